"""bfloat16 convolutions: close to float32, and no more than convolutions."""

from __future__ import annotations

import pytest
import torch

from pansplat.errors import InputError
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import HeadsConfig
from pansplat.model.layers import attend, autocast_convolutions
from pansplat.model.network import require_precision
from pansplat.model.pansplat import PanSplat, PanSplatConfig

SMALL = PanSplatConfig(
    features=FeaturePyramidConfig(channels=(8, 8, 16, 32), transformer=TransformerConfig(channels=32, blocks=2)),
    cost_volume=CostVolumeConfig(
        mono_channels=0, levels=(SweepLevel(3, 32, 16, 32), SweepLevel(2, 16, 8, 32), SweepLevel(1, 8, 8, 32))
    ),
    heads=HeadsConfig(feature_channels=(32, 16, 8, 8), candidates=8),
)
CPU = torch.device("cpu")


def _output(randomize, **precisions):
    network = randomize(PanSplat(SMALL, "fixed", **precisions)).float()
    generator = torch.Generator().manual_seed(1)
    poses = torch.eye(4, dtype=torch.float32).repeat(1, 2, 1, 1)
    poses[0, 1, 0, 3] = 0.5
    images = torch.rand(1, 2, 3, 64, 128, generator=generator)
    bounds = torch.full((1, 2), 0.5), torch.full((1, 2), 10.0)
    with torch.no_grad():
        return network(images, poses, *bounds)


def test_bfloat16_is_close_to_float32_and_gives_float32(randomize):
    exact, rounded = _output(randomize), _output(randomize, precision="bfloat16")
    for a, b in zip(exact.depths.inverse_depth, rounded.depths.inverse_depth, strict=True):
        assert b.dtype == torch.float32
        assert not torch.equal(a, b)
        relative = (b - a).abs() / a
        assert float(relative.median()) < 0.02
    (a,), (b,) = exact.gaussians, rounded.gaussians
    for name in ("means", "scales", "opacities", "harmonics"):
        x, y = getattr(a, name), getattr(b, name)
        assert y.dtype == torch.float32
        assert 0 < float((y - x).pow(2).mean().sqrt()) < 0.05 * float(x.std())
    assert torch.equal(a.levels, b.levels)


def test_float32_leaves_other_number_types_alone():
    tensor = torch.randn(1, 4, 8, 8, dtype=torch.float64)
    with autocast_convolutions("float32", CPU):
        assert torch.nn.functional.conv2d(tensor, tensor[:, :, :3, :3]).dtype == torch.float64


def test_convolutions_round_to_bfloat16_and_attention_does_not():
    generator = torch.Generator().manual_seed(2)
    queries, keys, values = torch.randn(3, 1, 2, 9, 4, generator=generator)
    with autocast_convolutions("bfloat16", CPU):
        assert torch.nn.functional.conv2d(torch.ones(1, 1, 3, 3), torch.ones(1, 1, 1, 1)).dtype == torch.bfloat16
        inside = attend(queries, keys, values)
        coarse = attend(queries, keys, values, precision="bfloat16")
    assert torch.equal(inside, attend(queries, keys, values))
    assert torch.equal(coarse, attend(queries, keys, values, precision="bfloat16"))
    assert not torch.equal(inside, coarse)
    mixed = attend(queries.bfloat16(), keys.bfloat16(), values.bfloat16())
    assert mixed.dtype == torch.float32


def test_a_processor_without_bfloat16_is_told_to_use_float32(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_f": True, "avx512_bf16": False})
    with pytest.raises(InputError, match=r"this one has none .* use float32"):
        require_precision("bfloat16")
    require_precision("float32")
    with pytest.raises(InputError, match="float32 or bfloat16, got 'float16'"):
        require_precision("float16")
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    require_precision("bfloat16")
