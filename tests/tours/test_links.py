"""The way along a link and its ring."""

import dataclasses
import math

import numpy as np

from pansplat.inputs.panorama_sets import Link
from pansplat.tours.graph import TourGraph
from pansplat.tours.links import find_link_ring
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
