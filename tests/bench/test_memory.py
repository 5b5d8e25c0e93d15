"""The bench of memory: one process a row, nothing silently missing, runs that go on where they were stopped."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from pansplat.bench import memory as bench_memory
from pansplat.bench import roofline
from pansplat.bench.memory import MemoryRow, deviation, expected_gib, memory_cases
from pansplat.bench.memory_case import MemoryCase, MemorySetting, OverLimit, RowFailed, Taken, _failure, take
from pansplat.bench.memory_report import memory_cells, memory_markdown, plot_memory
from pansplat.bench.model_weights import save_random_weights
from pansplat.cli import run
from pansplat.training.network import network_config

SETTING = MemorySetting("tiny", "cubemap", "structure", 1, "cpu", 8.0)
ARGUMENTS = ["bench", "memory", "--preset", "tiny", "--heights", "64", "128", "--threads", "1", "--device", "cpu"]


def taken(case: MemoryCase) -> Taken:
    """As if a child had said it: more for higher panoramas, less for more tiles, a little apart from the reference."""
    gib = (case.height / 64) ** 2 / case.tiles
    return Taken(0.5, 0.5 + gib, 2.0, 1.5, 100, {"weight": torch.tensor([3.0, 4.0 + 0.005 * (case.tiles - 1)])})


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[MemoryCase]:
    """Answers in place of the children's; the cases that were asked for."""
    cases: list[MemoryCase] = []

    def answer(case: MemoryCase, setting: MemorySetting, weights: Path) -> Taken:
        assert weights.is_file() and setting.network == "tiny"
        cases.append(case)
        return taken(case)

    monkeypatch.setattr(bench_memory, "take", answer)
    monkeypatch.setattr(roofline, "_STEPS", 1 << 12)
    monkeypatch.setattr(roofline, "_ELEMENTS", 1 << 12)
    return cases


def rows_in(folder: Path) -> list[dict]:
    return json.loads((folder / "memory.json").read_text())["rows"]


def test_the_command_writes_and_prints_what_was_measured(asked, tmp_path, capsys):
    out = tmp_path / "out"
    assert run([*ARGUMENTS, "--out", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["memory.json", "memory.md", "memory.png"]
    rows = rows_in(out)
    assert (
        [MemoryCase(r["work"], r["tiles"], r["height"]) for r in rows] == asked == memory_cases((64, 128), quick=False)
    )
    assert {r["status"] for r in rows} == {"measured"}
    assert [(r["work"], r["tiles"]) for r in rows if r["reference"]] == 2 * [("inference", 1), ("plain", 1)]
    assert rows[2]["tiles"] == 4 and rows[2]["deviation"] == pytest.approx(0.015 / 5, rel=1e-4)
    assert rows[0]["taken_gib"] == 1.0
    printed = capsys.readouterr().out
    for word in ("two-step", "reference", "taken GiB", "processor s", "3.0e-03"):
        assert word in printed


def test_a_run_that_was_stopped_goes_on(asked, tmp_path, monkeypatch, capsys):
    answer = bench_memory.take

    def interrupted(case: MemoryCase, *arguments) -> Taken:
        if len(asked) == 6:
            raise KeyboardInterrupt
        return answer(case, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(bench_memory, "take", interrupted)
        assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 130
    assert len(rows_in(tmp_path)) == 6
    assert "14 of 20 rows are still to be measured" in capsys.readouterr().out
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 0
    assert len(asked) == 20 and len(rows_in(tmp_path)) == 20  # nothing twice
    assert sum(r["reference"] for r in rows_in(tmp_path)) == 4


def test_what_is_compared_with_is_measured_anew_where_it_left_nothing(asked, tmp_path):
    assert run([*ARGUMENTS, "--quick", "--out", str(tmp_path)]) == 0
    before = len(asked)
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 0
    again = asked[before:]
    assert MemoryCase("plain", 1, 64) in again and MemoryCase("two-step", 4, 64) not in again
    assert [(r["work"], r["tiles"]) for r in rows_in(tmp_path) if r["reference"]] == 2 * [
        ("inference", 1), ("plain", 1)
    ]  # fmt: skip


def test_rows_of_other_settings_are_refused(asked, tmp_path, capsys):
    assert run([*ARGUMENTS, "--quick", "--out", str(tmp_path)]) == 0
    assert run([*ARGUMENTS, "--style", "panorama", "--out", str(tmp_path)]) == 2
    assert "style was cubemap, now panorama" in capsys.readouterr().err
    (tmp_path / "memory.json").write_text("{}")
    assert run([*ARGUMENTS, "--out", str(tmp_path)]) == 2
    assert "delete it" in capsys.readouterr().err


def test_rows_that_fail_are_told_of_and_higher_ones_not_tried(asked, tmp_path, monkeypatch, capsys):
    def failing(case: MemoryCase, setting: MemorySetting, weights: Path) -> Taken:
        asked.append(case)
        if case.work == "plain":
            raise OverLimit("ended at 2 GiB")
        if case.work == "one-step":
            raise RowFailed("ended by SIGSEGV")
        return taken(case)

    monkeypatch.setattr(bench_memory, "take", failing)
    assert run([*ARGUMENTS, "--limit-gb", "4.3", "--out", str(tmp_path)]) == 0
    found = {(r["work"], r["tiles"], r["height"]): (r["status"], r["note"]) for r in rows_in(tmp_path)}
    assert len(found) == 20
    assert found["plain", 1, 64] == ("over the limit", "ended at 2 GiB")
    assert found["plain", 1, 128] == ("not tried", "a lower panorama was too much")
    assert found["one-step", 2, 64] == ("died", "ended by SIGSEGV")
    assert found["inference", 1, 128] == ("not tried", "4.5 GiB expected")
    assert found["two-step", 2, 128][0] == "measured"
    assert MemoryCase("plain", 1, 128) not in asked
    assert "not tried: 4.5 GiB expected" in capsys.readouterr().out
    reference = next(r for r in rows_in(tmp_path) if r["work"] == "two-step" and r["height"] == 64)
    assert reference["reference"]  # the first that came to an end


def test_what_failed_is_tried_again_where_it_is_asked_for_and_kept_elsewhere(asked, tmp_path, monkeypatch):
    def failing(case: MemoryCase, *_) -> Taken:
        asked.append(case)
        if case.height == 64 and case.work == "plain":
            raise OverLimit("ended at 2 GiB")
        return taken(case)

    def run_at(height: int, answer) -> list[dict]:
        asked.clear()
        monkeypatch.setattr(bench_memory, "take", answer)
        heights = ["--heights", str(height)]
        assert run([*ARGUMENTS[:4], *heights, *ARGUMENTS[7:], "--out", str(tmp_path)]) == 0
        return rows_in(tmp_path)

    def succeeding(case: MemoryCase, *_) -> Taken:
        asked.append(case)
        return taken(case)

    low = run_at(64, failing)
    failure = next(row for row in low if row["work"] == "plain")
    assert failure["status"] == "over the limit"
    both = run_at(128, failing)
    assert [row for row in both if row["height"] == 64] == low  # the failure too
    assert asked == memory_cases([128], quick=False)  # nothing is concluded from it: the limit may be another now
    again = run_at(64, succeeding)
    assert MemoryCase("plain", 1, 64) in asked and MemoryCase("inference", 1, 64) not in asked
    assert {row["status"] for row in again} == {"measured"} and len(again) == len(both)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--heights", "80"], "multiples of 32"),
        (["--heights", "32"], "64 pixels or more"),
        (["--threads", "0"], "--threads must be at least 1"),
        (["--limit-gb", "0"], "--limit-gb must be positive"),
    ],
)
def test_unusable_arguments_are_refused(asked, arguments, told, capsys):
    assert run(["bench", "memory", "--preset", "tiny", *arguments]) == 2
    assert told in capsys.readouterr().err
    assert asked == []


def test_memory_is_expected_to_grow_with_the_number_of_pixels():
    case = MemoryCase("two-step", 2, 256)
    row = MemoryRow("two-step", 2, 64, "measured", base_gib=0.5, peak_gib=0.75)
    assert expected_gib(case, []) == 0
    assert expected_gib(case, [row]) == pytest.approx(0.5 + 16 * 0.25)
    assert expected_gib(case, [dataclasses.replace(row, tiles=1), dataclasses.replace(row, height=512)]) == 0
    assert expected_gib(case, [MemoryRow("two-step", 2, 128, "died"), row]) == math.inf
    assert expected_gib(MemoryCase("two-step", 2, 1024), [row]) == 0  # only the heads learn there
    tall = dataclasses.replace(row, height=1024)
    assert expected_gib(MemoryCase("two-step", 2, 2048), [tall, row]) == pytest.approx(0.5 + 4 * 0.25)


def test_deviations_are_relative_to_the_reference():
    reference = {"a": torch.tensor([3.0, 0.0]), "b": torch.tensor([4.0])}
    found = {"a": torch.tensor([3.0, 0.3]), "b": torch.tensor([4.0])}
    assert deviation(found, reference, together=True) == pytest.approx(0.06)
    assert deviation(found, reference, together=False) == pytest.approx(0.1)
    with pytest.raises(ValueError, match="needed"):
        deviation({"a": found["a"]}, reference, together=True)


def test_what_was_not_measured_is_blank_and_says_why(tmp_path):
    row = MemoryRow("two-step", 4, 2048, "not tried", "20.0 GiB expected")
    assert memory_cells(row) == ("2048", "two-step", "16", *[""] * 6, "not tried: 20.0 GiB expected")
    assert memory_markdown([row]).count("\n") == 3
    assert not plot_memory([row], tmp_path / "none.png", "nothing")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("status", "said", "kind", "told"),
    [
        (1, "RuntimeError: [enforce fail] can't allocate memory", OverLimit, "no memory left"),
        (1, "torch.OutOfMemoryError: CUDA out of memory. Tried", OverLimit, "no memory left"),
        (-9, "", RowFailed, "ended by SIGKILL"),
        (1, "ValueError: nonsense", RowFailed, "nonsense"),
    ],
)
def test_the_end_of_a_child_is_told_in_words(status, said, kind, told):
    error = _failure(status, said.splitlines())
    assert type(error) is kind and told in str(error)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("memory") / "tiny.safetensors"
    save_random_weights(path, network_config("tiny"))
    return path


def test_a_child_measures_the_gradients_and_their_memory(weights):
    plain, tiled = (
        take(MemoryCase(work, tiles, 64), SETTING, weights) for work, tiles in (("plain", 1), ("two-step", 4))
    )
    assert any(name.startswith("features.") for name in plain.result)
    assert 0 < deviation(tiled.result, plain.result, together=True) < 1e-4
    assert plain.num_gaussians == tiled.num_gaussians == 13848
    assert 0.1 < plain.base_gib < plain.peak_gib < 2
    assert 0.01 < tiled.peak_gib - tiled.base_gib < plain.peak_gib - plain.base_gib


def test_a_child_that_takes_too_much_is_ended(weights):
    with pytest.raises(OverLimit, match=r"ended at 0\.1 GiB"):
        take(MemoryCase("plain", 1, 64), dataclasses.replace(SETTING, limit_gib=0.1), weights)
