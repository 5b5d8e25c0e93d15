"""The network's bench: errors against the plain float32 row, one process a row, files that a person reads."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import safetensors.torch
import torch

from pansplat.bench import model as bench_model
from pansplat.bench import model_case, roofline
from pansplat.bench.model import ModelRow, model_cases, psnr, relative_errors
from pansplat.bench.model_case import Measured, ModelCase, measure_case
from pansplat.bench.model_report import model_cells, model_markdown
from pansplat.bench.model_weights import save_random_weights
from pansplat.cli import bench_model as command
from pansplat.cli import run
from pansplat.errors import InputError
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import AdapterConfig, HeadsConfig
from pansplat.model.network import build_network, has_bfloat16
from pansplat.model.pansplat import PanSplatConfig
from pansplat.model.weights import load_weights

SMALL = PanSplatConfig(
    features=FeaturePyramidConfig(channels=(8, 8, 16, 32), transformer=TransformerConfig(channels=32, blocks=2)),
    cost_volume=CostVolumeConfig(
        mono_channels=0, levels=(SweepLevel(3, 32, 16, 32), SweepLevel(2, 16, 8, 32), SweepLevel(1, 8, 8, 32))
    ),
    heads=HeadsConfig(feature_channels=(32, 16, 8, 8), candidates=8, adapter=AdapterConfig(degree=1)),
)
PLAIN = ModelCase("fixed", "float32", "float32", 1, 1)


def _small_weights(path: Path) -> None:
    save_random_weights(path, SMALL)


@pytest.fixture
def no_children(monkeypatch: pytest.MonkeyPatch) -> list[ModelCase]:
    """Answers in place of the children's, each row a little further off; the cases that were asked for."""
    asked: list[ModelCase] = []

    def answer(case: ModelCase, weights: Path, views: Path, *, near: float, far: float) -> Measured:
        assert weights.is_file() and views.is_file() and 0 < near < far
        asked.append(case)
        off = 0.001 * (len(asked) - 1)
        depth, picture = torch.full((2, 32, 64), 2.0 + 2 * off), torch.full((3, 64, 128), 0.5 + off)
        return Measured({"features": 1.0, "mono": 2.0, "cost volume": 3.0, "heads": 4.0}, 17.0, 1.5, 10, depth, picture)

    monkeypatch.setattr(bench_model, "measure_case", answer)
    monkeypatch.setattr(command, "save_random_weights", _small_weights)
    monkeypatch.setattr(command, "has_bfloat16", lambda: True)
    monkeypatch.setattr(roofline, "_STEPS", 1 << 12)
    monkeypatch.setattr(roofline, "_ELEMENTS", 1 << 12)
    return asked


def test_the_command_writes_and_prints_what_was_measured(no_children, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["bench", "model", "--height", "64", "--quick", "--out", str(out), "--threads", "1"]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["model.json", "model.md", "model.png"]
    rows = json.loads((out / "model.json").read_text())["rows"]
    assert len(rows) == len(no_children) == 3
    assert rows[0]["is_reference"] and rows[0]["psnr_db"] is None
    assert (rows[1]["total_s"], rows[1]["processor_s"]) == (10.0, 17.0) and rows[1]["height"] == 64
    assert rows[1]["depth_max_error"] == pytest.approx(0.001, rel=1e-3)
    assert rows[1]["psnr_db"] == pytest.approx(60, abs=0.01)
    assert {row["precision"] for row in rows} == {"float32", "bfloat16"}
    printed = capsys.readouterr().out
    for word in ("random weights", "cost volume s", "reference", "peak GiB", "60.0"):
        assert word in printed


def test_an_interruption_keeps_what_was_measured(no_children, tmp_path, monkeypatch, capsys):
    answer = bench_model.measure_case

    def interrupted(case: ModelCase, *arguments, **others) -> Measured:
        if len(no_children) == 2:
            raise KeyboardInterrupt
        return answer(case, *arguments, **others)

    monkeypatch.setattr(bench_model, "measure_case", interrupted)
    file = tmp_path / "rows.json"
    assert run(["bench", "model", "--height", "64", "--json", str(file)]) == 130
    assert len(json.loads(file.read_text())["rows"]) == 2
    assert "reference" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--height", "80"], "multiple of 64"),
        (["--threads", "0"], "--threads must be at least 1"),
        (["--json", "no/rows.json"], "create it first"),
        (["--pair", "nowhere"], "nowhere is no folder"),
        (["--model", "none.safetensors"], "none.safetensors"),
    ],
)
def test_unusable_arguments_are_refused(no_children, arguments, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(["bench", "model", *arguments]) == 2
    assert told in capsys.readouterr().err
    assert no_children == []


def test_each_compat_begins_with_its_plain_row():
    cases = model_cases(2, bfloat16=True, quick=False)
    assert len(set(cases)) == len(cases)
    for compat in ("fixed", "official"):
        first = next(case for case in cases if case.compat == compat)
        assert dataclasses.replace(first, compat="fixed", threads=1) == PLAIN
    assert {case.tiles for case in cases} == {1, 2, 4} and {case.threads for case in cases} == {1, 2}
    assert all(case.precision == "float32" for case in model_cases(1, bfloat16=False, quick=False))


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    """Weights of a small network, and views of it."""
    folder = tmp_path_factory.mktemp("bench")
    _small_weights(folder / "small.safetensors")
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.5
    images = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    safetensors.torch.save_file({"images": images, "cam2world": poses}, folder / "views.safetensors")
    return folder / "small.safetensors", folder / "views.safetensors"


@pytest.fixture(scope="module")
def plain(files) -> Measured:
    """What a child makes of the plain case."""
    return measure_case(PLAIN, *files, near=0.5, far=10.0)


def test_a_child_measures_what_the_network_gives(files, plain):
    assert list(plain.stages_s) == list(model_case.STAGES)
    assert plain.stages_s["mono"] == 0 and all(plain.stages_s[name] > 0 for name in ("features", "heads"))
    assert plain.peak_gib is None or 0.05 < plain.peak_gib < 2
    network, kept = build_network(load_weights(files[0]), "fixed", files[0]), safetensors.torch.load_file(files[1])
    bounds = torch.full((1, 2), 0.5), torch.full((1, 2), 10.0)
    with torch.no_grad():
        output = network(kept["images"][None], kept["cam2world"][None].float(), *bounds)
    assert relative_errors(plain.depth, output.depths.depth[-1][0])[1] < 1e-4
    assert float(plain.depth.std() / plain.depth.mean()) > 0.01
    assert plain.num_gaussians == len(output.gaussians[0])
    assert plain.picture.shape == (3, 64, 128) and float(plain.picture.std()) > 0.01


def test_tiles_change_next_to_nothing(files, plain):
    tiled = measure_case(dataclasses.replace(PLAIN, tiles=2), *files, near=0.5, far=10.0)
    assert torch.equal(plain.depth, tiled.depth)  # tiles are the heads' affair
    assert psnr(tiled.picture, plain.picture) > 60


@pytest.mark.skipif(not has_bfloat16(), reason="a processor without bfloat16 imitates it slowly")
def test_bfloat16_changes_little(files, plain):
    rounded = measure_case(dataclasses.replace(PLAIN, precision="bfloat16"), *files, near=0.5, far=10.0)
    median, largest = relative_errors(rounded.depth, plain.depth)
    assert 0 < median < 0.02 and largest < 0.5
    assert psnr(rounded.picture, plain.picture) > 25


def test_a_child_that_fails_is_an_error_that_tells_what_it_said(files, tmp_path):
    with pytest.raises(InputError, match=r"a row of the bench failed \(.*FileNotFoundError.*try a smaller --height"):
        measure_case(PLAIN, files[0], tmp_path / "none.safetensors", near=0.5, far=10.0)


def test_random_weights_are_the_same_for_a_seed(tmp_path, files):
    for seed in (0, 1):
        save_random_weights(tmp_path / f"{seed}.safetensors", SMALL, seed=seed)
    first, same, other = (load_weights(file).tensors for file in (files[0], *sorted(tmp_path.iterdir())))
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_errors_are_relative_to_the_reference():
    reference = torch.tensor([1.0, 2.0, 4.0])
    assert relative_errors(torch.tensor([1.0, 2.2, 3.0]), reference) == (pytest.approx(0.1), pytest.approx(0.25))
    assert psnr(reference / 4, reference / 4) == math.inf


def test_what_was_not_measured_is_blank():
    row = ModelRow("fixed", "float32", "float32", 1, 1, 64)
    assert model_cells(row)[5:] == ("",) * 10
    same = dataclasses.replace(row, psnr_db=math.inf, depth_median_error=0.0, depth_max_error=0.0)
    assert model_cells(same)[-3:] == ("0.0e+00", "0.0e+00", "same")
    assert model_markdown([row]).count("\n") == 3
