"""Learning rates equal the official ones, and form a cycle for any number of steps."""

from collections.abc import Callable

import pytest
import torch

from pansplat.training.optimization import one_cycle_rate


def test_rates_equal_the_official_ones(golden: Callable) -> None:
    expected = golden("units")["lr.total1000"]
    ours = torch.tensor([one_cycle_rate(step, 1000 + 10, 2e-4) for step in range(1000)], dtype=torch.float64)
    torch.testing.assert_close(ours, expected, rtol=1e-9, atol=1e-16)


@pytest.mark.parametrize("total", [11, 60, 310, 33_260])
def test_the_rate_is_positive_and_at_most_the_peak(total: int) -> None:
    rates = [one_cycle_rate(step, total, 1.0) for step in range(0, total + 20, max(1, total // 500))]
    assert max(rates) == pytest.approx(1.0, abs=0.02)
    assert min(rates) > 0
    assert rates[-1] == pytest.approx(1 / 25e4)
