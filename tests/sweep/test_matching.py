"""The matching cost of hypotheses, and its semi-global aggregation on the sphere."""

import dataclasses
import math

import numba as nb
import numpy as np
import pytest

from pansplat.sweep.matching import (
    AggregationConfig,
    HypothesisSet,
    MatchingConfig,
    View,
    _aggregate_columns,
    _fast_atan2,
    aggregate,
    best_labels,
    matching_cost,
)
from pansplat.sweep.surface import ray_grid

_ANYWHERE = (math.inf, -math.inf)
_PLAIN = MatchingConfig(textureless_weight=1.0, distance_penalty=0.0)
_IMPOSSIBLE = 2 * (_PLAIN.correlation_weight + _PLAIN.color_weight)
_NEUTRAL = 0.5 * (_PLAIN.correlation_weight + _PLAIN.color_weight)


def _spheres(height: int, inverses: np.ndarray) -> HypothesisSet:
    """Spheres at equally spaced inverse depths."""
    shape = (height, 2 * height)
    return HypothesisSet(
        np.full(shape, inverses[0], np.float32),
        np.full(shape, inverses[1] - inverses[0], np.float32),
        np.zeros((2, len(inverses)), np.float32),
        np.zeros(shape, np.uint8),
    )


def _view(image: np.ndarray, valid: np.ndarray | None = None, inverse: float | None = None, trust: float = 1) -> View:
    shape = image.shape[:2]
    return View(
        np.ascontiguousarray(image, np.float32),
        np.ones(shape, bool) if valid is None else valid,
        np.ascontiguousarray(ray_grid(shape[0])[..., 1]),
        None if inverse is None else np.full(shape, inverse, np.float32),
        None if inverse is None else np.full(shape, trust, np.float32),
    )


def _around_the_truth(observed, view: int, factors: np.ndarray) -> np.ndarray:
    """Cost (h, w, factor) of the true inverse depth times equally spaced factors."""
    posed = observed.posed
    true = (1 / observed.depths[view]).astype(np.float32)
    spheres = HypothesisSet(
        factors[0] * true,
        (factors[1] - factors[0]) * true,
        np.zeros((2, len(factors)), np.float32),
        np.zeros(true.shape, np.uint8),
    )
    views = [_view(image) for image in posed.images]
    pose = posed.relative_pose(view, 1 - view)
    return matching_cost(views[view], views[1 - view], pose, [spheres], (0.05, 8.0), _ANYWHERE, _PLAIN)


def test_an_image_matches_itself_at_every_hypothesis(empty_room):
    view = _view(empty_room.posed.images[0])
    spheres = _spheres(96, np.linspace(0.2, 1.5, 11, dtype=np.float32))
    cost = matching_cost(view, view, np.eye(4), [spheres], (0.1, 2.0), _ANYWHERE, _PLAIN)
    assert cost.max() < 0.02


def test_a_camera_turned_in_place_matches_at_every_hypothesis(empty_room, turn):
    """At the borders and the poles as well; the cost is that of interpolation."""
    room, pose = empty_room.room, empty_room.posed.cam2world[0]
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ turn("x", 50) @ turn("y", 75)
    views = [_view(room.cast(p, 96)[0]) for p in (pose, turned)]
    spheres = _spheres(96, np.linspace(0.2, 1.5, 3, dtype=np.float32))
    cost = matching_cost(*views, np.linalg.inv(turned) @ pose, [spheres], (0.1, 2.0), _ANYWHERE, _PLAIN)
    assert np.median(cost) < 0.1 and (cost < 0.3).mean() > 0.97
    assert np.ptp(cost, axis=2).max() < 1e-5  # without a baseline all hypotheses are one


@pytest.mark.parametrize("view", (0, 1))
def test_the_true_depth_has_the_lowest_cost(empty_room, view):
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
    spheres = _spheres(96, np.linspace(0.2, 1.0, 5, dtype=np.float32))
    plain = matching_cost(*(_view(i) for i in posed.images), pose, [spheres], (0.1, 2.0), _ANYWHERE, _PLAIN)
    rolled = matching_cost(
        *(_view(np.roll(i, columns, axis=1)) for i in posed.images),
        np.linalg.inv(roll) @ pose @ roll, [spheres], (0.1, 2.0), _ANYWHERE, _PLAIN,
    )  # fmt: skip
    assert np.allclose(np.roll(rolled, -columns, axis=1), plain, atol=2e-3)


def test_hypothesis_sets_do_not_affect_each_other(empty_room):
    posed = empty_room.posed
    views, pose = [_view(i) for i in posed.images], posed.relative_pose(0, 1)
    sets = [_spheres(96, np.linspace(low, 1.0, 10, dtype=np.float32)) for low in (0.2, 0.4)]
    both = matching_cost(*views, pose, sets, (0.1, 2.0), _ANYWHERE, _PLAIN)
    alone = [matching_cost(*views, pose, [f], (0.1, 2.0), _ANYWHERE, _PLAIN) for f in sets]
    assert np.array_equal(both, np.concatenate(alone, axis=2))


@pytest.mark.parametrize("whose", ("own", "other"))
def test_masked_pixels_have_the_same_cost_at_every_hypothesis(empty_room, whose):
    image, height = empty_room.posed.images[0], 96
    valid = np.ones((height, 2 * height), bool)
    valid[:20] = False
    views = _view(image, valid if whose == "own" else None), _view(image, valid if whose == "other" else None)
    spheres = _spheres(height, np.linspace(0.2, 1.5, 6, dtype=np.float32))
    cost = matching_cost(*views, np.eye(4), [spheres], (0.1, 2.0), _ANYWHERE, _PLAIN)
    assert np.allclose(cost[:20], _NEUTRAL)
    assert cost[20:].max() < 0.02


def test_hypotheses_out_of_range_are_impossible(empty_room):
    posed = empty_room.posed
    inverses = np.linspace(0.1, 1.1, 11, dtype=np.float32)
    cost = matching_cost(
        *(_view(i) for i in posed.images), posed.relative_pose(0, 1), [_spheres(96, inverses)],
        (0.35, 0.85), _ANYWHERE, _PLAIN,
    )  # fmt: skip
    out = (inverses < 0.35) | (inverses > 0.85)
    assert (cost[..., out] == _IMPOSSIBLE).all()
    assert cost[..., ~out].max() < _IMPOSSIBLE


def test_the_other_views_surface_changes_the_cost_as_configured(empty_room):
    """A penalty in free space, a bonus when consistent, a constant cost when occluded."""
    image = empty_room.posed.images[0]
    spheres = _spheres(96, np.array((0.25, 0.5, 0.75, 1.0), np.float32))
    cost = matching_cost(
        _view(image), _view(image, inverse=0.5), np.eye(4), [spheres], (0.1, 2.0), _ANYWHERE, _PLAIN
    ).reshape(-1, 4)
    expected = (_PLAIN.occluded_cost, -_PLAIN.consistency_bonus, _PLAIN.free_space_penalty, _PLAIN.free_space_penalty)
    assert np.allclose(cost, expected, atol=0.02)
    unverified = matching_cost(
        _view(image), _view(image, inverse=0.5, trust=0), np.eye(4), [spheres], (0.1, 2.0), _ANYWHERE, _PLAIN
    )
    assert unverified.max() < 0.02


def test_hypotheses_below_the_floor_or_above_the_ceiling_are_penalised(empty_room):
    view = _view(empty_room.posed.images[0])
    spheres = _spheres(96, np.array((0.25, 0.5), np.float32))  # 4 and 2 metres
    cost = matching_cost(view, view, np.eye(4), [spheres], (0.1, 2.0), (1.5, -1.0), _PLAIN)
    down = view.down[..., None] * np.array((4.0, 2.0))
    outside = (down > 1.5) | (down < -1.0)
    sure = np.minimum(np.abs(down - 1.5), np.abs(down + 1.0)) > 1e-4
    assert outside.any() and not outside.all()
    assert np.allclose(cost[sure], np.where(outside, _PLAIN.outside_penalty, 0)[sure], atol=0.02)


def test_penalties_depend_on_the_side(empty_room):
    view = _view(empty_room.posed.images[0])
    plain = _spheres(96, np.array((0.25, 0.5), np.float32))
    side = np.zeros(plain.side.shape, np.uint8)
    side[:, 96:] = 1
    spheres = HypothesisSet(plain.base, plain.step, np.array(((0.0, 0.3), (0.7, 0.0)), np.float32), side)
    cost = matching_cost(view, view, np.eye(4), [spheres], (0.1, 2.0), _ANYWHERE, _PLAIN)
    assert np.allclose(cost[:, :96], (0.0, 0.3), atol=0.02)
    assert np.allclose(cost[:, 96:], (0.7, 0.0), atol=0.02)


def test_a_window_without_texture_has_less_weight():
    """White against grey: the colour difference is truncated, the correlation is undefined."""
    white, gray = np.ones((32, 64, 3)), np.full((32, 64, 3), 0.5)
    spheres = _spheres(32, np.array((0.25, 0.5), np.float32))
    config = MatchingConfig()
    cost = matching_cost(_view(white), _view(gray), np.eye(4), [spheres], (0.1, 2.0), _ANYWHERE, config)
    expected = (
        config.textureless_weight * config.color_weight + (1 - config.textureless_weight) * config.textureless_cost
    )
    assert np.allclose(cost, expected, atol=1e-3)


def test_points_much_nearer_to_one_camera_than_to_the_other_are_penalised(empty_room):
    views, pose = [_view(image) for image in empty_room.posed.images], np.eye(4)
    pose[0, 3] = 2.0
    inverses = np.array((0.25, 2.0, 3.75), np.float32)
    penalised = dataclasses.replace(_PLAIN, distance_penalty=0.5)
    plain, far_apart = (
        matching_cost(*views, pose, [_spheres(96, inverses)], (0.1, 4.0), _ANYWHERE, config)
        for config in (_PLAIN, penalised)
    )
    points = ray_grid(96)[..., None, :] / inverses[:, None]
    ratio = np.linalg.norm(points + np.array((2.0, 0, 0)), axis=-1) * inverses
    expected = 0.5 * np.maximum(1 - penalised.distance_ratio * np.minimum(ratio, 1 / ratio), 0)
    assert np.allclose(far_apart - plain, expected, atol=1e-4)
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
    y, x = np.array((0, 0, 1, -1, 0), np.float32), np.array((1, -1, 0, 0, 0), np.float32)  # on the axes
    assert np.allclose(_all_atan2(y, x), np.arctan2(y, x), atol=2e-6)


def test_a_plane_that_separates_the_views_has_a_constant_cost(empty_room):
    views = [_view(image) for image in empty_room.posed.images]
    plain = _spheres(96, np.array((0.25, 0.5), np.float32))
    hidden = dataclasses.replace(plain, back_facing=np.array(((False, True), (False, False))))
    pose = empty_room.posed.relative_pose(0, 1)
    before, cost = (matching_cost(*views, pose, [f], (0.1, 2.0), _ANYWHERE, _PLAIN) for f in (plain, hidden))
    assert np.array_equal(cost[..., 0], before[..., 0])
    assert np.allclose(cost[..., 1], _PLAIN.back_facing_cost) and not np.allclose(
        before[..., 1], _PLAIN.back_facing_cost
    )


def test_spheres_seen_from_opposite_directions_are_penalised_and_planes_are_not(empty_room):
    views, pose = [_view(image) for image in empty_room.posed.images], np.eye(4)
    pose[0, 3] = 2.0
    inverses = np.array((0.5, 1.25, 2.0), np.float32)
    spheres = _spheres(96, inverses)
    plain, sphere = (
        matching_cost(*views, pose, [dataclasses.replace(spheres, sphere=s)], (0.1, 4.0), _ANYWHERE, _PLAIN)
        for s in (False, True)
    )
    rays = ray_grid(96)[..., None, :]
    there = rays / inverses[:, None] + np.array((2.0, 0, 0))
    cosine = (rays * there).sum(axis=-1) / np.linalg.norm(there, axis=-1)
    expected = _PLAIN.opposed_penalty * ((0.2 - cosine) / 0.7).clip(0, 1)
    assert expected.max() == _PLAIN.opposed_penalty and (expected == 0).mean() > 0.3
    assert np.allclose(sphere - plain, expected, atol=1e-4)


_AWAY_FROM_POLES = slice(4, -4)
"""Rows where the start of a path has no effect after half a turn; near a pole penalties are too high for that."""
_FREE = AggregationConfig(step_penalty=0, crease_penalty=0, jump_penalty=0)


def _slots(height: int, sets: int = 1) -> np.ndarray:
    """Hypothesis k of every set in depth slot k."""
    slot_map = np.zeros((height, 2 * height, sets, 2), np.float32)
    slot_map[..., 0], slot_map[..., 1] = 1, 0.5
    return slot_map


def _gray(height: int) -> np.ndarray:
    return np.full((height, 2 * height, 3), 0.5, np.float32)


def _noise(height: int, labels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, 2 * height, labels)).astype(np.float32)


def test_without_penalties_every_direction_adds_the_cost_once():
    cost = _noise(32, 24)
    total = aggregate(cost, _gray(32), _slots(32, 2), 12, _FREE)
    assert np.allclose(total, 8 * cost, atol=1e-5)


def test_a_hypothesis_that_matches_everywhere_has_cost_zero():
    cost = 0.1 + _noise(32, 24)
    cost[..., 17] = 0
    total = aggregate(cost, _gray(32), _slots(32, 2), 12, AggregationConfig())
    assert np.abs(total[..., 17]).max() < 1e-5
    assert np.delete(total, 17, axis=2).min() > 0.1


@pytest.mark.parametrize(
    ("gap", "cost_in_gap"),
    (
        ((slice(10, 20), slice(20, 40)), 0.02),
        ((np.arange(10, 20)[:, None], np.arange(-10, 10)[None]), 0.02),
        (slice(0, 5), 0.004),
        (slice(-5, None), 0.004),
    ),
    ids=("inside", "left and right border", "north pole", "south pole"),
)
def test_a_plane_continues_through_a_gap_without_evidence(gap, cost_in_gap):
    cost = _noise(32, 12) + 1
    cost[..., 5] = 0
    cost[gap] = cost_in_gap * _noise(32, 12, seed=1)[gap]
    assert (cost[gap].argmin(axis=-1) == 5).mean() < 0.3
    total = aggregate(cost, _gray(32), _slots(32), 12, AggregationConfig())
    assert (total.argmin(axis=-1) == 5).all()


@pytest.mark.parametrize("dy", (1, -1))
def test_a_path_continues_over_the_pole_half_a_turn_away(dy):
    """Costs of a few columns at the pole reach these and the opposite columns only."""
    height, count = 32, 12
    cost = np.zeros((height, 2 * height, count), np.float32)
    known = slice(0, 6) if dy > 0 else slice(-6, None)
    cost[known, :4] = 1
    cost[known, :4, 5] = 0
    total = np.zeros_like(cost)
    penalties = tuple(np.float32(price) for price in (0.08, 0.15, 0.8, 0.1))
    _aggregate_columns(cost, total, _gray(height), _slots(height), 1, count, count, penalties, dy, 0, height // 4)
    first = total[0 if dy > 0 else -1]
    knows = np.sort(first, axis=1)[:, 1] > first[:, 5] + 0.05
    assert np.flatnonzero(knows).tolist() == [0, 1, 2, 3, 32, 33, 34, 35]


def test_a_discontinuity_follows_the_image_edge():
    """The costs are zero in a strip around the discontinuity."""
    height = 32
    guide = _gray(height)
    guide[:, 29:] = 0.95
    cost = 1 + _noise(height, 12)
    cost[:, :26, 2], cost[:, 34:, 9] = 0, 0
    cost[:, 26:34] = 0
    total = aggregate(cost, guide, _slots(height), 12, AggregationConfig())
    rows = slice(8, 24)
    assert (total[rows, 10:29].argmin(axis=-1) == 2).mean() > 0.98
    assert (total[rows, 29:54].argmin(axis=-1) == 9).mean() > 0.98


def test_a_change_of_set_is_cheap_only_at_equal_depth():
    """The best hypothesis changes from set 0 to set 1: a crease at the same depth, else a jump."""
    height, count = 32, 12
    cost = np.full((height, 2 * height, 2 * count), 1.0, np.float32)
    cost[:, :32, 4] = 0
    cost[:, 32:, count + 4] = 0
    least = []
    for start in (0.5, 6.5):  # hypothesis 4 of set 1 lies in slot 4, or in slot 10
        slot_map = _slots(height, 2)
        slot_map[..., 1, 1] = start
        total = aggregate(cost, _gray(height), slot_map, 20, AggregationConfig())
        least.append(float(total[16, 32, count + 4]))
    assert 0 < least[0] < 0.5 * least[1]


def test_the_number_of_threads_changes_no_bit():
    cost, guide = _noise(32, 24), _noise(32, 3, seed=2)
    one, two = (aggregate(cost, guide, _slots(32, 2), 12, AggregationConfig(), threads=n) for n in (1, 2))
    assert np.array_equal(one, two)


def test_rolling_the_cost_rolls_the_total():
    cost, guide, columns = _noise(32, 12), 0.1 * _noise(32, 3, seed=2), 23
    total = aggregate(cost, guide, _slots(32), 12, AggregationConfig())
    rolled = aggregate(
        np.roll(cost, columns, axis=1), np.roll(guide, columns, axis=1), _slots(32), 12, AggregationConfig()
    )
    assert np.allclose(np.roll(rolled, -columns, axis=1)[_AWAY_FROM_POLES], total[_AWAY_FROM_POLES], atol=1e-4)


@pytest.mark.parametrize("axis", (0, 1))
def test_mirroring_the_cost_mirrors_the_total(axis):
    cost, guide = _noise(32, 12), 0.1 * _noise(32, 3, seed=2)
    total = aggregate(cost, guide, _slots(32), 12, AggregationConfig())
    mirrored = aggregate(
        np.ascontiguousarray(np.flip(cost, axis)), np.ascontiguousarray(np.flip(guide, axis)),
        _slots(32), 12, AggregationConfig(),
    )  # fmt: skip
    assert np.allclose(np.flip(mirrored, axis)[_AWAY_FROM_POLES], total[_AWAY_FROM_POLES], atol=1e-4)


def test_the_best_label_lies_at_the_vertex_of_a_parabola():
    count = 12
    vertex = np.random.default_rng(0).uniform(1, count - 2, (16, 32, 1))
    total = ((np.arange(count) - vertex) ** 2).astype(np.float32)
    label, offset = best_labels(np.concatenate((total + 1, total), axis=2), count)
    assert (label >= count).all()
    assert np.allclose(label - count + offset, vertex[..., 0], atol=1e-3)


def test_offsets_do_not_cross_hypothesis_sets():
    total = np.ones((8, 16, 24), np.float32)
    total[:, :8, 11], total[:, :8, 12] = 0, 0.2  # 11 is the last of the first set
    total[:, 8:, 12], total[:, 8:, 11] = 0, 0.2
    label, offset = best_labels(total, 12)
    assert set(np.unique(label)) == {11, 12}
    assert (offset == 0).all()
