"""The floor gives the unit of length."""

import cv2
import numpy as np
import pytest
import torch
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.poses.solvers import rotation_exp
from pansplat.poses.world import FLOOR_HEIGHT, find_floor, level_poses


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
