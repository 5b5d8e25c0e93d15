"""Graphs of panoramas, walks, smooth routes, overlap of images, and floor plans."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import torch

import pansplat.tours as tours
from pansplat.data.images import write_image
from pansplat.data.pairs import Pair, Panorama
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.tours import TourGraph, connect, draw_floor_plan, find_floor_outline, find_tours, plan_route


def make_panoramas(places, folder=Path()) -> tuple[Panorama, ...]:
    panoramas = []
    for index, (x, z) in enumerate(places):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3], pose[2, 3] = x, z
        panoramas.append(Panorama(f"p{index}", folder / f"p{index}.png", pose))
    return tuple(panoramas)


def make_tour(places, edges) -> TourGraph:
    return TourGraph("tour", Path(), make_panoramas(places), 0.45, 10.0, (), dict.fromkeys(edges, 0.3))


@pytest.fixture
def comb() -> TourGraph:
    """Four panoramas in a row, and one beside the second and the third each."""
    places = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2))
    return make_tour(places, ((0, 1), (1, 2), (2, 3), (1, 4), (2, 5)))


def test_pairs_that_share_panoramas_are_one_tour():
    a, b, c, d, e = make_panoramas([(0, z) for z in range(5)])
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


def test_a_walk_through_a_hundred_panoramas_of_a_grid_is_hardly_longer_than_the_shortest_one():
    places = [(x, z) for x in range(10) for z in range(10)]
    edges = [(a, b) for a, b in itertools.combinations(range(100), 2) if math.dist(places[a], places[b]) == 1]
    walk = make_tour(places, edges).plan_walk()
    assert set(walk) == set(range(100)) and len(walk) <= 104, "99 steps of 1 m are the shortest"


def test_the_scene_of_an_edge_holds_both_ends_and_shares_a_third():
    places = ((0, 0), (0, 1), (1, 0), (3, 0), (3, 0.1))
    tour = make_tour(places, ((0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (2, 4)))
    scenes = tour.choose_scene_views()
    assert scenes[0, 1] == scenes[0, 2] == scenes[1, 2] == (0, 1, 2)
    assert scenes[2, 3] == scenes[3, 4] == (2, 3, 4)
    for edge, views in scenes.items():
        assert set(edge) <= set(views)
    assert make_tour(places, ((0, 1), (2, 3))).choose_scene_views()[2, 3] == (2, 3)


def test_a_walk_over_separate_parts_is_refused():
    tour = make_tour(((0, 0), (0, 1), (2, 0), (3, 0)), ((0, 1), (2, 3)))
    with pytest.raises(InputError, match="needed edges that connect all 4 panoramas"):
        tour.plan_walk()


def test_panoramas_too_close_for_depth_get_a_third():
    tour = make_tour(((0, 0), (0, 0.1), (0, 2)), ((0, 1), (1, 2)))
    assert tour.choose_scene_views()[0, 1] == (0, 1, 2)


def test_one_scene_of_all_panoramas_takes_each_from_the_scene_of_the_largest_overlap():
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


def test_a_merged_scene_has_the_gains_of_all_photographs_relative_to_their_mean():
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


def test_a_route_is_smooth_and_passes_the_panoramas(comb):
    start = np.eye(4)
    start[:3, 3] = 0.3, 0.0, -0.5
    walk = comb.plan_walk(0)
    route = plan_route(comb, walk, start)
    assert np.allclose(route.pose(0), start)
    assert np.allclose(route.pose(1)[:3, 3], comb.positions[walk[-1]])
    poses = np.stack([route.pose(f) for f in np.linspace(0, 1, round(route.seconds * 30) + 1)])
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 1.05 / 30, "at most 1 m/s"
    cosines = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
    turns = np.degrees(np.arccos(np.clip((cosines - 1) / 2, -1, 1)))
    assert turns.max() < 46 / 30, "at most 45 degrees per second"
    distances = np.linalg.norm(poses[:, None, :3, 3] - comb.positions[None], axis=2).min(axis=0)
    assert distances.max() < 0.2
    assert np.allclose(poses[:, :3, 1], (0, 1, 0)), "level"


def test_a_route_reports_its_edges_in_order(comb):
    route = plan_route(comb, [4, 1, 2], comb.cam2world[0].numpy())
    edges = [route.edge(f) for f in np.linspace(0, 1, 200)]
    assert [key for key, _ in itertools.groupby(edges)] == [None, (1, 4), (1, 2)]
    assert route.edges_after(0) == [(1, 4), (1, 2)] and route.edges_after(1) == [(1, 2)]
    assert route.leg(0.0) == -1


def test_a_route_to_the_panorama_at_the_camera_stays_there(comb):
    pose = comb.cam2world[2].numpy()
    route = plan_route(comb, [2], pose)
    assert route.seconds < 3 and route.edge(0.5) is None
    assert np.allclose(route.pose(0.5), pose)


def test_the_camera_looks_along_its_way_in_any_world(comb):
    turn = torch.tensor(((1.0, 0, 0), (0, 0, 1), (0, -1, 0)), dtype=torch.float64)  # z up
    panoramas = []
    for panorama in comb.panoramas:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3] = turn @ panorama.cam2world[:3]
        panoramas.append(Panorama(panorama.name, panorama.image, pose))
    tour = TourGraph("", Path(), tuple(panoramas), 0.45, 10.0, (), comb.overlaps)
    pose = plan_route(tour, [0, 1, 2, 3]).pose(0.5)
    assert np.allclose(pose[:3, 2], turn @ torch.tensor((0.0, 0, 1), dtype=torch.float64), atol=1e-6)
    assert np.allclose(pose[:3, 1], (0, 0, -1))


def draw_room(place, low, high, seed) -> torch.Tensor:
    """A panorama in a box-shaped room with a random pattern on its surfaces."""
    directions, here = pixel_directions(96, 192).double().numpy(), np.array(place)
    far = np.where(directions > 0, high - here, low - here) / (directions + 1e-9)
    points = here + far.min(-1, keepdims=True) * directions
    cells = np.floor(points / 0.4 + 1e-6).astype(int)
    values = np.random.default_rng(seed).random((64, 64, 64, 3))
    return torch.from_numpy(values[tuple((cells + 32).transpose(2, 0, 1))]).float()


def test_panoramas_of_one_room_overlap_and_those_of_two_rooms_do_not(tmp_path):
    places = ((0.0, 0.0), (0.0, 1.0), (0.7, 0.4), (2.7, 0.0))
    panoramas = make_panoramas(places, tmp_path)
    for index, (x, z) in enumerate(places):
        room = ((-1.5, -1.3, -2.0), (1.5, 1.2, 2.0)) if index < 3 else ((1.6, -1.3, -2.0), (4.0, 1.2, 2.0))
        image = draw_room((x, 0.0, z), *map(np.array, room), seed=index // 3)
        write_image(panoramas[index].image, image.numpy())
    tour = TourGraph("", tmp_path, panoramas, 0.45, 10.0, (), {(0, 3): 0.0})
    tasks = []
    overlaps = connect(tour, lambda task, done: tasks.append(done)).overlaps
    assert set(overlaps) == {(0, 1), (0, 2), (1, 2), (0, 3)}, "given edges are kept"
    assert min(overlaps[0, 1], overlaps[0, 2], overlaps[1, 2]) > 0.25 > 0.1 > overlaps[0, 3]
    assert tasks == sorted(tasks) and tasks[-1] < 1


@pytest.fixture(scope="module")
def room_scene() -> Scene:
    """Gaussians on the surfaces of a room 4 m wide and 6 m long, around a camera 1.5 m over its floor; z is up."""
    low, high, count = np.array((-1.0, -2.0, 0.0)), np.array((3.0, 4.0, 2.5)), 20000
    here = np.array((0.5, 0.0, 1.5))
    directions = fibonacci_directions(count).double().numpy() + 1e-9
    far = np.where(directions > 0, high - here, low - here) / directions
    means = here + far.min(-1, keepdims=True) * directions
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor(((1.0, 0, 0), (0, 0, 1), (0, -1, 0)))
    pose[:3, 3] = torch.from_numpy(here)
    zeros = torch.zeros(count, dtype=torch.int64)
    gaussians = Gaussians(
        torch.from_numpy(means).float(),
        torch.full((count, 3), 0.02),
        torch.tensor((1.0, 0, 0, 0)).expand(count, 4),
        torch.ones(count),
        torch.zeros(count, 1, 3),
        zeros,
        zeros,
    )
    return Scene(gaussians, pose[None], 0.45, 10.0)


def test_the_floor_of_a_room_ends_at_its_walls(room_scene):
    level = room_scene.cam2world[0, :3, :3].numpy()
    outline = find_floor_outline(room_scene, 0, level)
    assert outline.camera_height == pytest.approx(1.5, abs=0.01)
    assert np.allclose(outline.center, (0.5, 0.0)), "right is x, forward is y of this world"
    inside = (outline.corners - (-1, -2)) / (4, 6)
    border = np.minimum(inside, 1 - inside).min(axis=1)
    assert np.abs(border).max() < 0.04, "all corners are near a wall"
    scene = Scene(room_scene.gaussians.select(torch.arange(20)), room_scene.cam2world, 0.45, 10.0)
    assert find_floor_outline(scene, 0, level) is None and tours.find_camera_height(scene, 0, level) is None
    assert tours.find_camera_height(room_scene, 0, level) == outline.camera_height
    assert tours.choose_camera_height((1.0, None, 1.4, 1.6), 10.0) == 1.4
    assert tours.choose_camera_height((None,), 10.0) == 1.5


def test_the_plan_shows_the_floor_and_its_walls(room_scene):
    panoramas = (Panorama("a", Path("a"), room_scene.cam2world[0]),)
    tour = TourGraph("", Path(), panoramas, 0.45, 10.0)
    outline = find_floor_outline(room_scene, 0, tour.level_axes)
    plan = draw_floor_plan(tour, [outline], size=200)
    assert max(plan.image.shape[:2]) in (200, 201)

    def alpha(x: float, y: float) -> int:
        column, row = plan.to_pixels(np.array((x, y))).round().astype(int)
        return int(plan.image[row, column, 3])

    assert alpha(0.5, 0) == alpha(2.8, 3.8) == alpha(-0.8, -1.8) == 255
    assert alpha(3.3, 0) == alpha(0.5, 4.3) == alpha(-1.3, -2.3) == 0
    walls = (plan.image[..., 0] > 200).sum() / plan.pixels_per_metre
    assert 20 < walls / 2 < 26, "a line of 2 pixels around 20 m"
    empty = draw_floor_plan(tour, [])
    assert empty.image.max() == 0
    assert math.isfinite(empty.pixels_per_metre)


def test_the_plan_of_a_scene_is_a_file_with_its_panoramas(room_scene, tmp_path):
    tours.write_floor_plan(room_scene, tmp_path / "plan.png")
    with PIL.Image.open(tmp_path / "plan.png") as image:
        colors = np.asarray(image.convert("RGB")).astype(int)
    assert max(colors.shape[:2]) in (1024, 1025)
    assert (np.abs(colors - (90, 204, 255)).max(axis=2) < 12).sum() > 60, "the dot of the panorama"
    empty = dataclasses.replace(room_scene, gaussians=room_scene.gaussians.select(torch.arange(20)))
    for scene in (empty, dataclasses.replace(empty, cam2world=torch.zeros(0, 4, 4, dtype=torch.float64))):
        with pytest.raises(InputError, match="needed a floor below"):
            tours.write_floor_plan(scene, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
