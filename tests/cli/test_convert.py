"""`pansplat convert`: what it leaves out, refused checkpoints, and the other commands with the converted weights."""

import contextlib
import io
from pathlib import Path

import pytest
import torch
from PIL import Image

from pansplat.cli import run
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.networks.weights import load_weights, pack_weights, save_weights
from pansplat.pipeline import load
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat_viewer.core.loader import find_entries, load_entry


@pytest.fixture(scope="module")
def content(recipe_weights, as_lightning) -> dict[str, object]:
    """A checkpoint of the network."""
    return as_lightning(recipe_weights)


@pytest.fixture(scope="module")
def conversion(content: dict[str, object], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """The checkpoint, the converted weights, and the output of the command."""
    folder = tmp_path_factory.mktemp("weights")
    official, converted = folder / "official.ckpt", folder / "model.safetensors"
    torch.save(content, official)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert run(["convert", str(official), "-o", str(converted)]) == 0
    return official, converted, printed.getvalue()


def test_the_command_names_what_is_left_out(conversion: tuple[Path, Path, str]) -> None:
    *left_out, summary = conversion[2].splitlines()
    assert [line.split(" (")[0] for line in left_out] == ["left out: 5 recomputed grids", "left out: 5 training state"]
    assert ": 988 tensors, " in summary


def test_converted_weights_have_their_model_and_compat(conversion: tuple[Path, Path, str]) -> None:
    weights = load_weights(conversion[1])
    assert (weights.model, weights.compat, len(weights.tensors)) == ("pansplat", "official", 988)
    assert weights.config["heads"]["candidates"] == 32


def test_all_commands_and_the_viewer_take_weights(tmp_path: Path, write_room, small_config: PanSplatConfig) -> None:
    room, weights = write_room(tmp_path / "room"), tmp_path / "small.safetensors"
    torch.manual_seed(0)
    tensors = PanSplat(small_config, "official").state_dict()
    save_weights(weights, pack_weights("pansplat", small_config, tensors, compat="official"))

    def run_on_room(command: str, out: Path, *arguments: str) -> None:
        assert run([command, str(room), "-o", str(out), "--model", str(weights), *arguments]) == 0

    scenes = {}
    for compat in ("trained", "fixed"):
        out = tmp_path / f"{compat}.ply"
        run_on_room("predict", out, "--height", "64", "--compat", compat)
        scenes[compat] = load(out)
    assert scenes["trained"].model == "pansplat"
    assert set(scenes["trained"].gaussians.levels.tolist()) == {0, 1, 2, 3}
    assert not torch.allclose(scenes["fixed"].gaussians.means, scenes["trained"].gaussians.means)
    run_on_room("render", tmp_path / "image.png", "--predict-height", "64", "--height", "16", "--refine", "0")
    with Image.open(tmp_path / "image.png") as image:
        assert image.height == 16 and len(set(image.convert("L").getextrema())) == 2
    run_on_room("evaluate", tmp_path / "results", "--height", "64", "--compat", "fixed")
    assert (tmp_path / "results" / "results.json").exists()
    options = PredictOptions(str(weights), "fixed", height=64, refine_steps=0)
    (entry,) = (entry for entry in find_entries(room, ReadOptions(), options) if entry.pair is not None)
    viewed = load_entry(entry, options).scene
    assert torch.equal(viewed.gaussians.means, scenes["fixed"].gaussians.means)


def test_a_truncated_checkpoint_is_refused(conversion: tuple[Path, Path, str], tmp_path: Path, refusal) -> None:
    with conversion[0].open("rb") as official:
        (tmp_path / "short.ckpt").write_bytes(official.read(1 << 20))
    message = refusal("convert", tmp_path / "short.ckpt", "-o", tmp_path / "m.safetensors")
    assert "got a damaged one; download" in message
    assert not (tmp_path / "m.safetensors").exists()
