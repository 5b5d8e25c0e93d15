"""Graphs of panoramas, walks, and merged scenes."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import pansplat.tours as tours
from pansplat.data.pairs import Pair, Panorama
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians
from pansplat.tours import find_tours


def test_pairs_that_share_panoramas_are_one_tour(make_tour):
    a, b, c, d, e = make_tour([(0, z) for z in range(5)], ()).panoramas
    siblings = tuple(p.image for p in (e, c, b, a, d))

    def pair(*context: Panorama) -> Pair:
        return Pair("", Path("house"), context, (), 0.45, 10.0, siblings)

    assert find_tours([pair(a, b), pair(d, e)]) == []
    (tour,) = find_tours([pair(a, b), pair(d, e), pair(b, c)])
    assert tour.name == "house tour"
    assert tour.panoramas == (c, b, a), "in the order of the folder"
    assert set(tour.overlaps) == {(0, 1), (1, 2)}
    (tour,) = find_tours([pair(a, b), pair(d, e), pair(b, c), pair(e, a)])
    assert len(tour) == 5


def test_a_walk_follows_edges_and_visits_all_panoramas(comb):
    for start in (None, 0, 2, 4):
        walk = comb.plan_walk(start)
        assert set(walk) == set(range(6)) and (start is None or walk[0] == start)
        assert all((min(step), max(step)) in comb.overlaps for step in itertools.pairwise(walk))
    assert len(comb.plan_walk()) == 8, "both side panoramas cost one way back"
    assert comb.find_walk(0, 5) == [0, 1, 2, 5] and comb.neighbours(1) == [0, 2, 4]


def test_a_walk_through_a_hundred_panoramas_of_a_grid_is_hardly_longer_than_the_shortest_one(make_tour):
    places = [(x, z) for x in range(10) for z in range(10)]
    edges = [(a, b) for a, b in itertools.combinations(range(100), 2) if math.dist(places[a], places[b]) == 1]
    walk = make_tour(places, edges).plan_walk()
    assert set(walk) == set(range(100)) and len(walk) <= 104, "99 steps of 1 m are the shortest"


def test_the_scene_of_an_edge_holds_both_ends_and_shares_a_third(make_tour):
    places = ((0, 0), (0, 1), (1, 0), (3, 0), (3, 0.1))
    tour = make_tour(places, ((0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (2, 4)))
    scenes = tour.choose_scene_views()
    assert scenes[0, 1] == scenes[0, 2] == scenes[1, 2] == (0, 1, 2)
    assert scenes[2, 3] == scenes[3, 4] == (2, 3, 4)
    for edge, views in scenes.items():
        assert set(edge) <= set(views)
    assert make_tour(places, ((0, 1), (2, 3))).choose_scene_views()[2, 3] == (2, 3)


def test_a_walk_over_separate_parts_is_refused(make_tour):
    tour = make_tour(((0, 0), (0, 1), (2, 0), (3, 0)), ((0, 1), (2, 3)))
    with pytest.raises(InputError, match="needed edges that connect all 4 panoramas"):
        tour.plan_walk()


def test_panoramas_too_close_for_depth_get_a_third(make_tour):
    tour = make_tour(((0, 0), (0, 0.1), (0, 2)), ((0, 1), (1, 2)))
    assert tour.choose_scene_views()[0, 1] == (0, 1, 2)


def test_one_scene_of_all_panoramas_takes_each_from_the_scene_of_the_largest_overlap(make_tour):
    tour = make_tour(((0, 0), (0, 1), (1, 0), (3, 0)), ())
    overlaps = {(0, 1): 0.3, (0, 2): 0.2, (1, 2): 0.25, (2, 3): 0.5}
    tour = dataclasses.replace(tour, overlaps=overlaps)
    assert tour.choose_sources() == {(2, 3): (2, 3), (0, 1, 2): (0, 1)}
    loaded = []

    def load(views: tuple[int, ...]) -> Scene:
        loaded.append(views)
        count = 10 * len(views)
        labels = torch.arange(count) % len(views)
        means = torch.tensor(views)[labels, None].float().expand(count, 3)
        sizes, colors = torch.ones(count, 3), torch.zeros(count, 1, 3)
        gaussians = Gaussians(means, sizes, torch.ones(count, 4), torch.ones(count), colors, labels, labels.byte())
        return Scene(gaussians, tour.cam2world[list(views)], 1.0, 2.0, tuple(f"{view}.jpg" for view in views))

    scene = tours.merge_scenes(tour, load)
    assert loaded == [(2, 3), (0, 1, 2)]
    assert scene.gaussians.views.tolist() == [0] * 10 + [1] * 10 + [2] * 10 + [3] * 10
    assert scene.gaussians.means[:, 0].equal(scene.gaussians.views.float())
    assert scene.names == ("0.jpg", "1.jpg", "2.jpg", "3.jpg") and scene.cam2world.equal(tour.cam2world)
    assert (scene.near, scene.far) == (0.45, 10.0)
    part = tours.select_views(scene, (3, 1))
    assert part.gaussians.means[:, 0].tolist() == [1] * 10 + [3] * 10
    assert part.gaussians.views.tolist() == [1] * 10 + [0] * 10 and part.names == ("3.jpg", "1.jpg")
    assert part.cam2world.equal(tour.cam2world[[3, 1]]) and part.overlaps == ()


def test_a_merged_scene_has_the_gains_of_all_photographs_relative_to_their_mean(make_tour):
    tour = make_tour(((0, 0), (0, 1), (0, 2)), ((0, 1), (1, 2)))
    truth = np.array(((1.0, 1.1, 0.9), (2.0, 1.8, 2.2), (0.5, 0.6, 0.4)))
    expected = truth / np.exp(np.log(truth).mean(axis=0))

    def load(views: tuple[int, ...], refined: bool = True) -> Scene:
        gains = truth[list(views)] / np.exp(np.log(truth[list(views)]).mean(axis=0))  # relative to those of the scene
        known = tuple(map(tuple, gains.tolist())) if refined else ()
        return Scene(empty_gaussians(), tour.cam2world[list(views)], 1.0, 2.0, gains=known)

    assert set(tour.choose_sources()) == {(0, 1), (1, 2)}
    assert np.allclose(tours.merge_scenes(tour, load).gains, expected)
    assert tours.merge_scenes(tour, lambda views: load(views, refined=False)).gains == ()


def test_next_nodes_lead_along_the_cheapest_walk(comb):
    following = comb.find_next_nodes()
    for start, end in itertools.product(range(6), repeat=2):
        walk = [start]
        while walk[-1] != end:
            walk.append(following[walk[-1]][end])
        assert walk == comb.find_walk(start, end)


def test_an_edge_is_followed_until_another_one_is_clearly_nearer(comb):
    assert comb.follow_edge(np.array((0.0, 0, 1.2)), (0, 1)) == (0, 1)
    assert comb.follow_edge(np.array((0.0, 0, 1.3)), (0, 1)) == (1, 2)
    assert comb.list_reachable((1, 4)) == {0, 1, 2, 4}


def test_a_way_begins_at_the_better_end_of_the_nearest_edge(comb):
    assert comb.find_way(np.array((0.0, 0, 1.4)), 0) == [1, 0]
    assert comb.find_way(np.array((0.0, 0, 1.4)), 5) == [2, 5]
    assert comb.find_way(np.array((0.8, 0, 1.0)), 4) == [4]


def test_a_pair_of_a_scene_has_its_panoramas(comb):
    pair = comb.make_pair((1, 4))
    assert pair.name == "p1-p4" and pair.context == (comb.panoramas[1], comb.panoramas[4])
    assert (pair.near, pair.far, pair.targets) == (0.45, 10.0, ())
