"""The hierarchical plane sweep: from posed panoramas to a surface for each of them.

First pixels vote for the planes that the scene has, and each picture shows where its floor ends and walls stand.
Then come three levels, as in the paper's hierarchical cost volume (PanSplat, section 3.2), at 1/4, 1/2 and 1/1 of
the height.
The coarse level searches the whole depth range among spheres and among planes along the scene's axes, twice: the
second time every view knows the other views' surfaces (what they see through, agree with, or hide) and which
planes the scene has. Each finer level searches a narrow range around the coarser surface.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from pansplat.sweep.aggregate import AggregationConfig, aggregate, best_labels
from pansplat.sweep.cost import Family, MatchingConfig, View, matching_cost
from pansplat.sweep.floor import FloorClues, FloorConfig, add_clues, find_floor
from pansplat.sweep.frame import main_directions, scene_axes
from pansplat.sweep.planes import MIN_FLOOR, PlaneSupport, no_support, plane_support
from pansplat.sweep.sphere import resize_sphere
from pansplat.sweep.surface import Surface, agreement, guided_upsample
from pansplat.sweep.votes import vote_for_planes
from pansplat.sweep.walls import Walls, add_walls, believe, find_walls

_FIRST_HEIGHT = 128
_FLOOR_THICKNESS = 2.5  # bins of the planes' offsets


@dataclass(frozen=True)
class SearchConfig:
    """How the sweep searches."""

    finest_height: int = 512
    """Height of the finest level; larger panoramas are searched at this height."""
    coarse_passes: int = 2
    max_candidates: int = 256
    """Hypotheses of one family at the coarse level, at most."""
    near_margin: float = 0.75
    """Surfaces are searched down to this fraction of `near`."""
    narrow_candidates: tuple[int, int] = (24, 16)
    """Hypotheses of one family at the two finer levels."""
    unsure_confidence: float = 0.1
    """What a surface that no other view agrees with may say about the other views' hypotheses."""
    plane_prior: float = 0.3
    """Penalty of a plane that the scene gives no support."""
    sphere_prior: float = 0.18
    """Penalty of hypotheses that are no plane."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    aggregation: AggregationConfig = field(default_factory=AggregationConfig)
    floor: FloorConfig = field(default_factory=FloorConfig)


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Input of the search: images (v, h, w, 3) float32, poses (v, 4, 4), masks (v, h, w) bool, depth range."""

    images: np.ndarray
    cam2world: np.ndarray
    masks: np.ndarray
    near: float
    far: float

    def relative_pose(self, view: int, other: int) -> np.ndarray:
        """Pose (4, 4) from `view`'s camera to `other`'s."""
        return np.linalg.inv(self.cam2world[other]) @ self.cam2world[view]

    @property
    def baseline(self) -> float:
        """Largest distance between two cameras, metres."""
        centres = self.cam2world[:, :3, 3]
        return float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())


def search_surfaces(posed: PosedImages, config: SearchConfig, report: Callable[[str, float], None]) -> list[Surface]:
    """The surface that each view sees, at the finest level."""
    finest = min(posed.images.shape[1], config.finest_height)
    small = [resize_sphere(image, max(finest // 2, 32)) for image in posed.images]
    axes = scene_axes(small, posed.cam2world[:, :3, :3])
    heights = [max(finest // 4, 16), max(finest // 2, 16), finest]
    if posed.baseline < 1e-3 * posed.near:
        return [_no_parallax(finest, posed) for _ in posed.images]
    surfaces: list[Surface] | None = None
    low, high = 1 / posed.far, 1 / (config.near_margin * posed.near)
    steps = (high - low) * posed.baseline / (math.pi / heights[0])  # candidates a pixel of parallax apart
    count = int(np.clip(math.ceil(steps), 48, config.max_candidates))
    step = (high - low) / (count - 1)
    report("finding floor, ceiling and walls", 0.0)
    support = no_support(posed.cam2world, axes, posed.near, posed.far)
    first = _Level(posed, min(finest, _FIRST_HEIGHT), support, (low, high), config, None)
    support = first.vote()
    floors = first.find_floor(support)
    clues = floors and [
        (floor, find_walls(floor, support.floor_below(pose), posed.far))
        for floor, pose in zip(floors, posed.cam2world, strict=True)
    ]
    for n in range(config.coarse_passes):
        report("searching the whole depth range", 0.1 + 0.4 * n / config.coarse_passes)
        level = _Level(posed, heights[0], support, (low, high), config, surfaces)
        surfaces = [level.search_all(view, count, clues and clues[view]) for view in range(len(posed.images))]
    for n, height in enumerate(heights[1:]):
        report("refining the surfaces", 0.5 + 0.25 * n)
        assert surfaces is not None
        surfaces = [
            guided_upsample(s, resize_sphere(image, s.height), resize_sphere(image, height))
            for s, image in zip(surfaces, posed.images, strict=True)
        ]
        step /= 2
        level = _Level(posed, height, support, (low, high), config, surfaces)
        surfaces = [
            level.search_near(view, config.narrow_candidates[n], step, spread=n == 0)
            for view in range(len(posed.images))
        ]
    assert surfaces is not None
    return surfaces


def _no_parallax(height: int, posed: PosedImages) -> Surface:
    """Where cameras coincide nothing can be matched: the middle of the inverse depth range."""
    inverse = np.full((height, 2 * height), 0.5 * (1 / posed.near + 1 / posed.far), np.float32)
    return Surface(inverse, np.zeros(inverse.shape, np.uint8))


class _Level:
    """All views at one height, with what is known of their surfaces so far."""

    def __init__(
        self,
        posed: PosedImages,
        height: int,
        support: PlaneSupport,
        limits: tuple[float, float],
        config: SearchConfig,
        surfaces: list[Surface] | None,
    ) -> None:
        self.posed, self.height, self.limits, self.config, self.surfaces = (
            posed,
            height,
            limits,
            config,
            surfaces,
        )
        self.rays = [main_directions(support.axes, pose[:3, :3], height) for pose in posed.cam2world]
        self.support = support
        masks = [
            cv2.resize(mask.astype(np.uint8), (2 * height, height), interpolation=cv2.INTER_NEAREST) > 0
            for mask in posed.masks
        ]
        confidence: list[np.ndarray | None] = [None] * len(masks)
        if surfaces is not None:
            agreed = [agreement(surfaces, posed.cam2world, view) & mask for view, mask in enumerate(masks)]
            confidence = [np.where(a, 1, config.unsure_confidence).astype(np.float32) for a in agreed]
            self.support = plane_support(surfaces, agreed, posed.cam2world, support)
        self.views = [
            View(
                resize_sphere(image, height),
                mask,
                np.ascontiguousarray(rays[0], np.float32),
                None if surfaces is None else surfaces[n].inverse_depth,
                confidence[n],
            )
            for n, (image, mask, rays) in enumerate(zip(posed.images, masks, self.rays, strict=True))
        ]

    def vote(self) -> PlaneSupport:
        """What the pixels of all views say about the scene's planes."""
        return vote_for_planes(
            self.views, self.rays, self.posed.cam2world, self.support, self.limits,
            MIN_FLOOR * self.posed.near, self.config.matching,
        )  # fmt: skip

    def find_floor(self, support: PlaneSupport) -> list[FloorClues] | None:
        """What each picture says of the floor."""
        return find_floor(self.views, self.rays, self.posed.cam2world, support, self.config.matching)

    def search_all(self, view: int, count: int, clues: tuple[FloorClues, Walls] | None) -> Surface:
        """The whole depth range, among spheres (family 0) and planes along the axes (families 1 to 3)."""
        low, high = self.limits
        step = (high - low) / (count - 1)
        shape = (self.height, 2 * self.height)
        slopes = [np.ones(shape, np.float32)] + [np.abs(r).astype(np.float32) for r in self.rays[view]]
        sides = [np.zeros(shape, np.uint8)] + [(r > 0).astype(np.uint8) for r in self.rays[view]]
        inverse = low + step * np.arange(count)
        penalties = [np.zeros((2, count), np.float32) for _ in slopes]
        if self.surfaces is not None:  # the first pass is to find what is no plane, too
            penalties[0] += self.config.sphere_prior
            for axis in range(3):
                penalties[axis + 1] = self.config.plane_prior * (
                    1 - self.support.share(axis, self.posed.cam2world[view], inverse)
                )
        families = [
            Family(low * slope, step * slope, penalty.astype(np.float32), side)
            for slope, penalty, side in zip(slopes, penalties, sides, strict=True)
        ]
        slot_map = np.stack([np.stack((s, (s - 1) * low / step + 0.5), axis=-1) for s in slopes], axis=2)
        cost = self._matched(view, lambda other: self._faces(view, other, families, inverse))
        if clues is not None:
            below = self.support.floor_below(self.posed.cam2world[view])
            is_floor = np.abs(1 / inverse - below) < _FLOOR_THICKNESS * self.support.bin
            add_clues(cost, clues[0], families, is_floor, self.rays[view], self.config.floor)
            if self.surfaces is not None:
                self._add_walls(view, *clues, families, cost)
        return self._solve(view, families, cost, slot_map.astype(np.float32), count)

    def _add_walls(self, view: int, clues: FloorClues, walls: Walls, families: list[Family], cost: np.ndarray) -> None:
        """Make the walls cheaper that the picture shows and the surfaces so far do not contradict."""
        known, agreed = self.views[view].inverse_depth, self.views[view].confidence
        assert known is not None and agreed is not None
        walls = believe(walls, clues, self.rays[view], known, agreed == 1)
        _, ceiling = self.support.bounds(self.posed.cam2world[view])
        add_walls(cost, walls, clues, families, self.rays[view], ceiling, self.config.floor.wall_bonus)

    def _faces(self, view: int, other: int, families: list[Family], inverse: np.ndarray) -> list[Family]:
        """The families, with which of their planes the other view would see from behind."""
        pose, there = self.posed.cam2world[[view, other]]
        unseen = [None] + [self.support.backs(axis, pose, there, inverse) for axis in range(3)]
        return [dataclasses.replace(f, unseen=u, sphere=u is None) for f, u in zip(families, unseen, strict=True)]

    def search_near(self, view: int, count: int, step: float, *, spread: bool) -> Surface:
        """A narrow range around the surface so far; with `spread` also around its neighbours' near and far side."""
        assert self.surfaces is not None
        known = self.surfaces[view].inverse_depth
        centres = [known]
        if spread:
            window = np.ones((5, 5), np.uint8)
            centres += [cv2.dilate(known, window), cv2.erode(known, window)]
        steps = np.full(known.shape, step, np.float32)
        side = np.zeros(known.shape, np.uint8)
        penalty = np.zeros((2, count), np.float32)
        families = [Family((c - step * (count // 2)).astype(np.float32), steps, penalty, side) for c in centres]
        slots = 2 * count
        starts = np.stack([np.clip((c - known) / step, -4 * slots, 4 * slots) + count / 2 for c in centres], axis=2)
        slot_map = np.stack((np.ones_like(starts), starts), axis=-1).astype(np.float32)
        cost = self._matched(view, lambda other: families)
        surface = self._solve(view, families, cost, slot_map, slots)
        return Surface(surface.inverse_depth, self.surfaces[view].family)

    def _matched(self, view: int, families: Callable[[int], list[Family]]) -> np.ndarray:
        """Mean cost (h, w, families * count) against every other view; `families` are those to compare it by."""
        others = [n for n in range(len(self.views)) if n != view]
        bounds = self.support.bounds(self.posed.cam2world[view])
        cost: np.ndarray | None = None
        for other in others:
            part = matching_cost(
                self.views[view], self.views[other], self.posed.relative_pose(view, other),
                families(other), self.limits, bounds, self.config.matching,
            )  # fmt: skip
            cost = part if cost is None else cost + part
        assert cost is not None
        if len(others) > 1:
            cost /= len(others)
        return cost

    def _solve(self, view: int, families: list[Family], cost: np.ndarray, slot_map: np.ndarray, slots: int) -> Surface:
        """Aggregate, and read the best hypothesis off."""
        count = families[0].penalty.shape[1]
        total = aggregate(cost, self.views[view].image, slot_map, slots, self.config.aggregation)
        label, offset = best_labels(total, count)
        family, k = label // count, label % count
        base = np.stack([f.base for f in families], axis=-1)
        step = np.stack([f.step for f in families], axis=-1)
        rows, columns = np.indices(label.shape)
        inverse = base[rows, columns, family] + (k + offset) * step[rows, columns, family]
        return Surface(np.clip(inverse, *self.limits).astype(np.float32), family.astype(np.uint8))
