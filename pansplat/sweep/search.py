"""The hierarchical sphere sweep: from posed panoramas to one surface per view.

Three levels of matching, at 1/4, 1/2 and 1/1 of the height, follow each other as in the paper's hierarchical cost
volume (PanSplat, section 3.2). The coarse level searches the whole depth range with spheres and with planes across the
scene's axes. Each finer level searches a narrow range around the coarser surface, which gives occlusion and
consistency between views. With a prior, the surfaces of the finest level and of the result are those of single views,
bent by the matches (`bend`). A prior of accurate shapes replaces the search of the whole range: all levels then search
near the surfaces of single views. At last all surfaces are made whole (`whole`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pansplat.inputs.views import ONE_POSITION
from pansplat.sweep.axes import (
    axis_components,
    estimate_axes,
    mark_separating_planes,
    match_axes,
)
from pansplat.sweep.bend import bend_surfaces
from pansplat.sweep.matching import (
    DepthRange,
    HypothesisSet,
    OtherView,
    View,
    aggregate_costs,
    compute_matching_cost,
    select_labels,
)
from pansplat.sweep.panoramas import resize_mask, resize_sharp, resize_sphere
from pansplat.sweep.prior import DepthPrior, PriorEstimator, apply_prior_cost
from pansplat.sweep.surface import PosedImages, Surface, guided_upsample, list_best_pairs, measure_distances
from pansplat.sweep.whole import make_whole
from pansplat.system.progress import report_progress

if TYPE_CHECKING:
    from pansplat.sweep.guided_sweep import NetworkPrior

_LONE_STEP = 0.6  # metres by which a camera leaves a view that has no neighbours
_SMALL_HEIGHT = 96  # rows of the panoramas with which heights of the cameras over the floor are compared


_MAX_CANDIDATES = 256  # largest number of hypotheses of a set at the coarse level
_NEAR_MARGIN = 0.75  # smallest searched depth, relative to `near`
_FAR_MARGIN = 10.0  # largest searched depth, relative to `far`: rooms are often larger (docs/adr/0011)
_NARROW_CANDIDATES = (16, 8)  # hypotheses of a set at the two finer levels (docs/what_was_tried.md)
_MAX_NEIGHBOURS = 3  # other views that a view is matched against

# A search near the surfaces of single views: hypotheses by level, and largest relative change of inverse depth by level
_SINGLE_VIEW_CANDIDATES, _SINGLE_VIEW_REACH = (33, 25, 17), (0.4, 0.2, 0.1)
_SINGLE_VIEW_PENALTY = 0.03  # matching cost of the largest change, which keeps walls without texture in place


@dataclass(frozen=True)
class SearchConfig:
    """Settings of the search."""

    finest_height: int = 512
    """Height of the finest level; larger panoramas are searched at this height."""
    near_single_views: bool = False
    """Search near the surfaces of single views only: for a depth network of better shapes than those of matches."""


@dataclass(frozen=True, eq=False)
class ObservedScene:
    """What the search is given.

    Attributes:
        depths: range of the depths of all hypotheses.
        neighbours: the other views that each view is matched against, best first.
        axes: axes (3, 3) of each view (`estimate_axes`).
        priors: priors of each view; empty if nothing can be matched, because there is one view or all are at one place.
        estimator: estimates the priors and the surfaces of single views; None without a prior model.
    """

    posed: PosedImages
    config: SearchConfig
    depths: DepthRange
    neighbours: list[list[int]]
    axes: Sequence[np.ndarray]
    priors: Sequence[Sequence[DepthPrior]] = ()
    estimator: PriorEstimator | None = None


def observe(
    posed: PosedImages,
    config: SearchConfig,
    prior_model: NetworkPrior | None = None,
) -> ObservedScene:
    """The depth range, neighbours, axes and priors of panoramas (v, h, 2h, 3)."""
    report_progress("finding the scene's axes", 0.0)
    height = min(posed.images.shape[1], config.finest_height)
    small = [resize_sphere(image, max(height // 2, 32)) for image in posed.images]
    axes = estimate_axes(small, posed.cam2world[:, :3, :3])
    low, high = 1 / posed.far, 1 / (_NEAR_MARGIN * posed.near)
    depths = DepthRange(low / _FAR_MARGIN, low, high)
    estimator = None
    if prior_model is not None:
        report_progress("estimating depth", 0.02)
        estimator = PriorEstimator(prior_model, posed.images, posed.cam2world, axes[0], (low, high))
    neighbours = choose_nearest(posed.cam2world, _MAX_NEIGHBOURS, 1 / high)
    if posed.measure_baseline(range(len(posed.images))) < ONE_POSITION * posed.near:
        return ObservedScene(posed, config, depths, neighbours, [axes] * len(posed.images), estimator=estimator)
    if estimator is not None:
        neighbours = estimator.choose_neighbours(_MAX_NEIGHBOURS)

    by_pair = {}  # grouped by the best neighbour: poses of further rooms may have another gravity
    pairs = list_best_pairs(neighbours)
    for pair in set(pairs) if len(posed.images) > 2 else ():
        turned = estimate_axes([small[n] for n in pair], posed.cam2world[list(pair), :3, :3])
        by_pair[pair] = turned[match_axes(turned, axes)]
    own_axes = [by_pair.get(pair, axes) for pair in pairs]
    report_progress("finding the cameras' heights", 0.15)
    priors: Sequence[Sequence[DepthPrior]] = [()] * len(posed.images)
    if estimator is not None:
        views = _make_views(posed, min(height, _SMALL_HEIGHT))
        priors = estimator.estimate_by_matching(views, neighbours)
    return ObservedScene(posed, config, depths, neighbours, own_axes, priors, estimator)


def search(scene: ObservedScene) -> list[Surface]:
    """The surface (h, 2h) of each view at the height of the finest level."""
    finest = min(scene.posed.images.shape[1], scene.config.finest_height)
    posed = scene.posed.resize(finest)
    if scene.priors:
        surfaces = _search(scene, posed)
    elif scene.estimator is not None:
        log_depths = [resize_sharp(log_depth, finest) for log_depth in scene.estimator.sharpen()]
        surfaces = [Surface(np.exp(-log_depth).clip(*scene.depths.limits)) for log_depth in log_depths]
    else:  # nothing is known: spheres in the middle of the range
        inverse = np.full((finest, 2 * finest), 0.5 * (1 / posed.near + 1 / posed.far), np.float32)
        return [Surface(inverse)] * len(posed.images)
    # A view alone is left by a step; others by a flight to the best neighbour.
    distances = measure_distances(posed.cam2world)
    baselines = [distances[view, others[0]] if others else 0.0 for view, others in enumerate(scene.neighbours)]
    return [
        Surface(make_whole(surface.inverse_depth, image, max(baseline, _LONE_STEP)).clip(*scene.depths.limits))
        for surface, image, baseline in zip(surfaces, posed.images, baselines, strict=True)
    ]


def _search(scene: ObservedScene, finest_posed: PosedImages) -> list[Surface]:
    """The surfaces of views that can be matched; `finest_posed` are those of the scene at the height of the result."""
    config, posed, depths = scene.config, scene.posed, scene.depths
    neighbours, estimator, finest = scene.neighbours, scene.estimator, finest_posed.images.shape[1]
    heights = [max(finest // 4, 16), max(finest // 2, 16), finest]
    if config.near_single_views:
        return _search_near_single_views(scene, heights)
    pixel = math.pi / heights[0] / (depths.high - depths.low)  # neighbouring candidates are a pixel of parallax apart
    baselines = [posed.measure_baseline([view, *others]) for view, others in enumerate(neighbours)]
    counts = [int(np.clip(math.ceil(baseline / pixel), 48, _MAX_CANDIDATES)) for baseline in baselines]
    report_progress("searching the whole depth range", 0.25)
    level = _SearchLevel(scene, heights[0])
    surfaces = [
        level.search_full_range(view, depths.sample(count), priors)
        for view, (count, priors) in enumerate(zip(counts, scene.priors, strict=True))
    ]
    for n, height in enumerate(heights[1:]):
        report_progress("refining the surfaces", 0.55 + 0.1 * n)
        surfaces = [
            guided_upsample(surface, resize_sphere(image, surface.height), resize_sphere(image, height))
            for surface, image in zip(surfaces, posed.images, strict=True)
        ]
        level = _SearchLevel(scene, height, surfaces)
        surfaces = [
            level.refine(view, _NARROW_CANDIDATES[n], depths.step(count) / 2 ** (n + 1), widen=n == 0)
            for view, count in enumerate(counts)
        ]
    if estimator is None:
        return surfaces
    sharp = [resize_sphere(log_depth, finest) for log_depth in estimator.sharpen()]
    return bend_surfaces(finest_posed, surfaces, neighbours, sharp)


def _search_near_single_views(scene: ObservedScene, heights: Sequence[int]) -> list[Surface]:
    """The surfaces of single views, bent at each level by a search near them."""
    posed = scene.posed
    assert scene.estimator is not None
    log_depths, bent = [], []
    for sharp, (prior, *_) in zip(scene.estimator.sharpen(), scene.priors, strict=True):
        log_factor = np.median(prior.log_depth - resize_sphere(sharp, len(prior.log_depth)))
        log_depths.append((sharp + log_factor).astype(np.float32))
    for n, height in enumerate(heights):
        report_progress("searching near the estimated depth", 0.25 + 0.15 * n)
        small = [resize_sharp(log_depth, height) for log_depth in log_depths]
        level = _SearchLevel(scene, height, [Surface(np.exp(-log_depth)) for log_depth in small])
        found = [level.refine_near(view, n) for view in range(len(small))]
        bent = bend_surfaces(posed.resize(height), found, scene.neighbours, small)
        log_depths = [
            log_depth + resize_sphere(-np.log(surface.inverse_depth) - start, len(log_depth))
            for log_depth, surface, start in zip(log_depths, bent, small, strict=True)
        ]
    return bent


def choose_nearest(cam2world: np.ndarray, count: int, least: float) -> list[list[int]]:
    """The other views of each view, the nearest cameras first, at most `count`; those within `least` metres last."""
    distances = measure_distances(cam2world).round(6)  # rounded: in a grid, equal distances differ in their last digits
    distances[distances < least] += distances.max()
    np.fill_diagonal(distances, -1)
    return distances.argsort(axis=1, kind="stable")[:, 1 : count + 1].tolist()


def _make_views(posed: PosedImages, height: int, surfaces: Sequence[Surface] = ()) -> list[View]:
    """What is matched of each view at a height."""
    images, masks = [resize_sphere(i, height) for i in posed.images], [resize_mask(m, height) for m in posed.masks]
    known = [surface.inverse_depth for surface in surfaces] or [None] * len(images)
    return list(map(View, images, masks, known))


class _SearchLevel:
    """All views at the height of one level of the search, with the surfaces found so far, if any."""

    def __init__(self, scene: ObservedScene, height: int, surfaces: Sequence[Surface] = ()) -> None:
        self.posed, self.height, self.limits = scene.posed, height, scene.depths.limits
        self.surfaces, self.neighbours, self.axes = surfaces, scene.neighbours, scene.axes
        self.views = _make_views(scene.posed, height, surfaces)

    def search_full_range(self, view: int, inverse: np.ndarray, priors: Sequence[DepthPrior]) -> Surface:
        """The best hypotheses: spheres of inverse depths (set 0) and planes across the axes (sets 1 to 3)."""
        low, step, count = inverse[0], inverse[1] - inverse[0], len(inverse)
        rays = axis_components(self.axes[view], self.posed.cam2world[view, :3, :3], self.height)
        slopes = [np.ones(rays.shape[1:], np.float32), *np.abs(rays).astype(np.float32)]
        sides = [np.zeros(rays.shape[1:], np.uint8), *(rays > 0).astype(np.uint8)]
        no_penalty = np.zeros(count, np.float32)
        sets = [
            HypothesisSet(low * slope, step * slope, no_penalty, side, sphere=n == 0)
            for n, (slope, side) in enumerate(zip(slopes, sides, strict=True))
        ]
        # Factor and offset from each set's hypothesis number to a depth slot that all share (`aggregate_costs`).
        slot_map = np.stack([np.stack((s, (s - 1) * low / step + 0.5), axis=-1) for s in slopes], axis=2)
        cost = self._compute_cost(view, lambda other: self._mark_separating_planes(view, other, sets, inverse))
        if priors:
            apply_prior_cost(cost, [prior.resize(self.height) for prior in priors], sets)
        return self._select_hypotheses(view, sets, cost, slot_map.astype(np.float32), count)

    def _mark_separating_planes(
        self, view: int, other: int, sets: list[HypothesisSet], inverse: np.ndarray
    ) -> list[HypothesisSet]:
        """Copies of the sets in which the planes that separate the two views are back-facing."""
        pose, there = self.posed.cam2world[[view, other]]
        marks = [None] + [mark_separating_planes(axis, pose, there, inverse) for axis in self.axes[view]]
        return [dataclasses.replace(s, back_facing=m) for s, m in zip(sets, marks, strict=True)]

    def refine(self, view: int, count: int, step: float, *, widen: bool) -> Surface:
        """The best hypotheses near the surface; with `widen` also near the depths of neighbouring pixels."""
        known = self.surfaces[view].inverse_depth
        centres = [known]
        if widen:
            window = np.ones((5, 5), np.uint8)
            centres += [cv2.dilate(known, window), cv2.erode(known, window)]
        return self._refine(view, centres, np.full(known.shape, step, np.float32), np.zeros(count, np.float32))

    def refine_near(self, view: int, level: int) -> Surface:
        """The best hypotheses near the surface, in steps of relative depth; changes have a penalty."""
        count = _SINGLE_VIEW_CANDIDATES[level]
        change = np.linspace(-1, 1, count, dtype=np.float32)
        known = self.surfaces[view].inverse_depth
        steps = known * np.float32(2 * _SINGLE_VIEW_REACH[level] / (count - 1))
        return self._refine(view, [known], steps, _SINGLE_VIEW_PENALTY * np.abs(change))

    def _refine(self, view: int, centres: list[np.ndarray], step: np.ndarray, penalty: np.ndarray) -> Surface:
        """The best of hypotheses a step (h, w) apart around each of some surfaces, with a penalty (count) each."""
        known, count = self.surfaces[view].inverse_depth, len(penalty)
        sets = [HypothesisSet((c - step * (count // 2)).astype(np.float32), step, penalty) for c in centres]
        slots = 2 * count
        # Far beyond the slots an offset has no meaning, and must fit an integer.
        starts = np.stack([np.clip((c - known) / step, -4 * slots, 4 * slots) + count / 2 for c in centres], axis=2)
        slot_map = np.stack((np.ones_like(starts), starts), axis=-1).astype(np.float32)
        cost = self._compute_cost(view, lambda other: sets)
        return self._select_hypotheses(view, sets, cost, slot_map, slots)

    def _compute_cost(self, view: int, make_sets: Callable[[int], list[HypothesisSet]]) -> np.ndarray:
        """Matching cost (h, w, sets * count) by the neighbours, of the sets that `make_sets(other)` returns."""
        others = [
            OtherView(self.views[other], self.posed.relative_pose(view, other), make_sets(other))
            for other in self.neighbours[view]
        ]
        return compute_matching_cost(self.views[view], others, self.limits)

    def _select_hypotheses(
        self, view: int, sets: list[HypothesisSet], cost: np.ndarray, slot_map: np.ndarray, slots: int
    ) -> Surface:
        """The surface of lowest aggregated cost."""
        count = len(sets[0].penalty)
        total = aggregate_costs(cost, self.views[view].image, slot_map, slots)
        label, offset = select_labels(total, count)
        chosen, k = label // count, label % count
        base = np.stack([s.base for s in sets], axis=-1)
        step = np.stack([s.step for s in sets], axis=-1)
        rows, columns = np.indices(label.shape)
        inverse = base[rows, columns, chosen] + (k + offset) * step[rows, columns, chosen]
        return Surface(np.clip(inverse, *self.limits).astype(np.float32))
