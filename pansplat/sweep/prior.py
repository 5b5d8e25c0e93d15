"""Priors of each view's depth in the search, from a model that was trained on rooms.

The model sees upright panoramas. Its first estimate is the logarithm of depth in units of the camera's height over the
floor; the height follows by matching: the estimated surfaces, scaled by each candidate, are warped into the other
views. The floor gives one height and all surfaces another one, because the walls of a hall are farther away than the
model expects. The model refines its estimates by comparison of the views, from both heights. In the search a prior is a
cost for hypotheses whose depth differs from it, relative to its uncertainty. The prior of lowest cost counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pansplat.geometry.equirect import row_weights
from pansplat.inputs.views import CAMERA_HEIGHT
from pansplat.sweep.matching import HypothesisSet, OtherView, View, compute_matching_cost
from pansplat.sweep.panoramas import nearest_pixel, ray_grid, resize_sphere, rotate_image, upright_rotation
from pansplat.sweep.surface import list_best_pairs, measure_distances
from pansplat.system.kernels import cached_njit, parallel_for, thread_count

if TYPE_CHECKING:
    from pansplat.sweep.guided_sweep import NetworkPrior

_HEIGHT_CANDIDATES = 40  # inverse heights of the cameras that are compared
_MAX_VARIANCE = 4e-3  # largest variance of grey values that raises a weight; more texture has no more
_SHARP_SCALE = 0.08  # Laplace scale up to which a pixel has full weight in the search of the height
_MAX_COST = 1.2  # matching cost above which a pixel does not count against a height
_HEIGHT_PENALTY = 0.06  # matching cost of a height by a factor of e from the usual one
_FLOOR_TOLERANCE = 0.15  # distance from the floor of pixels that the model places on it, in camera heights
_SAME_HEIGHT = 0.02  # relative difference of two heights whose priors are the same
_MIN_SPREAD = 0.1  # least relative deviation of an estimate that decides what a view sees
_MIN_OVERLAP = 0.5  # least common fraction of the surfaces of views that are matched (docs/what_was_tried.md)
_REFINEMENTS = 2  # refinements of the depth by comparison of the views

# The cost of a prior, in the unit of the matching cost
_DEVIATION_COST = 0.25  # matching cost of a deviation by one Laplace scale
_MAX_DEVIATION = 3.0  # deviation, in Laplace scales, above which the cost is constant
_MIN_SCALE = 0.03  # smallest Laplace scale of log-depth
_FURTHER_PENALTY = 0.25  # added to the deviation from each prior but the first, in Laplace scales


@dataclass(frozen=True, eq=False)
class DepthPrior:
    """The prior of the depth of a view.

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
        rotated = rotate_image(np.stack((self.log_depth, self.scale), axis=-1), rotation)
        return DepthPrior(rotated[..., 0], rotated[..., 1])


class PriorEstimator:
    """Estimates the priors of each view, in the unit of the poses.

    Args:
        images: (h, w, 3) of each view.
        cam2world: (v, 4, 4).
        down: (3,) unit vector of the world.
        limits: smallest and largest inverse height of the cameras over the floor: those of the inverse depth, because
            the floor is in its range.
    """

    def __init__(
        self,
        model: NetworkPrior,
        images: Sequence[np.ndarray],
        cam2world: np.ndarray,
        down: np.ndarray,
        limits: tuple[float, float],
    ) -> None:
        self._cam2world, self._down, self._limits = cam2world, down, limits
        self._usual_height = min(max(CAMERA_HEIGHT, 1 / limits[1]), 1 / limits[0])
        self._turns = [upright_rotation(pose[:3, :3], down) for pose in cam2world]
        self._observed = model.observe(
            [i if turn is None else rotate_image(i, turn) for i, turn in zip(images, self._turns, strict=True)]
        )
        self._upright_poses = np.array(cam2world, np.float64)
        for pose, turn in zip(self._upright_poses, self._turns, strict=True):
            if turn is not None:
                pose[:3, :3] = pose[:3, :3] @ turn

    def sharpen(self) -> list[np.ndarray]:
        """Sharpened log-depth (h, w) of each view by itself, in the unit of the poses for a usual camera height.

        The search bends it to the matches, and uses it as it is where nothing can be matched.
        """
        upright = [log_depth + math.log(self._usual_height) for log_depth in self._observed.sharpen()]
        return [
            log_depth if turn is None else rotate_image(log_depth[..., None], turn.T)[..., 0]
            for log_depth, turn in zip(upright, self._turns, strict=True)
        ]

    def choose_neighbours(self, count: int) -> list[list[int]]:
        """At most `count` other views of each view that see most of the same surfaces, the largest overlap first.

        Cameras that are too near for parallax come later.

        The surfaces are the estimates of each view by itself. An overlap is the smaller share of the two spheres that
        the other camera sees, from at most twice the distance. Each view has at least one other view.
        """
        priors = self._turn_back(_scale_depth(self._observed.priors, [self._usual_height] * len(self._turns)))
        shares = np.array(
            [
                [_share_seen(here, there, poses) for there, poses in zip(priors, pairs, strict=True)]
                for here, pairs in zip(priors, _pair_poses(self._cam2world), strict=True)
            ]
        )
        overlap = np.minimum(shares, shares.T)
        parallax = np.minimum(measure_distances(self._cam2world) * self._limits[1], 1)
        order = (overlap * parallax - np.eye(len(overlap))).argsort(axis=1, kind="stable")[:, ::-1]
        return [
            [int(other) for n, other in enumerate(row[:count]) if n == 0 or overlap[view, other] > _MIN_OVERLAP]
            for view, row in enumerate(order[:, :-1])
        ]

    def estimate_by_matching(
        self,
        views: Sequence[View],
        neighbours: Sequence[Sequence[int]],
    ) -> list[list[DepthPrior]]:
        """The priors of each view, from the height by the floor and, where it differs, from that by all surfaces.

        Args:
            views: the views at the size at which heights are compared.
            neighbours: the other views that each view is compared with.
        """
        first = self._turn_back(self._observed.priors)
        by_pair = {}  # grouped by the best neighbour: the model errs by another factor in each room
        pairs = list_best_pairs(neighbours)
        for nodes in set(pairs):
            pair = [[maps[n] for n in nodes] for maps in (first, views)]
            by_pair[nodes] = [
                _estimate_camera_heights(
                    *pair, self._cam2world[list(nodes)], self._down, self._limits, floor_only=floor_only
                )
                for floor_only in (True, False)
            ]
        heights = [[by_pair[nodes][kind][nodes.index(view)] for view, nodes in enumerate(pairs)] for kind in range(2)]
        if np.abs(np.log(np.divide(*heights))).max() < _SAME_HEIGHT:
            heights.pop()
        starts = [_scale_depth(self._observed.priors, own) for own in heights]
        poses = self._upright_poses
        refined = [self._turn_back(self._observed.refine(each, poses, neighbours, _REFINEMENTS)) for each in starts]
        return [list(own) for own in zip(*refined, strict=True)]

    def _turn_back(self, priors: Sequence[DepthPrior]) -> list[DepthPrior]:
        """Priors of the upright panoramas as ones of the panoramas."""
        return [p if turn is None else p.rotate(turn.T) for p, turn in zip(priors, self._turns, strict=True)]


def _scale_depth(priors: Sequence[DepthPrior], factors: Sequence[float]) -> list[DepthPrior]:
    """The priors with their depths multiplied by one factor each."""
    return [DepthPrior(p.log_depth + math.log(factor), p.scale) for p, factor in zip(priors, factors, strict=True)]


def _estimate_camera_heights(
    priors: Sequence[DepthPrior],
    views: Sequence[View],
    cam2world: np.ndarray,
    down: np.ndarray,
    limits: tuple[float, float],
    *,
    floor_only: bool,
) -> list[float]:
    """The height of each camera over the common floor at which the priors match the other views best.

    Args:
        floor_only: whether only the pixels count that the priors place on the floor.
    """
    above = -(cam2world[:, :3, 3] @ down)  # height of each camera over any level
    above -= above.mean()
    priors = [prior.resize(len(view.image)) for prior, view in zip(priors, views, strict=True)]
    weights = [_weight_pixels(*pair) for pair in zip(priors, views, strict=True)]
    if floor_only:
        for weight, prior, pose in zip(weights, priors, cam2world, strict=True):
            below = np.exp(prior.log_depth) * (ray_grid(len(weight)) @ (pose[:3, :3].T @ down))
            weight *= np.abs(below - 1) < _FLOOR_TOLERANCE
    unit = (len(views) - 1) * max(sum(float(weight.sum()) for weight in weights), 1e-9)
    low, high = limits
    for penalty in (_HEIGHT_PENALTY, 0.01 * _HEIGHT_PENALTY):  # the second round only takes the heights around the best
        candidates = np.linspace(low, high, _HEIGHT_CANDIDATES)  # inverse heights of the cameras' mean
        total = unit * penalty * np.abs(np.log(CAMERA_HEIGHT * candidates))
        for n, prior in enumerate(priors):
            own = 1 / np.maximum(1 / candidates + above[n], 1 / limits[1])  # inverse height of this camera
            sampled = np.linspace(own[0], max(own[-1], own[0] + 1e-6), _HEIGHT_CANDIDATES)
            costs = _match_heights(prior, weights[n], n, views, cam2world, sampled)
            total += np.interp(own, sampled, costs)
        best, step = candidates[total.argmin()], candidates[1] - candidates[0]
        low, high = max(best - 2 * step, limits[0]), min(best + 2 * step, limits[1])
    return [max(1 / best + float(a), 1 / limits[1]) for a in above]


def _pair_poses(cam2world: np.ndarray) -> np.ndarray:
    """Poses (v, v, 4, 4) from the first view's camera to the second one's."""
    return np.linalg.inv(cam2world)[None] @ cam2world[:, None]


def _share_seen(here: DepthPrior, there: DepthPrior, pose: np.ndarray) -> float:
    """Share of a view's sphere whose surface another view sees; `pose` (4, 4) is from its camera to the other one's."""
    height = len(here.log_depth)
    depth = np.exp(here.log_depth)
    points = (ray_grid(height) * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    distance = np.maximum(np.linalg.norm(points, axis=-1), 1e-9)
    pixel = nearest_pixel(points, height)
    behind = (distance / np.exp(there.log_depth[pixel]) - 1) / np.maximum(there.scale[pixel], _MIN_SPREAD)
    seen = np.clip(2 - 0.5 * behind, 0, 1) * np.minimum(2 * depth / distance, 1)
    areas = row_weights(height).numpy()
    return float(seen.mean(axis=1) @ areas / areas.sum())


def _weight_pixels(prior: DepthPrior, view: View) -> np.ndarray:
    """Weights (h, w) of a view's pixels in the search of the height: textured, not masked, and of a certain prior."""
    gray = view.image.mean(axis=2)
    variance = cv2.boxFilter(gray * gray, -1, (5, 5)) - cv2.boxFilter(gray, -1, (5, 5)) ** 2
    area = row_weights(len(view.image)).numpy()[:, None]
    certain = np.minimum(_SHARP_SCALE / np.maximum(prior.scale, 1e-3), 1)
    return np.clip(variance, 0, _MAX_VARIANCE) * view.valid * area * certain


def _match_heights(
    prior: DepthPrior,
    weight: np.ndarray,
    index: int,
    views: Sequence[View],
    cam2world: np.ndarray,
    candidates: np.ndarray,
) -> np.ndarray:
    """Sum of the weighted matching costs (candidates) of a view's prior at each inverse height."""
    inverse = np.exp(-prior.log_depth).astype(np.float32)
    shape = HypothesisSet(
        (candidates[0] * inverse).astype(np.float32),
        ((candidates[1] - candidates[0]) * inverse).astype(np.float32),
        np.zeros(len(candidates), np.float32),
    )
    total = np.zeros(len(candidates))
    for n, other in enumerate(views):
        if n != index:
            matched = OtherView(other, np.linalg.inv(cam2world[n]) @ cam2world[index], [shape])
            cost = compute_matching_cost(views[index], [matched], (1e-6, 1e6))
            total += np.einsum("hw,hwk->k", weight, np.minimum(cost, _MAX_COST))
    return total


def apply_prior_cost(cost: np.ndarray, priors: Sequence[DepthPrior], sets: Sequence[HypothesisSet]) -> None:
    """Add the lowest cost of the priors to that of all hypotheses (h, w, sets * count), in place."""
    count = len(sets[0].penalty)
    log_depth = np.stack([prior.log_depth for prior in priors]).astype(np.float32)
    scale = np.stack([np.maximum(prior.scale, _MIN_SCALE) for prior in priors]).astype(np.float32)
    penalty = np.where(np.arange(len(priors)) > 0, _FURTHER_PENALTY, 0).astype(np.float32)
    weight, cap = np.float32(_DEVIATION_COST), np.float32(_MAX_DEVIATION)
    for n, hypotheses in enumerate(sets):
        base, step = (np.ascontiguousarray(each, np.float32) for each in (hypotheses.base, hypotheses.step))
        add = partial(_add_cost, cost, log_depth, scale, penalty, base, step, n * count, count, weight, cap)
        parallel_for(add, len(cost), thread_count())


@cached_njit(nogil=True, fastmath=True)
def _add_cost(cost, log_depth, scale, penalty, base, step, offset, count, weight, cap, i):
    priors, _, width = log_depth.shape
    for j in range(width):
        for k in range(count):
            log_inverse = math.log(max(base[i, j] + np.float32(k) * step[i, j], np.float32(1e-6)))
            away = cap
            for n in range(priors):
                away = min(away, abs(log_inverse + log_depth[n, i, j]) / scale[n, i, j] + penalty[n])
            cost[i, j, offset + k] += weight * away
