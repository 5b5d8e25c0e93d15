"""The scene's axes, found in its edges."""

import math

import numpy as np
import pytest

from pansplat.sweep.frame import main_directions, scene_axes
from pansplat.sweep.sphere import ray_grid


def _degrees_off(found: np.ndarray, wanted: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, float(found @ wanted))))


def _yaw_degrees_off(axes: np.ndarray, placed: np.ndarray) -> float:
    """Smallest turn about the vertical that brings the wall normals onto the room's."""
    in_room = axes[1] @ placed
    turned = math.degrees(math.atan2(in_room[2], in_room[0])) % 90
    return min(turned, 90 - turned)


@pytest.mark.parametrize(("yaw", "pitch", "roll"), ((0, 0, 0), (31, 0, 0), (58, 6, -4), (12, -35, 50)))
def test_a_room_of_bricks_shows_which_way_is_down_and_how_its_walls_run(make_room, observe, turn, yaw, pitch, roll):
    placed = np.eye(4)
    placed[:3, :3] = turn("z", roll) @ turn("x", pitch) @ turn("y", yaw)
    room = make_room(paint="tiles", placed=placed, supersample=8)
    posed = observe(room, [room.pose((-0.4, 0, -0.2)), room.pose((0.4, 0, 0.1), turn("y", 23))], 128).posed
    axes = scene_axes(posed.images, posed.cam2world[:, :3, :3])
    assert _degrees_off(axes[0], placed[:3, 1]) < 1.0
    assert _yaw_degrees_off(axes, placed[:3, :3]) < 1.0


def test_tilted_cameras_do_not_tilt_the_scene(make_room, observe, turn):
    room = make_room(paint="tiles", supersample=8)
    tilt = turn("x", 5) @ turn("z", 4)  # both lean the same way: their mean is 6.4 degrees off
    posed = observe(room, [room.pose((-0.4, 0, -0.2), tilt), room.pose((0.4, 0, 0.1), tilt)], 128).posed
    assert _degrees_off(posed.cam2world[0, :3, 1], np.array((0, 1, 0))) > 6
    axes = scene_axes(posed.images, posed.cam2world[:, :3, :3])
    assert _degrees_off(axes[0], np.array((0, 1, 0))) < 1.2
    assert _yaw_degrees_off(axes, np.eye(3)) < 1.2


@pytest.mark.parametrize("paint", ("blank", "waves", "tiles"))
def test_axes_are_orthonormal(make_room, observe, turn, paint):
    room = make_room(paint=paint)
    posed = observe(room, [room.pose((0, 0, 0), turn("x", 20)), room.pose((0.5, 0, 0), turn("z", 9))], 64).posed
    axes = scene_axes(posed.images, posed.cam2world[:, :3, :3])
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_down_is_the_cameras_mean_where_nothing_shows_an_edge(turn):
    rotations = [turn("z", 12), turn("z", -2)]
    axes = scene_axes([np.full((64, 128, 3), 0.5, np.float32)] * 2, rotations)
    assert _degrees_off(axes[0], turn("z", 5)[:, 1]) < 1e-5


def test_cameras_upside_down_to_each_other_still_give_axes(turn):
    axes = scene_axes([np.full((64, 128, 3), 0.5, np.float32)] * 2, [np.eye(3), turn("z", 180)])
    assert np.isfinite(axes).all() and np.allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_main_directions_are_the_rays_in_the_scenes_axes(turn):
    rotation, axes = turn("y", 40) @ turn("x", 10), turn("z", 25)
    directions = main_directions(axes, rotation, 32)
    rays = ray_grid(32) @ rotation.T
    assert np.allclose(directions, np.moveaxis(rays @ axes.T, -1, 0), atol=1e-6)
