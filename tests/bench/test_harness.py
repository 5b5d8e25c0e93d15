"""Memory and time of calls, and errors of child processes."""

import sys

import numpy as np
import pytest
import torch

from pansplat.bench.harness import (
    CaseFailedError,
    OverLimitError,
    _make_error,
    describe_machine,
    measure_peak_memory,
    quartile_range,
    time_call,
)

CPU = torch.device("cpu")
linux = pytest.mark.skipif(sys.platform != "linux", reason="the high-water mark is Linux's")


@linux
@pytest.mark.parametrize("count", [2, 6])
def test_peak_memory_is_the_memory_that_the_call_holds_at_once(count):
    before = np.ones(50_000_000, np.uint8)

    def hold() -> int:
        return sum(int(block.sum()) for block in [np.ones(10_000_000, np.uint8) for _ in range(count)])

    peak, total = measure_peak_memory(hold, CPU)
    assert total == count * 10_000_000
    assert peak is not None and 10 * count - 2 <= peak <= 10 * count + 5
    assert before[0] == 1  # held during the call


def test_time_call_returns_the_result_of_the_call():
    timing, result = time_call(lambda: sum(range(200_000)) * 0 + 7, CPU)
    assert result == 7 and timing.wall > 0 and timing.cpu > 0


def test_the_machine_is_described():
    machine = describe_machine(2)
    assert set(machine) >= {"cpu", "cores", "system", "python", "gpu"}
    assert machine["threads"] == 2 and machine["versions"]["torch"] == torch.__version__


def test_outliers_hardly_change_the_quartile_range():
    assert quartile_range([5.0]) == 0
    assert quartile_range([1.0, 4.0]) == 3
    assert quartile_range([0.0, 1.0, 2.0, 3.0, 1000.0]) == 2


@pytest.mark.parametrize(
    ("status", "log", "kind", "message"),
    [
        (1, "RuntimeError: [enforce fail] can't allocate memory", OverLimitError, "no memory left"),
        (1, "torch.OutOfMemoryError: CUDA out of memory. Tried", OverLimitError, "no memory left"),
        (1, "MemoryError", OverLimitError, "no memory left"),
        (-9, "", CaseFailedError, "ended by SIGKILL"),
        (1, "", CaseFailedError, "no message"),
        (1, "Traceback\nValueError: nonsense", CaseFailedError, "ValueError: nonsense"),
    ],
)
def test_errors_of_children_name_their_cause(status, log, kind, message):
    error = _make_error(status, log)
    assert type(error) is kind and str(error).startswith(message)
