"""`pansplat convert`: what it writes and leaves out, and the other commands with weights."""

from pathlib import Path

import torch
from PIL import Image

from pansplat.cli import run
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.networks.weights import load_weights, pack_weights, save_weights
from pansplat.pipeline import load
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat_viewer.core.loader import find_entries, load_entry


def test_converted_weights_have_their_model_and_what_is_left_out_is_named(
    tmp_path, recipe_weights, as_lightning, capsys
):
    official, converted = tmp_path / "official.ckpt", tmp_path / "model.safetensors"
    torch.save(as_lightning(recipe_weights), official)
    assert run(["convert", str(official), "-o", str(converted)]) == 0
    *left_out, summary = capsys.readouterr().out.splitlines()
    assert [line.split(" (")[0] for line in left_out] == ["left out: 5 recomputed grids", "left out: 5 training state"]
    weights = load_weights(converted)
    assert (weights.model, weights.compat, len(weights.tensors)) == ("pansplat", "official", 988)
    assert weights.config["heads"]["candidates"] == 32 and ": 988 tensors, " in summary


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
