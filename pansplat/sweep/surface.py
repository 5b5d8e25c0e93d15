"""The views' surfaces: consistency between views, and upsampling."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from pansplat.sweep.panoramas import for_point_ranges, locate_pixel, ray_grid, resize_mask, resize_sphere
from pansplat.system.kernels import cached_njit, parallel_for, thread_count

CONSISTENT, OCCLUDED, FREE_SPACE = 0, 1, 2  # on, behind, or in front of another view's surface
_MAX_SMOOTH_CHANGE = 0.03  # largest relative change of inverse depth that is interpolated bilinearly
_MAX_INCONSISTENCY = 0.06  # largest relative difference of depth of two views' surfaces that are consistent


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that a view shows: inverse radial depth (h, w) in each direction, 1/m."""

    inverse_depth: np.ndarray

    @property
    def height(self) -> int:
        return self.inverse_depth.shape[0]


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Input of the sweep: images (v, h, w, 3) float32, poses (v, 4, 4), masks (v, h, w) bool, depth range."""

    images: np.ndarray
    cam2world: np.ndarray
    masks: np.ndarray
    near: float
    far: float

    def relative_pose(self, view: int, other: int) -> np.ndarray:
        """Pose (4, 4) from `view`'s camera to `other`'s."""
        return np.linalg.inv(self.cam2world[other]) @ self.cam2world[view]

    def resize(self, height: int) -> PosedImages:
        """The input at another height."""
        if self.images.shape[1] == height:
            return self
        images = np.stack([resize_sphere(image, height) for image in self.images])
        return dataclasses.replace(self, images=images, masks=np.stack([resize_mask(m, height) for m in self.masks]))

    def measure_baseline(self, views: Sequence[int]) -> float:
        """Largest distance between two cameras of some views, metres."""
        return float(measure_distances(self.cam2world[list(views)]).max())


def classify_visibility(
    points: np.ndarray, surface: Surface, cam2world: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Classes (uint8) of world points (..., 3), distances from the camera, and rows and columns of their pixels.

    A point is CONSISTENT with a view's surface, OCCLUDED by it, or in FREE_SPACE.
    """
    flat = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    found = np.empty(len(flat), np.uint8), np.empty(len(flat)), np.empty((2, len(flat)), np.int32)
    pose = np.ascontiguousarray(cam2world, np.float64)
    for_point_ranges(partial(_classify_points, flat, surface.inverse_depth, pose, tolerance, *found), len(flat))
    classes, distances, row, column = (each.reshape(points.shape[:-1]) for each in (*found[:2], *found[2]))
    return classes, distances, (row, column)


@cached_njit(nogil=True)
def _classify_points(points, inverse_depth, cam2world, tolerance, classes, distances, pixels, first, end):
    for n in range(first, end):
        point = points[n]
        x, y, z = point[0] - cam2world[0, 3], point[1] - cam2world[1, 3], point[2] - cam2world[2, 3]
        right = x * cam2world[0, 0] + y * cam2world[1, 0] + z * cam2world[2, 0]
        down = x * cam2world[0, 1] + y * cam2world[1, 1] + z * cam2world[2, 1]
        ahead = x * cam2world[0, 2] + y * cam2world[1, 2] + z * cam2world[2, 2]
        distance = max(math.sqrt(x * x + y * y + z * z), 1e-9)
        row, column = locate_pixel(right, down, ahead, len(inverse_depth))
        ratio = 1 / (distance * inverse_depth[row, column])
        kind = CONSISTENT if ratio > 1 - tolerance else OCCLUDED
        classes[n] = FREE_SPACE if ratio > 1 + tolerance else kind
        distances[n], pixels[0, n], pixels[1, n] = distance, row, column


def world_points(surface: Surface, cam2world: np.ndarray) -> np.ndarray:
    """World points (h, w, 3) of the surface."""
    local = ray_grid(surface.height) / surface.inverse_depth[..., None]
    return local @ cam2world[:3, :3].T + cam2world[:3, 3]


def measure_distances(cam2world: np.ndarray) -> np.ndarray:
    """Distances (v, v) between the cameras of poses (v, 4, 4)."""
    centres = cam2world[:, :3, 3]
    return np.linalg.norm(centres[:, None] - centres[None], axis=-1)


def list_best_pairs(neighbours: Sequence[Sequence[int]]) -> list[tuple[int, int]]:
    """Each view and its best neighbour, the smaller number first."""
    return [(min(view, others[0]), max(view, others[0])) for view, others in enumerate(neighbours)]


def consistency_mask(
    surfaces: Sequence[Surface], cam2world: np.ndarray, view: int, others: Sequence[int]
) -> np.ndarray:
    """Pixels (h, w) of a view whose surface is consistent with the surface of at least one of the other views."""
    points = world_points(surfaces[view], cam2world[view])
    consistent = np.zeros(points.shape[:2], bool)
    for other in others:
        classes, _, _ = classify_visibility(points, surfaces[other], cam2world[other], _MAX_INCONSISTENCY)
        consistent |= classes == CONSISTENT
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
    inverse, window = surface.inverse_depth, np.ones((5, 5), np.uint8)
    # Columns wrap; the rows beyond a pole, where the filters have no values, do not count.
    wrapped = np.concatenate((inverse[:, -2:], inverse, inverse[:, :2]), axis=1)
    lowest, highest = cv2.erode(wrapped, window)[:, 2:-2], cv2.dilate(wrapped, window)[:, 2:-2]
    smooth = highest < (1 + _MAX_SMOOTH_CHANGE) * lowest
    result = np.zeros(needed.shape, np.float32)
    work = partial(_upsample, inverse, smooth, coarse, fine, needed, result)
    parallel_for(work, len(needed), thread_count())
    return Surface(result)


@cached_njit(nogil=True, fastmath=True)
def _upsample(inverse, is_smooth, coarse, fine, needed, result, i):
    h, w = inverse.shape
    height, width = fine.shape[:2]
    values, weights = np.empty(25, np.float32), np.empty(25, np.float32)
    y = (i + 0.5) * h / height - 0.5
    for j in range(width):
        if not needed[i, j]:
            continue
        x = (j + 0.5) * w / width - 0.5
        cy, cx = int(math.floor(y + 0.5)), int(math.floor(x + 0.5))
        y0, x0 = int(math.floor(y)), int(math.floor(x))
        fy, fx = y - y0, x - x0
        r0, r1 = min(max(y0, 0), h - 1), min(max(y0 + 1, 0), h - 1)
        c0, c1 = x0 % w, (x0 + 1) % w
        smooth = (inverse[r0, c0] * (1 - fx) + inverse[r0, c1] * fx) * (1 - fy)
        smooth += (inverse[r1, c0] * (1 - fx) + inverse[r1, c1] * fx) * fy
        r, c = min(max(cy, 0), h - 1), cx % w
        if is_smooth[r, c]:  # the median is close to the smooth value
            result[i, j] = smooth
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
                value, weight = inverse[r, c], math.exp(-d / 0.1 - near / 2.0) + 1e-12
                total += weight
                at = n
                while at > 0 and values[at - 1] > value:
                    values[at], weights[at] = values[at - 1], weights[at - 1]
                    at -= 1
                values[at], weights[at] = value, weight
                n += 1
        below, median = weights[0], 0
        while below < 0.5 * total and median < 24:
            median += 1
            below += weights[median]
        close = abs(smooth / values[median] - 1) < _MAX_SMOOTH_CHANGE
        result[i, j] = smooth if close else values[median]
