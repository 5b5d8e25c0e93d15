"""The planes that a scene has."""

import dataclasses

import numpy as np
import pytest

from pansplat.sweep.planes import PlaneSupport, no_support, plane_support
from pansplat.sweep.surface import Surface, world_points

_AXES = np.array(((0.0, 1, 0), (1, 0, 0), (0, 0, 1)))  # down and the room's two wall normals


@pytest.fixture(scope="module")
def support(empty_room) -> PlaneSupport:
    """Of the exact surfaces, every pixel labelled with its wall's axis."""
    room, poses = empty_room.room, empty_room.posed.cam2world
    surfaces = []
    for pose, depth in zip(poses, empty_room.depths, strict=True):
        plain = Surface((1 / depth).astype(np.float32), np.zeros(depth.shape, np.uint8))
        points = world_points(plain, pose) @ _AXES.T
        low, high = np.array(room.low) @ _AXES.T, np.array(room.high) @ _AXES.T
        wall = np.minimum(np.abs(points - low), np.abs(points - high)).argmin(axis=-1)
        surfaces.append(Surface(plain.inverse_depth, (wall + 1).astype(np.uint8)))
    return plane_support(surfaces, list(empty_room.posed.masks), poses, no_support(poses, _AXES, 0.5, 8.0))


def test_shares_of_all_planes_sum_to_one(support):
    assert np.isclose(support.histogram.sum(), 1, atol=1e-3)


@pytest.mark.parametrize("view", (0, 1))
def test_every_wall_has_support_at_its_distance_and_none_between(support, empty_room, view):
    pose = empty_room.posed.cam2world[view]
    low, high = (np.array(corner) @ _AXES.T for corner in (empty_room.room.low, empty_room.room.high))
    centre = pose[:3, 3] @ _AXES.T
    for axis in range(3):
        distances = np.array((centre[axis] - low[axis], high[axis] - centre[axis]))
        share = support.share(axis, pose, 1 / distances)
        assert share[0, 0] > 0.9 and share[1, 1] > 0.9
        assert support.share(axis, pose, 1 / (0.7 * distances)).max() < 0.1


@pytest.mark.parametrize("view", (0, 1))
def test_the_floor_is_below_and_the_ceiling_above_the_camera(support, empty_room, view):
    """Bounds leave a little room beyond, never less than the true planes."""
    pose, room = empty_room.posed.cam2world[view], empty_room.room
    down, up = support.bounds(pose)
    floor, ceiling = room.high[1] - pose[1, 3], room.low[1] - pose[1, 3]
    assert floor < down < 1.15 * floor + 0.1
    assert 1.15 * ceiling - 0.1 < up < ceiling


def test_without_agreement_nothing_is_known(empty_room):
    nothing = [np.zeros_like(mask) for mask in empty_room.posed.masks]
    poses = empty_room.posed.cam2world
    support = plane_support(empty_room.surfaces, nothing, poses, no_support(poses, _AXES, 0.45, 8.0))
    assert support.bounds(empty_room.posed.cam2world[0]) == (np.inf, -np.inf)
    assert support.share(1, empty_room.posed.cam2world[0], np.linspace(0.1, 2, 20)).max() == 0


def test_the_sweep_finds_floor_and_ceiling_by_itself(empty_room):
    from pansplat.sweep.surface import agreement

    poses = empty_room.posed.cam2world
    labelled = [
        Surface(s.inverse_depth, np.where(np.abs(world_points(s, p)[..., 1]) > 1.0, 1, 0).astype(np.uint8))
        for s, p in zip(empty_room.surfaces, poses, strict=True)
    ]
    agreed = [agreement(labelled, poses, view) for view in (0, 1)]
    down, up = plane_support(labelled, agreed, poses, no_support(poses, _AXES, 0.45, 8.0)).bounds(poses[0])
    assert down == pytest.approx(1.06 * empty_room.room.high[1] + 0.05, abs=0.1)
    assert up == pytest.approx(1.06 * empty_room.room.low[1] - 0.05, abs=0.1)


def test_a_plane_that_pixels_voted_for_is_supported_without_any_surface(empty_room):
    poses = empty_room.posed.cam2world
    nothing = no_support(poses, _AXES, 0.45, 8.0)
    votes = np.zeros_like(nothing.votes)
    votes[0, nothing.offsets.searchsorted(1.2)] = 0.7
    voted = dataclasses.replace(nothing, votes=votes)
    distance = voted.offsets[voted.votes[0].argmax()] - poses[0][1, 3] + voted.origin[1]
    assert voted.share(0, poses[0], np.array((1 / distance,)))[1, 0] == pytest.approx(0.7)
    assert nothing.share(0, poses[0], np.array((1 / distance,))).max() == 0


def test_floor_and_ceiling_that_pixels_voted_for_come_before_those_of_surfaces(support, empty_room):
    pose = empty_room.posed.cam2world[0]
    voted = dataclasses.replace(support, floor_ceiling=(2.0, -np.inf)).bounds(pose)
    below = 2.0 - (pose[1, 3] - support.origin[1])
    assert voted[0] == pytest.approx(1.06 * below + support.bin)
    assert voted[1] == support.bounds(pose)[1]


def test_planes_between_two_cameras_show_them_different_faces():
    """Cameras at x = 0 and x = 1, planes across x."""
    here, there = np.eye(4), np.eye(4)
    there[0, 3] = 1.0
    nothing = no_support(np.stack((here, there)), _AXES, 0.5, 8.0)
    distance = np.array((0.5, 0.9, 1.1, 3.0))
    assert np.array_equal(nothing.backs(1, here, there, 1 / distance), ((False,) * 4, (True, True, False, False)))
    assert np.array_equal(nothing.backs(1, there, here, 1 / distance), ((True, True, False, False), (False,) * 4))
    assert not nothing.backs(0, here, there, 1 / distance).any()


def test_the_floor_is_below_each_camera_by_its_own_height():
    poses = np.stack((np.eye(4), np.eye(4)))
    poses[1, 1, 3] = 0.4  # lower by that
    floor = dataclasses.replace(no_support(poses, _AXES, 0.5, 8.0), floor_ceiling=(1.0, -np.inf))
    assert floor.floor_below(poses[0]) == pytest.approx(1.2)
    assert floor.floor_below(poses[1]) == pytest.approx(0.8)
