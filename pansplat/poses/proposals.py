"""Hypotheses of relative poses by estimated depth: where both panoramas look alike.

With its depth in both panoramas a match is a pair of points. With parallel walls it states the translation for each of
four rotations. Poses that many matches state are likely; the panoramas are compared under them, and under their
neighbours.
"""

from __future__ import annotations

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
_VOTERS = 800  # best matches that state translations
_VOTE_WIDTH, _VOTE_LIMITS = 0.06, (0.03, 0.25)  # deviation of a translation: relative to the depth; camera heights
_SAME_TURN = 0.05  # largest difference of an element of two rotations that are equal
_CLIMB = 0.3  # deviation of the difference of the cameras' heights over the floor, camera heights
_KEPT, _FARTHEST = 8, 8.0  # hypotheses that are moved; largest distance of two cameras, camera heights
_ALIKE = 1.5, -60.0, 10.0, 2.0, 5.0  # weights of the logarithm of votes, of conflict, likeness, shade and hue
_STEPS = (0.08, 0.04, 0.02)  # steps of the search for the translation, over the height of the cameras
_ROUNDS = 3  # rounds of that search with each step
_AROUND = np.array([(x, y, 0.0) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y])


def propose_by_depth(
    a: Bearings,
    b: Bearings,
    prior: Float[Array, "match"],
    depths: MatchDepths,
    axes: RotationPrior,
    surroundings: tuple[Surroundings, Surroundings],
    links: LinkDirections,
) -> list[Pose]:
    """Levelled poses near those of single matches under which both panoramas look most alike.

    Args:
        a, b: bearings of the matches in the first and in the second panorama, the most probable first.
        prior: probability of each match to be right.
        depths: estimated at the matches.
        axes: gravity and walls of both panoramas; without walls there is no hypothesis.
        surroundings: all that both panoramas show.
        links: directions of each panorama towards the other one.
    """
    if not axes.has_walls:
        return []
    a, b, prior, depths = a[:_VOTERS], b[:_VOTERS], prior[:_VOTERS], depths.select(slice(_VOTERS))
    levels = axes.first.axes[_LEVEL], axes.second.axes[_LEVEL]
    x, y = ((rays * np.exp(depths.log_depth[:, side, None])) @ levels[side].T for side, rays in enumerate((a, b)))
    reach = (_VOTE_WIDTH * np.exp(depths.log_depth).mean(axis=1)).clip(*_VOTE_LIMITS)
    turns = levels[1] @ axes.wall_rotations @ levels[0].T
    rotations, translations = np.repeat(turns, len(x), axis=0), np.concatenate([y - x @ turn.T for turn in turns])
    votes = np.concatenate([_count_votes(each, reach, prior) for each in np.split(translations, len(turns))])
    kept = (np.abs(translations[:, 2]) < _CLIMB) & (np.linalg.norm(translations, axis=1) < _FARTHEST)
    rotations, translations, votes = rotations[kept], translations[kept] * (1, 1, 0), votes[kept]
    poses = levels[1].T @ rotations @ levels[0], translations @ levels[1]
    odds = _ALIKE[0] * np.log1p(votes) + _compare_alike(surroundings, *poses, coarse=True) + links.score(*poses)
    chosen: list[int] = []
    for n in np.argsort(-odds, kind="stable").tolist():
        if len(chosen) == _KEPT:
            break
        if all(
            np.linalg.norm(translations[n] - translations[m]) > _VOTE_LIMITS[1]
            or np.abs(rotations[n] - rotations[m]).max() > _SAME_TURN
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
) -> Float[Array, "n"]:
    """How many matches state a translation near that of each match."""
    squared = scipy.spatial.distance.cdist(translations, translations, "sqeuclidean")
    votes = (np.exp(-0.5 * squared / reach[None] ** 2) * prior).sum(axis=1)
    return votes * np.exp(-0.5 * (translations[:, 2] / _CLIMB) ** 2)
