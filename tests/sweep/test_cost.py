"""The matching cost of hypotheses."""

import dataclasses
import math

import numba as nb
import numpy as np
import pytest

from pansplat.sweep.cost import Family, MatchingConfig, View, _fast_atan2, matching_cost
from pansplat.sweep.sphere import ray_grid

_ANYWHERE = (math.inf, -math.inf)
_PLAIN = MatchingConfig(flat_weight=1.0, distance_penalty=0.0)
_IMPOSSIBLE = 2 * (_PLAIN.correlation_weight + _PLAIN.color_weight)
_NEUTRAL = 0.5 * (_PLAIN.correlation_weight + _PLAIN.color_weight)


def _family(height: int, inverses: np.ndarray) -> Family:
    """Spheres at equally spaced inverse depths."""
    shape = (height, 2 * height)
    return Family(
        np.full(shape, inverses[0], np.float32),
        np.full(shape, inverses[1] - inverses[0], np.float32),
        np.zeros((2, len(inverses)), np.float32),
        np.zeros(shape, np.uint8),
    )


def _view(image: np.ndarray, usable: np.ndarray | None = None, inverse: float | None = None, trust: float = 1) -> View:
    shape = image.shape[:2]
    return View(
        np.ascontiguousarray(image, np.float32),
        np.ones(shape, bool) if usable is None else usable,
        np.ascontiguousarray(ray_grid(shape[0])[..., 1]),
        None if inverse is None else np.full(shape, inverse, np.float32),
        None if inverse is None else np.full(shape, trust, np.float32),
    )


def _around_the_truth(observed, view: int, factors: np.ndarray) -> np.ndarray:
    """Cost (h, w, factor) of the true inverse depth times equally spaced factors."""
    posed = observed.posed
    true = (1 / observed.depths[view]).astype(np.float32)
    family = Family(
        factors[0] * true,
        (factors[1] - factors[0]) * true,
        np.zeros((2, len(factors)), np.float32),
        np.zeros(true.shape, np.uint8),
    )
    views = [_view(image) for image in posed.images]
    pose = posed.relative_pose(view, 1 - view)
    return matching_cost(views[view], views[1 - view], pose, [family], (0.05, 8.0), _ANYWHERE, _PLAIN)


def test_the_same_picture_from_the_same_place_fits_every_hypothesis(empty_room):
    view = _view(empty_room.posed.images[0])
    family = _family(96, np.linspace(0.2, 1.5, 11, dtype=np.float32))
    cost = matching_cost(view, view, np.eye(4), [family], (0.1, 2.0), _ANYWHERE, _PLAIN)
    assert cost.max() < 0.02


def test_a_camera_turned_in_place_fits_every_hypothesis(empty_room, turn):
    """At the edges and over the poles as well; only interpolation costs."""
    room, pose = empty_room.room, empty_room.posed.cam2world[0]
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ turn("x", 50) @ turn("y", 75)
    views = [_view(room.cast(p, 96)[0]) for p in (pose, turned)]
    family = _family(96, np.linspace(0.2, 1.5, 3, dtype=np.float32))
    cost = matching_cost(*views, np.linalg.inv(turned) @ pose, [family], (0.1, 2.0), _ANYWHERE, _PLAIN)
    assert np.median(cost) < 0.1 and (cost < 0.3).mean() > 0.97
    assert np.ptp(cost, axis=2).max() < 1e-5  # without a baseline all hypotheses are one


@pytest.mark.parametrize("view", (0, 1))
def test_the_truth_is_cheaper_than_what_is_near_it(empty_room, view):
    cost = _around_the_truth(empty_room, view, np.linspace(0.6, 1.4, 9, dtype=np.float32))
    assert (cost[..., 4] < cost[..., 0]).mean() > 0.9
    assert (cost[..., 4] < cost[..., 8]).mean() > 0.9
    assert np.abs(cost.argmin(axis=2) - 4).mean() < 0.8
    assert np.median(cost[..., 4]) < 0.25 * np.median(cost[..., (0, 8)])


def test_rolling_both_panoramas_rolls_the_cost(empty_room, turn):
    posed, columns = empty_room.posed, 31
    roll = np.eye(4)
    roll[:3, :3] = turn("y", -360 * columns / 192)  # from rolled to former camera axes
    pose = posed.relative_pose(0, 1)
    family = _family(96, np.linspace(0.2, 1.0, 5, dtype=np.float32))
    plain = matching_cost(*(_view(i) for i in posed.images), pose, [family], (0.1, 2.0), _ANYWHERE, _PLAIN)
    rolled = matching_cost(
        *(_view(np.roll(i, columns, axis=1)) for i in posed.images),
        np.linalg.inv(roll) @ pose @ roll, [family], (0.1, 2.0), _ANYWHERE, _PLAIN,
    )  # fmt: skip
    assert np.allclose(np.roll(rolled, -columns, axis=1), plain, atol=2e-3)


def test_several_families_cost_what_they_cost_alone(empty_room):
    posed = empty_room.posed
    views, pose = [_view(i) for i in posed.images], posed.relative_pose(0, 1)
    families = [_family(96, np.linspace(low, 1.0, 10, dtype=np.float32)) for low in (0.2, 0.4)]
    both = matching_cost(*views, pose, families, (0.1, 2.0), _ANYWHERE, _PLAIN)
    alone = [matching_cost(*views, pose, [f], (0.1, 2.0), _ANYWHERE, _PLAIN) for f in families]
    assert np.array_equal(both, np.concatenate(alone, axis=2))


@pytest.mark.parametrize("whose", ("own", "other"))
def test_masked_pixels_are_neutral(empty_room, whose):
    image, height = empty_room.posed.images[0], 96
    usable = np.ones((height, 2 * height), bool)
    usable[:20] = False
    views = _view(image, usable if whose == "own" else None), _view(image, usable if whose == "other" else None)
    family = _family(height, np.linspace(0.2, 1.5, 6, dtype=np.float32))
    cost = matching_cost(*views, np.eye(4), [family], (0.1, 2.0), _ANYWHERE, _PLAIN)
    assert np.allclose(cost[:20], _NEUTRAL)
    assert cost[20:].max() < 0.02


def test_hypotheses_out_of_range_are_impossible(empty_room):
    posed = empty_room.posed
    inverses = np.linspace(0.1, 1.1, 11, dtype=np.float32)
    cost = matching_cost(
        *(_view(i) for i in posed.images), posed.relative_pose(0, 1), [_family(96, inverses)],
        (0.35, 0.85), _ANYWHERE, _PLAIN,
    )  # fmt: skip
    out = (inverses < 0.35) | (inverses > 0.85)
    assert (cost[..., out] == _IMPOSSIBLE).all()
    assert cost[..., ~out].max() < _IMPOSSIBLE


def test_what_the_other_view_knows_changes_the_cost_as_configured(empty_room):
    """Seen through costs, agreement earns, and hidden points cost the same whatever the pictures say."""
    image = empty_room.posed.images[0]
    family = _family(96, np.array((0.25, 0.5, 0.75, 1.0), np.float32))
    cost = matching_cost(
        _view(image), _view(image, inverse=0.5), np.eye(4), [family], (0.1, 2.0), _ANYWHERE, _PLAIN
    ).reshape(-1, 4)
    expected = (_PLAIN.occluded_cost, -_PLAIN.agreement_bonus, _PLAIN.visible_penalty, _PLAIN.visible_penalty)
    assert np.allclose(cost, expected, atol=0.02)
    unsure = matching_cost(
        _view(image), _view(image, inverse=0.5, trust=0), np.eye(4), [family], (0.1, 2.0), _ANYWHERE, _PLAIN
    )
    assert unsure.max() < 0.02


def test_hypotheses_below_the_floor_or_above_the_ceiling_cost_more(empty_room):
    view = _view(empty_room.posed.images[0])
    family = _family(96, np.array((0.25, 0.5), np.float32))  # 4 and 2 metres
    cost = matching_cost(view, view, np.eye(4), [family], (0.1, 2.0), (1.5, -1.0), _PLAIN)
    down = view.down[..., None] * np.array((4.0, 2.0))
    outside = (down > 1.5) | (down < -1.0)
    sure = np.minimum(np.abs(down - 1.5), np.abs(down + 1.0)) > 1e-4
    assert outside.any() and not outside.all()
    assert np.allclose(cost[sure], np.where(outside, _PLAIN.outside_penalty, 0)[sure], atol=0.02)


def test_a_penalty_is_paid_on_its_side_only(empty_room):
    view = _view(empty_room.posed.images[0])
    plain = _family(96, np.array((0.25, 0.5), np.float32))
    side = np.zeros(plain.side.shape, np.uint8)
    side[:, 96:] = 1
    family = Family(plain.base, plain.step, np.array(((0.0, 0.3), (0.7, 0.0)), np.float32), side)
    cost = matching_cost(view, view, np.eye(4), [family], (0.1, 2.0), _ANYWHERE, _PLAIN)
    assert np.allclose(cost[:, :96], (0.0, 0.3), atol=0.02)
    assert np.allclose(cost[:, 96:], (0.7, 0.0), atol=0.02)


def test_a_window_without_texture_says_little():
    """White against grey: the colours differ by more than the limit, the correlation says nothing."""
    white, gray = np.ones((32, 64, 3)), np.full((32, 64, 3), 0.5)
    family = _family(32, np.array((0.25, 0.5), np.float32))
    config = MatchingConfig()
    cost = matching_cost(_view(white), _view(gray), np.eye(4), [family], (0.1, 2.0), _ANYWHERE, config)
    expected = config.flat_weight * config.color_weight + (1 - config.flat_weight) * config.flat_cost
    assert np.allclose(cost, expected, atol=1e-3)


def test_points_much_nearer_to_one_camera_than_to_the_other_cost_more(empty_room):
    views, pose = [_view(image) for image in empty_room.posed.images], np.eye(4)
    pose[0, 3] = 2.0
    inverses = np.array((0.25, 2.0, 3.75), np.float32)
    priced = dataclasses.replace(_PLAIN, distance_penalty=0.5)
    plain, dear = (
        matching_cost(*views, pose, [_family(96, inverses)], (0.1, 4.0), _ANYWHERE, config)
        for config in (_PLAIN, priced)
    )
    points = ray_grid(96)[..., None, :] / inverses[:, None]
    ratio = np.linalg.norm(points + np.array((2.0, 0, 0)), axis=-1) * inverses
    expected = 0.5 * np.maximum(1 - priced.distance_ratio * np.minimum(ratio, 1 / ratio), 0)
    assert np.allclose(dear - plain, expected, atol=1e-4)
    assert (expected[..., 0] == 0).all() and (expected[..., 2] > 0).all()


@nb.njit
def _all_atan2(y, x):
    result = np.empty_like(x)
    for n in range(len(x)):
        result[n] = _fast_atan2(y[n], x[n])
    return result


def test_fast_atan2_is_within_two_microradians():
    angle = np.linspace(-math.pi, math.pi, 20001, dtype=np.float64)[1:-1]
    y, x = np.sin(angle).astype(np.float32), np.cos(angle).astype(np.float32)
    error = np.abs(_all_atan2(y, x) - np.arctan2(y.astype(np.float64), x.astype(np.float64)))
    assert error.max() < 2e-6 + np.pi * np.finfo(np.float32).eps


def test_fast_atan2_is_right_on_the_axes():
    y = np.array((0, 0, 1, -1, 0), np.float32)
    x = np.array((1, -1, 0, 0, 0), np.float32)
    assert np.allclose(_all_atan2(y, x), np.arctan2(y, x), atol=2e-6)


def test_a_plane_that_the_other_view_sees_from_behind_is_not_compared(empty_room):
    views = [_view(image) for image in empty_room.posed.images]
    plain = _family(96, np.array((0.25, 0.5), np.float32))
    hidden = dataclasses.replace(plain, unseen=np.array(((False, True), (False, False))))
    pose = empty_room.posed.relative_pose(0, 1)
    before, cost = (matching_cost(*views, pose, [f], (0.1, 2.0), _ANYWHERE, _PLAIN) for f in (plain, hidden))
    assert np.array_equal(cost[..., 0], before[..., 0])
    assert np.allclose(cost[..., 1], _PLAIN.unseen_cost) and not np.allclose(before[..., 1], _PLAIN.unseen_cost)


def test_spheres_seen_from_opposite_directions_cost_more_and_planes_do_not(empty_room):
    views, pose = [_view(image) for image in empty_room.posed.images], np.eye(4)
    pose[0, 3] = 2.0
    inverses = np.array((0.5, 1.25, 2.0), np.float32)
    family = _family(96, inverses)
    plain, sphere = (
        matching_cost(*views, pose, [dataclasses.replace(family, sphere=s)], (0.1, 4.0), _ANYWHERE, _PLAIN)
        for s in (False, True)
    )
    rays = ray_grid(96)[..., None, :]
    there = rays / inverses[:, None] + np.array((2.0, 0, 0))
    cosine = (rays * there).sum(axis=-1) / np.linalg.norm(there, axis=-1)
    expected = _PLAIN.opposed_penalty * ((0.2 - cosine) / 0.7).clip(0, 1)
    assert expected.max() == _PLAIN.opposed_penalty and (expected == 0).mean() > 0.3
    assert np.allclose(sphere - plain, expected, atol=1e-4)
