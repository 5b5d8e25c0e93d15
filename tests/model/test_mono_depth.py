"""UniFuse: agreement with the official code, and equivariance of the fixed network under half a turn."""

import pytest
import torch

from pansplat.model.mono_depth import MonocularDepth
from pansplat.model.network import build_network


@pytest.mark.shared
def test_features_and_depth_match_the_official_code(run_official, golden, error) -> None:
    truth, run = golden("pansplat_64x128_fp32attn"), run_official()
    panoramas, strips = run.network.mono_depth.prepare_inputs(truth["in.image"][0])
    assert error(panoramas[..., ::8, ::8], truth["in.mono_image_sub"][0]) < 2e-4
    assert error(strips[..., ::8, ::8], truth["in.cube_image_sub"][0]) < 2e-4
    features = run.outputs["mono_depth"]
    assert features.shape == (1, 2, 32, 256, 512) and not features.requires_grad
    assert error(features[..., ::16, ::16], truth["mono.feat_sub"]) < 2e-4
    depth = run.network.mono_depth.depth(features)
    assert error(depth[..., ::8, ::8], truth["mono.pred_depth_sub"]) < 2e-4


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
