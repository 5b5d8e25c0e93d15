"""Surfaces seen by the views, and what one view's surface says about another's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np

from pansplat.sweep.sphere import nearest_pixel, ray_grid

AGREES, HIDDEN, SEEN_THROUGH = 0, 1, 2  # what another view says about a point


@dataclass(frozen=True, eq=False)
class Surface:
    """One view's surface: inverse radial depth (h, w) in 1/m, and the family (h, w) of hypotheses that won.

    Family 0 are spheres; 1, 2, 3 are planes across the scene's axes.
    """

    inverse_depth: np.ndarray
    family: np.ndarray

    @property
    def height(self) -> int:
        return self.inverse_depth.shape[0]


def relation(
    points: np.ndarray, surface: Surface, cam2world: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """What a view says about world points (..., 3): AGREES, HIDDEN behind its surface, or SEEN_THROUGH (in front).

    Returns the relation (uint8) and the ratio of the point's inverse depth to the surface's there.
    """
    local = (points - cam2world[:3, 3]) @ cam2world[:3, :3]
    distance = np.maximum(np.linalg.norm(local, axis=-1), 1e-9)
    row, column = nearest_pixel(local, surface.height)
    ratio = 1 / (distance * surface.inverse_depth[row, column])
    result = np.full(ratio.shape, HIDDEN, np.uint8)
    result[ratio > 1 - tolerance] = AGREES
    result[ratio > 1 + tolerance] = SEEN_THROUGH
    return result, ratio


def world_points(surface: Surface, cam2world: np.ndarray) -> np.ndarray:
    """The surface's points (h, w, 3) in the world."""
    local = ray_grid(surface.height) / surface.inverse_depth[..., None]
    return local @ cam2world[:3, :3].T + cam2world[:3, 3]


def agreement(surfaces: Sequence[Surface], cam2world: np.ndarray, view: int, tolerance: float = 0.06) -> np.ndarray:
    """Pixels (h, w) of a view whose surface at least one other view's surface agrees with."""
    points = world_points(surfaces[view], cam2world[view])
    agreed = np.zeros(points.shape[:2], bool)
    for other, surface in enumerate(surfaces):
        if other != view:
            agreed |= relation(points, surface, cam2world[other], tolerance)[0] == AGREES
    return agreed


def guided_upsample(surface: Surface, coarse: np.ndarray, fine: np.ndarray) -> Surface:
    """The surface at the size of `fine`: interpolated where smooth, and at its jumps on the side that looks alike.

    Args:
        coarse, fine: the view's picture (h, w, 3) at the surface's size and at the new size.
    """
    inverse, family = _upsample(surface.inverse_depth, surface.family, coarse, fine)
    return Surface(inverse, family)


@nb.njit(parallel=True, fastmath=True, cache=True)
def _upsample(inverse, family, coarse, fine):
    h, w = inverse.shape
    height, width = fine.shape[:2]
    result = np.empty((height, width), np.float32)
    families = np.empty((height, width), np.uint8)
    for i in nb.prange(height):
        values, weights = np.empty(25, np.float32), np.empty(25, np.float32)
        kinds = np.empty(25, np.uint8)
        y = (i + 0.5) * h / height - 0.5
        for j in range(width):
            x = (j + 0.5) * w / width - 0.5
            cy, cx = int(math.floor(y + 0.5)), int(math.floor(x + 0.5))
            n = 0
            total = 0.0
            for di in range(-2, 3):
                for dj in range(-2, 3):
                    r = min(max(cy + di, 0), h - 1)
                    c = (cx + dj) % w
                    d = 0.0
                    for q in range(3):
                        d += abs(fine[i, j, q] - coarse[r, c, q])
                    near = (cy + di - y) ** 2 + (cx + dj - x) ** 2
                    values[n], kinds[n] = inverse[r, c], family[r, c]
                    weights[n] = math.exp(-d / 0.1 - near / 2.0) + 1e-12
                    total += weights[n]
                    n += 1
            order = np.argsort(values)
            below = 0.0
            median = order[24]
            for m in range(25):
                below += weights[order[m]]
                if below >= 0.5 * total:
                    median = order[m]
                    break
            y0, x0 = int(math.floor(y)), int(math.floor(x))
            fy, fx = y - y0, x - x0
            r0, r1 = min(max(y0, 0), h - 1), min(max(y0 + 1, 0), h - 1)
            c0, c1 = x0 % w, (x0 + 1) % w
            smooth = (inverse[r0, c0] * (1 - fx) + inverse[r0, c1] * fx) * (1 - fy)
            smooth += (inverse[r1, c0] * (1 - fx) + inverse[r1, c1] * fx) * fy
            close = abs(smooth / values[median] - 1) < 0.03
            result[i, j] = smooth if close else values[median]
            families[i, j] = kinds[median]
    return result, families
