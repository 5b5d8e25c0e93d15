"""Memory is that of the call alone; middles and spreads of times."""

import sys

import numpy as np
import pytest
import torch

from pansplat.bench.measure import median, peak_memory, seconds, spread

CPU = torch.device("cpu")
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="the high-water mark is Linux's")


@LINUX
def test_peak_is_what_was_held_at_once():
    def hold(count: int) -> int:
        return sum(int(block.sum()) for block in [np.ones(10_000_000, np.uint8) for _ in range(count)])

    for count in (2, 6):
        peak, total = peak_memory(lambda count=count: hold(count), CPU)
        assert total == count * 10_000_000
        assert peak is not None and 10 * count - 2 <= peak <= 10 * count + 5


@LINUX
def test_memory_held_before_does_not_count():
    before = np.ones(50_000_000, np.uint8)
    peak, _ = peak_memory(lambda: np.ones(10_000_000, np.uint8), CPU)
    assert peak is not None and peak <= 15
    assert before[0] == 1


def test_seconds_returns_what_the_call_returns():
    took, result = seconds(lambda: sum(range(200_000)) * 0 + 7, CPU)
    assert result == 7 and took.wall > 0 and took.cpu > 0


def test_spread_is_the_range_between_the_quartiles():
    assert median([3.0, 1.0, 2.0]) == 2
    assert spread([5.0]) == 0
    assert spread([1.0, 4.0]) == 3
    assert spread([0.0, 1.0, 2.0, 3.0, 1000.0]) == 2  # one late time counts little
