"""The U-Net over all views' maps."""

import pytest
import torch

from pansplat.model.cost_volume import JointAttention, ResBlock, UNet, UNetConfig


def _noise(*shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(6), dtype=torch.float64)


@pytest.fixture(scope="module")
def unet(randomize):
    return randomize(UNet(UNetConfig(32), "sphere"))


@pytest.mark.parametrize("columns", [4, 8, 12])
def test_rolling_by_whole_pixels_of_the_bottleneck_rolls_the_output(unet, columns):
    maps = _noise(1, 2, 32, 8, 16)
    assert torch.allclose(unet(maps.roll(columns, -1)), unet(maps).roll(columns, -1), atol=1e-11)


def test_zeros_beyond_the_border_break_the_roll(randomize):
    maps, network = _noise(1, 2, 32, 8, 16), randomize(UNet(UNetConfig(32), "zeros"))
    assert not torch.allclose(network(maps.roll(8, -1)), network(maps).roll(8, -1), atol=1e-3)


@pytest.mark.parametrize("views", [2, 3])
def test_the_order_of_the_views_does_not_matter(unet, views):
    maps, order = _noise(1, views, 32, 8, 16), torch.arange(views).flip(0)
    assert torch.allclose(unet(maps[:, order]), unet(maps)[:, order], atol=1e-11)


def test_views_see_each_other_and_batch_items_do_not(unet):
    maps = _noise(2, 2, 32, 4, 8)
    before = unet(maps)
    maps[0, 1] += 1
    moved = (unet(maps) - before).abs().amax(dim=(2, 3, 4))
    assert moved[0].min() > 1e-3 and moved[1].max() < 1e-12


@pytest.mark.parametrize("scales", [1, 2, 5])
def test_any_number_of_scales_keeps_the_size(randomize, scales):
    network = randomize(UNet(UNetConfig(32, scales=scales), "sphere"))
    assert network(_noise(1, 2, 32, 16, 32)).shape == (1, 2, 32, 16, 32)
    assert [scale.attention is not None for scale in network.encoder] == [False] * (scales - 1) + [True]


def test_a_fresh_block_is_its_shortcut():
    maps = _noise(2, 32, 4, 8)
    assert torch.equal(ResBlock(32, 32, "sphere").double()(maps), maps)
    block = ResBlock(32, 64, "sphere").double()
    assert torch.equal(block(maps), block.shortcut(maps))


def test_fresh_attention_adds_nothing():
    maps = _noise(2, 32, 4, 8)
    assert torch.equal(JointAttention(32, "float32").double()(maps, 2), maps)


def test_gradient_reaches_every_parameter(unet):
    unet.zero_grad()
    unet(_noise(1, 2, 32, 8, 16)).square().sum().backward()
    assert all(parameter.grad.abs().max() > 1e-9 for parameter in unet.parameters())
