"""The point under the pointer: its ray and its depth."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls

from pansplat.gaussians.scene import Scene
from pansplat.rendering import rasterize
from pansplat_viewer.scene.camera import Camera, turn
from pansplat_viewer.scene.picking import compute_pixel_ray, pick_point, project_point
from pansplat_viewer.scene.settings import DrawSettings

SIZE = (80, 60)
CAMERA = replace(turn(Camera(), 0.4, 0.2), position=(0.3, -0.2, 0.1), vertical_fov_degrees=70.0)


@pytest.fixture
def scene() -> Scene:
    """Two flat discs ahead of the origin: a translucent one at 2 m and an opaque one at 3 m."""
    means, sizes = ((0.0, 0.0, 2.0), (0.0, 0.0, 3.0)), ((0.2, 0.2, 0.0), (0.5, 0.5, 0.0))
    opacities, levels, views = torch.tensor((0.25, 0.9)), torch.tensor((0, 2)), torch.tensor((0, 1))
    gaussians = make_balls(torch.tensor(means), torch.tensor(sizes), opacities, levels=levels, views=views)
    return Scene(gaussians, torch.eye(4, dtype=torch.float64)[None], 0.1, 10.0)


def test_rays_and_projection_are_inverse():
    for pixel in ((0.0, 0.0), (79.5, 3.5), (40.0, 30.0)):
        origin, direction = compute_pixel_ray(CAMERA, pixel, SIZE)
        assert project_point(CAMERA, tuple(origin + 2.5 * direction), SIZE) == pytest.approx(pixel)
        assert math.isclose(np.linalg.norm(direction), 1.0)
    origin, direction = compute_pixel_ray(CAMERA, (40.0, 30.0), SIZE)
    assert np.allclose(direction, CAMERA.rotation[:, 2]), "the middle of the image is ahead"
    assert project_point(CAMERA, tuple(origin - direction), SIZE) is None


def test_depth_is_the_mean_by_weight(scene):
    point = pick_point(scene, np.zeros(3), np.array((0.0, 0.0, 1.0)), DrawSettings())
    weights = np.array((0.25, 0.75 * 0.9))
    assert point.depth == pytest.approx((weights @ (2, 3)) / weights.sum())
    assert point.position == pytest.approx((0, 0, point.depth))


@pytest.mark.parametrize("settings", [DrawSettings(levels=frozenset((0,))), DrawSettings(mode="view", view=0)])
def test_hidden_gaussians_are_not_picked(scene, settings):
    assert pick_point(scene, np.zeros(3), np.array((0.0, 0.0, 1.0)), settings).depth == pytest.approx(2)


def test_nothing_is_picked_behind_the_camera_beside_the_scene_or_too_near(scene):
    for direction in ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0)):
        assert pick_point(scene, np.zeros(3), np.array(direction), DrawSettings()) is None
    ahead = np.array((0.0, 0.0, 1.0))
    assert pick_point(scene, np.zeros(3), ahead, DrawSettings(near=5.0)) is None


def test_depths_are_those_of_the_image(random_scene):
    scene = random_scene(300, size=0.12)
    pose = torch.from_numpy(CAMERA.cam2world)
    image = rasterize(
        scene.gaussians, pose, size=SIZE[::-1], layout="pinhole", vertical_fov_degrees=70.0, backend="torch"
    )
    for row, column in ((10, 20), (30, 40), (50, 70), (25, 60)):
        ray = compute_pixel_ray(CAMERA, (column + 0.5, row + 0.5), SIZE)
        point = pick_point(scene, *ray, DrawSettings())
        assert point.depth == pytest.approx(float(image.depth[row, column]), rel=0.02)  # the image is filtered
