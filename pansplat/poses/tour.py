"""Poses of many panoramas from the relative poses of their pairs.

The tour grows from the best pair: the panorama with the strongest relations to the placed ones is added, with the
scale of its distance by points that placed panoramas see, and all poses are adjusted together. Pairs that contradict
the others around triangles are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from pansplat.poses.bundle import Problem, adjust, point_depths, residual_angles, triangulate
from pansplat.poses.features import Features
from pansplat.poses.solvers import rotation_angle, two_view_depths
from pansplat.poses.two_view import RelativePose

Pair = tuple[int, int]
FloorHeight = Callable[[Pair], float | None]
"""Height of the cameras of a pair over the floor in units of their distance; None if no floor is found."""

_LARGEST_LOOP = math.radians(4)  # rotation around a triangle of right pairs
_MIN_SHARED = 3  # points that determine the distance of a new panorama
_MIN_PARALLAX = math.radians(1.0)  # of such a point
_OUTLIER = 8.0  # residual of an observation that is left out, in the noise's standard deviation
_FEW_JOINT = 40  # points with two other panoramas, below which the floor contributes to the distance of a panorama
_FLOOR_PAIRS = 5  # whose floors give the height of the cameras in the tour's unit
_ROUNDS = 3  # of adjustment and removal of outliers


@dataclass(frozen=True, eq=False)
class Tour:
    """Placed panoramas in a world of arbitrary orientation and unit.

    Attributes:
        placed: indices of the panoramas that have a pose.
        poses: cam2world of the placed panoramas, in that order.
        depths: distances of the points from the cameras that observe them.
        angles: residuals of these observations, radians.
        rejected: pairs that contradict the others.
        unplaced: for each panorama without a pose the reason, and the other panorama of its best pair.
    """

    placed: tuple[int, ...]
    poses: Float[Array, "placed 4 4"]
    depths: Float[Array, "observation"]
    angles: Float[Array, "observation"]
    rejected: tuple[Pair, ...]
    unplaced: dict[int, tuple[str, int | None]]


def build_tour(
    features: Sequence[Features],
    relations: Mapping[Pair, RelativePose],
    downs: Float[Array, "view 3"],
    noise: float,
    floor_height: FloorHeight = lambda pair: None,
) -> Tour:
    """Poses of the largest group of panoramas that reliable pairs connect.

    Args:
        features: of all panoramas.
        relations: of the pairs (i, j), i < j, that were compared.
        downs: gravity in each camera's frame; NaN where unknown.
        noise: standard deviation of a bearing, radians.
        floor_height: by which a panorama is placed whose distance no points determine.
    """
    reliable = {pair: relation for pair, relation in relations.items() if relation.is_reliable}
    rejected = _find_contradictions(reliable)
    reliable = {pair: relation for pair, relation in reliable.items() if pair not in rejected}
    count = len(features)
    if not reliable:
        return Tour(
            (), np.empty((0, 4, 4)), np.empty(0), np.empty(0), rejected,
            {view: _describe_failure(view, relations, rejected) for view in range(count)},
        )  # fmt: skip
    growing = _GrowingTour(_make_tracks(features, reliable), reliable, downs, noise, floor_height)
    growing.grow()
    problem, placed = growing.with_distances(), growing.placed
    for _ in range(_ROUNDS if len(placed) > 2 else 1):
        if len(placed) > 2:
            problem = adjust(problem, noise)
        problem = problem.select(residual_angles(problem) < _OUTLIER * noise)
    poses = np.tile(np.eye(4), (len(placed), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = problem.rotations, problem.centres
    order = np.argsort(placed)
    return Tour(
        tuple(int(placed[i]) for i in order),
        poses[order],
        point_depths(problem),
        residual_angles(problem),
        rejected,
        {view: _describe_failure(view, relations, rejected) for view in range(count) if view not in placed},
    )


def _describe_failure(
    view: int, relations: Mapping[Pair, RelativePose], rejected: Sequence[Pair]
) -> tuple[str, int | None]:
    """Why a panorama has no pose: the problem of its best pair."""
    own = [(pair, relation) for pair, relation in relations.items() if view in pair]
    if not own:
        return "it has nothing in common with another panorama", None
    pair, best = max(own, key=lambda item: item[1].places)
    other = pair[0] if pair[1] == view else pair[1]
    if best.problem is not None:
        return best.problem, other
    if pair in rejected:
        return "its pose contradicts those of other panoramas", other
    return "its distance cannot be determined: it shares too few points with panoramas that have a pose", other


def _find_contradictions(relations: Mapping[Pair, RelativePose]) -> tuple[Pair, ...]:
    """Pairs whose rotations contradict two better pairs of a triangle more often than they agree.

    A pair is compared with its triangles in the order of the scores, so that a wrong one does not discredit others.
    """
    kept: dict[Pair, Array] = {}
    rejected = []
    for pair in sorted(relations, key=lambda p: -relations[p].score):
        i, j = pair
        rotation = relations[pair].rotation
        loops = []
        for k in {view for other in kept for view in other} - {i, j}:
            first, second = _rotation_between(kept, i, k), _rotation_between(kept, k, j)
            if first is not None and second is not None:
                loops.append(float(rotation_angle(second @ first @ rotation.T)) < _LARGEST_LOOP)
        if loops and sum(loops) * 2 < len(loops):
            rejected.append(pair)
        else:
            kept[pair] = rotation
    return tuple(rejected)


def _rotation_between(kept: Mapping[Pair, Array], i: int, j: int) -> Array | None:
    if (i, j) in kept:
        return kept[i, j]
    return kept[j, i].T if (j, i) in kept else None


@dataclass(frozen=True, eq=False)
class _Observations:
    """Observations of tracks: panorama, track and bearing; at most one for each panorama and track."""

    view: Int[Array, "observation"]
    track: Int[Array, "observation"]
    bearing: Float[Array, "observation 3"]


def _make_tracks(features: Sequence[Features], relations: Mapping[Pair, RelativePose]) -> _Observations:
    """Features that matches connect; tracks with two features of one panorama are dropped."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    starts = np.concatenate(((0,), np.cumsum([len(f) for f in features])))
    edges = np.concatenate([relation.indices + starts[[i, j]] for (i, j), relation in relations.items()])
    size = int(starts[-1])
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(size, size))
    labels = connected_components(graph, directed=False)[1]
    nodes = np.unique(edges)
    view = np.searchsorted(starts, nodes, side="right") - 1
    track = np.unique(labels[nodes], return_inverse=True)[1].reshape(-1)
    _, index, repeats = np.unique(np.stack((track, view)), axis=1, return_inverse=True, return_counts=True)
    ambiguous = np.zeros(track.max() + 1, bool)
    ambiguous[track[repeats[index.reshape(-1)] > 1]] = True
    kept = ~ambiguous[track]
    nodes, view, track = nodes[kept], view[kept], track[kept]
    bearings = np.concatenate([f.bearings for f in features])[nodes]
    return _Observations(view, track, bearings)


class _GrowingTour:
    """Panoramas that are placed one after another; the first one is the world.

    Attributes:
        placed: panoramas in the order of placing; cameras of the problem.
        problem: their poses, and the points that two or more of them see.
        tracks: of the problem's points.
    """

    def __init__(
        self,
        observations: _Observations,
        relations: Mapping[Pair, RelativePose],
        downs: Float[Array, "view 3"],
        noise: float,
        floor_height: FloorHeight,
    ) -> None:
        self._observations, self._relations, self._downs = observations, relations, downs
        self._noise, self._floor_height = noise, floor_height
        start = max(relations, key=lambda p: relations[p].score * min(1.0, relations[p].parallax / math.radians(5)))
        first = relations[start]
        self.placed = list(start)
        self._triangulate([np.eye(3), first.rotation.T], [np.zeros(3), -first.rotation.T @ first.translation])

    def grow(self) -> None:
        """Place all panoramas that can be placed."""
        failed: set[int] = set()
        tried: set[int] = set()  # to be placed by the floor
        while True:
            candidates: dict[int, float] = {}
            for (i, j), relation in self._relations.items():
                for inside, outside in ((i, j), (j, i)):
                    if inside in self.placed and outside not in self.placed and outside not in failed:
                        candidates[outside] = candidates.get(outside, 0.0) + relation.score
            if candidates:
                view = max(candidates, key=lambda v: candidates[v])
                pose = self._place_by_points(view)
            else:  # no points determine the distance of any further panorama
                left = failed - tried
                if not left:
                    return
                view = min(left)
                tried.add(view)
                pose = self._place_by_floor(view)
            if pose is None:
                failed.add(view)
                continue
            failed.clear()
            self.placed.append(view)
            self._triangulate([*self.problem.rotations, pose[0]], [*self.problem.centres, pose[1]])
            self.problem = adjust(self.problem, self._noise, steps=6)

    def with_distances(self) -> Problem:
        """The problem with distances by the floor for panoramas that few points connect to two others.

        Matches of two panoramas determine the direction between them, and points that a third one sees the distance.
        """
        problem, placed = self.problem, self.placed
        counts = np.bincount(problem.point)
        joint = np.bincount(problem.camera[counts[problem.point] > 2], minlength=len(placed))
        weak = {view for view, number in zip(placed, joint, strict=True) if number < _FEW_JOINT}
        pairs = [pair for pair in self._relations if weak & set(pair) and set(pair) <= set(placed)]
        height = self._measure_height() if pairs and len(placed) > 2 else None
        if height is None:
            return problem
        relative = {pair: self._floor_height(pair) for pair in pairs}
        known = {pair: height / value for pair, value in relative.items() if value is not None}
        numbers = np.array([[placed.index(view) for view in pair] for pair in known]).reshape(-1, 2)
        return replace(problem, pairs=numbers, distances=np.array(list(known.values())))

    def _triangulate(self, rotations: Sequence[Array], centres: Sequence[Array]) -> None:
        """Make the problem of the placed panoramas at these poses."""
        observations = self._observations
        position = np.full(len(self._downs), -1)
        position[self.placed] = np.arange(len(self.placed))
        kept = position[observations.view] >= 0
        counts = np.bincount(observations.track[kept], minlength=int(observations.track.max(initial=0)) + 1)
        kept &= counts[observations.track] >= 2
        self.tracks, point = np.unique(observations.track[kept], return_inverse=True)
        point, camera, bearing = point.reshape(-1), position[observations.view[kept]], observations.bearing[kept]
        rotation, centre = np.stack(rotations), np.stack(centres)
        points = triangulate(rotation, centre, camera, point, bearing, len(self.tracks))
        axes = self._downs[self.placed]
        world = np.einsum("nij,nj->ni", rotation, axes)
        known = np.isfinite(world).all(axis=1)
        down = np.median(world[known], axis=0) if known.any() else np.array((0.0, 1, 0))
        self.problem = Problem(rotation, centre, points, camera, point, bearing, axes, down / np.linalg.norm(down))

    def _place_by_points(self, view: int) -> tuple[Float[Array, "3 3"], Float[Array, "3"]] | None:
        """The pose of a new panorama by the relation to a placed one that most known points support."""
        known = self._known_points()
        own = self._observations.view == view
        tracks = self._observations.track[own]
        shared = np.isin(tracks, list(known))
        bearings = self._observations.bearing[own][shared]
        points = np.array([known[t] for t in tracks[shared]]).reshape(-1, 3)
        best, most = None, float(_MIN_SHARED) - 0.5
        for other, origin in zip(self.placed, self.problem.centres, strict=True):
            if (other, view) not in self._relations and (view, other) not in self._relations:
                continue
            world, direction = self._turn_from(other, view)
            scales = _scales(points, bearings, origin, world, direction)
            for scale in np.unique(np.quantile(scales, np.linspace(0.1, 0.9, 17))) if len(scales) else ():
                centre = origin + scale * direction
                toward = points - centre
                distance = np.maximum(np.linalg.norm(toward, axis=1), 1e-12)
                cosine = np.einsum("ij,nj,ni->n", world, bearings, toward) / distance
                support = float(np.exp(-0.5 * (np.arccos(np.clip(cosine, -1, 1)) / math.radians(1.0)) ** 2).sum())
                if support > most:
                    best, most = (world, centre), support
        return best

    def _known_points(self) -> dict[int, Float[Array, "3"]]:
        """World positions of the tracks that the placed panoramas see with enough parallax."""
        points, w = self.problem.points[:, :3], self.problem.points[:, 3:]
        centres = self.problem.centres
        baseline = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
        nearest = np.full(len(points), np.inf)
        np.minimum.at(nearest, self.problem.point, point_depths(self.problem))
        usable = (nearest * _MIN_PARALLAX < baseline) & (np.abs(w[:, 0]) > 1e-9)
        return {int(t): points[n] / w[n] for n, t in enumerate(self.tracks) if usable[n]}

    def _turn_from(self, other: int, view: int) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """World rotation of a panorama by its relation to a placed one, and the direction from that one to it."""
        if (other, view) in self._relations:
            relation = self._relations[other, view]
            rotation, translation = relation.rotation, relation.translation
        else:
            relation = self._relations[view, other]
            rotation, translation = relation.rotation.T, -relation.rotation.T @ relation.translation
        world = self.problem.rotations[self.placed.index(other)] @ rotation.T
        return world, -world @ translation

    def _place_by_floor(self, view: int) -> tuple[Float[Array, "3 3"], Float[Array, "3"]] | None:
        """The pose of a new panorama by its best relation to a placed one, and a distance by the height over the floor.

        The cameras of a tour have one height: it is the unit in which floors give the distances of pairs.
        """
        own = [pair for pair in self._relations if view in pair and (set(pair) - {view}) <= set(self.placed)]
        if not own:
            return None
        pair = max(own, key=lambda p: self._relations[p].score)
        relative = self._floor_height(pair)
        height = None if relative is None else self._measure_height()
        if relative is None or height is None:
            return None
        other = pair[0] if pair[1] == view else pair[1]
        world, direction = self._turn_from(other, view)
        return world, self.problem.centres[self.placed.index(other)] + height / relative * direction

    def _measure_height(self) -> float | None:
        """Height of the cameras over the floor in the tour's unit, by the best pairs; None without a floor."""
        heights: list[float] = []
        for i, j in sorted(self._relations, key=lambda p: -self._relations[p].score):
            if i in self.placed and j in self.placed and len(heights) < _FLOOR_PAIRS:
                height = self._floor_height((i, j))
                if height is not None:
                    first, second = (self.problem.centres[self.placed.index(view)] for view in (i, j))
                    heights.append(height * float(np.linalg.norm(first - second)))
        return float(np.median(heights)) if heights else None


def _scales(points: Array, bearings: Array, origin: Array, rotation: Array, direction: Array) -> Float[Array, "n"]:
    """Distances along `direction` at which the bearings point to the points."""
    rays = bearings @ rotation.T
    offset = points - origin
    distance = np.linalg.norm(offset, axis=1)
    sine = np.linalg.norm(np.cross(rays, direction), axis=1)
    depths = two_view_depths(offset / np.maximum(distance, 1e-12)[:, None], rays, np.eye(3), -direction)[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = distance / depths
    angle = np.linalg.norm(np.cross(rays, offset), axis=1) / np.maximum(distance, 1e-12)
    return scales[(sine > 0.05) & (angle > math.sin(_MIN_PARALLAX)) & np.isfinite(scales) & (scales > 0)]
