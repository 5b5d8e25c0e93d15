"""The hierarchical sphere sweep: from posed panoramas to one surface per view.

The scene's planes are detected first. Three levels of matching follow at 1/4, 1/2 and 1/1 of the height, as in the
paper's hierarchical cost volume (PanSplat, section 3.2). The coarse level searches the whole depth range with spheres
and with planes across the scene's axes. It runs twice: the first pass, at a smaller size, finds the surfaces which the
second one uses for occlusion, consistency between views, and the support of planes. Each finer level searches a narrow
range around the coarser surface. With a prior, the surfaces of the finest level and of the result are those of single
views, bent by the matches (`bend`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import cv2
import numpy as np

from pansplat.rendering.cpu.runtime import thread_count
from pansplat.sweep.bend import BendConfig, bend_surfaces
from pansplat.sweep.matching import (
    AggregationConfig,
    DepthRange,
    HypothesisSet,
    MatchingConfig,
    OtherView,
    View,
    aggregate_costs,
    compute_matching_cost,
    select_labels,
)
from pansplat.sweep.planes import (
    MIN_FLOOR,
    ScenePlanes,
    axis_components,
    collect_planes,
    detect_planes,
    estimate_axes,
    make_empty_planes,
    match_axes,
)
from pansplat.sweep.prior import DepthPrior, PriorConfig, PriorEstimator, PriorModel, apply_prior_cost
from pansplat.sweep.surface import (
    PosedImages,
    Surface,
    consistency_mask,
    guided_upsample,
    list_best_pairs,
    measure_distances,
    resize_mask,
    resize_nearest,
    resize_sphere,
)

_DETECTION_HEIGHT = 96  # pixels; planes are detected at this size


@dataclass(frozen=True)
class SearchConfig:
    """Settings of the search."""

    finest_height: int = 512
    """Height of the finest level; larger panoramas are searched at this height."""
    coarse_passes: int = 2
    first_height: int = 64
    """Largest height of the passes before the last one."""
    max_candidates: int = 256
    """Largest number of hypotheses of a set at the coarse level."""
    near_margin: float = 0.75
    """The smallest depth of the search, relative to `near`."""
    far_margin: float = 10.0
    """The largest depth of the search, relative to `far`: rooms are often larger than the range that was given."""
    narrow_candidates: tuple[int, int] = (16, 8)
    """Hypotheses of a set at the two finer levels."""
    plane_prior: float = 0.3
    """Penalty of a plane without support in the scene."""
    sphere_prior: float = 0.18
    """Penalty of spheres relative to supported planes."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    aggregation: AggregationConfig = field(default_factory=AggregationConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    bend: BendConfig = field(default_factory=BendConfig)
    max_neighbours: int = 3
    """Other views, at most, that a view is matched against."""


def search_surfaces(
    posed: PosedImages,
    config: SearchConfig,
    report: Callable[[str, float], None],
    prior_model: PriorModel | None = None,
) -> tuple[list[Surface], list[list[int]]]:
    """The surface of each view, at the finest level, and the other views that it was matched against, best first."""
    report("finding the scene's axes", 0.0)
    finest = min(posed.images.shape[1], config.finest_height)
    small = [resize_sphere(image, max(finest // 2, 32)) for image in posed.images]
    axes = estimate_axes(small, posed.cam2world[:, :3, :3])
    heights = [max(finest // 4, 16), max(finest // 2, 16), finest]
    surfaces: list[Surface] | None = None
    low, high = 1 / posed.far, 1 / (config.near_margin * posed.near)
    depths = DepthRange(low / config.far_margin, low, high)
    empty = make_empty_planes(posed.cam2world, axes, posed.near, 1 / depths.farthest)
    height, everywhere = min(finest, _DETECTION_HEIGHT), [empty] * len(posed.images)
    detection = _SearchLevel(posed, height, everywhere, depths.limits, config, [], None)
    estimator = None
    if prior_model is not None:
        report("estimating depth", 0.02)
        estimator = PriorEstimator(prior_model, posed.images, posed.cam2world, axes[0], config.prior)
    neighbours = choose_nearest(posed.cam2world, config.max_neighbours, 1 / high)
    # One view, or views at one place: nothing can be matched.
    if posed.measure_baseline(range(len(posed.images))) < 1e-3 * posed.near:
        return _place_unmatched(posed, finest, depths, estimator), neighbours
    if estimator is not None:
        neighbours = estimator.choose_neighbours((low, high), config.max_neighbours)

    def find_planes() -> list[ScenePlanes]:
        by_pair = {}  # with the best neighbour: poses of further rooms may have another gravity
        pairs = list_best_pairs(neighbours)
        for pair in set(pairs):
            poses = posed.cam2world[list(pair)]
            start = empty
            if len(posed.images) > len(pair):
                own = estimate_axes([small[n] for n in pair], poses[:, :3, :3])
                start = dataclasses.replace(empty, axes=own[match_axes(own, axes)])
            rays = [axis_components(start.axes, pose[:3, :3], detection.height) for pose in poses]
            views = [detection.views[n] for n in pair]
            by_pair[pair] = detect_planes(views, rays, poses, start, depths, MIN_FLOOR * posed.near, config.matching)
        return [by_pair[pair] for pair in pairs]

    def estimate_priors() -> Sequence[Sequence[DepthPrior]]:
        if estimator is None:
            return [()] * len(posed.images)
        return estimator.estimate_by_matching(detection.views, neighbours, (low, high), config.matching)

    report("finding planes", 0.05)
    if thread_count() > 1:  # half of each is work of one thread
        with ThreadPoolExecutor(1) as pool:
            estimated = pool.submit(estimate_priors)
            planes, priors = find_planes(), estimated.result()
    else:
        planes, priors = find_planes(), estimate_priors()
    pixel = math.pi / heights[0] / (high - low)  # candidates are a pixel of parallax apart
    baselines = [posed.measure_baseline([view, *others]) for view, others in enumerate(neighbours)]
    counts = [int(np.clip(math.ceil(baseline / pixel), 48, config.max_candidates)) for baseline in baselines]
    for n in range(config.coarse_passes):
        report("searching the whole depth range", 0.1 + 0.4 * n / config.coarse_passes)
        if estimator is not None and surfaces is not None:
            priors = estimator.estimate_from_surfaces(surfaces)
        rows = heights[0] if n == config.coarse_passes - 1 else min(heights[0], config.first_height)
        if surfaces is not None:
            surfaces = _upsample(surfaces, posed.images, rows)
        level = _SearchLevel(posed, rows, planes, depths.limits, config, neighbours, surfaces)
        surfaces = [level.search_full_range(view, depths.sample(counts[view]), own) for view, own in enumerate(priors)]
    sharp, finest_posed = None, posed
    if estimator is not None:
        sharp = [resize_sphere(log_depth, finest) for log_depth in estimator.sharpen((low, high))]
        finest_posed = posed.resize(finest)
    for n, height in enumerate(heights[1:]):
        report("refining the surfaces", 0.5 + 0.25 * n)
        assert surfaces is not None
        surfaces = _upsample(surfaces, posed.images, height)
        if sharp is not None and height == finest:
            surfaces = bend_surfaces(finest_posed, surfaces, neighbours, sharp, config.bend)
        level = _SearchLevel(posed, height, planes, depths.limits, config, neighbours, surfaces)
        surfaces = [
            level.refine(view, config.narrow_candidates[n], depths.step(count) / 2 ** (n + 1), widen=n == 0)
            for view, count in enumerate(counts)
        ]
    assert surfaces is not None
    if sharp is not None:
        surfaces = bend_surfaces(finest_posed, surfaces, neighbours, sharp, config.bend)
    return surfaces, neighbours


def _upsample(surfaces: list[Surface], images: np.ndarray, height: int) -> list[Surface]:
    """The surfaces at a height, guided by their photographs."""
    return [
        s if s.height == height else guided_upsample(s, resize_sphere(image, s.height), resize_sphere(image, height))
        for s, image in zip(surfaces, images, strict=True)
    ]


def choose_nearest(cam2world: np.ndarray, count: int, least: float) -> list[list[int]]:
    """The other views of each view, the nearest cameras first, at most `count`; those within `least` metres last."""
    distances = measure_distances(cam2world)
    distances[distances < least] += distances.max()
    np.fill_diagonal(distances, -1)
    return distances.argsort(axis=1, kind="stable")[:, 1 : count + 1].tolist()


def _place_unmatched(
    posed: PosedImages, height: int, depths: DepthRange, estimator: PriorEstimator | None
) -> list[Surface]:
    """Surfaces of the prior alone; without a prior, spheres in the middle of the range."""
    shape = (height, 2 * height)
    if estimator is None:
        inverse = np.full((len(posed.images), *shape), 0.5 * (1 / posed.near + 1 / posed.far))
    else:
        sharp = estimator.sharpen((depths.low, depths.high))
        inverse = np.stack([np.exp(-resize_nearest(values, height)) for values in sharp]).clip(*depths.limits)
    return [Surface(values.astype(np.float32), np.zeros(shape, np.uint8)) for values in inverse]


class _SearchLevel:
    """All views at the height of one level of the search, with the surfaces found so far."""

    def __init__(
        self,
        posed: PosedImages,
        height: int,
        planes: Sequence[ScenePlanes],
        limits: tuple[float, float],
        config: SearchConfig,
        neighbours: Sequence[Sequence[int]],
        surfaces: list[Surface] | None,
    ) -> None:
        self.posed, self.height, self.limits, self.config, self.surfaces = posed, height, limits, config, surfaces
        self.neighbours = neighbours
        self.rays = [
            axis_components(own.axes, pose[:3, :3], height) for own, pose in zip(planes, posed.cam2world, strict=True)
        ]
        self.planes = planes
        masks = [resize_mask(mask, height) for mask in posed.masks]
        self.consistent: list[np.ndarray] = []
        if surfaces is not None:
            self.consistent = [
                consistency_mask(surfaces, posed.cam2world, n, neighbours[n]) & mask for n, mask in enumerate(masks)
            ]
            groups = [[view, *others] for view, others in enumerate(neighbours)]
            self.planes = [
                collect_planes(
                    *([maps[n] for n in group] for maps in (surfaces, self.consistent)), posed.cam2world[group], own
                )
                for group, own in zip(groups, planes, strict=True)
            ]
        self.views = [
            View(
                resize_sphere(image, height),
                mask,
                np.ascontiguousarray(rays[0], np.float32),
                None if surfaces is None else surfaces[n].inverse_depth,
            )
            for n, (image, mask, rays) in enumerate(zip(posed.images, masks, self.rays, strict=True))
        ]

    def search_full_range(self, view: int, inverse: np.ndarray, priors: Sequence[DepthPrior]) -> Surface:
        """The best hypotheses: spheres of inverse depths (set 0) and planes across the axes (sets 1 to 3)."""
        low, step, count = inverse[0], inverse[1] - inverse[0], len(inverse)
        shape = (self.height, 2 * self.height)
        slopes = [np.ones(shape, np.float32)] + [np.abs(r).astype(np.float32) for r in self.rays[view]]
        sides = [np.zeros(shape, np.uint8)] + [(r > 0).astype(np.uint8) for r in self.rays[view]]
        penalties = [np.zeros((2, count), np.float32) for _ in slopes]
        if self.surfaces is not None:  # the first pass has no priors, so that other shapes are found too
            penalties[0] += self.config.sphere_prior
            for axis in range(3):
                penalties[axis + 1] = self.config.plane_prior * (
                    1 - self.planes[view].support(axis, self.posed.cam2world[view], inverse)
                )
        sets = [
            HypothesisSet(low * slope, step * slope, penalty.astype(np.float32), side)
            for slope, penalty, side in zip(slopes, penalties, sides, strict=True)
        ]
        slot_map = np.stack([np.stack((s, (s - 1) * low / step + 0.5), axis=-1) for s in slopes], axis=2)
        cost = self._compute_cost(view, lambda other: self._mark_separating_planes(view, other, sets, inverse))
        if priors:
            apply_prior_cost(cost, [prior.resize(self.height) for prior in priors], sets, self.config.prior)
        return self._select_hypotheses(view, sets, cost, slot_map.astype(np.float32), count)

    def _mark_separating_planes(
        self, view: int, other: int, sets: list[HypothesisSet], inverse: np.ndarray
    ) -> list[HypothesisSet]:
        """Copies of the sets in which the planes that separate the two views are back-facing."""
        pose, there = self.posed.cam2world[[view, other]]
        marks = [None] + [self.planes[view].separating(axis, pose, there, inverse) for axis in range(3)]
        return [dataclasses.replace(s, back_facing=m, sphere=m is None) for s, m in zip(sets, marks, strict=True)]

    def refine(self, view: int, count: int, step: float, *, widen: bool) -> Surface:
        """The best hypotheses near the surface; with `widen` also near the depths of neighbouring pixels."""
        assert self.surfaces is not None
        known = self.surfaces[view].inverse_depth
        centres = [known]
        if widen:
            window = np.ones((5, 5), np.uint8)
            centres += [cv2.dilate(known, window), cv2.erode(known, window)]
        steps = np.full(known.shape, step, np.float32)
        side = np.zeros(known.shape, np.uint8)
        penalty = np.zeros((2, count), np.float32)
        sets = [HypothesisSet((c - step * (count // 2)).astype(np.float32), steps, penalty, side) for c in centres]
        slots = 2 * count
        starts = np.stack([np.clip((c - known) / step, -4 * slots, 4 * slots) + count / 2 for c in centres], axis=2)
        slot_map = np.stack((np.ones_like(starts), starts), axis=-1).astype(np.float32)
        cost = self._compute_cost(view, lambda other: sets)
        surface = self._select_hypotheses(view, sets, cost, slot_map, slots)
        return Surface(surface.inverse_depth, self.surfaces[view].orientation)

    def _compute_cost(self, view: int, make_sets: Callable[[int], list[HypothesisSet]]) -> np.ndarray:
        """Matching cost (h, w, sets * count) by the neighbours, of the sets that `make_sets(other)` returns."""
        bounds = self.planes[view].vertical_bounds(self.posed.cam2world[view])
        others = [
            OtherView(self.views[other], self.posed.relative_pose(view, other), make_sets(other))
            for other in self.neighbours[view]
        ]
        return compute_matching_cost(self.views[view], others, self.limits, bounds, self.config.matching)

    def _select_hypotheses(
        self, view: int, sets: list[HypothesisSet], cost: np.ndarray, slot_map: np.ndarray, slots: int
    ) -> Surface:
        """The surface of lowest aggregated cost."""
        count = sets[0].penalty.shape[1]
        total = aggregate_costs(cost, self.views[view].image, slot_map, slots, self.config.aggregation)
        label, offset = select_labels(total, count)
        chosen, k = label // count, label % count
        base = np.stack([s.base for s in sets], axis=-1)
        step = np.stack([s.step for s in sets], axis=-1)
        rows, columns = np.indices(label.shape)
        inverse = base[rows, columns, chosen] + (k + offset) * step[rows, columns, chosen]
        return Surface(np.clip(inverse, *self.limits).astype(np.float32), chosen.astype(np.uint8))
