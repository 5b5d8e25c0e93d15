"""Rows, their JSON file, and the tables of a report."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from pansplat.bench.report import Benchmark, Column, Report, Row
from pansplat.errors import InputError
from pansplat.files import is_written

HEADER = {"machine": {"cpu": "some", "gpu": None, "threads": 2}}


@dataclass(frozen=True)
class Case:
    height: int


SPEED = Benchmark(
    "speed",
    (Column("height", "height", "{:d}"), Column("seconds", "seconds", "{:.1f}"), Column("", lambda row: row.note)),
    lambda row: f"{row.suite}: {row.case.height}",
    lambda rows, header: Figure(),
    lambda rows: [f"{len(rows)} rows."],
)


def row(height: int = 16, **values) -> Row:
    return Row("speed", "room", Case(height), values)


def resume(file: Path, **setting) -> tuple[bool, list[Row]]:
    """Whether the rows are of the same setting, and the rows."""
    report = Report(SPEED, HEADER | {"setting": setting}, json_file=file)
    return report.resume(Case), report.rows


def test_rows_are_read_as_they_were_written(tmp_path):
    report = Report(SPEED, HEADER | {"setting": {"style": "plain", "limit_gib": 1.0}}, out=tmp_path)
    report.add(Row("speed", "room", Case(16), {"seconds": 2.0, "stages": {"sort": 0.5}}, is_reference=True))
    report.add(Row("speed", "room", Case(32), status="died", note="ended by SIGKILL"))
    file = tmp_path / "speed.json"
    assert json.loads(file.read_text())["machine"] == HEADER["machine"]
    for limit in (1.0, 2.0):
        assert resume(file, style="plain", limit_gib=limit) == (limit == 1.0, report.rows)
    assert resume(tmp_path / "none.json", style="plain") == (True, [])
    with pytest.raises(InputError, match=r"style was plain, now rich.*give another --out"):
        resume(file, style="rich")
    for text in ("{}", "no json", '{"rows": [{"suite": "speed"}]}'):
        file.write_text(text)
        with pytest.raises(InputError, match=r"needed rows of `pansplat bench speed`.*delete it"):
            resume(file, style="plain")


def test_numbers_have_six_digits_and_infinite_ones_are_null(tmp_path):
    report = Report(SPEED, HEADER, json_file=tmp_path / "rows.json")
    report.add(row(seconds=1 / 3, stages={"a": math.nan}, psnr_db=math.inf))
    (found,) = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert found["seconds"] == 0.333333 and found["stages"] == {"a": None} and found["psnr_db"] is None


def test_a_failed_write_leaves_the_old_file(tmp_path):
    report = Report(SPEED, HEADER, json_file=tmp_path / "rows.json")
    report.add(row())
    before = report.json_file.read_text()
    with pytest.raises(TypeError):
        report.add(row(seconds=object()))
    assert report.json_file.read_text() == before and list(tmp_path.iterdir()) == [report.json_file]
    with pytest.raises(InputError, match="create it first"):
        Report(SPEED, HEADER, json_file=tmp_path / "no" / "rows.json").add(row())


def test_a_page_holds_the_findings_and_a_table_for_each_section():
    rows = [row(16), row(32), row(16, seconds=2.0)]
    assert [(table.title, table.row_count) for table in SPEED.tables(rows)] == [("speed: 16", 2), ("speed: 32", 1)]
    assert SPEED.markdown([row(16, seconds=math.inf), row(16)]).splitlines() == [
        *("* 2 rows.", "", "### Speed: 16", ""),
        *("| height | seconds |  |", "|---:|---:|---|", "| 16 | exact |  |", "| 16 |  |  |"),
    ]
    assert replace(SPEED, findings=lambda rows: []).markdown([]) == "\n"


def test_an_interrupted_run_is_printed_and_written(tmp_path, capsys):
    with pytest.raises(KeyboardInterrupt), Report(SPEED, HEADER, out=tmp_path) as report:
        report.step("the first row")
        report.add(row(16, seconds=2.0))
        raise KeyboardInterrupt
    assert len(json.loads((tmp_path / "speed.json").read_text())["rows"]) == 1
    assert "### Speed: 16" in (tmp_path / "speed.md").read_text()
    assert (tmp_path / "speed.png").read_bytes().startswith(b"\x89PNG")
    assert all(is_written(tmp_path / f"speed{suffix}") for suffix in (".json", ".md", ".png"))
    printed, steps = capsys.readouterr()
    assert "some, GPU: none, 2 threads" in printed and "speed: 16" in printed and "1 rows." in printed
    assert printed.split()[-3:] == [str(tmp_path / name) for name in ("speed.json", "speed.md", "speed.png")]
    assert steps == "the first row\n"


def test_a_run_without_rows_writes_nothing_and_one_without_a_plot_no_picture(tmp_path):
    with Report(SPEED, HEADER, out=tmp_path) as report:
        report.save()
    assert not list(tmp_path.iterdir())
    with Report(replace(SPEED, plot=lambda rows, header: None), HEADER, out=tmp_path) as report:
        report.add(row())
    assert sorted(file.name for file in tmp_path.iterdir()) == ["speed.json", "speed.md"]
