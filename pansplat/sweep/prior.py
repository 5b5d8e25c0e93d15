"""A prior of each view's depth in the search: a hypothesis set of its shape, and a cost for hypotheses far from it.

A prior gives the logarithm of depth up to one factor per view, with a Laplace scale at each pixel. `estimate_scale`
finds the factor by matching: the prior's surface, scaled by each candidate, is warped into the other views.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.matching import HypothesisSet, MatchingConfig, View, compute_matching_cost
from pansplat.sweep.surface import resize_sphere

_SCALE_CANDIDATES = 96
_SHARP_SCALE = 0.08  # Laplace scale up to which a pixel has full weight in the search of the factor
_UNBOUNDED = (math.inf, -math.inf)


@dataclass(frozen=True)
class PriorConfig:
    """Weights of the prior, in the unit of the matching cost."""

    weight: float = 0.25
    """Cost of a deviation by one Laplace scale."""
    cap: float = 3.0
    """Deviation, in Laplace scales, above which the cost is constant."""
    min_scale: float = 0.03
    """Smallest Laplace scale of log-depth."""
    penalty: float = 0.0
    """Penalty of the hypotheses of the prior's shape."""


@dataclass(frozen=True, eq=False)
class DepthPrior:
    """One view's prior.

    Attributes:
        log_depth: (h, w) logarithm of radial depth up to a constant.
        scale: (h, w) Laplace scale of it.
    """

    log_depth: np.ndarray
    scale: np.ndarray

    def resize(self, height: int) -> DepthPrior:
        return DepthPrior(resize_sphere(self.log_depth, height), resize_sphere(self.scale, height))


PriorModel = Callable[[Sequence[np.ndarray]], list[DepthPrior]]
"""Priors of upright panoramas (h, w, 3), RGB in [0, 1]."""


def estimate_scale(
    prior: DepthPrior,
    view: View,
    others: Sequence[tuple[View, np.ndarray]],
    limits: tuple[float, float],
    config: MatchingConfig,
) -> float:
    """The logarithm of the factor from the prior's depth to metres with the lowest matching cost.

    Args:
        others: the other views, and the poses (4, 4) from `view`'s camera to theirs.
        limits: smallest and largest inverse depth, 1/m; they bound the factor's inverse.
    """
    height = view.image.shape[0]
    inverse = np.exp(-prior.log_depth).astype(np.float32)
    low, high = limits
    step = (high - low) / (_SCALE_CANDIDATES - 1)
    shape = HypothesisSet(
        (low * inverse).astype(np.float32),
        (step * inverse).astype(np.float32),
        np.zeros((2, _SCALE_CANDIDATES), np.float32),
        np.zeros(inverse.shape, np.uint8),
    )
    gray = view.image.mean(axis=2)
    variance = cv2.boxFilter(gray * gray, -1, (5, 5)) - cv2.boxFilter(gray, -1, (5, 5)) ** 2
    weight = np.clip(variance, 0, 4e-3) * view.valid * row_weights(height).numpy()[:, None]
    weight *= np.minimum(_SHARP_SCALE / np.maximum(prior.scale, 1e-3), 1)
    total = np.zeros(_SCALE_CANDIDATES)
    for other, pose in others:
        cost = compute_matching_cost(view, other, pose, [shape], (1e-6, 1e6), _UNBOUNDED, config)
        total += np.einsum("hw,hwk->k", weight, np.minimum(cost, 1.2))
    best = int(total.argmin())
    offset = 0.0
    if 0 < best < _SCALE_CANDIDATES - 1:
        left, middle, right = total[best - 1 : best + 2]
        offset = float(np.clip(0.5 * (left - right) / max(left + right - 2 * middle, 1e-12), -0.5, 0.5))
    return -math.log(low + (best + offset) * step)


def agreed_scale(prior: DepthPrior, inverse: np.ndarray, consistent: np.ndarray, fallback: float) -> float:
    """The weighted median of the factor's logarithm over pixels (h, w) whose surface is consistent between views."""
    if consistent.sum() < 64:
        return fallback
    values = (-np.log(np.maximum(inverse, 1e-6)) - prior.log_depth)[consistent]
    area = np.broadcast_to(row_weights(len(inverse)).numpy()[:, None], inverse.shape)[consistent]
    weight = area * np.minimum(_SHARP_SCALE / np.maximum(prior.scale[consistent], 1e-3), 1)
    order = np.argsort(values)
    below = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])


def apply_prior_cost(
    cost: np.ndarray, prior: DepthPrior, log_factor: float, sets: Sequence[HypothesisSet], config: PriorConfig
) -> None:
    """Add the prior's cost to that of all hypotheses (h, w, sets * count), in place."""
    count = sets[0].penalty.shape[1]
    log_depth = (prior.log_depth + log_factor).astype(np.float32)
    scale = np.maximum(prior.scale, config.min_scale).astype(np.float32)
    for n, hypotheses in enumerate(sets):
        _add_cost(
            cost, log_depth, scale, hypotheses.base, hypotheses.step, n * count, count,
            np.float32(config.weight), np.float32(config.cap),
        )  # fmt: skip


@nb.njit(parallel=True, fastmath=True, cache=True)
def _add_cost(cost, log_depth, scale, base, step, offset, count, weight, cap):
    height, width = log_depth.shape
    for i in nb.prange(height):
        for j in range(width):
            for k in range(count):
                inverse = max(base[i, j] + np.float32(k) * step[i, j], np.float32(1e-6))
                away = abs(math.log(inverse) + log_depth[i, j]) / scale[i, j]
                cost[i, j, offset + k] += weight * min(away, cap)
