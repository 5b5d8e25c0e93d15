import numpy as np
import pytest
import torch

from pansplat.networks.depth_network import DepthEstimate
from pansplat.networks.depth_sharpening import DepthSharpening, SharpeningConfig

_CONFIG = SharpeningConfig(
    height=64,
    room_channels=24,
    attention_layers=1,
    attention_heads=3,
    decoder_channels=(16, 12, 8, 8),
    selection_channels=8,
)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DepthSharpening(_CONFIG).eval()


def _inputs(seed=0):
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(1, 3, 64, 128, generator=generator)
    return images, DepthEstimate(*(torch.randn(1, 16, 32, generator=generator) for _ in range(2)))


@torch.no_grad()
def test_untrained_network_keeps_the_range_of_the_estimate(network):
    images, estimate = _inputs()
    log_depth, half = network(images, estimate)
    assert log_depth.shape == (1, 64, 128)
    assert half.log_depth.shape == half.log_scale.shape == (1, 32, 64)
    assert estimate.log_depth.min() <= log_depth.min() and log_depth.max() <= estimate.log_depth.max()
    assert log_depth.std() > 0.3 * estimate.log_depth.std()


@torch.no_grad()
def test_each_pixel_can_choose_either_side_of_an_edge(network):
    depth = torch.zeros(1, 32, 64)
    depth[..., 20:40] = 1.0
    images, features = torch.zeros(1, 3, 64, 128), torch.zeros(1, 8, 32, 64)
    network = DepthSharpening(_CONFIG).eval()
    weights = torch.full((9, 4), -40.0)
    weights[3, 0::2] = weights[5, 1::2] = 40.0  # left pixels take the left neighbour, right ones the right neighbour
    network.mask.weight.zero_()
    network.mask.bias.copy_(weights.flatten())
    sharp = network._select(features, images, depth).round(decimals=6)
    assert set(sharp.unique().tolist()) == {0.0, 1.0}
    assert sharp[0, 8, 39] == 1.0 and depth[0, 4, 19] == 0.0  # the right pixel of a far cell before the edge
    assert sharp[0, 8, 40] == 0.0 and depth[0, 4, 20] == 1.0


@torch.no_grad()
@pytest.mark.parametrize("columns", (32, 64))
def test_a_turned_panorama_has_turned_depth(network, columns):
    images, estimate = _inputs()
    turned = DepthEstimate(*(map.roll(columns // 4, -1) for map in estimate))
    expected = network(images, estimate)[0].roll(columns, -1)
    np.testing.assert_allclose(network(images.roll(columns, -1), turned)[0], expected, atol=2e-4)


def test_gradients_reach_the_encoder_and_the_choice_of_neighbours():
    network = DepthSharpening(_CONFIG).train()
    torch.nn.init.normal_(network.head.weight, std=0.1)
    images, estimate = _inputs()
    log_depth, half = network(images, estimate)
    (log_depth.square().sum() + half.log_scale.sum()).backward()
    for parameter in (network.encoder.stem.weight, network.mask.weight, network.attention[0].project_in.weight):
        assert parameter.grad is not None and parameter.grad.abs().max() > 0
