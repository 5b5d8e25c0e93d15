"""Scenes of whole tours, and their graphs."""

import dataclasses
import math

import numpy as np
import torch
from synthetic_scenes import make_balls

from pansplat.gaussians.scene import Scene, SceneTour, empty_gaussians
from pansplat.inputs.placements import ApproximatePlace, Placement
from pansplat.tours.linked_rooms import find_stated_place
from pansplat.tours.merge import merge_scenes, select_views
from pansplat.tours.scene_graph import make_graph
from pansplat.tours.scene_views import choose_sources


def test_one_scene_of_all_panoramas_takes_each_from_the_scene_of_the_largest_overlap(make_tour):
    tour = make_tour(((0, 0), (0, 1), (1, 0), (3, 0)), ())
    overlaps = {(0, 1): 0.3, (0, 2): 0.2, (1, 2): 0.25, (2, 3): 0.5}
    tour = dataclasses.replace(tour, overlaps=overlaps)
    assert choose_sources(tour) == {(2, 3): (2, 3), (0, 1, 2): (0, 1)}
    assert choose_sources(tour, 4) == {(0, 1, 2, 3): (0, 1, 2, 3)}, "a predictor of four views is given the part"
    loaded = []

    def load(views: tuple[int, ...]) -> Scene:
        loaded.append(views)
        count = 10 * len(views)
        labels = torch.arange(count) % len(views)
        means = torch.tensor(views)[labels, None].float().expand(count, 3)
        gaussians = make_balls(means, 1.0, views=labels.byte())
        return Scene(gaussians, tour.cam2world[list(views)], 1.0, 2.0)

    scene = merge_scenes(tour, load)
    assert loaded == [(2, 3), (0, 1, 2)]
    assert scene.gaussians.views.tolist() == [0] * 10 + [1] * 10 + [2] * 10 + [3] * 10
    assert scene.gaussians.means[:, 0].equal(scene.gaussians.views.float())
    assert scene.names == ("p0", "p1", "p2", "p3") and scene.cam2world.equal(tour.cam2world)
    assert (scene.near, scene.far) == (0.45, 10.0)
    part = select_views(scene, (3, 1))
    assert part.gaussians.means[:, 0].tolist() == [1] * 10 + [3] * 10
    assert part.gaussians.views.tolist() == [1] * 10 + [0] * 10 and part.names == ("p3", "p1")
    assert part.cam2world.equal(tour.cam2world[[3, 1]]) and part.tour is None


def test_a_merged_scene_has_the_gains_of_all_photographs_relative_to_their_mean(make_tour):
    tour = make_tour(((0, 0), (0, 1), (0, 2)), ((0, 1), (1, 2)))
    truth = np.array(((1.0, 1.1, 0.9), (2.0, 1.8, 2.2), (0.5, 0.6, 0.4)))
    expected = truth / np.exp(np.log(truth).mean(axis=0))

    def load(views: tuple[int, ...], refined: bool = True) -> Scene:
        gains = truth[list(views)] / np.exp(np.log(truth[list(views)]).mean(axis=0))  # relative to those of the scene
        known = tuple(map(tuple, gains.tolist())) if refined else ()
        return Scene(empty_gaussians(), tour.cam2world[list(views)], 1.0, 2.0, gains=known)

    assert set(choose_sources(tour)) == {(0, 1), (1, 2)}
    assert np.allclose(merge_scenes(tour, load).gains, expected)
    assert merge_scenes(tour, lambda views: load(views, refined=False)).gains == ()


def test_a_merged_scene_of_parts_has_their_links_titles_and_gains(home):
    title, start = "living <room>", (9.0, 0.1)
    panoramas = list(home.panoramas)
    panoramas[3] = dataclasses.replace(panoramas[3], title=title, start=start)
    panoramas[6] = dataclasses.replace(panoramas[6], title=title)
    tour = dataclasses.replace(home, panoramas=tuple(panoramas))

    def load(views: tuple[int, ...]) -> Scene:
        gains = ((2.0,) * 3, (0.5,) * 3)[: len(views)] if len(views) > 1 else ((1.0,) * 3,)
        return Scene(empty_gaussians(), tour.cam2world[list(views)], 1.0, 2.0, gains=gains)

    scene = merge_scenes(tour, load)
    assert scene.names == ("p0", "p1", "p2", title, "p4", "p5", title)
    gains = np.array(scene.gains)
    assert np.allclose(gains[[3, 6]], 1) and np.allclose(gains[[4, 5]], [[2] * 3, [0.5] * 3])
    assert scene.starts == (None,) * 3 + ((9.0 - 2 * math.pi, 0.1),) + (None,) * 3
    again = make_graph(scene)
    assert again.overlaps == tour.overlaps and set(again.links) == set(tour.links) and again.parts == tour.parts
    assert again.links[2, 3].text == "to the hall"
    assert np.allclose(again.find_direction(2, 3), tour.find_direction(2, 3))
    assert [panorama.label for panorama in again.panoramas] == list(scene.names)
    part = select_views(scene, (3,))
    assert part.names == (title,) and part.starts == () and part.tour is None


def test_links_of_a_scene_lead_to_their_ends_whatever_the_titles_are():
    titles, ends = ("Hall", "Bath", "Bath (2)", "Bath", ""), (1, 2, 3, 4, 0)
    links = tuple((start, end, 0.0, 0.0, "") for start, end in enumerate(ends))
    edges = tuple((view, view, 1.0) for view in range(5))
    scene = Scene(empty_gaussians(), torch.eye(4).repeat(5, 1, 1), 1.0, 2.0, titles, tour=SceneTour(edges, links))
    tour = make_graph(scene)
    assert set(tour.links) == {*enumerate(ends)} and make_graph(scene) is tour, "made once"
    assert tuple(panorama.title for panorama in tour.panoramas) == titles


def test_a_panorama_at_an_approximate_place_is_shown_there_and_stays_where_no_camera_flies(home):
    """p3 is 1 m to the right and 2 m ahead of p2, and is turned by a quarter to the right."""
    about = ApproximatePlace(home.panoramas[2].image, 1.0, 2.0, math.pi / 2, ("p2",))
    panoramas = list(home.panoramas)
    panoramas[3] = dataclasses.replace(panoramas[3], placement=Placement("not placed", about=about))
    tour = dataclasses.replace(home, panoramas=tuple(panoramas))
    scene = merge_scenes(tour, lambda views: Scene(empty_gaussians(), tour.cam2world[list(views)], 1.0, 2.0))
    for drawn in (tour, make_graph(scene)):
        assert list(drawn.approximate) == [3] and drawn.approximate[3][0] == 2
        axes = drawn.level_axes[:, (0, 2)]
        places = drawn.positions[3] @ axes + np.array(((0, 0), (0, 1), (1, 0)))  # the camera, ahead, to the right
        shown = find_stated_place(drawn, 3).move(places)
        assert np.allclose(shown, drawn.positions[2] @ axes + np.array(((1, 2), (2, 2), (1, 1))))
        assert drawn.parts == home.parts and not drawn.is_placed(3)
        assert np.allclose(drawn.positions, home.positions) and drawn.overlaps == home.overlaps
    joined = dataclasses.replace(tour, overlaps=home.overlaps | {(2, 3): 0.5})
    assert joined.approximate == {}, "one that is placed is where it is"
