"""`pansplat bench memory`: one process per row, a status for every row, and continued runs."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from pansplat.bench import memory as bench_memory
from pansplat.bench.fidelity import relative_deviation
from pansplat.bench.harness import CaseFailedError, OverLimitError
from pansplat.bench.memory import (
    MEMORY_COLUMNS,
    MemoryCase,
    MemoryResult,
    MemoryRow,
    MemorySetting,
    estimate_gib,
    list_memory_cases,
    measure_case,
    plot_memory,
)
from pansplat.bench.model import save_random_weights
from pansplat.cli import run
from pansplat.training.network import network_config

SETTING = MemorySetting("tiny", "cubemap", "structure", 1, "cpu", 8.0)
ARGUMENTS = ["bench", "memory", "--preset", "tiny", "--heights", "64", "128", "--threads", "1", "--device", "cpu"]


def invent_result(case: MemoryCase) -> tuple[MemoryResult, dict[str, torch.Tensor]]:
    """More memory for larger heights, less for more tiles, and gradients that depend on the tiles."""
    gib = (case.height / 64) ** 2 / case.tiles
    tensors = {"weight": torch.tensor([3.0, 4.0 + 0.005 * (case.tiles - 1)])}
    return MemoryResult(0.5, 0.5 + gib, gib, 2.0, 1.5, 100), tensors


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[MemoryCase]:
    """The measured cases; their results are made up."""
    cases: list[MemoryCase] = []

    def measure(case: MemoryCase, setting: MemorySetting, weights: Path) -> tuple:
        assert weights.is_file() and setting.network == "tiny"
        cases.append(case)
        return invent_result(case)

    monkeypatch.setattr(bench_memory, "measure_case", measure)
    return cases


@pytest.fixture
def fail(monkeypatch: pytest.MonkeyPatch, measured: list[MemoryCase]):
    """A function that makes cases raise an error: the one that it returns for a case, if any."""

    def set_errors(error_of) -> None:
        def measure(case: MemoryCase, *_: object) -> tuple:
            measured.append(case)
            error = error_of(case)
            if error is not None:
                raise error
            return invent_result(case)

        monkeypatch.setattr(bench_memory, "measure_case", measure)

    return set_errors


def rows_in(folder: Path) -> list[dict]:
    return json.loads((folder / "memory.json").read_text())["rows"]


def references_in(folder: Path) -> list[tuple[str, int]]:
    return [(row["work"], row["tiles"]) for row in rows_in(folder) if row["is_reference"]]


def test_the_command_writes_and_prints_the_rows(measured, tmp_path, capsys):
    out = tmp_path / "out"
    assert run([*ARGUMENTS, "--out", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["memory.json", "memory.md", "memory.png"]
    rows = rows_in(out)
    assert measured == list_memory_cases((64, 128), quick=False)
    assert [MemoryCase(row["work"], row["tiles"], row["height"]) for row in rows] == measured
    assert {row["status"] for row in rows} == {"measured"}
    assert references_in(out) == 2 * [("inference", 1), ("plain", 1)]
    assert rows[2]["tiles"] == 4 and rows[2]["deviation"] == pytest.approx(0.015 / 5, rel=1e-4)
    assert rows[0]["taken_gib"] == 1.0
    printed = capsys.readouterr().out
    for word in ("two-step", "reference", "taken GiB", "processor s", "3.0e-03"):
        assert word in printed


def test_an_interrupted_run_continues(measured, fail, tmp_path, capsys):
    fail(lambda case: KeyboardInterrupt() if len(measured) == 7 else None)
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 130
    assert len(rows_in(tmp_path)) == 6
    assert "14 of 20 rows are still to be measured" in capsys.readouterr().out
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 0
    assert len(measured) == 21 and len(rows_in(tmp_path)) == 20  # only the interrupted case twice
    assert len(references_in(tmp_path)) == 4


def test_references_without_a_stored_result_are_measured_again(measured, tmp_path):
    assert run([*ARGUMENTS, "--quick", "--out", str(tmp_path)]) == 0
    before = len(measured)
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 0
    again = measured[before:]
    assert MemoryCase("plain", 1, 64) in again and MemoryCase("two-step", 4, 64) not in again
    assert references_in(tmp_path) == 2 * [("inference", 1), ("plain", 1)]


def test_rows_of_other_settings_are_refused(measured, tmp_path, capsys):
    assert run([*ARGUMENTS, "--quick", "--out", str(tmp_path)]) == 0
    assert run([*ARGUMENTS, "--style", "panorama", "--out", str(tmp_path)]) == 2
    assert "style was cubemap, now panorama" in capsys.readouterr().err
    (tmp_path / "memory.json").write_text("{}")
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 2
    assert "delete it" in capsys.readouterr().err


def test_failed_rows_have_a_status_and_larger_heights_are_not_tried(measured, fail, tmp_path, capsys):
    errors = {"plain": OverLimitError("ended at 2 GiB"), "one-step": CaseFailedError("ended by SIGSEGV")}
    fail(lambda case: errors.get(case.work))
    assert run([*ARGUMENTS, "--limit-gb", "4.3", "--out", str(tmp_path)]) == 0
    rows = rows_in(tmp_path)
    found = {(row["work"], row["tiles"], row["height"]): (row["status"], row["note"]) for row in rows}
    assert len(found) == 20
    assert found["plain", 1, 64] == ("over the limit", "ended at 2 GiB")
    assert found["plain", 1, 128] == ("not tried", "a smaller height failed")
    assert found["one-step", 2, 64] == ("died", "ended by SIGSEGV")
    assert found["inference", 1, 128] == ("not tried", "4.5 GiB expected")
    assert found["two-step", 2, 128][0] == "measured"
    assert MemoryCase("plain", 1, 128) not in measured
    assert "not tried: 4.5 GiB expected" in capsys.readouterr().out
    assert ("two-step", 1) in references_in(tmp_path)  # the first that succeeded


def test_failed_rows_are_measured_again_if_their_height_is_requested_and_kept_otherwise(measured, fail, tmp_path):
    def run_at(height: int) -> list[dict]:
        measured.clear()
        assert run([*ARGUMENTS[:4], "--heights", str(height), *ARGUMENTS[7:], "--out", str(tmp_path)]) == 0
        return rows_in(tmp_path)

    fail(lambda case: OverLimitError("ended at 2 GiB") if (case.height, case.work) == (64, "plain") else None)
    small = run_at(64)
    assert [row["status"] for row in small if row["work"] == "plain"] == ["over the limit"]
    both = run_at(128)
    assert [row for row in both if row["height"] == 64] == small
    assert measured == list_memory_cases([128], quick=False)  # all are tried: the limit may be another one
    fail(lambda case: None)
    again = run_at(64)
    assert MemoryCase("plain", 1, 64) in measured and MemoryCase("inference", 1, 64) not in measured
    assert {row["status"] for row in again} == {"measured"} and len(again) == len(both)


def row_of(work: str, tiles: int, height: int, **result: float) -> MemoryRow:
    return MemoryRow("memory", "sphere", MemoryCase(work, tiles, height), MemoryResult(**result))


def test_memory_is_expected_to_grow_with_the_number_of_pixels():
    case, known = MemoryCase("two-step", 2, 256), {"base_gib": 0.5, "taken_gib": 0.25}
    row = row_of("two-step", 2, 64, **known)
    assert estimate_gib(case, []) == 0
    assert estimate_gib(case, [row]) == pytest.approx(0.5 + 16 * 0.25)
    assert estimate_gib(case, [row_of("two-step", 1, 64, **known), row_of("two-step", 2, 512, **known)]) == 0
    assert estimate_gib(case, [row_of("two-step", 2, 128), row]) == math.inf
    assert estimate_gib(MemoryCase("two-step", 2, 1024), [row]) == 0  # only the heads are trained there
    tall = row_of("two-step", 2, 1024, **known)
    assert estimate_gib(MemoryCase("two-step", 2, 2048), [tall, row]) == pytest.approx(0.5 + 4 * 0.25)


def test_cells_of_rows_that_were_not_measured_are_empty_except_for_the_reason():
    row = row_of("two-step", 4, 2048)
    row.status, row.note = "not tried", "20.0 GiB expected"
    cells = [column.cell(row) for column in MEMORY_COLUMNS]
    assert cells == ["2048", "two-step", "16", *[""] * 6, "not tried: 20.0 GiB expected"]
    assert plot_memory([row], "nothing") is None


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("memory") / "tiny.safetensors"
    save_random_weights(path, network_config("tiny"))
    return path


@pytest.mark.slow
def test_a_child_measures_gradients_and_memory(weights):
    cases = MemoryCase("plain", 1, 64), MemoryCase("two-step", 4, 64)
    (plain, plain_gradients), (tiled, tiled_gradients) = (measure_case(case, SETTING, weights) for case in cases)
    assert any(name.startswith("features.") for name in plain_gradients)
    assert 0 < relative_deviation(tiled_gradients, plain_gradients, together=True) < 1e-4
    assert plain.num_gaussians == tiled.num_gaussians == 13848
    assert 0.1 < plain.base_gib < plain.peak_gib < 2
    assert plain.peak_gib - plain.base_gib == pytest.approx(plain.taken_gib)
    assert 0.01 < tiled.taken_gib < plain.taken_gib


def test_a_child_over_the_limit_is_ended(weights):
    with pytest.raises(OverLimitError, match=r"ended at 0\.1 GiB"):
        measure_case(MemoryCase("plain", 1, 64), dataclasses.replace(SETTING, limit_gib=0.1), weights)
