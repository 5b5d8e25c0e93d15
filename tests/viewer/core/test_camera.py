"""The interactive camera moves and stays level."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pansplat_viewer.core import camera as cameras
from pansplat_viewer.core.camera import Camera
from pansplat_viewer.core.state import ViewerState, enter_scene, go_to_view, toggle_play

# Right, down, forward of the level camera are x, -z, y: a world with z up.
Z_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))


@pytest.mark.parametrize("level", [Camera().level, Z_UP])
def test_every_pose_is_rigid_and_has_no_roll(level):
    for yaw in np.linspace(-4, 4, 9):
        for pitch in np.linspace(-2, 2, 9):
            camera = cameras.turn(replace(Camera(), level=level), yaw, pitch)
            rotation = camera.rotation
            assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0
            down = np.asarray(level)[:, 1]
            assert abs(rotation[:, 0] @ down) < 1e-12, "right is horizontal"
            assert rotation[:, 1] @ down > 0, "the image is not upside down"


def test_place_drops_the_roll_only():
    c, s = math.cos(0.2), math.sin(0.2)
    rolled = np.eye(4)
    rolled[:3, :3] = cameras.turn(Camera(), 1, 0.3).rotation @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    placed = cameras.move_to_pose(Camera(), rolled)
    assert (placed.yaw_radians, placed.pitch_radians) == pytest.approx((1, 0.3))
    assert np.allclose(Camera().cam2world, np.eye(4)), "it looks along z, with y down"
    camera = cameras.turn(replace(Camera(), position=(1, 2, 3)), 2.5, -0.7)
    assert np.allclose(cameras.move_to_pose(Camera(), camera.cam2world).cam2world, camera.cam2world)


def test_place_of_a_pose_straight_down_keeps_the_heading():
    down = np.eye(4)
    down[:3, :3] = replace(Camera(), yaw_radians=0.8, pitch_radians=-math.pi / 2).rotation
    assert cameras.move_to_pose(Camera(), down).yaw_radians == pytest.approx(0.8)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_scene_follows_a_drag(axis):
    camera, height = Camera(), 720
    focal = height / 2 / math.tan(math.radians(camera.vertical_fov_degrees) / 2)
    turned = cameras.turn_by_drag(camera, ((10.0, 0.0), (0.0, 10.0))[axis], height)
    ahead = turned.rotation.T @ np.array((0.0, 0.0, 1.0))
    assert focal * ahead[axis] / ahead[2] == pytest.approx(10, rel=1e-3)


def test_fly_moves_along_the_view_and_along_the_up_axis_of_the_scene():
    camera = cameras.turn(replace(Camera(), level=Z_UP), 0.5, 0.6)
    forward = camera.rotation[:, 2]
    assert np.allclose(cameras.fly(camera, 0, 0, 2).position, 2 * forward)
    assert np.allclose(cameras.fly(camera, 0, 1, 0).position, -np.asarray(Z_UP)[:, 1])


def test_dolly_approaches_the_centre_and_does_not_pass_it():
    camera = replace(Camera(), distance=1.0)
    near = cameras.dolly(camera, 1)
    assert near.distance == pytest.approx(0.9) and near.position[2] == pytest.approx(0.1)
    nearest = cameras.dolly(camera, 1000)
    assert nearest.distance == cameras.MIN_DISTANCE
    assert np.allclose(nearest.orbit_center, camera.orbit_center)


def test_zoom_stays_within_its_bounds():
    assert cameras.zoom(Camera(), 1).vertical_fov_degrees < Camera().vertical_fov_degrees
    assert cameras.zoom(Camera(), 1e3).vertical_fov_degrees == cameras.MIN_FOV_DEGREES
    assert cameras.zoom(Camera(), -1e3).vertical_fov_degrees == cameras.MAX_FOV_DEGREES


def test_focus_looks_at_the_point_and_orbits_it():
    point = np.array((2.0, -1.0, 3.0))
    camera = cameras.focus_on_point(replace(Camera(), position=(0.5, 0, 0)), point)
    assert np.allclose(camera.orbit_center, point)
    assert cameras.focus_on_point(camera, np.asarray(camera.position)) == camera


def test_a_scene_is_entered_in_the_direction_of_its_start_view(small_scene):
    pose = small_scene.cam2world[:1].clone()
    pose[0, :3, :3] = torch.tensor(((0.0, 0, 1), (0, 1, 0), (-1, 0, 0)))  # looks to the right
    state, single = ViewerState(), replace(small_scene, cam2world=pose, names=("a",), starts=((0.5, 0.2),))
    enter_scene(state, single)
    ahead = np.array((math.cos(0.5) * math.cos(0.2), math.sin(0.2), -math.sin(0.5) * math.cos(0.2)))
    assert np.allclose(state.camera.rotation[:, 2], ahead) and state.home == state.camera
    enter_scene(state, replace(single, cam2world=small_scene.cam2world[1:], starts=()))
    assert np.allclose(state.camera.rotation[:, 2], (0, 0, 1))


def test_entering_a_scene_resets_modes_that_it_lacks_and_the_panorama_to_fly_to(small_scene):
    one = replace(small_scene, gaussians=small_scene.gaussians.select(small_scene.gaussians.views == 0))
    state = ViewerState(target=1)
    state.settings = replace(state.settings, mode="deferred", view=1)
    enter_scene(state, replace(one, cam2world=one.cam2world[:1]))
    assert state.settings.mode == "joint" and state.settings.view == 0 and state.target is None
    assert state.levels == (0, 1, 2, 3)


def test_a_scene_without_cameras_is_seen_from_outside_and_has_no_flight(small_scene):
    state = ViewerState()
    enter_scene(state, replace(small_scene, cam2world=small_scene.cam2world[:0]))
    means = small_scene.gaussians.means.double().numpy()
    ahead = (means - np.asarray(state.camera.position)) @ state.camera.rotation[:, 2]
    assert (ahead > 0).mean() > 0.95
    toggle_play(state)
    go_to_view(state, 0)
    assert not state.playing
