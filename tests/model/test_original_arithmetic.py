"""The original's order of operations: every bit before the heads is its own, and so are its roundings to bfloat16."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from pansplat.model import layers
from pansplat.model.layers import AttentionPrecision, attend, follow_the_original
from pansplat.model.pansplat import PanSplat, PanSplatOutput
from pansplat.model.unet import UNet, UNetConfig
from pansplat.model.weights import official_names
from pansplat.threads import one_thread

Golden = Callable[[str], dict[str, Tensor]]


@pytest.fixture(scope="module", autouse=True)
def two_threads() -> Iterator[None]:
    """The fixtures were made with one; with more, a sum is split in another place unless that is prevented."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
@one_thread()
def adds_alike(golden: Golden, recipe_weights: dict[str, Tensor]) -> bool:
    """Whether torch's convolutions add up here as where the fixtures were made: the original's first two, plainly."""
    truth = golden("pansplat_64x128_fp32attn")
    mean, std = (torch.tensor(rgb)[:, None, None] for rgb in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    maps = (truth["in.image"][0] - mean) / std
    for name, margin in (("conv00", 3), ("conv01", 2)):
        own = {
            key.removeprefix(f"backbone.encoder.{name}."): tensor
            for key, tensor in recipe_weights.items()
            if f"encoder.{name}." in key
        }
        padded = functional.pad(functional.pad(maps, (0, 0, margin, margin)), (margin, margin, 0, 0), mode="circular")
        maps = functional.conv2d(padded, own["conv.weight"])
        mean, variance, scale, offset = (
            own[f"bn.{part}"] for part in ("running_mean", "running_var", "weight", "bias")
        )
        maps = functional.leaky_relu(functional.batch_norm(maps, mean, variance, scale, offset), 0.1)
    return torch.equal(maps, truth["backbone.cnn.3"][0])


def _output(
    recipe_weights: dict[str, Tensor], inputs: dict[str, Tensor], attention: AttentionPrecision, **options: str
) -> PanSplatOutput:
    network = PanSplat(compat="official", attention_precision=attention, **options).eval()  # pyright: ignore[reportArgumentType]
    ours = network.state_dict()
    names = official_names("pansplat")
    network.load_state_dict({own: recipe_weights[name].reshape(ours[own].shape) for name, own in names.items()})
    with torch.no_grad():
        return network(*(inputs[f"in.{name}"] for name in ("image", "extrinsics", "near", "far")))


def _differences(found: PanSplatOutput, truth: dict[str, Tensor]) -> dict[str, float]:
    """Largest difference from each tensor of a fixture, in its standard deviations."""
    pairs: dict[str, tuple[Tensor, Tensor]] = {}
    for stage, level in enumerate(found.depths.levels):
        pairs[f"s{stage}.disp"] = level.inverse_depth, truth[f"s{stage}.disp"]
        pairs[f"s{stage}.depth"] = level.depth, truth[f"s{stage}.depth"]
        pairs[f"s{stage}.pdf_max"] = level.confidence[0], truth[f"s{stage}.pdf_max"][:, 0]
    (gaussians,) = found.gaussians
    for stage in range(4):
        for view in range(2):
            part = gaussians.select((gaussians.levels == 3 - stage) & (gaussians.views == view))
            for name in ("means", "opacities", "scales"):
                pairs[f"g.s{stage}.v{view}.{name}"] = getattr(part, name), truth[f"g.s{stage}.v{view}.{name}"]
    return {name: float((ours - theirs).abs().max() / theirs.std()) for name, (ours, theirs) in pairs.items()}


@pytest.mark.shared
def test_with_bfloat16_attention_every_tensor_is_the_originals(
    recipe_weights: dict[str, Tensor], golden: Golden, adds_alike: bool
):
    """Depths to the bit, Gaussians to 1e-4 of a deviation; elsewhere roundings flip, and grow."""
    inputs, truth = golden("pansplat_64x128_fp32attn"), golden("pansplat_64x128_bf16attn")
    output = _output(recipe_weights, inputs, "bfloat16")
    errors = _differences(output, truth)
    assert max(errors.values()) < (1e-4 if adds_alike else 0.05), errors
    if adds_alike:
        assert max(error for name, error in errors.items() if not name.startswith("g.")) == 0, errors
    single = output.depths.depth[2] - inputs["s2.depth"]
    assert float(single.abs().max() / inputs["s2.depth"].std()) > 2e-3  # the rounding is there


@pytest.mark.shared
def test_with_float32_attention_every_bit_before_the_heads_is_the_originals(
    recipe_weights: dict[str, Tensor], golden: Golden, adds_alike: bool
):
    if not adds_alike:
        pytest.skip("this processor adds up in another order than the one the fixtures were made on")
    truth = golden("pansplat_64x128_fp32attn")
    output = _output(recipe_weights, truth, "float32", arithmetic="original")
    for stage, maps in enumerate(output.matched.features):
        assert torch.equal(maps, truth[f"backbone.feat.{stage}"])
    for stage, level in enumerate(output.depths.levels):
        assert torch.equal(level.logits, truth[f"s{stage}.logits"])
        assert torch.equal(level.inverse_depth, truth[f"s{stage}.disp"])
        assert torch.equal(level.confidence[0], truth[f"s{stage}.pdf_max"][:, 0])
        if stage:
            assert torch.equal(level.candidates, truth[f"s{stage}.candidates"])


def test_it_is_chosen_where_a_last_bit_decides():
    def choice(compat: layers.Compat, **options: str) -> str:
        with torch.device("meta"):
            return PanSplat(compat=compat, **options).arithmetic  # pyright: ignore[reportArgumentType]

    assert choice("official", attention_precision="bfloat16") == "original"
    assert choice("official") == choice("fixed", attention_precision="bfloat16") == "fast"
    assert choice("official", attention_precision="bfloat16", precision="bfloat16") == "fast"
    assert choice("official", attention_precision="bfloat16", arithmetic="fast") == "fast"
    with pytest.raises(ValueError, match='needs compat="official"'):
        choice("fixed", arithmetic="original")


def test_attention_written_out_is_attention(monkeypatch: pytest.MonkeyPatch):
    generator = torch.Generator().manual_seed(4)
    queries, keys, values = torch.randn(3, 2, 3, 10, 8, generator=generator, dtype=torch.float64)
    mask = torch.randn(1, 3, 10, 10, generator=generator, dtype=torch.float64)
    for bias in (None, mask):
        fast, plain = (attend(queries, keys, values, mask=bias, arithmetic=way) for way in ("fast", "original"))
        assert torch.allclose(fast, plain, atol=1e-12) and not torch.equal(fast, plain)
        with monkeypatch.context() as patch:
            patch.setattr(layers, "_LOGITS", 1)
            assert torch.allclose(attend(queries, keys, values, mask=bias, arithmetic="original"), plain, atol=1e-12)


def test_both_ways_give_the_same_numbers(randomize: Callable[[torch.nn.Module], torch.nn.Module]):
    network = randomize(UNet(UNetConfig(32), "wrapped_columns"))
    maps = torch.randn(1, 2, 32, 8, 16, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    with torch.no_grad():
        fast = network(maps)
        follow_the_original(network)
        assert all(module.arithmetic == "original" for module in network.modules() if hasattr(module, "arithmetic"))
        assert torch.allclose(network(maps), fast, atol=1e-10)
