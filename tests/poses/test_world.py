"""The floor gives the unit of length."""

import cv2
import numpy as np
import pytest
import torch
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.poses.solvers import rotation_exp
from pansplat.poses.world import FLOOR_HEIGHT, find_floor, level_poses


def _render(texture: Array, pose: Array, height: float) -> Array:
    """A room without walls: a textured floor, and a grey sky."""
    rays = pixel_directions(FLOOR_HEIGHT, 2 * FLOOR_HEIGHT, dtype=torch.float64).numpy() @ pose[:3, :3].T
    scale = (height - pose[1, 3]) / np.maximum(rays[..., 1], 1e-3)
    x, z = (rays[..., n] * scale + pose[n, 3] for n in (0, 2))
    size = len(texture)
    u, v = ((c * 40 + size / 2).astype(np.float32) for c in (x, z))
    image = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.where(rays[..., 1] > 0.05, image, 0.5).astype(np.float32)


@pytest.fixture(scope="module")
def scene() -> tuple[list[Array], Array]:
    """Two panoramas 1 m apart, 1.6 m above a floor."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 1, (512, 512)).astype(np.float32), (0, 0), 4)
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3], poses[1, :3, 3] = rotation_exp(np.array((0, 0.7, 0))), (0.8, 0, 0.6)
    return [_render(texture, pose, 1.6) for pose in poses], poses


def test_the_height_over_a_textured_floor_is_found(scene: tuple[list[Array], Array]) -> None:
    floor = find_floor(*scene, [(0, 1)])
    assert floor.is_found() and floor.height == pytest.approx(1.6, rel=0.03)


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
