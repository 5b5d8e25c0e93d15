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
from pansplat.poses.depth import DepthMap

_HEIGHT = 96  # rows of the directions that are compared
_BLUR, _REGION = 1.0, 12.0  # standard deviations of the compared detail and of its surroundings, pixels of 2 * _HEIGHT
_LEAST_CONTRAST = 0.03  # grey values of 1
_TOLERANCE = 0.12  # of log-depth, beside the deviations of both estimates
_CONFLICT = 0.25  # least log-depth that a surface in front of another one has against it
_CERTAIN = 0.3  # largest sum of the deviations at a conflict
_NEAREST = 0.25  # camera heights
_LEAST_COMMON = 30  # directions


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

    @functools.cached_property
    def rays(self) -> Float[Array, "n 3"]:
        """Directions in the camera's frame."""
        return pixel_directions(_HEIGHT, 2 * _HEIGHT).reshape(-1, 3).double().numpy()

    @functools.cached_property
    def weight(self) -> Float[Array, "n"]:
        """Area of each direction; the sum is 1."""
        area = np.repeat(np.cos((np.arange(_HEIGHT) + 0.5) / _HEIGHT * math.pi - math.pi / 2), 2 * _HEIGHT)
        return area / area.sum()

    @functools.cached_property
    def sampled_depth(self) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """Log-depth of each direction, camera heights, and its deviation."""
        return self.depth.sample(self.rays)

    @functools.cached_property
    def maps(self) -> Float[Array, "h 2*h 2"]:
        """Detail against its surroundings, and the logarithm of the grey value."""
        small = cv2.resize(self.grey.astype(np.float32), (4 * _HEIGHT, 2 * _HEIGHT), interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), _BLUR)
        mean = cv2.GaussianBlur(small, (0, 0), _REGION)
        variance = cv2.GaussianBlur(small * small, (0, 0), _REGION) - mean * mean
        detail = (small - mean) / (np.sqrt(np.maximum(variance, 0)) + _LEAST_CONTRAST)
        return np.stack((detail, np.log(small + 0.02)), axis=-1)

    def sample(self, rays: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
        """`maps` at directions of the camera."""
        height, width = self.maps.shape[:2]
        column = ((np.arctan2(rays[:, 0], rays[:, 2]) / (2 * math.pi) + 0.5) * width).astype(int) % width
        row = (np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2])) / math.pi + 0.5) * height
        return self.maps[row.astype(int).clip(0, height - 1), column]


def compare(
    first: Surroundings, second: Surroundings, rotation: Float[Array, "3 3"], translation: Float[Array, "3"]
) -> Comparison:
    """Compare two panoramas under x2 = R x1 + t, in camera heights."""
    there = _compare_one_way(first, second, rotation, translation)
    back = _compare_one_way(second, first, rotation.T, -rotation.T @ translation)
    return Comparison(*((a + b) / 2 for a, b in zip(there, back, strict=True)))


def _compare_one_way(
    first: Surroundings, second: Surroundings, rotation: Array, translation: Array
) -> tuple[float, float, float, float]:
    log_depth, deviation = first.sampled_depth
    points = first.rays * np.exp(log_depth)[:, None] @ rotation.T + translation
    distance = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
    rays = points / distance[:, None]
    other, other_deviation = second.depth.sample(rays)
    error, uncertain = np.log(distance) - other, deviation + other_deviation
    near = distance > _NEAREST
    common = near & (np.abs(error) < _TOLERANCE + uncertain)
    conflict = near & (uncertain < _CERTAIN) & (error < -np.maximum(2 * (_TOLERANCE + uncertain), _CONFLICT))
    likeness = shade = 0.0
    if common.sum() >= _LEAST_COMMON:
        a, b = first.sample(first.rays[common]), second.sample(rays[common])
        likeness, shade = (_correlate(a[:, n], b[:, n], first.weight[common]) for n in range(2))
    return float(first.weight[common].sum()), float(first.weight[conflict].sum()), likeness, shade


def _correlate(a: Float[Array, "n"], b: Float[Array, "n"], weight: Float[Array, "n"]) -> float:
    total = weight.sum()
    a, b = a - (weight * a).sum() / total, b - (weight * b).sum() / total
    norm = math.sqrt(float((weight * a * a).sum() * (weight * b * b).sum()))
    return float((weight * a * b).sum()) / max(norm, 1e-9)
