"""Places on a floor plan: composition, poses, outlines, and places behind doors."""

import math

import numpy as np
import pytest

from pansplat.poses.placing import Guess, Piece, PlanFrame, PlanPose, list_through_door
from pansplat.poses.solvers import rotation_exp

QUARTER = math.pi / 2


def _upright(yaw: float) -> np.ndarray:
    """Cam2world rotation of a level camera, y down, that is turned to the right."""
    return rotation_exp(np.array((0.0, yaw, 0)))


def _assert_same(first: PlanPose, second: PlanPose) -> None:
    assert first.distance(second) < 1e-9 and first.turn_between(second) < 1e-9


def test_a_place_and_its_inverse_cancel():
    first, second = PlanPose(1.0, -2.0, 0.7), PlanPose(0.4, 3.0, -2.0)
    _assert_same(first.add(first.inverse()), PlanPose(0, 0, 0))
    _assert_same(first.add(second).add(second.inverse()), first)
    _assert_same(PlanPose(0, 0, QUARTER).add(PlanPose(0, 1, 0)), PlanPose(1, 0, QUARTER))  # turned: forward is right
    _assert_same(PlanPose(0, 0, 0).add(PlanPose(0, 1, 0), unit=1.5), PlanPose(0, 1.5, 0))


@pytest.mark.parametrize("tilt", [0.0, 0.15])
def test_a_pose_of_a_place_has_this_place_whatever_the_tilt(tilt):
    world = np.eye(4)
    world[:3, :3] = rotation_exp(np.array((0.4, 1.0, 0))) @ _upright(0.5)
    floor = PlanFrame.of_world(world[None], 1.5)
    upright = rotation_exp(np.array((tilt, 0, -tilt)))
    pose = floor.make_pose(PlanPose(2.0, 1.0, 0.8), upright, -0.3)
    _assert_same(floor.find_place(pose, upright), PlanPose(2.0, 1.0, 0.8))
    assert floor.level[:, 1] @ pose[:3, 3] == pytest.approx(-0.3)
    assert np.allclose(pose[:3, :3] @ upright[:, 1], floor.level[:, 1])  # gravity


def test_y_is_down_if_the_cameras_are_nearly_upright():
    pose = np.eye(4)
    pose[:3, :3] = rotation_exp(np.array((0.05, 0, 0.02)))
    assert np.allclose(PlanFrame.of_world(pose[None], 1.0).level[:, 1], (0, 1, 0))


def test_the_outline_of_a_room_is_where_its_walls_are(look_around):
    """The camera is 1.35 m over the floor of a room of 5.2 x 4.2 m, off its middle."""
    centre = np.array((0.6, 0.0, -0.4))
    piece = Piece(look_around(1, np.eye(3), centre), None)
    corners = piece.draw_outline(PlanPose(0.6, -0.4, 0), 1.35)
    assert np.allclose(corners.max(axis=0), (2.6, 2.1), atol=0.12)
    assert np.allclose(corners.min(axis=0), (-2.6, -2.1), atol=0.12)
    turned = piece.draw_outline(PlanPose(0, 0, QUARTER), 1.35) + np.array(
        (-0.4, -0.6)
    )  # the same room, turned to the right
    assert np.allclose(turned.max(axis=0), (2.1, 2.6), atol=0.12)


@pytest.mark.parametrize(("door", "tilt"), [(0.6, 0.0), (-1.7, 0.0), (0.6, 0.1)])
def test_directions_to_one_door_state_the_place_behind_its_wall(look_around, door, tilt):
    """Rooms of 5.2 by 4.2 m, the second on the right of the first; the door is at a place along the wall, metres."""
    centres, rooms, unit = np.array(((0.5, 0, 0.3), (-1.0, 0, -0.4))), np.array((0, 5.2)), 1.35
    pieces, places, links = [], [], []
    for n, yaw in enumerate((0.4, -2.0)):
        rotation = _upright(yaw) @ rotation_exp(np.array((tilt, 0.0, 0.5 * tilt)))
        surroundings = look_around(0, rotation, centres[n])
        axes = rotation @ surroundings.depth.rotation  # of the upright camera
        wall, ahead = axes.T @ (0, 0, 1), axes[:, 2]
        pieces.append(Piece(surroundings, math.atan2(wall[0], wall[2])))
        right = (centres[n, 0] + rooms[n]) / unit + 0.08 * n
        places.append(PlanPose(right, centres[n, 2] / unit, math.atan2(ahead[0], ahead[2])))
        x, y, z = rotation.T @ ((2.6 - 5.2 * n, 1.0, door) - centres[n])
        links.append((math.atan2(x, z), math.atan2(y, math.hypot(x, z))))
    truth = places[0].inverse().add(places[1])

    def find(order: int) -> list[Guess]:
        return list_through_door(tuple(pieces[::order]), tuple(links[::order]))

    def best(order: int = 1) -> PlanPose:
        return max(find(order), key=lambda guess: guess.probability).place

    every, found = find(1), best()
    assert found.distance(truth) < 0.05 and found.turn_between(truth) < 1e-6
    assert best(-1).distance(truth.inverse()) < 0.05
    pieces[1] = Piece(pieces[1].surroundings, None)
    assert best().distance(truth) < 0.05, "walls without edges are those of the surfaces"
    assert 0.5 < sum(guess.probability for guess in every) < 1
