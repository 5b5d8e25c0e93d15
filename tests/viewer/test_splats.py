"""Sorting and the thread that does it."""

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pansplat_viewer import splats as splats_module
from pansplat_viewer.splats import Splats, SplatSorter, radix_argsort, sort_splats

_FLOATS = st.floats(width=32, allow_nan=False)


@given(hnp.arrays(np.float32, st.integers(0, 200), elements=_FLOATS))
def test_radix_order_is_the_stable_order_of_any_floats(keys):
    assert np.array_equal(radix_argsort(keys), np.argsort(keys, kind="stable"))


def test_radix_order_of_many_keys_with_ties_is_the_stable_order():
    keys = np.random.default_rng(0).integers(0, 5000, 200_000).astype(np.float32) / 7
    assert np.array_equal(radix_argsort(keys), np.argsort(keys, kind="stable"))


def test_ordering_is_by_distance_from_the_position(random_scene):
    splats = Splats.from_scene(random_scene())
    position = (0.3, -0.2, 0.1)
    ordering = sort_splats(splats, position)
    distance = np.linalg.norm(splats.means.astype(np.float64) - position, axis=1)
    assert np.allclose(ordering.distances, distance, rtol=1e-6)
    assert np.all(np.diff(distance[ordering.order]) > -1e-6)
    assert sorted(ordering.order.tolist()) == list(range(len(splats)))


def _wait(sorter: SplatSorter):
    for _ in range(2000):
        ordering = sorter.take()
        if ordering is not None:
            return ordering
        time.sleep(0.005)
    raise AssertionError("the sorter made nothing in 10 s")


def test_sorter_makes_what_was_asked_last_and_skips_what_waited(random_scene, monkeypatch):
    splats = Splats.from_scene(random_scene(20))
    started, go, seen = threading.Event(), threading.Event(), []

    def slow(splats, position):
        seen.append(position)
        started.set()
        assert go.wait(10)
        return sort_splats(splats, position)

    monkeypatch.setattr(splats_module, "sort_splats", slow)
    sorter = SplatSorter()
    sorter.request(splats, (1.0, 0.0, 0.0))
    assert started.wait(10)
    sorter.request(splats, (2.0, 0.0, 0.0))
    sorter.request(splats, (3.0, 0.0, 0.0))
    assert sorter.take() is None
    go.set()
    while _wait(sorter).position != (3.0, 0.0, 0.0):
        pass
    sorter.close()
    assert seen == [(1.0, 0.0, 0.0), (3.0, 0.0, 0.0)]


def test_what_fails_in_the_sorter_is_raised_where_it_is_taken(random_scene, monkeypatch):
    def fail(splats, position):
        raise MemoryError("no room")

    monkeypatch.setattr(splats_module, "sort_splats", fail)
    sorter = SplatSorter()
    sorter.request(Splats.from_scene(random_scene(5)), (0.0, 0.0, 0.0))
    with pytest.raises(MemoryError, match="no room"):
        _wait(sorter)
    sorter.close()


def test_closing_ends_the_thread(random_scene):
    before = threading.active_count()
    sorter = SplatSorter()
    sorter.request(Splats.from_scene(random_scene(5)), (0.0, 0.0, 0.0))
    _wait(sorter)
    sorter.close()
    assert threading.active_count() == before
    with pytest.raises(RuntimeError, match="closed"):
        sorter.request(Splats.from_scene(random_scene(5)), (0.0, 0.0, 0.0))
