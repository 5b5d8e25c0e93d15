"""The raster benchmark covers every choice, keeps its rows when interrupted, and its findings compare equal rows."""

import json
import math
from dataclasses import asdict, replace

import pytest
import torch

from pansplat.bench import raster
from pansplat.bench.harness import run
from pansplat.bench.raster import (
    RASTER,
    Group,
    RasterCase,
    choice_height,
    default_face_size,
    list_choices,
    list_main_choices,
    list_raster_groups,
    make_room_scene,
    make_sample_group,
    measure_raster,
    plot_choices,
)
from pansplat.evaluation.results import Row

HEIGHT = 16
HEADER = {"machine": {"cpu": "some", "threads": 2, "gpu": None}}
DIRECT = RasterCase("torch", HEIGHT)
FACES = replace(DIRECT, layout="cubemap", face_size=default_face_size(HEIGHT))


def group(*cases: RasterCase, backward: bool = False, height: int = HEIGHT) -> Group:
    return Group("choices", make_room_scene(height), [replace(case, backward=backward) for case in cases])


def measure(*groups: Group, budget: float = 0, **files) -> list[Row]:
    return run(RASTER, measure_raster(groups, budget=budget), {}, **files)


def test_rows_hold_times_memory_and_errors():
    reference, row = measure(group(DIRECT, backward=True), budget=0.1)
    assert (reference.get("precision"), reference.get("max_error"), reference.get("repeats")) == ("float64", 0, 1)
    assert reference.get("is_reference") and reference.get("backward_ms") is None
    result = row.values
    assert result["forward_min_ms"] <= result["forward_ms"] and result["num_gaussians"] == 862
    assert {"backward_ms", "forward_cpu_ms", "backward_cpu_ms", "peak_mb"} <= result.keys()
    assert 0 < result["max_error"] < 1e-5 and result["psnr_db"] > 120


def test_errors_are_against_the_exact_image_of_the_layout():
    pinhole, official = replace(DIRECT, layout="pinhole"), list_main_choices("torch", HEIGHT, 1)[-1]
    cases = (FACES, replace(FACES, kernel="ewa"), official, pinhole, replace(pinhole, kernel="ewa"))
    rows = measure(group(*cases))
    assert [row.get("layout") for row in rows if row.get("precision") == "float64"] == ["equirect", "pinhole"]
    exact, ewa, official, pinhole, pinhole_ewa = (row for row in rows if row.get("precision") == "float32")
    assert exact.get("psnr_db") > ewa.get("psnr_db") > official.get("psnr_db")
    assert pinhole.get("max_error") < 1e-5 and pinhole_ewa.get("max_error") > 1e-3


def test_the_exact_image_is_rendered_once_for_each_scene_and_not_of_huge_ones(monkeypatch):
    rows = measure(group(DIRECT), group(DIRECT, height=8), group(DIRECT))
    assert [row.get("scene") for row in rows if row.get("precision") == "float64"] == [f"room {HEIGHT}", "room 8"]
    assert rows[-1].get("max_error") < 1e-5
    monkeypatch.setattr(raster, "_MAX_TORCH_GAUSSIANS", 100)
    (row,) = measure(group(DIRECT))
    assert "forward_ms" in row.values and "max_error" not in row.values


@pytest.fixture
def rendered(monkeypatch) -> list[RasterCase]:
    """The rendered cases, in order, without warm-up; a case with kernel "ewa" interrupts the run."""
    cases, original = [], RasterCase.render

    def render(case, gaussians, pose):
        if case.kernel == "ewa":
            raise KeyboardInterrupt
        assert torch.get_num_threads() == case.threads
        if len(gaussians) > 1:
            cases.append(case)
        return original(case, gaussians, pose)

    monkeypatch.setattr(RasterCase, "render", render)
    return cases


def test_cases_of_a_group_are_rendered_in_turns(rendered, monkeypatch):
    monkeypatch.setattr(raster, "_MAX_REPEATS", 3)
    measure(group(replace(DIRECT, threads=2), FACES), budget=1e6)
    layouts = [case.layout for case in rendered if case.precision == "float32"]
    assert layouts == ["equirect", "cubemap"] * 4  # a first image each, then three rounds


def test_an_interruption_keeps_the_rows_and_restores_the_threads(rendered, tmp_path):
    file, threads = tmp_path / "rows.json", torch.get_num_threads()
    with pytest.raises(KeyboardInterrupt):
        measure(group(DIRECT), group(FACES, replace(FACES, kernel="ewa")), json_file=file)
    kept = json.loads(file.read_text())["rows"]
    assert [(row["layout"], row["precision"]) for row in kept] == [
        *(("equirect", "float64"), ("equirect", "float32"), ("cubemap", "float32"))
    ]
    assert "forward_ms" in kept[1] and math.isfinite(kept[2]["psnr_db"])
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize(("quick", "small"), [(True, 192), (False, 512)])
def test_groups_hold_every_choice_of_the_fast_backend_and_the_main_ones_at_full_height(quick, small):
    assert choice_height(512, quick=quick) == small and choice_height(2048, quick=False) == 512
    headline, choices = list_raster_groups(make_room_scene, 512, ["numba"], 2, quick=quick)
    assert set(list_choices("numba", small, 2)) <= set(choices.cases) and choices.scene.name == f"room {small}"
    assert set(list_main_choices("torch", small, 1)) <= set(choices.cases)
    assert headline.scene.name == "room 512" and {case.height for case in headline.cases} == {512}
    assert {(case.backend, case.threads) for case in headline.cases} == {("numba", 2), ("numba", 1), ("torch", 1)}
    huge = list_raster_groups(make_room_scene, 2048, ["numba"], 2, quick=quick)[0]
    assert {case.backend for case in huge.cases} == {"numba"}
    alone = make_sample_group(make_room_scene(64), 64, [], 2)
    assert {case.backend for case in alone.cases} == {"torch"}


def test_all_choices_are_all_combinations():
    for backend, kernels, orders in (("torch", 2, 2), ("triton", 2, 2), ("numba", 1, 1)):
        choices = list_choices(backend, 64, 1)
        assert len(set(choices)) == len(choices) == 2 + 2 * orders * kernels + kernels
        assert {(c.kernel, c.order) for c in choices if c.layout == "equirect"} == {("ray", "radial")}
    official = list_main_choices("torch", 512, 2)[-1]
    choices = (official.kernel, official.order, official.filter, official.face_size, official.stitching)
    assert choices == ("ewa", "z", "3dgs", 256, "official")
    assert official.exact == RasterCase("torch", 512, precision="float64", backward=False)


# Findings, tables and plots of given rows.


@pytest.fixture
def row() -> Row:
    names = ("forward_ms", "forward_min_ms", "backward_ms", "forward_cpu_ms", "max_error", "psnr_db", "num_gaussians")
    result = dict(zip(names, (100.0, 100.0, 200.0, 90.0, 1e-6, 130.0, 886_580), strict=True))
    return make_row("headline", RasterCase("numba", 512), result)


def make_row(suite: str, case: RasterCase, values: dict[str, float]) -> Row:
    entries = {"suite": suite, "scene": "room 512", **asdict(case), "layout_name": case.layout_name}
    return Row({**entries, "is_reference": case.precision == "float64"}, values)


def change(row: Row, suite: str | None = None, **values) -> Row:
    """The row with other values of its case or its result."""
    fields = RasterCase.__dataclass_fields__
    case = RasterCase(**{name: values.pop(name, row.get(name)) for name in fields})
    return make_row(suite or row.get("suite"), case, row.values | values)


def test_cells_of_unmeasured_values_are_empty(row):
    def cells(row: Row) -> list[str]:
        return [column.cell(row) for column in RASTER.columns]

    assert cells(row)[8:] == ["100", "90.0", "200", "", "", "130.0", "1.0e-06"]
    assert cells(change(row, forward_spread_ms=8.0, psnr_db=math.inf))[8:14] == [
        "100 ±4",
        "90.0",
        "200",
        "",
        "",
        "exact",
    ]
    assert cells(change(row, psnr_db=None, max_error=None, backward_ms=None)).count("") == 5


def test_findings_compare_rows_of_the_same_kind(row):
    rows = [
        row,
        change(row, threads=2, forward_ms=50.0, backward_ms=None),
        change(row, layout="cubemap", forward_ms=1.0),
        change(row, backend="torch", forward_ms=10_000.0, backward_ms=30_000.0, forward_cpu_ms=8100.0),
        change(row, backend="torch", precision="float64", forward_ms=1.0),
    ]
    one, two = RASTER.findings(rows)
    assert one.startswith("numba on one thread is 100 times as fast forward and 150 times backward")
    assert "(processor time: 90 and ? times less), 512x1024, 886,580 Gaussians" in one
    assert two.startswith("numba on 2 threads is 200 times as fast forward and ? times backward")
    assert RASTER.findings(rows[:2]) == []


def test_the_plot_shows_panoramas_of_the_choices(row):
    choices = [
        change(row, "choices"),
        change(row, "choices", backend="torch", precision="float64", psnr_db=math.inf),
        change(row, "choices", backend="triton", kernel="ewa", layout="cubemap", face_size=8, filter="3dgs"),
    ]
    (axes,) = plot_choices([*choices, change(row, "choices", layout="pinhole")], HEADER).axes
    labels = {text.get_text() for text in axes.get_legend().get_texts()}
    assert labels == {"numba, equirect", "triton, cubemap 8"}
    assert {text.get_text() for text in axes.texts} == {"ray radial angular", "ewa radial 3dgs"}
    assert "886,580 Gaussians; some" in axes.get_title(loc="left")
    assert plot_choices([row], HEADER) is None
