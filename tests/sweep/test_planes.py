"""The scene's axes and planes."""

import dataclasses
import math

import numpy as np
import pytest

from pansplat.sweep.matching import DepthRange, MatchingConfig, View
from pansplat.sweep.planes import (
    ScenePlanes,
    axis_components,
    collect_planes,
    detect_planes,
    estimate_axes,
    make_empty_planes,
)
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


@pytest.fixture(scope="module")
def planes(empty_room) -> ScenePlanes:
    """From the exact surfaces, with the true orientation of every pixel."""
    room, poses = empty_room.room, empty_room.posed.cam2world
    surfaces = []
    for pose, plain in zip(poses, empty_room.make_exact_surfaces(), strict=True):
        points = world_points(plain, pose) @ _AXES.T
        low, high = np.array(room.low) @ _AXES.T, np.array(room.high) @ _AXES.T
        wall = np.minimum(np.abs(points - low), np.abs(points - high)).argmin(axis=-1)
        surfaces.append(Surface(plain.inverse_depth, (wall + 1).astype(np.uint8)))
    return collect_planes(surfaces, list(empty_room.posed.masks), poses, make_empty_planes(poses, _AXES, 0.5, 8.0))


def test_every_wall_has_support_at_its_distance_and_none_between(planes, empty_room, view):
    pose = empty_room.posed.cam2world[view]
    low, high = (np.array(corner) @ _AXES.T for corner in (empty_room.room.low, empty_room.room.high))
    centre = pose[:3, 3] @ _AXES.T
    for axis in range(3):
        distances = np.array((centre[axis] - low[axis], high[axis] - centre[axis]))
        support = planes.support(axis, pose, 1 / distances)
        assert support[0, 0] > 0.9 and support[1, 1] > 0.9
        assert planes.support(axis, pose, 1 / (0.7 * distances)).max() < 0.1


def test_vertical_bounds_contain_the_floor_and_the_ceiling(planes, empty_room, view):
    pose, room = empty_room.posed.cam2world[view], empty_room.room
    down, up = planes.vertical_bounds(pose)
    floor, ceiling = room.high[1] - pose[1, 3], room.low[1] - pose[1, 3]
    assert floor < down < 1.15 * floor + 0.1
    assert 1.15 * ceiling - 0.1 < up < ceiling


def test_votes_support_a_plane_without_any_surface(empty_room):
    poses = empty_room.posed.cam2world
    nothing = make_empty_planes(poses, _AXES, 0.45, 8.0)
    votes = np.zeros_like(nothing.votes)
    votes[0, nothing.offsets.searchsorted(1.2)] = 0.7
    voted = dataclasses.replace(nothing, votes=votes)
    distance = voted.offsets[voted.votes[0].argmax()] - poses[0][1, 3] + voted.origin[1]
    assert voted.support(0, poses[0], np.array((1 / distance,)))[1, 0] == pytest.approx(0.7)
    assert nothing.support(0, poses[0], np.array((1 / distance,))).max() == 0


def test_a_detected_floor_overrides_the_floor_of_surfaces(planes, empty_room):
    pose = empty_room.posed.cam2world[0]
    voted = dataclasses.replace(planes, floor_ceiling=(2.0, -np.inf)).vertical_bounds(pose)
    below = 2.0 - (pose[1, 3] - planes.origin[1])
    assert voted[0] == pytest.approx(1.06 * below + planes.bin)
    assert voted[1] == planes.vertical_bounds(pose)[1]


def test_planes_between_two_cameras_are_separating():
    """Cameras at x = 0 and x = 1, planes across x."""
    here, there = np.eye(4), np.eye(4)
    there[0, 3] = 1.0
    nothing = make_empty_planes(np.stack((here, there)), _AXES, 0.5, 8.0)
    distance = np.array((0.5, 0.9, 1.1, 3.0))
    assert np.array_equal(nothing.separating(1, here, there, 1 / distance), ((False,) * 4, (True, True, False, False)))
    assert np.array_equal(nothing.separating(1, there, here, 1 / distance), ((True, True, False, False), (False,) * 4))
    assert not nothing.separating(0, here, there, 1 / distance).any()


def _detect(posed, images=None, masks=None) -> ScenePlanes:
    """The planes that the views of posed images vote for, with other images or masks."""
    images, masks = posed.images if images is None else images, posed.masks if masks is None else masks
    rays = [axis_components(_AXES, pose[:3, :3], images.shape[1]) for pose in posed.cam2world]
    views = [
        View(image, mask, np.ascontiguousarray(ray[0])) for image, mask, ray in zip(images, masks, rays, strict=True)
    ]
    planes, depths = make_empty_planes(posed.cam2world, _AXES, posed.near, posed.far), DepthRange(0.125, 0.125, 2.5)
    return detect_planes(views, rays, posed.cam2world, planes, depths, 0.45, MatchingConfig())


@pytest.fixture(scope="module")
def voted(empty_room) -> ScenePlanes:
    return _detect(empty_room.posed)


def test_every_wall_has_the_most_votes_on_its_side(voted, empty_room):
    for axis in range(3):
        for sign, corner in ((1, empty_room.room.high), (-1, empty_room.room.low)):
            true = (np.array(corner) - voted.origin) @ _AXES[axis]
            side = np.where(sign * voted.offsets > 0.5, voted.votes[axis], 0)
            assert voted.offsets[side.argmax()] == pytest.approx(true, abs=1.5 * voted.bin)
            assert side.max() > 0.5


def test_the_floor_and_the_ceiling_are_found(voted, empty_room):
    down, up = voted.floor_ceiling
    assert down == pytest.approx(empty_room.room.high[1] - voted.origin[1], abs=1.5 * voted.bin)
    assert up == pytest.approx(empty_room.room.low[1] - voted.origin[1], abs=1.5 * voted.bin)


@pytest.mark.slow
def test_a_box_standing_on_the_floor_is_not_the_floor(furnished_room):
    down, _ = _detect(furnished_room.posed).floor_ceiling
    assert down == pytest.approx(furnished_room.room.high[1], abs=0.1)


def test_blank_images_and_masked_pixels_have_no_votes(empty_room):
    images, masks = np.ones_like(empty_room.posed.images), np.zeros_like(empty_room.posed.masks)
    for voted, most in ((_detect(empty_room.posed, images), 1e-3), (_detect(empty_room.posed, masks=masks), 0)):
        assert voted.votes.max() <= most
        assert voted.floor_ceiling == (math.inf, -math.inf)
