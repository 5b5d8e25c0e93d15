"""Rows of all benchmarks and their report: tables, a JSON file, a page in Markdown, a plot."""

from __future__ import annotations

import dataclasses
import math
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pansplat.atomic import replacing
from pansplat.console import make_table_console
from pansplat.errors import InputError
from pansplat.evaluation.report import write_json
from pansplat.files import SOFTWARE
from pansplat.strict_json import read_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.table import Table

MEAN = "mean"  # scene of the rows that average all others
_SETTINGS_TO_CHANGE = ("limit_gib",)  # an interrupted run may continue with another value


@dataclass
class Row:
    """One case of a benchmark and its measured values.

    Attributes:
        suite: the question that the case answers.
        scene: name of what is rendered or predicted.
        case: the configuration, a frozen dataclass.
        result: measured values by name; the name ends in the unit. What was not measured has no entry.
        status: whether the case was measured, or why not.
        is_reference: whether other rows are compared with this one.
        note: additional information.
    """

    suite: str
    scene: str
    case: Any
    result: dict[str, Any] = field(default_factory=dict)
    status: Literal["measured", "over the limit", "died"] = "measured"
    is_reference: bool = False
    note: str = ""

    def get(self, name: str) -> Any:
        """The value of this name in the case or the result; None if it was not measured."""
        return getattr(self.case, name) if hasattr(self.case, name) else self.result.get(name)

    def as_json(self) -> dict[str, object]:
        """All values in one flat dictionary; numbers with six digits, null instead of infinite ones."""
        values = {name: getattr(self, name) for name in ("suite", "scene", "status", "is_reference", "note")}
        return _rounded(values | dataclasses.asdict(self.case) | self.result)

    @classmethod
    def from_json(cls, values: Mapping[str, Any], case_type: type) -> Row:
        """The row of a dictionary that `as_json` made.

        Raises:
            KeyError: a field is missing.
        """
        rest = dict(values)
        row = {name: rest.pop(name) for name in ("suite", "scene", "status", "is_reference", "note")}
        case = case_type(**{item.name: rest.pop(item.name) for item in dataclasses.fields(case_type)})
        return cls(**row, case=case, result=rest)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        value: name of a value of the row's case or result, or a function of the row.
        form: format of a number. Columns of the format "{}" hold texts and are aligned on the left.
    """

    title: str
    value: str | Callable[[Row], Any]
    form: str = "{}"

    @property
    def justify(self) -> Literal["left", "right"]:
        """Alignment of the cells."""
        return "left" if self.form == "{}" else "right"

    def cell(self, row: Row) -> str:
        """The text of a row's cell: empty if the value was not measured, "exact" for an infinite PSNR."""
        value = row.get(self.value) if isinstance(self.value, str) else self.value(row)
        if value is None or isinstance(value, str):
            return value or ""
        return "exact" if value == math.inf else self.form.format(value)


def average_rows(rows: Sequence[Row]) -> Iterator[Row]:
    """For each case, the mean of its rows; values that not all of them have are left out."""
    for case in dict.fromkeys(row.case for row in rows):
        results = [row.result for row in rows if row.case == case and row.scene != MEAN]
        names = [name for name in results[0] if all(name in result for result in results)]
        yield Row(rows[0].suite, MEAN, case, {name: statistics.fmean(each[name] for each in results) for name in names})


def error_or_reference(name: str) -> Callable[[Row], Any]:
    """A column's value: an error, or "reference" in the row that the others are compared with."""
    return lambda row: "reference" if row.is_reference else row.get(name)


def format_threads(count: int) -> str:
    """A number of threads in words."""
    return "one thread" if count == 1 else f"{count} threads"


def make_axes(count: int, size: tuple[float, float], **options: Any) -> tuple[Figure, list[Axes]]:
    """A figure of this size in inches with plots side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = list(figure.subplots(1, count, squeeze=False, **options)[0])
    for each in axes:
        each.grid(alpha=0.25)
    return figure, axes


Header = Mapping[str, Any]
Plot = Callable[[Sequence[Row], Header], "Figure | None"]


@dataclass(frozen=True)
class Benchmark:
    """What the reports of one benchmark have in common.

    Attributes:
        name: of its files: NAME.json, NAME.md and NAME.png.
        columns: of its tables.
        section: title of the table that a row belongs to.
        plot: a function that plots the rows, given also the header of the JSON file; None if there is nothing to plot.
        findings: sentences about all rows, for the terminal and the page.
        width: characters of a printed line if there is no terminal.
    """

    name: str
    columns: Sequence[Column]
    section: Callable[[Row], str]
    plot: Plot
    findings: Callable[[Sequence[Row]], list[str]] = lambda rows: []
    width: int = 190

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One table for each section, in the order of the rows; only cells of columns without a title may wrap."""
        from rich.table import Table

        tables = []
        for title, part in self._sections(rows).items():
            tables.append(Table(title=title, title_justify="left", pad_edge=False))
            for column in self.columns:
                tables[-1].add_column(column.title, justify=column.justify, no_wrap=bool(column.title))
            for row in part:
                tables[-1].add_row(*(column.cell(row) for column in self.columns))
        return tables

    def markdown(self, rows: Sequence[Row]) -> str:
        """The findings and all tables as the text of a page."""
        rule = "|" + "|".join("---:" if column.justify == "right" else "---" for column in self.columns) + "|"
        titles = "| " + " | ".join(column.title for column in self.columns) + " |"
        parts = ["\n".join(f"* {sentence}" for sentence in self.findings(rows))]
        for title, part in self._sections(rows).items():
            lines = ["| " + " | ".join(column.cell(row) for column in self.columns) + " |" for row in part]
            parts.append("\n".join((f"### {title[:1].upper()}{title[1:]}\n", titles, rule, *lines)))
        return "\n\n".join(part for part in parts if part) + "\n"

    def _sections(self, rows: Sequence[Row]) -> dict[str, list[Row]]:
        sections: dict[str, list[Row]] = {}
        for row in rows:
            sections.setdefault(self.section(row), []).append(row)
        return sections


class Report:
    """The rows of one run: saved after each measurement, printed and written at the end.

    As a context manager it prints and writes the measured rows even if the run was interrupted.

    Attributes:
        header: values of the JSON file beside the rows, with the `machine` of `describe_machine`.
        json_file: written after every row.
        rows: measured so far.
    """

    def __init__(
        self, benchmark: Benchmark, header: Header, *, json_file: Path | None = None, out: Path | None = None
    ) -> None:
        """Begin a run.

        Args:
            json_file: by default NAME.json in `out`, if that is given.
            out: folder for the page and the plot.
        """
        self.header, self.rows = header, list[Row]()
        self.json_file = json_file or (None if out is None else out / f"{benchmark.name}.json")
        self._benchmark, self._out = benchmark, out

    def resume(self, case_type: type) -> bool:
        """Read the rows of an earlier run from the JSON file, if there is one; False if its limits were other ones.

        Raises:
            InputError: it is not a file of such rows, or its `setting` differs from that of the header.
        """
        if self.json_file is None or not self.json_file.is_file():
            return True
        command = f"`pansplat bench {self._benchmark.name}`"
        try:
            content = read_json(self.json_file)
            rows = [Row.from_json(values, case_type) for values in content["rows"]]
            before, now = content.get("setting", {}), _rounded(self.header.get("setting", {}))
            changed = [
                f"{name} was {before.get(name)}, now {now[name]}"
                for name in now
                if name not in _SETTINGS_TO_CHANGE and before.get(name) != now[name]
            ]
        except (KeyError, TypeError, AttributeError, InputError) as error:
            raise InputError(f"{self.json_file}: needed rows of {command}, got {error!r}; delete it.") from error
        if changed:
            raise InputError(
                f"{self.json_file}: has another setting ({'; '.join(changed)}); give another --out, or delete the file."
            )
        self.rows += rows
        return before == now

    def __enter__(self) -> Report:
        return self

    def __exit__(self, *_: object) -> None:
        machine = self.header["machine"]
        print(f"{machine['cpu']}, GPU: {machine.get('gpu') or 'none'}, {format_threads(machine['threads'])}")
        console = make_table_console(self._benchmark.width)
        for table in self._benchmark.tables(self.rows):
            console.print(table)
        for sentence in self._benchmark.findings(self.rows):
            print(sentence)
        for file in self._write():
            print(file)

    def step(self, text: str) -> None:
        """Show what is measured next."""
        print(text, file=sys.stderr, flush=True)

    def add(self, row: Row) -> None:
        """Add a measured row and write the JSON file."""
        self.rows.append(row)
        self.save()

    def save(self) -> None:
        """Write the JSON file after a change of the rows."""
        if self.json_file is not None and self.rows:
            write_json({**_rounded(dict(self.header)), "rows": [row.as_json() for row in self.rows]}, self.json_file)

    def _write(self) -> list[Path]:
        """Write the page and the plot and return all written files."""
        if not self.rows:
            return []
        written = [] if self.json_file is None else [self.json_file]
        if self._out is None:
            return written
        page, picture = (self._out / f"{self._benchmark.name}{suffix}" for suffix in (".md", ".png"))
        with replacing(page) as partial:
            partial.write_text(f"<!-- {SOFTWARE} -->\n{self._benchmark.markdown(self.rows)}", "utf-8")
        figure = self._benchmark.plot(self.rows, self.header)
        if figure is None:
            return [*written, page]
        with replacing(picture) as partial:
            figure.savefig(partial, dpi=110, metadata={"Software": "pansplat"})
        return [*written, page, picture]
