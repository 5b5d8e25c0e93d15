"""What a person reads of `pansplat bench memory`: a table, and memory over height with the paper's points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from pansplat.atomic import replacing
from pansplat.bench.memory import MemoryRow
from pansplat.bench.memory_case import Work
from pansplat.bench.tabulate import Column, number, page_table, terminal_table

PAPER_POINTS: tuple[tuple[str, str, int, float], ...] = (
    ("training", "untiled", 512, 36.0),
    ("training", "16 tiles", 2048, 42.0),
    ("inference", "untiled", 512, 7.5),
    ("inference", "tiled", 512, 5.0),
    ("inference", "4 tiles", 2048, 40.0),
    ("inference", "16 tiles", 2048, 23.0),
)
"""Kind, tiles, height, GB of a GPU. Source: the paper's figure of memory, read off by eye. Training's batch is 2 at 512
and 1 at 2048; with 4 tiles 2048 ran out of memory."""

_COLUMNS: tuple[Column, ...] = (
    ("height", "right"),
    ("work", "left"),
    ("tiles", "right"),
    ("base GiB", "right"),
    ("peak GiB", "right"),
    ("taken GiB", "right"),
    ("seconds", "right"),
    ("processor s", "right"),
    ("deviation", "right"),
    ("", "left"),
)
_COLORS: dict[Work, str] = {
    "inference": "#1764ab", "plain": "#444444", "one-step": "#e0a030", "two-step": "#c8501e"
}  # fmt: skip
_LINES = {1: "-", 2: "--", 4: ":"}
_MARKERS = {1: "o", 2: "s", 4: "D"}


def memory_table(rows: Sequence[MemoryRow], title: str) -> Table:
    """All rows, in order."""
    return terminal_table(_COLUMNS, map(memory_cells, rows), title)


def memory_markdown(rows: Sequence[MemoryRow]) -> str:
    """The same table as a page's text."""
    return page_table(_COLUMNS, map(memory_cells, rows)) + "\n"


def memory_cells(row: MemoryRow) -> tuple[str, ...]:
    """A row's cells; what was not measured is blank, and the last cell says why."""
    error = "reference" if row.reference else number(row.deviation, "{:.1e}")
    why = "" if row.status == "measured" else f"{row.status}: {row.note}"
    return (
        *(str(row.height), row.work, str(row.tiles**2)),
        *(number(value, "{:.2f}") for value in (row.base_gib, row.peak_gib, row.taken_gib)),
        *(number(value, "{:.1f}") for value in (row.wall_s, row.processor_s)),
        *(error, why),
    )


def plot_memory(rows: Sequence[MemoryRow], path: Path, title: str) -> bool:
    """Memory taken over height, training and inference apart; False when there is nothing to show.

    Raises:
        InputError: the file cannot be written.
    """
    shown = [row for row in rows if row.taken_gib]
    if not shown:
        return False
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _draw(left, [row for row in shown if row.work != "inference"], "training")
    _draw(right, [row for row in shown if row.work == "inference"], "inference")
    left.set_ylabel("GiB taken beyond Python, weights and input")
    heights = sorted({row.height for row in shown} | {point[2] for point in PAPER_POINTS})
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_yscale("log", base=2)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xticks(heights, [f"{height}\nx{2 * height}" for height in heights])
        axes.minorticks_off()
        axes.grid(alpha=0.25)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)
    return True


def _draw(axes: Axes, rows: Sequence[MemoryRow], kind: str) -> None:
    """A line a way of working, and the paper's points."""
    for work, tiles in dict.fromkeys((row.work, row.tiles) for row in rows):
        own = sorted((r for r in rows if (r.work, r.tiles) == (work, tiles)), key=lambda row: row.height)
        name = kind if work == "inference" else work
        axes.plot(
            [row.height for row in own],
            [row.taken_gib or 0.0 for row in own],
            _LINES[tiles],
            color=_COLORS[work],
            marker=_MARKERS[tiles],
            markersize=4,
            label=f"{name}, {_tiles(tiles)}",
        )
    for _, words, height, gigabytes in (point for point in PAPER_POINTS if point[0] == kind):
        axes.plot(height, gigabytes * 1e9 / 2**30, "*", color="#2a8c4a", markersize=13, markerfacecolor="none")
        axes.annotate(
            words, (height, gigabytes * 1e9 / 2**30), xytext=(-8, 0), textcoords="offset points",
            ha="right", va="center", fontsize=8, color="#2a8c4a",
        )  # fmt: skip
    axes.plot(
        [], [], "*", color="#2a8c4a", markersize=13, markerfacecolor="none", label="the paper: its network, a GPU"
    )
    axes.set_title(kind, loc="left")
    axes.set_xlabel("panorama, pixels")
    axes.legend(fontsize=8, loc="lower right")


def _tiles(tiles: int) -> str:
    return "untiled" if tiles == 1 else f"{tiles**2} tiles"
