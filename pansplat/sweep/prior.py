"""A prior of each view's depth in the search, from a model that knows what rooms look like.

The model sees upright panoramas. Its first estimate is the logarithm of depth in units of the camera's height over the
floor; the height follows by matching: the estimated surfaces, scaled by each candidate, are warped into the other
views. The model then refines its estimates by comparison of the views. In the search the prior is a cost for
hypotheses whose depth differs from it, relative to its uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numba as nb
import numpy as np
import torch

from pansplat.geometry.equirect import rotate_equirect
from pansplat.sweep.matching import HypothesisSet, MatchingConfig, View, compute_matching_cost
from pansplat.sweep.planes import texture_weights
from pansplat.sweep.surface import resize_sphere

_HEIGHT_CANDIDATES = 64
_SHARP_SCALE = 0.08  # Laplace scale up to which a pixel has full weight in the search of the height
_MAX_COST = 1.2  # matching cost above which a pixel does not count against a height
_MIN_TILT = math.radians(0.5)  # of a camera that is turned upright
_USUAL_HEIGHT = 1.5  # metres, of a camera over the floor
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
    iterations: int = 2
    """Refinements by comparison of the views."""


@dataclass(frozen=True, eq=False)
class DepthPrior:
    """One view's prior.

    Attributes:
        log_depth: (h, w) logarithm of radial depth.
        scale: (h, w) Laplace scale of it.
    """

    log_depth: np.ndarray
    scale: np.ndarray

    def resize(self, height: int) -> DepthPrior:
        """The prior at another height."""
        return DepthPrior(resize_sphere(self.log_depth, height), resize_sphere(self.scale, height))

    def rotate(self, rotation: np.ndarray) -> DepthPrior:
        """The prior of the camera rotated by `rotation` (3, 3), its new axes in the old ones."""
        both = torch.from_numpy(np.stack((self.log_depth, self.scale)))
        rotated = rotate_equirect(both, torch.from_numpy(rotation)).numpy()
        return DepthPrior(rotated[0], rotated[1])


class ObservedViews(Protocol):
    """The model's view of upright panoramas.

    Attributes:
        priors: the estimate of each panorama by itself, in units of its camera's height.
    """

    priors: list[DepthPrior]

    def refine(self, camera_heights: Sequence[float], cam2world: np.ndarray, iterations: int) -> list[DepthPrior]:
        """The estimates in the unit of the poses (v, 4, 4), refined by comparison of the views."""
        ...


class PriorModel(Protocol):
    """Estimates depth. `fingerprint` changes whenever the estimates could."""

    fingerprint: str

    def observe(self, images: Sequence[np.ndarray]) -> ObservedViews:
        """Observe upright panoramas (h, w, 3), RGB in [0, 1]."""
        ...


def estimate_priors(
    model: PriorModel,
    images: Sequence[np.ndarray],
    cam2world: np.ndarray,
    views: Sequence[View],
    down: np.ndarray,
    limits: tuple[float, float],
    config: PriorConfig,
    matching: MatchingConfig,
    *,
    coincident: bool = False,
) -> list[DepthPrior]:
    """The prior of each view, in the unit of the poses.

    Cameras that coincide cannot be compared: each view has the model's first estimate, with a usual camera height.

    Args:
        images: (h, w, 3) of each view.
        cam2world: (v, 4, 4).
        views: the views at the size at which heights are compared.
        down: (3,) unit vector of the world.
        limits: smallest and largest inverse height of the cameras over the floor.
    """
    turns = [_upright_rotation(pose[:3, :3], down) for pose in cam2world]
    upright = [image if turn is None else _rotate_image(image, turn) for image, turn in zip(images, turns, strict=True)]
    observed = model.observe(upright)
    first = [
        prior if turn is None else prior.rotate(turn.T) for prior, turn in zip(observed.priors, turns, strict=True)
    ]
    if coincident:
        log_height = math.log(min(max(_USUAL_HEIGHT, 1 / limits[1]), 1 / limits[0]))
        return [DepthPrior(prior.log_depth + log_height, prior.scale) for prior in first]
    heights = _estimate_camera_heights(first, views, cam2world, down, limits, matching)
    poses = np.array(cam2world, np.float64)
    for pose, turn in zip(poses, turns, strict=True):
        if turn is not None:
            pose[:3, :3] = pose[:3, :3] @ turn
    refined = observed.refine(heights, poses, config.iterations)
    return [prior if turn is None else prior.rotate(turn.T) for prior, turn in zip(refined, turns, strict=True)]


def _upright_rotation(rotation: np.ndarray, down: np.ndarray) -> np.ndarray | None:
    """The smallest rotation (3, 3) after which a camera's y axis is `down`, as new axes in the old ones."""
    target = rotation.T @ down
    axis = np.cross((0.0, 1.0, 0.0), target)
    sine, cosine = float(np.linalg.norm(axis)), float(target[1])
    angle = math.atan2(sine, cosine)
    if angle < _MIN_TILT:
        return None
    if sine < 1e-9:  # upside down
        return np.diag((1.0, -1.0, -1.0))
    return cv2.Rodrigues(axis / sine * angle)[0]


def _rotate_image(image: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    maps = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)
    return np.ascontiguousarray(rotate_equirect(maps, torch.from_numpy(rotation)).permute(1, 2, 0).numpy())


def _estimate_camera_heights(
    priors: Sequence[DepthPrior],
    views: Sequence[View],
    cam2world: np.ndarray,
    down: np.ndarray,
    limits: tuple[float, float],
    config: MatchingConfig,
) -> list[float]:
    """The height of each camera over the common floor at which the priors match the other views best."""
    above = -(cam2world[:, :3, 3] @ down)  # of each camera, over any level
    above -= above.mean()
    low, high = limits
    for _ in range(2):  # all heights, then the ones around the best
        candidates = np.linspace(low, high, _HEIGHT_CANDIDATES)  # inverse heights
        total = np.zeros(_HEIGHT_CANDIDATES)
        for n, prior in enumerate(priors):
            own = 1 / np.maximum(1 / candidates + above[n], 1 / limits[1])  # this camera's, by the mean's
            sampled = np.linspace(own[0], max(own[-1], own[0] + 1e-6), _HEIGHT_CANDIDATES)
            total += np.interp(own, sampled, _match_heights(prior, n, views, cam2world, sampled, config))
        best, step = candidates[total.argmin()], candidates[1] - candidates[0]
        low, high = max(best - 2 * step, limits[0]), min(best + 2 * step, limits[1])
    return [max(1 / best + float(a), 1 / limits[1]) for a in above]


def _match_heights(
    prior: DepthPrior,
    index: int,
    views: Sequence[View],
    cam2world: np.ndarray,
    candidates: np.ndarray,
    config: MatchingConfig,
) -> np.ndarray:
    """Weighted matching cost (candidates) of a view's prior at each inverse height."""
    view = views[index]
    prior = prior.resize(view.image.shape[0])
    inverse = np.exp(-prior.log_depth).astype(np.float32)
    shape = HypothesisSet(
        (candidates[0] * inverse).astype(np.float32),
        ((candidates[1] - candidates[0]) * inverse).astype(np.float32),
        np.zeros((2, len(candidates)), np.float32),
        np.zeros(inverse.shape, np.uint8),
    )
    weight = texture_weights(view)
    weight *= np.minimum(_SHARP_SCALE / np.maximum(prior.scale, 1e-3), 1)
    total = np.zeros(len(candidates))
    for n, other in enumerate(views):
        if n != index:
            pose = np.linalg.inv(cam2world[n]) @ cam2world[index]
            cost = compute_matching_cost(view, other, pose, [shape], (1e-6, 1e6), _UNBOUNDED, config)
            total += np.einsum("hw,hwk->k", weight, np.minimum(cost, _MAX_COST))
    return total


def apply_prior_cost(cost: np.ndarray, prior: DepthPrior, sets: Sequence[HypothesisSet], config: PriorConfig) -> None:
    """Add the prior's cost to that of all hypotheses (h, w, sets * count), in place."""
    count = sets[0].penalty.shape[1]
    log_depth = prior.log_depth.astype(np.float32)
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
