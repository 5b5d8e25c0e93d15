"""Every key has the effect that the help states."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from pansplat_viewer.scene.state import ViewerState, advance_flight, enter_scene
from pansplat_viewer.window.input import FAST, FLY_SPEED, KEYS, SLOW, Input, apply_input

METHODS = "write_screenshot", "focus_center", "click"


@pytest.fixture
def state(small_scene) -> ViewerState:
    state = ViewerState()
    enter_scene(state, small_scene)
    return state


def send(state: ViewerState, **events: object) -> list[tuple[object, ...]]:
    """Apply input; returns the queued calls, with the names of methods of the viewer."""
    viewer = Mock(state=state)
    apply_input(viewer, Input(**events))
    names = {getattr(viewer, name): name for name in METHODS}
    return [(names[call.args[0]], *call.args[1:]) for call in viewer.queue.call_args_list]


def press(state: ViewerState, *keys: str, held: tuple[str, ...] = ()) -> list[tuple[object, ...]]:
    return send(state, pressed=frozenset(keys), held=frozenset((*keys, *held)))


@pytest.mark.parametrize(
    ("key", "step"),
    [
        ("w", (0, 0, 1)), ("s", (0, 0, -1)), ("d", (1, 0, 0)), ("a", (-1, 0, 0)),
        ("e", (0, -1, 0)), ("q", (0, 1, 0)), ("up", (0, 0, 1)), ("left", (-1, 0, 0)),
    ],
)  # fmt: skip
def test_fly_keys_move_at_the_flying_speed(state, key, step):
    send(state, seconds=0.5, held=frozenset((key,)))
    assert np.allclose(state.camera.position, 0.5 * FLY_SPEED * np.array(step))


def test_shift_is_faster_alt_is_slower_and_opposite_keys_cancel(state):
    moved = []
    for held in (("w",), ("w", "shift"), ("w", "alt")):
        state.camera = state.home
        send(state, seconds=0.1, held=frozenset(held))
        moved.append(state.camera.position[2])
    assert moved == pytest.approx([0.1, 0.1 * FAST, 0.1 * SLOW])
    state.camera = state.home
    send(state, held=frozenset("wsadqe"))
    assert state.camera == state.home


def test_scroll_changes_the_field_of_view_when_flying_and_the_distance_when_orbiting(state):
    send(state, scroll=1.0)
    assert state.camera.vertical_fov_degrees < state.home.vertical_fov_degrees
    press(state, "v")
    before = state.camera
    send(state, scroll=1.0)
    assert state.camera.distance < before.distance
    assert state.camera.vertical_fov_degrees == before.vertical_fov_degrees


def test_v_switches_to_orbiting_which_keeps_the_centre(state):
    press(state, "v")
    assert state.orbiting
    center = state.camera.orbit_center
    send(state, drag=(80.0, 10.0))
    assert np.allclose(state.camera.orbit_center, center)
    assert state.camera.position != state.home.position
    for key in "wasdqe":
        before = state.camera
        send(state, held=frozenset(key))
        assert np.allclose(state.camera.orbit_center, center) and state.camera != before
    press(state, "v")
    assert not state.orbiting


def test_pan_moves_across_the_view(state):
    send(state, pan=(30.0, 0.0))
    assert state.camera.position[0] < 0 and state.camera.position[2] == pytest.approx(0)


def test_digits_jump_to_the_panoramas_that_exist(state):
    for key, view in (("2", 1), ("1", 0)):
        press(state, key)
        assert np.allclose(state.camera.position, state.context[view, :3, 3]) and state.flight == view
    before = state.camera
    press(state, "3")
    assert state.camera == before


def test_page_keys_reach_all_panoramas_in_their_order(state, random_scene):
    poses = torch.eye(4, dtype=torch.float64).repeat(12, 1, 1)
    poses[:, 2, 3] = torch.arange(12)
    enter_scene(state, replace(random_scene(), cam2world=poses))
    visited = []
    for key in (*["page down"] * 12, "page up"):
        press(state, key)
        visited.append(state.camera.position[2])
    assert visited == pytest.approx([*range(1, 12), 0, 11])


def test_space_plays_the_flight_to_its_end_and_again_from_the_start(state):
    press(state, "space")
    assert state.playing
    for _ in range(100):
        advance_flight(state, 0.1)
    assert not state.playing and state.flight == 1
    assert np.allclose(state.camera.position, state.context[1, :3, 3])
    press(state, "space")
    assert state.playing and state.flight == 0


def test_space_pauses_a_playing_flight(state):
    press(state, "space")
    advance_flight(state, 1.0)
    press(state, "space")
    before = state.camera
    advance_flight(state, 1.0)
    assert state.camera == before


def test_moving_the_camera_stops_the_flight_and_zooming_does_not(state):
    press(state, "space")
    send(state, scroll=1.0)
    assert state.playing
    send(state, held=frozenset("w"))
    assert not state.playing


def test_comma_and_period_step_along_the_flight_and_stop_at_its_ends(state):
    press(state, ",")
    assert state.flight == 0
    for _ in range(12):
        press(state, ".")
    assert state.flight == pytest.approx(0.5)
    assert np.allclose(state.camera.position, (0, 0, 0.25))
    for _ in range(50):
        press(state, ".")
    assert state.flight == 1


@pytest.mark.parametrize(("key", "name"), [("tab", "overlay"), ("h", "help"), ("c", "comparing")])
def test_key_toggles_what_is_shown(state, key, name):
    before = getattr(state, name)
    press(state, key)
    assert getattr(state, name) is not before
    press(state, key)
    assert getattr(state, name) is before


def test_r_restores_the_start(state):
    send(state, held=frozenset("wd"), drag=(40.0, 10.0), scroll=2.0)
    assert state.camera != state.home
    press(state, "r")
    assert state.camera == state.home


def test_keys_and_clicks_queue_actions_of_the_viewer(state):
    assert press(state, "p") == [("write_screenshot", "png")]
    assert press(state, "p", held=("shift",)) == [("write_screenshot", "exr")]
    assert press(state, "f") == [("focus_center",)]
    assert send(state, click=(0.5, 0.25)) == [("click", (0.5, 0.25))]
    assert press(state) == []


def test_each_key_has_one_action():
    keys = [key for row in KEYS for key in row.actions]
    assert len(set(keys)) == len(keys)


def test_escape_closes_the_help_first_and_then_quits(state):
    state.help = True
    press(state, "escape")
    assert not (state.help or state.quit)
    press(state, "escape")
    assert state.quit


def test_q_quits_only_with_control(state):
    press(state, "q")
    before = state.camera
    assert not state.quit
    press(state, "q", held=("ctrl",))
    assert state.quit and state.camera == before


def test_entering_a_scene_of_one_view_resets_modes_that_need_two(small_scene):
    one = replace(small_scene, gaussians=small_scene.gaussians.select(small_scene.gaussians.views == 0))
    state = ViewerState()
    state.settings = replace(state.settings, mode="deferred", view=1)
    enter_scene(state, replace(one, cam2world=one.cam2world[:1]))
    assert state.settings.mode == "joint" and state.settings.view == 0
    assert state.levels == (0, 1, 2, 3)


def test_entering_a_scene_forgets_the_panorama_to_fly_to(small_scene):
    state = ViewerState(target=1)
    enter_scene(state, small_scene)
    assert state.target is None


def test_a_scene_without_cameras_is_seen_from_outside_and_has_no_flight(small_scene):
    state = ViewerState()
    enter_scene(state, replace(small_scene, cam2world=small_scene.cam2world[:0]))
    means = small_scene.gaussians.means.double().numpy()
    ahead = (means - np.asarray(state.camera.position)) @ state.camera.rotation[:, 2]
    assert (ahead > 0).mean() > 0.95
    press(state, "space", "1", ".")
    assert not state.playing


def test_a_camera_that_flies_by_hand_stops_along_a_poor_edge(state, house):
    """The state of a tour is the graph with the poor edges that were found."""
    (a, b), *_ = house.overlaps
    state.tour = replace(house, poor=((a, b),))
    way = house.positions[b] - house.positions[a]
    ahead = np.linalg.inv(np.asarray(state.camera.level)) @ way
    state.camera = replace(
        state.camera, position=tuple(house.positions[a]), yaw_radians=float(np.arctan2(ahead[0], ahead[2]))
    )
    for _ in range(200):
        send(state, held=frozenset("w"), seconds=0.05 * float(np.linalg.norm(way)))
    away = np.linalg.norm(np.array(state.camera.position) - house.positions[a])
    assert away == pytest.approx(min(0.5, np.linalg.norm(way) / 4), abs=1e-6)
