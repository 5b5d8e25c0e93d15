"""Progress in a terminal and in a file."""

import io
import re
import sys
from types import SimpleNamespace

import pytest

from pansplat.system import console
from pansplat.system.progress import report_progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The seconds that `time.monotonic` returns."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(console, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def test_without_a_terminal_a_line_with_the_time_left_is_printed_each_half_minute(clock, capsys) -> None:
    with console.progress_bar():
        for seconds in range(0, 91, 5):
            clock.now = float(seconds)
            report_progress("film", seconds / 120)
    assert capsys.readouterr().err.splitlines() == [
        "progress: film, 25 %, about 90 s left",
        "progress: film, 50 %, about 60 s left",
        "progress: film, 75 %, about 30 s left",
    ]


@pytest.mark.parametrize("speeds", [(1, 1, 1), (4, 1, 0.25), (0.25, 1, 4), (1, 8, 0.1), (5, 0.02, 5), (0.1, 9, 0.1)])
@pytest.mark.parametrize("steps", [1, 3, 40])
def test_the_stated_end_of_work_of_unequal_speed_does_not_recede(monkeypatch, clock, speeds, steps: int) -> None:
    monkeypatch.setattr(console, "describe_time_left", str)
    left, stated, silent = console._TimeLeft(), [], 0
    for stage, speed in enumerate(speeds):
        for step in range(steps):
            for _ in range(20):  # looks at the time between two reports
                clock.now += 100 / (20 * steps * speed)
                text = left.describe()
                stated += [clock.now + float(text)] if text else []
                silent += not text
            left.report((stage + (step + 1) / steps) / len(speeds))
    assert all(end <= 1.5 * min(stated[: number + 1]) + 1e-6 for number, end in enumerate(stated))
    if speeds == (1, 1, 1) and steps == 40:
        assert stated[len(stated) // 2 :] == pytest.approx([300] * (len(stated) - len(stated) // 2), abs=15)
        assert silent < len(stated) / 4


def test_work_that_has_not_begun_has_no_time_left(clock, capsys) -> None:
    with console.progress_bar():
        clock.now = 40.0
        report_progress("", 0.0)
    assert capsys.readouterr().err == "progress: working, 0 %\n"


@pytest.mark.parametrize("is_file", [True, False])
def test_a_terminal_shows_a_bar_and_standard_output_stays_complete(monkeypatch, is_file: bool) -> None:
    out, err = io.StringIO() if is_file else Terminal(), Terminal()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    with console.progress_bar():
        report_progress("placing Gaussians", 0.5)
        print("a result")
    assert "a result" in (out if is_file else err).getvalue()
    text = re.sub(r"\x1b\[[^a-zA-Z]*[a-zA-Z]", "", err.getvalue())
    assert "placing Gaussians" in text and "50 %" in text
