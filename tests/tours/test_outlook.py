"""Where there is something to see at a panorama."""

import dataclasses
import math

import numpy as np
import pytest
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.gaussians.scene import Scene
from pansplat.tours.outlook import (
    BINS,
    find_clearance,
    find_hidden,
    find_turns,
    find_widest,
    measure_clearance,
    measure_outlook,
)
from pansplat.tours.surfaces import Surfaces, find_surfaces


def look(scene: Scene) -> Surfaces:
    return find_surfaces(scene, np.eye(3))[0]


def test_the_outlook_is_the_distance_of_the_walls_around():
    """The room of boxes ends at x of -3.4 and 3, and at z of -2.6 and 3.9."""
    scene = Scene(full_lattice_room(128, views=1), make_room_cameras(1), 0.1, 10.0)
    outlook = measure_outlook(look(scene))
    x, _, z = make_room_cameras(1)[0, :3, 3].tolist()
    for yaw, distance in ((0, 3.9 - z), (math.pi / 2, 3.0 - x), (-math.pi / 2, 3.4 + x)):
        bins = [int(((yaw + turn) / (2 * math.pi) + 0.5) * BINS) % BINS for turn in (-0.1, 0.1)]
        assert max(outlook[bins]) == pytest.approx(distance, rel=0.15), yaw


def test_the_clearance_is_the_distance_of_the_room_around():
    """Above and below, too; the room is 2.6 m high."""
    low, high, camera = np.array((-2.0, -1.1, -3.0)), np.array((2.5, 1.5, 2.0)), np.zeros(3)
    balls = make_balls(see_box(low, high, camera, 20_000), 0.02)
    clearance = measure_clearance(look(Scene(balls, place_cameras((0.0, 0.0, 0.0)), 0.3, 12.0)))
    for axis in range(3):
        for sign, end in ((-1, low), (1, high)):
            direction = sign * np.eye(3)[axis] + 0.01
            found = find_clearance(clearance, direction)
            assert found == pytest.approx(abs(end[axis]), rel=0.05), (axis, sign)
    empty = dataclasses.replace(balls, opacities=0 * balls.opacities)
    nothing = measure_clearance(look(Scene(empty, place_cameras((0.0, 0.0, 0.0)), 0.3, 12.0)))
    assert not nothing.any() and find_clearance(nothing, np.array((0.0, 0.0, 1.0))) == math.inf


def test_the_widest_view_is_over_several_directions_and_the_sky_does_not_count():
    outlook = np.full(BINS, 3.0)
    outlook[2:5] = 8.0  # behind on the left
    outlook[12] = 12.0  # a gap
    assert find_widest(outlook) == pytest.approx((3.5 / BINS - 0.5) * 2 * math.pi)
    sky = np.zeros(BINS)
    sky[6] = 5.0
    assert find_widest(sky) == pytest.approx((5.5 / BINS - 0.5) * 2 * math.pi)


def test_an_arrival_turns_from_a_close_wall_to_the_nearest_open_view():
    outlook = np.full(BINS, 0.8)
    outlook[:4], outlook[14:18] = 4.0, 2.0
    turned = (np.arange(BINS) + np.round(find_turns(outlook) / (2 * math.pi) * BINS).astype(int)) % BINS
    assert turned[[0, 2, 16]].tolist() == [0, 2, 16], "open"
    assert turned[[6, 12, 21]].tolist() == [4, 14, 23], "the nearest one, to the left or right"
    assert not find_turns(np.full(BINS, 0.8)).any() and not find_turns(np.zeros(BINS)).any()


def test_marks_are_hidden_by_what_is_in_front_of_them_only():
    """The floor of the room of boxes is seen to its walls, but for what boxes hide."""
    surfaces = look(Scene(full_lattice_room(128, views=1), make_room_cameras(1), 0.1, 10.0))
    places = surfaces.opaque
    floor = np.quantile(places[:, 1], 0.99)
    on_floor = places[(places[:, 1] > 0.97 * floor) & (np.abs(places[:, [0, 2]]).max(axis=1) > 1)]
    walls = 1.6 * places[np.abs(places[:, 1]) < 0.5][::10]
    seen, beyond = (np.isin(np.arange(len(marks)), find_hidden(surfaces, marks)) for marks in (on_floor[::10], walls))
    assert len(seen) > 50 and np.mean(seen) < 0.05 and np.mean(beyond) > 0.95
    nothing = dataclasses.replace(surfaces, is_opaque=np.zeros_like(surfaces.is_opaque))
    assert not find_hidden(nothing, np.ones((1, 3)))
