"""Surfaces that are smooth where parallax is large, and straight along straight lines."""

import math

import numpy as np
import pytest

from pansplat.sweep.panoramas import ray_grid
from pansplat.sweep.whole import find_segments, make_whole

_HEIGHT = 128
_RAYS = ray_grid(_HEIGHT).astype(np.float64)
_BLANK = np.full((_HEIGHT, 2 * _HEIGHT, 3), 0.4, np.float32)
_PIXEL = math.pi / _HEIGHT
_BAND = 0.05  # half the width of a bright band, radians
_NORMALS = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.7, 0.5, 0.0), (0.3, -0.8, 0.1)]  # of its plane


def _wall(distance: float) -> np.ndarray:
    """Inverse depth of a wall in front, and of a far sphere elsewhere."""
    return np.maximum(_RAYS[..., 2], 0.1) / distance


def _band(normal: np.ndarray) -> np.ndarray:
    """A photograph of a bright straight band, up to 45 degrees from its centre."""
    image = _BLANK.copy()
    image[(np.abs(_RAYS @ normal) < _BAND) & (_RAYS[..., 2] > math.cos(math.radians(45)))] = 0.9
    return image


def _unit(vector: tuple[float, float, float]) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


def test_jumps_of_a_near_surface_are_averaged_and_those_of_a_far_one_stay():
    noise = np.where(np.random.default_rng(1).random(_RAYS.shape[:2]) < 0.5, 0.9, 1.1)
    inside = slice(32, 96)  # rows with pixels of nearly equal sides
    near = make_whole(np.full_like(noise, 1.0) * noise, _BLANK, 2.0)
    # The mean of n independent values has 1 / sqrt(n) of their deviation; a Gaussian has n = 4 pi (sigma / pixel)^2.
    count = 4 * math.pi * (math.radians(3) / _PIXEL) ** 2
    assert near[inside].std() < 1.5 * noise.std() / math.sqrt(count)
    far = make_whole(0.01 * noise, _BLANK, 0.6)
    # A coupling of c couples four neighbours, which differ by 0.2 at most.
    coupling = (math.radians(1.5) * 0.6 * 0.011 / _PIXEL) ** 2
    np.testing.assert_allclose(far[inside], (0.01 * noise)[inside], rtol=4 * 0.25 * 2 * coupling + 1e-6)


def test_a_plane_stays():
    wall = _wall(1.0)
    whole = make_whole(wall, _BLANK, 2.0)
    inside = _RAYS[..., 2] > 0.5  # more than three deviations of 4 degrees from the wall's end
    # The average of a plane over a Gaussian of s radians has exp(-s^2) of its inverse depth, and s changes along it.
    np.testing.assert_allclose(whole[inside], wall[inside], rtol=4 * math.radians(3) ** 2)


@pytest.mark.parametrize("normal", _NORMALS)
def test_a_wavy_surface_is_straight_along_a_straight_line_of_any_direction(normal):
    normal = _unit(normal)
    along = np.cross(normal, (0.0, 0.0, 1.0))
    wave = 0.05 * np.sin(12 * np.arctan2(_RAYS @ along, _RAYS[..., 2]))
    wavy = _wall(2.0) * np.exp(wave)
    whole = make_whole(wavy, _band(normal), 0.0)
    edge = (np.abs(np.abs(_RAYS @ normal) - _BAND) < _PIXEL) & (_RAYS[..., 2] > math.cos(math.radians(35)))
    rest = np.log(whole / _wall(2.0))[edge]
    assert rest.std() < 0.4 * wave[edge].std()
    beyond = np.abs(_RAYS @ normal) > 0.3
    np.testing.assert_allclose(whole[beyond], wavy[beyond], rtol=1e-3)


@pytest.mark.parametrize("normal", _NORMALS)
def test_segments_lie_along_the_straight_lines_of_a_photograph(normal):
    normal = _unit(normal)
    segments = find_segments(_band(normal))
    lengths = np.arccos((segments[:, 0] * segments[:, 1]).sum(axis=1))
    long = segments[lengths > math.radians(30)]
    assert len(long) >= 2
    assert (np.abs(np.abs(long @ normal) - math.sin(_BAND)) < 1.5 * _PIXEL).all()
    np.testing.assert_allclose(np.linalg.norm(segments, axis=-1), 1, atol=1e-9)


def test_without_parallax_and_lines_nothing_changes():
    surface = 1 + np.random.default_rng(2).random((_HEIGHT, 2 * _HEIGHT))
    assert find_segments(_BLANK).shape == (0, 2, 3)
    np.testing.assert_allclose(make_whole(surface, _BLANK, 0.0), surface, rtol=1e-6)
