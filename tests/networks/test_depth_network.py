import pytest
import torch

from pansplat.networks.depth_network import MAX_LOG_SCALE, DepthNetwork, DepthNetworkConfig, RoomAttention

_SMALL = DepthNetworkConfig(room_channels=24, attention_layers=1, attention_heads=3, decoder_channels=(16, 12, 8, 8))


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    network = DepthNetwork(_SMALL)
    torch.nn.init.normal_(network.head.weight)
    network.train()
    with torch.no_grad():
        for _ in range(4):  # sets the statistics of the normalisations
            network(torch.rand(4, 3, 64, 128))
    return network.eval()


@torch.no_grad()
def test_rolling_the_panorama_rolls_the_depth(network):
    image = torch.rand(1, 3, 64, 128)
    depth, rolled = network(image).log_depth, network(image.roll(32, dims=-1)).log_depth
    assert depth.std() > 1e-3
    torch.testing.assert_close(depth.roll(16, dims=-1), rolled, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_scale_is_bounded(network):
    scale = network(1e4 * torch.rand(1, 3, 64, 128)).log_scale
    assert torch.isfinite(scale).all() and scale.abs().max() <= MAX_LOG_SCALE


@torch.no_grad()
def test_attention_depends_on_latitude_and_longitude_difference():
    torch.manual_seed(1)
    attention, maps = RoomAttention(24, 3), torch.randn(1, 24, 4, 8)
    result = attention(maps)
    torch.testing.assert_close(attention(maps.roll(3, dims=-1)), result.roll(3, dims=-1), atol=1e-5, rtol=1e-5)
    assert (attention(maps.flip(-2)) - result.flip(-2)).abs().max() > 1e-3
    shuffled = maps[..., [1, 0, 2, 3, 4, 5, 6, 7]]
    assert (attention(shuffled)[..., [1, 0, 2, 3, 4, 5, 6, 7]] - result).abs().max() > 1e-4
