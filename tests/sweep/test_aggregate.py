"""Semi-global aggregation on the sphere."""

import numpy as np
import pytest

from pansplat.sweep.aggregate import AggregationConfig, _sweep_columns, aggregate, best_labels

_AWAY_FROM_POLES = slice(4, -4)
"""Rows whose paths forget within half a turn where they began; nearer to a pole changing costs too much for that."""
_FREE = AggregationConfig(step_price=0, crease_price=0, jump_price=0)


def _slots(height: int, families: int = 1) -> np.ndarray:
    """Every family's hypotheses k in depth slots k."""
    slot_map = np.zeros((height, 2 * height, families, 2), np.float32)
    slot_map[..., 0], slot_map[..., 1] = 1, 0.5
    return slot_map


def _gray(height: int) -> np.ndarray:
    return np.full((height, 2 * height, 3), 0.5, np.float32)


def _noise(height: int, labels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, 2 * height, labels)).astype(np.float32)


def test_without_prices_every_direction_counts_the_cost_once():
    cost = _noise(32, 24)
    total = aggregate(cost, _gray(32), _slots(32, 2), 12, _FREE)
    assert np.allclose(total, 8 * cost, atol=1e-5)


def test_a_hypothesis_that_fits_everywhere_costs_nothing():
    cost = 0.1 + _noise(32, 24)
    cost[..., 17] = 0
    total = aggregate(cost, _gray(32), _slots(32, 2), 12, AggregationConfig())
    assert np.abs(total[..., 17]).max() < 1e-5
    assert np.delete(total, 17, axis=2).min() > 0.1


def test_a_plane_is_carried_on_through_a_gap_that_shows_nothing():
    cost = _noise(32, 12) + 1
    cost[..., 5] = 0
    gap = (slice(10, 20), slice(20, 40))
    cost[gap] = 0.02 * _noise(32, 12, seed=1)[gap]
    assert (cost[gap].argmin(axis=-1) == 5).mean() < 0.3  # the gap by itself does not know
    total = aggregate(cost, _gray(32), _slots(32), 12, AggregationConfig())
    assert (total.argmin(axis=-1) == 5).all()


def test_a_gap_across_the_left_and_right_edge_is_filled_as_well():
    cost = _noise(32, 12) + 1
    cost[..., 5] = 0
    gap = (np.arange(10, 20)[:, None], np.arange(-10, 10)[None])
    cost[gap] = 0.02 * _noise(32, 12, seed=1)[gap]
    total = aggregate(cost, _gray(32), _slots(32), 12, AggregationConfig())
    assert (total.argmin(axis=-1) == 5).all()


@pytest.mark.parametrize("pole", (slice(0, 5), slice(-5, None)))
def test_a_gap_over_a_pole_is_filled_as_well(pole):
    cost = _noise(32, 12) + 1
    cost[..., 5] = 0
    cost[pole] = 0.004 * _noise(32, 12, seed=1)[pole]
    total = aggregate(cost, _gray(32), _slots(32), 12, AggregationConfig())
    assert (total.argmin(axis=-1) == 5).all()


@pytest.mark.parametrize("dy", (1, -1))
def test_a_column_goes_on_over_the_pole_half_a_turn_away(dy):
    """What a few columns know at the pole that paths come from reaches the opposite columns, and no others."""
    height, count = 32, 12
    cost = np.zeros((height, 2 * height, count), np.float32)
    known = slice(0, 6) if dy > 0 else slice(-6, None)
    cost[known, :4] = 1
    cost[known, :4, 5] = 0
    total = np.zeros_like(cost)
    prices = tuple(np.float32(price) for price in (0.08, 0.15, 0.8, 0.1))
    _sweep_columns(cost, total, _gray(height), _slots(height), 1, count, count, prices, dy, 0, height // 4)
    first = total[0 if dy > 0 else -1]
    knows = np.sort(first, axis=1)[:, 1] > first[:, 5] + 0.05
    assert np.flatnonzero(knows).tolist() == [0, 1, 2, 3, 32, 33, 34, 35]


def test_a_jump_stays_where_the_picture_has_an_edge():
    """The costs leave a strip open in which the surface jumps; the picture says where."""
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


def test_families_meet_cheaply_only_where_their_slots_do():
    """Family 0's hypothesis gives way to family 1's; cheap if both pass through the same depth, else a jump."""
    height, count = 32, 12
    cost = np.full((height, 2 * height, 2 * count), 1.0, np.float32)
    cost[:, :32, 4] = 0
    cost[:, 32:, count + 4] = 0
    least = []
    for start in (0.5, 6.5):  # family 1's hypothesis 4 lies in slot 4, or in slot 10
        slot_map = _slots(height, 2)
        slot_map[..., 1, 1] = start
        total = aggregate(cost, _gray(height), slot_map, 20, AggregationConfig())
        least.append(float(total[16, 32, count + 4]))
    assert 0 < least[0] < 0.5 * least[1]


def test_threads_change_no_bit():
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


def test_no_offset_leaves_a_family():
    total = np.ones((8, 16, 24), np.float32)
    total[:, :8, 11], total[:, :8, 12] = 0, 0.2  # the last of the first family: 12 belongs to another
    total[:, 8:, 12], total[:, 8:, 11] = 0, 0.2
    label, offset = best_labels(total, 12)
    assert set(np.unique(label)) == {11, 12}
    assert (offset == 0).all()
