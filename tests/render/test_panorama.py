"""Panoramas: turning rolls, no seams, poles; cube faces, and stitching against the original's fixtures."""

import dataclasses
import math

import pytest
import torch
from safetensors.torch import load_file

from pansplat.gaussians.gaussians import Gaussians
from pansplat.geometry.cubemap import face_poses, face_rotations
from pansplat.geometry.equirect import pixel_directions, uv_from_directions
from pansplat.geometry.pose import multiply_quats, quats_from_rotations, rotations_from_quats
from pansplat.render import rasterize
from pansplat.render.panorama import Picture, face_of, stitch_faces


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
def test_stitching_equals_the_originals_where_its_borders_are_right(shared):
    fixtures = load_file(shared / "golden" / "units.safetensors")
    expected = fixtures["cubemap.pano_out"][0]
    got = stitch_faces(fixtures["cubemap.faces_in"][0], tuple(expected.shape[1:]))
    face, theirs = face_of(pixel_directions(64, 128, dtype=torch.float64)), fixtures["cubemap.face"].long()
    same = face == theirs
    assert int((~same).sum()) <= 32  # the original rounds the up and down faces' outline to whole rows
    # Its borders of the up and down faces are shifted (OFFICIAL.md, P9).
    inside = torch.stack([(fixtures[f"cubemap.{axis}"] - 16).abs() <= 15.5 for axis in "xy"]).all(dim=0)
    right = same & ((face < 4) | inside)
    assert float((got - expected).abs().amax(dim=0)[right].max()) < 5e-5
    assert int((right & ~inside).sum()) > 40


@pytest.mark.shared
def test_face_rotations_equal_the_originals(shared):
    expected = load_file(shared / "golden" / "units.safetensors")["cubemap.rotations"]
    assert torch.allclose(face_rotations().float(), expected[:, :3, :3], atol=1e-6)


@pytest.mark.parametrize("num", [1, 2, 7, 16])
def test_stitching_equal_faces_gives_the_same_value_everywhere(num):
    faces = torch.full((6, 2, num, num), 0.7, dtype=torch.float64)
    assert torch.allclose(stitch_faces(faces, (9, 18)), torch.full((2, 9, 18), 0.7, dtype=torch.float64), atol=1e-14)


def _direction_faces(num: int) -> torch.Tensor:
    pictures = [Picture((num, num), rotation, 0.5 * num) for rotation in face_rotations()]
    return torch.stack([p.directions() for p in pictures]).permute(0, 3, 1, 2)


def test_stitching_reproduces_the_direction_of_every_pixel_across_edges_and_corners():
    expected = pixel_directions(64, 128, dtype=torch.float64).permute(2, 0, 1)
    errors = [float((stitch_faces(_direction_faces(num), (64, 128)) - expected).norm(dim=0).max()) for num in (16, 64)]
    # Bilinear within a face, and a neighbour's pixel is less than a pixel from its ideal place.
    assert errors[0] < 0.05 and errors[1] < 0.012
    uv = uv_from_directions(stitch_faces(_direction_faces(64), (64, 128)).permute(1, 2, 0))
    assert float((uv[..., 1] - (torch.arange(64) + 0.5)[:, None] / 64).abs().max()) < 0.005


def test_stitching_is_the_adjoint_of_its_gradient():
    generator = torch.Generator().manual_seed(0)
    faces = torch.randn(6, 3, 9, 9, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(3, 14, 28, generator=generator, dtype=torch.float64)
    picture = stitch_faces(faces, (14, 28))
    (adjoint,) = torch.autograd.grad(picture, faces, weights)
    other = torch.randn(6, 3, 9, 9, generator=generator, dtype=torch.float64)
    left, right = (stitch_faces(other, (14, 28)) * weights).sum(), (other * adjoint).sum()
    assert float((left - right).abs() / left.abs()) < 1e-12


def test_every_face_pixel_reaches_a_panorama_that_is_fine_enough():
    faces = torch.zeros(6, 1, 8, 8, dtype=torch.float64, requires_grad=True)
    (reach,) = torch.autograd.grad(stitch_faces(faces, (64, 128)).sum(), faces)
    assert float(reach.min()) > 0


def test_cube_directions_meet_the_camera_axes():
    upright = quats_from_rotations(face_rotations())
    assert torch.isfinite(upright).all()
    assert face_of(face_rotations()[:, :, 2]).tolist() == list(range(6))
