"""Graphs of panoramas, and the tours of folders."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls

from pansplat.gaussians.scene import Scene, empty_gaussians
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
from pansplat.tours.graph import find_tours
from pansplat.tours.limits import follow_edge
from pansplat.tours.scene_graph import describe_tour, make_graph
from pansplat.tours.scene_views import choose_scene_views, choose_sources, leave_out
from pansplat.tours.walks import find_walk, plan_walk


def test_pairs_that_share_panoramas_are_one_tour(make_tour):
    a, b, c, d, e = make_tour([(0, z) for z in range(5)], ()).panoramas
    siblings = tuple(p.image for p in (e, c, b, a, d))

    def pair(*context: Panorama) -> PanoramaSet:
        return PanoramaSet("", Path("house"), context, (), 0.45, 10.0, siblings)

    assert find_tours([pair(a, b), pair(d, e)]) == []
    (tour,) = find_tours([pair(a, b), pair(d, e), pair(b, c)])
    assert tour.name == "house tour"
    assert tour.panoramas == (c, b, a), "in the order of the folder"
    assert set(tour.overlaps) == {(0, 1), (1, 2)}
    (tour,) = find_tours([pair(a, b), pair(d, e), pair(b, c), pair(e, a)])
    assert len(tour) == 5


def test_all_panoramas_of_a_folder_of_parts_are_one_tour(home):
    assert list(home.overlaps.items()) == [((0, 1), 1), ((1, 2), 1), ((4, 5), 1), ((3, 3), 1), ((6, 6), 1)]
    assert home.parts == (0, 0, 0, 1, 2, 2, 3) and home.name == "home tour"
    scenes = choose_scene_views(home)
    assert scenes[3, 3] == (3,) and scenes[4, 5] == (4, 5) and set(choose_sources(home)) == set(scenes.values())
    assert home.neighbours(3) == []
    pairs = [home.make_set((node,)) for node in (3, 6)]
    (tour,) = find_tours(pairs)
    assert set(tour.overlaps) == {(0, 0), (1, 1)}, "two photographs are a tour of two parts"
    assert find_tours(pairs[:1]) == [] and find_tours([home.make_set((0, 1))]) == []
    elsewhere = dataclasses.replace(pairs[1], folder=Path("other"))
    assert find_tours([pairs[0], elsewhere]) == [], "each folder has its own tour"


def test_single_views_are_between_the_other_panoramas_of_a_tour_in_file_order(make_tour):
    a, b, c = make_tour([(0, 0), (0, 1), (0, 2)], ()).panoramas
    together = PanoramaSet("", Path("house"), (a, c), (), 0.45, 10.0, (a.image, c.image))
    alone = (dataclasses.replace(b, world=1),)
    alone = PanoramaSet("", Path("house"), alone, (), 0.45, 10.0, (a.image, b.image, c.image))
    (tour,) = find_tours([together, alone])
    assert [panorama.name for panorama in tour.panoramas] == ["p0", "p1", "p2"] and tour.parts == (0, 1, 0)
    pair = tour.make_set((0, 2))
    assert set(tour.overlaps) == {(0, 2), (1, 1)} and pair.context == (a, c) and pair.name == "p0-p2"


def test_the_depth_range_of_a_tour_is_that_of_the_pairs_with_several_views(home):
    together, alone = home.make_set((0, 1)), home.make_set((3,))
    (tour,) = find_tours([dataclasses.replace(together, near=0.8, far=4.0), alone])
    assert (tour.near, tour.far) == (0.8, 4.0) and (alone.near, alone.far) == (0.45, 10.0)
    single = tour.make_set((len(tour) - 1,))
    assert len(single.context) == 1 and (single.near, single.far) == (0.45, 10.0), "its walls may be nearer"
    (tour,) = find_tours([alone, home.make_set((6,))])
    assert (tour.near, tour.far) == (0.45, 10.0)


def test_a_panorama_in_no_pair_is_a_part_of_its_own_at_its_place(make_tour):
    a, b, c = make_tour(((0, 0), (0, 1), (3, 0)), ()).panoramas
    images = (a.image, b.image, c.image)
    (tour,) = find_tours([PanoramaSet("", Path(), context, (), 0.45, 10.0, images) for context in ((a, b), (c,))])
    assert tour.parts == (0, 0, 1) and set(tour.overlaps) == {(0, 1), (2, 2)}
    assert np.allclose(tour.positions, [(0, 0, 0), (0, 0, 1), (3, 0, 0)]), "they have a common world"


def test_worlds_are_level_and_far_apart(home):
    distances = np.linalg.norm(home.positions[:, None] - home.positions[None], axis=2)
    parts = np.array(home.parts)
    assert distances[parts[:, None] != parts].min() >= 8
    assert distances[4, 5] == pytest.approx(1) and np.allclose(home.positions[:3], [(0, 0, z) for z in range(3)])
    axes = home.cam2world[:, :3, :3].numpy()
    assert np.allclose(axes, np.eye(3)), "up is up, and the first panorama of each world looks ahead"
    assert np.allclose(home.positions[:, 1], 0), "the cameras have one height"
    pair = home.make_set((4, 5))
    (place, _), poses = pair.context, torch.stack([panorama.cam2world for panorama in pair.context])
    assert np.allclose(place.cam2world[:3, 3], (5, 5, 0)), "scenes are predicted in their own world"
    means = poses[:, :3, 3].float() + place.cam2world[:3, 2].float()  # 1 m ahead
    scene = home.place(Scene(make_balls(means, 1.0), poses, 1.0, 2.0), (4, 5))
    assert np.allclose(scene.cam2world, home.cam2world[4:6]), "and placed in that of the tour"
    assert np.allclose(scene.gaussians.means, home.positions[4:6] + np.array((0, 0, 1)), atol=1e-5)
    for node, place in enumerate(home.positions):
        moved = place + np.array((0.7, 0, 0.7))
        edge, distance = home.find_nearest_edge(moved)
        assert node in edge and distance < 1 and follow_edge(home, moved, edge) == edge


def test_two_hundred_parts_stay_near_each_other(make_tour):
    single = make_tour(((0, 0),), ()).panoramas[0]
    panoramas = tuple(dataclasses.replace(single, image=Path(f"{k}.jpg"), world=k) for k in range(200))
    (tour,) = find_tours([PanoramaSet("", Path(), (panorama,), (), 0.45, 10.0, ()) for panorama in panoramas])
    assert np.ptp(tour.positions, axis=0).max() < 250 and len(plan_walk(tour)) == 200


def test_a_link_is_a_direction_in_the_world(home):
    assert set(home.links) == {(2, 3), (3, 2), (3, 6)}
    assert np.allclose(home.find_direction(2, 3), (-math.cos(0.4), math.sin(0.4), 0)), "left and below the horizon"
    assert home.find_direction(6, 3) is None


def test_no_flight_leads_through_a_wall_and_places_stay_known(comb):
    tour = comb.with_walls([(1, 2)])
    assert (1, 2) not in tour.overlaps and tour.parts == (0, 0, 1, 1, 0, 1) and set(tour.worlds) == {0}
    assert tour.is_zoom(1, 2) and find_walk(tour, 0, 3) == [0, 1, 2, 3] and not comb.is_zoom(1, 2)
    tour = tour.with_walls([(2, 5)])
    assert tour.overlaps[5, 5] == 1 and tour.is_placed(5), "a panorama behind walls is in the world of the others"
    assert leave_out(tour, 5).context and set(plan_walk(tour)) == set(range(6))
    again = make_graph(Scene(empty_gaussians(), tour.cam2world, 1.0, 2.0, tour=describe_tour(tour)))
    assert again.overlaps == tour.overlaps and again.walls == tour.walls
