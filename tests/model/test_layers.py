"""Convolutions that know the sphere, resizing, attention, and what users are told."""

import math

import pytest
import torch
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.geometry.equirect import pad_equirect
from pansplat.model.layers import (
    PanoramaConv2d,
    attend,
    border_of,
    convolve_and_normalize,
    require_rigid,
    require_size,
    require_views,
    resize,
    upsample,
)


def _noise(*shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def test_a_convolution_on_the_sphere_sees_the_true_neighbours():
    conv = PanoramaConv2d(3, 4, 5, border="sphere").double()
    maps = _noise(2, 3, 8, 16)
    assert torch.allclose(conv(maps), functional.conv2d(pad_equirect(maps, 2), conv.weight, conv.bias), atol=1e-14)


def test_the_originals_convolution_has_zeros_above_and_below_only():
    conv = PanoramaConv2d(3, 4, 3, border="wrapped_columns").double()
    maps = _noise(2, 3, 8, 16)
    wide = torch.cat((maps[..., -1:], maps, maps[..., :1]), dim=-1)
    assert torch.allclose(conv(maps), functional.conv2d(wide, conv.weight, conv.bias, padding=(1, 0)), atol=1e-14)


def test_zeros_are_an_ordinary_convolution():
    conv = PanoramaConv2d(3, 4, 3, stride=2, border="zeros").double()
    maps = _noise(2, 3, 8, 16)
    assert torch.equal(conv(maps), functional.conv2d(maps, conv.weight, conv.bias, stride=2, padding=1))


@pytest.mark.parametrize(("stride", "columns"), [(1, 3), (2, 6)])
@pytest.mark.parametrize("kernel", [1, 3, 5, 7])
@pytest.mark.parametrize("compat", ["official", "fixed"])
def test_rolling_a_panorama_rolls_its_convolution(compat, kernel, stride, columns):
    conv = PanoramaConv2d(2, 3, kernel, stride=stride, border=border_of(compat)).double()
    maps = _noise(1, 2, 8, 16)
    assert torch.allclose(conv(maps.roll(columns, -1)), conv(maps).roll(columns // stride, -1), atol=1e-14)
    assert conv(maps).shape[-2:] == (8 // stride, 16 // stride)


def test_a_constant_panorama_stays_constant_up_to_the_poles():
    conv = PanoramaConv2d(2, 3, 3, border="sphere").double()
    result = conv(torch.ones(1, 2, 6, 12).double())
    assert torch.allclose(result, result[..., :1, :1].expand_as(result), atol=1e-14)


@pytest.mark.parametrize("border", ["sphere", "wrapped_columns", "zeros"])
def test_a_convolution_has_the_right_gradient(border):
    conv = PanoramaConv2d(1, 2, 3, border=border).double()
    assert torch.autograd.gradcheck(conv, _noise(1, 1, 4, 8).requires_grad_())


@pytest.mark.parametrize("bias", [True, False])
def test_a_normalised_convolution_is_one_convolution_outside_training(randomize, bias):
    conv, norm = PanoramaConv2d(3, 4, 3, border="sphere", bias=bias), torch.nn.BatchNorm2d(4)
    randomize(torch.nn.ModuleList((conv, norm)))
    norm.running_mean.copy_(_noise(4))
    norm.running_var.copy_(_noise(4).square())
    maps = _noise(2, 3, 4, 8)
    assert torch.allclose(convolve_and_normalize(conv, norm, maps), norm(conv(maps)), atol=1e-13)
    norm.train()
    result = convolve_and_normalize(conv, norm, maps)
    assert torch.allclose(result.mean(dim=(0, 2, 3)), norm.bias, atol=1e-12)


def test_upsampling_keeps_pixel_centres_at_half_integers():
    ramp = torch.arange(4, dtype=torch.float64)[:, None].expand(1, 1, 4, 8)  # rows
    assert torch.allclose(upsample(ramp, 2, "fixed")[0, 0, 1:7, 0], torch.arange(6).double() / 2 + 0.25)
    assert torch.allclose(upsample(ramp, 2, "official")[0, 0, :, 0], torch.arange(8).double() * 3 / 7)


def test_resizing_goes_on_over_the_seam_in_fixed_mode_only():
    maps = _noise(1, 2, 8, 16)
    for compat, goes_on in (("fixed", True), ("official", False)):
        resized, rolled = resize(maps, (16, 32), compat), resize(maps.roll(8, -1), (16, 32), compat)
        assert torch.allclose(rolled, resized.roll(16, -1), atol=1e-12) == goes_on


def _softmax_attention(queries, keys, values, mask):
    logits = queries @ keys.transpose(-1, -2) / math.sqrt(queries.shape[-1]) + mask
    return logits.softmax(dim=-1) @ values


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_attention_is_a_softmax_of_scaled_products(dtype):
    queries, keys, values = _noise(3, 2, 4, 6, 32).to(dtype)
    mask = _noise(1, 4, 6, 6).to(dtype)
    mask[..., ::2, :3] = -math.inf
    truth = _softmax_attention(*(t.double() for t in (queries, keys, values, mask)))
    result = attend(queries, keys, values, mask=mask)
    assert result.dtype == dtype
    assert (result - truth).abs().max() < (1e-5 if dtype == torch.float32 else 1e-12)


def test_bfloat16_attention_rounds_what_goes_in_and_what_comes_out():
    def rounded(tensor):
        return tensor.to(torch.bfloat16).to(tensor.dtype)

    queries, keys, values = _noise(3, 2, 4, 6, 32).float()
    mask = _noise(1, 4, 6, 6).float()
    truth = rounded(_softmax_attention(rounded(queries), rounded(keys), rounded(values), rounded(mask)))
    result = attend(queries, keys, values, mask=mask, precision="bfloat16")
    assert torch.equal(result, rounded(result))
    assert (result != truth).double().mean() < 0.01  # sums in another order may round to the neighbour
    assert (result - truth).abs().max() <= 2**-7 * truth.abs().max()


def test_two_views_serve_both_modes_and_more_the_fixed_one():
    require_views(2, "official")
    require_views(2, "fixed")
    require_views(7, "fixed")


def test_a_single_view_is_refused():
    with pytest.raises(InputError, match="needs two or more views, got 1"):
        require_views(1, "fixed")


def test_three_views_are_refused_in_official_mode():
    with pytest.raises(InputError, match='takes exactly two views, as the original does, got 3; use compat="fixed"'):
        require_views(3, "official")


def test_a_size_that_cannot_be_halved_is_refused():
    require_size(64, 128, 32)
    with pytest.raises(InputError, match="that 32 divides, got 80x160"):
        require_size(80, 160, 32)


@pytest.mark.parametrize("spoil", [lambda r: r * 1.001, lambda r: -r, lambda r: r * math.nan])
def test_a_pose_that_is_not_rigid_is_refused(spoil):
    poses = torch.eye(4).repeat(2, 3, 1, 1)
    require_rigid(poses)
    poses[1, 2, :3, :3] = spoil(poses[1, 2, :3, :3])
    with pytest.raises(InputError, match="of item 1, view 2 must be a rigid pose"):
        require_rigid(poses)
