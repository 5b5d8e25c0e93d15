"""Where there is something to see at a panorama."""

import math

import numpy as np
import pytest

from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.gaussians.scene import Scene
from pansplat.tours.outlook import BINS, choose_heading, find_blank, is_hidden, measure_outlook
from pansplat.tours.route import plan_route
from pansplat.tours.surfaces import locate_surfaces


def test_the_outlook_is_the_distance_of_the_walls_around():
    """The room of boxes ends at x of -3.4 and 3, and at z of -2.6 and 3.9."""
    scene = Scene(full_lattice_room(128, views=1), make_room_cameras(1), 0.1, 10.0)
    outlook = measure_outlook(scene, 0, np.eye(3))
    x, _, z = make_room_cameras(1)[0, :3, 3].tolist()
    for yaw, distance in ((0, 3.9 - z), (math.pi / 2, 3.0 - x), (-math.pi / 2, 3.4 + x)):
        bins = [int(((yaw + turn) / (2 * math.pi) + 0.5) * BINS) % BINS for turn in (-0.1, 0.1)]
        assert max(outlook[bins]) == pytest.approx(distance, rel=0.15), yaw


def test_a_flight_turns_from_a_wall_to_the_widest_view(comb):
    wall = np.full(BINS, 3.0)
    wall[BINS // 2 - 3 : BINS // 2 + 4] = 0.6  # ahead, yaw 0
    wall[2:5] = 8.0  # behind on the left
    turned = choose_heading(wall, 0.0)
    assert turned == pytest.approx((3.5 / BINS - 0.5) * 2 * math.pi)
    assert choose_heading(wall, 1.5) == 1.5 and choose_heading(np.zeros(BINS), 0.2) == 0.2
    start = comb.cam2world[0].numpy()
    plain, ended = plan_route(comb, [0, 1, 2], start), plan_route(comb, [0, 1, 2], start, wall)
    assert plain.yaws[-1] == pytest.approx(0, abs=1e-3)
    assert ended.yaws[-1] == pytest.approx(turned, abs=math.radians(2))
    assert np.allclose(ended.pose(1.0)[:3, 3], plain.pose(1.0)[:3, 3])
    assert np.abs(np.diff(ended.yaws)).max() < math.radians(1.0), "not at once"


def test_a_wall_fills_the_blank_directions():
    wall = np.full(BINS, 3.0)
    wall[[0, 1, 2, -1, -2]] = 0.4
    is_blank, widest = find_blank(wall)
    assert np.flatnonzero(is_blank).tolist() == [0, 1, 2, 22, 23] and choose_heading(wall, -math.pi + 0.1) == widest
    assert not find_blank(np.zeros(BINS))[0].any()
    wall[10] = 0.4  # a post
    assert not find_blank(wall)[0][10]


def test_marks_are_hidden_by_what_is_in_front_of_them_only():
    """The floor of the room of boxes is seen to its walls, but for what boxes hide."""
    scene = Scene(full_lattice_room(128, views=1), make_room_cameras(1), 0.1, 10.0)
    places = locate_surfaces(scene, 0, np.eye(3), min_opacity=0.5)
    floor = np.quantile(places[:, 1], 0.99)
    on_floor = places[(places[:, 1] > 0.97 * floor) & (np.abs(places[:, [0, 2]]).max(axis=1) > 1)]
    seen = [is_hidden(places, mark) for mark in on_floor[::10]]
    beyond = [is_hidden(places, 1.6 * mark) for mark in places[np.abs(places[:, 1]) < 0.5][::10]]
    assert len(seen) > 50 and np.mean(seen) < 0.05 and np.mean(beyond) > 0.95
    assert not is_hidden(np.zeros((0, 3)), np.ones(3))
