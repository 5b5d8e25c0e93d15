"""A run keeps what it measured, whatever happens, and tells right from wrong choices."""

import json
import math
from dataclasses import replace

import pytest
import torch

from pansplat.bench import raster
from pansplat.bench.cases import Case, Group, default_face_size, official
from pansplat.bench.plan import room
from pansplat.bench.raster import Bench

HEIGHT = 16
MACHINE = {"fma_gflops": {"1": 100.0, "2": 200.0}, "bandwidth_gb_s": {"1": 30.0, "2": 30.0}}
DIRECT = Case("torch", HEIGHT)
FACES = replace(DIRECT, layout="cubemap", face_size=default_face_size(HEIGHT))


def group(*cases: Case, truths: str = "own", backward: bool = False) -> Group:
    return Group("choices", room(HEIGHT), tuple(replace(case, backward=backward) for case in cases), truths)


def by_case(bench: Bench) -> dict[tuple, raster.Row]:
    return {(row.kernel, row.order, row.layout, row.precision): row for row in bench.rows}


def test_rows_hold_times_memory_errors_and_distances_to_the_peaks():
    bench = Bench(MACHINE, budget=0.1)
    bench.run([group(DIRECT, backward=True)])
    truth, row = bench.rows
    assert (truth.precision, truth.max_error, truth.repeats) == ("float64", 0, 1)
    assert row.forward_ms > 0 and row.backward_ms > 0 and row.forward_min_ms <= row.forward_ms
    assert row.forward_cpu_ms > 0 and row.backward_cpu_ms > 0
    assert row.num_gaussians == 862 and row.repeats >= 1
    assert 0 < row.max_error < 1e-5 and row.psnr_db > 120 and row.own_max_error == row.max_error
    assert 0 < row.fma_fraction < 1 and 0 < row.bandwidth_fraction < 1 and row.pairs > 0
    expected = 46 * row.pairs / (1e-3 * row.forward_cpu_ms) / 100e9
    assert row.fma_fraction == pytest.approx(expected)


def test_errors_tell_the_choice_apart_from_the_backend():
    bench = Bench(MACHINE, budget=0)
    bench.run([group(FACES, replace(FACES, kernel="ewa"), official("torch", HEIGHT, 1))])
    rows = by_case(bench)
    exact, classic = rows["ray", "radial", "cubemap", "float32"], rows["ewa", "radial", "cubemap", "float32"]
    original = rows["ewa", "z", "cubemap", "float32"]
    assert exact.psnr_db > classic.psnr_db > original.psnr_db
    assert exact.seam_jump < 0.01 < classic.seam_jump
    assert all(row.own_max_error < 1e-5 for row in (exact, classic, original))
    assert rows["ewa", "z", "cubemap", "float64"].max_error == pytest.approx(original.max_error, rel=1e-3)


def test_a_pinhole_view_is_compared_with_the_exact_view():
    view = replace(DIRECT, layout="pinhole")
    bench = Bench(MACHINE, budget=0)
    bench.run([group(view, replace(view, kernel="ewa"))])
    rows = by_case(bench)
    assert rows["ray", "radial", "pinhole", "float32"].max_error < 1e-5
    assert rows["ewa", "radial", "pinhole", "float32"].max_error > 1e-3
    assert rows["ray", "radial", "pinhole", "float32"].seam_jump is None


def test_the_exact_truth_alone_is_drawn_where_that_is_asked_for():
    bench = Bench(MACHINE, budget=0)
    bench.run([group(FACES, truths="exact"), group(DIRECT, truths="none")])
    assert [row.precision for row in bench.rows] == ["float64", "float32", "float32"]
    assert bench.rows[1].own_max_error is None and bench.rows[1].max_error is not None
    assert bench.rows[2].max_error is None


def test_a_truth_is_drawn_once_a_scene():
    bench = Bench(MACHINE, budget=0)
    other = replace(group(DIRECT), subject=room(8))
    bench.run([group(DIRECT), other, group(DIRECT)])
    assert [(row.scene, row.precision) for row in bench.rows if row.precision == "float64"] == [
        (f"room {HEIGHT}", "float64"),
        ("room 8", "float64"),
    ]
    assert bench.rows[-1].own_max_error < 1e-5


def test_cases_of_a_group_are_drawn_in_turn(monkeypatch):
    drawn = []
    original = raster.draw

    def noted(case, *arguments):
        drawn.append(case.layout)
        return original(case, *arguments)

    monkeypatch.setattr(raster, "draw", noted)
    monkeypatch.setattr(raster, "_MOST", 3)
    Bench(MACHINE, budget=1e6).run([group(DIRECT, FACES, truths="none")])
    # A first drawing each, then three rounds.
    assert drawn == ["equirect", "cubemap"] * 4


def test_an_interruption_keeps_the_rows(monkeypatch, tmp_path):
    file, original = tmp_path / "rows.json", raster.draw

    def interrupted(case, *arguments):
        if case.kernel == "ewa":
            raise KeyboardInterrupt
        return original(case, *arguments)

    monkeypatch.setattr(raster, "draw", interrupted)
    threads = torch.get_num_threads()
    bench = Bench(MACHINE, file=file, budget=0)
    with pytest.raises(KeyboardInterrupt):
        bench.run([group(DIRECT, truths="none"), group(FACES, replace(FACES, kernel="ewa"), truths="exact")])
    kept = json.loads(file.read_text())["rows"]
    assert [(row["layout"], row["precision"]) for row in kept] == [
        ("equirect", "float32"),
        ("equirect", "float64"),
        ("cubemap", "float32"),
    ]
    assert kept[0]["forward_ms"] > 0 and math.isfinite(kept[2]["psnr_db"])
    assert torch.get_num_threads() == threads


def test_the_watcher_hears_what_is_done_and_sees_the_rows():
    heard = []
    Bench(MACHINE, budget=0, watch=lambda doing, rows: heard.append((doing, len(rows)))).run([group(DIRECT)])
    assert heard[0][0] == f"room {HEIGHT}: making the scene"
    assert any("the float64 reference" in doing for doing, _ in heard)
    assert heard[-1][1] == 2


def test_threads_are_those_of_the_case(monkeypatch):
    used, original = [], raster.draw
    monkeypatch.setattr(raster, "draw", lambda *a: (used.append(torch.get_num_threads()), original(*a))[1])
    Bench(MACHINE, budget=0).run([group(replace(DIRECT, threads=2), truths="none")])
    assert set(used) == {2}
