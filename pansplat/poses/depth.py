"""Depth of single panoramas as evidence for relative poses.

The depth network estimates the depth of one panorama in units of the camera's height over the floor. At right matches
its error is a few percent, so that it states where along an epipolar curve a match must lie, and how far apart the
cameras are. A repeated door or window that fits by its bearings rarely fits by its depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from pansplat.sweep.panoramas import rotate_image, upright_rotation

_LEAST_DEVIATION = 0.04  # deviation of log-depth at a right match: heights of two cameras differ, too
_TAIL = 2.0  # degrees of freedom of a right match's deviation
_EQUAL = 0.1  # deviation of both sides' difference at a wrong match on one floor or ceiling
_WRONG_SHARE = 0.1  # share of right matches whose depth is wrong: edges, windows and mirrors
_STEP = 0.04  # step of the search of the distance, logarithm
_DISTANCES = math.log(0.05), math.log(30.0)  # distances of two cameras that are searched, camera heights
_SMOOTHING = np.exp(-0.5 * (np.arange(-4, 5) / 1.5) ** 2)
_DENSITY = math.gamma((_TAIL + 1) / 2) / math.gamma(_TAIL / 2) / math.sqrt(_TAIL * math.pi)  # Student's t at 0


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Estimated depth of a panorama.

    Attributes:
        log_depth: logarithm of the depth of the upright panorama, camera heights.
        scale: Laplace scale of it, at any size.
        rotation: the upright camera's axes in the camera's frame, as columns.
    """

    log_depth: Float[Array, "h 2*h"]
    scale: Float[Array, "s 2*s"]
    rotation: Float[Array, "3 3"]

    def sample(self, bearings: Float[Array, "n 3"]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """Log-depth and its standard deviation at bearings of the camera."""
        upright = bearings @ self.rotation
        deviation = np.hypot(_LEAST_DEVIATION, sample_nearest(self.scale, upright))
        return sample_nearest(self.log_depth, upright), deviation

    def mirrored(self) -> DepthMap:
        """The depth of the panorama that is mirrored left to right."""
        flip = np.diag((-1.0, 1.0, 1.0))
        return DepthMap(self.log_depth[:, ::-1], self.scale[:, ::-1], flip @ self.rotation @ flip)


def estimate_depth(image: Float[Array, "h w 3"], down: Float[Array, "3"] | None) -> DepthMap:
    """The depth of a panorama by the default model.

    Args:
        image: RGB in [0, 1].
        down: gravity in the camera's frame; None if it is unknown: the camera is then taken to be upright.
    """
    from pansplat.sweep.guided_sweep import load_default_sweep

    turn = None if down is None else upright_rotation(np.eye(3), down)
    upright = image if turn is None else rotate_image(image, turn)
    prior = load_default_sweep().prior
    assert prior is not None
    observed = prior.observe([upright.astype(np.float32)])
    return DepthMap(observed.sharpen()[0], observed.priors[0].scale, np.eye(3) if turn is None else turn)


def sample_nearest(values: Float[Array, "h w"], rays: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Nearest values of an equirectangular map at directions, as float64."""
    height, width = values.shape
    column = (np.arctan2(rays[:, 0], rays[:, 2]) / (2 * math.pi) + 0.5) * width
    row = (np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2])) / math.pi + 0.5) * height
    return values[row.astype(int).clip(0, height - 1), column.astype(int) % width].astype(np.float64)


@dataclass(frozen=True, eq=False)
class MatchDepths:
    """Estimated depth at matches, in both panoramas.

    Attributes:
        log_depth, deviation: log-depth and its deviation in the first and in the second panorama.
    """

    log_depth: Float[Array, "match 2"]
    deviation: Float[Array, "match 2"]

    def select(self, chosen: Int[Array, "n"] | slice) -> MatchDepths:
        """The depths of a selection of the matches."""
        return replace(self, log_depth=self.log_depth[chosen], deviation=self.deviation[chosen])

    def find_distance(self, depths: Float[Array, "match 2"], weight: Float[Array, "match"]) -> float:
        """The distance of the cameras, in camera heights, on which most matches agree.

        Args:
            depths: triangulated, in units of the distance; positive where `weight` is.
            weight: weight of each match.
        """
        used = weight > 1e-3
        if not used.any():
            return math.nan
        logs = self.log_depth[used] - np.log(np.maximum(depths[used], 1e-9))
        weights = weight[used, None] / self.deviation[used]
        low, high = _DISTANCES
        count = math.ceil((high - low) / _STEP)
        place = ((logs - low) / _STEP).astype(int)
        inside = (logs > low) & (place < count)
        if not inside.any():
            return math.nan
        votes = np.bincount(place[inside], weights[inside], count)
        best = int(np.convolve(votes, _SMOOTHING, "same").argmax())
        middle = low + (best + 0.5) * _STEP
        near = inside & (np.abs(logs - middle) < 3 * _STEP)
        total = weights[near].sum()
        return math.exp(float((weights[near] * logs[near]).sum() / total) if total > 0 else middle)

    def likelihood_ratio(
        self, depths: Float[Array, "match 2"], distance: float, parallax: Float[Array, "match"], noise: Array
    ) -> Float[Array, "match"]:
        """Likelihood of the depths of each match if it is right, over that by chance.

        By chance both deviations are independent, or equal, as for two places on the floor.

        Args:
            depths: triangulated, in units of the distance.
            distance: distance of the cameras, camera heights.
            parallax: parallax of each match, radians.
            noise: standard deviation of the bearings, radians.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.log(depths * distance) - self.log_depth
        error = np.nan_to_num(error, nan=9.0, posinf=9.0, neginf=-9.0).clip(-9, 9)
        shared = noise / np.maximum(parallax, 1e-6)  # relative error of the triangulation
        deviation = np.hypot(self.deviation, shared[:, None])
        right = np.prod(_DENSITY / deviation * (1 + (error / deviation) ** 2 / _TAIL) ** (-(_TAIL + 1) / 2), axis=1)
        chance = 0.5 * np.exp(-np.abs(error))  # a wrong match's deviation has Laplace's scale 1
        equal = np.exp(-0.5 * ((error[:, 0] - error[:, 1]) / _EQUAL) ** 2) / (_EQUAL * math.sqrt(2 * math.pi))
        by_chance = 0.5 * chance.prod(axis=1) + 0.5 * chance[:, 0] * np.maximum(equal, 1e-6)
        known = shared < 0.5
        return np.where(known, (1 - _WRONG_SHARE) * right / by_chance + _WRONG_SHARE, 1.0)
