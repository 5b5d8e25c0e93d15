"""Graphs of panoramas, walks, and merged scenes."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls

from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
from pansplat.inputs.placements import ApproximatePlace, Placement
from pansplat.tours import graph
from pansplat.tours.graph import TourGraph, find_tours


def make_gaussians(count: int) -> Gaussians:
    return make_balls(torch.ones(count, 3), 1.0, 1.0)


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


def test_a_walk_starts_at_the_first_panorama_if_that_has_a_start_view(comb):
    assert comb.plan_walk()[0] != 1
    order = [1, 0, 2, 3, 4, 5]
    first, *others = (comb.panoramas[node] for node in order)
    overlaps = {(0, 1): 0.3, (0, 2): 0.3, (2, 3): 0.3, (0, 4): 0.3, (2, 5): 0.3}
    tour = dataclasses.replace(comb, panoramas=(first, *others), overlaps=overlaps)
    assert tour.plan_walk()[0] != 0, "a walk from there is longer"
    started = dataclasses.replace(tour, panoramas=(dataclasses.replace(first, start=(0.3, 0.0)), *others))
    assert started.plan_walk()[0] == 0 and started.plan_walk(3)[0] == 3


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


def test_panoramas_are_predicted_with_their_part_or_with_a_piece_of_a_large_one(make_tour, home):
    assert home.choose_predictions(3) == {}, "a network has scenes of edges"
    predictions = home.choose_predictions(64)
    assert predictions == {0: (0, 1, 2), 1: (0, 1, 2), 2: (0, 1, 2), 3: (3,), 4: (4, 5), 5: (4, 5), 6: (6,)}
    assert set(predictions.values()) == set(home.choose_sources(64)), "those of one scene of all panoramas"
    row = make_tour([(0, k) for k in range(40)], [(k, k + 1) for k in range(39)])
    predictions = row.choose_predictions(64)
    assert set(predictions) == set(range(40)) and len(set(predictions.values())) == 3
    for node, views in predictions.items():
        assert {node, *row.find_edge(node)} <= set(views) and len(views) <= 16
    members = [sum(node in views for views in set(predictions.values())) for node in range(40)]
    assert max(members) <= 2 and sum(members) <= 44, "nothing is predicted more than twice"


def test_all_panoramas_of_a_folder_of_parts_are_one_tour(home):
    assert list(home.overlaps.items()) == [((0, 1), 1), ((1, 2), 1), ((4, 5), 1), ((3, 3), 1), ((6, 6), 1)]
    assert home.parts == (0, 0, 0, 1, 2, 2, 3) and home.name == "home tour"
    scenes = home.choose_scene_views()
    assert scenes[3, 3] == (3,) and scenes[4, 5] == (4, 5) and set(home.choose_sources()) == set(scenes.values())
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
    alone = PanoramaSet(
        "", Path("house"), (dataclasses.replace(b, world=1),), (), 0.45, 10.0, (a.image, b.image, c.image)
    )
    (tour,) = find_tours([together, alone])
    assert [panorama.name for panorama in tour.panoramas] == ["p0", "p1", "p2"] and tour.parts == (0, 1, 0)
    assert set(tour.overlaps) == {(0, 2), (1, 1)} and tour.make_set((0, 2)).context == (a, c)


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
    gaussians = dataclasses.replace(make_gaussians(2), means=means)
    scene = home.place(Scene(gaussians, poses, 1.0, 2.0), (4, 5))
    assert np.allclose(scene.cam2world, home.cam2world[4:6]), "and placed in that of the tour"
    assert np.allclose(scene.gaussians.means, home.positions[4:6] + np.array((0, 0, 1)), atol=1e-5)
    for node, place in enumerate(home.positions):
        moved = place + np.array((0.7, 0, 0.7))
        edge, distance = home.find_nearest_edge(moved)
        assert node in edge and distance < 1 and home.follow_edge(moved, edge) == edge


def test_two_hundred_parts_stay_near_each_other(make_tour):
    single = make_tour(((0, 0),), ()).panoramas[0]
    panoramas = tuple(dataclasses.replace(single, image=Path(f"{k}.jpg"), world=k) for k in range(200))
    (tour,) = find_tours([PanoramaSet("", Path(), (panorama,), (), 0.45, 10.0, ()) for panorama in panoramas])
    assert np.ptp(tour.positions, axis=0).max() < 250 and len(tour.plan_walk()) == 200


def test_an_edge_is_followed_within_its_part_until_the_camera_is_at_another_one(home):
    places = home.positions
    towards = places[3] - places[2]
    between = places[3] - 0.55 * towards
    assert home.find_nearest_edge(between)[0] == (1, 2) and home.follow_edge(between, (3, 3)) == (3, 3)
    assert home.find_nearest_edge(between, part=0)[0] in ((0, 1), (1, 2))
    assert home.follow_edge(places[6], (3, 3)) == (6, 6), "after a jump"


def test_walks_fade_between_parts_preferably_along_links(home):
    walk = home.plan_walk()
    assert set(walk) == set(range(7)) and walk[:5] == [0, 1, 2, 3, 6], "from the first panorama on, along links"
    flown = [(min(step), max(step)) for step in itertools.pairwise(walk) if not home.is_fade(*step)]
    assert len(walk) - len(flown) == 4 and set(flown) <= set(home.overlaps), "three fades"
    assert home.find_walk(0, 6) == [0, 1, 2, 3, 6] and home.find_walk(6, 0) == [6, 3, 2, 1, 0]
    assert home.find_walk(0, 5) == [0, 5], "no link leads there"
    assert home.find_walk(0, 2) == [0, 1, 2], "a fade is no short cut within a part"
    assert home.find_way(home.positions[0] + (0, 0, 0.4), 3) == [1, 2, 3]
    assert home.find_way(home.positions[3], 2, part=home.parts[4])[0] in (4, 5)
    unlinked = dataclasses.replace(home, panoramas=tuple(dataclasses.replace(p, links=()) for p in home.panoramas))
    assert set(unlinked.plan_walk()) == set(range(7)) and unlinked.plan_walk()[:3] in ([0, 1, 2], [2, 1, 0])
    assert unlinked.find_walk(0, 6) == [0, 6]


def test_a_link_is_a_direction_in_the_world(home):
    assert set(home.links) == {(2, 3), (3, 2), (3, 6)}
    assert np.allclose(home.find_direction(2, 3), (-math.cos(0.4), math.sin(0.4), 0)), "left and below the horizon"
    assert home.find_direction(6, 3) is None and home.find_start_view(0) is None
    panorama = dataclasses.replace(home.panoramas[4], start=(math.pi / 2, -0.1))
    tour = dataclasses.replace(home, panoramas=(panorama,), overlaps={(0, 0): 1.0})
    assert np.allclose(tour.find_start_view(0), (math.cos(0.1), -math.sin(0.1), 0))


def test_panoramas_too_close_for_depth_get_a_third(make_tour):
    tour = make_tour(((0, 0), (0, 0.1), (0, 2)), ((0, 1), (1, 2)))
    assert tour.choose_scene_views()[0, 1] == (0, 1, 2)


def test_a_panorama_is_left_out_of_the_scene_that_the_others_show_at_its_position(make_tour):
    tour = make_tour(((0, 0), (0, 1), (0, 2), (9, 0), (9, 1)), ((0, 1), (1, 2), (0, 2), (3, 4)))
    left_out = tour.leave_out(1)
    assert [view.name for view in left_out.context] == [tour.panoramas[k].name for k in (0, 2)]
    assert left_out.targets == (tour.panoramas[1],) and left_out.name == tour.panoramas[1].name
    alone = tour.leave_out(3)
    assert [view.name for view in alone.context] == [tour.panoramas[4].name], "the other one of its part"


def test_one_scene_of_all_panoramas_takes_each_from_the_scene_of_the_largest_overlap(make_tour):
    tour = make_tour(((0, 0), (0, 1), (1, 0), (3, 0)), ())
    overlaps = {(0, 1): 0.3, (0, 2): 0.2, (1, 2): 0.25, (2, 3): 0.5}
    tour = dataclasses.replace(tour, overlaps=overlaps)
    assert tour.choose_sources() == {(2, 3): (2, 3), (0, 1, 2): (0, 1)}
    assert tour.choose_sources(4) == {(0, 1, 2, 3): (0, 1, 2, 3)}, "a predictor of four views is given the part"
    loaded = []

    def load(views: tuple[int, ...]) -> Scene:
        loaded.append(views)
        count = 10 * len(views)
        labels = torch.arange(count) % len(views)
        means = torch.tensor(views)[labels, None].float().expand(count, 3)
        gaussians = dataclasses.replace(make_gaussians(count), means=means, views=labels.byte())
        return Scene(gaussians, tour.cam2world[list(views)], 1.0, 2.0, tuple(f"{view}.jpg" for view in views))

    scene = graph.merge_scenes(tour, load)
    assert loaded == [(2, 3), (0, 1, 2)]
    assert scene.gaussians.views.tolist() == [0] * 10 + [1] * 10 + [2] * 10 + [3] * 10
    assert scene.gaussians.means[:, 0].equal(scene.gaussians.views.float())
    assert scene.names == ("0.jpg", "1.jpg", "2.jpg", "3.jpg") and scene.cam2world.equal(tour.cam2world)
    assert (scene.near, scene.far) == (0.45, 10.0)
    part = graph.select_views(scene, (3, 1))
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
    assert np.allclose(graph.merge_scenes(tour, load).gains, expected)
    assert graph.merge_scenes(tour, lambda views: load(views, refined=False)).gains == ()


def test_a_merged_scene_of_parts_has_their_links_titles_and_gains(home):
    title, start = "living <room>", (9.0, 0.1)
    panoramas = list(home.panoramas)
    panoramas[3] = dataclasses.replace(panoramas[3], title=title, start=start)
    panoramas[6] = dataclasses.replace(panoramas[6], title=title)
    tour = dataclasses.replace(home, panoramas=tuple(panoramas))

    def load(views: tuple[int, ...]) -> Scene:
        gains = ((2.0,) * 3, (0.5,) * 3)[: len(views)] if len(views) > 1 else ((1.0,) * 3,)
        names = tuple(f"p{view}" for view in views)
        return Scene(empty_gaussians(), tour.cam2world[list(views)], 1.0, 2.0, names, gains=gains)

    scene = graph.merge_scenes(tour, load)
    assert scene.names == ("p0", "p1", "p2", title, "p4", "p5", title)
    gains = np.array(scene.gains)
    assert np.allclose(gains[[3, 6]], 1) and np.allclose(gains[[4, 5]], [[2] * 3, [0.5] * 3])
    assert scene.starts == (None,) * 3 + ((9.0 - 2 * math.pi, 0.1),) + (None,) * 3
    again = graph.make_graph(scene)
    assert again.overlaps == tour.overlaps and set(again.links) == set(tour.links) and again.parts == tour.parts
    assert again.links[2, 3].text == "to the hall"
    assert np.allclose(again.find_direction(2, 3), tour.find_direction(2, 3))
    assert [panorama.label for panorama in again.panoramas] == list(scene.names)
    part = graph.select_views(scene, (3,))
    assert part.names == (title,) and part.links == part.starts == part.overlaps == ()


def test_links_of_a_scene_lead_to_their_ends_whatever_the_titles_are():
    titles, ends = ("Hall", "Bath", "Bath (2)", "Bath", ""), (1, 2, 3, 4, 0)
    links = tuple((start, end, 0.0, 0.0, "") for start, end in enumerate(ends))
    scene = Scene(empty_gaussians(), torch.eye(4).repeat(5, 1, 1), 1.0, 2.0, titles, links=links)
    tour = graph.make_graph(scene)
    assert set(tour.links) == {*enumerate(ends)}
    assert tuple(panorama.title for panorama in tour.panoramas) == titles


def test_a_panorama_at_an_approximate_place_is_shown_there_and_stays_where_no_camera_flies(home):
    """p3 is 1 m to the right and 2 m ahead of p2, and is turned by a quarter to the right."""
    about = ApproximatePlace(home.panoramas[2].image, 1.0, 2.0, math.pi / 2, ("p2",))
    panoramas = list(home.panoramas)
    panoramas[3] = dataclasses.replace(panoramas[3], placement=Placement("not placed", about=about))
    tour = dataclasses.replace(home, panoramas=tuple(panoramas))
    scene = graph.merge_scenes(tour, lambda views: Scene(empty_gaussians(), tour.cam2world[list(views)], 1.0, 2.0))
    for drawn in (tour, graph.make_graph(scene)):
        assert list(drawn.approximate) == [3] and drawn.approximate[3].beside == 2
        axes = drawn.level_axes[:, (0, 2)]
        places = drawn.positions[3] @ axes + np.array(((0, 0), (0, 1), (1, 0)))  # the camera, ahead, to the right
        shown = drawn.approximate[3].move(places)
        assert np.allclose(shown, drawn.positions[2] @ axes + np.array(((1, 2), (2, 2), (1, 1))))
        assert drawn.parts == home.parts and not drawn.is_placed(3)
        assert np.allclose(drawn.positions, home.positions) and drawn.overlaps == home.overlaps
    assert graph.select_views(scene, (3,)).approximate == ()
    joined = dataclasses.replace(tour, overlaps=home.overlaps | {(2, 3): 0.5})
    assert joined.approximate == {}, "one that is placed is where it is"


def test_next_nodes_lead_along_the_cheapest_walk(comb, home):
    for tour in (comb, home):
        following = tour.find_next_nodes()
        for start, end in itertools.product(range(len(tour)), repeat=2):
            walk = [start]
            while walk[-1] != end:
                walk.append(following[walk[-1]][end])
            assert walk == tour.find_walk(start, end)


def test_an_edge_is_followed_until_another_one_is_clearly_nearer(comb):
    assert comb.follow_edge(np.array((0.0, 0, 1.2)), (0, 1)) == (0, 1)
    assert comb.follow_edge(np.array((0.0, 0, 1.3)), (0, 1)) == (1, 2)


def test_a_way_begins_at_the_better_end_of_the_nearest_edge(comb):
    assert comb.find_way(np.array((0.0, 0, 1.4)), 0) == [1, 0]
    assert comb.find_way(np.array((0.0, 0, 1.4)), 5) == [2, 5]
    assert comb.find_way(np.array((0.8, 0, 1.0)), 4) == [4]


def test_a_pair_of_a_scene_has_its_panoramas(comb):
    pair = comb.make_set((1, 4))
    assert pair.name == "p1-p4" and pair.context == (comb.panoramas[1], comb.panoramas[4])
    assert (pair.near, pair.far, pair.targets) == (0.45, 10.0, ())


def test_a_poor_edge_is_a_fade_in_its_part_and_ways_around_it_are_better(make_tour):
    square = make_tour(((0, 0), (0, 2), (2, 2), (2, 0)), ((0, 1), (1, 2), (2, 3), (0, 3)))
    poor = dataclasses.replace(square, poor=((0, 1),))
    assert square.find_walk(0, 1) == [0, 1] and poor.find_walk(0, 1) == [0, 3, 2, 1]
    assert poor.is_fade(0, 1) and poor.is_fade(1, 0) and not poor.is_fade(1, 2) and poor.parts == square.parts


def test_no_flight_leads_through_a_wall_and_places_stay_known(comb):
    tour = comb.with_walls([(1, 2)])
    assert (1, 2) not in tour.overlaps and tour.parts == (0, 0, 1, 1, 0, 1) and set(tour.worlds) == {0}
    assert tour.is_fade(1, 2) and tour.find_walk(0, 3) == [0, 1, 2, 3] and not comb.is_fade(1, 2)
    tour = tour.with_walls([(2, 5)])
    assert tour.overlaps[5, 5] == 1 and tour.is_placed(5), "a panorama behind walls is in the world of the others"
    assert tour.leave_out(5).context and set(tour.plan_walk()) == set(range(6))
    again = comb.with_overlaps(tour.list_overlaps())
    assert again.overlaps == tour.overlaps and again.walls == tour.walls
    assert not comb.with_overlaps(((0, 1, 0.5), *((node, node, 1.0) for node in range(2, 6)))).is_placed(5)


def test_a_walk_ends_half_a_metre_from_the_ends_of_a_poor_edge(comb):
    """Of one shorter than 2 m after a quarter of it."""
    poor = dataclasses.replace(comb, poor=((0, 1),))
    start, end = comb.positions[0], comb.positions[1]
    places = [start + t * (end - start) for t in np.linspace(0, 1, 41)]

    def walk(tour: TourGraph, path: list[np.ndarray]) -> float:
        place = path[0]
        for before, after in itertools.pairwise(path):
            place = tour.limit_step(place, place + after - before)
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
            place = tour.limit_step(place, place + step)
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
