"""UniFuse: agreement with the official code, and equivariance of the fixed network under half a turn."""

import types

import pytest
import torch
from torch import Tensor

from pansplat.model.mono_depth import Decoder, MonocularDepth, ResNet18
from pansplat.model.network import build_network

_CHANNELS = {5: 512, 4: 256, 3: 128, 2: 64, 1: 64}


def _noise(*shape: int, seed: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _seeded(module: torch.nn.Module) -> torch.nn.Module:
    """A module with the same random weights and statistics every time."""
    generator = torch.Generator().manual_seed(5)
    for tensor in module.state_dict().values():
        if tensor.is_floating_point():
            fan_in = max(1, tensor[0].numel()) if tensor.ndim > 1 else 1
            tensor.copy_(torch.rand(tensor.shape, generator=generator) * (3 / fan_in) ** 0.5)
    return module.double().eval()


@pytest.mark.shared
def test_features_and_depth_match_the_official_code(run_official, golden, error) -> None:
    truth, run = golden("pansplat_64x128_fp32attn"), run_official()
    panoramas, strips = run.network.mono_depth.prepare_inputs(truth["in.image"][0])
    assert error(panoramas[..., ::8, ::8], truth["in.mono_image_sub"][0]) < 2e-4
    assert error(strips[..., ::8, ::8], truth["in.cube_image_sub"][0]) < 2e-4
    features = run.outputs["mono_depth"]
    assert features.shape == (1, 2, 32, 256, 512) and not features.requires_grad
    assert error(features[..., ::16, ::16], truth["mono.feat_sub"]) < 2e-4
    depth = run.network.mono_depth.depth(features)
    assert error(depth[..., ::8, ::8], truth["mono.pred_depth_sub"]) < 2e-4


@pytest.mark.slow
@pytest.mark.shared
def test_rolling_the_panorama_by_half_a_turn_rolls_the_features(official_weights, golden, error) -> None:
    network = build_network(official_weights, "fixed", "recipe").mono_depth
    images = golden("pansplat_64x128_fp32attn")["in.image"][:, :1]
    assert error(network(images.roll(64, dims=-1)), network(images).roll(256, dims=-1)) < 1e-3


def test_the_network_stays_frozen_in_training_mode() -> None:
    with torch.device("meta"):
        network = MonocularDepth().train()
    assert not any(module.training for module in network.modules())
    assert not any(parameter.requires_grad for parameter in network.parameters())


def test_the_fixed_input_wraps_and_the_official_one_does_not() -> None:
    image = _noise(1, 3, 16, 32, seed=0)
    for compat, wraps in (("fixed", True), ("official", False)):
        network = types.SimpleNamespace(compat=compat)  # `prepare_inputs` reads nothing else
        before, after = (MonocularDepth.prepare_inputs(network, i)[0] for i in (image, image.roll(16, dims=-1)))
        assert torch.allclose(after, before.roll(512, dims=-1), atol=1e-12) == wraps


def test_rolling_the_panorama_rolls_its_encoding() -> None:
    encoder, image = _seeded(ResNet18("sphere")), _noise(1, 3, 64, 128, seed=1)
    with torch.no_grad():
        before, after = encoder(image), encoder(image.roll(64, dims=-1))
    for scale, maps in before.items():
        assert maps.shape == (1, _CHANNELS[scale], 64 >> scale, 128 >> scale)
        assert torch.allclose(after[scale], maps.roll(64 >> scale, dims=-1), rtol=1e-9)


def test_rolling_a_face_does_not_roll_its_encoding() -> None:
    encoder, image = _seeded(ResNet18("zeros")), _noise(1, 3, 64, 64, seed=2)
    with torch.no_grad():
        before, after = encoder(image)[1], encoder(image.roll(32, dims=-1))[1]
    assert not torch.allclose(after, before.roll(16, dims=-1), rtol=1e-3)


def test_rolling_the_features_rolls_the_decoded_maps() -> None:
    decoder = _seeded(Decoder("sphere"))
    parts = [
        {s: _noise(1, channels, 64 >> s, 128 >> s, seed=10 * seed + s) for s, channels in _CHANNELS.items()}
        for seed in (1, 2)
    ]
    rolled = [{scale: maps.roll(64 >> scale, dims=-1) for scale, maps in part.items()} for part in parts]
    with torch.no_grad():
        before, after = decoder(*parts), decoder(*rolled)
        assert before.shape == (1, 32, 32, 64)
        assert torch.allclose(after, before.roll(32, dims=-1), rtol=1e-9)
        assert torch.allclose(decoder.head(after), decoder.head(before).roll(64, dims=-1), rtol=1e-9)
