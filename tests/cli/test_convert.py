"""`pansplat convert`, and what it makes at work in the other commands."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from pansplat.cli import run
from pansplat.model.weights import load_weights
from pansplat.pipeline import load
from pansplat_viewer.loader import LoadOptions, find_entries, load_entry

HEIGHT = 64


@pytest.fixture(scope="module")
def content(
    mvsplat_weights: dict[str, Tensor], as_lightning: Callable[[dict[str, Tensor]], dict[str, object]]
) -> dict[str, object]:
    """A checkpoint of the baseline, which is the smaller network."""
    return as_lightning(mvsplat_weights)


@pytest.fixture(scope="module")
def converted(content: dict[str, object], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    torch.save(content, folder / "original.ckpt")
    assert run(["convert", str(folder / "original.ckpt"), "-o", str(folder / "model.safetensors")]) == 0
    return folder / "model.safetensors"


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A folder with a pair of tiny panoramas and the one between them."""
    random = np.random.default_rng(0)
    poses = {}
    for name, x in {"a.png": 0.0, "b.png": 1.0, "c.png": 0.5}.items():
        Image.fromarray(random.integers(0, 255, (HEIGHT, 2 * HEIGHT, 3), dtype=np.uint8)).save(tmp_path / name)
        pose = np.eye(4)
        pose[0, 3] = x
        poses[name] = pose.tolist()
    (tmp_path / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    pairs = [{"context": ["a.png", "b.png"], "target": "c.png"}]
    (tmp_path / "pairs.json").write_text(json.dumps({"pairs": pairs}))
    return tmp_path


def refusal(path: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert run(["convert", str(path), "-o", str(out)]) == 2
    assert not out.exists()
    return capsys.readouterr().err


def test_convert_tells_what_became_of_every_tensor(
    content: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.save(content, tmp_path / "original.ckpt")
    assert run(["convert", str(tmp_path / "original.ckpt"), "-o", str(tmp_path / "m.safetensors")]) == 0
    lines = {line.split("│")[1].strip(): line.split("│")[2].strip() for line in _rows(capsys.readouterr().out)}
    assert lines == {"used": "471", "left out: training state": "5", "unknown": "0", "missing": "0"}


def _rows(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("│")]


def test_converted_weights_say_what_they_are(converted: Path) -> None:
    weights = load_weights(converted)
    assert (weights.model, weights.compat, len(weights.tensors)) == ("mvsplat", "official", 471)
    assert weights.config["candidates"] == 128


def test_converted_weights_work_wherever_a_model_is_named(converted: Path, room: Path) -> None:
    model = ["--model", str(converted)]
    scenes = {}
    for compat in ("trained", "official", "fixed"):
        out = room / f"{compat}.ply"
        arguments = ["predict", str(room), "-o", str(out), "--height", "64", "--compat", compat, *model]
        assert run(arguments) == 0
        scenes[compat] = load(out)
    assert scenes["trained"].model == "mvsplat"
    assert len(scenes["trained"].gaussians) == 2 * 2 * HEIGHT**2
    assert torch.equal(scenes["trained"].gaussians.means, scenes["official"].gaussians.means)
    assert not torch.allclose(scenes["fixed"].gaussians.means, scenes["official"].gaussians.means)
    picture = room / "picture.png"
    arguments = ["render", str(room), "-o", str(picture), "--predict-height", "64", "--height", "16", *model]
    assert run(arguments) == 0
    assert picture.stat().st_size > 0
    results = room / "results"
    assert run(["evaluate", str(room), "-o", str(results), "--height", "64", "--compat", "fixed", *model]) == 0
    assert (results / "results.json").exists()
    options = LoadOptions(model=str(converted), compat="fixed", height=64)
    (entry,) = (entry for entry in find_entries(room, options) if entry.pair is not None)
    viewed = load_entry(entry, options, lambda what, done: None, photos=False).scene
    assert torch.equal(viewed.gaussians.means, scenes["fixed"].gaussians.means)


def test_a_mismatched_checkpoint_is_shown_before_it_is_refused(
    content: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = dict(content["state_dict"])  # type: ignore[call-overload]
    del state["encoder.backbone.backbone.conv1.weight"]
    state["encoder.extra"] = torch.zeros(1)
    torch.save(content | {"state_dict": state}, tmp_path / "odd.ckpt")
    assert run(["convert", str(tmp_path / "odd.ckpt"), "-o", str(tmp_path / "m.safetensors")]) == 2
    out, err = capsys.readouterr()
    assert "encoder.extra" in out and "encoder.backbone.backbone.conv1.weight" in out
    assert "lacked 1 (encoder.backbone.backbone.conv1.weight) and found unknown 1 (encoder.extra)" in err
    assert not (tmp_path / "m.safetensors").exists()


def test_a_poisoned_checkpoint_is_refused_and_not_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mark = tmp_path / "was run"

    class Poison:
        def __reduce__(self) -> tuple[object, ...]:
            return os.mkdir, (str(mark),)

    torch.save({"state_dict": {}, "callbacks": Poison()}, tmp_path / "poisoned.ckpt")
    assert "nothing was run" in refusal(tmp_path / "poisoned.ckpt", tmp_path / "m.safetensors", capsys)
    assert not mark.exists()


def test_a_truncated_checkpoint_is_refused(
    content: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.save(content, tmp_path / "short.ckpt")
    with open(tmp_path / "short.ckpt", "r+b") as file:
        file.truncate(1 << 20)
    assert "got a damaged one; download" in refusal(tmp_path / "short.ckpt", tmp_path / "m.safetensors", capsys)


def test_convert_refuses_other_outputs(converted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    original = converted.with_name("original.ckpt")
    assert "--out must be a .safetensors" in refusal(original, tmp_path / "m.ckpt", capsys)
    assert "existing folder" in refusal(original, tmp_path / "no" / "m.safetensors", capsys)
