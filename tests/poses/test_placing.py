"""Places on a floor plan: composition, snapping, suggestions of relative poses, outlines and the fit."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pansplat.inputs.pairs import Link, Panorama
from pansplat.poses.placing import (
    SNAP_ANGLE,
    SNAP_RADIUS,
    WALL_ANGLE,
    Piece,
    PlanFrame,
    PlanPose,
    list_suggestions,
    list_through_door,
    measure_fit,
    snap,
    suggest_by_links,
    suggest_through_door,
)
from pansplat.poses.solvers import rotation_exp
from pansplat.poses.two_view import Hypotheses, RelativePose

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


def test_suggestions_are_where_the_second_camera_of_a_candidate_is():
    """The second camera is 2 camera heights to the right of the first one and 1 ahead, and is turned by 0.6 radians."""
    uprights = rotation_exp(np.array((0.1, 0, 0.05))), rotation_exp(np.array((-0.05, 0, 0.1)))
    first = PlanFrame(np.eye(3), 1.0).make_pose(PlanPose(0, 0, 0.3), uprights[0], 0.0)
    second = PlanFrame(np.eye(3), 1.0).make_pose(PlanPose(0, 0, 0.3).add(PlanPose(2, 1, 0.6)), uprights[1], 0.0)
    motion = np.linalg.inv(second) @ first
    rotations, translations = np.stack((motion[:3, :3], np.eye(3))), np.stack((motion[:3, 3], np.zeros(3)))
    hypotheses = Hypotheses(rotations, translations, np.array((-1.0, -4.0)))
    none = np.zeros((0, 2), int)
    relation = RelativePose(np.eye(3), np.array((0.0, 0, 1)), none, problem="no", hypotheses=hypotheses)
    best, other = list_suggestions(relation, uprights)
    _assert_same(best.place, PlanPose(2, 1, 0.6))
    assert (best.log_odds, other.log_odds) == (-1.0, -4.0)


def test_a_place_snaps_to_the_nearest_suggestion_within_radius_and_angle():
    suggestions = [PlanPose(0, 0, 0), PlanPose(0.3, 0, 0), PlanPose(0, 0, 1.0)]
    assert snap(PlanPose(0.2, 0.02, 0.05), suggestions) == (suggestions[1], 1, False)
    for place in (PlanPose(0, SNAP_RADIUS + 0.01, 0), PlanPose(-0.1, 0, SNAP_ANGLE + 0.01)):
        assert snap(place, suggestions) == (place, None, False)
    assert snap(PlanPose(0.05, 0, 0.97), suggestions).suggestion == 2  # of two at one point, that of the heading


@pytest.mark.parametrize("quarters", range(4))
def test_walls_snap_to_multiples_of_a_quarter_turn(quarters):
    target, own = 0.3, 0.1
    exact = target - own + quarters * QUARTER
    for error in (-0.9 * WALL_ANGLE, 0.9 * WALL_ANGLE):
        snapped = snap(PlanPose(1, 2, exact + error), [], own, target)
        assert snapped.is_aligned and snapped.place.turn_between(PlanPose(0, 0, exact)) < 1e-9
        assert snapped.place[:2] == (1, 2)
    place = PlanPose(1, 2, exact + 1.1 * WALL_ANGLE)
    assert snap(place, [], own, target) == snap(place, []) == (place, None, False)


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


def test_the_fit_is_best_at_the_right_pose(look_around):
    centres, yaws = np.array(((-0.8, 0, -0.5), (0.9, 0, 0.4), (0.2, 0, -0.9))), (0.0, 0.6, -2.0)
    views = [Piece(look_around(2, _upright(yaw), centre), None) for yaw, centre in zip(yaws, centres, strict=True)]
    poses = [np.eye(4) for _ in views]
    for pose, yaw, centre in zip(poses, yaws, centres, strict=True):
        pose[:3, :3], pose[:3, 3] = _upright(yaw), centre
    floor = PlanFrame.of_world(np.stack(poses[:2]), 1.35)
    others = list(zip(views[:2], poses[:2], strict=True))
    place = floor.find_place(poses[2], views[2].upright)

    def fit(right: float, yaw: float):
        changed = place._replace(right=place.right + right, yaw=place.yaw + yaw)
        return measure_fit(views[2], floor.make_pose(changed, views[2].upright, 0.0), others, 1.35)

    best = fit(0, 0)
    assert best.likeness > 0.6 and best.conflict < 0.01
    assert best.score > fit(0.3, 0).score > fit(0.3, 0.5).score
    assert fit(0, math.pi).likeness < 0.3


def test_a_piece_that_has_nothing_in_common_with_the_others_has_no_fit(look_around):
    view, far = Piece(look_around(3, np.eye(3), np.zeros(3)), None), np.eye(4)
    far[0, 3] = 1000.0
    assert measure_fit(view, far, [(view, np.eye(4))], 1.35) is None
    assert measure_fit(view, far, [], 1.35) is None


def test_links_suggest_the_place_at_which_they_meet_the_floor_also_of_tilted_cameras():
    truth, upright = PlanPose(1.2, 1.6, -2.0), (_tilt(0.1), _tilt(-0.2))
    levels = {"a": (truth.right, 1.0, truth.forward), "b": (truth.inverse().right, 1.0, truth.inverse().forward)}
    links = {}
    for name, axes in zip("ab", upright, strict=True):
        x, y, z = axes @ levels[name]
        links[name] = Link("ba"["ab".index(name)], math.atan2(x, z), math.atan2(y, math.hypot(x, z)))
    first, second = (
        Panorama(name, Path(f"{name}.jpg"), torch.eye(4, dtype=torch.float64), links=(links[name],)) for name in "ab"
    )
    _assert_same(suggest_by_links(first, second, upright), truth)
    _assert_same(suggest_by_links(second, first, upright[::-1]), truth.inverse())
    unlinked = replace(second, links=())
    assert suggest_by_links(replace(first, links=()), unlinked, upright) is None
    onwards = suggest_by_links(first, unlinked, upright)
    assert onwards[:2] == pytest.approx(truth[:2]) and onwards.yaw == pytest.approx(math.atan2(1.2, 1.6))
    turned = suggest_by_links(first, replace(unlinked, start=(0.5, 0.0)), (upright[0], np.eye(3)))
    assert turned.yaw == pytest.approx(onwards.yaw - 0.5)
    horizontal = replace(first, links=(replace(links["a"], pitch=-0.3),))
    assert math.hypot(*suggest_by_links(horizontal, second, upright)[:2]) == pytest.approx(4.0)


@pytest.mark.parametrize(("door", "tilt"), [(0.6, 0.0), (-1.7, 0.0), (0.6, 0.1)])
def test_links_to_one_door_suggest_the_place_behind_its_wall(look_around, door, tilt):
    """Rooms of 5.2 by 4.2 m, the second on the right of the first; the door is at a place along the wall, metres."""
    centres, rooms, unit = np.array(((0.5, 0, 0.3), (-1.0, 0, -0.4))), np.array((0, 5.2)), 1.35
    pieces, places, views = [], [], []
    for n, yaw in enumerate((0.4, -2.0)):
        rotation = _upright(yaw) @ _tilt(tilt)
        surroundings = look_around(0, rotation, centres[n])
        axes = rotation @ surroundings.depth.rotation  # of the upright camera
        wall, ahead = axes.T @ (0, 0, 1), axes[:, 2]
        pieces.append(Piece(surroundings, math.atan2(wall[0], wall[2])))
        right = (centres[n, 0] + rooms[n]) / unit + 0.08 * n
        places.append(PlanPose(right, centres[n, 2] / unit, math.atan2(ahead[0], ahead[2])))
        x, y, z = rotation.T @ ((2.6 - 5.2 * n, 1.0, door) - centres[n])
        link = Link("ba"[n], math.atan2(x, z), math.atan2(y, math.hypot(x, z)))
        views.append(Panorama("ab"[n], Path("ab"[n]), torch.eye(4, dtype=torch.float64), links=(link,)))
    truth, found = places[0].inverse().add(places[1]), suggest_through_door(views[0], views[1], tuple(pieces))
    assert found.distance(truth) < 0.05 and found.turn_between(truth) < 1e-6
    assert suggest_through_door(views[1], views[0], tuple(pieces[::-1])).distance(truth.inverse()) < 0.05
    assert suggest_through_door(views[0], replace(views[1], links=()), tuple(pieces)) is None
    bare = suggest_through_door(views[0], views[1], (pieces[0], Piece(pieces[1].surroundings, None)))
    assert bare.distance(truth) < 0.05, "walls without edges are those of the surfaces"
    every = list_through_door(tuple(pieces), tuple((view.links[0].yaw, view.links[0].pitch) for view in views))
    assert max(every, key=lambda guess: guess.probability).place == found
    assert 0.5 < sum(guess.probability for guess in every) < 1


def _tilt(angle: float) -> np.ndarray:
    return rotation_exp(np.array((angle, 0.0, 0.5 * angle)))
