"""UniFuse: the original's numbers, and what the corrected network keeps when the panorama rolls."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pansplat.model.mono_depth import Decoder, MonocularDepth, ResNet18

_CHANNELS = {5: 512, 4: 256, 3: 128, 2: 64, 1: 64}


def deviation(ours: Tensor, theirs: Tensor) -> float:
    """Largest difference in standard deviations of the golden tensor."""
    return float((ours - theirs).abs().max() / theirs.std())


def seeded(module: torch.nn.Module) -> torch.nn.Module:
    """A module with the same random weights every time, none of them special."""
    generator = torch.Generator().manual_seed(5)
    for tensor in module.state_dict().values():
        if tensor.is_floating_point():
            fan_in = max(1, tensor[0].numel()) if tensor.ndim > 1 else 1
            tensor.copy_(torch.rand(tensor.shape, generator=generator) * (3 / fan_in) ** 0.5)
    return module.double().eval()


@pytest.fixture(scope="module")
def network(load_recipe: Callable[[torch.nn.Module, str], torch.nn.Module]) -> torch.nn.Module:
    return load_recipe(MonocularDepth("official"), "mono_depth")


@pytest.fixture(scope="module")
def expected(golden: Callable[[str], dict[str, Tensor]]) -> dict[str, Tensor]:
    return golden("pansplat_64x128_fp32attn")


def test_the_encoders_see_what_the_originals_saw(network: MonocularDepth, expected: dict[str, Tensor]) -> None:
    panoramas, strips = network.prepare(expected["in.image"][0])
    assert deviation(panoramas[..., ::8, ::8], expected["in.mono_image_sub"][0]) < 2e-4
    assert deviation(strips[..., ::8, ::8], expected["in.cube_image_sub"][0]) < 2e-4


def test_features_and_depth_are_the_originals(network: MonocularDepth, expected: dict[str, Tensor]) -> None:
    features = network(expected["in.image"])
    assert features.shape == (1, 2, 32, 256, 512)
    assert deviation(features[..., ::16, ::16], expected["mono.feat_sub"]) < 2e-4
    depth = network.depth(features)
    assert deviation(depth[..., ::8, ::8], expected["mono.pred_depth_sub"]) < 2e-4
    assert not features.requires_grad


def test_the_network_is_frozen(network: MonocularDepth) -> None:
    network.train()
    assert not any(module.training for module in network.modules())
    assert not any(parameter.requires_grad for parameter in network.parameters())


def test_the_fixed_input_is_seamless_and_the_originals_is_not() -> None:
    image = torch.rand(1, 3, 16, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rolled = image.roll(16, dims=-1)
    for compat, seamless in (("fixed", True), ("official", False)):
        network = MonocularDepth.prepare(_Only(compat), image)[0]
        turned = MonocularDepth.prepare(_Only(compat), rolled)[0]
        assert torch.allclose(turned, network.roll(512, dims=-1), atol=1e-12) == seamless


class _Only:
    """All that `prepare` asks of its network."""

    def __init__(self, compat: str) -> None:
        self.compat = compat


def test_rolling_the_panorama_by_half_a_turn_rolls_the_features(
    network: MonocularDepth, expected: dict[str, Tensor]
) -> None:
    fixed = MonocularDepth("fixed")
    fixed.load_state_dict(network.state_dict())
    image = expected["in.image"][:, :1]
    features, turned = fixed(image), fixed(image.roll(64, dims=-1))
    assert deviation(turned, features.roll(256, dims=-1)) < 1e-3


def test_rolling_the_panorama_rolls_its_encoding() -> None:
    encoder = seeded(ResNet18("sphere"))
    image = torch.rand(1, 3, 64, 128, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    with torch.no_grad():
        before, after = encoder(image), encoder(image.roll(64, dims=-1))
    for scale, maps in before.items():
        assert maps.shape == (1, _CHANNELS[scale], 64 >> scale, 128 >> scale)
        assert torch.allclose(after[scale], maps.roll(64 >> scale, dims=-1), rtol=1e-9)


def test_faces_do_not_see_beyond_their_border() -> None:
    encoder = seeded(ResNet18("zeros"))
    image = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    with torch.no_grad():
        before, after = encoder(image)[1], encoder(image.roll(32, dims=-1))[1]
    assert not torch.allclose(after, before.roll(16, dims=-1), rtol=1e-3)


def test_rolling_the_features_rolls_what_is_decoded() -> None:
    decoder = seeded(Decoder("sphere"))
    generator = torch.Generator().manual_seed(3)

    def maps() -> dict[int, Tensor]:
        return {
            scale: torch.rand(1, channels, 64 >> scale, 128 >> scale, generator=generator, dtype=torch.float64)
            for scale, channels in _CHANNELS.items()
        }

    panorama, faces = maps(), maps()
    turned = [{scale: m.roll(64 >> scale, dims=-1) for scale, m in part.items()} for part in (panorama, faces)]
    with torch.no_grad():
        before, after = decoder(panorama, faces), decoder(*turned)
        assert before.shape == (1, 32, 32, 64)
        assert torch.allclose(after, before.roll(32, dims=-1), rtol=1e-9)
        assert torch.allclose(decoder.head(after), decoder.head(before).roll(64, dims=-1), rtol=1e-9)
