"""Panoramas: turning rolls, no seams, poles; cube faces, and stitching against the original's fixtures."""

import dataclasses
import math

import pytest
import torch

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.cubemap import face_of, face_poses, face_rotations, official_faces
from pansplat.geometry.equirect import pixel_directions, uv_from_directions
from pansplat.geometry.pose import multiply_quats, quats_from_rotations, rotations_from_quats
from pansplat.rendering import rasterize
from pansplat.rendering.image_planes import ImagePlane, stitch_faces


def _turned(pose: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3] @ rotation
    return turned


def _yaw(angle: float) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)


@pytest.mark.parametrize("columns", [1, 7, 24])
@pytest.mark.parametrize("width", [48, 50])
def test_turning_the_camera_rolls_the_panorama(columns, width, make_scene, pose):
    scene = make_scene(150, scale=0.15)
    still = rasterize(scene, pose, size=(24, width))
    turned = rasterize(scene, _turned(pose, _yaw(columns * 2 * math.pi / width)), size=(24, width))
    for name in ("color", "alpha", "depth"):
        rolled = torch.roll(getattr(still, name), -columns, dims=-1)
        assert torch.allclose(rolled, getattr(turned, name), atol=1e-9)


@pytest.mark.parametrize(
    ("layout", "kernel"),
    [("equirect", "ray"), ("cubemap", "ray"), ("pinhole", "ray"), ("cubemap", "ewa"), ("pinhole", "ewa")],
)
def test_turning_scene_and_camera_together_changes_nothing(layout, kernel, make_scene, pose):
    scene = make_scene(60, degree=0)
    quat = torch.tensor((0.5, -0.3, 0.7, 0.1), dtype=torch.float64)
    quat = quat / quat.norm()
    rotation = rotations_from_quats(quat)
    rotated = Gaussians(
        scene.means @ rotation.T, scene.scales, multiply_quats(quat.expand(60, 4), scene.quats),
        scene.opacities, scene.harmonics, scene.levels, scene.views,
    )  # fmt: skip
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3] = rotation
    a = rasterize(scene, pose, size=(20, 40), layout=layout, kernel=kernel)
    b = rasterize(rotated, world @ pose, size=(20, 40), layout=layout, kernel=kernel)
    assert float(a.alpha.mean()) > 0.1
    assert torch.allclose(a.color, b.color, atol=1e-9) and torch.allclose(a.depth, b.depth, atol=1e-9)


def test_a_panorama_pixel_is_a_one_pixel_pinhole_picture(make_scene, pose):
    scene = make_scene(80, scale=0.3)
    height, width = 16, 32
    panorama = rasterize(scene, pose, size=(height, width))
    # A pinhole picture whose one pixel covers the same angle, at seams, poles, and the middle.
    fov = 2 * math.degrees(math.atan(0.5 * math.pi / height))
    for row, column in ((0, 0), (0, 17), (15, 31), (8, 0), (7, 31), (8, 16), (3, 9)):
        ahead = pixel_directions(height, width, dtype=torch.float64)[row, column]
        right = torch.linalg.cross(torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64), ahead)
        right = right / right.norm()
        rotation = torch.stack((right, torch.linalg.cross(ahead, right), ahead), dim=1)
        look = rasterize(scene, _turned(pose, rotation), size=(1, 1), layout="pinhole", vertical_fov_degrees=fov)
        assert torch.allclose(look.color[:, 0, 0], panorama.color[:, row, column], atol=1e-9)
        assert torch.allclose(look.depth[0, 0], panorama.depth[row, column], atol=1e-9)


def _ball(mean: tuple[float, float, float], sigma: float = 0.2) -> Gaussians:
    label = torch.zeros(1, dtype=torch.int64)
    return Gaussians(
        torch.tensor([mean], dtype=torch.float64), torch.full((1, 3), sigma, dtype=torch.float64),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64), torch.tensor([0.9], dtype=torch.float64),
        torch.ones(1, 1, 3, dtype=torch.float64), label, label,
    )  # fmt: skip


def test_a_ball_behind_is_symmetric_across_the_seam():
    alpha = rasterize(_ball((0.0, 0.3, -2.0)), torch.eye(4).double(), size=(32, 64)).alpha
    assert float(alpha[:, 0].max()) > 0.5 and float(alpha[:, 32].max()) == 0
    assert torch.allclose(alpha, alpha.flip(1), atol=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_ball_at_a_pole_fills_whole_rows_evenly(side):
    alpha = rasterize(_ball((0.0, 2.0 * side, 0.0)), torch.eye(4).double(), size=(32, 64)).alpha
    alpha = alpha if side > 0 else alpha.flip(0)
    assert float(alpha[-1].min()) > 0.5 and float(alpha[:16].max()) == 0
    assert torch.allclose(alpha, alpha[:, :1].expand_as(alpha), atol=1e-12)


@pytest.mark.parametrize("kernel", ["ray", "ewa"])
def test_a_face_of_the_cubemap_is_a_pinhole_picture(kernel, make_scene, pose):
    scene = make_scene(80, scale=0.3)
    faces = [rasterize(scene, p, size=(16, 16), layout="pinhole", kernel=kernel, order="z") for p in face_poses(pose)]
    panorama = rasterize(scene, pose, size=(12, 24), layout="cubemap", face_size=16, kernel=kernel, order="z")
    expected = stitch_faces(torch.stack([f.color for f in faces]), (12, 24))
    assert torch.allclose(panorama.color, expected, atol=1e-9)


def test_the_cubemap_tends_to_the_direct_panorama(make_scene, pose):
    scene = make_scene(60, scale=0.4)
    # Far wider than either filter, which a finer face narrows.
    scene = dataclasses.replace(scene, scales=scene.scales.clamp_min(0.5))
    direct = rasterize(scene, pose, size=(32, 64))
    errors = []
    for face_size in (20, 40, 80):
        stitched = rasterize(scene, pose, size=(32, 64), layout="cubemap", face_size=face_size)
        errors.append(float((stitched.color - direct.color).abs().mean()))
    # The edges at which alpha is cut are steps, so the error falls with the face's pixel, not its square.
    assert errors[1] < errors[0] and errors[2] < 0.4 * errors[0] and errors[2] < 2e-3


@pytest.mark.shared
def test_official_faces_are_the_originals(golden):
    assert torch.equal(official_faces(64), golden("units")["cubemap.face"].long())


@pytest.mark.shared
def test_official_stitching_equals_the_originals(golden):
    fixtures = golden("units")
    expected = fixtures["cubemap.pano_out"][0].double()
    got = stitch_faces(fixtures["cubemap.faces_in"][0].double(), (64, 128), stitching="official")
    # The original looks up float32 places in a strip of six padded faces, 204 pixels long, where neighbouring numbers
    # are 1.5e-5 apart; the fixture's faces are noise, up to 1 from pixel to pixel.
    assert float((got - expected).abs().max()) < 3e-5
    # Rounding its places as it does leaves a sixth of the pixels, where the last bit fell otherwise.
    rounded = _stitched_in_a_float32_strip(fixtures, got)
    far = (rounded - expected).abs().amax(dim=0) > 5e-7
    assert float(far.double().mean()) < 0.2


def _stitched_in_a_float32_strip(fixtures, stitched: torch.Tensor) -> torch.Tensor:
    """`stitched` moved by what rounding each place in a strip of padded faces to float32 moves it."""
    face, x, y = (fixtures[f"cubemap.{name}"] for name in ("face", "x", "y"))
    strip = _padded_official(fixtures["cubemap.faces_in"][0]).permute(1, 0, 2, 3).reshape(3, 6 * 34, 34)
    grid = torch.stack(((x + 1) / 34 * 2 - 1, (y + 1 + 34 * face) / 204 * 2 - 1), dim=-1)
    assert grid.dtype == torch.float32
    return torch.nn.functional.grid_sample(strip[None], grid[None], align_corners=False)[0].to(stitched)


def _padded_official(faces: torch.Tensor) -> torch.Tensor:
    """Faces with the original's borders as OFFICIAL.md describes them (P9, T6), written out edge by edge."""
    front, right, back, left, up, down = faces
    padded = torch.zeros(6, 3, 34, 34)
    padded[:, :, 1:-1, 1:-1] = faces
    around = (front, right, back, left)
    for i in range(4):
        padded[i, :, 1:-1, 0] = around[i - 1][:, :, -1]
        padded[i, :, 1:-1, -1] = around[(i + 1) % 4][:, :, 0]
    over = (up[:, -1], up[:, :, -1].flip(1), up[:, 0].flip(1), up[:, :, 0])
    under = (down[:, 0], down[:, :, -1], down[:, -1].flip(1), down[:, :, 0].flip(1))
    for i in range(4):
        padded[i, :, 0, 1:-1], padded[i, :, -1, 1:-1] = over[i], under[i]
    padded[4, :, 0, 1:-1], padded[4, :, -1, 1:-1] = back[:, 0].flip(1), front[:, 0]
    padded[5, :, 0, 1:-1], padded[5, :, -1, 1:-1] = front[:, -1], back[:, -1].flip(1)
    # Left and right of up and down: a row too low, behind a zero; down's are its own.
    padded[4, :, 2:, 0], padded[4, :, 2:, -1] = left[:, 0], right[:, 0].flip(1)
    padded[5, :, 2:, 0], padded[5, :, 2:, -1] = down[:, :, 0], down[:, :, -1]
    return padded


@pytest.mark.shared
def test_the_two_stitchings_differ_beside_up_and_down_only(golden):
    faces = golden("units")["cubemap.faces_in"][0].double()
    theirs, ours = (stitch_faces(faces, (64, 128), stitching=way) for way in ("official", "seamless"))
    differ = (theirs - ours).abs().amax(dim=0) > 1e-12
    assert 0 < int(differ.sum()) <= 96
    along = face_of(pixel_directions(64, 128, dtype=torch.float64)) >= 4
    grown = torch.nn.functional.max_pool2d(along[None].float(), 3, 1, 1)[0] > 0
    assert not (differ & ~grown).any()


@pytest.mark.shared
def test_depth_along_an_axis_becomes_distance_by_the_originals_factor(golden):
    ahead = ImagePlane((32, 32), face_rotations()[0], 16.0).directions()[..., 2]
    assert torch.allclose(1 / ahead, golden("units")["cubemap.depth_norm"].double(), rtol=0, atol=2e-7)


@pytest.mark.parametrize("stitching", ["seamless", "official"])
def test_stitching_face_by_face_adds_up_to_the_whole(stitching):
    generator = torch.Generator().manual_seed(0)
    faces = torch.randn(6, 2, 6, 6, generator=generator, dtype=torch.float64)
    whole = stitch_faces(faces, (12, 24), stitching=stitching)
    parts = torch.zeros_like(whole)
    for face in range(6):
        alone = torch.zeros_like(faces)
        alone[face] = faces[face]
        parts += stitch_faces(alone, (12, 24), stitching=stitching)
    assert torch.allclose(parts, whole, rtol=0, atol=1e-14)


def test_official_stitching_refuses_what_the_original_cannot_stitch(make_scene, pose):
    scene = make_scene(3)
    for options in ({"size": (6, 12)}, {"size": (8, 12)}, {"size": (8, 16), "layout": "equirect"}):
        with pytest.raises(InputError, match="'official' needs layout='cubemap' and a 2:1 panorama"):
            rasterize(scene, pose, **{"layout": "cubemap", "stitching": "official", **options})
    with pytest.raises(ValueError, match="must be 2:1"):
        stitch_faces(torch.zeros(6, 1, 4, 4), (8, 8), stitching="official")
    with pytest.raises(ValueError, match="multiple of 4, got 6"):
        stitch_faces(torch.zeros(6, 1, 4, 4), (6, 12), stitching="official")


@pytest.mark.shared
def test_face_rotations_equal_the_originals(golden):
    expected = golden("units")["cubemap.rotations"]
    assert torch.allclose(face_rotations().float(), expected[:, :3, :3], atol=1e-6)


@pytest.mark.parametrize("num", [1, 2, 7, 16])
def test_stitching_equal_faces_gives_the_same_value_everywhere(num):
    faces = torch.full((6, 2, num, num), 0.7, dtype=torch.float64)
    assert torch.allclose(stitch_faces(faces, (9, 18)), torch.full((2, 9, 18), 0.7, dtype=torch.float64), atol=1e-14)


def _direction_faces(num: int) -> torch.Tensor:
    pictures = [ImagePlane((num, num), rotation, 0.5 * num) for rotation in face_rotations()]
    return torch.stack([p.directions() for p in pictures]).permute(0, 3, 1, 2)


def test_stitching_reproduces_the_direction_of_every_pixel_across_edges_and_corners():
    expected = pixel_directions(64, 128, dtype=torch.float64).permute(2, 0, 1)
    errors = [float((stitch_faces(_direction_faces(num), (64, 128)) - expected).norm(dim=0).max()) for num in (16, 64)]
    # Bilinear within a face, and a neighbour's pixel is less than a pixel from its ideal place.
    assert errors[0] < 0.05 and errors[1] < 0.012
    uv = uv_from_directions(stitch_faces(_direction_faces(64), (64, 128)).permute(1, 2, 0))
    assert float((uv[..., 1] - (torch.arange(64) + 0.5)[:, None] / 64).abs().max()) < 0.005


@pytest.mark.parametrize("stitching", ["seamless", "official"])
def test_stitching_is_the_adjoint_of_its_gradient(stitching):
    generator = torch.Generator().manual_seed(0)
    faces = torch.randn(6, 3, 9, 9, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(3, 16, 32, generator=generator, dtype=torch.float64)
    picture = stitch_faces(faces, (16, 32), stitching=stitching)
    (adjoint,) = torch.autograd.grad(picture, faces, weights)
    other = torch.randn(6, 3, 9, 9, generator=generator, dtype=torch.float64)
    left, right = (stitch_faces(other, (16, 32), stitching=stitching) * weights).sum(), (other * adjoint).sum()
    assert float((left - right).abs() / left.abs()) < 1e-12


def test_every_face_pixel_reaches_a_panorama_that_is_fine_enough():
    faces = torch.zeros(6, 1, 8, 8, dtype=torch.float64, requires_grad=True)
    (reach,) = torch.autograd.grad(stitch_faces(faces, (64, 128)).sum(), faces)
    assert float(reach.min()) > 0


def test_cube_directions_meet_the_camera_axes():
    upright = quats_from_rotations(face_rotations())
    assert torch.isfinite(upright).all()
    assert face_of(face_rotations()[:, :, 2]).tolist() == list(range(6))
