"""Memory, time and errors of calls; rows that a run prints and writes, though it is interrupted."""

import json
import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from pansplat.bench import harness
from pansplat.bench.harness import (
    Suite,
    announce,
    compare_images,
    describe_machine,
    measure_peak_memory,
    quartile_range,
    time_call,
    time_workload,
)
from pansplat.evaluation.results import Column, Row
from pansplat.system.files import is_written

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
    assert 10 * count - 2 <= peak["peak_mb"] <= 10 * count + 20  # other threads may allocate a little
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


def test_the_workload_is_the_median_of_51_calls_after_half_a_second(monkeypatch):
    clock, durations = Clock(monkeypatch), [0.3, 0.3, *range(51)]
    monkeypatch.setattr(torch.nn.functional, "conv2d", lambda *_, **__: clock.work(durations.pop(0)))
    assert time_workload() == 25 and not durations


def test_the_machine_is_described():
    machine = describe_machine()
    assert machine["cpu"] and machine["threads"] == torch.get_num_threads()
    assert machine["versions"]["torch"] == torch.__version__


SPEED = Suite(
    "speed",
    (Column("height", "height", "d"), Column("seconds", "seconds", ".1f")),
    lambda row: f"room: {row.get('height')}",
    lambda rows, header: Figure(),
    lambda rows: [f"{len(rows)} rows."],
)


def test_an_interrupted_run_is_printed_and_written(tmp_path, capsys):
    def measure():
        announce("the first row")
        row = Row({"height": 16}, {"seconds": 2.0})
        yield row
        row.values["seconds"] = math.inf  # measured again
        yield row
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        harness.run(SPEED, measure(), {"setting": "small"}, out=tmp_path)
    content = json.loads((tmp_path / "speed.json").read_text())
    assert content["rows"] == [{"height": 16, "seconds": None}] and content["setting"] == "small"
    assert (tmp_path / "speed.md").read_text().splitlines()[1:] == [
        *("* 1 rows.", "", "### Room: 16", ""),
        *("| height | seconds |", "| ---: | ---: |", "| 16 | exact |"),
    ]
    names = ["speed.json", "speed.md", "speed.png"]
    assert all(is_written(tmp_path / name) for name in names)
    printed, steps = capsys.readouterr()
    assert "GPU: none" in printed and "room: 16" in printed and "1 rows." in printed
    assert printed.split()[-3:] == [str(tmp_path / name) for name in names] and steps == "the first row\n"


def test_a_run_without_rows_writes_nothing_and_one_without_a_plot_no_picture(tmp_path):
    assert harness.run(SPEED, [], {}, out=tmp_path) == [] and not list(tmp_path.iterdir())
    harness.run(replace(SPEED, plot=lambda rows, header: None), [Row({"height": 16})], {}, out=tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["speed.json", "speed.md"]
