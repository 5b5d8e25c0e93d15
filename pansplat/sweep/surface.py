"""The views' surfaces: consistency between views, upsampling, and panoramas as numpy arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np
import torch

from pansplat.geometry.equirect import pixel_directions, uv_from_directions
from pansplat.threads import limit_numba_threads


def ray_grid(height: int) -> np.ndarray:
    """Unit rays (height, 2 height, 3), float32, of a panorama's pixels."""
    return pixel_directions(height, 2 * height).numpy()


def pixel_coordinates(directions: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Continuous x and y of directions (..., 3) of any length in a panorama; pixel centres at half-integers."""
    uv = uv_from_directions(torch.from_numpy(np.ascontiguousarray(directions))).numpy()
    return uv[..., 0] * 2 * height, uv[..., 1] * height


def nearest_pixel(directions: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the pixel that holds each direction (..., 3)."""
    x, y = pixel_coordinates(directions, height)
    return np.clip(y.astype(np.int64), 0, height - 1), x.astype(np.int64) % (2 * height)


def pad_sphere(image: np.ndarray, margin: int) -> np.ndarray:
    """A panorama (h, w) or (h, w, c) padded by its neighbours on the sphere."""
    over = np.roll(image, image.shape[1] // 2, axis=1)
    rows = np.concatenate((over[:margin][::-1], image, over[-margin:][::-1]))
    return np.ascontiguousarray(np.concatenate((rows[:, -margin:], rows, rows[:, :margin]), axis=1))


def resize_sphere(image: np.ndarray, height: int) -> np.ndarray:
    """A panorama (h, w) or (h, w, c) at another height: area average when smaller, bilinear when larger."""
    if image.shape[0] == height:
        return np.ascontiguousarray(image)
    if image.shape[0] > height:
        return cv2.resize(image, (2 * height, height), interpolation=cv2.INTER_AREA)
    # The smallest margin that has whole pixels at both sizes: values continue over the seam and the poles.
    common = math.gcd(image.shape[0], height)
    margin, scaled = image.shape[0] // common, height // common
    size = 2 * (height + scaled), height + 2 * scaled
    large = cv2.resize(pad_sphere(image, margin), size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(large[scaled:-scaled, scaled:-scaled])


def resize_nearest(values: np.ndarray, height: int) -> np.ndarray:
    """A panorama (h, w) at another height: the nearest pixel when smaller, so that edges stay, bilinear when larger."""
    if height >= len(values):
        return resize_sphere(values, height)
    return cv2.resize(values, (2 * height, height), interpolation=cv2.INTER_NEAREST_EXACT)


def resize_mask(mask: np.ndarray, height: int) -> np.ndarray:
    """A panorama (h, w) of bool at another height, by the nearest pixel."""
    return cv2.resize(mask.astype(np.uint8), (2 * height, height), interpolation=cv2.INTER_NEAREST) > 0


_SMOOTH = 0.03  # largest relative change of inverse depth that is interpolated bilinearly

CONSISTENT, OCCLUDED, FREE_SPACE = 0, 1, 2  # on, behind, or in front of another view's surface


@dataclass(frozen=True, eq=False)
class Surface:
    """One view's surface.

    Attributes:
        inverse_depth: (h, w) inverse radial depth, 1/m.
        orientation: (h, w) 0 for a sphere around the camera; 1, 2, 3 for a plane across that axis of the scene.
    """

    inverse_depth: np.ndarray
    orientation: np.ndarray

    @property
    def height(self) -> int:
        return self.inverse_depth.shape[0]


def classify_visibility(points: np.ndarray, surface: Surface, cam2world: np.ndarray, tolerance: float) -> np.ndarray:
    """Class (uint8) of world points (..., 3): CONSISTENT with a view's surface, OCCLUDED by it, or in FREE_SPACE."""
    local = (points - cam2world[:3, 3]) @ cam2world[:3, :3]
    distance = np.maximum(np.linalg.norm(local, axis=-1), 1e-9)
    row, column = nearest_pixel(local, surface.height)
    ratio = 1 / (distance * surface.inverse_depth[row, column])
    result = np.full(ratio.shape, OCCLUDED, np.uint8)
    result[ratio > 1 - tolerance] = CONSISTENT
    result[ratio > 1 + tolerance] = FREE_SPACE
    return result


def world_points(surface: Surface, cam2world: np.ndarray) -> np.ndarray:
    """World points (h, w, 3) of the surface."""
    local = ray_grid(surface.height) / surface.inverse_depth[..., None]
    return local @ cam2world[:3, :3].T + cam2world[:3, 3]


def measure_distances(cam2world: np.ndarray) -> np.ndarray:
    """Distances (v, v) between the cameras of poses (v, 4, 4)."""
    centres = cam2world[:, :3, 3]
    return np.linalg.norm(centres[:, None] - centres[None], axis=-1)


def list_others(count: int) -> list[list[int]]:
    """The other views of each of some views."""
    return [[other for other in range(count) if other != view] for view in range(count)]


def list_best_pairs(neighbours: Sequence[Sequence[int]]) -> list[tuple[int, int]]:
    """Each view and its best neighbour, the smaller number first."""
    return [(min(view, others[0]), max(view, others[0])) for view, others in enumerate(neighbours)]


def consistency_mask(
    surfaces: Sequence[Surface], cam2world: np.ndarray, view: int, others: Sequence[int], tolerance: float = 0.06
) -> np.ndarray:
    """Pixels (h, w) of a view whose surface is consistent with the surface of at least one of the other views."""
    points = world_points(surfaces[view], cam2world[view])
    consistent = np.zeros(points.shape[:2], bool)
    for other in others:
        consistent |= classify_visibility(points, surfaces[other], cam2world[other], tolerance) == CONSISTENT
    return consistent


def guided_upsample(
    surface: Surface, coarse: np.ndarray, fine: np.ndarray, needed: np.ndarray | None = None
) -> Surface:
    """The surface at the size of `fine`.

    Smooth parts are interpolated bilinearly. At a depth discontinuity a pixel takes the weighted median of its
    neighbourhood, with weights by colour similarity (joint bilateral upsampling).

    Args:
        coarse, fine: the view's image (h, w, 3) at the surface's size and at the new size.
        needed: pixels (h, w) of the new size that are computed; the others are 0. All by default.
    """
    if needed is None:
        needed = np.ones(fine.shape[:2], bool)
    limit_numba_threads()
    return Surface(*_upsample(surface.inverse_depth, surface.orientation, coarse, fine, needed))


@nb.njit(parallel=True, fastmath=True, cache=True)
def _upsample(inverse, orientation, coarse, fine, needed):
    h, w = inverse.shape
    height, width = fine.shape[:2]
    result = np.zeros((height, width), np.float32)
    orientations = np.zeros((height, width), np.uint8)
    for i in nb.prange(height):
        values, weights = np.empty(25, np.float32), np.empty(25, np.float32)
        kinds = np.empty(25, np.uint8)
        y = (i + 0.5) * h / height - 0.5
        for j in range(width):
            if not needed[i, j]:
                continue
            x = (j + 0.5) * w / width - 0.5
            cy, cx = int(math.floor(y + 0.5)), int(math.floor(x + 0.5))
            lowest, highest = np.inf, 0.0
            for di in range(-2, 3):
                for dj in range(-2, 3):
                    value = inverse[min(max(cy + di, 0), h - 1), (cx + dj) % w]
                    lowest, highest = min(lowest, value), max(highest, value)
            y0, x0 = int(math.floor(y)), int(math.floor(x))
            fy, fx = y - y0, x - x0
            r0, r1 = min(max(y0, 0), h - 1), min(max(y0 + 1, 0), h - 1)
            c0, c1 = x0 % w, (x0 + 1) % w
            smooth = (inverse[r0, c0] * (1 - fx) + inverse[r0, c1] * fx) * (1 - fy)
            smooth += (inverse[r1, c0] * (1 - fx) + inverse[r1, c1] * fx) * fy
            if highest < (1 + _SMOOTH) * lowest:  # the median is close to the smooth value
                result[i, j], orientations[i, j] = smooth, orientation[min(max(cy, 0), h - 1), cx % w]
                continue
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
                    values[n], kinds[n] = inverse[r, c], orientation[r, c]
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
            close = abs(smooth / values[median] - 1) < _SMOOTH
            result[i, j] = smooth if close else values[median]
            orientations[i, j] = kinds[median]
    return result, orientations
