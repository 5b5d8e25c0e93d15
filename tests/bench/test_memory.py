"""`pansplat bench memory`: one process per row, a status for every row, and continued runs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pansplat.bench import memory as bench_memory
from pansplat.bench.harness import CaseFailedError, OverLimitError, relative_deviation
from pansplat.bench.memory import MEMORY, MemoryCase, MemorySetting, list_memory_cases, measure_case, plot_memory
from pansplat.bench.model import save_random_weights
from pansplat.bench.report import Row
from pansplat.cli import run
from pansplat.training.network import network_config

SETTING = MemorySetting("tiny", "cubemap", "structure", 1, 8.0)
ARGUMENTS = ["bench", "memory", "--preset", "tiny", "--heights", "64", "128", "--threads", "1"]


def invent_result(case: MemoryCase) -> tuple[dict, dict[str, torch.Tensor]]:
    """More memory for larger heights, less for more tiles, and gradients that depend on the tiles."""
    gib = (case.height / 64) ** 2 / case.tiles
    tensors = {"weight": torch.tensor([3.0, 4.0 + 0.005 * (case.tiles - 1)])}
    return {"base_gib": 0.5, "peak_gib": 0.5 + gib, "taken_gib": gib, "processor_s": 1.5}, tensors


@dataclasses.dataclass
class Measured:
    """The measured cases; their results are made up. `error_of` gives the error of a case that fails."""

    cases: list[MemoryCase] = dataclasses.field(default_factory=list)
    error_of: Callable[[MemoryCase], BaseException | None] = lambda case: None

    def __call__(self, case: MemoryCase, setting: MemorySetting, weights: Path) -> tuple:
        assert weights.is_file() and setting.network == "tiny"
        self.cases.append(case)
        error = self.error_of(case)
        if error is not None:
            raise error
        return invent_result(case)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> Measured:
    measured = Measured()
    monkeypatch.setattr(bench_memory, "measure_case", measured)
    return measured


def rows_in(folder: Path) -> list[dict]:
    return json.loads((folder / "memory.json").read_text())["rows"]


def references_in(folder: Path) -> list[tuple[str, int]]:
    return [(row["work"], row["tiles"]) for row in rows_in(folder) if row["is_reference"]]


def test_the_command_writes_and_prints_the_rows(measured, tmp_path, capsys):
    out = tmp_path / "out"
    assert run([*ARGUMENTS, "--out", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["memory.json", "memory.md", "memory.png"]
    rows = rows_in(out)
    assert measured.cases == list_memory_cases((64, 128), quick=False)
    assert [MemoryCase(row["work"], row["tiles"], row["height"]) for row in rows] == measured.cases
    assert {row["status"] for row in rows} == {"measured"}
    assert references_in(out) == 2 * [("inference", 1), ("plain", 1)]
    assert rows[2]["tiles"] == 4 and rows[2]["deviation"] == pytest.approx(0.015 / 5, rel=1e-4)
    printed = capsys.readouterr().out
    for word in ("two-step", "reference", "taken GiB", "processor s", "3.0e-03"):
        assert word in printed


def test_an_interrupted_run_continues_with_the_kind_that_was_interrupted(measured, tmp_path):
    measured.error_of = lambda case: KeyboardInterrupt() if len(measured.cases) == 7 else None
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 130
    assert len(rows_in(tmp_path)) == 6
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 0
    assert measured.cases[7] == MemoryCase("plain", 1, 64)  # inference at 64 was complete
    assert len(measured.cases) == 7 + 17 and len(rows_in(tmp_path)) == 20
    assert references_in(tmp_path) == 2 * [("inference", 1), ("plain", 1)]


def test_rows_of_other_settings_are_refused(measured, tmp_path, capsys):
    assert run([*ARGUMENTS, "--quick", "--out", str(tmp_path)]) == 0
    assert {(row["work"], row["tiles"]) for row in rows_in(tmp_path)} == {
        *(("inference", 1), ("inference", 4), ("plain", 1), ("two-step", 1), ("two-step", 4))
    }
    assert run([*ARGUMENTS, "--style", "panorama", "--out", str(tmp_path)]) == 2
    assert "style was cubemap, now panorama" in capsys.readouterr().err


def test_failed_rows_have_a_status_and_are_measured_again_with_another_limit(measured, tmp_path, capsys):
    errors = {"plain": OverLimitError("ended at 2 GiB"), "one-step": CaseFailedError("ended by SIGSEGV")}
    measured.error_of = lambda case: errors.get(case.work)
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 0
    found = {(row["work"], row["tiles"], row["height"]): (row["status"], row["note"]) for row in rows_in(tmp_path)}
    assert len(found) == 20
    assert found["plain", 1, 128] == ("over the limit", "ended at 2 GiB")
    assert found["one-step", 2, 64] == ("died", "ended by SIGSEGV")
    assert found["two-step", 2, 128][0] == "measured"
    assert "over the limit: ended at 2 GiB" in capsys.readouterr().out
    assert ("two-step", 1) in references_in(tmp_path)  # the first that succeeded
    measured.cases.clear()
    measured.error_of = lambda case: None
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 0
    assert not measured.cases
    small = [*ARGUMENTS[:4], "--heights", "64", "--threads", "1", "--limit-gb", "9", "--out", str(tmp_path)]
    assert run(small) == 0
    assert measured.cases == [case for case in list_memory_cases([64], quick=False) if case.kind == "training"]
    assert [row["status"] for row in rows_in(tmp_path) if row["height"] == 64] == ["measured"] * 10
    assert len(rows_in(tmp_path)) == 20


def test_cells_of_rows_that_were_not_measured_are_empty_except_for_the_reason():
    row = Row("memory", "sphere", MemoryCase("two-step", 4, 2048), status="died", note="ended by SIGSEGV")
    cells = [column.cell(row) for column in MEMORY.columns]
    assert cells == ["2048", "two-step", "16", *[""] * 6, "died: ended by SIGSEGV"]
    assert plot_memory([row], {}) is None


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("memory") / "tiny.safetensors"
    save_random_weights(path, network_config("tiny"))
    return path


@pytest.mark.exhaustive
@pytest.mark.slow
def test_a_child_measures_gradients_and_memory(weights):
    """The tiled case runs in a child process; the plain one in this process, which gives the expected gradients."""
    plain, tiled = MemoryCase("plain", 1, 64), MemoryCase("two-step", 2, 64)
    job = {"case": dataclasses.asdict(plain), "setting": dataclasses.asdict(SETTING), "weights": str(weights)}
    expected, plain_gradients = bench_memory._measure_job(job)
    result, tiled_gradients = measure_case(tiled, SETTING, weights)
    assert any(name.startswith("features.") for name in plain_gradients)
    assert 0 < relative_deviation(tiled_gradients, plain_gradients, together=True) < 1e-4
    assert expected["num_gaussians"] == result["num_gaussians"] == 13848
    assert 0.1 < result["base_gib"] < result["peak_gib"] < 2
    assert result["peak_gib"] - result["base_gib"] == pytest.approx(result["taken_gib"])
    assert 0.01 < result["taken_gib"] < expected["taken_gib"]


def test_a_child_over_the_limit_is_ended(weights):
    with pytest.raises(OverLimitError, match=r"ended at 0\.1 GiB"):
        measure_case(MemoryCase("plain", 1, 64), dataclasses.replace(SETTING, limit_gib=0.1), weights)
