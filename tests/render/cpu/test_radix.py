"""The order front to back: stable, exact to far below float32, the same on any number of threads."""

import numpy as np
import pytest

from pansplat.render.cpu.radix import front_to_back

_UPRIGHT = np.zeros(3)


def _records(directions):
    records = np.zeros((len(directions), 16), np.float32)
    records[:, :3] = directions
    return records


def _sorted(radii, lease, *, records=None, towards=_UPRIGHT, hidden=None, threads=1):
    radii = np.asarray(radii, np.float64)
    boxes = np.zeros((len(radii), 4), np.int16)
    if hidden is not None:
        boxes[hidden] = (0, 0, 1, 0)
    records = _records(np.ones((len(radii), 3))) if records is None else records
    return front_to_back(records, radii, boxes, towards, lease, threads)


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
def test_distances_come_out_in_order_and_equal_ones_by_number(threads, lease):
    random = np.random.default_rng(0)
    radii = random.integers(1, 5000, 30000) / 64.0
    assert np.array_equal(_sorted(radii, lease, threads=threads), np.argsort(radii, kind="stable"))


def test_distances_one_step_of_float32_apart_are_told_apart(lease):
    step = float(np.spacing(np.float32(3)))
    radii = 3 + step * np.arange(20)[::-1]
    assert _sorted(radii, lease).tolist() == list(range(20))[::-1]
    radii = 3 + step / 32 * np.arange(20)[::-1]
    assert _sorted(radii, lease).tolist() == list(range(20))[::-1]


@pytest.mark.parametrize("count", [0, 1, 2, 2049])
def test_any_number_of_gaussians_is_sorted(count, lease):
    radii = np.linspace(9, 1, count) if count else np.empty(0)
    assert _sorted(radii, lease).tolist() == list(range(count))[::-1]


def test_a_range_of_36_powers_of_ten_is_sorted(lease):
    radii = 10.0 ** np.random.default_rng(1).permutation(np.linspace(-18, 18, 5000))
    assert np.array_equal(_sorted(radii, lease), np.argsort(radii, kind="stable"))


def test_gaussians_without_a_box_are_left_out(lease):
    hidden = np.arange(20000) % 3 != 0
    order = _sorted(np.linspace(20, 10, 20000), lease, hidden=hidden, threads=2)
    assert np.array_equal(order, np.arange(20000)[~hidden][::-1])


def test_depths_of_both_signs_come_out_in_order(lease):
    random = np.random.default_rng(2)
    directions = random.standard_normal((5000, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    radii, towards = random.uniform(1, 9, 5000), np.array((0.6, 0.0, 0.8))
    depths = radii * (directions.astype(np.float64) @ towards)
    order = _sorted(radii, lease, records=_records(directions), towards=towards)
    assert (np.diff(depths[order]) > -1e-6).all() and len(set(order.tolist())) == 5000
    assert depths.min() < -5 and depths.max() > 5
