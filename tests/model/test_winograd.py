"""Convolutions in blocks equal ordinary ones."""

import pytest
import torch
from torch.nn import functional

from pansplat.model.winograd import FastConv3x3, convolve_blocks, transform_weights


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("size", [(6, 6), (7, 9), (10, 67), (21, 40), (3, 3)])
@pytest.mark.parametrize("channels", [(3, 5), (40, 33)])
@pytest.mark.parametrize("margin", [0, 1])
def test_blocks_give_the_convolution(size, channels, margin):
    """Against float64; 5e-5 of the output's standard deviation is allowed, as its rounding in float32 gives."""
    maps, weight, bias = _random(1, channels[0], *size), _random(*channels[::-1], 3, 3, seed=1), _random(channels[1])
    found = convolve_blocks(maps, transform_weights(weight), bias, margin)
    expected = functional.conv2d(maps.double(), weight.double(), bias.double(), padding=margin)
    assert found.shape == expected.shape and found.is_contiguous(memory_format=torch.channels_last)
    scale = (weight.double() ** 2).sum(dim=(1, 2, 3)).sqrt().mean()
    assert float((found - expected).abs().max() / scale) < 5e-5


@pytest.mark.parametrize("padding", [0, 1])
def test_a_large_map_is_computed_in_blocks_and_a_gradient_ordinarily(padding, monkeypatch):
    used = []
    monkeypatch.setattr(
        "pansplat.model.winograd.convolve_blocks",
        lambda *arguments: (used.append(1), convolve_blocks(*arguments))[1],
    )
    conv = FastConv3x3(32, 40, padding=padding)
    maps = _random(2, 32, 70, 64)
    with torch.no_grad():
        fast = conv(maps)
    assert len(used) == 2  # one a batch item
    ordinary = conv(maps)
    assert len(used) == 2 and ordinary.requires_grad
    assert float((fast - ordinary).detach().abs().max()) < 1e-4
    with torch.no_grad():
        conv(maps[:, :, :20, :20])
        conv.double()(maps.double())
        with torch.autocast("cpu", torch.bfloat16):
            conv.float()(maps)
    assert len(used) == 2


def test_changed_weights_are_noticed():
    conv = FastConv3x3(32, 32, padding=1)
    maps = _random(1, 32, 64, 64)
    with torch.no_grad():
        before = conv(maps)
        conv.weight.mul_(2)
        assert torch.allclose(conv(maps) - conv.bias[:, None, None], 2 * (before - conv.bias[:, None, None]), atol=1e-4)
        conv.load_state_dict({"weight": torch.zeros(32, 32, 3, 3), "bias": torch.zeros(32)})
        assert float(conv(maps).abs().max()) == 0


def test_the_number_of_threads_changes_nothing():
    maps, weights, bias = _random(1, 40, 50, 60), transform_weights(_random(32, 40, 3, 3)), _random(32)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = convolve_blocks(maps, weights, bias)
        torch.set_num_threads(3)
        together = convolve_blocks(maps, weights, bias)
    finally:
        torch.set_num_threads(threads)
    assert torch.allclose(alone, together, atol=1e-5)
