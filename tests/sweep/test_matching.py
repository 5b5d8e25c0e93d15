"""The matching cost of hypotheses, and its semi-global aggregation on the sphere."""

import dataclasses

import numpy as np
import pytest

from pansplat.sweep.matching import (
    HypothesisSet,
    MatchingWeights,
    OtherView,
    View,
    _aggregate_columns,
    _Penalties,
    aggregate_costs,
    compute_matching_cost,
    select_labels,
)
from pansplat.sweep.panoramas import ray_grid

_PLAIN = MatchingWeights(textureless_weight=1.0, distance_penalty=0.0)
_IMPOSSIBLE = 2 * (_PLAIN.correlation_weight + _PLAIN.color_weight)
_NEUTRAL = 0.5 * (_PLAIN.correlation_weight + _PLAIN.color_weight)


def _spheres(inverses, height: int = 96) -> HypothesisSet:
    """Spheres at equally spaced inverse depths."""
    shape, (first, second) = (height, 2 * height), np.float32(inverses[:2])
    maps = np.full(shape, first, np.float32), np.full(shape, second - first, np.float32)
    return HypothesisSet(*maps, np.zeros(len(inverses), np.float32))


def _view(image: np.ndarray, valid: np.ndarray | None = None, inverse: float | None = None) -> View:
    shape = image.shape[:2]
    return View(
        np.ascontiguousarray(image, np.float32),
        np.ones(shape, bool) if valid is None else valid,
        None if inverse is None else np.full(shape, inverse, np.float32),
    )


def _cost(views, *sets, pose=None, limits=(0.1, 2.0), weights=_PLAIN) -> np.ndarray:
    """Cost of a view against another, by default with the same pose."""
    view, *others = views
    pose = np.eye(4) if pose is None else pose
    return compute_matching_cost(view, [OtherView(o, pose, list(sets)) for o in others], limits, weights)


@pytest.fixture(scope="module")
def twice(empty_room) -> tuple[View, View]:
    """One view, matched against itself."""
    view = _view(empty_room.posed.images[0])
    return view, view


@pytest.fixture(scope="module")
def views(empty_room) -> list[View]:
    return [_view(image) for image in empty_room.posed.images]


def test_a_camera_turned_in_place_matches_at_every_hypothesis(empty_room, turn):
    """At the borders and the poles as well; the cost is that of interpolation."""
    room, pose = empty_room.room, empty_room.posed.cam2world[0]
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ turn("x", 50) @ turn("y", 75)
    rotated = [_view(room.cast(p, 96)[0]) for p in (pose, turned)]
    cost = _cost(rotated, _spheres(np.linspace(0.2, 1.5, 3)), pose=np.linalg.inv(turned) @ pose)
    assert np.median(cost) < 0.1 and (cost < 0.3).mean() > 0.97
    assert np.ptp(cost, axis=2).max() < 1e-5  # without a baseline all hypotheses are equal


def test_the_true_depth_has_the_lowest_cost(empty_room, views, view):
    factors = np.linspace(0.6, 1.4, 9, dtype=np.float32)
    true = (1 / empty_room.depths[view]).astype(np.float32)
    near = HypothesisSet(factors[0] * true, (factors[1] - factors[0]) * true, np.zeros(len(factors), np.float32))
    pose = empty_room.posed.relative_pose(view, 1 - view)
    cost = _cost((views[view], views[1 - view]), near, pose=pose, limits=(0.05, 8.0))
    assert (cost[..., 4] < cost[..., 0]).mean() > 0.9
    assert (cost[..., 4] < cost[..., 8]).mean() > 0.9
    assert np.abs(cost.argmin(axis=2) - 4).mean() < 0.8
    assert np.median(cost[..., 4]) < 0.25 * np.median(cost[..., (0, 8)])


@pytest.mark.parametrize("masked", (0, 1), ids=("own", "other"))
def test_masked_pixels_have_the_same_cost_at_every_hypothesis(twice, masked):
    valid = np.ones((96, 192), bool)
    valid[:20] = False
    pair = list(twice)
    pair[masked] = dataclasses.replace(twice[0], valid=valid)
    cost = _cost(pair, _spheres(np.linspace(0.2, 1.5, 6)))
    assert np.allclose(cost[:20], _NEUTRAL)
    assert cost[20:].max() < 0.02


def test_hypotheses_out_of_range_are_impossible(empty_room, views):
    inverses = np.linspace(0.1, 1.1, 11, dtype=np.float32)
    cost = _cost(views, _spheres(inverses), pose=empty_room.posed.relative_pose(0, 1), limits=(0.35, 0.85))
    out = (inverses < 0.35) | (inverses > 0.85)
    assert (cost[..., out] == _IMPOSSIBLE).all()
    assert cost[..., ~out].max() < _IMPOSSIBLE


def test_the_other_views_surface_changes_the_cost_as_configured(twice):
    """A penalty in free space, a bonus when consistent, a constant cost when occluded."""
    image, spheres = twice[0].image, _spheres((0.25, 0.5, 0.75, 1.0))
    cost = _cost((twice[0], _view(image, inverse=0.5)), spheres)
    expected = (_PLAIN.occluded_cost, -_PLAIN.consistency_bonus, *[_PLAIN.free_space_penalty] * 2)
    assert np.allclose(cost, expected, atol=0.02)
    assert _cost((twice[0], _view(image)), spheres).max() < 0.02  # nothing is known before the first pass


def test_only_views_that_can_see_a_hypothesis_count(twice):
    """The second other view sees all of the hypotheses, the first one what is not behind its surface."""
    image, spheres = twice[0].image, _spheres((0.25, 0.5, 0.75, 1.0))
    near, far = _view(image, inverse=0.6), _view(image, inverse=0.1)
    first, second = _cost((twice[0], near), spheres), _cost((twice[0], far), spheres)
    both = _cost((twice[0], near, far), spheres)
    assert np.allclose(both[..., :2], second[..., :2], atol=0.02), "occluded in the first one"
    assert np.allclose(both[..., 2:], (first + second)[..., 2:] / 2, atol=1e-4)
    assert np.allclose(_cost((twice[0], near, near), spheres), first, atol=1e-4), "nobody sees the farthest ones"


def test_penalties_are_added_and_a_window_without_texture_has_less_weight(twice):
    penalty = np.array((0.0, 0.3), np.float32)
    assert np.allclose(_cost(twice, dataclasses.replace(_spheres((0.25, 0.5)), penalty=penalty)), penalty, atol=0.02)
    # White against grey: the colour difference is truncated, the correlation is undefined.
    flat, weights = [_view(np.full((32, 64, 3), value)) for value in (1.0, 0.5)], MatchingWeights()
    cost, weight = _cost(flat, _spheres((0.25, 0.5), 32), weights=weights), weights.textureless_weight
    assert np.allclose(cost, weight * weights.color_weight + (1 - weight) * weights.textureless_cost, atol=1e-3)


def _two_metres_apart(inverses) -> tuple[np.ndarray, np.ndarray]:
    """A pose 2 m along x, and the points of all hypotheses in the other camera."""
    pose = np.eye(4)
    pose[0, 3] = 2.0
    return pose, ray_grid(96)[..., None, :] / np.array(inverses)[:, None] + np.array((2.0, 0, 0))


def test_points_much_nearer_to_one_camera_than_to_the_other_are_penalised(views):
    inverses = np.array((0.25, 2.0, 3.75), np.float32)
    pose, there = _two_metres_apart(inverses)
    penalised = _PLAIN._replace(distance_penalty=0.5)
    plain, far_apart = (
        _cost(views, _spheres(inverses), pose=pose, limits=(0.1, 4.0), weights=weights)
        for weights in (_PLAIN, penalised)
    )
    ratio = np.linalg.norm(there, axis=-1) * inverses
    expected = 0.5 * np.maximum(1 - penalised.distance_ratio * np.minimum(ratio, 1 / ratio), 0)
    assert np.allclose(far_apart - plain, expected, atol=1e-4)
    assert (expected[..., 0] == 0).all() and (expected[..., 2] > 0).all()


def test_a_plane_that_separates_the_views_has_a_constant_cost(empty_room, views):
    plain, pose = _spheres((0.25, 0.5)), empty_room.posed.relative_pose(0, 1)
    side = np.zeros((96, 192), np.uint8)
    side[:, 96:] = 1
    hidden = dataclasses.replace(plain, side=side, back_facing=np.array(((False, True), (False, False))))
    before, cost = (_cost(views, hypotheses, pose=pose) for hypotheses in (plain, hidden))
    assert np.array_equal(cost[..., 0], before[..., 0]) and np.array_equal(cost[:, 96:], before[:, 96:])
    assert np.allclose(cost[:, :96, 1], _PLAIN.back_facing_cost)
    assert not np.allclose(before[..., 1], _PLAIN.back_facing_cost)


def test_spheres_seen_from_opposite_directions_are_penalised_and_planes_are_not(views):
    inverses = np.array((0.5, 1.25, 2.0), np.float32)
    pose, there = _two_metres_apart(inverses)
    plain, sphere = (
        _cost(views, dataclasses.replace(_spheres(inverses), sphere=is_sphere), pose=pose, limits=(0.1, 4.0))
        for is_sphere in (False, True)
    )
    cosine = (ray_grid(96)[..., None, :] * there).sum(axis=-1) / np.linalg.norm(there, axis=-1)
    expected = _PLAIN.opposed_penalty * ((0.2 - cosine) / 0.7).clip(0, 1)
    assert expected.max() == _PLAIN.opposed_penalty and (expected == 0).mean() > 0.3
    assert np.allclose(sphere - plain, expected, atol=1e-4)


def _slots(height: int, sets: int = 1) -> np.ndarray:
    """Hypothesis k of every set in depth slot k."""
    slot_map = np.zeros((height, 2 * height, sets, 2), np.float32)
    slot_map[..., 0], slot_map[..., 1] = 1, 0.5
    return slot_map


def _gray(height: int) -> np.ndarray:
    return np.full((height, 2 * height, 3), 0.5, np.float32)


def _noise(height: int, labels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, 2 * height, labels)).astype(np.float32)


def _aggregate(cost: np.ndarray, guide: np.ndarray | None = None, *, sets: int = 1) -> np.ndarray:
    height = len(cost)
    return aggregate_costs(cost, _gray(height) if guide is None else guide, _slots(height, sets), 12)


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
    total = _aggregate(cost)
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
    penalties = _Penalties(*np.float32((0.08, 0.15, 0.8, 0.1)))
    _aggregate_columns(cost, total, _gray(height), _slots(height), count, penalties, dy, 0, height // 4)
    first = total[0 if dy > 0 else -1]
    evident = np.sort(first, axis=1)[:, 1] > first[:, 5] + 0.05
    assert np.flatnonzero(evident).tolist() == [0, 1, 2, 3, 32, 33, 34, 35]


def test_a_discontinuity_follows_the_image_edge():
    """The costs are zero in a strip around the discontinuity."""
    height = 32
    guide = _gray(height)
    guide[:, 29:] = 0.95
    cost = 1 + _noise(height, 12)
    cost[:, :26, 2], cost[:, 34:, 9] = 0, 0
    cost[:, 26:34] = 0
    total = _aggregate(cost, guide)
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
        total = aggregate_costs(cost, _gray(height), slot_map, 20)
        least.append(float(total[16, 32, count + 4]))
    assert 0 < least[0] < 0.5 * least[1]


def test_the_best_label_lies_at_the_vertex_of_a_parabola():
    count = 12
    vertex = np.random.default_rng(0).uniform(1, count - 2, (16, 32, 1))
    total = ((np.arange(count) - vertex) ** 2).astype(np.float32)
    label, offset = select_labels(np.concatenate((total + 1, total), axis=2), count)
    assert (label >= count).all()
    assert np.allclose(label - count + offset, vertex[..., 0], atol=1e-3)


def test_offsets_do_not_cross_hypothesis_sets():
    total = np.ones((8, 16, 24), np.float32)
    total[:, :8, 11], total[:, :8, 12] = 0, 0.2  # 11 is the last of the first set
    total[:, 8:, 12], total[:, 8:, 11] = 0, 0.2
    label, offset = select_labels(total, 12)
    assert set(np.unique(label)) == {11, 12}
    assert (offset == 0).all()
