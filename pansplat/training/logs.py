"""Logs of a training run: CSV tables, their plot, and the progress on the terminal."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from pansplat.system.atomic import replacing

_SMOOTHING = 20  # divides the number of steps; the thick curve averages over the quotient


class CsvTable:
    """A CSV file with one row per step. Rows from `step` on, of an earlier run, are removed.

    Args:
        path: file to write.
        columns: names after the first column, `step`.
        step: the first step that will be written.
    """

    def __init__(self, path: Path, columns: tuple[str, ...], step: int) -> None:
        self.columns = ("step", *columns)
        kept = [row for row in read_table(path) if int(row["step"]) < step] if path.is_file() else []
        text = io.StringIO()
        writer = csv.DictWriter(text, self.columns, extrasaction="ignore", restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept)
        with replacing(path) as partial:
            partial.write_text(text.getvalue(), "utf-8")
        self._file = open(path, "a", encoding="utf-8", newline="")  # noqa: SIM115  # closed by `close`
        self._writer = csv.DictWriter(self._file, self.columns, lineterminator="\n")

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Write a row and flush it to the file."""
        self._writer.writerow({"step": step, **{name: f"{values[name]:.9g}" for name in self.columns[1:]}})
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def read_table(path: Path) -> list[dict[str, str]]:
    """The complete rows of a CSV file; an incomplete last row is ignored."""
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return [row for row in rows if (row.get("step") or "").isdecimal() and all(map(_is_number, row.values()))]


def _is_number(text: object) -> bool:
    """Whether a value of a row is a number or empty; a row that was cut off, edited or damaged has others."""
    try:
        return text == "" or isinstance(float(str(text)), float)
    except ValueError:
        return False


def plot_run(folder: Path) -> Path | None:
    """Plot the tables of a run's folder as `curves.png`; None if nothing has been logged yet."""
    log, scores = (read_table(folder / name) for name in ("log.csv", "validation.csv"))
    if not log:
        return None
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    steps = [int(row["step"]) + 1 for row in log]
    losses = [float(row["loss"]) for row in log]
    above.plot(steps, losses, color="#b9cfe4", linewidth=1)
    above.plot(steps, _running_means(losses), color="#1764ab", linewidth=2)
    above.set_ylabel("loss")
    for measure, color, label in (("psnr", "#c8501e", "PSNR, dB"), ("ws_psnr", "#e0a030", "WS-PSNR, dB")):
        values = [float(row[measure]) for row in scores]
        below.plot([int(row["step"]) for row in scores], values, "o-", color=color, label=label)
    below.set(xlabel="step", ylabel="unseen places, dB")
    below.legend(loc="lower right")
    for axes in (above, below):
        axes.grid(alpha=0.25)
    path = folder / "curves.png"
    with replacing(path) as unfinished:
        figure.savefig(unfinished, dpi=110, format="png")
    return path


def _running_means(values: list[float]) -> np.ndarray:
    """Means over each value and the ones before it, in a window of a 20th of all values."""
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - math.ceil(len(values) / _SMOOTHING), 0)
    sums = np.cumsum([0.0, *values])
    return (sums[ends] - sums[starts]) / (ends - starts)


class ProgressDisplay:
    """A progress bar with the loss and the remaining time; lines of text if stderr is not a terminal."""

    def __init__(self, step: int, total: int, *, silent: bool) -> None:
        self.console = Console(stderr=True, quiet=silent, highlight=False)
        self.total, self.first = total, step
        self.progress = Progress(
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[loss]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self.console,
            disable=silent or not self.console.is_terminal,
        )
        self.task = self.progress.add_task("training", total=total, completed=step, loss="")
        self._every = max(1, total // 20)

    def __enter__(self) -> ProgressDisplay:
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()

    def update(self, done: int, loss: float, seconds: float) -> None:
        """Show the number of completed steps, and the loss and duration of the last one."""
        self.progress.update(self.task, completed=done, loss=f"loss {loss:.4f}")
        if not self.console.is_terminal and (done % self._every == 0 or done in (self.first + 1, self.total)):
            left = (self.total - done) * seconds / 60
            self.print(f"step {done} of {self.total}, loss {loss:.4f}, {seconds:.2f} s per step, {left:.0f} min left")

    def print(self, text: str) -> None:
        """Print a line above the progress bar."""
        self.console.print(text, markup=False, soft_wrap=True)
