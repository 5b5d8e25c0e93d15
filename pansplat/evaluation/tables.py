"""The paper's tables with our rows, and the file of an evaluation. The numbers of the paper are in paper.json."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from rich.table import Table

from pansplat.evaluation.protocol import ProtocolResult
from pansplat.evaluation.results import Column, Row, markdown_table, rich_table
from pansplat.system.atomic import replacing
from pansplat.system.files import SOFTWARE

_METRICS = {  # titles and formats
    "psnr": ("PSNR", ".2f"),
    "ws_psnr": ("WS-PSNR", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "lpips": ("LPIPS", ".3f"),
    "abs_rel": ("AbsRel", ".4f"),
    "sq_rel": ("SqRel", ".4f"),
    "rmse": ("RMSE", ".4f"),
}
_PAPER_LPIPS = "lpips-vgg"


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper.

    Attributes:
        sets, metrics: from left to right; every set has all metrics.
        rows: the paper's; a value has the name of its set and metric, such as "Replica 1.0 m ssim".
    """

    title: str
    sets: tuple[str, ...]
    metrics: tuple[str, ...]
    rows: tuple[Row, ...] = ()

    @property
    def columns(self) -> list[Column]:
        """The method, and every metric of every set; a dash stands for a missing value."""
        metrics = [(name, metric, *_METRICS[metric]) for name in self.sets for metric in self.metrics]
        return [
            Column("method", "method"),
            *(Column(f"{name}\n{title}", f"{name} {metric}", form, "-") for name, metric, title, form in metrics),
        ]


def read_paper_tables() -> dict[str, PaperTable]:
    """The tables of paper.json, by protocol, and "depth"."""
    tables = {}
    content = json.loads(files("pansplat.evaluation").joinpath("paper.json").read_text("utf-8"))
    for protocol, table in content["tables"].items():
        names = [f"{name} {metric}" for name in table["sets"] for metric in table["metrics"]]
        rows = [
            Row({"method": method}, {n: v for n, v in zip(names, numbers, strict=True) if v is not None})
            for method, numbers in table["rows"].items()
        ]
        tables[protocol] = PaperTable(table["title"], tuple(table["sets"]), tuple(table["metrics"]), tuple(rows))
    return tables


def list_tables(result: ProtocolResult) -> list[PaperTable]:
    """The paper's tables for the evaluation."""
    tables = read_paper_tables()
    with_depth = result.protocol == "m3d" and any("rmse" in row.values for row in result.rows)
    return [tables[result.protocol], *([tables["depth"]] if with_depth else [])]


def our_rows(result: ProtocolResult) -> list[Row]:
    """A row for each method with its values on all sets, named as those of `PaperTable`."""
    rows: dict[str, Row] = {}
    for mean in result.means():
        row = rows.setdefault(mean.case["method"], Row({"method": mean.case["method"]}))
        row.values |= {f"{mean.case['set']} {metric}": value for metric, value in mean.values.items()}
    return list(rows.values())


def rich_tables(result: ProtocolResult) -> list[Table]:
    """The printable tables."""
    return [rich_table(table.title, table.columns, table.rows, our_rows(result)) for table in list_tables(result)]


def report_notes(result: ProtocolResult) -> list[str]:
    """Notes on the tables: numbers of images, missing data, and figures that are not comparable."""
    counts = {row.case["set"]: row.case["images"] for row in result.means()}
    lines = ["Ours: " + ", ".join(f"{name}: {n} image{'s' * (n != 1)}" for name, n in counts.items()) + "."]
    if result.height != 512:
        lines.append(f"Ours is at {result.height}x{2 * result.height}, the paper's figures at 512x1024.")
    if result.lpips is None:
        lines.append("No LPIPS: its weights were not found (see docs/evaluation.md).")
    elif result.lpips != _PAPER_LPIPS:
        lines.append(f"LPIPS of ours is {result.lpips}, the paper's is {_PAPER_LPIPS}: they are not comparable.")
    lines += [f"Missing: {line}." for line in result.missing]
    lines += [f"Left out: {line}" for line in result.skipped]
    return lines


def write_report(result: ProtocolResult, out: Path) -> Path:
    """Write table.md; return its path."""
    ours = our_rows(result)
    tables = [markdown_table(table.title, table.columns, table.rows, ours) for table in list_tables(result)]
    with replacing(out / "table.md") as partial:
        partial.write_text(
            "\n".join([f"<!-- {SOFTWARE} -->", *tables, *(f"* {note}" for note in report_notes(result))]) + "\n",
            encoding="utf-8",
        )
    return out / "table.md"
