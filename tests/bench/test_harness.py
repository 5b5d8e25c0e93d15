"""Memory, time and errors of calls, and errors of child processes."""

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pansplat.bench import harness
from pansplat.bench.harness import (
    CaseFailedError,
    OverLimitError,
    _make_error,
    compare_images,
    describe_machine,
    measure_peak_memory,
    quartile_range,
    relative_deviation,
    time_call,
    time_workload,
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
    assert peak is not None and 10 * count - 2 <= peak <= 10 * count + 20  # other threads may allocate a little
    del before  # held during the call


class Clock:
    """Clocks that move only during a call."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall, self.cpu = 100.0, 10.0
        monkeypatch.setattr(
            harness, "time", SimpleNamespace(perf_counter=lambda: self.wall, process_time=lambda: self.cpu)
        )

    def work(self, wall: float, cpu: float = 0.0) -> int:
        self.wall, self.cpu = self.wall + wall, self.cpu + cpu
        return 7


def test_time_call_measures_both_clocks_around_the_call(monkeypatch):
    clock = Clock(monkeypatch)
    timing, result = time_call(lambda: clock.work(3.0, 2.0), CPU)
    assert (timing.wall, timing.cpu, result) == (3.0, 2.0, 7)


def test_outliers_hardly_change_the_quartile_range():
    assert quartile_range([5.0]) == 0
    assert quartile_range([1.0, 4.0]) == 3
    assert quartile_range([0.0, 1.0, 2.0, 3.0, 1000.0]) == 2


def test_one_wrong_pixel_sets_the_largest_error_and_the_psnr():
    reference = torch.rand(3, 8, 16, generator=torch.Generator().manual_seed(0))
    wrong = reference.clone()
    wrong[1, 5, 2] += 0.25
    assert compare_images(reference, reference) == {"psnr_db": math.inf, "max_error": 0}
    expected = -10 * math.log10(0.25**2 / reference.numel())
    assert compare_images(wrong, reference) == pytest.approx({"psnr_db": expected, "max_error": 0.25}, rel=1e-5)
    with pytest.raises(ValueError, match="reference's shape"):
        compare_images(wrong[:, :-1], reference)


def test_deviation_of_tensors_is_relative_to_the_reference():
    reference = {"a": torch.tensor([3.0, 0.0]), "b": torch.tensor([4.0])}
    result = {"a": torch.tensor([3.0, 0.3]), "b": torch.tensor([4.0])}
    assert relative_deviation(result, reference, together=True) == pytest.approx(0.06)
    assert relative_deviation(result, reference, together=False) == pytest.approx(0.1)
    with pytest.raises(ValueError, match="must hold"):
        relative_deviation({"a": result["a"]}, reference, together=True)


def test_the_workload_is_the_median_of_51_calls_after_half_a_second(monkeypatch):
    clock, durations = Clock(monkeypatch), [0.3, 0.3, *range(51)]
    monkeypatch.setattr(torch.nn.functional, "conv2d", lambda *_, **__: clock.work(durations.pop(0)))
    assert time_workload() == 25 and not durations


def test_the_machine_is_described():
    machine = describe_machine()
    assert machine["cpu"] and machine["threads"] == torch.get_num_threads()
    assert machine["versions"]["torch"] == torch.__version__


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
