"""Tables show what was measured, and the sentences compare like with like."""

import io
from dataclasses import replace

import pytest
from rich.console import Console

from pansplat.bench.report import cells, findings, markdown, tables
from pansplat.bench.rows import Row


@pytest.fixture
def row():
    return Row(
        suite="headline",
        scene="room 512",
        backend="numba",
        kernel="ray",
        order="radial",
        filter="angular",
        layout="equirect",
        height=512,
        face_size=None,
        stitching="seamless",
        precision="float32",
        num_gaussians=886_580,
        threads=1,
        forward_ms=100.0,
        backward_ms=200.0,
        forward_cpu_ms=90.0,
        max_error=1e-6,
        psnr_db=130.0,
        fma_fraction=0.5,
        backward_fma_fraction=0.4,
        bandwidth_fraction=0.1,
        stages_ms={"sort": 20.0, "raster": 80.0},
    )


def test_each_suite_and_scene_has_a_table(row):
    rows = [row, replace(row, suite="count", scene="room 128"), replace(row, suite="count", scene="room 256")]
    found = tables(rows)
    assert [(table.title, table.row_count) for table in found] == [("headline: room 512", 1), ("count", 2)]
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(*found)
    assert "886,580" in console.export_text()


def test_cells_are_blank_where_nothing_was_measured(row):
    shown = cells(replace(row, psnr_db=None, max_error=None, backward_ms=None))
    assert shown.count("") == 8 and "100" in shown


def test_the_exact_picture_is_called_exact(row):
    assert "exact" in cells(replace(row, max_error=0.0, psnr_db=float("inf")))


def test_sentences_compare_like_with_like(row):
    rows = [
        row,
        replace(row, threads=2, forward_ms=50.0),
        replace(row, layout="cubemap", forward_ms=1.0),
        replace(row, backend="torch", forward_ms=10_000.0, backward_ms=30_000.0, forward_cpu_ms=8100.0),
        replace(row, backend="torch", precision="float64", forward_ms=1.0),
        replace(row, suite="dense", backend="dense", height=64, num_gaussians=13_848, forward_ms=4000.0),
        replace(row, suite="dense", height=64, num_gaussians=13_848, forward_ms=2.0),
    ]
    told = findings(rows)
    assert any(
        "numba on one thread is 100 times (backward 150 times) [by processor time 90] as fast" in one for one in told
    )
    assert any("numba on 2 threads is 200 times" in one for one in told)
    assert any("numba on one thread is 2,000 times" in one and "64x128" in one for one in told)
    scaled = 4.0 * 8**2 * 886_580 / 13_848
    assert any(f"(not measured), the dense renderer would take {scaled:,.0f} s" in one for one in told)
    peaks = "reaches 50% of the multiply-add peak forward (56% while it rasters), 40% backward, and 10% of the memory"
    assert any(peaks in one for one in told)


def test_nothing_measured_tells_nothing():
    assert tables([]) == [] and findings([]) == [] and markdown([]) == "\n"


def test_markdown_is_the_same_table(row):
    lines = markdown([row, replace(row, threads=2)]).splitlines()
    start = lines.index("### Headline: room 512")
    table = lines[start + 2 :]
    assert len(table) == 4 and len({line.count("|") for line in table}) == 1
    assert " | ".join(cells(row)) in table[2]
