"""`pansplat bench model`: errors against the float32 row, files and tables."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from pansplat.bench import model as bench_model
from pansplat.bench.model import (
    STAGES,
    ModelCase,
    compare_predictions,
    list_model_cases,
    save_random_weights,
)
from pansplat.cli import run
from pansplat.model.network import build_network, has_bfloat16
from pansplat.model.weights import load_weights
from pansplat.training.network import network_config

TINY = network_config("tiny")
PLAIN = ModelCase("fixed", "float32", "float32", 1, 1)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "tiny.safetensors"
    save_random_weights(path, TINY)
    return path


def test_the_command_measures_predictions_of_the_network(weights, monkeypatch, tmp_path, capsys):
    measured, measure_case = [], bench_model.measure_case

    def measure(case, file, views):
        values, prediction = measure_case(case, file, views)
        measured.append((views, prediction))
        return values, prediction

    monkeypatch.setattr(bench_model, "measure_case", measure)
    monkeypatch.setattr(bench_model, "time_workload", lambda: 0.02)
    cases = [PLAIN, dataclasses.replace(PLAIN, tiles=2)]
    cases += [dataclasses.replace(PLAIN, precision="bfloat16")] * has_bfloat16()
    monkeypatch.setattr(bench_model, "list_model_cases", lambda threads, bfloat16, quick: cases)
    command = ["bench", "model", "--height", "64", "--model", str(weights), "--threads", "1", "--out", str(tmp_path)]
    assert run(command) == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["model.json", "model.md", "model.png"]
    content = json.loads((tmp_path / "model.json").read_text())
    assert content["weights"] == "tiny.safetensors"
    plain, tiled, *rounded = content["rows"]
    assert plain["is_reference"] and "psnr_db" not in plain and plain["height"] == 64
    assert list(plain["stages_s"]) == list(STAGES) and plain["taken_gib"] > 0
    assert plain["stages_s"]["mono"] == 0 and {"processor_s", "total_ratio"} <= plain.keys()
    assert plain["total_s"] == pytest.approx(sum(plain["stages_s"].values()), rel=1e-4)
    assert tiled["depth_max_error"] == 0 and tiled["psnr_db"] > 60  # only the heads are tiled
    for row in rounded:
        assert 0 < row["depth_median_error"] < 0.02 and row["depth_max_error"] < 0.5 and row["psnr_db"] > 25
    printed = capsys.readouterr().out
    for word in ("cost volume s", "reference", "taken GiB", "0.0e+00"):
        assert word in printed
    # The measured prediction is that of the network.
    views, tensors = measured[0]
    bounds = (torch.full((1, 2), bound) for bound in (views.near, views.far))
    with torch.no_grad():
        network = build_network(load_weights(weights), "fixed", weights)
        expected = network(views.images[None], views.cam2world[None].float(), *bounds)
    assert plain["num_gaussians"] == len(expected.gaussians[0])
    depth = {"depth": expected.depths.depth[-1][0], "image": tensors["image"]}
    assert compare_predictions(tensors, depth)["depth_max_error"] < 1e-4
    assert float(tensors["depth"].std() / tensors["depth"].mean()) > 0.01
    assert tensors["image"].shape == (3, 64, 128) and float(tensors["image"].std()) > 0.01


def test_each_compat_begins_with_its_reference():
    cases = list_model_cases(2, bfloat16=True, quick=False)
    assert len(set(cases)) == len(cases)
    for compat in ("fixed", "official"):
        first = next(case for case in cases if case.compat == compat)
        assert dataclasses.replace(first, compat="fixed", threads=1) == PLAIN
    assert {case.tiles for case in cases} == {1, 2, 4} and {case.threads for case in cases} == {2}
    assert {(case.precision, case.tiles) for case in list_model_cases(2, bfloat16=True, quick=True)} == {
        *(("float32", 1), ("bfloat16", 1))
    }
    assert all(case.precision == "float32" for case in list_model_cases(1, bfloat16=False, quick=False))


def test_depth_errors_are_relative_to_the_reference():
    image = torch.full((3, 1, 3), 0.5)
    reference = {"depth": torch.tensor([1.0, 2.0, 4.0]), "image": image}
    found = compare_predictions({"depth": torch.tensor([1.0, 2.2, 3.0]), "image": image}, reference)
    assert found == pytest.approx({"depth_median_error": 0.1, "depth_max_error": 0.25, "psnr_db": math.inf})


def test_random_weights_depend_on_the_seed_only(tmp_path, weights):
    for seed in (0, 1):
        save_random_weights(tmp_path / f"{seed}.safetensors", TINY, seed=seed)
    first, same, other = (load_weights(file).tensors for file in (weights, *sorted(tmp_path.iterdir())))
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)
