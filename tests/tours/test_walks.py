"""Walks through graphs."""

import dataclasses
import itertools
import math

import numpy as np

from pansplat.tours.walks import find_next_nodes, find_walk, find_way, plan_walk


def test_a_walk_starts_at_the_first_panorama_if_that_has_a_start_view(comb):
    assert plan_walk(comb)[0] != 1
    order = [1, 0, 2, 3, 4, 5]
    first, *others = (comb.panoramas[node] for node in order)
    overlaps = {(0, 1): 0.3, (0, 2): 0.3, (2, 3): 0.3, (0, 4): 0.3, (2, 5): 0.3}
    tour = dataclasses.replace(comb, panoramas=(first, *others), overlaps=overlaps)
    assert plan_walk(tour)[0] != 0, "a walk from there is longer"
    started = dataclasses.replace(tour, panoramas=(dataclasses.replace(first, start=(0.3, 0.0)), *others))
    assert plan_walk(started)[0] == 0 and plan_walk(started, 3)[0] == 3


def test_a_walk_follows_edges_and_visits_all_panoramas(comb):
    for start in (None, 0, 2, 4):
        walk = plan_walk(comb, start)
        assert set(walk) == set(range(6)) and (start is None or walk[0] == start)
        assert all((min(step), max(step)) in comb.overlaps for step in itertools.pairwise(walk))
    assert len(plan_walk(comb)) == 8, "both side panoramas cost one way back"
    assert find_walk(comb, 0, 5) == [0, 1, 2, 5] and comb.neighbours(1) == [0, 2, 4]


def test_a_walk_through_a_hundred_panoramas_of_a_grid_is_hardly_longer_than_the_shortest_one(make_tour):
    places = [(x, z) for x in range(10) for z in range(10)]
    edges = [(a, b) for a, b in itertools.combinations(range(100), 2) if math.dist(places[a], places[b]) == 1]
    walk = plan_walk(make_tour(places, edges))
    assert set(walk) == set(range(100)) and len(walk) <= 104, "99 steps of 1 m are the shortest"


def test_walks_fade_between_parts_preferably_along_links(home):
    walk = plan_walk(home)
    assert set(walk) == set(range(7)) and walk[:5] == [0, 1, 2, 3, 6], "from the first panorama on, along links"
    flown = [(min(step), max(step)) for step in itertools.pairwise(walk) if not home.is_zoom(*step)]
    assert len(walk) - len(flown) == 4 and set(flown) <= set(home.overlaps), "three fades"
    assert find_walk(home, 0, 6) == [0, 1, 2, 3, 6] and find_walk(home, 6, 0) == [6, 3, 2, 1, 0]
    assert find_walk(home, 0, 5) == [0, 5], "no link leads there"
    assert find_walk(home, 0, 2) == [0, 1, 2], "a fade is no short cut within a part"
    assert find_way(home, home.positions[0] + (0, 0, 0.4), 3) == [1, 2, 3]
    assert find_way(home, home.positions[3], 2, part=home.parts[4])[0] in (4, 5)
    unlinked = dataclasses.replace(home, panoramas=tuple(dataclasses.replace(p, links=()) for p in home.panoramas))
    assert set(plan_walk(unlinked)) == set(range(7)) and plan_walk(unlinked)[:3] in ([0, 1, 2], [2, 1, 0])
    assert find_walk(unlinked, 0, 6) == [0, 6]


def test_next_nodes_lead_along_the_cheapest_walk(comb, home):
    for tour in (comb, home):
        following = find_next_nodes(tour)
        for start, end in itertools.product(range(len(tour)), repeat=2):
            walk = [start]
            while walk[-1] != end:
                walk.append(following[walk[-1]][end])
            assert walk == find_walk(tour, start, end)


def test_a_way_begins_at_the_better_end_of_the_nearest_edge(comb):
    assert find_way(comb, np.array((0.0, 0, 1.4)), 0) == [1, 0]
    assert find_way(comb, np.array((0.0, 0, 1.4)), 5) == [2, 5]
    assert find_way(comb, np.array((0.8, 0, 1.0)), 4) == [4]


def test_a_poor_edge_is_a_zoom_in_its_part_and_ways_around_it_are_better(make_tour):
    square = make_tour(((0, 0), (0, 2), (2, 2), (2, 0)), ((0, 1), (1, 2), (2, 3), (0, 3)))
    poor = dataclasses.replace(square, poor=((0, 1),))
    assert find_walk(square, 0, 1) == [0, 1] and find_walk(poor, 0, 1) == [0, 3, 2, 1]
    assert poor.is_zoom(0, 1) and poor.is_zoom(1, 0) and not poor.is_zoom(1, 2) and poor.parts == square.parts
