"""Where a camera stops near a graph."""

import dataclasses
import itertools

import numpy as np
import pytest

from pansplat.tours.graph import TourGraph
from pansplat.tours.limits import follow_edge, limit_step


def test_an_edge_is_followed_within_its_part_until_the_camera_is_at_another_one(home):
    places = home.positions
    towards = places[3] - places[2]
    between = places[3] - 0.55 * towards
    assert home.find_nearest_edge(between)[0] == (1, 2) and follow_edge(home, between, (3, 3)) == (3, 3)
    assert home.find_nearest_edge(between, part=0)[0] in ((0, 1), (1, 2))
    assert follow_edge(home, places[6], (3, 3)) == (6, 6), "after a jump"


def test_an_edge_is_followed_until_another_one_is_clearly_nearer(comb):
    assert follow_edge(comb, np.array((0.0, 0, 1.2)), (0, 1)) == (0, 1)
    assert follow_edge(comb, np.array((0.0, 0, 1.3)), (0, 1)) == (1, 2)


def test_a_walk_ends_half_a_metre_from_the_ends_of_a_poor_edge(comb):
    """Of one shorter than 2 m after a quarter of it."""
    poor = dataclasses.replace(comb, poor=((0, 1),))
    start, end = comb.positions[0], comb.positions[1]
    places = [start + t * (end - start) for t in np.linspace(0, 1, 41)]

    def walk(tour: TourGraph, path: list[np.ndarray]) -> float:
        place = path[0]
        for before, after in itertools.pairwise(path):
            place = limit_step(tour, place, place + after - before)
        return float(np.linalg.norm(place - path[0]))

    assert walk(poor, places) == pytest.approx(0.25) == walk(poor, places[::-1])
    assert walk(comb, places) == pytest.approx(comb.length((0, 1))) == 1
    assert walk(poor, places[20::-1]) == pytest.approx(0.5), "from the middle it goes back"


def test_a_walk_ends_a_quarter_of_a_metre_before_a_surface_and_is_free_along_a_flight(comb):
    """The surfaces around the third panorama are 0.6 m away; those of the fourth one are unknown."""
    seen = dataclasses.replace(comb, clearances={2: np.full((12, 24), 0.6)})
    start = comb.positions[2]

    def walk(tour: TourGraph, place: np.ndarray, step: np.ndarray) -> np.ndarray:
        for _ in range(300):
            place = limit_step(tour, place, place + step)
        return place

    for step in np.array(((-1, 0, 0), (0, 1, 0), (0, -1, 0), (-1, 1, 0))) / 100:
        assert np.linalg.norm(walk(seen, start, step) - start) == pytest.approx(0.35, abs=0.011)
        assert np.linalg.norm(walk(comb, start, step) - start) > 2.9
    assert walk(seen, start, np.array((0, 0, 0.01)))[2] == pytest.approx(3.25, abs=0.011), "along the flight"
    stuck = start + np.array((-0.5, 0, 0))
    assert walk(seen, stuck, np.array((-0.01, 0, 0))) == pytest.approx(stuck, abs=0.011), "placed there by a script"
    assert walk(seen, stuck, np.array((0.001, 0, 0)))[0] > stuck[0] + 0.2, "it can go back"
    slid = walk(seen, start + np.array((-0.34, 0.05, 0)), np.array((-0.001, 0.001, 0)))
    assert slid[1] > start[1] + 0.15 and np.linalg.norm(slid - start) < 0.361, "it slides along"
