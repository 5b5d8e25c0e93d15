"""Intersections are sorted by distance within their tile."""

import numpy as np
import pytest

from pansplat.rendering.cpu.tiling import TileIntersections, radix_argsort, sort_front_to_back
from pansplat.system.kernels import Workspace


def _make_tiles(counts, *, slots=True):
    """Tiles with these numbers of intersections, each with the Gaussians from 0 on."""
    gaussians = np.concatenate([np.arange(count) for count in counts])
    intersections = np.stack((gaussians, 7 * np.arange(len(gaussians)) + 1), axis=1).astype(np.int32)
    starts = np.concatenate(((0,), np.cumsum(counts))).astype(np.int64)
    numbers = (3 * np.arange(len(gaussians) if slots else 0) + 5).astype(np.int32)
    return TileIntersections(0, intersections, starts, numbers, np.empty(0), Workspace())


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("slots", [True, False])
def test_intersections_are_sorted_within_their_tile_with_their_slots(threads, slots):
    counts = [0, 1, 2, 5, 0, 300, 3000, 17, 40]
    tiles = _make_tiles(counts, slots=slots)
    intersections, numbers = tiles.intersections.copy(), tiles.slots.copy()
    distances = np.random.default_rng(0).integers(1, 900, max(counts)) / 64.0
    sort_front_to_back(tiles, distances, threads)
    for first, end in zip(tiles.starts[:-1], tiles.starts[1:], strict=True):
        order = first + np.argsort(distances[intersections[first:end, 0]], kind="stable")
        assert np.array_equal(tiles.intersections[first:end], intersections[order])
        if slots:
            assert np.array_equal(tiles.slots[first:end], numbers[order])


def _order(distances):
    """The Gaussians of one tile, sorted."""
    tiles = _make_tiles([len(distances)], slots=False)
    sort_front_to_back(tiles, distances, 1)
    return tiles.intersections[:, 0].tolist()


@pytest.mark.parametrize(
    "distances",
    [
        pytest.param(np.full(5000, 2.5), id="equal"),
        pytest.param(3.3 + np.spacing(3.3) * np.arange(20), id="ties by rounding"),
        pytest.param(3 + 2.0**-38 * np.arange(1000)[::-1], id="closer than float32"),
        pytest.param(10.0 ** np.random.default_rng(1).permutation(np.linspace(-18, 18, 5000)), id="36 decades"),
    ],
)
def test_sorting_is_stable_for_any_distribution(distances):
    assert _order(distances) == np.argsort(distances, kind="stable").tolist()


@pytest.mark.parametrize("count", [0, 1, 3000])
def test_the_order_of_float32_keys_is_that_of_a_stable_sort(count):
    random = np.random.default_rng(5)
    keys = (random.standard_normal(count) * 10.0 ** random.integers(-30, 30, count)).astype(np.float32)
    keys[::7], keys[3::7], keys[5::7], keys[6:20] = 0.0, -0.0, keys[5::7][::-1], np.inf
    assert np.array_equal(radix_argsort(keys), np.argsort(keys, kind="stable"))


def test_depths_of_both_signs_are_sorted():
    depths = np.random.default_rng(3).standard_normal(5000)
    depths[:5] = 0.0, -0.0, 1e-300, -1e-300, -0.0
    order = _order(depths)  # keys and indices exceed 64 bits, so keys are cut
    assert np.array_equal(depths[order], np.sort(depths, kind="stable"))
    assert order.index(0) < order.index(1) < order.index(4)
