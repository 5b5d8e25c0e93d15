"""Smoothing of panoramas, which does not cross where neighbouring pixels are not coupled.

Source: the fast global smoother of Min et al., IEEE Transactions on Image Processing 23(12), 2014, with rows and
meridians as closed lines, so that it has neither seam nor pole.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from pansplat.geometry.equirect import row_weights
from pansplat.rendering.cpu.runtime import cached_njit, parallel_for, thread_count

_PASSES = 2  # solutions over all rows, then over all meridians
_MAX_ROW_COUPLING = 1e3  # largest factor of the couplings of a row, whose pixels are close to each other at the poles


def as_meridians(maps: np.ndarray) -> np.ndarray:
    """Panoramas (..., h, 2h) as closed lines (..., h, 2h): down a meridian, and up the opposite one."""
    half = maps.shape[-1] // 2
    lines = np.concatenate((maps[..., :half], maps[..., ::-1, half:]), axis=-2)
    return np.ascontiguousarray(np.swapaxes(lines, -1, -2))


def _from_meridians(lines: np.ndarray) -> np.ndarray:
    """The panoramas of `as_meridians`."""
    maps, half = np.swapaxes(lines, -1, -2), lines.shape[-2]
    return np.ascontiguousarray(np.concatenate((maps[..., :half, :], maps[..., : half - 1 : -1, :]), axis=-1))


def smooth_sphere(maps: np.ndarray, rows: np.ndarray, meridians: np.ndarray, smoothness: float) -> np.ndarray:
    """Panoramas (2, h, w), smoothed by alternate one-dimensional smoothings of falling strength.

    Args:
        rows, meridians: coupling (h, w) of each pixel with the next one of its row, as at the equator, and of its
            meridian, as `as_meridians` has them.
        smoothness: square of the length over which pixels of full coupling are averaged, pixels.
    """
    rows = rows * np.minimum(1 / row_weights(len(rows)).numpy()[:, None] ** 2, _MAX_ROW_COUPLING)
    for number in range(_PASSES):
        strength = 1.5 * 4.0 ** (_PASSES - 1 - number) / (4.0**_PASSES - 1) * smoothness
        _smooth_lines(maps, rows, strength)
        maps = as_meridians(maps)
        _smooth_lines(maps, meridians, strength)
        maps = _from_meridians(maps)
    return maps


def _smooth_lines(maps: np.ndarray, couplings: np.ndarray, strength: float) -> None:
    """Smooth closed lines in place, along the last axis of both maps (2, lines, length).

    Args:
        couplings: (lines, length) of each value with the next one of its line.
        strength: square of the length over which values of full coupling are averaged.
    """
    parallel_for(partial(_smooth_line, maps, couplings, strength), len(couplings), thread_count())


@cached_njit(nogil=True, fastmath=True, error_model="numpy")
def _smooth_line(maps, couplings, strength, line):
    """Smooth line `line` of both maps (2, n, length) in place.

    It solves (1 + strength * L) x = b for the Laplacian L of a closed line: a tridiagonal system with two corners, by
    the Sherman-Morrison formula.
    """
    coupling, length = couplings[line], couplings.shape[1]
    upper, turn = np.empty(length), np.empty(length)
    first, second = maps[0, line], maps[1, line]
    corner = -strength * coupling[length - 1]
    gamma = -(1 + strength * (coupling[length - 1] + coupling[0]))
    inverse = -0.5 / gamma  # 1 / the first pivot, which is -2 gamma
    upper[0], turn[0] = -strength * coupling[0] * inverse, -0.5
    first[0] *= inverse
    second[0] *= inverse
    for k in range(1, length):
        lower = -strength * coupling[k - 1]
        diagonal = 1 + strength * (coupling[k - 1] + coupling[k])
        last = 0.0
        if k == length - 1:
            diagonal -= corner * corner / gamma
            last = corner
        inverse = 1 / (diagonal - lower * upper[k - 1])
        upper[k] = -strength * coupling[k] * inverse
        first[k] = (first[k] - lower * first[k - 1]) * inverse
        second[k] = (second[k] - lower * second[k - 1]) * inverse
        turn[k] = (last - lower * turn[k - 1]) * inverse
    for k in range(length - 2, -1, -1):
        first[k] -= upper[k] * first[k + 1]
        second[k] -= upper[k] * second[k + 1]
        turn[k] -= upper[k] * turn[k + 1]
    ratio = corner / gamma
    scale = 1 + turn[0] + ratio * turn[length - 1]
    one, two = (first[0] + ratio * first[length - 1]) / scale, (second[0] + ratio * second[length - 1]) / scale
    for k in range(length):
        first[k] -= one * turn[k]
        second[k] -= two * turn[k]
