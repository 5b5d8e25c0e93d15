"""Textured triangles of a box room: places, textures, steps in depth, each place once, and the files."""

import dataclasses
import weakref
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from synthetic_scenes import make_balls, place_cameras

from pansplat.errors import InputError
from pansplat.export.mesh import make_mesh
from pansplat.export.mesh_files import Mesh, MeshPart, remove_old_meshes, save_mesh
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.geometry.world import WorldFrame
from pansplat.tours.doll_house import find_rooms
from pansplat.tours.facts import TourFacts

LOW, HIGH = torch.tensor((-2.0, -1.1, -3.0)), torch.tensor((2.0, 1.5, 3.0))  # y is down
CENTERS = torch.tensor(((-0.8, 0.0, -1.0), (0.8, 0.1, 1.2)))
TURN = torch.tensor(((0.8, 0.0, 0.6), (0.0, 1.0, 0.0), (-0.6, 0.0, 0.8)))  # of the second camera
TRIANGLES = 4 * 2 * 64**2


def _color(places: torch.Tensor) -> torch.Tensor:
    """A smooth colour of each place of the room."""
    return 0.1 + 0.8 * (places - LOW) / (HIGH - LOW)


def _view(view: int, screen: float | None = None, count: int = 60000) -> Gaussians:
    """The Gaussians of the walls around a camera, and of a disc at a distance ahead of it."""
    rays = fibonacci_directions(count).float() + 1e-9
    center = CENTERS[view]
    distance = (torch.where(rays > 0, HIGH - center, LOW - center) / rays).min(dim=1).values
    if screen is not None:
        distance = torch.where(rays[:, 2] > 0.95, screen, distance)
    means = center + distance[:, None] * rays
    return make_balls(means, 0.009 * distance[:, None], 0.98, color=_color(means), views=view)


@pytest.fixture(scope="module")
def box() -> Scene:
    """A room that two cameras see."""
    poses = place_cameras(*CENTERS.tolist())
    poses[1, :3, :3] = TURN.double()
    return Scene(Gaussians.cat([_view(0), _view(1)]), poses, 0.5, 10.0, names=("a.jpg", "b.jpg"), height=128)


@pytest.fixture(scope="module")
def mesh(box: Scene) -> Mesh:
    return make_mesh(box, triangles=TRIANGLES)


def _measure_offset(places: np.ndarray) -> np.ndarray:
    """Distance of places from the nearest wall, metres."""
    return np.minimum(np.abs(places - LOW.numpy()), np.abs(places - HIGH.numpy())).min(axis=1)


def _measure_area(mesh: Mesh) -> float:
    return sum(trimesh.Trimesh(part.positions, part.triangles, process=False).area for part in mesh.parts)


def test_vertices_are_on_the_walls_and_cover_them_once(mesh: Mesh) -> None:
    size = (HIGH - LOW).numpy()
    for part in mesh.parts:
        offset = _measure_offset(part.positions)
        assert np.quantile(offset, 0.99) < 0.01 * size.max() and offset.max() < 0.03 * size.max()
        assert part.uv.min() >= 0 and part.uv[:, 0].max() <= 1 + 1 / 128 and part.uv[:, 1].max() <= 1
    box_area = 2 * float(size[0] * size[1] + size[1] * size[2] + size[0] * size[2])
    assert _measure_area(mesh) == pytest.approx(box_area, rel=0.05), "closed, and little of it twice"
    assert 0.5 * TRIANGLES < mesh.num_triangles < 0.95 * TRIANGLES


def test_what_a_window_shows_is_left_out_of_the_rooms() -> None:
    """A window of 2.4 x 1.4 m in the right wall shows a fence 5 m behind it."""
    views = []
    for view in (0, 1):
        gaussians, center = _view(view), CENTERS[view]
        offset = gaussians.means - center
        at_wall = offset * ((HIGH[0] - center[0]) / offset[:, 0])[:, None] + center
        in_window = (offset[:, 0] > 0) & (at_wall[:, 1].abs() < 0.7) & (at_wall[:, 2].abs() < 1.2)
        in_window &= gaussians.means[:, 0] > HIGH[0] - 1e-3
        factor = torch.where(in_window, (HIGH[0] + 5 - center[0]) / (HIGH[0] - center[0]), 1.0)
        moved = {"means": center + offset * factor[:, None], "scales": gaussians.scales * factor[:, None]}
        views.append(dataclasses.replace(gaussians, **moved))
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, :3, 3] = CENTERS.double()
    scene = Scene(Gaussians.cat(views), poses, 0.5, 10.0, names=("a.jpg", "b.jpg"), height=128)
    whole = make_mesh(scene, triangles=TRIANGLES)
    cropped = make_mesh(scene, triangles=TRIANGLES, inside=find_rooms(TourFacts(scene)).contains)
    reach = [max(float(part.positions[part.triangles, 0].max()) for part in mesh.parts) for mesh in (whole, cropped)]
    assert reach[0] > float(HIGH[0]) + 4 and reach[1] < float(HIGH[0]) + 0.5
    size = (HIGH - LOW).numpy()
    walls = 2 * float(size[0] * size[1] + size[1] * size[2] + size[0] * size[2]) - 2.4 * 1.4
    assert _measure_area(cropped) == pytest.approx(walls, rel=0.08), "the room is whole"


def test_triangles_face_their_camera(mesh: Mesh) -> None:
    for part, center in zip(mesh.parts, CENTERS.numpy(), strict=True):
        a, b, c = (part.positions[part.triangles[:, k]] for k in range(3))
        assert ((np.cross(b - a, c - a) * (center - a)).sum(axis=1) > 0).all()


def test_each_place_is_kept_from_the_nearest_camera(mesh: Mesh) -> None:
    for view, part in enumerate(mesh.parts):
        distance = [np.linalg.norm(part.positions - center, axis=1) for center in CENTERS.numpy()]
        nearer = distance[view] - distance[1 - view]
        assert np.quantile(nearer, 0.97) < 0.05 and nearer.max() < 0.4, "but for one triangle beyond the border"


def test_photographs_are_textures_without_their_exposure(box: Scene) -> None:
    grey = torch.full((3, 16, 32), 0.4)
    exposed = dataclasses.replace(box, gains=((2.0, 1.0, 1.0), (0.5, 1.0, 1.0)))
    parts = make_mesh(exposed, triangles=TRIANGLES, textures=lambda view: grey * (1 + view)).parts
    assert [part.texture()[0, 0].tolist() for part in parts] == [[51, 102, 102], [255, 204, 204]]


def test_no_triangle_spans_a_step_in_depth(box: Scene) -> None:
    scene = dataclasses.replace(box, gaussians=_view(0, screen=0.8), cam2world=box.cam2world[:1], names=("a.jpg",))
    (part,) = make_mesh(scene, triangles=TRIANGLES).parts
    corners = part.positions[part.triangles] - CENTERS[0].numpy()
    distance = np.linalg.norm(corners, axis=2)
    on_screen = distance < 1.0
    assert on_screen.all(axis=1).sum() > 20, "the screen"
    middle = distance[(np.abs(corners.mean(axis=1)[:, :2]) < 0.6).all(axis=1) & (corners[..., 2] > 0).all(axis=1)]
    assert np.ptp(middle, axis=1).max() < 0.5, "the wall is 3.2 m behind the screen"


def test_the_background_is_no_surface(box: Scene, mesh: Mesh) -> None:
    """Where a mask leaves out the floor below a camera, the background behind the surfaces shows beside the hole."""
    is_masked = (box.gaussians.views == 0) & (
        (box.gaussians.means - CENTERS[0])[:, 1] > 0.85 * (box.gaussians.means - CENTERS[0]).norm(dim=1)
    )
    behind = box.gaussians.select((box.gaussians.views == 0) & ~is_masked)
    means = CENTERS[0] + 1.5 * (behind.means - CENTERS[0])
    behind = dataclasses.replace(behind, means=means, scales=4 * behind.scales, levels=behind.levels + 2)
    gaussians = Gaussians.cat([box.gaussians.select(~is_masked), behind])
    filled = make_mesh(dataclasses.replace(box, gaussians=gaussians), triangles=TRIANGLES)
    assert max(_measure_offset(part.positions).max() for part in filled.parts) < 0.1
    assert _measure_area(filled) == pytest.approx(_measure_area(mesh), rel=0.03), "the other camera fills the hole"


def test_a_joint_scene_and_another_unit_give_the_same_surface(box: Scene, mesh: Mesh) -> None:
    scaled = make_mesh(box.scaled(1024.0), triangles=TRIANGLES)
    assert scaled.num_triangles == mesh.num_triangles
    assert np.allclose(scaled.parts[0].positions, 1024 * mesh.parts[0].positions, rtol=1e-3, atol=1)
    joint = make_mesh(dataclasses.replace(box, joint=True), triangles=TRIANGLES)
    assert _measure_area(joint) == pytest.approx(_measure_area(mesh), rel=0.05)


def test_files_are_read_by_another_program(mesh: Mesh, tmp_path: Path) -> None:
    save_mesh(mesh, tmp_path / "house.glb")
    assert [path.name for path in tmp_path.iterdir()] == ["house.glb"]
    read = trimesh.load(tmp_path / "house.glb", process=False)
    parts = sorted(read.geometry.values(), key=lambda part: part.vertices[:, 2].mean(), reverse=True)  # z backward
    assert len(parts) == 2
    for part, written in zip(parts, mesh.parts, strict=True):
        corners = np.asarray(part.triangles) * (1, -1, -1)
        expected = written.positions[written.triangles]
        assert corners.shape == expected.shape
        assert np.allclose(corners.mean(axis=(0, 1)), expected.mean(axis=(0, 1)), atol=1e-3)
        image = part.visual.material.baseColorTexture
        assert not image.getexif()
        pixels = np.asarray(image.convert("RGB"), float)
        uv = part.visual.uv
        column = (uv[:, 0] * pixels.shape[1]).astype(int) % pixels.shape[1]
        row = ((1 - uv[:, 1]) * pixels.shape[0]).astype(int).clip(0, pixels.shape[0] - 1)
        places = np.asarray(part.vertices) * (1, -1, -1)
        error = np.abs(pixels[row, column] - 255 * _color(torch.from_numpy(places)).numpy())
        assert np.quantile(error, 0.98) < 6 and error.max() < 24
        assert np.ptp(uv[part.faces], axis=1).max() < 0.02, "no triangle spans the whole texture, also at its seam"


def test_further_meshes_of_an_earlier_export_are_removed_and_other_exports_stay(mesh: Mesh, tmp_path: Path) -> None:
    path = tmp_path / "k\xfcche.glb"
    further = [dataclasses.replace(mesh, part_of=name) for name in (path.name, path.name, "other.glb")]
    files = [path.with_stem(f"{path.stem}_{k}") for k in range(2, 6)]
    for part, file in zip((mesh, *further), files, strict=True):
        save_mesh(part, file)
    users = path.with_stem(f"{path.stem}_7")
    users.write_text(f'"part_of":"{path.name}"')
    remove_old_meshes(path, [files[1]])
    assert set(tmp_path.iterdir()) == {files[0], files[1], files[3], users}, "without the third one"


@pytest.mark.parametrize("frame", [WorldFrame(1e3), WorldFrame(1.0, (5e6, -4e5, 64.0))])
def test_files_are_in_the_unit_of_the_poses_and_at_their_place_or_state_it(
    box: Scene, tmp_path: Path, frame: WorldFrame
) -> None:
    mesh = make_mesh(dataclasses.replace(box, frame=frame), triangles=TRIANGLES)
    places = np.concatenate([part.positions for part in mesh.parts])
    save_mesh(mesh, tmp_path / "house.glb")
    read = trimesh.load(tmp_path / "house.glb", process=False)
    vertices = np.concatenate([np.asarray(part.vertices) for part in read.geometry.values()]) * (1, -1, -1)
    assert np.allclose(np.sort(vertices, axis=0), np.sort(frame.unit * places, axis=0), rtol=1e-5, atol=1e-3)
    assert (b'"origin":[5000000.0,-400000.0,64.0]' in (tmp_path / "house.glb").read_bytes()) == any(frame.origin)


def _read_textures(file: Path) -> list[np.ndarray]:
    """The textures of the parts of a file, (height, width, 3)."""
    parts = trimesh.load_scene(file, process=False).geometry.values()
    return [np.asarray(part.visual.material.baseColorTexture.convert("RGB"), float) for part in parts]


def test_textures_show_nothing_that_no_triangle_uses(box: Scene, tmp_path: Path) -> None:
    """Half of the walls are left out, and the photograph is red there; the seam of the texture is in the other half."""
    rays = box.gaussians.means - CENTERS[0]
    kept = box.gaussians.select((box.gaussians.views == 0) & (rays[:, 2] < 0.3 * rays[:, 0]))
    scene = dataclasses.replace(box, gaussians=kept, cam2world=box.cam2world[:1], names=("a.jpg",))
    directions = pixel_directions(256, 512)
    is_secret = directions[..., 2] > 0.3 * directions[..., 0] + 0.03  # more than a triangle from the edge of the walls
    photograph = torch.where(is_secret, torch.tensor((1.0, 0, 0))[:, None, None], torch.tensor(0.4))
    file = tmp_path / "house.glb"
    save_mesh(make_mesh(scene, triangles=TRIANGLES, textures=lambda view: photograph), file)
    (texture,) = _read_textures(file)
    assert texture.shape == (256, 512, 3) and np.abs(texture - 102).max() < 12, "grey, as what the triangles show"


def test_what_triangles_use_of_a_texture_is_that_of_the_photograph(
    box: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pansplat.export.mesh_files._QUALITY", 100)
    noise = torch.rand(1, 128, 256, generator=torch.Generator().manual_seed(0)).expand(3, -1, -1)  # grey
    mesh = make_mesh(box, triangles=TRIANGLES, textures=lambda view: noise)
    save_mesh(mesh, tmp_path / "a.glb")
    expected = 255 * noise.permute(1, 2, 0).numpy()
    for part, texture in zip(mesh.parts, _read_textures(tmp_path / "a.glb"), strict=True):
        corners = part.uv[part.triangles]
        for weights in ((1, 0, 0), (0.05, 0.9, 0.05), (1 / 3, 1 / 3, 1 / 3), (0.5, 0.5, 0), (0, 0.3, 0.7)):
            place = np.einsum("k,tkc->tc", weights, corners) * (256, 128) - 0.5
            first = np.floor(place).astype(int)
            for right in (0, 1):  # the texels of bilinear filtering
                for below in (0, 1):
                    column, row = (first[:, 0] + right) % 256, (first[:, 1] + below).clip(0, 127)
                    assert np.abs(texture[row, column] - expected[row, column]).max() < 4


def test_one_texture_is_in_memory_at_a_time(mesh: Mesh, tmp_path: Path) -> None:
    made: list[weakref.ref] = []

    def make(part: MeshPart) -> np.ndarray:
        assert not any(texture() is not None for texture in made), "an earlier one is still in memory"
        texture = part.texture()
        made.append(weakref.ref(texture))
        return texture

    parts = [dataclasses.replace(part, texture=partial(make, part)) for part in mesh.parts * 3]
    save_mesh(Mesh(tuple(parts)), tmp_path / "house.glb")
    assert len(made) == 6


def test_bad_scenes_and_names_are_refused(box: Scene, mesh: Mesh, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs a scene with input cameras"):
        make_mesh(dataclasses.replace(box, cam2world=box.cam2world[:0]))
    with pytest.raises(InputError, match="needs 512 triangles or more, got a limit of 100"):
        make_mesh(box, triangles=100)
    with pytest.raises(InputError, match=r"must end in \.glb"):
        save_mesh(mesh, tmp_path / "a.stl")
    with pytest.raises(InputError, match="needed one or more triangles"):
        save_mesh(Mesh(()), tmp_path / "a.glb")
