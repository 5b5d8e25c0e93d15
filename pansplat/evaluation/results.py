"""Rows of results of evaluations and benchmarks: quality, time and memory by name; their means, tables and files."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.table import Table

from pansplat.errors import InputError
from pansplat.system.atomic import replacing


@dataclass
class Row:
    """A row of results.

    Attributes:
        case: what was measured, by name.
        values: the measured values by name. What was not measured has no entry.
    """

    case: dict[str, Any]
    values: dict[str, Any] = field(default_factory=dict)

    def get(self, name: str) -> Any:
        """The entry of this name in the case or the values; None if there is none."""
        return self.case[name] if name in self.case else self.values.get(name)

    def as_json(self) -> dict[str, Any]:
        """All entries in one dictionary, with null for numbers that JSON cannot represent."""
        return _make_finite({**self.case, **self.values})


def average_rows(rows: Iterable[Row], names: Sequence[str]) -> list[Row]:
    """A row for each combination of these entries of the case; a value is the mean of the rows that have it."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(name) for name in names), []).append(row)
    means = []
    for key, group in groups.items():
        values: dict[str, list[float]] = {}
        for name, value in ((name, value) for row in group for name, value in row.values.items()):
            if isinstance(value, int | float):
                values.setdefault(name, []).append(value)
        means.append(
            Row(dict(zip(names, key, strict=True)), {name: fmean(numbers) for name, numbers in values.items()})
        )
    return means


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: for people.
        value: name of an entry of the row, or a function of the row.
        form: format of a value. Columns without it hold texts and are aligned on the left.
    """

    title: str
    value: str | Callable[[Row], Any]
    form: str = ""

    def cell(self, row: Row) -> str:
        """The text of a row's cell: empty if nothing was measured, "exact" for an infinite PSNR."""
        value = row.get(self.value) if isinstance(self.value, str) else self.value(row)
        if value is None:
            return ""
        return "exact" if value == math.inf else str(value) if isinstance(value, str) else format(value, self.form)


def rich_table(title: str, columns: Sequence[Column], rows: Sequence[Row], below: Sequence[Row] = ()) -> Table:
    """A printable table. The rows `below` follow a line, in bold. Only columns without a title may wrap."""
    table = Table(title=title, title_justify="left", pad_edge=False)
    for column in columns:
        table.add_column(column.title, justify="right" if column.form else "left", no_wrap=bool(column.title))
    for row in rows:
        table.add_row(*(column.cell(row) for column in columns))
    table.add_section()
    for row in below:
        table.add_row(*(column.cell(row) for column in columns), style="bold")
    return table


def markdown_table(title: str, columns: Sequence[Column], rows: Sequence[Row]) -> str:
    """A heading and a table in Markdown."""
    cells = [[column.title for column in columns]]
    cells += [["---:" if column.form else "---" for column in columns]]
    cells += [[column.cell(row) for column in columns] for row in rows]
    return "\n".join([f"### {title[:1].upper()}{title[1:]}", "", *(f"| {' | '.join(line)} |" for line in cells)]) + "\n"


def write_json(value: Mapping[str, Any] | Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write an object, or a list of objects, as JSON, atomically; non-finite numbers become null."""
    mark = {"software": "pansplat"}
    marked = {**mark, **value} if isinstance(value, Mapping) else [{**mark, **row} for row in value]
    text = json.dumps(_make_finite(marked), indent=1, allow_nan=False)
    with replacing(path) as unfinished:
        unfinished.write_text(text + "\n", encoding="utf-8")


def _make_finite(value: Any) -> Any:
    """The value with null for numbers that JSON cannot represent."""
    if isinstance(value, dict):
        return {key: _make_finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_make_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def make_folder(folder: Path) -> None:
    """Make a folder and its parents."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {folder} ({error.strerror}); choose another --out") from error
