"""What a run tells: rows of numbers in CSV files, TensorBoard where it is installed, and a line of progress."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from pansplat.atomic import replacing


class Table:
    """A CSV file with a row a step. A run that goes on from an earlier step drops the rows after it.

    Args:
        path: of the file.
        columns: after the first, which is `step`.
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
            partial.write_text(text.getvalue())
        self._file = open(path, "a", newline="")  # noqa: SIM115  # closed by `close`
        self._writer = csv.DictWriter(self._file, self.columns, lineterminator="\n")

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Write a row; it is in the file when this returns."""
        self._writer.writerow({"step": step, **{name: f"{values[name]:.9g}" for name in self.columns[1:]}})
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def read_table(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file; a last row that was cut off is left out."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    return [row for row in rows if None not in row.values() and (row.get("step") or "").isdigit()]


class Board:
    """TensorBoard's files, where the package is installed; else nothing."""

    def __init__(self, folder: Path) -> None:
        self._writer: Any = None
        if find_spec("tensorboard") is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(folder))

    def add(self, step: int, values: Mapping[str, float], group: str) -> None:
        """Numbers of a step."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, step)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


class Watch:
    """A bar with the loss and the time left; without a terminal, a line now and then."""

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

    def __enter__(self) -> Watch:
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()

    def show(self, done: int, loss: float, seconds: float) -> None:
        """After so many steps, the last of which took that long."""
        self.progress.update(self.task, completed=done, loss=f"loss {loss:.4f}")
        if not self.console.is_terminal and (done % self._every == 0 or done in (self.first + 1, self.total)):
            left = (self.total - done) * seconds / 60
            self.say(f"step {done} of {self.total}, loss {loss:.4f}, {seconds:.2f} s a step, {left:.0f} min left")

    def say(self, text: str) -> None:
        """A line that stays."""
        self.console.print(text, markup=False, soft_wrap=True)
