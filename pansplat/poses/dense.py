"""Comparison of all that two panoramas show under a relative pose, by the estimated depth of each.

Surfaces of one panorama are drawn into the other one. Under the right pose they are where the other panorama sees a
surface, or behind it; none is in front of it, where the other camera sees through; and what both see looks alike.
Doors and windows that repeat in other rooms fail here.

Source: the bird's-eye check of SALVe, https://arxiv.org/abs/2406.19390, with depth in place of its floor textures.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.poses.depth import DepthMap, sample_nearest

_HEIGHT = 96  # rows of the maps that are compared
_COARSE = 4  # of many poses, every fourth row and column are compared
_BLUR, _REGION = 0.5, 6.0  # standard deviations of the compared detail and of its surroundings, pixels
_LEAST_CONTRAST = 0.03  # grey values of 1
_TOLERANCE = 0.12  # of log-depth, beside the deviations of both estimates
_CONFLICT = 0.25  # least log-depth that a surface in front of another one has against it
_CERTAIN = 0.3  # largest sum of the deviations at a conflict
_NEAREST = 0.25  # camera heights
_LEAST_COMMON = 0.002  # of the sphere


@dataclass(frozen=True)
class Comparison:
    """How well two panoramas fit under a pose; means of both directions.

    Attributes:
        overlap: share of the sphere whose surface the other panorama sees at its place.
        conflict: share of the sphere whose surface is where the other panorama sees through.
        likeness: correlation of the detail of what both see, against its surroundings.
        shade: correlation of the logarithm of its grey values.
    """

    overlap: float
    conflict: float
    likeness: float
    shade: float


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is compared of a panorama.

    Attributes:
        grey: in [0, 1], as the camera took it.
        depth: of the same panorama.
    """

    grey: Float[Array, "h 2*h"]
    depth: DepthMap

    def mirrored(self) -> Surroundings:
        """Those of the panorama that is mirrored left to right."""
        return Surroundings(self.grey[:, ::-1], self.depth.mirrored())

    @functools.cached_property
    def maps(self) -> Float[Array, "h 2*h 4"]:
        """Log-depth, its deviation, detail against its surroundings, and the logarithm of the grey value.

        They are those of the upright camera; depths are in camera heights.
        """
        rays = _upright_rays().reshape(-1, 3).astype(np.float64) @ self.depth.rotation.T
        small = cv2.resize(self.grey.astype(np.float32), (2 * _HEIGHT, _HEIGHT), interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), _BLUR)
        mean = cv2.GaussianBlur(small, (0, 0), _REGION)
        variance = cv2.GaussianBlur(small * small, (0, 0), _REGION) - mean * mean
        detail = (small - mean) / (np.sqrt(np.maximum(variance, 0)) + _LEAST_CONTRAST)
        values = *self.depth.sample(rays), sample_nearest(detail, rays), sample_nearest(np.log(small + 0.02), rays)
        return np.stack(values, axis=-1).reshape(_HEIGHT, 2 * _HEIGHT, 4).astype(np.float32)


def compare(
    first: Surroundings, second: Surroundings, rotation: Float[Array, "3 3"], translation: Float[Array, "3"]
) -> Comparison:
    """Compare two panoramas under x2 = R x1 + t, in camera heights."""
    return Comparison(*_compare_all(first, second, rotation[None], translation[None], 1)[0].tolist())


def compare_many(
    first: Surroundings,
    second: Surroundings,
    rotations: Float[Array, "pose 3 3"],
    translations: Float[Array, "pose 3"],
) -> Float[Array, "pose 4"]:
    """The values of `Comparison` for many poses, by a sixteenth of the directions."""
    return _compare_all(first, second, rotations, translations, _COARSE)


def _compare_all(first: Surroundings, second: Surroundings, rotations: Array, translations: Array, step: int) -> Array:
    a, b = first.depth.rotation, second.depth.rotation  # of the upright cameras
    there = b.T @ rotations @ a, translations @ b
    back = there[0].transpose(0, 2, 1), -np.einsum("nji,nj->ni", there[0], there[1])
    values = np.zeros((len(rotations), 4))
    for (turns, ways), source, target in ((there, first, second), (back, second, first)):
        values += 0.5 * _compare_one_way(
            _upright_rays(), source.maps, target.maps, turns.astype(np.float32), ways.astype(np.float32), step
        )
    return values


@functools.cache
def _upright_rays() -> Float[Array, "h 2*h 3"]:
    return pixel_directions(_HEIGHT, 2 * _HEIGHT).numpy().astype(np.float32)


@nb.njit(fastmath=True, cache=True, nogil=True)
def _compare_one_way(rays, source, target, rotations, translations, step):
    height, width = target.shape[:2]
    count = len(rotations)
    result = np.zeros((count, 4))
    for n in range(count):
        r, t = rotations[n], translations[n]
        total = common = conflict = 0.0
        sums = np.zeros((2, 5))  # of a, b, a a, b b, a b
        for i in range(step // 2, height, step):
            weight = math.cos(((i + 0.5) / height - 0.5) * math.pi)
            for j in range(step // 2, width, step):
                depth, deviation = math.exp(source[i, j, 0]), source[i, j, 1]
                x, y, z = rays[i, j, 0] * depth, rays[i, j, 1] * depth, rays[i, j, 2] * depth
                px = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]
                py = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]
                pz = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
                total += weight
                flat = px * px + pz * pz
                distance = math.sqrt(flat + py * py)
                if distance < _NEAREST:
                    continue
                column = int((math.atan2(px, pz) / (2 * math.pi) + 0.5) * width) % width
                row = min(max(int((math.atan2(py, math.sqrt(flat)) / math.pi + 0.5) * height), 0), height - 1)
                uncertain = deviation + target[row, column, 1]
                error = math.log(distance) - target[row, column, 0]
                if abs(error) < _TOLERANCE + uncertain:
                    common += weight
                    for k in range(2):
                        a, b = source[i, j, 2 + k], target[row, column, 2 + k]
                        sums[k, 0] += weight * a
                        sums[k, 1] += weight * b
                        sums[k, 2] += weight * a * a
                        sums[k, 3] += weight * b * b
                        sums[k, 4] += weight * a * b
                elif uncertain < _CERTAIN and error < -max(2 * (_TOLERANCE + uncertain), _CONFLICT):
                    conflict += weight
        result[n, 0], result[n, 1] = common / total, conflict / total
        if common > _LEAST_COMMON * total:
            for k in range(2):
                a, b = sums[k, 0] / common, sums[k, 1] / common
                norm = (sums[k, 2] / common - a * a) * (sums[k, 3] / common - b * b)
                result[n, 2 + k] = (sums[k, 4] / common - a * b) / math.sqrt(max(norm, 1e-12))
    return result
