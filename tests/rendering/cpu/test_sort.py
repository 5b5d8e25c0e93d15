"""Each tile's entries front to back: stable, exact but for rounding, the same on any number of threads."""

import numpy as np
import pytest

from pansplat.rendering.cpu.bins import TileLists
from pansplat.rendering.cpu.sort import depths_along, sort_front_to_back


def _lists(counts, lease, *, slots=True):
    """Tiles of so many entries each: the Gaussians from 0 on, in order, with other boxes and slots than numbers."""
    numbers = np.concatenate([np.arange(count) for count in counts]) if counts else np.empty(0, int)
    entries = np.stack((numbers, 7 * np.arange(len(numbers)) + 1), axis=1).astype(np.int32)
    places = (3 * np.arange(len(numbers) if slots else 0) + 5).astype(np.int32)
    return TileLists(0, entries, np.concatenate(((0,), np.cumsum(counts))).astype(np.int64), places, np.empty(0), lease)


def _sorted(distances, lease, threads=1):
    """The order of one tile."""
    lists = _lists([len(distances)], lease, slots=False)
    sort_front_to_back(lists, np.asarray(distances, np.float64), threads)
    return lists.entries[:, 0].tolist()


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
@pytest.mark.parametrize("slots", [True, False])
def test_every_tile_is_in_order_and_boxes_and_slots_go_along(threads, slots, lease):
    counts = [0, 1, 2, 5, 0, 300, 3000, 17, 40]
    lists = _lists(counts, lease, slots=slots)
    entries, places = lists.entries.copy(), lists.slots.copy()
    distances = np.random.default_rng(0).integers(1, 900, max(counts)) / 64.0
    sort_front_to_back(lists, distances, threads)
    for first, end in zip(lists.starts[:-1], lists.starts[1:], strict=True):
        order = first + np.argsort(distances[entries[first:end, 0]], kind="stable")
        assert np.array_equal(lists.entries[first:end], entries[order])
        if slots:
            assert np.array_equal(lists.slots[first:end], places[order])


def test_equal_distances_stay_in_the_order_of_their_numbers(lease):
    assert _sorted(np.full(5000, 2.5), lease) == list(range(5000))


def test_distances_are_told_apart_far_below_float32(lease):
    distances = 3 + 2.0**-38 * np.arange(1000)[::-1]
    assert _sorted(distances, lease) == list(range(1000))[::-1]


def test_distances_that_only_rounding_tells_apart_stay_in_the_order_of_their_numbers(lease):
    distances = 3.3 + np.spacing(3.3) * np.arange(20)[::-1]
    assert _sorted(distances, lease) == list(range(20))


def test_a_range_of_36_powers_of_ten_is_sorted(lease):
    distances = 10.0 ** np.random.default_rng(1).permutation(np.linspace(-18, 18, 5000))
    assert np.array_equal(_sorted(distances, lease), np.argsort(distances, kind="stable"))


@pytest.mark.parametrize("far", [1e30, 4.0, 3.0])
def test_many_that_crowd_together_before_one_far_away_are_sorted(far, lease):
    distances = 2 + 1e-11 * np.random.default_rng(2).permutation(4000)
    distances[1234] = far
    assert np.array_equal(_sorted(distances, lease), np.argsort(distances, kind="stable"))


def test_depths_of_both_signs_come_out_in_order(lease):
    depths = np.random.default_rng(3).standard_normal(5000)
    depths[:5] = 0.0, -0.0, 1e-300, -1e-300, -0.0
    # Of 64 bits with the places: some are cut from the keys.
    order = _sorted(depths, lease)
    assert np.array_equal(depths[order], np.sort(depths, kind="stable"))
    assert order.index(0) < order.index(1) < order.index(4)


def test_depths_lie_along_the_axis(lease):
    random = np.random.default_rng(4)
    directions = random.standard_normal((5000, 3))
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    records = np.zeros((5000, 16), np.float32)
    records[:, :3] = directions
    records[:, 3:6] = directions - records[:, :3]
    radii, axis = random.uniform(1, 9, 5000), np.array((0.6, 0.0, 0.8))
    for threads in (1, 3):
        depths = depths_along(records, radii, axis, lease, threads)
        assert np.allclose(depths, radii * (directions @ axis), rtol=0, atol=1e-13)
