"""Rooms beside the doors to which links point: wall to wall, as dots, along chains, and never in other rooms."""

import itertools
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from numpy.testing import assert_allclose

from pansplat.inputs.panorama_sets import Link, Panorama
from pansplat.tours.graph import TourGraph
from pansplat.tours.linked_rooms import DrawnPlace, place_rooms

UNIT, WALL = 1.5, 0.12  # height of the cameras, thickness of a wall
HALL, BATH, BED, LOFT = range(4)
BACK, RIGHT, LEFT = math.pi, math.pi / 2, -math.pi / 2


def _place(links: Mapping[tuple[int, int], float], joined: tuple[int, int] | None = None, count: int = 4):
    """The places of rooms of 4 x 3 m (the hall has 6 m), 20 m apart, with links by yaw; two may be in one world."""
    panoramas, outlines = [], {}
    for node in range(count):
        pose, center = torch.eye(4, dtype=torch.float64), np.array((20.0 * node, 0.0))
        pose[0, 3] = center[0]
        own = tuple(Link(f"{b}", yaw, 0.1) for (a, b), yaw in links.items() if a == node)
        panoramas.append(Panorama(f"{node}", Path(f"{node}"), pose, links=own, world=node))
        half = np.array((3.0 if node == HALL else 2.0, 1.5))
        outlines[node] = center + half * np.array(((-1, -1), (1, -1), (1, 1), (-1, 1)))
    overlaps = {(node, node): 1.0 for node in range(count)} | ({joined: 1.0} if joined else {})
    return place_rooms(TourGraph("", Path(), tuple(panoramas), 0.5, 10.0, overlaps=overlaps), outlines, UNIT), outlines


def _shapes(drawn: Mapping[int, DrawnPlace], outlines: Mapping[int, np.ndarray]) -> dict[int, shapely.Polygon]:
    return {n: shapely.Polygon(drawn[n].move(o) if n in drawn else o) for n, o in outlines.items()}


def test_rooms_with_links_in_both_directions_are_wall_to_wall_at_their_door() -> None:
    """The bath is on the right of the hall; the way back leads through its far wall."""
    drawn, outlines = _place({(HALL, BATH): RIGHT, (BATH, HALL): 0.0})
    assert drawn[BATH].beside == HALL and abs(drawn[BATH].turn) == pytest.approx(RIGHT)
    assert _shapes(drawn, outlines)[BATH].bounds == pytest.approx((3 + WALL, -2, 6 + WALL, 2), abs=0.05)
    assert_allclose(drawn[BATH].move(np.array((20.0, 1.5))), (3 + WALL, 0), atol=0.05)
    assert set(drawn) == {BATH}, "rooms without links stand apart"


def test_a_room_without_a_link_back_is_a_dot_behind_its_door() -> None:
    drawn, _ = _place({(HALL, BATH): RIGHT})
    assert drawn[BATH].turn is None
    right, forward = drawn[BATH].move(np.array((20.0, 0.0)))
    assert 3.4 < right < 4.5 and abs(forward) < 0.1


def test_a_chain_is_followed_to_its_end_beyond_a_dot_and_beyond_an_outline() -> None:
    drawn, outlines = _place(
        {(HALL, BATH): 0.0, (BATH, HALL): 0.0, (HALL, 4): LEFT, (BATH, BED): BACK, (BED, LOFT): 1.0}, count=5
    )
    assert {node: place.beside for node, place in drawn.items()} == dict.fromkeys((BATH, BED, LOFT, 4), HALL)
    assert drawn[BATH].turn is not None and drawn[BED].turn is drawn[LOFT].turn is None
    ahead = [drawn[node].move(np.array((20.0 * node, 0.0)))[1] for node in (BATH, BED, LOFT)]
    assert 1.5 < ahead[0] < ahead[1] < ahead[2] and ahead[1] > _shapes(drawn, outlines)[BATH].bounds[3]


def test_rooms_behind_one_door_do_not_overlap_and_dots_have_different_places() -> None:
    links = {(HALL, node): RIGHT for node in (BATH, BED, LOFT)}
    drawn, outlines = _place(links | {(node, HALL): LEFT for node in (BATH, BED, LOFT)})
    for a, b in itertools.combinations(_shapes(drawn, outlines).values(), 2):
        assert a.intersection(b).area < 0.02 * min(a.area, b.area)
        assert a.distance(b) < 8
    dots, _ = _place(links)
    places = [dots[node].move(np.array((20.0 * node, 0.0))) for node in (BATH, BED, LOFT)]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(places, 2)) > 0.4


def test_panoramas_of_one_world_move_together_beside_a_larger_one_or_the_one_with_more_links() -> None:
    drawn, _ = _place({(BED, BATH): 0.0, (BED, LOFT): BACK})
    assert set(drawn) == {BATH, LOFT} and all(place.beside == BED for place in drawn.values())
    drawn, _ = _place({(HALL, BATH): 0.0, (HALL, BED): RIGHT}, joined=(BATH, BED))
    assert drawn == {}, "no link leads from the larger world"
    drawn, _ = _place({(BATH, HALL): 0.0}, joined=(BATH, BED))
    assert set(drawn) == {HALL} and drawn[HALL].beside == BATH
