"""From a file of weights to a predictor, whichever kind of file, as it was trained or otherwise."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.model.feature_pyramid import TransformerConfig
from pansplat.model.mvsplat import MVSplat, MVSplatConfig
from pansplat.model.network import (
    NetworkPredictor,
    build_empty_network,
    build_network,
    convert_checkpoint,
    load_predictor,
)
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.model.weights import WeightsFile, pack_weights, save_weights
from pansplat.pipeline import load_model

Wrap = Callable[[dict[str, Tensor]], dict[str, object]]
SMALL = MVSplatConfig(channels=16, candidates=8, width=32, transformer=TransformerConfig(channels=16, blocks=2))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Weights of a small network that was trained without the original's defects."""
    torch.manual_seed(3)
    path = tmp_path / "small.safetensors"
    save_weights(path, pack_weights("mvsplat", SMALL, MVSplat(SMALL).state_dict(), compat="fixed"))
    return path


def inputs() -> tuple[Tensor, Tensor, float, float]:
    images = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.5
    return images, poses, 0.5, 10.0


def network_of(predictor: object) -> torch.nn.Module:
    assert isinstance(predictor, NetworkPredictor)
    return predictor.network


def test_weights_load_as_they_were_trained_unless_told_otherwise(file: Path) -> None:
    assert network_of(load_model(file)).compat == "fixed"
    assert network_of(load_model(str(file), compat="fixed")).compat == "fixed"
    assert network_of(load_model(file, compat="official")).compat == "official"


def test_a_loaded_network_predicts_what_the_saved_one_did(file: Path) -> None:
    torch.manual_seed(3)
    saved = NetworkPredictor("mvsplat", MVSplat(SMALL))
    loaded = load_predictor(file)
    assert loaded.name == "mvsplat"
    assert loaded.fingerprint == saved.fingerprint
    assert torch.equal(loaded(*inputs()).means, saved(*inputs()).means)


def test_compat_changes_the_prediction_and_the_fingerprint(file: Path) -> None:
    fixed, official = load_predictor(file, "fixed"), load_predictor(file, "official")
    assert fixed.fingerprint != official.fingerprint
    assert not torch.allclose(fixed(*inputs()).means, official(*inputs()).means)


def test_loading_draws_no_random_numbers_and_leaves_nothing_empty(file: Path) -> None:
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    network = network_of(load_predictor(file))
    assert torch.equal(torch.rand(3), expected)
    held = [*network.parameters(), *network.buffers()]
    assert not any(tensor.is_meta for tensor in held)
    assert not any(module.training for module in network.modules())


def test_a_checkpoint_loads_as_the_original_and_as_what_it_converts_to(
    tmp_path: Path, mvsplat_weights: dict[str, Tensor], as_lightning: Wrap
) -> None:
    content = as_lightning(mvsplat_weights)
    torch.save(content, tmp_path / "original.ckpt")
    save_weights(tmp_path / "converted.safetensors", convert_checkpoint(content, "original.ckpt"))
    first, second = load_model(tmp_path / "original.ckpt"), load_model(tmp_path / "converted.safetensors")
    assert network_of(first).compat == network_of(second).compat == "official"
    assert first.fingerprint == second.fingerprint


def test_a_converted_pansplat_predicts_the_originals_gaussians(
    recipe_weights: dict[str, Tensor], as_lightning: Wrap, golden: Callable[[str], dict[str, Tensor]]
) -> None:
    weights = convert_checkpoint(as_lightning(recipe_weights), "recipe.ckpt")
    predictor = NetworkPredictor("pansplat", build_network(weights, weights.compat, "recipe.ckpt"))
    expected = golden("pansplat_64x128_fp32attn")
    scene = (expected["in.image"][0], expected["in.extrinsics"][0], expected["in.near"][0], expected["in.far"][0])
    gaussians, depths = predictor.predict_with_depths(*scene)
    for stage in range(3):
        theirs = expected[f"s{stage}.depth"][0]
        assert (depths[stage] - theirs).abs().max() < 2e-4 * theirs.std()
    for stage in range(4):
        for view in range(2):
            own = gaussians.select((gaussians.levels == 3 - stage) & (gaussians.views == view))
            for name in ("means", "covariances", "opacities", "scales"):
                theirs = expected[f"g.s{stage}.v{view}.{name}"]
                assert (getattr(own, name) - theirs).abs().max() < 2e-4 * theirs.std(), (stage, view, name)


def test_every_switch_of_a_config_comes_back(tmp_path: Path) -> None:
    config = PanSplatConfig()
    heads = dataclasses.replace(config.heads, lattice="pixel", residual=False)
    config = dataclasses.replace(config, heads=heads)
    network = build_empty_network(pack_weights("pansplat", config, {}, compat="fixed"), "fixed", "x")
    assert isinstance(network, PanSplat) and network.config == config


def test_files_that_fit_no_network_are_refused(file: Path, unchecked: None) -> None:
    tensors = MVSplat(SMALL).state_dict()
    good = pack_weights("mvsplat", SMALL, tensors, compat="fixed")
    odd: list[tuple[WeightsFile, str]] = [
        (dataclasses.replace(good, model="splatter"), "needed weights of pansplat or mvsplat, got of 'splatter'"),
        (dataclasses.replace(good, config={"channels": 16}), r"x: config: needed the settings of this version"),
        (dataclasses.replace(good, config=good.config | {"transformer": 3}), "needed settings by name, got 3"),
        (dataclasses.replace(good, tensors=tensors | {"new": torch.zeros(1)}), r"found unknown 1 \(new\)"),
        (dataclasses.replace(good, config=good.config | {"width": 64}), r"got \d+ \(depth\.shortcut\.weight"),
    ]
    for weights, message in odd:
        with pytest.raises(InputError, match=message):
            build_network(weights, "fixed", "x")


def test_settings_that_contradict_each_other_are_refused() -> None:
    good = pack_weights("pansplat", PanSplatConfig(), {}, compat="fixed")
    wrong = good.config | {"heads": good.config["heads"] | {"candidates": 7}}
    with pytest.raises(InputError, match=r"needed settings of a pansplat network, got .*candidates"):
        build_empty_network(dataclasses.replace(good, config=wrong), "fixed", "x")


def test_choices_that_make_no_sense_are_refused(file: Path, unchecked: None) -> None:
    with pytest.raises(InputError, match="`compat` must be one of trained, official, fixed, got 'broken'"):
        load_model(file, compat="broken")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="`compat` is for networks, and sweep is not one"):
        load_model("sweep", compat="fixed")
    with pytest.raises(InputError, match="nothing there"):
        load_model(file.with_name("other.safetensors"))
    with pytest.raises(InputError, match=r"a file of weights \(\.safetensors, \.ckpt, \.pt, \.pth\), got .*scene\.ply"):
        load_model(file.with_name("scene.ply"))
