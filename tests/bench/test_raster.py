"""The raster benchmark keeps its rows when interrupted, and its findings compare rows of the same kind."""

import json
import math
from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pansplat.bench import raster
from pansplat.bench.raster import (
    RASTER_COLUMNS,
    RasterBench,
    RasterResult,
    RasterRow,
    find_pareto_front,
    list_findings,
    make_raster_report,
    plot_choices,
    plot_sweeps,
)
from pansplat.bench.raster_cases import Group, RasterCase, default_face_size, make_official_case, make_room_scene

HEIGHT = 16
MACHINE = {"cpu": "some", "threads": 2, "gpu": None}
DIRECT = RasterCase("torch", HEIGHT)
FACES = replace(DIRECT, layout="cubemap", face_size=default_face_size(HEIGHT))
NUMBER = st.integers(1, 6).map(float)


def group(*cases: RasterCase, references: str = "own", backward: bool = False, height: int = HEIGHT) -> Group:
    return Group(
        "choices", make_room_scene(height), tuple(replace(case, backward=backward) for case in cases), references
    )


def measure(*groups: Group, budget: float = 0, **files) -> list[RasterRow]:
    report = make_raster_report(MACHINE, **files)
    RasterBench(report, budget=budget).run(groups)
    return report.rows


def results(rows: list[RasterRow]) -> Mapping[tuple, RasterResult]:
    return {(row.case.kernel, row.case.order, row.case.layout, row.case.precision): row.result for row in rows}


def test_rows_hold_times_memory_and_errors():
    reference, row = measure(group(DIRECT, backward=True), budget=0.1)
    assert (reference.case.precision, reference.result.max_error, reference.result.repeats) == ("float64", 0, 1)
    result = row.result
    assert result.forward_ms > 0 and result.backward_ms > 0 and result.forward_min_ms <= result.forward_ms
    assert result.forward_cpu_ms > 0 and result.backward_cpu_ms > 0
    assert result.num_gaussians == 862 and result.repeats >= 1
    assert 0 < result.max_error < 1e-5 and result.psnr_db > 120 and result.own_max_error == result.max_error
    values = row.as_json()
    for kind, names in (
        (str, "suite scene backend kernel order filter layout stitching precision"),
        (int, "height threads num_gaussians repeats"),
        (float, "forward_ms backward_ms peak_mb psnr_db max_error seam_jump energy_error"),
    ):
        assert all(isinstance(values[name], kind) for name in names.split())


def test_errors_of_the_choice_are_separate_from_those_of_the_backend():
    found = results(measure(group(FACES, replace(FACES, kernel="ewa"), make_official_case("torch", HEIGHT, 1))))
    exact, ewa = found["ray", "radial", "cubemap", "float32"], found["ewa", "radial", "cubemap", "float32"]
    official = found["ewa", "z", "cubemap", "float32"]
    assert exact.psnr_db > ewa.psnr_db > official.psnr_db
    assert exact.seam_jump < 0.01 < ewa.seam_jump
    assert all(result.own_max_error < 1e-5 for result in (exact, ewa, official))
    assert found["ewa", "z", "cubemap", "float64"].max_error == pytest.approx(official.max_error, rel=1e-3)


def test_pinhole_images_are_compared_with_the_exact_pinhole_image():
    pinhole = replace(DIRECT, layout="pinhole")
    found = results(measure(group(pinhole, replace(pinhole, kernel="ewa"))))
    assert found["ray", "radial", "pinhole", "float32"].max_error < 1e-5
    assert found["ewa", "radial", "pinhole", "float32"].max_error > 1e-3
    assert found["ray", "radial", "pinhole", "float32"].seam_jump is None


def test_only_the_needed_references_are_rendered():
    rows = measure(group(FACES, references="exact"), group(DIRECT, references="none"))
    assert [row.case.precision for row in rows] == ["float64", "float32", "float32"]
    assert rows[1].result.own_max_error is None and rows[1].result.max_error is not None
    assert rows[2].result.max_error is None


def test_a_reference_is_rendered_once_for_each_scene():
    rows = measure(group(DIRECT), group(DIRECT, height=8), group(DIRECT))
    assert [row.scene for row in rows if row.case.precision == "float64"] == [f"room {HEIGHT}", "room 8"]
    assert rows[-1].result.own_max_error < 1e-5


@pytest.fixture
def rendered(monkeypatch) -> list[RasterCase]:
    """The rendered cases, in order; a case with kernel "ewa" interrupts the run."""
    cases, original = [], raster.render_case

    def render_case(case, *arguments):
        if case.kernel == "ewa":
            raise KeyboardInterrupt
        assert torch.get_num_threads() == case.threads
        cases.append(case)
        return original(case, *arguments)

    monkeypatch.setattr(raster, "render_case", render_case)
    return cases


def test_cases_of_a_group_are_rendered_in_turns(rendered, monkeypatch):
    monkeypatch.setattr(raster, "_MAX_REPEATS", 3)
    measure(group(replace(DIRECT, threads=2), FACES, references="none"), budget=1e6)
    assert [case.layout for case in rendered] == ["equirect", "cubemap"] * 4  # a first image each, then three rounds


def test_an_interruption_keeps_the_rows_and_restores_the_threads(rendered, tmp_path):
    file, threads = tmp_path / "rows.json", torch.get_num_threads()
    with pytest.raises(KeyboardInterrupt):
        groups = group(DIRECT, references="none"), group(FACES, replace(FACES, kernel="ewa"), references="exact")
        measure(*groups, json=file)
    kept = json.loads(file.read_text())["rows"]
    assert [(row["layout"], row["precision"]) for row in kept] == [
        *(("equirect", "float32"), ("equirect", "float64"), ("cubemap", "float32"))
    ]
    assert kept[0]["forward_ms"] > 0 and math.isfinite(kept[2]["psnr_db"])
    assert torch.get_num_threads() == threads


# Findings, tables and plots of given rows.


@pytest.fixture
def row() -> RasterRow:
    result = RasterResult(
        886_580,
        forward_ms=100.0,
        forward_min_ms=100.0,
        backward_ms=200.0,
        forward_cpu_ms=90.0,
        max_error=1e-6,
        psnr_db=130.0,
        stages_ms={"sort": 20.0, "raster": 80.0},
    )
    return RasterRow("headline", "room 512", RasterCase("numba", 512), result)


def change(row: RasterRow, suite: str | None = None, scene: str | None = None, **values) -> RasterRow:
    """The row with other fields of itself, its case or its result."""
    in_case = {name: value for name, value in values.items() if hasattr(row.case, name)}
    in_result = {name: value for name, value in values.items() if name not in in_case}
    case, result = replace(row.case, **in_case), replace(row.result, **in_result)
    return RasterRow(suite or row.suite, scene or row.scene, case, result)


def cells(row: RasterRow) -> list[str]:
    return [column.cell(row) for column in RASTER_COLUMNS]


def test_cells_of_unmeasured_values_are_empty(row):
    assert cells(row).count("") == 5
    shown = cells(change(row, psnr_db=None, max_error=None, backward_ms=None))
    assert shown.count("") == 8 and "100" in shown
    assert "exact" in cells(change(row, max_error=0.0, psnr_db=math.inf))


def test_a_sweep_has_one_table_for_all_scenes(row):
    report = make_raster_report(MACHINE)
    sweep = [change(row, suite="count", scene=f"room {height}") for height in (128, 256)]
    assert [(table.title, table.row_count) for table in report.tables([row, *sweep])] == [
        *(("headline: room 512", 1), ("count", 2))
    ]


def test_findings_compare_rows_of_the_same_kind(row):
    rows = [
        row,
        change(row, threads=2, forward_ms=50.0),
        change(row, layout="cubemap", forward_ms=1.0),
        change(row, backend="torch", forward_ms=10_000.0, backward_ms=30_000.0, forward_cpu_ms=8100.0),
        change(row, backend="torch", precision="float64", forward_ms=1.0),
    ]
    text = "\n".join(list_findings(rows))
    assert "numba on one thread is 100 times (backward 150 times) [by processor time 90] as fast" in text
    assert "numba on 2 threads is 200 times" in text
    assert list_findings([]) == []


@given(st.lists(st.tuples(NUMBER, NUMBER), min_size=1, max_size=20))
def test_no_other_point_beats_a_point_of_the_front(points):
    def beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
        return one[0] <= other[0] and one[1] <= other[1] and one != other

    front = find_pareto_front(points)
    for index, point in enumerate(points):
        assert (index in front) == (not any(beats(other, point) for other in points))
    ordered = [points[i] for i in front]
    assert ordered == sorted(ordered, key=lambda point: (point[0], -point[1]))


def test_plots_are_made_of_the_rows_of_their_suites(row, tmp_path):
    choices = [
        change(row, suite="choices"),
        change(row, suite="choices", backend="torch", precision="float64", psnr_db=math.inf),
        change(row, suite="choices", backend="numba", kernel="ewa", layout="cubemap", face_size=8, filter="3dgs"),
    ]
    counts = [change(row, suite="count"), change(row, suite="count", num_gaussians=20, backward_min_ms=9.0)]
    sweeps = counts + [change(one, suite="resolution", height=16 * n) for n, one in enumerate(counts, 1)]
    for plot, rows in ((plot_choices, choices), (plot_sweeps, sweeps)):
        plot(rows).savefig(tmp_path / "plot.png")
        assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
        assert plot([change(row, suite="other")]) is None
