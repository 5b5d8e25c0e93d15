"""Predictions that go to a file tile by tile hold what those in memory hold."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat import pipeline
from pansplat.cli import predict, run
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.model import network
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import AdapterConfig, HeadsConfig
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.model.weights import pack_weights, save_weights

HEIGHT = 64
SMALL = PanSplatConfig(
    features=FeaturePyramidConfig(channels=(4, 8, 8, 16), transformer=TransformerConfig(channels=16, blocks=1)),
    cost_volume=CostVolumeConfig(
        mono_channels=0,
        levels=(SweepLevel(3, 16, 8, 32), SweepLevel(2, 8, 4, 32), SweepLevel(1, 8, 4, 32)),
    ),
    heads=HeadsConfig(feature_channels=(16, 8, 8, 4), candidates=4, adapter=AdapterConfig(degree=1)),
)


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """Two panoramas, the lower third of one covered."""
    folder = tmp_path / "pair"
    folder.mkdir()
    random = np.random.default_rng(0)
    poses = {}
    for index, name in enumerate(("a.png", "b.png")):
        pixels = random.integers(1, 255, (HEIGHT, 2 * HEIGHT, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / name)
        poses[name] = np.eye(4).tolist()
        poses[name][0][3] = 0.4 * index
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    mask = np.full((HEIGHT, 2 * HEIGHT), 255, np.uint8)
    mask[40:] = 0
    Image.fromarray(mask).save(folder / "a_mask.png")
    return folder


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small network; panoramas of 64 pixels are cut into four tiles, and count as large."""
    monkeypatch.setattr(network, "_UNTILED_HEIGHT", HEIGHT // 2)
    monkeypatch.setattr(predict, "_MAX_CACHED_HEIGHT", HEIGHT // 2)
    torch.manual_seed(0)
    path = tmp_path / "small.safetensors"
    save_weights(path, pack_weights("pansplat", SMALL, PanSplat(SMALL).state_dict(), compat="fixed"))
    return path


def _sorted_rows(gaussians: Gaussians) -> np.ndarray:
    fields = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.harmonics)
    labels = (gaussians.levels, gaussians.views)
    rows = torch.cat([field.reshape(len(gaussians), -1).float() for field in (*fields, *labels)], dim=1).numpy()
    return rows[np.lexsort(rows.T[::-1])]


def test_the_file_holds_what_a_prediction_in_memory_holds(pair: Path, weights: Path, tmp_path: Path) -> None:
    scene = pipeline.predict(pair, weights, height=HEIGHT, cache=False)
    pipeline.save(scene, tmp_path / "whole.ply")
    whole = pipeline.load(tmp_path / "whole.ply")
    count = pipeline.predict_to_file(pair, tmp_path / "tiles.ply", weights, height=HEIGHT)
    tiles = pipeline.load(tmp_path / "tiles.ply")
    assert count == len(tiles.gaussians) == len(scene.gaussians) > 1000
    assert 0 < int((tiles.gaussians.views == 0).sum()) < int((tiles.gaussians.views == 1).sum())  # masked
    np.testing.assert_array_equal(_sorted_rows(tiles.gaussians), _sorted_rows(whole.gaussians))
    assert not torch.equal(tiles.gaussians.means, whole.gaussians.means)  # in the order of tiles
    assert torch.equal(tiles.cam2world, whole.cam2world)
    assert (tiles.near, tiles.far, tiles.names, tiles.model, tiles.height) == (
        *(whole.near, whole.far, whole.names, whole.model, whole.height),
    )


def test_degree_and_opacity_make_the_file_smaller(pair: Path, weights: Path, tmp_path: Path) -> None:
    pipeline.predict_to_file(pair, tmp_path / "all.ply", weights, height=HEIGHT)
    every = pipeline.load(tmp_path / "all.ply").gaussians
    least = float(every.opacities.median())
    count = pipeline.predict_to_file(pair, tmp_path / "few.ply", weights, height=HEIGHT, degree=0, min_opacity=least)
    few = pipeline.load(tmp_path / "few.ply").gaussians
    assert few.degree == 0 and len(few) == count
    assert abs(count - int((every.opacities >= least).sum())) <= 2  # a logit rounds
    assert float(few.opacities.min()) >= least - 1e-6


def test_the_command_streams_large_predictions(pair: Path, weights: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    command = ["predict", str(pair), "--model", str(weights), "--height", str(HEIGHT), "--degree", "0"]
    monkeypatch.setattr(pipeline, "predict", None)  # all at once it would not fit
    assert run([*command, "-o", str(tmp_path / "tiles.ply")]) == 0
    assert "Gaussians from a, b in" in capsys.readouterr().out
    monkeypatch.undo()
    assert run([*command, "-o", str(tmp_path / "whole.ply"), "--no-cache"]) == 0
    tiles, whole = (pipeline.load(tmp_path / name).gaussians for name in ("tiles.ply", "whole.ply"))
    assert tiles.degree == whole.degree == 0
    np.testing.assert_allclose(_sorted_rows(tiles)[:, 0], _sorted_rows(whole)[:, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--degree", "5"], "--degree must be 0 to 4, got 5"),
        (["--min-opacity", "1"], "--min-opacity must be at least 0 and less than 1"),
        (["--precision", "bfloat16", "--model", "sweep"], "`precision` is for networks"),
    ],
)
def test_unusable_choices_are_refused(pair: Path, tmp_path: Path, arguments, told, capsys) -> None:
    assert run(["predict", str(pair), "-o", str(tmp_path / "a.ply"), *arguments]) == 2
    assert told in capsys.readouterr().err


def test_what_makes_all_at_once_is_refused(pair: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sweep makes all Gaussians at once"):
        pipeline.predict_to_file(pair, tmp_path / "a.ply", "sweep")
    with pytest.raises(InputError, match=r"must end in \.ply"):
        pipeline.predict_to_file(pair, tmp_path / "a.obj", "sweep")
