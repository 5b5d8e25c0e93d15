"""Where there is something to see at a panorama."""

import math

import numpy as np
import pytest

from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.gaussians.scene import Scene
from pansplat.tours import measure_outlook, plan_route
from pansplat.tours.outlook import BINS, choose_heading


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
