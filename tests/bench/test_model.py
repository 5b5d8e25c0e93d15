"""`pansplat bench model`: errors against the float32 row, one process per row, files and tables."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import safetensors.torch
import torch

from pansplat.bench import model as bench_model
from pansplat.bench.model import (
    STAGES,
    ModelCase,
    compare_predictions,
    list_model_cases,
    measure_case,
    save_random_weights,
)
from pansplat.cli import run
from pansplat.errors import InputError
from pansplat.model import network as model_network
from pansplat.model.network import build_network, has_bfloat16
from pansplat.model.weights import load_weights
from pansplat.training.network import network_config

TINY = network_config("tiny")
PLAIN = ModelCase("fixed", "float32", "float32", 1, 1)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[ModelCase]:
    """The measured cases; results are made up, with an error that increases from row to row."""
    cases: list[ModelCase] = []

    def measure(case: ModelCase, weights: Path, views: Path, *, near: float, far: float) -> tuple:
        assert weights.is_file() and views.is_file() and 0 < near < far
        cases.append(case)
        error = 0.001 * (len(cases) - 1)
        stages = {"features": 1.0, "mono": 2.0, "cost volume": 3.0, "heads": 4.0}
        tensors = {"depth": torch.full((2, 32, 64), 2.0 + 2 * error), "image": torch.full((3, 64, 128), 0.5 + error)}
        numbers = {"height": 64, "num_gaussians": 10, "total_s": 10.0, "processor_s": 17.0, "peak_gib": 1.5}
        return numbers | {"stages_s": stages}, tensors

    monkeypatch.setattr(bench_model, "measure_case", measure)
    monkeypatch.setattr(bench_model, "save_random_weights", lambda path: save_random_weights(path, TINY))
    monkeypatch.setattr(model_network, "has_bfloat16", lambda: True)
    return cases


def test_the_command_writes_and_prints_the_rows(measured, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["bench", "model", "--height", "64", "--quick", "--out", str(out), "--threads", "1"]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["model.json", "model.md", "model.png"]
    rows = json.loads((out / "model.json").read_text())["rows"]
    assert len(rows) == len(measured) == 3
    assert rows[0]["is_reference"] and "psnr_db" not in rows[0]
    assert (rows[1]["total_s"], rows[1]["processor_s"]) == (10.0, 17.0) and rows[1]["height"] == 64
    assert rows[1]["depth_max_error"] == pytest.approx(0.001, rel=1e-3)
    assert rows[1]["psnr_db"] == pytest.approx(60, abs=0.01)
    assert {row["precision"] for row in rows} == {"float32", "bfloat16"}
    printed = capsys.readouterr().out
    for word in ("cost volume s", "reference", "peak GiB", "60.0"):
        assert word in printed
    assert "random" in json.loads((out / "model.json").read_text())["weights"]


def test_each_compat_begins_with_its_reference():
    cases = list_model_cases(2, bfloat16=True, quick=False)
    assert len(set(cases)) == len(cases)
    for compat in ("fixed", "official"):
        first = next(case for case in cases if case.compat == compat)
        assert dataclasses.replace(first, compat="fixed", threads=1) == PLAIN
    assert {case.tiles for case in cases} == {1, 2, 4} and {case.threads for case in cases} == {2}
    assert all(case.precision == "float32" for case in list_model_cases(1, bfloat16=False, quick=False))


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    """Weights of a small network, and views for it."""
    folder = tmp_path_factory.mktemp("bench")
    save_random_weights(folder / "tiny.safetensors", TINY)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.5
    images = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    safetensors.torch.save_file({"images": images, "cam2world": poses}, folder / "views.safetensors")
    return folder / "tiny.safetensors", folder / "views.safetensors"


def predict(files: tuple[Path, Path], **case) -> tuple[dict, dict[str, torch.Tensor]]:
    """The values and tensors of a case, measured in this process."""
    job = {"case": dataclasses.asdict(dataclasses.replace(PLAIN, **case)), "near": 0.5, "far": 10.0}
    return bench_model._measure_job(job | {"weights": str(files[0]), "views": str(files[1])})


@pytest.fixture(scope="module")
def plain(files) -> tuple:
    """The values and the tensors of the plain case."""
    return predict(files)


def test_the_prediction_of_the_network_is_measured(files, plain):
    result, tensors = plain
    assert list(result["stages_s"]) == list(STAGES)
    assert result["stages_s"]["mono"] == 0 and all(result["stages_s"][name] > 0 for name in ("features", "heads"))
    assert result["total_s"] == pytest.approx(sum(result["stages_s"].values())) and result["processor_s"] > 0
    assert 0.05 < result.get("peak_gib", 1) < 8
    network, views = build_network(load_weights(files[0]), "fixed", files[0]), safetensors.torch.load_file(files[1])
    bounds = torch.full((1, 2), 0.5), torch.full((1, 2), 10.0)
    with torch.no_grad():
        output = network(views["images"][None], views["cam2world"][None].float(), *bounds)
    expected = {"depth": output.depths.depth[-1][0], "image": tensors["image"]}
    assert compare_predictions(tensors, expected)["depth_max_error"] < 1e-4
    assert float(tensors["depth"].std() / tensors["depth"].mean()) > 0.01
    assert result["num_gaussians"] == len(output.gaussians[0]) and result["height"] == 64
    assert tensors["image"].shape == (3, 64, 128) and float(tensors["image"].std()) > 0.01


def test_tiles_hardly_change_the_prediction(files, plain):
    _, tiled = predict(files, tiles=2)
    assert torch.equal(plain[1]["depth"], tiled["depth"])  # only the heads are tiled
    assert compare_predictions(tiled, plain[1])["psnr_db"] > 60


@pytest.mark.skipif(not has_bfloat16(), reason="emulated bfloat16 is slow")
def test_bfloat16_changes_the_prediction_a_little(files, plain):
    errors = compare_predictions(predict(files, precision="bfloat16")[1], plain[1])
    assert 0 < errors["depth_median_error"] < 0.02 and errors["depth_max_error"] < 0.5
    assert errors["psnr_db"] > 25


def test_depth_errors_are_relative_to_the_reference():
    image = torch.full((3, 1, 3), 0.5)
    reference = {"depth": torch.tensor([1.0, 2.0, 4.0]), "image": image}
    found = compare_predictions({"depth": torch.tensor([1.0, 2.2, 3.0]), "image": image}, reference)
    assert found == pytest.approx({"depth_median_error": 0.1, "depth_max_error": 0.25, "psnr_db": math.inf})


@pytest.mark.slow
def test_the_error_of_a_child_is_passed_on(files, tmp_path):
    with pytest.raises(InputError, match=r"a row of the bench failed \(.*FileNotFoundError.*try a smaller --height"):
        measure_case(PLAIN, files[0], tmp_path / "none.safetensors", near=0.5, far=10.0)


def test_random_weights_depend_on_the_seed_only(tmp_path, files):
    for seed in (0, 1):
        save_random_weights(tmp_path / f"{seed}.safetensors", TINY, seed=seed)
    first, same, other = (load_weights(file).tensors for file in (files[0], *sorted(tmp_path.iterdir())))
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)
