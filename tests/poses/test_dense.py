"""Panoramas of a room are alike under their relative pose, and contradict each other under others."""

import math
from itertools import product

import numpy as np
import pytest
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.poses.dense import Comparison, Surroundings, compare, compare_many
from pansplat.poses.solvers import rotation_exp

HEIGHT = 1.35  # of the cameras over the floor, metres
CENTRES = np.array((-0.9, 0, 0.4)), np.array((0.8, 0, -0.5))


def turn(degrees: float) -> Array:
    return rotation_exp(np.array((0, math.radians(degrees), 0)))


TURNS = np.eye(3), turn(35)
TILTED = turn(35) @ rotation_exp(np.array((0.2, 0, -0.1)))


def relate(first: Array, second: Array, centres: tuple[Array, Array] = CENTRES) -> tuple[Array, Array]:
    """R and t, camera heights, of x2 = R x1 + t."""
    return second.T @ first, second.T @ (centres[0] - centres[1]) / HEIGHT


@pytest.fixture(scope="module")
def views(look_around) -> tuple[Surroundings, Surroundings]:
    """Of two cameras in one room."""
    first, second = (look_around(0, rotation, centre) for rotation, centre in zip(TURNS, CENTRES, strict=True))
    return first, second


def contradicts(found: Comparison) -> bool:
    """Whether a comparison speaks against a pose."""
    return found.conflict > 0.05 or found.likeness < 0.2


def test_the_right_pose_fits(views: tuple[Surroundings, Surroundings]) -> None:
    found = compare(*views, *relate(*TURNS))
    assert found.overlap > 0.97 and found.conflict == 0
    assert found.likeness > 0.8 and found.shade > 0.9


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_turned_pose_does_not_fit(views, degrees: float) -> None:
    rotation, translation = relate(*TURNS)
    assert contradicts(compare(*views, turn(degrees) @ rotation, translation))
    assert contradicts(compare(*views, turn(degrees) @ rotation, turn(degrees) @ translation))


def test_a_pose_beyond_a_wall_conflicts(views) -> None:
    outside = CENTRES[0], CENTRES[1] + np.array((3.0, 0, 0))
    found = compare(*views, *relate(*TURNS, outside))
    assert found.conflict > 0.02 and found.overlap < 0.5 and found.likeness < 0.2


def test_the_other_side_of_a_wall_is_not_common(views, look_around) -> None:
    # The next room is a mirror image beyond the wall x = 2.6 m; its floor and ceiling continue those of this room.
    beyond = look_around(1, TURNS[1], CENTRES[1])
    centres = CENTRES[0], CENTRES[1] + np.array((2 * 2.6, 0, 0))
    rotation, translation = relate(*TURNS, centres)
    found = compare(views[0], beyond, rotation, translation)
    assert found.conflict == 0 and found.overlap < 0.01


def test_another_room_of_the_same_shape_is_not_alike(views, look_around) -> None:
    found = compare(views[0], look_around(1, TURNS[1], CENTRES[1]), *relate(*TURNS))
    assert found.overlap > 0.97 and abs(found.likeness) < 0.2


def make_poses() -> tuple[Array, Array]:
    """The right pose, then others."""
    poses = [relate(*TURNS)]
    for degrees, shift in product((0, 25, 90, 180), (0.0, 1.5)):
        poses.append(relate(turn(degrees), TURNS[1], (CENTRES[0], CENTRES[1] + np.array((shift, 0, shift)))))
    rotations, translations = zip(*poses, strict=True)
    return np.stack(rotations), np.stack(translations)


def test_a_sixteenth_of_the_directions_gives_nearly_the_same(views) -> None:
    rotations, translations = make_poses()
    quick = compare_many(*views, rotations, translations)
    for values, rotation, translation in zip(quick, rotations, translations, strict=True):
        found = compare(*views, rotation, translation)
        assert np.abs(values[:2] - (found.overlap, found.conflict)).max() < 0.02
        assert np.abs(values[2:] - (found.likeness, found.shade, found.hue)).max() < 0.15
    assert quick[:, 2].argmax() == 0


def compare_one_way(source: Array, target: Array, rotation: Array, translation: Array) -> Array:
    """The same in float64, by the definitions in dense.py."""
    height, width = target.shape[:2]
    rays = pixel_directions(height, width).numpy().astype(np.float64)
    weight = np.cos(((np.arange(height) + 0.5) / height - 0.5) * math.pi)[:, None] * np.ones(width)
    points = rays * np.exp(source[..., :1]) @ rotation.T + translation
    distance = np.linalg.norm(points, axis=-1)
    column = ((np.arctan2(points[..., 0], points[..., 2]) / (2 * math.pi) + 0.5) * width).astype(int) % width
    row = ((np.arcsin(points[..., 1] / distance) / math.pi + 0.5) * height).astype(int).clip(0, height - 1)
    seen = target[row, column]
    uncertain = source[..., 1] + seen[..., 1]
    error = np.log(distance) - seen[..., 0]
    usable = distance > 0.25
    close = usable & (np.abs(error) < 0.12 + uncertain)
    same = close & (((source[..., 2:5] @ rotation.T) * seen[..., 2:5]).sum(axis=-1) > 0.3)
    conflict = usable & ~close & (uncertain < 0.3) & (error < -np.maximum(0.24 + 2 * uncertain, 0.25))
    values = [weight[same].sum() / weight.sum(), weight[conflict].sum() / weight.sum()]
    if values[0] < 0.002:
        return np.array([*values, 0, 0, 0])
    covariances = [np.cov(source[same][:, k], seen[same][:, k], aweights=weight[same], ddof=0) for k in range(5, 9)]
    values += [c[0, 1] / math.sqrt(c[0, 0] * c[1, 1]) for c in covariances[:2]]
    hue = covariances[2] + covariances[3]
    return np.array([*values, hue[0, 1] / (math.sqrt(hue[0, 0] * hue[1, 1]) + 0.06**2)])


def test_the_kernel_equals_plain_numpy_in_float64(views, look_around) -> None:
    second = look_around(0, TILTED, CENTRES[1])
    for rotation, translation in zip(*make_poses(), strict=True):
        upright = second.depth.rotation.T @ rotation, second.depth.rotation.T @ translation
        maps = [view.maps.astype(np.float64) for view in (views[0], second)]
        there = compare_one_way(*maps, *upright)
        back = compare_one_way(*maps[::-1], upright[0].T, -upright[0].T @ upright[1])
        found = compare(views[0], second, rotation, translation)
        values = found.overlap, found.conflict, found.likeness, found.shade, found.hue
        assert np.abs((there + back) / 2 - values).max() < 3e-3  # pixels at borders of others may be others
