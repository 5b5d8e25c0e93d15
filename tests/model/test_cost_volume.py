"""Spherical cost volume and U-Net: agreement with the official code, candidates, symmetries, hard cases."""

from dataclasses import replace

import pytest
import torch
from synthetic_scenes import draw_noise

from pansplat.geometry.warp import warp_panorama
from pansplat.model.cost_volume import (
    CostVolumeConfig,
    SphericalCostVolume,
    SweepLevel,
    correlate_views,
    make_first_candidates,
    regress_depth,
)

_SMALL = CostVolumeConfig(mono_channels=3, levels=(SweepLevel(2, 8, 6, 32), SweepLevel(1, 4, 4, 32)))


def _inputs(views=2, batch=1):
    """Features of two levels and one that is not used, poses, bounds and monocular features."""
    poses = torch.eye(4, dtype=torch.float64).repeat(batch, views, 1, 1)
    poses[..., :3, 3] = 0.5 * draw_noise(batch, views, 3)
    features = [
        draw_noise(batch, views, 8, 8, 16),
        draw_noise(batch, views, 4, 16, 32),
        draw_noise(batch, views, 2, 32, 64),
    ]
    bounds = (torch.full((batch, views), depth, dtype=torch.float64) for depth in (0.5, 10.0))
    return features, poses, *bounds, draw_noise(batch, views, 3, 16, 32)


@pytest.fixture(scope="module")
def small(randomize):
    return randomize(SphericalCostVolume(_SMALL, "fixed"))


def test_each_view_is_correlated_with_the_mean_of_the_others():
    (features, *_), poses, near, far, _ = _inputs(views=3)
    candidates = make_first_candidates((1 / far, 1 / near), 4, (8, 16))
    result = correlate_views(features, candidates, poses, "fixed")
    for view in range(3):
        others = []
        for other in {0, 1, 2} - {view}:
            pose = torch.linalg.inv(poses[:, other]) @ poses[:, view]
            warped = warp_panorama(features[:, other], candidates[:, view], pose)
            others.append((features[:, view, :, None] * warped).sum(dim=1) / 8**0.5)
        assert torch.allclose(result[:, view], (others[0] + others[1]) / 2, atol=1e-12)


def test_scaling_the_world_scales_the_depth_of_a_single_level(randomize):
    # Finer levels also read the centre, in 1 / metres.
    network = randomize(SphericalCostVolume(replace(_SMALL, levels=_SMALL.levels[:1]), "fixed"))
    features, poses, near, far, mono = _inputs()
    scaled = poses.clone()
    scaled[..., :3, 3] *= 7
    before, after = network(features, poses, near, far, mono), network(features, scaled, 7 * near, 7 * far, mono)
    assert torch.allclose(after.depth[0], 7 * before.depth[0], rtol=1e-10)


def test_depths_lie_within_the_bounds(small):
    depths = small(*_inputs())
    assert [tuple(depth.shape) for depth in depths.depth] == [(1, 2, 8, 16), (1, 2, 16, 32)]
    assert all((depth >= 0.5 - 1e-9).all() and (depth <= 10 + 1e-9).all() for depth in depths.depth)
    assert all((level.confidence >= 1 / 6).all() and (level.confidence <= 1).all() for level in depths.levels)


@pytest.mark.parametrize("changes", [{"mono_channels": 0}, {"refinement": "none"}, {"levels": _SMALL.levels[:1]}])
def test_each_shape_runs(randomize, changes):
    config = replace(_SMALL, **changes)
    network = randomize(SphericalCostVolume(config, "fixed"))
    features, poses, near, far, mono = _inputs()
    depths = network(features, poses, near, far, mono if config.mono_channels else None)
    assert len(depths.levels) == len(network.levels) == len(config.levels)
    assert any("unet" in name for name, _ in network.named_parameters()) == (config.refinement == "unet")


def test_identical_views_give_finite_depths_and_gradients(small):
    small.zero_grad()
    features, poses, *rest = _inputs()
    depths = small(features, torch.eye(4).expand_as(poses).double(), *rest)
    assert all(torch.isfinite(depth).all() for depth in depths.depth)
    sum(depth.sum() for depth in depths.depth).backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in small.parameters() if parameter.grad is not None)


def test_equal_bounds_give_that_depth(small):
    features, poses, near, _, mono = _inputs()
    depths = small(features, poses, 4 * near, 4 * near, mono)
    assert all(torch.allclose(depth, torch.tensor(2.0).double(), rtol=1e-12) for depth in depths.depth)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_logits_choose_one_candidate_or_their_mean_in_float32(dtype):
    candidates = make_first_candidates((torch.full((1, 2), 0.1), torch.full((1, 2), 2.0)), 6, (8, 16))
    logits = torch.full((1, 2, 6, 8, 16), -1e4, dtype=dtype)
    logits[:, :, 4] = 1e4
    level = regress_depth(2, logits.requires_grad_(), candidates)
    assert level.inverse_depth.dtype == torch.float32
    assert torch.equal(level.inverse_depth, candidates[:, :, 4])
    level.inverse_depth.sum().backward()
    assert torch.isfinite(logits.grad).all()
    level = regress_depth(2, torch.zeros_like(logits), candidates)
    assert torch.allclose(level.inverse_depth, candidates.mean(dim=2), rtol=1e-6)
