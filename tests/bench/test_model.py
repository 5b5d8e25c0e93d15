"""`pansplat bench model`: errors against the float32 row, files and tables."""

import dataclasses
import json
from pathlib import Path

import pytest

from pansplat.bench import model as bench_model
from pansplat.bench.model import STAGES, ModelCase, save_random_weights
from pansplat.cli import run
from pansplat.model.network import has_bfloat16
from pansplat.training.network import network_config

TINY = network_config("tiny")
PLAIN = ModelCase("fixed", "float32", "float32", 1, 1)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "tiny.safetensors"
    save_random_weights(path, TINY)
    return path


def test_the_command_measures_predictions_of_the_network(weights, monkeypatch, tmp_path, capsys):
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
