"""Hypotheses of relative poses by estimated depth: where many matches agree, and where both panoramas look alike.

With its depth in both panoramas a match is a pair of points. With parallel walls one match states the translation for
each of four rotations; two matches of levelled cameras state rotation and translation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat.poses.axes import RotationPrior
from pansplat.poses.dense import Surroundings, compare_many, overlap_weight
from pansplat.poses.depth import MatchDepths
from pansplat.poses.link_directions import LinkDirections
from pansplat.poses.solvers import Bearings

Pose = tuple[Float[Array, "3 3"], Float[Array, "3"]]
"""R and t of x2 = R x1 + t, camera heights."""
_LEVEL = [1, 2, 0]  # order of the axes in a levelled camera: both walls' normals, down
_LARGEST_CONFLICT = 0.1  # share of the sphere, above which a conflict counts no more
_VOTERS, _VOTE_WIDTH, _VOTE_LIMITS = 800, 0.06, (0.03, 0.25)  # matches; error of their depth; of translations
_VOTE_YAW, _CLIMB = 0.05, 0.3  # radians; deviation of the difference of the cameras' heights, camera heights
_PAIR_SAMPLES, _PAIRS = 20000, 1000  # of two matches; of them, those that agree
_MODES, _KEPT_BY_DEPTH = 8, 12  # hypotheses by depth: of each rotation; that are optimised
_KEPT_ALIKE, _FARTHEST = 8, 8.0  # hypotheses by single matches that are optimised; their largest distance
_ALIKE = 1.5, -60.0, 10.0, 2.0, 5.0  # of the logarithm of votes, conflict, likeness, shade, hue
_STEPS, _ROUNDS = (0.08, 0.04, 0.02), 3  # of the search of the translation, camera heights; of each step
_AROUND = np.array([(x, y, 0.0) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y])


def propose_by_depth(
    a: Bearings,
    b: Bearings,
    prior: Float[Array, "match"],
    depths: MatchDepths,
    axes: RotationPrior,
    surroundings: tuple[Surroundings, Surroundings],
    links: LinkDirections,
    rng: np.random.Generator,
) -> tuple[list[Pose], list[Pose]]:
    """Poses on which the translations of many matches agree, and those under which both panoramas look most alike.

    Args:
        a, b: bearings of the matches in the first and in the second panorama, the most probable first.
        prior: probability of each match to be right.
        depths: estimated at the matches.
        axes: gravity and walls of both panoramas.
        surroundings: all that both panoramas show.
        links: from each panorama towards the other one.
        rng: supplies the samples of pairs of matches.
    """
    a, b, prior, depths = a[:_VOTERS], b[:_VOTERS], prior[:_VOTERS], depths.select(slice(_VOTERS))
    levels = axes.first.axes[_LEVEL], axes.second.axes[_LEVEL]
    x, y = ((rays * np.exp(depths.log_depth[:, side, None])) @ levels[side].T for side, rays in enumerate((a, b)))
    reach = (_VOTE_WIDTH * np.exp(depths.log_depth).mean(axis=1)).clip(*_VOTE_LIMITS)
    found, singles = [], []
    for rotation in axes.wall_rotations:
        level = levels[1] @ rotation @ levels[0].T
        translations = y - x @ level.T
        votes, weights = _count_votes(translations, reach, prior)
        found += [(level, t, v) for t, v in _find_modes(translations, reach, votes, weights)]
        singles.append((level, translations, votes))
    found += _vote_pairs(x, y, reach, prior, rng)
    found.sort(key=lambda item: -item[2])
    agreed = [(levels[1].T @ rotation @ levels[0], t @ levels[1]) for rotation, t, _ in found[:_KEPT_BY_DEPTH]]
    return agreed, _choose_alike(singles, levels, surroundings, links)


def _choose_alike(
    singles: Sequence[tuple[Float[Array, "3 3"], Float[Array, "n 3"], Float[Array, "n"]]],
    levels: tuple[Float[Array, "3 3"], Float[Array, "3 3"]],
    surroundings: tuple[Surroundings, Surroundings],
    links: LinkDirections,
) -> list[Pose]:
    """Levelled poses near those of single matches under which both panoramas look most alike."""
    if not singles:
        return []
    rotations = np.concatenate([np.repeat(rotation[None], len(t), axis=0) for rotation, t, _ in singles])
    translations, votes = (np.concatenate([item[n] for item in singles]) for n in (1, 2))
    kept = (np.abs(translations[:, 2]) < _CLIMB) & (np.linalg.norm(translations, axis=1) < _FARTHEST)
    rotations, translations, votes = rotations[kept], translations[kept] * (1, 1, 0), votes[kept]
    poses = levels[1].T @ rotations @ levels[0], translations @ levels[1]
    odds = _ALIKE[0] * np.log1p(votes) + _compare_alike(surroundings, *poses, coarse=True) + links.score(*poses)
    chosen: list[int] = []
    for n in np.argsort(-odds, kind="stable").tolist():
        if len(chosen) == _KEPT_ALIKE:
            break
        if all(
            np.linalg.norm(translations[n] - translations[m]) > _VOTE_LIMITS[1]
            or np.abs(rotations[n] - rotations[m]).max() > _VOTE_YAW
            for m in chosen
        ):
            chosen.append(n)
    around = _AROUND @ levels[1]
    return [(poses[0][n], _move_alike(surroundings, poses[0][n], poses[1][n], around)) for n in chosen]


def _move_alike(
    surroundings: tuple[Surroundings, Surroundings],
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    around: Float[Array, "n 3"],
) -> Float[Array, "3"]:
    """The translation near one at which both panoramas look most alike, by smaller and smaller steps."""
    best = float(_compare_alike(surroundings, rotation[None], translation[None])[0])
    for step in _STEPS:
        for _ in range(_ROUNDS):
            moved = translation + step * around
            odds = _compare_alike(surroundings, np.repeat(rotation[None], len(moved), axis=0), moved)
            if odds.max() <= best:
                break
            best, translation = float(odds.max()), moved[odds.argmax()]
    return translation


def _compare_alike(
    surroundings: tuple[Surroundings, Surroundings],
    rotations: Float[Array, "n 3 3"],
    translations: Float[Array, "n 3"],
    *,
    coarse: bool = False,
) -> Float[Array, "n"]:
    """How well both panoramas fit; a logarithm of odds without its constant."""
    overlap, conflict, likeness, shade, hue = compare_many(*surroundings, rotations, translations, coarse=coarse).T
    return _ALIKE[1] * np.minimum(conflict, _LARGEST_CONFLICT) + (
        _ALIKE[2] * likeness + _ALIKE[3] * shade + _ALIKE[4] * hue
    ) * overlap_weight(overlap)


def _count_votes(
    translations: Float[Array, "n 3"], reach: Float[Array, "n"], prior: Float[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
    """How many matches state a translation near that of each match, and their weights."""
    squared = scipy.spatial.distance.cdist(translations, translations, "sqeuclidean")
    weights = np.exp(-0.5 * squared / reach[None] ** 2) * prior
    return weights.sum(axis=1) * np.exp(-0.5 * (translations[:, 2] / _CLIMB) ** 2), weights


def _find_modes(
    translations: Float[Array, "n 3"], reach: Array, votes: Float[Array, "n"], weights: Float[Array, "n n"]
) -> list[tuple[Float[Array, "3"], float]]:
    """Translations with most votes, and these."""
    found: list[tuple[Array, float]] = []
    for n in np.argsort(-votes, kind="stable"):
        if len(found) == _MODES:
            break
        if all(np.linalg.norm(translations[n] - t) > 2 * reach[n] for t, _ in found):
            centre = (weights[n][:, None] * translations).sum(axis=0) / max(weights[n].sum(), 1e-9)
            found.append((centre, float(votes[n])))
    return found


def _vote_pairs(
    x: Float[Array, "n 3"], y: Float[Array, "n 3"], reach: Array, prior: Array, rng: np.random.Generator
) -> list[tuple[Float[Array, "3 3"], Float[Array, "3"], float]]:
    """Rotations about the third axis and translations of pairs of points, dense ones, with their votes."""
    count = len(x)
    weights = prior / prior.sum()
    first, second = (rng.choice(count, _PAIR_SAMPLES, p=weights) for _ in range(2))
    dx, dy = x[second] - x[first], y[second] - y[first]
    lengths = np.linalg.norm(dx[:, :2], axis=1), np.linalg.norm(dy[:, :2], axis=1)
    tolerance = reach[first] + reach[second]
    kept = (np.abs(lengths[0] - lengths[1]) < tolerance) & (np.abs(dx[:, 2] - dy[:, 2]) < tolerance)
    kept &= np.minimum(*lengths) > 5 * tolerance
    first, second, dx, dy = first[kept][:_PAIRS], second[kept][:_PAIRS], dx[kept][:_PAIRS], dy[kept][:_PAIRS]
    if not len(first):
        return []
    yaw = np.arctan2(dy[:, 1], dy[:, 0]) - np.arctan2(dx[:, 1], dx[:, 0])
    cos, sin, zero, one = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw)), np.ones(len(yaw))
    rotations = np.stack((cos, -sin, zero, sin, cos, zero, zero, zero, one), axis=1).reshape(-1, 3, 3)
    middle = (x[first] + x[second]) / 2, (y[first] + y[second]) / 2
    translations = middle[1] - np.einsum("nij,nj->ni", rotations, middle[0])
    turns = np.stack((cos, sin), axis=1) / _VOTE_YAW
    points = np.concatenate((translations / _VOTE_LIMITS[1], turns), axis=1)
    squared = scipy.spatial.distance.cdist(points, points, "sqeuclidean")
    votes = np.exp(-0.5 * squared).sum(axis=1) * np.exp(-0.5 * (translations[:, 2] / _CLIMB) ** 2)
    found: list[int] = []
    for n in np.argsort(-votes, kind="stable"):
        if len(found) == _MODES:
            break
        if all(squared[n, other] > 4 for other in found):
            found.append(int(n))
    return [(rotations[n], translations[n], float(votes[n]) * count / len(first) * 0.1) for n in found]
