"""The point under the pointer: its ray and its depth."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pansplat.rendering import rasterize
from pansplat_viewer.core.camera import Camera, turn
from pansplat_viewer.core.picking import compute_pixel_ray, pick_point, project_point
from pansplat_viewer.core.settings import DrawSettings

SIZE = (80, 60)
CAMERA = replace(turn(Camera(), 0.4, 0.2), position=(0.3, -0.2, 0.1), vertical_fov_degrees=70.0)


def test_rays_and_projection_are_inverse():
    for pixel in ((0.0, 0.0), (79.5, 3.5), (40.0, 30.0)):
        origin, direction = compute_pixel_ray(CAMERA, pixel, SIZE)
        assert project_point(CAMERA, tuple(origin + 2.5 * direction), SIZE) == pytest.approx(pixel)
        assert math.isclose(np.linalg.norm(direction), 1.0)
    origin, direction = compute_pixel_ray(CAMERA, (40.0, 30.0), SIZE)
    assert np.allclose(direction, CAMERA.rotation[:, 2]), "the middle of the image is ahead"
    assert project_point(CAMERA, tuple(origin - direction), SIZE) is None


@pytest.mark.gl
@pytest.mark.parametrize("name", ["gl", "cpu"])
def test_a_point_is_where_the_image_shows_it_and_nothing_where_that_is_empty(make_renderer, random_scene, name):
    scene, pose = random_scene(300, size=0.12), torch.from_numpy(CAMERA.cam2world)
    image = rasterize(scene.gaussians, pose, size=SIZE[::-1], layout="pinhole", vertical_fov_degrees=70.0)
    renderer = make_renderer(scene, name)
    for row, column in ((10, 20), (30, 40), (50, 70), (25, 60)):
        origin, direction = compute_pixel_ray(CAMERA, (column + 0.5, row + 0.5), SIZE)
        point = pick_point(renderer, origin, direction, DrawSettings())
        assert point.depth == pytest.approx(float(image.depth[row, column]), rel=0.03)  # the image is filtered
        assert np.linalg.norm(point.position - origin) == pytest.approx(point.depth)
    for settings in (DrawSettings(near=50.0), DrawSettings(levels=frozenset())):
        assert pick_point(renderer, origin, direction, settings) is None
