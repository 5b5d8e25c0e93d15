"""The floor gives the unit of length."""

import cv2
import numpy as np
import pytest
import torch
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.poses.solvers import rotation_exp
from pansplat.poses.world import FLOOR_HEIGHT, Floor, find_common_height, find_floor, find_floors, level_poses


def _render(texture: Array, pose: Array, height: float, table: float | None = None) -> Array:
    """A room without walls: a textured floor, a grey sky, and a table 4 m wide, `table` below the origin."""
    rays = pixel_directions(FLOOR_HEIGHT, 2 * FLOOR_HEIGHT, dtype=torch.float64).numpy() @ pose[:3, :3].T
    x = z = np.zeros(rays.shape[:2])
    for plane in (height, height if table is None else table):
        scale = (plane - pose[1, 3]) / np.maximum(rays[..., 1], 1e-3)
        hit = [rays[..., n] * scale + pose[n, 3] for n in (0, 2)]
        seen = (np.abs(hit[0]) < 2) & (np.abs(hit[1]) < 2) | (plane == height)
        x, z = (np.where(seen, new, old) for new, old in zip(hit, (x, z), strict=True))
    size = len(texture)
    u, v = ((c * 40 + size / 2).astype(np.float32) for c in (x, z))
    image = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.where(rays[..., 1] > 0.05, image, 0.5).astype(np.float32)


@pytest.fixture(scope="module")
def texture() -> Array:
    texture = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 1, (512, 512)).astype(np.float32), (0, 0), 4)
    return (texture - texture.min()) / (texture.max() - texture.min())


@pytest.fixture(scope="module")
def scene(texture: Array) -> tuple[list[Array], Array]:
    """Two panoramas 1 m apart, 1.6 m above a floor."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3], poses[1, :3, 3] = rotation_exp(np.array((0, 0.7, 0))), (0.8, 0, 0.6)
    return [_render(texture, pose, 1.6) for pose in poses], poses


def test_the_height_over_a_textured_floor_is_found(scene: tuple[list[Array], Array]) -> None:
    floor = find_floor(*scene, [(0, 1)])
    assert floor.is_found() and floor.height == pytest.approx(1.6, rel=0.03)


def test_a_table_that_hides_much_of_the_floor_is_not_taken_for_it(texture: Array, scene) -> None:
    floor = find_floor([_render(texture, pose, 1.6, 1.0) for pose in scene[1]], scene[1], [(0, 1)])
    found = floor.height if floor.lower is None else floor.height * floor.lower
    assert floor.is_found() and found == pytest.approx(1.6, rel=0.05)


def test_a_wrong_pose_has_no_floor(scene: tuple[list[Array], Array]) -> None:
    images, poses = scene
    wrong = poses.copy()
    wrong[1, :3, :3] = rotation_exp(np.array((0, 2.5, 0)))
    assert not find_floor(images, wrong, [(0, 1)]).is_found()


def test_levelled_poses_have_y_down_and_the_first_camera_at_the_origin() -> None:
    turn = rotation_exp(np.array((0.4, -1.0, 2.0)))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3], poses[1, :3, 3] = turn, turn @ (1.0, 0, 2)
    levelled = level_poses(poses, np.tile((0.0, 1, 0), (2, 1)))
    assert np.allclose(levelled[0], np.eye(4), atol=1e-9)
    assert np.allclose(levelled[1, :3, 3], (1, 0, 2))


STOREY, HEIGHT = 2.9, 1.5  # of two storeys; of the cameras over their floors, metres
WELL = (1.2, 3.0), (-1.0, 1.5)  # hole of the upper floor: x and z


def _render_house(texture: Array, place: Array, step: float = 0.0) -> Array:
    """Two floors without walls, the lower one at y = 0; the upper one has another texture, and a stair well.

    `step`: how much lower the lower floor is beyond x = 0.
    """
    rays = pixel_directions(FLOOR_HEIGHT, 2 * FLOOR_HEIGHT, dtype=torch.float64).numpy()
    image = np.full(rays.shape[:2], 0.5, np.float32)
    for plane, low, high in ((step, 0, np.inf), (0, -np.inf, 0 if step else np.inf), (-STOREY, -np.inf, np.inf)):
        scale = (plane - place[1]) / np.where(np.abs(rays[..., 1]) > 0.05, rays[..., 1], -1e-9)
        x, z = (rays[..., n] * scale + place[n] for n in (0, 2))
        seen = (scale > 0) & (x >= low) & (x < high)
        if plane == -STOREY:
            seen &= (x < WELL[0][0]) | (x > WELL[0][1]) | (z < WELL[1][0]) | (z > WELL[1][1])
        u, v = ((c * 40 + 256 + 100 * plane).astype(np.float32) for c in (x, z))
        shown = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        image = np.where(seen, shown if place[1] < plane else 0.5, image).astype(np.float32)  # ceilings are plain
    return image


def _see_house(texture: Array, places: Array, unit: float = 1.5, **options) -> tuple[list[Array], Array, float]:
    """Panoramas and poses of level cameras, and the metres of the poses' unit."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places / unit
    return [_render_house(texture, place, **options) for place in places], poses, unit


LOWER = np.array(((-1.0, -HEIGHT, 0.0), (0.0, -HEIGHT, 0.8), (0.7, -HEIGHT, -0.4)))
UPPER = LOWER[:2] + np.array((0.3, -STOREY, 0.4))
STAIRS = np.array(((2.2, -HEIGHT - 1.4, 0.5),))


def test_each_storey_has_its_floor(texture: Array) -> None:
    images, poses, unit = _see_house(texture, np.concatenate((LOWER[:1], STAIRS, UPPER, LOWER[1:])))
    floors = find_floors(images, poses, unit)
    assert len(floors) == 2 and all(floor.is_found() for floor in floors)
    assert [floor.height * unit for floor in floors] == pytest.approx([HEIGHT, HEIGHT], rel=0.03)
    height, doubt = find_common_height(floors)
    assert height * unit == pytest.approx(HEIGHT, rel=0.03) and doubt is None


def test_a_storey_without_texture_does_not_spoil_the_scale_of_the_other(texture: Array) -> None:
    images, poses, unit = _see_house(texture, np.concatenate((LOWER, UPPER)))
    images[3:] = [np.full_like(image, 0.5) for image in images[3:]]
    floors = find_floors(images, poses, unit)
    assert [floor.is_found() for floor in floors] == [True, False]
    height, doubt = find_common_height(floors)
    assert height * unit == pytest.approx(HEIGHT, rel=0.03) and doubt is None


def test_panoramas_of_many_levels_find_the_floor_of_the_lowest(texture: Array) -> None:
    images, poses, unit = _see_house(texture, np.concatenate((UPPER[:1], STAIRS - np.eye(3)[0], LOWER[2:])))
    (floor,) = find_floors(images, poses, unit)
    assert floor.is_found() and floor.height * unit == pytest.approx(HEIGHT, rel=0.04)


def test_a_panorama_on_the_stairs_does_not_change_the_scale(texture: Array) -> None:
    images, poses, unit = _see_house(texture, np.concatenate((STAIRS + 0.5 * np.eye(3)[1], LOWER)))
    (floor,) = find_floors(images, poses, unit)
    assert floor.is_found() and floor.height * unit == pytest.approx(HEIGHT, rel=0.03)


def test_a_sunken_room_is_in_the_same_storey(texture: Array) -> None:
    places = LOWER + np.where(LOWER[:, :1] > 0, 1, 0) * (0, 0.3, 0)
    images, poses, unit = _see_house(texture, places, step=0.3)
    (floor,) = find_floors(images, poses, unit)
    assert floor == find_floor(images, poses, [(0, 1), (1, 2), (0, 2)]), "the nearest pairs of all first"
    assert floor.is_found() and 1.36 < floor.height * unit < 1.75, "one of both levels, 1.4 and 1.7 m below the mean"


def test_agreeing_storeys_state_the_height_and_others_make_it_uncertain() -> None:
    low, same, strong = Floor(1.0, 0.1, 2.0, 1.5), Floor(1.04, 0.1, 2.0), Floor(0.5, 0.15, 2.0)
    assert find_common_height([Floor(1.0, 0.1, 1.0)]) is None
    assert find_common_height([low]) == (1.0, "a plane 1.5 times as deep may be the floor")
    assert find_common_height([low, same]) == (pytest.approx(1.02), None)
    assert find_common_height([low, strong, same]) == (pytest.approx(1.02), "the floors of the storeys differ")
    assert find_common_height([low, strong]) == (0.5, "the floors of the storeys differ")
