"""Poses of many panoramas from the relative poses of their pairs.

Each relation states a rotation, a direction and, by the estimated depths, a distance in camera heights. Relations that
contradict the others around triangles are left out. The others connect the panoramas in groups. The strongest relations
place a group, and all its poses are adjusted together. Groups and single panoramas are then joined where the
hypotheses of several pairs between them agree, or one is probable enough by itself.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from pansplat.poses.bundle import Bundle, adjust, point_depths, residual_angles, triangulate
from pansplat.poses.features import Features
from pansplat.poses.solvers import make_motion, rotation_angle
from pansplat.poses.two_view import RelativePose
from pansplat.system.components import label_components

IndexPair = tuple[int, int]

_LARGEST_LOOP = math.radians(4)  # right pairs of a triangle turn by less around it
_LARGEST_GAP = 0.15  # and their translations leave a smaller gap, relative to their length
_JOINED_ODDS = 1.0  # groups are joined above this logarithm of the odds
_AGREEMENT = 1.5  # logarithm: how much rarer hypotheses of two pairs agree if they are wrong; neighbours look alike
_LEAST_ODDS = -9.0  # hypotheses with a lower logarithm of the odds are left out
_JOINED_TURN, _JOINED_GAP = math.radians(4), (0.25, 0.1)  # agreeing hypotheses are nearer: camera heights, or relative
_RIVAL_TURN, _RIVAL_GAP = math.radians(6), (0.5, 0.2)  # junctions that differ by more exclude each other
_OUTLIER = 8.0  # an observation with a larger residual is left out, in the noise's standard deviation
_FEW_JOINT = 40  # points seen by three panoramas; with fewer, the adjustment uses estimated distances
_ROUNDS = 3  # the poses are adjusted so often, each time without the outliers
_NONE_SHOWS_IT = "no other photograph shows this room{}: take one in the doorway"
_REASONS = {  # by the problem of the best pair, without its figures
    "": "it seems to be at another place than other photographs state: take one more near it",
    "both were taken at one place": "another photograph was taken at this place: take one a metre away",
    "one of both looks mirrored left to right": "it or another photograph looks mirrored left to right: flip it",
}


@dataclass(frozen=True, eq=False)
class Group:
    """Panoramas that relations connect, in a world of arbitrary orientation; its unit is the cameras' height.

    Attributes:
        placed: indices of the panoramas.
        poses: cam2world of them, in that order.
        depths: distances of the points from the cameras that observe them.
        angles: residuals of these observations, radians.
    """

    placed: tuple[int, ...]
    poses: Float[Array, "placed 4 4"]
    depths: Float[Array, "observation"]
    angles: Float[Array, "observation"]


@dataclass(frozen=True, eq=False)
class Tour:
    """Groups of placed panoramas.

    Attributes:
        groups: the largest one first.
        confirmed: doubtful pairs that agree with the others of their group.
        unplaced: for each panorama without a pose why, the other panorama of its best pair, and figures of that pair.
    """

    groups: tuple[Group, ...]
    confirmed: dict[IndexPair, RelativePose]
    unplaced: dict[int, tuple[str, int | None, str]]


def build_tour(
    features: Sequence[Features],
    relations: Mapping[IndexPair, RelativePose],
    downs: Float[Array, "view 3"],
    noise: float,
) -> Tour:
    """Poses of all panoramas that reliable pairs connect.

    Args:
        features: features of all panoramas.
        relations: relative poses of the pairs (i, j), i < j, that were compared.
        downs: gravity in each camera's frame; NaN where unknown.
        noise: standard deviation of a bearing, radians.
    """
    reliable = drop_contradictions({p: r for p, r in relations.items() if r.is_reliable and r.is_matched})
    groups = _place_groups(features, reliable, downs, noise)
    parts = _join_parts(groups, relations, len(features))
    confirmed = _confirm(parts, relations)
    if confirmed:
        groups = _place_groups(features, reliable | confirmed, downs, noise)
    groups = [_assemble(part, groups) for part in parts if len(part) > 1]
    groups.sort(key=lambda group: (-len(group.placed), group.placed))
    placed = {view for group in groups for view in group.placed}
    unplaced = {view: _describe_failure(view, relations) for view in range(len(features)) if view not in placed}
    return Tour(tuple(groups), confirmed, unplaced)


def _place_groups(
    features: Sequence[Features], relations: Mapping[IndexPair, RelativePose], downs: Array, noise: float
) -> list[Group]:
    """The groups of panoramas that relations connect."""
    parts: dict[int, dict[IndexPair, RelativePose]] = {}
    labels = label_components(len(features), relations)
    for pair, relation in relations.items():
        parts.setdefault(labels[pair[0]], {})[pair] = relation
    return [_place_group(features, parts[label], downs, noise) for label in sorted(parts)]


_Part = dict[int, Float[Array, "4 4"]]
"""Poses of panoramas, cam2world, in a world of their own; its unit is the cameras' height."""


def _join_parts(groups: Sequence[Group], relations: Mapping[IndexPair, RelativePose], count: int) -> list[_Part]:
    """The groups and single panoramas, joined where that is probable, the most probable junction first."""
    parts: list[_Part] = [dict(zip(group.placed, group.poses, strict=True)) for group in groups]
    placed = {view for part in parts for view in part}
    parts += [{view: np.eye(4)} for view in range(count) if view not in placed]
    junctions = {pair: _find_junction(parts[pair[0]], parts[pair[1]], relations) for pair in _pairs_of(len(parts))}
    while junctions:
        i, j = max(junctions, key=lambda pair: junctions[pair][0])
        odds, motion = junctions[i, j]
        if odds < _JOINED_ODDS:
            break
        parts[i] |= {view: motion @ pose for view, pose in parts[j].items()}
        parts[j] = {}
        for pair in junctions:
            if {i, j} & set(pair):
                junctions[pair] = _find_junction(parts[pair[0]], parts[pair[1]], relations)
    return [part for part in parts if part]


def _pairs_of(count: int) -> list[IndexPair]:
    return list(itertools.combinations(range(count), 2))


def _find_junction(
    first: _Part, second: _Part, relations: Mapping[IndexPair, RelativePose]
) -> tuple[float, Float[Array, "4 4"]]:
    """The most probable motion from the world of the second part to that of the first, and the logarithm of its odds.

    Each hypothesis of a pair between them states a motion. The hypotheses of other pairs that agree are evidence for
    it; motions that exclude it, and that no hypothesis is right, are evidence against it.
    """
    between = []
    for (i, j), relation in relations.items():
        is_forward = i in first and j in second
        if not is_forward and not (j in first and i in second):
            continue
        likely = relation.hypotheses.log_odds > _LEAST_ODDS
        motions, odds = relation.hypotheses.motions[likely], relation.hypotheses.log_odds[likely]
        between.append((i, j, motions, odds) if is_forward else (j, i, np.linalg.inv(motions), odds))
    stated = [first[i] @ np.linalg.inv(motions) @ np.linalg.inv(second[j]) for i, j, motions, _ in between]
    found = np.concatenate((np.empty((0, 4, 4)), *stated))
    if not len(found):
        return -math.inf, np.eye(4)
    sums = np.zeros(len(found))
    for i, j, motions, odds in between:
        agreeing = _agree(np.linalg.inv(found @ second[j]) @ first[i], motions, _JOINED_TURN, _JOINED_GAP)
        own = np.logaddexp.reduce(np.where(agreeing, odds, -math.inf), axis=1)
        sums += np.logaddexp(0, _AGREEMENT + own)
    evidence = sums + np.log(-np.expm1(-sums)) - _AGREEMENT  # log(exp(sums) - 1)
    best = int(evidence.argmax())
    middle = np.eye(4)
    middle[:3, 3] = np.mean([pose[:3, 3] for pose in second.values()], axis=0)
    same = _agree(found @ middle, found @ middle, _RIVAL_TURN, _RIVAL_GAP)
    rivals = (evidence - np.log(same.sum(axis=1)))[~same[best]]  # each motion once
    return float(evidence[best] - np.logaddexp.reduce(np.append(rivals, 0.0))), found[best]


def _agree(
    first: Float[Array, "n 4 4"], second: Float[Array, "m 4 4"], turn: float, gap: tuple[float, float]
) -> Bool[Array, "n m"]:
    """Whether motions differ by less than a turn and a gap, in camera heights or relative."""
    cosine = (np.einsum("nij,mij->nm", first[:, :3, :3], second[:, :3, :3]) - 1) / 2
    translations = first[:, None, :3, 3], second[None, :, :3, 3]
    length = np.linalg.norm(translations[0], axis=-1) + np.linalg.norm(translations[1], axis=-1)
    distance = np.linalg.norm(translations[0] - translations[1], axis=-1)
    return (cosine > math.cos(turn)) & (distance < np.maximum(gap[0], gap[1] * length))


def _confirm(parts: Sequence[_Part], relations: Mapping[IndexPair, RelativePose]) -> dict[IndexPair, RelativePose]:
    """The doubtful relations by matches that agree with the poses of their part."""
    confirmed = {}
    for part in parts:
        for (i, j), relation in relations.items():
            if i in part and j in part and relation.is_doubtful and relation.is_matched:
                motion = np.linalg.inv(part[j]) @ part[i]
                if _agree(motion[None], relation.motion[None], _JOINED_TURN, _JOINED_GAP)[0, 0]:
                    confirmed[i, j] = replace(relation, problem=None)
    return confirmed


def _assemble(part: _Part, groups: Sequence[Group]) -> Group:
    """The group of a part: adjusted groups at their places in it, and panoramas without matches."""
    poses, depths, angles = dict(part), [np.empty(0)], [np.empty(0)]
    for group in groups:
        if group.placed[0] in part:
            motion = part[group.placed[0]] @ np.linalg.inv(group.poses[0])
            poses |= dict(zip(group.placed, motion @ group.poses, strict=True))
            depths.append(group.depths)
            angles.append(group.angles)
    placed = tuple(sorted(poses))
    return Group(placed, np.stack([poses[view] for view in placed]), np.concatenate(depths), np.concatenate(angles))


def _closes(kept: Mapping[IndexPair, RelativePose], relation: RelativePose, pair: IndexPair, k: int) -> bool | None:
    """Whether a relation agrees with those by a third panorama; None if they are not known."""
    first, second = _motion_between(kept, pair[0], k), _motion_between(kept, k, pair[1])
    if first is None or second is None:
        return None
    around, own = second @ first, relation.motion
    turn = float(rotation_angle(around[:3, :3] @ own[:3, :3].T))
    length = sum(float(np.linalg.norm(motion[:3, 3])) for motion in (own, first, second))
    return turn < _LARGEST_LOOP and float(np.linalg.norm(around[:3, 3] - own[:3, 3])) < _LARGEST_GAP * length


def _place_group(
    features: Sequence[Features],
    relations: Mapping[IndexPair, RelativePose],
    downs: Float[Array, "view 3"],
    noise: float,
) -> Group:
    """The group that relations connect: placed by a tree of the strongest ones, then adjusted together."""
    poses = {min(relations)[0]: np.eye(4)}
    while leaving := [pair for pair in relations if (pair[0] in poses) != (pair[1] in poses)]:
        i, j = max(leaving, key=lambda pair: (relations[pair].log_odds, relations[pair].score))
        if i in poses:
            poses[j] = poses[i] @ np.linalg.inv(relations[i, j].motion)
        else:
            poses[i] = poses[j] @ relations[i, j].motion
    placed = tuple(sorted(poses))
    bundle = _make_bundle(features, relations, placed, np.stack([poses[view] for view in placed]), downs)
    for _ in range(_ROUNDS if len(placed) > 2 else 1):
        if len(placed) > 2:
            bundle = adjust(bundle, noise)
        bundle = bundle.select(residual_angles(bundle) < _OUTLIER * noise)
    return Group(placed, make_motion(bundle.rotations, bundle.centres), point_depths(bundle), residual_angles(bundle))


def _describe_failure(view: int, relations: Mapping[IndexPair, RelativePose]) -> tuple[str, int | None, str]:
    """`Tour.unplaced` of a panorama."""
    own = [(pair, relation) for pair, relation in relations.items() if view in pair]
    if not own:
        return _NONE_SHOWS_IT.format(""), None, ""
    pair, best = max(own, key=lambda item: (item[1].log_odds, item[1].places))
    figures = best.problem or ""
    reason = _REASONS.get(figures.partition(":")[0], _NONE_SHOWS_IT.format(" well enough"))
    return reason, pair[0] if pair[1] == view else pair[1], figures


def drop_contradictions(relations: Mapping[IndexPair, RelativePose]) -> dict[IndexPair, RelativePose]:
    """The pairs without those that contradict two better ones of a triangle more often than they agree.

    They contradict each other by rotation or by translation. A pair is compared with its triangles in the order of the
    odds and scores, so that a wrong one does not discredit others.
    """
    kept: dict[IndexPair, RelativePose] = {}
    for pair in sorted(relations, key=lambda p: (-relations[p].log_odds, -relations[p].score)):
        others = {view for other in kept for view in other} - set(pair)
        closed = [_closes(kept, relations[pair], pair, k) for k in others]
        loops = [is_closed for is_closed in closed if is_closed is not None]
        if not loops or sum(loops) * 2 >= len(loops):
            kept[pair] = relations[pair]
    return {pair: relation for pair, relation in relations.items() if pair in kept}


def _motion_between(known: Mapping[IndexPair, RelativePose], i: int, j: int) -> Float[Array, "4 4"] | None:
    """The motion from one camera's frame to another one's, camera heights; None if it is not known."""
    if (i, j) in known:
        return known[i, j].motion
    return np.linalg.inv(known[j, i].motion) if (j, i) in known else None


def _make_bundle(
    features: Sequence[Features],
    relations: Mapping[IndexPair, RelativePose],
    placed: Sequence[int],
    poses: Float[Array, "placed 4 4"],
    downs: Float[Array, "view 3"],
) -> Bundle:
    """The placed panoramas, and a point for the features that matches connect, of at most one in each panorama.

    Matches of two panoramas determine the direction between them, and points that a third one sees the distance.
    Relations of a panorama that few such points connect therefore state distances.
    """
    starts = np.concatenate(((0,), np.cumsum([len(f) for f in features])))
    edges = np.concatenate([relation.indices + starts[[i, j]] for (i, j), relation in relations.items()])
    size = int(starts[-1])
    graph = scipy.sparse.coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(size, size))
    labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    nodes = np.unique(edges)
    camera = np.searchsorted(placed, np.searchsorted(starts, nodes, side="right") - 1)
    point = np.unique(labels[nodes], return_inverse=True)[1].reshape(-1)
    _, index, repeats = np.unique(np.stack((point, camera)), axis=1, return_inverse=True, return_counts=True)
    kept = ~np.isin(point, point[repeats[index.reshape(-1)] > 1])
    camera, point = camera[kept], np.unique(point[kept], return_inverse=True)[1].reshape(-1)
    bearing = np.concatenate([f.bearings for f in features])[nodes[kept]]
    rotation, centre, down = poses[:, :3, :3], poses[:, :3, 3], downs[list(placed)]
    counts = np.bincount(point)
    points = triangulate(rotation, centre, camera, point, bearing, len(counts))
    world = np.einsum("nij,nj->ni", rotation, down)
    known = np.isfinite(world).all(axis=1)
    mean = np.median(world[known], axis=0) if known.any() else np.array((0.0, 1, 0))
    joint = np.bincount(camera[counts[point] > 2], minlength=len(placed))
    weak = {view for view, number in zip(placed, joint, strict=True) if number < _FEW_JOINT}
    pairs = [pair for pair in relations if weak & set(pair)]
    numbers = np.array([[placed.index(view) for view in pair] for pair in pairs], np.int64).reshape(-1, 2)
    distances = np.array([relations[pair].distance for pair in pairs])
    mean /= np.linalg.norm(mean)
    return Bundle(rotation, centre, points, camera, point, bearing, down, mean, numbers, distances)
