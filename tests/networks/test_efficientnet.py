import torch

from pansplat.networks.efficientnet import CHANNELS, EfficientNetLite0


def _random_network(seed):
    torch.manual_seed(seed)
    network = EfficientNetLite0().eval()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_var.uniform_(0.01, 0.1)
    return network


@torch.no_grad()
def test_features_halve_at_each_scale():
    features = _random_network(0)(torch.rand(2, 3, 64, 128))
    assert [tuple(f.shape) for f in features] == [(2, c, 32 >> n, 64 >> n) for n, c in enumerate(CHANNELS)]


@torch.no_grad()
def test_rolling_the_panorama_rolls_the_features():
    network, image = _random_network(1), torch.rand(1, 3, 64, 128)
    features, rolled = network(image), network(image.roll(32, dims=-1))
    for n, (a, b) in enumerate(zip(features, rolled, strict=True)):
        assert a.std() > 1e-4
        torch.testing.assert_close(a.roll(16 >> n, dims=-1), b, atol=1e-5, rtol=1e-4)
