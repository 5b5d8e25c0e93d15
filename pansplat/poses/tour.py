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
        points: of the scene.
        depths: distances of the points from the cameras that observe them.
        angles: residuals of these observations, radians.
        rejected: pairs that contradict the others.
        unplaced: for each panorama without a pose the reason, and the other panorama of its best pair.
    """

    placed: tuple[int, ...]
    poses: Float[Array, "placed 4 4"]
    points: Float[Array, "point 3"]
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
            (), np.empty((0, 4, 4)), np.empty((0, 3)), np.empty(0), np.empty(0), rejected,
            {view: _describe_failure(view, relations, rejected) for view in range(count)},
        )  # fmt: skip
    observations = _make_tracks(features, reliable)
    problem, placed = _grow(observations, reliable, downs, noise, floor_height)
    problem = _add_distances(problem, placed, reliable, floor_height)
    for _ in range(_ROUNDS if len(placed) > 2 else 1):
        if len(placed) > 2:
            problem = adjust(problem, noise)
        problem = problem.select(residual_angles(problem) < _OUTLIER * noise)
    poses = np.tile(np.eye(4), (len(placed), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = problem.rotations, problem.centres
    order = np.argsort(placed)
    finite = np.abs(problem.points[:, 3]) > 1e-6
    return Tour(
        tuple(int(placed[i]) for i in order),
        poses[order],
        problem.points[finite, :3] / problem.points[finite, 3:],
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
    track_of: dict[tuple[int, int], int]


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
    track_of = {(int(v), int(n - starts[v])): int(t) for v, n, t in zip(view, nodes, track, strict=True)}
    return _Observations(view, track, bearings, track_of)


def _grow(
    observations: _Observations,
    relations: Mapping[Pair, RelativePose],
    downs: Array,
    noise: float,
    floor_height: FloorHeight,
) -> tuple[Problem, list[int]]:
    """Place panoramas one after another; returns the problem of the placed ones in the order of placing."""
    start = max(relations, key=lambda p: relations[p].score * min(1.0, relations[p].parallax / math.radians(5)))
    first = relations[start]
    placed = list(start)
    rotations = [np.eye(3), first.rotation.T]
    centres = [np.zeros(3), -first.rotation.T @ first.translation]
    failed: set[int] = set()
    tried: set[int] = set()  # to be placed by the floor
    problem = _make_problem(observations, placed, rotations, centres, downs)
    while True:
        candidates = {}
        for (i, j), relation in relations.items():
            for inside, outside in ((i, j), (j, i)):
                if inside in placed and outside not in placed and outside not in failed:
                    candidates[outside] = candidates.get(outside, 0.0) + relation.score
        if candidates:
            view = max(candidates, key=lambda v: candidates[v])
            pose = _place(view, placed, problem, observations, relations)
        else:  # no points determine the distance of any further panorama
            left = failed - tried
            if not left:
                return problem, placed
            view = min(left)
            tried.add(view)
            pose = _place_by_floor(view, placed, problem, relations, floor_height)
        if pose is None:
            failed.add(view)
            continue
        failed.clear()
        placed.append(view)
        rotations, centres = [*problem.rotations, pose[0]], [*problem.centres, pose[1]]
        problem = _make_problem(observations, placed, rotations, centres, downs)
        problem = adjust(problem, noise, steps=6)


def _make_problem(
    observations: _Observations,
    placed: Sequence[int],
    rotations: Sequence[Array],
    centres: Sequence[Array],
    downs: Array,
) -> Problem:
    """Triangulate the tracks that two or more placed panoramas see."""
    position = np.full(len(downs), -1)
    position[list(placed)] = np.arange(len(placed))
    kept = position[observations.view] >= 0
    counts = np.bincount(observations.track[kept], minlength=int(observations.track.max(initial=0)) + 1)
    kept &= counts[observations.track] >= 2
    tracks, point = np.unique(observations.track[kept], return_inverse=True)
    camera, bearing = position[observations.view[kept]], observations.bearing[kept]
    rotation, centre = np.stack(rotations), np.stack(centres)
    points = triangulate(rotation, centre, camera, point.reshape(-1), bearing, len(tracks))
    axes = downs[list(placed)]
    world = np.einsum("nij,nj->ni", rotation, axes)
    known = np.isfinite(world).all(axis=1)
    down = np.median(world[known], axis=0) if known.any() else np.array((0.0, 1, 0))
    return Problem(rotation, centre, points, camera, point.reshape(-1), bearing, axes, down / np.linalg.norm(down))


def _place(
    view: int,
    placed: Sequence[int],
    problem: Problem,
    observations: _Observations,
    relations: Mapping[Pair, RelativePose],
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]] | None:
    """The pose of a new panorama by the relation to a placed one that most known points support."""
    known = _known_points(placed, problem, observations)
    own = observations.view == view
    tracks = observations.track[own]
    shared = np.isin(tracks, list(known))
    bearings = observations.bearing[own][shared]
    points = np.array([known[t] for t in tracks[shared]]).reshape(-1, 3)
    best, most = None, float(_MIN_SHARED) - 0.5
    for position, other in enumerate(placed):
        relation = relations.get((other, view)) or relations.get((view, other))
        if relation is None:
            continue
        world, direction = _turn_to(problem.rotations[position], relation, (other, view) in relations)
        scales = _scales(points, bearings, problem.centres[position], world, direction)
        for scale in np.unique(np.quantile(scales, np.linspace(0.1, 0.9, 17))) if len(scales) else ():
            centre = problem.centres[position] + scale * direction
            toward = points - centre
            cosine = np.einsum("ij,nj,ni->n", world, bearings, toward) / np.maximum(
                np.linalg.norm(toward, axis=1), 1e-12
            )
            support = float(np.exp(-0.5 * (np.arccos(np.clip(cosine, -1, 1)) / math.radians(1.0)) ** 2).sum())
            if support > most:
                best, most = (world, centre), support
    return best


def _turn_to(placed: Array, relation: RelativePose, is_first: bool) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """Rotation of the other camera of a relation, and the direction to it from the placed one, in the world.

    Args:
        placed: rotation of the placed camera.
        is_first: whether the placed camera is the first one of the relation.
    """
    rotation, translation = relation.rotation, relation.translation
    if not is_first:
        rotation, translation = rotation.T, -rotation.T @ translation
    world = placed @ rotation.T
    return world, -world @ translation


def _place_by_floor(
    view: int,
    placed: Sequence[int],
    problem: Problem,
    relations: Mapping[Pair, RelativePose],
    floor_height: FloorHeight,
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]] | None:
    """The pose of a new panorama by its best relation to a placed one, and a distance by the height over the floor.

    The cameras of a tour have one height: it is the unit in which floors give the distances of pairs.
    """
    own = [pair for pair in relations if view in pair and (set(pair) - {view}) <= set(placed)]
    if not own:
        return None
    pair = max(own, key=lambda p: relations[p].score)
    relative = floor_height(pair)
    if relative is None:
        return None
    height = _measure_height(placed, problem, relations, floor_height)
    if height is None:
        return None
    other = placed.index(pair[0] if pair[1] == view else pair[1])
    world, direction = _turn_to(problem.rotations[other], relations[pair], pair[1] == view)
    return world, problem.centres[other] + height / relative * direction


def _measure_height(
    placed: Sequence[int], problem: Problem, relations: Mapping[Pair, RelativePose], floor_height: FloorHeight
) -> float | None:
    """Height of the cameras over the floor in the tour's unit, by the best pairs; None without a floor."""
    heights: list[float] = []
    for i, j in sorted(relations, key=lambda p: -relations[p].score):
        if i in placed and j in placed and len(heights) < _FLOOR_PAIRS:
            height = floor_height((i, j))
            if height is not None:
                ends = problem.centres[placed.index(i)], problem.centres[placed.index(j)]
                heights.append(height * float(np.linalg.norm(ends[0] - ends[1])))
    return float(np.median(heights)) if heights else None


def _add_distances(
    problem: Problem, placed: Sequence[int], relations: Mapping[Pair, RelativePose], floor_height: FloorHeight
) -> Problem:
    """The problem with distances by the floor for panoramas that few points connect to two others.

    Matches of two panoramas determine the direction between them, and points that a third one sees the distance.
    """
    counts = np.bincount(problem.point)
    joint = np.bincount(problem.camera[counts[problem.point] > 2], minlength=len(placed))
    weak = {view for view, number in zip(placed, joint, strict=True) if number < _FEW_JOINT}
    pairs = [pair for pair in relations if weak & set(pair) and set(pair) <= set(placed)]
    height = _measure_height(placed, problem, relations, floor_height) if pairs and len(placed) > 2 else None
    if height is None:
        return problem
    relative = {pair: floor_height(pair) for pair in pairs}
    known = {pair: height / value for pair, value in relative.items() if value is not None}
    numbers = np.array([[placed.index(view) for view in pair] for pair in known]).reshape(-1, 2)
    return replace(problem, pairs=numbers, distances=np.array(list(known.values())))


def _known_points(placed: Sequence[int], problem: Problem, observations: _Observations) -> dict[int, Float[Array, "3"]]:
    """World positions of the tracks that the placed panoramas see with enough parallax."""
    position = np.full(int(observations.view.max()) + 1, -1)
    inside = [view for view in placed if view < len(position)]
    position[inside] = [list(placed).index(view) for view in inside]
    kept = position[observations.view] >= 0
    counts = np.bincount(observations.track[kept], minlength=int(observations.track.max()) + 1)
    kept &= counts[observations.track] >= 2
    tracks = np.unique(observations.track[kept])
    points, w = problem.points[:, :3], problem.points[:, 3:]
    depth = point_depths(problem)
    baseline = np.linalg.norm(problem.centres - problem.centres.mean(axis=0), axis=1).max()
    nearest = np.full(len(points), np.inf)
    np.minimum.at(nearest, problem.point, depth)
    usable = (nearest * _MIN_PARALLAX < baseline) & (np.abs(w[:, 0]) > 1e-9)
    return {int(t): points[n] / w[n] for n, t in enumerate(tracks) if usable[n]}


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
