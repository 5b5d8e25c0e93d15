"""Approximate places of panoramas without a pose: behind the doors to which the links of a tour point in both rooms.

Places are found from known ones outwards. Each panorama beside a room states where the room may be; what they state
together is the place, if it is probable enough. It is a guess: no camera flies to it, and nothing is predicted from it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pansplat.poses.placing import Guess, Piece, PlanPose, list_through_door

_LEAST_PROBABILITY = 0.5  # a place that is less probable is not stated
_SAME, _TURN = 1.0, 0.3  # places that support each other are nearer: camera heights, and turn, radians


class LinkedPlace(NamedTuple):
    """Where a panorama probably is.

    Attributes:
        beside: a panorama with a pose, or with links only.
        place: its place relative to that panorama, camera heights.
        by: the panoramas whose links state the place.
    """

    beside: Path
    place: PlanPose
    by: tuple[Path, ...]


class _Known(NamedTuple):
    """A panorama with a place: the first one of its world, the place in that world, and its probability."""

    first: Path
    place: PlanPose
    probability: float = 1.0


def place_linked(
    pieces: Mapping[Path, Piece], links: Mapping[Path, Mapping[Path, float]], worlds: Sequence[Mapping[Path, PlanPose]]
) -> dict[Path, LinkedPlace]:
    """The places of panoramas that links join, in both directions, with others.

    Of panoramas that none joins with a world, the others are beside the one with most links.

    Args:
        pieces: what each panorama shows.
        links: the yaw of the links of each panorama to others, radians to the right of the centre.
        worlds: known places of panoramas on the plan of each world, camera heights.
    """
    known = {image: _Known(next(iter(world)), place) for world in worlds for image, place in world.items()}
    guesses: dict[Path, dict[Path, list[Guess]]] = {image: {} for image in pieces}
    for a, b in itertools.combinations(pieces, 2):
        there, back = links.get(a, {}).get(b), links.get(b, {}).get(a)
        if there is not None and back is not None and not (a in known and b in known):
            places = list_through_door((pieces[a], pieces[b]), ((there, 0.0), (back, 0.0)))
            if places:
                guesses[b][a] = places
                guesses[a][b] = [Guess(place.inverse(), probability) for place, probability in places]
    free = [image for image in pieces if image not in known and guesses[image]]
    found: dict[Path, LinkedPlace] = {}
    while free:
        votes = {image: _vote(guesses[image], known) for image in free}
        image, (best, by) = max(votes.items(), key=lambda vote: vote[1][0].probability)
        if best.probability >= _LEAST_PROBABILITY:
            found[image] = LinkedPlace(best.first, known[best.first].place.inverse().add(best.place), by)
        else:
            image = max(free, key=lambda image: len(guesses[image]))
            best = _Known(image, PlanPose(0.0, 0.0, 0.0))
        known[image] = best
        free.remove(image)
    return found


def _vote(guesses: Mapping[Path, Sequence[Guess]], known: Mapping[Path, _Known]) -> tuple[_Known, tuple[Path, ...]]:
    """The most probable place of a panorama, and the panoramas beside it that support it.

    Args:
        guesses: its places relative to others.
        known: panoramas with a place.
    """
    best, by = _Known(Path(), PlanPose(0.0, 0.0, 0.0), 0.0), ()
    for first in dict.fromkeys(known[other].first for other in guesses if other in known):
        beside = [other for other in guesses if other in known and known[other].first == first]
        votes = [
            (known[other].place.add(place), known[other].probability * probability / len(beside), other)
            for other in beside
            for place, probability in guesses[other]
        ]
        for place, _, _ in votes:
            same = [vote for vote in votes if vote[0].distance(place) < _SAME and vote[0].turn_between(place) < _TURN]
            weights = np.array([weight for _, weight, _ in same])
            if weights.sum() > best.probability:
                right, forward = (weights @ [other[:2] for other, _, _ in same] / weights.sum()).tolist()
                best = _Known(first, PlanPose(right, forward, place.yaw), float(weights.sum()))
                by = tuple(dict.fromkeys(other for *_, other in same))
    return best, by
