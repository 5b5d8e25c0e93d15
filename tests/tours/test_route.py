"""Smooth flights through panoramas."""

import dataclasses
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat.inputs.folders import load_pairs
from pansplat.inputs.pairs import Panorama
from pansplat.tours.floor import assign_storeys
from pansplat.tours.graph import TourGraph, find_tours
from pansplat.tours.route import plan_route


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


def test_a_route_to_the_only_panorama_of_its_walk_flies_there(comb):
    start = np.eye(4)
    start[2, 3] = 1.4
    walk = comb.find_way(start[:3, 3], 2)
    route = plan_route(comb, walk, start)
    assert walk == [2] and route.walk == (2,), "an end of the edge at the camera"
    assert np.allclose(route.pose(0), start) and np.allclose(route.pose(1)[:3, 3], comb.positions[2])


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


def test_a_route_goes_along_a_link_then_jumps_and_looks_away_from_the_link_back(home):
    route = plan_route(home, [1, 2, 3, 6])
    assert route.fades == (1, 2) and len(route.jumps) == 2
    assert route.edges == ((1, 2), (3, 3), (6, 6))
    before, after = route.jumps[0], route.jumps[0] + 1
    assert np.allclose(route.positions[before], home.positions[2] + (-0.7, 0, 0)), "0.7 m to the left"
    assert math.remainder(route.yaws[before] + math.pi / 2, 2 * math.pi) == pytest.approx(0, abs=0.02)
    assert np.allclose(route.positions[after], home.positions[3]) and math.cos(route.yaws[after]) == pytest.approx(1)
    assert route.legs[before] == 0 and set(route.legs[after : route.jumps[1] + 1]) == {1}
    assert np.allclose(route.positions[route.jumps[1]], home.positions[3] + (0, 0, 0.7))
    last = route.jumps[1] + 1
    assert np.allclose(route.positions[last:], home.positions[6]) and math.cos(route.yaws[last]) == pytest.approx(1)
    assert math.sin(route.yaws[-1]) == pytest.approx(1, abs=1e-3), "the last panorama, which is alone, is seen, too"
    assert len(route.yaws) - last > 3 * 60, "for more than the second of the fade"
    way = plan_route(home, [3, 6], home.cam2world[3].numpy())
    assert math.cos(way.yaws[-1]) == pytest.approx(1), "a way to it ends in the direction of arrival"
    steps = np.linalg.norm(np.diff(route.positions, axis=0), axis=1)
    assert steps[np.delete(np.arange(len(steps)), route.jumps)].max() < 1.05 / 60, "only the jumps are fast"
    count = 7 * len(route.yaws)
    places = np.stack([route.pose(k / count)[:3, 3] for k in range(count + 1)])
    assert np.linalg.norm(places[:, None] - home.positions[None], axis=2).min(axis=1).max() < 0.8, "never between parts"
    seen = [route.edge(k / count) for k in range(count + 1)]
    assert [edge for edge, _ in itertools.groupby(seen)] == [(1, 2), (3, 3), (6, 6)]


def test_a_fade_without_a_link_begins_at_once_and_ends_in_the_start_view_or_the_heading(home):
    start = home.cam2world[3].numpy().copy()
    start[:3, 3] += 0.3
    start[:3, :3] = ((0, 0, 1), (0, 1, 0), (-1, 0, 0))  # looks to the right
    kept = plan_route(home, [3, 4, 5], start)
    (jump,) = kept.jumps
    assert np.allclose(kept.positions[: jump + 1], start[:3, 3]) and kept.legs[jump] == -1 and kept.edges[0] == (4, 5)
    assert kept.yaws[jump + 1] == pytest.approx(math.pi / 2)
    panoramas = list(home.panoramas)
    panoramas[4] = dataclasses.replace(panoramas[4], start=(-0.5, 0.2))
    tour = dataclasses.replace(home, panoramas=tuple(panoramas))
    route = plan_route(tour, [3, 4], start)
    assert route.yaws[-1] == pytest.approx(-0.5) and route.pitches[-1] == pytest.approx(-0.2)


@pytest.mark.parametrize(("unit", "origin"), [(1e3, (0, 0, 0)), (1.0, (5e6, 4e5, 120)), (1e3, (5e9, 4e8, 1e5))])
def test_a_home_in_another_unit_or_far_from_the_origin_has_the_same_flight_and_graph(
    tmp_path: Path, unit: float, origin: tuple[float, float, float]
) -> None:
    metres, other = _load_home(tmp_path / "metres"), _load_home(tmp_path / "other", unit, origin)
    assert np.ptp(other.positions, axis=0).max() == pytest.approx(9.0), "metres again"
    assert metres.plan_walk() == other.plan_walk() and list(metres.overlaps) == list(other.overlaps)
    assert assign_storeys(metres) == assign_storeys(other) == [0, 0, 0, 1, 1]
    ours, theirs = (plan_route(tour, tour.plan_walk()) for tour in (metres, other))
    assert theirs.seconds == ours.seconds and 9 < ours.seconds < 60
    edges = []
    for tour, route in ((metres, ours), (other, theirs)):
        edge, followed = (0, 1), []
        for fraction in np.linspace(0, 1, 40):
            edge = tour.follow_edge(route.pose(fraction)[:3, 3] + (0.1, 0, 0), edge)
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
    (tour,) = find_tours(load_pairs(folder))
    return tour
