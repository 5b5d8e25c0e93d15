"""Surfaces: consistency between views, and upsampling."""

import numpy as np
import pytest
import torch

from pansplat.geometry.equirect import uv_from_directions
from pansplat.sweep.panoramas import nearest_pixel, ray_grid, resize_sphere
from pansplat.sweep.surface import (
    CONSISTENT,
    FREE_SPACE,
    OCCLUDED,
    Surface,
    classify_visibility,
    consistency_mask,
    guided_upsample,
)


def _surface(inverse: np.ndarray) -> Surface:
    return Surface(inverse.astype(np.float32))


def _sphere(radius: float, height: int = 32) -> Surface:
    return _surface(np.full((height, 2 * height), 1 / radius))


def test_points_in_front_of_on_and_behind_a_surface_are_classified(turn):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn("y", 50) @ turn("x", 20), (3, -1, 2)
    directions = ray_grid(8).reshape(-1, 3).astype(np.float64)
    classes = {FREE_SPACE: (1.0, 1.88), CONSISTENT: (1.89, 2.0, 2.12), OCCLUDED: (2.13, 4.0)}  # 6 % about 2 m
    for expected, distances in classes.items():
        for distance in distances:
            points = pose[:3, 3] + distance * directions
            assert (classify_visibility(points, _sphere(2.0), pose, 0.06)[0] == expected).all()
    assert classify_visibility(pose[None, :3, 3], _sphere(2.0), pose, 0.06)[0].tolist() == [FREE_SPACE]  # the camera


def test_exact_surfaces_are_inconsistent_only_at_occlusions(empty_room, furnished_room, view):
    empty, furnished = (
        consistency_mask(room.make_exact_surfaces(), room.posed.cam2world, view, [1 - view])
        for room in (empty_room, furnished_room)
    )
    assert empty.mean() > 0.995 > furnished.mean() > 0.85
    surfaces, poses = furnished_room.make_exact_surfaces()[::-1], furnished_room.posed.cam2world[::-1]
    assert np.array_equal(furnished, consistency_mask(surfaces, poses, 1 - view, [view]))  # in any order of the views


@pytest.mark.parametrize("height", (64, 48, 36, 24, 8))
def test_resizing_wraps_around_and_continues_over_the_poles(height):
    """32 rows to others; the panorama is turned by an eighth."""
    image = np.random.default_rng(0).random((32, 64, 3)).astype(np.float32)
    large = resize_sphere(image, height)
    assert large.shape == (height, 2 * height, 3)
    turned = resize_sphere(np.roll(image, 8, axis=1), height)
    assert np.allclose(turned, np.roll(large, height // 4, axis=1), atol=1e-6)
    row = 0.5 * 32 / height  # of the first pixel centre, in pixels of the image: between both sides of the pole
    if height > 32:
        opposite = np.roll(image[0], 32, axis=0)
        pole = (0.5 + row) * image[0] + (0.5 - row) * opposite
        assert np.allclose(large[0], resize_sphere(np.repeat(pole[None], 32, axis=0), height)[height // 2], atol=1e-6)


@pytest.mark.parametrize("edge", (96, 101))
def test_a_discontinuity_stays_sharp_along_an_image_edge(edge):
    """At 101 the edge lies within a coarse pixel."""
    fine = np.full((96, 192, 3), 0.2, np.float32)
    fine[:, edge:] = 0.8
    inverse = np.full((48, 96), 1.0)
    inverse[:, (edge + 1) // 2 :] = 0.4
    large = guided_upsample(_surface(inverse), resize_sphere(fine, 48), fine).inverse_depth
    assert np.array_equal(large, np.where(np.arange(192) < edge, 1.0, 0.4).astype(np.float32) * np.ones((96, 1)))


def test_the_pixel_of_a_direction_is_that_of_its_panorama_coordinates():
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions[:4] = ((0, 1, 0), (0, -1, 0), (0, 0, -1), (1e-9, 0, -1))  # the poles and the seam
    height = 48
    u, v = uv_from_directions(torch.from_numpy(directions)).numpy().T
    row, column = nearest_pixel(directions, height)
    assert np.array_equal(row, np.minimum((v * height).astype(int), height - 1))
    assert np.array_equal(column, (u * 2 * height).astype(int) % (2 * height))
