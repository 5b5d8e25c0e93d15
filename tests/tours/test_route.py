"""Ways through panoramas: turns, flights and zooms."""

import dataclasses
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat.geometry.level import find_direction, turn_axes
from pansplat.inputs.folders import load_sets
from pansplat.inputs.panorama_sets import Panorama
from pansplat.tours.floor import assign_storeys
from pansplat.tours.graph import TourGraph, find_tours
from pansplat.tours.limits import follow_edge
from pansplat.tours.route import Moment, Route, find_offset, plan_route
from pansplat.tours.walks import find_way, plan_walk


def _start(tour: TourGraph, node: int, yaw: float = 0.0) -> np.ndarray:
    """The pose of a camera at a panorama of a world with y down."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn_axes(np.eye(3), yaw, 0.0), tour.positions[node]
    return pose


def _look(tour: TourGraph, node: int) -> np.ndarray:
    """The direction of the view that a visitor of a panorama sees first."""
    yaw, pitch = tour.panoramas[node].start
    return find_direction(tour.cam2world[node], yaw, pitch).numpy()


def _watch(route: Route, rate: int = 60) -> list[Moment]:
    """Moments of a route."""
    count = round(route.seconds * rate)
    return [route.at(k / count) for k in range(count + 1)]


def _angle(first: np.ndarray, second: np.ndarray) -> float:
    """Between the directions of two poses, degrees."""
    return math.degrees(math.acos(min(max(float(first[:3, 2] @ second[:3, 2]), -1.0), 1.0)))


def test_the_camera_turns_at_the_photograph_flies_ahead_and_arrives_at_the_photograph(comb):
    route = plan_route(comb, [0, 1, 4], _start(comb, 0, math.pi / 2))
    assert [step.kind for step in route.steps] == ["turn", "flight", "turn", "flight"]
    assert [step.seconds for step in route.steps] == pytest.approx([0.4, 1.0, 0.4, 1.0])
    moments = _watch(route)
    for moment in moments:
        step, place = moment.step, moment.pose[:3, 3]
        ends = [comb.positions[node] for node in step.nodes]
        if step.kind == "turn":
            assert np.allclose(place, ends[0]) and (moment.photograph, moment.weight) == (step.nodes[0], 1)
            continue
        way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        assert np.allclose(moment.pose[:3, 2], way), "ahead"
        part = float((place - ends[0]) @ way)
        assert np.allclose(place, ends[0] + part * way)
        nearest = step.nodes[part > 0.499]
        expected = 1 if min(part, 1 - part) < 0.1 else 0 if 0.2 < part < 0.8 else moment.weight
        assert moment.photograph == nearest and moment.weight == pytest.approx(expected)
        assert np.allclose(moment.pose[:3, 1], (0, 1, 0)), "level"
    for before, after in itertools.pairwise(moments):
        assert np.linalg.norm(after.pose[:3, 3] - before.pose[:3, 3]) < 1.51 / 60, "eased"
        assert _angle(before.pose, after.pose) < 90 / 0.4 * 1.51 / 60 and abs(after.weight - before.weight) < 0.25
    assert np.allclose(route.pose(1)[:3, 3], comb.positions[4]) and np.allclose(route.pose(1)[:3, 2], (1, 0, 0))


def test_a_flight_takes_1_to_1_6_seconds_and_a_small_turn_less_than_a_large_one(make_tour):
    tour = make_tour(((0, 0), (0, 0.3), (0, 4.3), (0, 20)), ((0, 1), (1, 2), (2, 3)))
    route = plan_route(tour, [0, 1, 2, 3], _start(tour, 0, math.radians(9)))
    assert [step.seconds for step in route.steps] == pytest.approx([0.2 * 0.4, 1.0, 1.2, 1.6])


def test_a_route_ends_in_the_start_view_and_passes_those_on_the_way(comb):
    panoramas = [dataclasses.replace(view, start=(-0.5, 0.2)) for view in comb.panoramas]
    tour = dataclasses.replace(comb, panoramas=tuple(panoramas))
    route = plan_route(tour, [0, 1, 2], _start(tour, 0))
    assert [step.kind for step in route.steps] == ["flight", "flight", "turn"]
    assert np.allclose(route.pose(1)[:3, 2], _look(tour, 2))
    visits = plan_route(tour, [0, 1, 0, 4], rest=1.5)
    kinds = [step.kind for step in visits.steps if step.kind != "turn"]
    assert kinds == ["rest", "flight", "rest", "flight", "flight", "rest"]
    assert list(visits.visits) == [0, 1, 4], "once"
    for node, at in visits.visits.items():
        moment = visits.at(at)
        assert (moment.photograph, moment.weight) == (node, 1) and np.allclose(moment.pose[:3, 2], _look(tour, node))


def test_a_route_reports_its_edges_in_order(comb):
    route = plan_route(comb, [4, 1, 2], comb.cam2world[0].numpy())
    edges = [route.at(f).step.edge for f in np.linspace(0, 1, 200)]
    assert [key for key, _ in itertools.groupby(edges)] == [None, (1, 4), (1, 2)]
    assert list(dict.fromkeys(route.edges_after(0))) == [(1, 4), (1, 2)] and route.edges_after(1) == [(1, 2)]
    assert [route.list_remaining(f) for f in (0.0, 0.55, 0.9, 1.0)] == [(4, 1, 2), (1, 2), (2,), (2,)]


def test_a_route_to_the_panorama_at_the_camera_stays_there(comb):
    pose = comb.cam2world[2].numpy()
    route = plan_route(comb, [2], pose)
    assert 0 < route.seconds < 1 and np.allclose(route.pose(0.5), pose) and route.at(0.5).photograph == 2


def test_a_route_to_the_only_panorama_of_its_walk_flies_there(comb):
    start = np.eye(4)
    start[2, 3] = 1.4
    walk = find_way(comb, start[:3, 3], 2)
    route = plan_route(comb, walk, start)
    assert walk == [2] and route.walk == (2,), "an end of the edge at the camera"
    assert np.allclose(route.pose(0), start) and np.allclose(route.pose(1)[:3, 3], comb.positions[2])
    assert route.at(0).weight == 0, "no photograph where there is no panorama"
    way = plan_route(comb, [1], _start(comb, 0))
    assert way.at(0).photograph == 0 and way.at(0).weight == 1 and way.edges_after(0) == [(0, 1)]


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


def test_a_zoom_turns_to_the_link_grows_and_arrives_away_from_the_link_back(home):
    route = plan_route(home, [2, 3], _start(home, 2))
    assert [step.kind for step in route.steps] == ["turn", "zoom", "rest"]
    assert [step.seconds for step in route.steps] == pytest.approx([0.4, 0.7, 0.1])
    zoom = [moment for moment in _watch(route) if moment.arrival is not None]
    link = turn_axes(np.eye(3), -math.pi / 2, -0.2)[:, 2]  # the ring is lower, 0.4
    for moment in zoom:
        assert np.allclose(moment.pose[:3, 3], home.positions[2]) and np.allclose(moment.pose[:3, 2], link)
        assert moment.step.nodes == (2, 3) and moment.weight == 1, "no Gaussians"
        assert np.allclose(moment.arrival[:3, 3], home.positions[3]) and np.allclose(moment.arrival[:3, 2], (0, 0, 1))
    shares = [moment.arrived for moment in zoom]
    assert shares[0] < 0.01 and shares[-1] > 0.99 and np.diff(shares).min() > 0 and np.diff(shares).max() < 2 / 42
    assert [zoom[k].narrowing for k in (0, -1)] == pytest.approx([1, 2 / 3], abs=0.01)
    assert np.allclose(route.pose(1), zoom[-1].arrival) and route.at(1).photograph == 3
    assert [route.at(f).step.edge for f in (0, 0.9, 1)] == [(1, 2), (1, 2), (3, 3)]
    onward = plan_route(home, [2, 3, 6, 4, 5], _start(home, 2))
    assert list(dict.fromkeys(onward.edges_after(0))) == [(1, 2), (3, 3), (6, 6), (4, 5)]


def test_a_zoom_without_a_link_grows_where_the_camera_looks_and_arrives_in_the_start_view_or_a_wide_one(home):
    start, wide = _start(home, 3, math.pi / 2), np.full(24, 3.0)
    wide[2:5] = 8.0
    route = plan_route(home, [3, 4], start)
    assert route.steps[0].kind == "zoom"
    assert np.allclose(route.pose(0), start) and np.allclose(route.pose(1)[:3, 2], start[:3, 2])
    turned = plan_route(home, [3, 4], start, outlooks={4: wide})
    assert math.atan2(*(turned.level.T @ turned.pose(1)[:3, 2])[::2]) == pytest.approx((3.5 / 24 - 0.5) * 2 * math.pi)
    panoramas = list(home.panoramas)
    panoramas[4] = dataclasses.replace(panoramas[4], start=(-0.5, 0.2))
    tour = dataclasses.replace(home, panoramas=tuple(panoramas))
    viewed = plan_route(tour, [3, 4], start, outlooks={4: wide})
    assert np.allclose(viewed.pose(1)[:3, 2], _look(tour, 4))


def test_a_way_ends_beside_a_wall_that_is_close_unless_a_start_view_is_stated(comb, home):
    closed = np.full(24, 4.0)
    closed[8:16] = 0.5  # ahead
    walls = dict.fromkeys(range(7), closed)
    for tour, walk in ((comb, [0, 1]), (home, [2, 3])):  # a flight, a zoom away from the link back
        start = _start(tour, walk[0])
        straight, turned = (plan_route(tour, walk, start, outlooks=seen).pose(1) for seen in ({}, walls))
        assert np.allclose(straight[:3, 2], (0, 0, 1)) and 30 <= _angle(straight, turned) <= 60
    panoramas = tuple(dataclasses.replace(view, start=(0.0, 0.0)) for view in comb.panoramas)
    stated = dataclasses.replace(comb, panoramas=panoramas)
    assert np.allclose(plan_route(stated, [0, 1], _start(comb, 0), outlooks=walls).pose(1)[:3, 2], (0, 0, 1))


def test_along_a_poor_edge_the_camera_zooms_in_the_direction_of_the_other_panorama(comb):
    poor = dataclasses.replace(comb, poor=((1, 4),))
    route = plan_route(poor, [0, 1, 4], _start(poor, 0))
    assert [step.kind for step in route.steps] == ["flight", "turn", "zoom", "rest"]
    assert np.allclose(route.at(0.9).pose[:3, 2], (1, 0, 0)) and np.allclose(route.pose(1)[:3, 2], (1, 0, 0))


def test_beside_its_panorama_a_photograph_is_seen_as_if_surfaces_were_2_5_metres_away():
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn_axes(np.eye(3), math.pi / 2, 0.0), (1, 2, 3)
    assert np.allclose(find_offset(pose, np.array((1.5, 2, 3))), (0, 0, 0.2)), "in its axes: it looks to the right"
    assert np.allclose(find_offset(pose, np.array((9, 2, 3))), (0, 0, 0.4)), "never near the surfaces"
    assert not find_offset(pose, pose[:3, 3]).any()


def test_a_home_in_another_unit_far_from_the_origin_has_the_same_flight_and_graph(tmp_path: Path) -> None:
    metres, other = _load_home(tmp_path / "metres"), _load_home(tmp_path / "other", 1e3, (5e9, 4e8, 1e5))
    assert np.ptp(other.positions, axis=0).max() == pytest.approx(9.0), "metres again"
    assert plan_walk(metres) == plan_walk(other) and list(metres.overlaps) == list(other.overlaps)
    assert assign_storeys(metres) == assign_storeys(other) == [0, 0, 0, 1, 1]
    ours, theirs = (plan_route(tour, plan_walk(tour)) for tour in (metres, other))
    assert theirs.seconds == pytest.approx(ours.seconds) and 4 < ours.seconds < 60
    edges = []
    for tour, route in ((metres, ours), (other, theirs)):
        edge, followed = (0, 1), []
        for fraction in np.linspace(0, 1, 40):
            edge = follow_edge(tour, route.pose(fraction)[:3, 3] + (0.1, 0, 0), edge)
            followed.append(edge)
        edges.append(followed)
    assert edges[0] == edges[1] and len(set(edges[0])) > 1


def _load_home(folder: Path, unit: float = 1.0, origin: tuple[float, float, float] = (0, 0, 0)) -> TourGraph:
    """A home of two storeys, 9 m long, whose cameras look about, from a poses.json."""
    folder.mkdir()
    poses = {}
    for number, place in enumerate(((0, 0, 0), (0, 0, 4.5), (0, 0, 9), (2, -3, 9), (2, -3, 5))):
        Image.new("RGB", (64, 32), (20 * number, 90, 40)).save(folder / f"{number}.png")
        pose = np.eye(4)
        pose[:3, 3] = unit * np.array(place) + origin
        poses[f"{number}.png"] = pose.tolist()
    content = {"convention": "cam2world opencv", "near": 0.45 * unit, "far": 10.0 * unit, "poses": poses}
    (folder / "poses.json").write_text(json.dumps(content))
    (tour,) = find_tours(load_sets(folder))
    return tour
