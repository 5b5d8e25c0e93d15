"""The way along a link and its ring."""

import dataclasses
import math

import numpy as np

from pansplat.inputs.panorama_sets import Link
from pansplat.tours.graph import TourGraph
from pansplat.tours.links import choose_rings, find_link_ring
from pansplat.tours.outlook import BINS, find_bins


def _link(tour: TourGraph, pitch: float) -> TourGraph:
    first, *others = tour.panoramas
    first = dataclasses.replace(first, links=(Link("p1", math.pi / 2, pitch),))
    return dataclasses.replace(tour, panoramas=(first, *others))


def test_a_ring_is_where_the_link_meets_the_floor_a_metre_away_at_least(make_tour) -> None:
    for pitch, distance in ((math.atan(0.75), 2.0), (1.4, 1.0)):
        tour = _link(make_tour(((0, 0), (0, 1)), ((0, 0), (1, 1))), pitch)
        ring = find_link_ring(tour, 0, 1, 1.5)
        assert np.allclose(ring, (distance, 1.5, 0)), "metres to the right, and down"


def test_a_ring_off_the_floor_is_on_the_wall_in_the_direction_of_the_link(make_tour) -> None:
    for pitch in (0.1, -0.2):
        tour = _link(make_tour(((0, 0), (0, 1)), ((0, 0), (1, 1))), pitch)
        for wall, distance in ((2.0, 2.0), (0.0, 3.0)):
            outlook = np.zeros(BINS)
            outlook[find_bins(np.array(0.5 * math.pi))] = wall
            assert np.allclose(find_link_ring(tour, 0, 1, 1.5, outlook), (distance, distance * math.tan(pitch), 0))


def test_a_vertical_link_and_none_have_no_ring(make_tour) -> None:
    tour = _link(make_tour(((0, 0), (0, 1)), ((0, 0), (1, 1))), 0.5 * math.pi)
    assert find_link_ring(tour, 0, 1, 1.5) is None
    assert find_link_ring(tour, 1, 0, 1.5) is None


def _choose(tour: TourGraph, here: int, links: dict[int, int] | None = None, **known) -> list[tuple[int, bool]]:
    """The rings with links of some panoramas to others, and whether they are where these lead."""
    panoramas = [
        dataclasses.replace(view, links=(Link(f"p{(links or {})[node]}", 0.5, 0.3),) if node in (links or {}) else ())
        for node, view in enumerate(tour.panoramas)
    ]
    found = choose_rings(dataclasses.replace(tour, panoramas=tuple(panoramas)), here, 1.5, **known)
    return [(node, offset is not None) for node, offset in found]


def test_the_rings_of_a_panorama_are_its_own_links_and_where_edges_lead(make_tour) -> None:
    """Three panoramas in a row, and a part behind a door; surfaces hide what has no link, and a room has one ring."""
    row = make_tour(((0, 0), (0, 2), (0, 4), (30, 0)), ((0, 1), (0, 2), (1, 2), (3, 3)))
    edges = [(1, False), (2, False), (0, False)]
    assert _choose(row, 0) == _choose(row, 0, {1: 3}) == edges, "not the links of the next one"
    assert _choose(row, 1, {1: 3}) == [(3, True), (0, False), (2, False), (1, False)], "where it leads"
    assert _choose(row, 3, {1: 3}) == [(1, False), (3, False)], "what leads here"
    assert _choose(row, 3) == [(0, False), (3, False)], "the nearest one, where nothing leads"
    assert _choose(row, 0, hidden=[1]) == [(2, False), (0, False)]
    assert _choose(row, 0, hidden=[1, 2]) == [(1, False), (0, False)], "the nearest one is left"
    assert _choose(row, 0, {0: 2}, hidden=[1, 2]) == [(2, True), (0, False)], "on its arrow"
    assert _choose(row, 0, rooms=[[1, 2]]) == [(1, False), (0, False)], "the nearest one of a room"
    assert _choose(row, 0, rooms=[[0, 1, 2]]) == edges, "its own one has all"
    assert _choose(row, 0, {0: 2}, rooms=[[1, 2]]) == [(2, False), (0, False)], "that of a link comes before"
