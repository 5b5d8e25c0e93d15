"""Rows of results: means, tables and files."""

import io
import json
import math
from pathlib import Path

from refusals import expect_error
from rich.console import Console

from pansplat.evaluation.results import Column, Row, average_rows, markdown_table, rich_table, write_json

COLUMNS = (Column("method", "method"), Column("PSNR", "psnr", ".2f"), Column("SSIM", "ssim", ".3f"))
ROWS = (Row({"method": "paper"}, {"psnr": 21.5}), Row({"method": "exact"}, {"psnr": math.inf, "ssim": 1.0}))
OURS = Row({"method": "ours"}, {"psnr": 20.0, "ssim": 0.75})


def test_a_mean_is_that_of_the_rows_with_the_value() -> None:
    a = {"set": "x", "method": "a"}
    rows = [Row(a, {"psnr": 20, "lpips": 0.2}), Row(a, {"psnr": 24})]
    rows.append(Row({"set": "y", "method": "a"}, {"psnr": 1, "stages": {}}))
    means = average_rows(rows, ("set", "method"))
    assert means == [Row(a, {"psnr": 22, "lpips": 0.2}), Row({"set": "y", "method": "a"}, {"psnr": 1})]


def test_tables_have_formatted_cells_and_printed_ones_more_rows_below() -> None:
    assert markdown_table("speed", COLUMNS, ROWS).splitlines() == [
        *("### Speed", "", "| method | PSNR | SSIM |", "| --- | ---: | ---: |"),
        *("| paper | 21.50 |  |", "| exact | exact | 1.000 |"),
    ]
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(rich_table("speed", COLUMNS, ROWS, [OURS]))
    lines = [line.replace("│", " ").split() for line in console.export_text().splitlines()]
    assert lines.index(["ours", "20.00", "0.750"]) > lines.index(["exact", "exact", "1.000"])


def test_numbers_that_json_has_not_are_null(tmp_path: Path) -> None:
    file = tmp_path / "rows.json"
    write_json([Row({"name": "a"}, {"psnr": math.inf, "stages": {"sort": math.nan}}).as_json()], file)
    (row,) = json.loads(file.read_text())
    assert row == {"software": "pansplat", "name": "a", "psnr": None, "stages": {"sort": None}}
    expect_error("create it first", write_json, {}, tmp_path / "no" / "rows.json")
