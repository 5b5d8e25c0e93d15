"""The scene's axes and planes."""

import math

import numpy as np
import pytest

from pansplat.sweep.planes import estimate_axes, mark_separating_planes, measure_vertical_bounds
from pansplat.sweep.surface import Surface, world_points


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


_AXES = np.array(((0.0, 1, 0), (1, 0, 0), (0, 0, 1)))  # down and the room's two wall normals


def _orient_surfaces(room, poses, surfaces) -> list[Surface]:
    """Surfaces of the walls of a room, with the true orientation of every pixel."""
    low, high = np.array(room.low) @ _AXES.T, np.array(room.high) @ _AXES.T
    oriented = []
    for pose, surface in zip(poses, surfaces, strict=True):
        points = world_points(surface, pose) @ _AXES.T
        wall = np.minimum(np.abs(points - low), np.abs(points - high)).argmin(axis=-1)
        oriented.append(Surface(surface.inverse_depth, (wall + 1).astype(np.uint8)))
    return oriented


@pytest.fixture(scope="module")
def oriented(empty_room) -> list[Surface]:
    return _orient_surfaces(empty_room.room, empty_room.posed.cam2world, empty_room.make_exact_surfaces())


def test_vertical_bounds_contain_the_floor_and_the_ceiling(oriented, empty_room, view):
    poses, masks, room = empty_room.posed.cam2world[:: -1 if view else 1], empty_room.posed.masks, empty_room.room
    down, up = measure_vertical_bounds(oriented[:: -1 if view else 1], list(masks), poses, _AXES[0], 0.5)
    floor, ceiling = room.high[1] - poses[0, 1, 3], room.low[1] - poses[0, 1, 3]
    assert floor < down < 1.15 * floor + 0.1
    assert 1.15 * ceiling - 0.1 < up < ceiling


def test_without_consistent_horizontal_surface_there_are_no_bounds(oriented, empty_room):
    poses, masks = empty_room.posed.cam2world, empty_room.posed.masks
    nothing = [np.zeros_like(mask) for mask in masks]
    spheres = [Surface.unoriented(surface.inverse_depth) for surface in oriented]
    for surfaces, consistent in ((oriented, nothing), (spheres, list(masks))):
        assert measure_vertical_bounds(surfaces, consistent, poses, _AXES[0], 0.5) == (math.inf, -math.inf)


def test_planes_between_two_cameras_are_separating():
    """Cameras at x = 0 and x = 1, planes across x."""
    here, there = np.eye(4), np.eye(4)
    there[0, 3] = 1.0
    inverse = 1 / np.array((0.5, 0.9, 1.1, 3.0))
    across, down = _AXES[1], _AXES[0]
    expected = np.array(((False,) * 4, (True, True, False, False)))
    assert np.array_equal(mark_separating_planes(across, here, there, inverse), expected)
    assert np.array_equal(mark_separating_planes(across, there, here, inverse), expected[::-1])
    assert not mark_separating_planes(down, here, there, inverse).any()
