"""Tables of cells, on the terminal and on a page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

from rich.table import Table

Column = tuple[str, Literal["left", "right"]]
"""Its heading, which may be empty, and the side its cells stand on."""


def terminal_table(columns: Sequence[Column], rows: Iterable[tuple[str, ...]], title: str) -> Table:
    """For a terminal; only cells of a column without heading may wrap."""
    table = Table(title=title, title_justify="left", pad_edge=False)
    for name, side in columns:
        table.add_column(name, justify=side, no_wrap=bool(name))
    for cells in rows:
        table.add_row(*cells)
    return table


def page_table(columns: Sequence[Column], rows: Iterable[tuple[str, ...]]) -> str:
    """For a page, in Markdown, without a line's end after the last row."""
    rule = "|" + "|".join("---:" if side == "right" else "---" for _, side in columns) + "|"
    lines = ["| " + " | ".join(cells) + " |" for cells in (tuple(name for name, _ in columns), *rows)]
    return "\n".join((lines[0], rule, *lines[1:]))


def number(value: float | None, form: str) -> str:
    """A cell; blank for what was not measured."""
    return "" if value is None else form.format(value)
