"""What an evaluation's files and the terminal say: the paper's tables with our rows, and what to know of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from pansplat.atomic import replacing
from pansplat.evaluation.frame_distance import frame_distance_layout, plot_frame_distance
from pansplat.evaluation.protocol import ProtocolResult
from pansplat.evaluation.tables import DEPTH_LAYOUT, HEADS, LAYOUTS, Layout, TableRow, markdown_table, rich_table

_PAPER_LPIPS = "lpips-vgg"


def layouts_of(result: ProtocolResult) -> list[Layout]:
    """The tables of the evaluation, as the paper has them."""
    if result.protocol == "frame-distance":
        return [frame_distance_layout(result)]
    with_depth = result.protocol == "m3d" and any(row.depth for row in result.sets)
    return [LAYOUTS[result.protocol], *([DEPTH_LAYOUT] if with_depth else [])]


def our_rows(result: ProtocolResult, layout: Layout) -> list[TableRow]:
    """A row a method with what it reached on the table's sets."""
    rows: dict[str, TableRow] = {}
    for reached in result.sets:
        row = rows.setdefault(reached.method, TableRow(reached.method, {}))
        for metric in layout.metrics:
            value = reached.mean(metric)
            if value is not None:
                row.values[reached.set, metric] = value
    return list(rows.values())


def rich_tables(result: ProtocolResult) -> list[Table]:
    """The tables to print."""
    return [rich_table(layout, our_rows(result, layout), HEADS) for layout in layouts_of(result)]


def notes(result: ProtocolResult) -> list[str]:
    """What a reader of the tables must know: how many images, what is missing, what cannot be compared."""
    counts = {row.set: len(row.scores) for row in result.sets}
    lines = ["Ours: " + ", ".join(f"{name}: {_images(count)}" for name, count in counts.items()) + "."]
    if result.height != 512:
        lines.append(f"Ours is at {result.height}x{2 * result.height}, the paper's figures at 512x1024.")
    if result.lpips is None:
        lines.append("No LPIPS: its weights are not here (docs/evaluation.md says where to get them).")
    elif result.lpips != _PAPER_LPIPS:
        lines.append(f"LPIPS of ours is {result.lpips}, the paper's is {_PAPER_LPIPS}: do not compare them.")
    lines += [f"Missing: {line}." for line in result.missing]
    lines += [f"Left out: {line}" for line in result.skipped]
    return lines


def write_report(result: ProtocolResult, out: Path) -> list[Path]:
    """Write table.md, and frame_distance.png where it is asked for; the paths.

    Raises:
        InputError: they cannot be written.
    """
    tables = [markdown_table(layout, our_rows(result, layout)) for layout in layouts_of(result)]
    with replacing(out / "table.md") as partial:
        partial.write_text("\n".join([*tables, *_items(notes(result))]) + "\n", encoding="utf-8")
    written = [out / "table.md"]
    if result.protocol == "frame-distance":
        plot_frame_distance(result, out / "frame_distance.png")
        written.append(out / "frame_distance.png")
    return written


def _items(lines: Sequence[str]) -> list[str]:
    return [f"* {line}" for line in lines]


def _images(count: int) -> str:
    return f"{count} image" + ("s" if count != 1 else "")
