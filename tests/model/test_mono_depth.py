"""UniFuse: agreement with the official code, and equivariance of the fixed network under half a turn."""

import pytest
import torch

from pansplat.model.mono_depth import MonocularDepth
from pansplat.model.network import build_network


@pytest.mark.slow
@pytest.mark.shared
def test_rolling_the_panorama_by_half_a_turn_rolls_the_features(official_weights, golden, error) -> None:
    network = build_network(official_weights, "fixed", "recipe").mono_depth
    images = golden("pansplat_64x128_fp32attn")["in.image"][:, :1]
    assert error(network(images.roll(64, dims=-1)), network(images).roll(256, dims=-1)) < 1e-3


def test_the_network_stays_frozen_in_training_mode() -> None:
    with torch.device("meta"):
        network = MonocularDepth().train()
    assert not any(module.training for module in network.modules())
    assert not any(parameter.requires_grad for parameter in network.parameters())
