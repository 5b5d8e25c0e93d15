"""Network predictors: batches, masks, tiles, streams, fingerprints, refusals, loading from files of weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import pytest
import torch
from fake_card import CARD, pretend_card
from refusals import expect_error
from torch import Tensor

from pansplat.errors import InputWarning
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import uv_from_directions
from pansplat.geometry.fibonacci import lattice_size
from pansplat.model.heads import TileGaussians
from pansplat.model.network import (
    NetworkPredictor,
    build_network,
    convert_checkpoint,
    load_network_predictor,
    remove_masked_gaussians,
    require_precision,
)
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.networks.weights import WeightsFile, pack_weights, save_weights
from pansplat.pipeline import load_model
from pansplat.sweep.guided_sweep import default_weights
from pansplat.system.progress import show_progress

_PER_VIEW = sum(lattice_size(128 >> level) for level in range(4))


def _predictor(config: PanSplatConfig, compat="fixed", tiles: int | None = None, seed: int = 0) -> NetworkPredictor:
    torch.manual_seed(seed)
    return NetworkPredictor("small", PanSplat(config, compat), tiles=tiles)


@pytest.fixture(scope="module")
def predictor(small_config) -> NetworkPredictor:
    return _predictor(small_config)


@pytest.fixture(scope="module")
def prediction(predictor) -> Gaussians:
    """The prediction from `_inputs()`."""
    return predictor(*_inputs(), 0.5, 20.0)


def _inputs(height: int = 64, views: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    poses = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    poses[:, :3, 3] = 0.3 * torch.randn(views, 3, generator=generator, dtype=torch.float64)
    return torch.rand(views, 3, height, 2 * height, generator=generator), poses


def test_a_batch_gives_a_list_of_the_predictions_of_its_items(predictor, prediction):
    images, poses = _inputs()
    assert isinstance(prediction, Gaussians) and len(prediction) == 2 * _PER_VIEW
    both = predictor(torch.stack((images.flip(0), images)), torch.stack((poses, poses)), torch.tensor((1.0, 0.5)), 20.0)
    assert isinstance(both, list) and len(both) == 2
    assert torch.equal(both[1].means, prediction.means)
    assert not torch.equal(both[0].means, prediction.means)


def test_masks_remove_only_the_gaussians_of_masked_pixels(predictor, prediction):
    images, poses = _inputs()
    masks = torch.ones(2, 64, 128, dtype=torch.bool)
    masks[1, 40:] = False
    kept = predictor(images, poses, 0.5, 20.0, masks=masks)
    assert int((kept.views == 0).sum()) == _PER_VIEW
    assert 0.3 * _PER_VIEW < int((kept.views == 1).sum()) < 0.8 * _PER_VIEW
    local = kept.means[kept.views == 1] - poses[1, :3, 3].float()
    assert float(uv_from_directions(local)[:, 1].max()) * 64 < 40.01
    first, second = (g.select(g.views == 0) for g in (prediction, kept))
    assert torch.equal(first.means, second.means)
    assert len(remove_masked_gaussians(prediction, poses, ~torch.ones_like(masks))) == 0


def test_a_stream_yields_the_same_gaussians_tile_by_tile_and_its_progress(small_config):
    predictor, (images, poses) = _predictor(small_config, tiles=2), _inputs()
    masks = torch.ones(2, 64, 128, dtype=torch.bool)
    masks[0, :20] = False
    untiled = predictor(images, poses, 0.5, 20.0, masks=masks)
    reports: list[tuple[str, float]] = []
    with show_progress(lambda *report: reports.append(report)):
        parts = list(predictor.stream(images, poses, 0.5, 20.0, masks=masks))
    assert len(parts) == 4 and all(len(part) > 0 for part in parts)
    fractions = [fraction for _, fraction in reports]
    assert fractions == sorted(fractions) and fractions[0] == 0 and reports[-1] == ("done", 1.0)
    assert {stage for stage, _ in reports} == {"matching views", "making Gaussians", "done"}
    streamed = Gaussians.cat(parts)
    assert len(streamed) == len(untiled)
    for name in ("means", "opacities"):
        a, b = (getattr(g, name).reshape(len(g), -1).sort(dim=0).values for g in (untiled, streamed))
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5)


def test_predictions_carry_no_gradient(predictor, prediction):
    images, poses = _inputs()
    assert not prediction.means.requires_grad
    assert not next(predictor.stream(images.requires_grad_(), poses, 0.5, 20.0)).means.requires_grad
    assert torch.is_grad_enabled()


def test_the_fingerprint_depends_on_weights_settings_compatibility_and_precision(small_config, file):
    other = dataclasses.replace(small_config, heads=dataclasses.replace(small_config.heads, depth="swept"))
    predictors = (
        _predictor(small_config),
        _predictor(small_config, seed=1),
        _predictor(small_config, "official"),
        _predictor(other),
        load_network_predictor(file, attention_precision="bfloat16"),
    )
    assert len({predictor.fingerprint for predictor in predictors}) == 5
    assert _predictor(small_config).fingerprint == predictors[0].fingerprint


# Refusals


@pytest.fixture
def refuse(small_config, unchecked):
    """Check that a prediction is refused with a message."""

    def check(match: str, images: torch.Tensor, poses: torch.Tensor, near=0.5, far=20.0, compat="fixed", **options):
        expect_error(match, lambda: _predictor(small_config, compat)(images, poses, near, far, **options))

    return check


def test_wrong_shapes_and_values_are_refused(refuse):
    images, poses = _inputs()
    refuse(r"must be \(view, 3, height, 2 \* height\), got \(2, 3, 64, 64\)", images[..., :64], poses)
    refuse(r"`cam2world` must be \(2, 4, 4\) to fit the images, got \(1, 4, 4\)", images, poses[:1])
    refuse(r"`masks` must be \(2, 64, 128\)", images, poses, masks=torch.ones(2, 32, 64, dtype=torch.bool))
    refuse("at least 64 pixels high", *_inputs(32))
    refuse("must be finite, got NaN", images.index_fill(-1, torch.tensor(3), float("nan")), poses)
    for near, far in ((3.0, 2.0), (0.0, 20.0)):
        refuse("0 < near < far", images, poses, near=near, far=far)
    refuse("bring them to a world of metres", images, poses, near=500.0, far=9000.0)
    refuse("one number, or one number per view", images, poses, near=torch.ones(3))


@pytest.mark.parametrize(("height", "compat"), [(67, "fixed"), (70, "official")])
def test_any_height_is_predicted_from(small_config, height: int, compat: Literal["official", "fixed"]) -> None:
    images, poses = _inputs(height)
    masks = torch.ones(2, height, 2 * height, dtype=torch.bool)
    gaussians = _predictor(small_config, compat)(images, poses, 0.5, 20.0, masks=masks)
    assert isinstance(gaussians, Gaussians) and len(gaussians) > 0
    assert gaussians.means.isfinite().all()


@pytest.mark.parametrize(("failures", "tried"), [(1, [1, 2]), (3, [1, 2, 4, 1])])
def test_out_of_a_cards_memory_a_network_has_more_tiles_and_then_the_processor(
    small_config, prediction: Gaussians, monkeypatch: pytest.MonkeyPatch, failures: int, tried: list[int]
) -> None:
    predictor, given = _predictor(small_config), []
    lift = predictor.network.lift_gaussians

    def lift_gaussians(matched, *, tiles: int):
        given.append(tiles)
        if len(given) <= failures:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return lift(matched, tiles=tiles)

    monkeypatch.setattr(predictor.network, "lift_gaussians", lift_gaussians)
    with pytest.warns(InputWarning, match="small: the graphics card has too little memory; ") as notes:
        gaussians = predictor(*_inputs(), 0.5, 20.0)
    ending = "it runs on the processor" if tried[-1] == 1 else f"{tried[-1]}x{tried[-1]} tiles"
    assert given == tried and len(notes) == failures and str(notes[-1].message).endswith(ending)
    assert len(gaussians) == len(prediction)


@pytest.mark.parametrize("full_after", [0, 1, 3])
def test_out_of_a_cards_memory_the_processor_makes_the_tiles_that_are_left(
    small_config, prediction: Gaussians, monkeypatch: pytest.MonkeyPatch, full_after: int
) -> None:
    predictor = _predictor(small_config, tiles=2)
    lift = predictor.network.lift_gaussians

    def lift_gaussians(matched, *, tiles: int) -> Iterator[TileGaussians]:
        for done, part in enumerate(lift(matched, tiles=tiles)):
            if done == full_after and part.gaussians[0].means.device == CARD:
                raise torch.cuda.OutOfMemoryError("CUDA out of memory")
            yield part

    monkeypatch.setattr(predictor.network, "lift_gaussians", lift_gaussians)
    for predict in (predictor, lambda *inputs: Gaussians.cat(list(predictor.stream(*inputs)))):
        with pretend_card(), pytest.warns(InputWarning, match="too little memory; ") as notes:
            predictor.network.to(CARD)
            made = predict(*_inputs(), 0.5, 20.0)
        assert str(notes[-1].message).endswith("it runs on the processor")
        assert len(notes) == (1 if full_after else 3) and len(made) == len(prediction)
        assert made.means.sort(dim=0).values.allclose(prediction.means.sort(dim=0).values, atol=1e-4)


# Loading


@pytest.fixture
def file(tmp_path: Path, small_config: PanSplatConfig) -> Path:
    """Weights of a small network that was trained with compat="fixed"."""
    torch.manual_seed(3)
    path = tmp_path / "small.safetensors"
    save_weights(path, pack_weights("pansplat", small_config, PanSplat(small_config).state_dict(), compat="fixed"))
    return path


def _network_of(predictor: object) -> torch.nn.Module:
    assert isinstance(predictor, NetworkPredictor)
    return predictor.network


def test_weights_load_with_the_compat_of_their_training_by_default(file: Path) -> None:
    assert _network_of(load_model(file)).compat == "fixed"
    assert _network_of(load_model(str(file), compat="fixed")).compat == "fixed"
    assert _network_of(load_model(file, compat="official")).compat == "official"


def test_a_loaded_network_predicts_as_the_saved_one(file: Path, small_config: PanSplatConfig) -> None:
    torch.manual_seed(3)
    saved = NetworkPredictor("pansplat", PanSplat(small_config))
    loaded = load_network_predictor(file)
    assert loaded.name == "pansplat"
    assert loaded.fingerprint == saved.fingerprint
    means, expected = (predictor(*_inputs(), 0.5, 10.0).means for predictor in (loaded, saved))
    assert torch.allclose(means, expected, rtol=1e-4, atol=1e-5)


def test_loading_draws_no_random_numbers_and_fills_every_tensor(file: Path) -> None:
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    network = _network_of(load_network_predictor(file))
    assert torch.equal(torch.rand(3), expected)
    held = [*network.parameters(), *network.buffers()]
    assert not any(tensor.is_meta for tensor in held)
    assert not any(module.training for module in network.modules())


def test_a_checkpoint_and_its_converted_file_load_equally(
    tmp_path: Path, recipe_weights: dict[str, Tensor], as_lightning: Callable[[dict[str, Tensor]], dict[str, object]]
) -> None:
    content = as_lightning(recipe_weights)
    torch.save(content, tmp_path / "original.ckpt")
    save_weights(tmp_path / "converted.safetensors", convert_checkpoint(content, "original.ckpt"))
    first, second = load_model(tmp_path / "original.ckpt"), load_model(tmp_path / "converted.safetensors")
    assert _network_of(first).compat == _network_of(second).compat == "official"
    assert first.fingerprint == second.fingerprint


def test_files_that_fit_no_network_are_refused(small_config: PanSplatConfig, unchecked: None) -> None:
    tensors = PanSplat(small_config).state_dict()
    good = pack_weights("pansplat", small_config, tensors, compat="fixed")
    wider = good.config | {"features": good.config["features"] | {"transformer": {"channels": 32, "blocks": 2}}}
    odd: list[tuple[WeightsFile, str]] = [
        (dataclasses.replace(good, model="mvsplat"), "needed weights of pansplat, got weights of 'mvsplat'"),
        (dataclasses.replace(good, config={"channels": 16}), r"x: config: needed the settings of this version"),
        (dataclasses.replace(good, config=good.config | {"features": 3}), "features: needed an object"),
        (dataclasses.replace(good, config=good.config | {"heads": good.config["heads"] | {"candidates": 7}}), "got 7"),
        (dataclasses.replace(good, tensors=tensors | {"new": torch.zeros(1)}), r"found unknown 1 \(new\)"),
        (dataclasses.replace(good, config=wider), r"got \d+ \(features\.transformer"),
    ]
    for weights, message in odd:
        expect_error(message, build_network, weights, "fixed", "x")


def test_invalid_choices_are_refused(file: Path, unchecked: None) -> None:
    expect_error("`compat` must be one of trained, official, fixed, got 'broken'", load_model, file, compat="broken")
    expect_error("`compat` is for networks, and sweep is not one", load_model, "sweep", compat="fixed")
    expect_error("`config` is for networks, and default is not one", load_model, "default", config=None)
    expect_error(r"`precision` .*model\.safetensors", lambda: load_model(default_weights(), precision="bfloat16"))
    expect_error("got no file", lambda: load_model(file.with_name("other.safetensors")))
    expect_error(r"\.safetensors, .*got .*scene\.ply", lambda: load_model(file.with_name("scene.ply")))


def test_a_processor_without_bfloat16_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_f": True, "avx512_bf16": False})
    expect_error(r"got one without them; use float32", require_precision, "bfloat16")
    require_precision("float32")
    expect_error("float32 or bfloat16, got 'float16'", require_precision, "float16")
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    require_precision("bfloat16")
