"""Rows of a benchmark and their report: a live table, a JSON file, tables in Markdown, plots."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from pansplat.atomic import replacing
from pansplat.console import make_table_console

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

Case = TypeVar("Case")
Result = TypeVar("Result")
AnyRow = TypeVar("AnyRow", bound="Row[Any, Any]")
Status = Literal["measured", "not tried", "over the limit", "died"]

_LIVE_ROWS = 14  # of the running table


@dataclass
class Row(Generic[Case, Result]):
    """One benchmark case and its result.

    Attributes:
        suite: the question that the case answers.
        scene: name of the rendered or predicted scene.
        case: the configuration.
        result: the measured values; None in a field means not measured.
        status: whether the case was measured, or why not.
        is_reference: whether other rows are compared with this one.
        note: additional information.
    """

    suite: str
    scene: str
    case: Case
    result: Result
    status: Status = "measured"
    is_reference: bool = False
    note: str = ""

    def as_json(self) -> dict[str, object]:
        """All fields in one flat dictionary; numbers with six digits, null instead of infinite ones."""
        values = {name: getattr(self, name) for name in ("suite", "scene", "status", "is_reference", "note")}
        values |= dataclasses.asdict(self.case) | dataclasses.asdict(self.result)  # type: ignore[call-overload]
        return {name: _rounded(value) for name, value in values.items()}


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def read_row(values: Mapping[str, Any], case: type[Case], result: type[Result]) -> Row[Case, Result]:
    """The row of a dictionary that `Row.as_json` made.

    Raises:
        KeyError: a field is missing.
    """

    def read(kind: type) -> Any:
        return kind(**{field.name: values[field.name] for field in dataclasses.fields(kind)})

    return Row(
        *(values["suite"], values["scene"], read(case), read(result)),
        *(values["status"], values["is_reference"], values["note"]),
    )


@dataclass(frozen=True)
class Column(Generic[AnyRow]):
    """A column of a table.

    Attributes:
        cell: text of a row's cell; empty if the value was not measured.
    """

    title: str
    cell: Callable[[AnyRow], str]
    justify: Literal["left", "right"] = "right"


def result_column(title: str, form: str, name: str) -> Column[Any]:
    """The column of a field of the result."""
    return Column(title, lambda row: format_number(getattr(row.result, name), form))


def error_column(title: str, form: str, name: str) -> Column[Any]:
    """The column of an error against the reference row."""
    return Column(
        title, lambda row: "reference" if row.is_reference else format_number(getattr(row.result, name), form)
    )


def format_number(value: float | None, form: str) -> str:
    """The text of a cell: empty for None, "exact" for an infinite PSNR."""
    return "" if value is None else "exact" if value == math.inf else form.format(value)


def format_threads(count: int) -> str:
    """A number of threads in words."""
    return "one thread" if count == 1 else f"{count} threads"


def make_terminal_table(columns: Sequence[Column[AnyRow]], rows: Iterable[AnyRow], title: str) -> Table:
    """A table for the terminal; only cells of columns without a title may wrap."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", pad_edge=False)
    for column in columns:
        table.add_column(column.title, justify=column.justify, no_wrap=bool(column.title))
    for row in rows:
        table.add_row(*(column.cell(row) for column in columns))
    return table


def format_markdown_table(columns: Sequence[Column[AnyRow]], rows: Iterable[AnyRow]) -> str:
    """A table in Markdown, without a line break after the last row."""
    rule = "|" + "|".join("---:" if column.justify == "right" else "---" for column in columns) + "|"
    cells = [[column.title for column in columns], *([column.cell(row) for column in columns] for row in rows)]
    lines = ["| " + " | ".join(texts) + " |" for texts in cells]
    return "\n".join((lines[0], rule, *lines[1:]))


def write_rows(path: Path, header: Mapping[str, object], rows: Iterable[Row[Any, Any]]) -> None:
    """Write {**header, "rows": [...]} as JSON; the file is complete at any moment.

    Raises:
        InputError: the file cannot be written.
    """
    text = json.dumps({**header, "rows": [row.as_json() for row in rows]}, indent=1, allow_nan=False)
    with replacing(path) as partial:
        partial.write_text(text + "\n")


@dataclass
class Report(Generic[AnyRow]):
    """The rows of one run: shown while they are measured, printed and written at the end.

    As a context manager it prints and writes the measured rows even if the run was interrupted.

    Attributes:
        columns: of the tables.
        section: title of the table that a row belongs to.
        machine: from `describe_machine`; written to the JSON file.
        header: more values of the JSON file.
        facts: entries of `machine` to print.
        findings: sentences about all rows, for the terminal and the page.
        json_file: written after every step.
        page: Markdown, written at the end.
        plots: functions that plot the rows, by file; they return None if there is nothing to plot.
        print_steps: print each step if there is no terminal.
        width: characters of a printed line if there is no terminal.
        rows: measured so far.
    """

    columns: Sequence[Column[AnyRow]]
    section: Callable[[AnyRow], str]
    machine: Mapping[str, Any]
    _: KW_ONLY
    header: Mapping[str, object] = field(default_factory=dict)
    facts: Sequence[str] = ()
    findings: Callable[[Sequence[AnyRow]], list[str]] = lambda rows: []
    json_file: Path | None = None
    page: Path | None = None
    plots: Mapping[Path, Callable[[Sequence[AnyRow]], Figure | None]] = field(default_factory=dict)
    print_steps: bool = False
    width: int = 150
    rows: list[AnyRow] = field(default_factory=list)
    _live: Any = None

    def __enter__(self) -> Report[AnyRow]:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(stderr=True), refresh_per_second=4, transient=True)
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()
        self._live = None
        self._print()
        for file in self._write():
            print(file)

    def add(self, row: AnyRow) -> None:
        """Add a measured row, write the JSON file and show the last rows."""
        self.rows.append(row)
        self.update()

    def update(self, step: str = "") -> None:
        """Write the JSON file and show the last rows and the step that follows."""
        if self.json_file is not None and self.rows:
            write_rows(self.json_file, {"machine": self.machine, **self.header}, self.rows)
        if self._live is None:
            return
        if self._live.console.is_terminal:
            from rich.console import Group
            from rich.text import Text

            self._live.update(Group(*self.tables(self.rows[-_LIVE_ROWS:]), Text(step, style="cyan")))
        elif step and self.print_steps:
            self._live.console.print(step, highlight=False, soft_wrap=True)

    def tables(self, rows: Sequence[AnyRow]) -> list[Table]:
        """One table for each section, in the order of the rows."""
        return [make_terminal_table(self.columns, part, title) for title, part in self._sections(rows).items()]

    def markdown(self) -> str:
        """The findings and all tables as the text of a page."""
        parts = ["\n".join(f"* {sentence}" for sentence in self.findings(self.rows))]
        for title, part in self._sections(self.rows).items():
            parts.append(f"### {title[:1].upper()}{title[1:]}\n\n{format_markdown_table(self.columns, part)}")
        return "\n\n".join(part for part in parts if part) + "\n"

    def _sections(self, rows: Sequence[AnyRow]) -> dict[str, list[AnyRow]]:
        sections: dict[str, list[AnyRow]] = {}
        for row in rows:
            sections.setdefault(self.section(row), []).append(row)
        return sections

    def _print(self) -> None:
        print_facts({name: self.machine[name] for name in self.facts})
        console = make_table_console(self.width)
        for table in self.tables(self.rows):
            console.print(table)
        for sentence in self.findings(self.rows):
            print(sentence)

    def _write(self) -> list[Path]:
        """Write the files and return those that were written."""
        if not self.rows:
            return []
        written = [] if self.json_file is None else [self.json_file]
        if self.page is not None:
            with replacing(self.page) as partial:
                partial.write_text(self.markdown())
            written.append(self.page)
        for path, plot in self.plots.items():
            figure = plot(self.rows)
            if figure is not None:
                with replacing(path) as partial:
                    figure.savefig(partial, dpi=110)
                written.append(path)
        return written


def print_facts(facts: Mapping[str, object]) -> None:
    """Print entries of `describe_machine`, one a line."""
    for name, value in facts.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key}: {item}" for key, item in value.items())
        print(f"{name:<15} {'none' if value is None else value}")
