"""What a person reads of `pansplat bench model`: a table, and a picture of time and memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from rich.table import Table

from pansplat.atomic import replacing
from pansplat.bench.model import ModelRow
from pansplat.bench.model_case import STAGES
from pansplat.bench.tabulate import Column, number, page_table, terminal_table

_COLUMNS: tuple[Column, ...] = (
    *(("compat", "left"), ("precision", "left"), ("attention", "left")),
    *(("tiles", "right"), ("threads", "right")),
    *((f"{stage} s", "right") for stage in STAGES),
    *(
        ("total s", "right"),
        ("processor s", "right"),
        ("peak GiB", "right"),
        ("depth median", "right"),
        ("depth max", "right"),
    ),
    ("PSNR dB", "right"),
)
_STAGE_COLORS = ("#1764ab", "#6aaed6", "#e0a030", "#c8501e")


def model_table(rows: Sequence[ModelRow], title: str) -> Table:
    """All rows, in the order they were measured."""
    return terminal_table(_COLUMNS, map(model_cells, rows), title)


def model_markdown(rows: Sequence[ModelRow]) -> str:
    """The same table as a page's text."""
    return page_table(_COLUMNS, map(model_cells, rows)) + "\n"


def model_cells(row: ModelRow) -> tuple[str, ...]:
    """A row's cells; what was not measured is blank."""
    return (
        *(row.compat, row.precision, row.attention, f"{row.tiles}x{row.tiles}", str(row.threads)),
        *(number(row.stages_s.get(stage), "{:.1f}") for stage in STAGES),
        number(row.total_s, "{:.1f}"),
        number(row.processor_s, "{:.1f}"),
        number(row.peak_gib, "{:.2f}"),
        "reference" if row.is_reference else number(row.depth_median_error, "{:.1e}"),
        number(row.depth_max_error, "{:.1e}"),
        "same" if row.psnr_db is not None and math.isinf(row.psnr_db) else number(row.psnr_db, "{:.1f}"),
    )


def plot_model(rows: Sequence[ModelRow], path: Path, title: str) -> bool:
    """Bars of each row's seconds by stage and of its memory; False when there is nothing to show.

    Raises:
        InputError: the file cannot be written.
    """
    if not rows:
        return False
    figure = Figure(figsize=(11, 1.5 + 0.4 * len(rows)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
    names = [_name(row) for row in rows]
    starts = [0.0] * len(rows)
    for stage, color in zip(STAGES, _STAGE_COLORS, strict=True):
        widths = [row.stages_s.get(stage, 0.0) for row in rows]
        left.barh(names, widths, left=starts, color=color, label=stage)
        starts = [start + width for start, width in zip(starts, widths, strict=True)]
    left.invert_yaxis()
    left.set(xlabel="seconds")
    left.set_title(title, loc="left")
    left.legend(fontsize=8)
    right.barh(names, [row.peak_gib or 0.0 for row in rows], color="#888888")
    right.set(xlabel="largest memory of the process, GiB")
    for axes in (left, right):
        axes.grid(axis="x", alpha=0.25)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)
    return True


def _name(row: ModelRow) -> str:
    parts = [row.compat, row.precision]
    parts += ["attention bfloat16"] * (row.attention == "bfloat16")
    parts += [f"{row.tiles}x{row.tiles} tiles"] * (row.tiles > 1)
    return ", ".join([*parts, "1 thread" if row.threads == 1 else f"{row.threads} threads"])
