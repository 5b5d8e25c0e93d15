"""The scene's axes and planes."""

import math

import numpy as np
import pytest

from pansplat.sweep.axes import estimate_axes


def _degrees_off(found: np.ndarray, true: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, float(found @ true))))


def _yaw_degrees_off(axes: np.ndarray, room2world: np.ndarray) -> float:
    """Smallest turn about the vertical that brings the wall normals onto the room's."""
    in_room = axes[1] @ room2world
    turned = math.degrees(math.atan2(in_room[2], in_room[0])) % 90
    return min(turned, 90 - turned)


@pytest.mark.slow
@pytest.mark.parametrize(("yaw", "pitch", "roll"), ((0, 0, 0), (58, 6, -4), (12, -35, 50)))
def test_down_and_the_wall_normals_are_found_in_a_room_of_bricks(make_room, turn, yaw, pitch, roll):
    room2world = np.eye(4)
    room2world[:3, :3] = turn("z", roll) @ turn("x", pitch) @ turn("y", yaw)
    room = make_room(paint="tiles", room2world=room2world, supersample=8)
    posed = room.observe(128, [room.pose((-0.4, 0, -0.2)), room.pose((0.4, 0, 0.1), turn("y", 23))]).posed
    axes = estimate_axes(posed.images, posed.cam2world[:, :3, :3])
    assert _degrees_off(axes[0], room2world[:3, 1]) < 1.0
    assert _yaw_degrees_off(axes, room2world[:3, :3]) < 1.0


def test_tilted_cameras_do_not_tilt_the_scene(make_room, turn):
    room = make_room(paint="tiles", supersample=8)
    tilt = turn("x", 5) @ turn("z", 4)  # the same for both cameras: their mean is 6.4 degrees off
    posed = room.observe(128, [room.pose((-0.4, 0, -0.2), tilt), room.pose((0.4, 0, 0.1), tilt)]).posed
    assert _degrees_off(posed.cam2world[0, :3, 1], np.array((0, 1, 0))) > 6
    axes = estimate_axes(posed.images, posed.cam2world[:, :3, :3])
    assert _degrees_off(axes[0], np.array((0, 1, 0))) < 1.2
    assert _yaw_degrees_off(axes, np.eye(3)) < 1.2


def test_without_edges_down_is_the_mean_of_the_cameras(turn):
    rotations = [turn("z", 12), turn("z", -2)]
    axes = estimate_axes([np.full((64, 128, 3), 0.5, np.float32)] * 2, rotations)
    assert _degrees_off(axes[0], turn("z", 5)[:, 1]) < 1e-5


def test_cameras_upside_down_to_each_other_give_orthonormal_axes(turn):
    axes = estimate_axes([np.full((64, 128, 3), 0.5, np.float32)] * 2, [np.eye(3), turn("z", 180)])
    assert np.isfinite(axes).all() and np.allclose(axes @ axes.T, np.eye(3), atol=1e-12)
