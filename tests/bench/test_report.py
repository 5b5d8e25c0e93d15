"""Rows, their JSON file, and the tables of a report."""

import io
import json
import math
from dataclasses import dataclass, field

import pytest
from matplotlib.figure import Figure
from rich.console import Console

from pansplat.bench.report import Column, Report, Row, format_number, read_row, write_rows
from pansplat.errors import InputError


@dataclass(frozen=True)
class Case:
    height: int


@dataclass
class Result:
    seconds: float | None = None
    stages: dict[str, float] = field(default_factory=dict)


COLUMNS = (
    Column("height", lambda row: str(row.case.height)),
    Column("seconds", lambda row: format_number(row.result.seconds, "{:.1f}")),
    Column("", lambda row: row.note, "left"),
)


def row(height: int = 16, **values) -> Row:
    return Row("speed", "room", Case(height), Result(**values))


def report(**options) -> Report:
    return Report(COLUMNS, lambda row: f"{row.suite}: {row.case.height}", {"cpu": "some", "gpu": None}, **options)


def test_rows_are_read_as_they_were_written(tmp_path):
    rows = [row(seconds=2.0, stages={"sort": 0.5}), row(32)]
    rows[1].status, rows[1].note, rows[0].is_reference = "died", "ended by SIGKILL", True
    write_rows(tmp_path / "rows.json", {"machine": {"cpu": "some"}}, rows)
    content = json.loads((tmp_path / "rows.json").read_text())
    assert set(content) == {"machine", "rows"} and content["machine"] == {"cpu": "some"}
    assert [read_row(values, Case, Result) for values in content["rows"]] == rows


def test_numbers_have_six_digits_and_infinite_ones_are_null(tmp_path):
    write_rows(tmp_path / "rows.json", {}, [row(seconds=1 / 3, stages={"a": math.nan}), row(seconds=math.inf)])
    first, second = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert first["seconds"] == 0.333333 and first["stages"] == {"a": None} and second["seconds"] is None


def test_a_failed_write_leaves_the_old_file(tmp_path):
    file = tmp_path / "rows.json"
    write_rows(file, {}, [row()])
    before = file.read_text()
    with pytest.raises(TypeError):
        write_rows(file, {"cpu": object()}, [row(), row()])
    assert file.read_text() == before
    assert list(tmp_path.iterdir()) == [file]
    with pytest.raises(InputError, match="create it first"):
        write_rows(tmp_path / "no" / "rows.json", {}, [row()])


def test_each_section_has_a_table():
    found = report().tables([row(16), row(32), row(16, seconds=2.0)])
    assert [(table.title, table.row_count) for table in found] == [("speed: 16", 2), ("speed: 32", 1)]
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(*found)
    assert "2.0" in console.export_text()


def test_markdown_holds_the_findings_and_the_tables():
    page = report(findings=lambda rows: [f"{len(rows)} rows."])
    page.rows += [row(16, seconds=2.0), row(16)]
    assert page.markdown().splitlines() == [
        *("* 2 rows.", "", "### Speed: 16", ""),
        *("| height | seconds |  |", "|---:|---:|---|", "| 16 | 2.0 |  |", "| 16 |  |  |"),
    ]
    assert report().markdown() == "\n"


def test_an_interrupted_run_is_printed_and_written(tmp_path, capsys):
    files = {"json_file": tmp_path / "rows.json", "page": tmp_path / "page.md"}
    plots = {tmp_path / "a.png": lambda rows: Figure(), tmp_path / "b.png": lambda rows: None}
    with pytest.raises(KeyboardInterrupt), report(**files, plots=plots, facts=("cpu", "gpu")) as page:
        page.update("the first row")
        page.add(row(16, seconds=2.0))
        raise KeyboardInterrupt
    assert len(json.loads(files["json_file"].read_text())["rows"]) == 1
    assert "### Speed: 16" in files["page"].read_text()
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG") and not (tmp_path / "b.png").exists()
    printed = capsys.readouterr().out
    assert "cpu             some" in printed and "gpu             none" in printed and "speed: 16" in printed
    assert printed.split()[-3:] == [str(tmp_path / name) for name in ("rows.json", "page.md", "a.png")]


def test_a_run_without_rows_writes_nothing(tmp_path):
    with report(json_file=tmp_path / "rows.json", page=tmp_path / "page.md") as page:
        page.update("nothing")
    assert not list(tmp_path.iterdir())
