"""The whole PanSplat: agreement with the official code, symmetries of the fixed network, precision."""

import dataclasses
import math

import pytest
import torch

from pansplat.gaussians.harmonics import rotate_harmonics
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import AdapterConfig, HeadsConfig
from pansplat.model.pansplat import PanSplat, PanSplatConfig


@pytest.fixture(scope="module")
def small(small_config) -> PanSplatConfig:
    """The small config with heads that are small enough for panoramas of 32 rows."""
    return dataclasses.replace(small_config, heads=dataclasses.replace(small_config.heads, layers=1))


@pytest.fixture(scope="module")
def network(small) -> PanSplat:
    torch.manual_seed(0)
    return PanSplat(small, "fixed").double().eval()


@pytest.fixture(scope="module")
def prediction(network, make_inputs):
    with torch.no_grad():
        return network(*make_inputs(32))


def test_rotating_the_world_rotates_the_prediction(network, prediction, make_inputs):
    images, poses, near, far = make_inputs(32)
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3] = rotations_from_quats(torch.tensor((0.3, -0.5, 0.7, 0.2), dtype=torch.float64))
    world[:3, 3] = torch.tensor((1.0, -2.0, 3.0))
    before = prediction.gaussians[0]
    with torch.no_grad():
        after = network(images, world @ poses, near, far).gaussians[0]
    rotation = world[:3, :3]
    assert torch.allclose(after.means, before.means @ rotation.T + world[:3, 3], atol=1e-8)
    assert torch.allclose(after.covariances, rotation @ before.covariances @ rotation.T, atol=1e-8)
    assert torch.allclose(after.harmonics, rotate_harmonics(before.harmonics, rotation), atol=1e-8)
    assert torch.allclose(after.opacities, before.opacities, atol=1e-8)


def test_rolling_panoramas_and_turning_poses_by_half_a_turn_rolls_the_depth(network, make_inputs):
    images, poses, near, far = make_inputs(32)
    half_turn = torch.diag(torch.tensor((-1.0, 1.0, -1.0, 1.0), dtype=torch.float64))
    with torch.no_grad():
        before = network(images, poses, near, far)
        after = network(images.roll(32, dims=-1), poses @ half_turn, near, far)
    for a, b in zip(after.depths.depth, before.depths.depth, strict=True):
        assert torch.allclose(a, b.roll(b.shape[-1] // 2, dims=-1), atol=1e-9)


def test_large_panoramas_are_matched_at_low_and_lifted_at_full_resolution(network, monkeypatch, make_inputs):
    monkeypatch.setattr("pansplat.model.pansplat.MATCHING_HEIGHT", 32)
    with torch.no_grad():
        output = network(*make_inputs(64))
    assert output.matched.features[-1].shape[-2:] == (32, 64)
    assert output.depths.depth[-1].shape[-2:] == (16, 32)
    assert int((output.gaussians[0].levels == 0).sum()) == 2 * int(128**2 / math.pi)


@pytest.mark.parametrize("compat", ["official", "fixed"])
def test_gradients_reach_every_weight_and_the_images(compat, small, randomize, make_inputs):
    """Coarser levels get gradients from a loss of their own: finer levels detach them."""
    network, (images, poses, near, far) = randomize(PanSplat(small, compat)), make_inputs(32)
    output = network(images.requires_grad_(), poses, near, far)
    gaussians = output.gaussians[0]
    fields = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.harmonics)
    losses = [field.square().sum() for field in fields]
    losses += [depth.square().sum() for depth in output.depths.inverse_depth[:-1]]
    torch.stack(losses).sum().backward()
    assert bool(torch.isfinite(images.grad).all()) and bool((images.grad.abs().amax(dim=(1, 2)) > 0).all())
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]


@pytest.mark.parametrize("views", [2, 3])
def test_the_order_of_the_views_does_not_matter_and_batch_items_are_independent(randomize, small, make_inputs, views):
    network, inputs = randomize(PanSplat(small, "fixed")), make_inputs(32, views=views, batch=2)
    with torch.no_grad():
        both, turned = network(*inputs), network(*(tensor[1:].flip(1) for tensor in inputs))
    assert torch.allclose(turned.depths.depth[-1], both.depths.depth[-1][1:].flip(1), rtol=1e-8)
    for view in range(views):
        a, b = both.gaussians[1], turned.gaussians[0]
        a, b = a.select(a.views == view), b.select(b.views == views - 1 - view)
        assert (
            len(a) > 0
            and torch.allclose(a.means, b.means, atol=1e-8)
            and torch.allclose(a.harmonics, b.harmonics, atol=1e-8)
        )


def test_heads_read_the_candidates_of_a_single_swept_level(small, make_inputs):
    single = dataclasses.replace(small.cost_volume, levels=small.cost_volume.levels[:1])
    with pytest.raises(ValueError, match=r"`heads\.candidates` must be the 8 of the finest sweep, got 4"):
        dataclasses.replace(small, cost_volume=single)
    heads = dataclasses.replace(small.heads, candidates=8)
    network = PanSplat(dataclasses.replace(small, cost_volume=single, heads=heads)).double().eval()
    with torch.no_grad():
        output = network(*make_inputs(32))
    assert len(output.depths.levels) == 1 and output.gaussians[0].levels.unique().tolist() == [0, 1, 2, 3]


def test_heads_that_do_not_fit_the_features_are_refused(small):
    with pytest.raises(ValueError, match=r"must be \(16, 8, 8, 4\), the channels of the features"):
        dataclasses.replace(small, heads=dataclasses.replace(small.heads, feature_channels=(8, 8, 8, 4)))


@pytest.mark.slow
def test_bfloat16_prediction_is_close_to_float32_and_in_float32(randomize, make_inputs):
    config = PanSplatConfig(
        features=FeaturePyramidConfig(channels=(8, 8, 16, 32), transformer=TransformerConfig(channels=32, blocks=2)),
        cost_volume=CostVolumeConfig(
            mono_channels=0, levels=(SweepLevel(3, 32, 16, 32), SweepLevel(2, 16, 8, 32), SweepLevel(1, 8, 8, 32))
        ),
        heads=HeadsConfig(feature_channels=(32, 16, 8, 8), candidates=8, layers=1, adapter=AdapterConfig(degree=1)),
    )
    inputs = [tensor.float() for tensor in make_inputs(32)]
    with torch.no_grad():
        exact, rounded = (
            randomize(PanSplat(config, "fixed", precision=precision)).float()(*inputs)
            for precision in ("float32", "bfloat16")
        )
    for a, b in zip(exact.depths.inverse_depth, rounded.depths.inverse_depth, strict=True):
        assert b.dtype == torch.float32 and not torch.equal(a, b)
        assert float(((b - a).abs() / a).median()) < 0.02
    (a,), (b,) = exact.gaussians, rounded.gaussians
    for name in ("means", "scales", "opacities", "harmonics"):
        x, y = getattr(a, name), getattr(b, name)
        assert y.dtype == torch.float32
        assert 0 < float((y - x).pow(2).mean().sqrt()) < 0.05 * float(x.std())
    assert torch.equal(a.levels, b.levels)
