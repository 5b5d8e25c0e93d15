"""Sorting by distance, and the worker thread that sorts."""

import threading

import numpy as np
import pytest

from pansplat_viewer.draw import splats as splats_module
from pansplat_viewer.draw.splats import Splats, SplatSorter, sort_splats


@pytest.fixture
def splats(random_scene) -> Splats:
    return Splats.from_scene(random_scene(20))


def test_splats_are_sorted_by_distance_from_the_position(random_scene):
    splats = Splats.from_scene(random_scene())
    position = (0.3, -0.2, 0.1)
    result = sort_splats(splats, position)
    distance = np.linalg.norm(splats.means.astype(np.float64) - position, axis=1)
    assert np.all(np.diff(distance[result.order]) > -1e-6)
    assert sorted(result.order.tolist()) == list(range(len(splats)))


def test_sorter_skips_requests_that_were_replaced(splats, monkeypatch, wait_until):
    started, go, positions = threading.Event(), threading.Event(), []

    def slow(splats, position):
        positions.append(position)
        started.set()
        assert go.wait(300)
        return sort_splats(splats, position)

    monkeypatch.setattr(splats_module, "sort_splats", slow)
    sorter = SplatSorter()
    sorter.request(splats, (1.0, 0.0, 0.0))
    assert started.wait(300)
    sorter.request(splats, (2.0, 0.0, 0.0))
    sorter.request(splats, (3.0, 0.0, 0.0))
    assert sorter.take() is None
    go.set()
    wait_until(lambda: (result := sorter.take()) and result.position == (3.0, 0.0, 0.0), "order of the last position")
    sorter.close()
    assert positions == [(1.0, 0.0, 0.0), (3.0, 0.0, 0.0)]


def test_exception_in_the_thread_is_raised_by_take(splats, monkeypatch, wait_until):
    def fail(splats, position):
        raise MemoryError("out of memory")

    monkeypatch.setattr(splats_module, "sort_splats", fail)
    sorter = SplatSorter()
    sorter.request(splats, (0.0, 0.0, 0.0))
    with pytest.raises(MemoryError, match="out of memory"):
        wait_until(sorter.take, "exception")
    sorter.close()
    with pytest.raises(RuntimeError, match="shutdown"):
        sorter.request(splats, (0.0, 0.0, 0.0))
