"""Vertical edges of surfaces."""

import math

import numpy as np
import pytest

from pansplat.sweep.straighten import straighten
from pansplat.sweep.surface import rotate_image

_HEIGHT = 128
_DOWN = np.array((0.0, 1.0, 0.0))
_LATITUDE = ((np.arange(_HEIGHT) + 0.5) / _HEIGHT - 0.5)[:, None] * math.pi
_BAR = slice(100, 104)  # columns of a bright bar before a grey wall
_BESIDE = (slice(44, 84), slice(98, 106))  # what is straightened, without the ends of the bar


def _photograph(rows: slice = slice(30, 98)) -> np.ndarray:
    image = np.full((_HEIGHT, 2 * _HEIGHT, 3), 0.4, np.float32)
    image[rows, _BAR] = 0.9
    return image


def _wall(distance: float = 2.0) -> np.ndarray:
    """Log-depth of a vertical surface all around."""
    return np.broadcast_to(np.log(distance / np.cos(_LATITUDE)), (_HEIGHT, 2 * _HEIGHT)).copy()


def _wave() -> np.ndarray:
    return 0.03 * np.sin(np.arange(_HEIGHT) * 0.9)[:, None] * np.ones((1, 2 * _HEIGHT))


def test_waves_beside_a_vertical_edge_are_smoothed_and_all_else_stays():
    wavy = _wall() + _wave()
    found = straighten(wavy, _photograph(), _DOWN)
    assert np.abs(found - _wall())[_BESIDE].max() < 0.2 * np.abs(_wave()).max()
    away = np.ones(wavy.shape, bool)
    away[:, 94:110] = False
    np.testing.assert_array_equal(found[away], wavy[away].astype(np.float32))


def test_jumps_of_depth_along_an_edge_stay():
    near_below = np.where(_LATITUDE > 0, _wall(1.0), _wall(2.0))
    found = straighten(near_below, _photograph(), _DOWN)
    np.testing.assert_allclose(found, near_below, atol=0.01)


def test_lines_on_a_floor_change_no_depth():
    """Boards that lead away from the camera are columns of the panorama, too, but the floor is not vertical."""
    down = np.maximum(np.sin(_LATITUDE), 1e-3)
    floor = np.log(np.minimum(1.5 / down, 8.0)) * np.ones((1, 2 * _HEIGHT))
    rows = slice(84, 120)  # of the floor
    found = straighten(floor, _photograph(rows), _DOWN)
    np.testing.assert_allclose(found[rows], floor[rows], atol=0.02)


@pytest.mark.parametrize("degrees", (5, 40))
def test_a_tilted_camera_has_the_same_edges(turn, degrees):
    """The panorama of the tilted camera, straightened and turned back, is the upright one, but for interpolation."""
    tilt = turn("x", degrees) @ turn("z", degrees / 2)
    wavy = _wall() + _wave()
    tilted = rotate_image(np.concatenate((wavy[..., None], _photograph()), axis=-1), tilt)
    found = straighten(tilted[..., 0], tilted[..., 1:].astype(np.float32), tilt.T @ _DOWN)
    back = rotate_image(found[..., None], tilt.T)[..., 0]
    assert np.median(np.abs(back - _wall())[_BESIDE]) < 0.3 * np.median(np.abs(_wave()))
