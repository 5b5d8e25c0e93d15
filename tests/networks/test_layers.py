"""Convolution on the sphere, resizing, attention, autocast, input checks."""

import math

import pytest
import torch
from refusals import expect_error
from synthetic_scenes import draw_noise

from pansplat.networks.layers import (
    PanoramaConv2d,
    attend,
    autocast_convolutions,
    choose_border,
    convolve_and_normalize,
    require_rigid,
    resize,
)


@pytest.mark.parametrize(("stride", "columns"), [(1, 3), (2, 6)])
@pytest.mark.parametrize("kernel", [1, 3, 7])
@pytest.mark.parametrize("compat", ["official", "fixed"])
def test_rolling_a_panorama_rolls_its_convolution(compat, kernel, stride, columns):
    conv = PanoramaConv2d(2, 3, kernel, stride=stride, border=choose_border(compat)).double()
    maps = draw_noise(1, 2, 8, 16)
    assert torch.allclose(conv(maps.roll(columns, -1)), conv(maps).roll(columns // stride, -1), atol=1e-14)
    assert conv(maps).shape[-2:] == (8 // stride, 16 // stride)


@pytest.mark.parametrize("bias", [True, False])
def test_convolve_and_normalize_equals_both_layers(randomize, bias):
    conv, norm = PanoramaConv2d(3, 4, 3, border="sphere", bias=bias), torch.nn.BatchNorm2d(4)
    randomize(torch.nn.ModuleList((conv, norm)))
    norm.running_mean.copy_(draw_noise(4))
    norm.running_var.copy_(draw_noise(4).square())
    maps = draw_noise(2, 3, 4, 8)
    assert torch.allclose(convolve_and_normalize(conv, norm, maps), norm(conv(maps)), atol=1e-13)
    norm.train()
    result = convolve_and_normalize(conv, norm, maps)
    assert torch.allclose(result.mean(dim=(0, 2, 3)), norm.bias, atol=1e-12)


def test_resizing_wraps_at_the_seam_in_fixed_mode_only():
    maps = draw_noise(1, 2, 8, 16)
    for compat, wraps in (("fixed", True), ("official", False)):
        resized, rolled = resize(maps, (16, 32), compat), resize(maps.roll(8, -1), (16, 32), compat)
        assert torch.allclose(rolled, resized.roll(16, -1), atol=1e-12) == wraps


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_attention_is_a_softmax_of_scaled_products(dtype):
    queries, keys, values = draw_noise(3, 2, 4, 6, 32).to(dtype)
    mask = draw_noise(1, 4, 6, 6).to(dtype)
    mask[..., ::2, :3] = -math.inf
    logits = queries.double() @ keys.double().transpose(-1, -2) / math.sqrt(32) + mask.double()
    truth = logits.softmax(dim=-1) @ values.double()
    result = attend(queries, keys, values, mask=mask)
    assert result.dtype == dtype
    assert (result - truth).abs().max() < (1e-5 if dtype == torch.float32 else 1e-12)


def test_bfloat16_autocast_rounds_convolutions_but_not_attention():
    generator = torch.Generator().manual_seed(2)
    queries, keys, values = torch.randn(3, 1, 2, 9, 4, generator=generator)
    with autocast_convolutions("bfloat16", torch.device("cpu")):
        assert torch.nn.functional.conv2d(torch.ones(1, 1, 3, 3), torch.ones(1, 1, 1, 1)).dtype == torch.bfloat16
        inside = attend(queries, keys, values)
        coarse = attend(queries, keys, values, precision="bfloat16")
    assert torch.equal(inside, attend(queries, keys, values))
    assert torch.equal(coarse, attend(queries, keys, values, precision="bfloat16"))
    assert not torch.equal(inside, coarse)
    mixed = attend(queries.bfloat16(), keys.bfloat16(), values.bfloat16())
    assert mixed.dtype == torch.float32


@pytest.mark.parametrize("break_rotation", [lambda r: r * 1.001, lambda r: -r, lambda r: r * math.nan])
def test_a_pose_that_is_not_rigid_is_refused(break_rotation):
    poses = torch.eye(4).repeat(2, 3, 1, 1)
    require_rigid(poses)
    poses[1, 2, :3, :3] = break_rotation(poses[1, 2, :3, :3])
    expect_error("of item 1, view 2 must be a rigid pose", require_rigid, poses)
