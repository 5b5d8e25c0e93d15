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
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.poses.depth import DepthMap, sample_nearest
from pansplat.poses.solvers import compiled
from pansplat.system.kernels import fast_atan2

_HEIGHT = 96  # rows of the maps that are compared
_COARSE, _FINE = 4, 2  # step of the rows and columns in which many poses, or fewer, are compared
_BLUR, _REGION = 0.5, 6.0  # standard deviations of the compared detail and of its surroundings, pixels
_LEAST_CONTRAST, _LOG_OFFSET = 0.03, 0.02  # added to deviations and to grey values, which are 0 to 1
_LEAST_HUE = 0.06  # deviation of the logarithm of a ratio of colours that noise hides
_TOLERANCE = 0.12  # surfaces are the same within this log-depth and the deviations of both estimates
_CONFLICT = 0.25  # least log-depth that a surface in front of another one has against it
_CERTAIN = 0.3  # largest sum of the deviations at a conflict
_NEAREST = 0.25  # nearer surfaces are not compared, camera heights
_LEAST_COMMON = 0.002  # what is common to less of the sphere states no likeness
_FULL_OVERLAP = 0.1  # share of the sphere above which likeness and shade have their full weight
_LEAST_FACING = 0.3  # cosine of the angle between both estimated normals of one surface


@dataclass(frozen=True)
class Comparison:
    """How well two panoramas fit under a pose; means of both directions.

    Attributes:
        overlap: share of the sphere whose surface the other panorama sees at its place.
        conflict: share of the sphere whose surface is where the other panorama sees through.
        likeness: correlation of the detail of what both see, against its surroundings.
        shade: correlation of the logarithm of its grey values.
        hue: correlation of the logarithms of red and of blue over green.
    """

    overlap: float
    conflict: float
    likeness: float
    shade: float
    hue: float

    @property
    def weight(self) -> float:
        """The weight of likeness, shade and hue: few directions correlate by chance."""
        return float(overlap_weight(np.array(self.overlap)))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is compared of a panorama.

    Attributes:
        image: RGB in [0, 1], as the camera took it.
        depth: estimated depth of the panorama.
    """

    image: Float[Array, "h 2*h 3"]
    depth: DepthMap

    def mirrored(self) -> Surroundings:
        """The surroundings in the panorama that is mirrored left to right."""
        return Surroundings(self.image[:, ::-1], self.depth.mirrored())

    @functools.cached_property
    def maps(self) -> Float[Array, "h 2*h 9"]:
        """Log-depth, its deviation, normal (3), detail against its surroundings, logarithm of grey value, hue (2).

        They are those of the upright camera; depths are in camera heights.
        """
        rays = _upright_rays().reshape(-1, 3).astype(np.float64) @ self.depth.rotation.T
        image = cv2.resize(self.image.astype(np.float32), (2 * _HEIGHT, _HEIGHT), interpolation=cv2.INTER_AREA)
        grey = cv2.GaussianBlur(image.mean(axis=2), (0, 0), _BLUR)
        mean = cv2.GaussianBlur(grey, (0, 0), _REGION)
        variance = cv2.GaussianBlur(grey * grey, (0, 0), _REGION) - mean * mean
        detail = (grey - mean) / (np.sqrt(np.maximum(variance, 0)) + _LEAST_CONTRAST)
        red, green, blue = np.moveaxis(np.log(cv2.GaussianBlur(image, (0, 0), _BLUR) + _LOG_OFFSET), 2, 0)
        pictures = detail, np.log(grey + _LOG_OFFSET), red - green, blue - green
        log_depth, deviation = (values.reshape(_HEIGHT, -1) for values in self.depth.sample(rays))
        sampled = [sample_nearest(picture, rays).reshape(_HEIGHT, -1) for picture in pictures]
        maps = np.dstack((log_depth, deviation, _find_normals(log_depth), *sampled))
        return np.ascontiguousarray(maps, np.float32)

    @functools.cached_property
    def points(self) -> Float[Array, "h 2*h 3"]:
        """The surfaces in the frame of the upright camera, camera heights."""
        return _upright_rays() * np.exp(self.maps[:, :, :1])


def overlap_weight(overlap: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Weight of the likeness and the shade of directions with this share of the sphere."""
    return np.minimum(np.sqrt(overlap / _FULL_OVERLAP), 1.0)


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
    *,
    coarse: bool = True,
) -> Float[Array, "pose 5"]:
    """The values of `Comparison` for many poses, by a sixteenth or a quarter of the directions."""
    return _compare_all(first, second, rotations, translations, _COARSE if coarse else _FINE)


def _compare_all(first: Surroundings, second: Surroundings, rotations: Array, translations: Array, step: int) -> Array:
    a, b = first.depth.rotation, second.depth.rotation  # axes of the upright cameras
    there = b.T @ rotations @ a, translations @ b
    back = there[0].transpose(0, 2, 1), -np.einsum("nji,nj->ni", there[0], there[1])
    values = np.zeros((len(rotations), 5))
    for (turns, translations), source, target in ((there, first, second), (back, second, first)):
        values += 0.5 * _compare_one_way(
            source.points, source.maps, target.maps, turns.astype(np.float32), translations.astype(np.float32), step
        )
    return values


def _find_normals(log_depth: Float[Array, "h 2*h"]) -> Float[Array, "h 2*h 3"]:
    """Unit normals of the surfaces, towards the camera."""
    points = _upright_rays() * np.exp(log_depth)[:, :, None]
    across = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
    normals = np.cross(across, np.gradient(points, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return normals * np.where((normals * points).sum(axis=-1, keepdims=True) > 0, -1, 1)


@functools.cache
def _upright_rays() -> Float[Array, "h 2*h 3"]:
    return pixel_directions(_HEIGHT, 2 * _HEIGHT).numpy().astype(np.float32)


@compiled
def _compare_one_way(points, source, target, rotations, translations, step):
    height, width = target.shape[:2]
    count = len(rotations)
    result = np.zeros((count, 5))
    for n in range(count):
        r, t = rotations[n], translations[n]
        total = common = conflict = 0.0
        sums = np.zeros((4, 5))  # a, b, a a, b b, a b: for detail, grey, and both of hue
        for i in range(step // 2, height, step):
            weight = math.cos(((i + 0.5) / height - 0.5) * math.pi)
            for j in range(step // 2, width, step):
                x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
                px = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]
                py = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]
                pz = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
                total += weight
                flat = px * px + pz * pz
                distance = math.sqrt(flat + py * py)
                if distance < _NEAREST:
                    continue
                column = min(int((fast_atan2(px, pz) / (2 * math.pi) + 0.5) * width), width - 1)
                row = min(max(int((fast_atan2(py, math.sqrt(flat)) / math.pi + 0.5) * height), 0), height - 1)
                uncertain = source[i, j, 1] + target[row, column, 1]
                error = math.log(distance) - target[row, column, 0]
                if abs(error) < _TOLERANCE + uncertain:
                    facing = 0.0
                    for k in range(3):
                        turned = r[k, 0] * source[i, j, 2] + r[k, 1] * source[i, j, 3] + r[k, 2] * source[i, j, 4]
                        facing += turned * target[row, column, 2 + k]
                    if facing < _LEAST_FACING:  # the other side of a wall
                        continue
                    common += weight
                    for k in range(4):
                        a, b = source[i, j, 5 + k], target[row, column, 5 + k]
                        sums[k, 0] += weight * a
                        sums[k, 1] += weight * b
                        sums[k, 2] += weight * a * a
                        sums[k, 3] += weight * b * b
                        sums[k, 4] += weight * a * b
                elif uncertain < _CERTAIN and error < -max(2 * (_TOLERANCE + uncertain), _CONFLICT):
                    conflict += weight
        result[n, 0], result[n, 1] = common / total, conflict / total
        if common > _LEAST_COMMON * total:
            hue = np.zeros(3)  # sums of a a, b b, a b
            for k in range(4):
                a, b = sums[k, 0] / common, sums[k, 1] / common
                squares = sums[k, 2] / common - a * a, sums[k, 3] / common - b * b, sums[k, 4] / common - a * b
                if k < 2:
                    result[n, 2 + k] = squares[2] / math.sqrt(max(squares[0] * squares[1], 1e-12))
                else:
                    for m in range(3):
                        hue[m] += squares[m]
            result[n, 4] = hue[2] / (math.sqrt(max(hue[0] * hue[1], 0.0)) + _LEAST_HUE**2)
    return result
