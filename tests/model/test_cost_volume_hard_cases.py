"""Cost volume in hard cases, as numbered in the project's list; all in fixed mode."""

import math

import pytest
import torch

from pansplat.geometry.correlation import correlate
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.geometry.warp import warp_panorama
from pansplat.model.cost_volume import (
    CostVolumeConfig,
    SphericalCostVolume,
    SweepLevel,
    correlate_views,
    first_candidates,
    regress_depth,
)

_CONFIG = CostVolumeConfig(mono_channels=0, levels=(SweepLevel(2, 8, 6, 32), SweepLevel(1, 4, 4, 32)))
H, W = 8, 16


def _noise(*shape, seed=3, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def _features(dtype=torch.float64):
    return [_noise(1, 2, 8, H, W, dtype=dtype), _noise(1, 2, 4, 2 * H, 2 * W, dtype=dtype)]


def _poses(baseline=(0.7, 0.1, -0.3)):
    poses = torch.eye(4, dtype=torch.float64).repeat(1, 2, 1, 1)
    poses[0, 1, :3, 3] = torch.tensor(baseline)
    return poses


def _bounds(near=0.5, far=10.0):
    return torch.full((1, 2), near, dtype=torch.float64), torch.full((1, 2), far, dtype=torch.float64)


def _candidates(near, far, count=6, size=(H, W)):
    return first_candidates((1 / far, 1 / near), count, size)


@pytest.fixture(scope="module")
def network(randomize):
    return randomize(SphericalCostVolume(_CONFIG, "fixed"))


# 38: no baseline


def test_38_without_a_baseline_the_cost_is_the_same_for_all_candidates():
    for dtype in (torch.float32, torch.float64):
        candidates = _candidates(*(bound.to(dtype) for bound in _bounds()))
        volume = correlate_views(_features(dtype)[0], candidates, _poses((0, 0, 0)), "fixed")
        assert torch.equal(volume, volume[:, :, :1].expand_as(volume))


def test_38_without_a_baseline_identical_views_match_fully():
    features = _noise(1, 1, 8, H, W).expand(1, 2, -1, -1, -1)
    volume = correlate_views(features, _candidates(*_bounds()), _poses((0, 0, 0)), "fixed")
    assert torch.allclose(volume, (features.square().sum(dim=2) / 8**0.5)[:, :, None].expand_as(volume), atol=1e-12)


def test_38_a_constant_cost_gives_the_mean_inverse_depth():
    candidates = _candidates(*_bounds())
    level = regress_depth(2, torch.zeros(1, 2, 6, H, W).double(), candidates)
    assert torch.allclose(level.inverse_depth, candidates.mean(dim=2), atol=1e-14)


def test_38_identical_views_give_finite_depths_and_gradients(network):
    network.zero_grad()
    depths = network(_features(), _poses((0, 0, 0)), *_bounds())
    assert all(torch.isfinite(depth).all() for depth in depths.depth)
    sum(depth.sum() for depth in depths.depth).backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in network.parameters())


# 39: the epipole


def test_39_a_candidate_at_the_other_camera_is_finite_with_its_gradient():
    inverse_depth = 0.5
    other_camera = pixel_directions(H, W, dtype=torch.float64)[3, 5] / inverse_depth
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, 3] = -other_camera
    reference, other = (_noise(1, 4, H, W, seed=seed).requires_grad_() for seed in (1, 2))
    candidates = torch.tensor((0.25, inverse_depth, 1.0)).double()[None, :, None, None].expand(1, 3, H, W)
    result = correlate(reference, other, candidates, pose)
    result.sum().backward()
    assert all(torch.isfinite(t).all() for t in (result, reference.grad, other.grad))


def test_39_candidates_before_and_behind_the_other_camera_are_seen_in_opposite_directions():
    ray = pixel_directions(H, W, dtype=torch.float64)[3, 5]
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, 3] = -2 * ray
    seen = pixel_directions(H, W, dtype=torch.float64).movedim(-1, 0)[None]
    candidates = torch.tensor((0.25, 1.0)).double()[None, :, None, None].expand(1, 2, H, W)
    behind, before = warp_panorama(seen, candidates, pose)[0, :, :, 3, 5].T
    assert torch.allclose(behind, ray, atol=0.05) and torch.allclose(before, -ray, atol=0.1)


def test_39_at_the_epipole_candidates_do_not_differ():
    ray = pixel_directions(H, W, dtype=torch.float64)[3, 5]
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, 3] = -0.3 * ray  # nearer than all candidates
    volume = correlate(*_noise(2, 1, 8, H, W), _candidates(*_bounds())[0, :1], pose)[0, :, 3, 5]
    assert torch.allclose(volume, volume[:1].expand_as(volume), atol=1e-12)


# 40: over the seam and over the poles


def test_40_samples_go_on_over_the_seam_and_the_poles():
    """A camera turned upside down or about sees a smooth field on the sphere without a jump."""
    height, width = 64, 128
    field = pixel_directions(height, width, dtype=torch.float64).movedim(-1, 0)[None]
    for quat in ((0.0, 1.0, 0.0, 0.0), (0.7, 0.7, 0.1, 0.0), (0.1, 0.0, 0.9, 0.3)):
        pose = torch.eye(4, dtype=torch.float64)[None].clone()
        pose[0, :3, :3] = rotations_from_quats(torch.tensor(quat, dtype=torch.float64))
        warped = warp_panorama(field, torch.ones(1, 1, height, width).double(), pose)[0, :, 0]
        truth = torch.einsum("ij,jhw->ihw", pose[0, :3, :3], field[0])
        assert (warped - truth).abs().max() < 2e-3  # a jump would be of the order of 1


def test_40_turning_all_cameras_by_half_a_turn_turns_the_volume():
    (features, _), poses, candidates = _features(), _poses(), _candidates(*_bounds())
    turned = poses @ torch.diag(torch.tensor((-1.0, 1.0, -1.0, 1.0)).double())
    volume = correlate_views(features, candidates, poses, "fixed")
    assert torch.allclose(
        correlate_views(features.roll(W // 2, -1), candidates, turned, "fixed"), volume.roll(W // 2, -1), atol=1e-11
    )


# 41: bounds


def test_41_equal_bounds_give_that_depth(network):
    depths = network(_features(), _poses(), *_bounds(2.0, 2.0))
    assert all(torch.allclose(depth, torch.tensor(2.0).double(), rtol=1e-12) for depth in depths.depth)


def test_41_one_candidate_is_the_depth(randomize):
    config = CostVolumeConfig(sweep="single", mono_channels=0, levels=(SweepLevel(2, 8, 1, 32),))
    level = randomize(SphericalCostVolume(config, "fixed"))(_features(), _poses(), *_bounds()).levels[0]
    assert torch.allclose(level.inverse_depth, torch.tensor((0.1 + 2) / 2).double())
    assert torch.equal(level.confidence, torch.ones_like(level.confidence))


def test_41_one_candidate_leaves_finer_levels_their_search(randomize):
    config = CostVolumeConfig(mono_channels=0, levels=(SweepLevel(2, 8, 1, 32), SweepLevel(1, 4, 4, 32)))
    level = randomize(SphericalCostVolume(config, "fixed"))(_features(), _poses(), *_bounds()).levels[1]
    expected = torch.tensor((0.1, 0.1, 1.05, 2.0)).double()  # about the middle, by half the range, clamped
    assert torch.allclose(level.candidates[0, 0, :, 3, 3], expected)


def test_41_no_logits_lead_out_of_the_bounds(network):
    with torch.no_grad():
        for sign in (-1, 1):
            scaled = [1e3 * sign * features for features in _features()]
            depths = network(scaled, _poses(), *_bounds())
            assert all(((depth >= 0.5 - 1e-12) & (depth <= 10 + 1e-9)).all() for depth in depths.depth)


# 42: half precision


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_42_huge_logits_in_half_precision_choose_one_candidate(dtype):
    candidates = _candidates(*(bound.float() for bound in _bounds()))
    logits = torch.full((1, 2, 6, H, W), -1e4, dtype=dtype)
    logits[:, :, 4] = 1e4
    level = regress_depth(2, logits.requires_grad_(), candidates)
    assert level.inverse_depth.dtype == torch.float32
    assert torch.equal(level.inverse_depth, candidates[:, :, 4])
    level.inverse_depth.sum().backward()
    assert torch.isfinite(logits.grad).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_42_the_mean_is_taken_in_float32(dtype):
    candidates = _candidates(*(bound.float() for bound in _bounds()))
    level = regress_depth(2, torch.zeros(1, 2, 6, H, W, dtype=dtype), candidates)
    assert torch.allclose(level.inverse_depth, candidates.mean(dim=2), rtol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("backend", ["torch", "kernel"])
def test_42_products_beyond_half_precision_do_not_overflow(dtype, backend):
    features = torch.full((1, 128, H, W), 30.0, dtype=dtype).requires_grad_()
    pose = _poses()[:, 1]
    result = correlate(features, features, _candidates(*_bounds())[0, :1].float(), pose, "sphere", backend)
    assert torch.allclose(result, torch.tensor(128 * 900 / math.sqrt(128)), rtol=1e-4)
    result.mean().backward()
    assert torch.isfinite(features.grad).all()


def test_42_a_network_in_bfloat16_is_near_the_one_in_float32(randomize):
    inputs = (_features(torch.float32), _poses(), *(bound.float() for bound in _bounds()))
    full = randomize(SphericalCostVolume(_CONFIG, "fixed")).float()
    half = randomize(SphericalCostVolume(_CONFIG, "fixed", precision="bfloat16")).float()
    with torch.no_grad():
        truth = full(*inputs).inverse_depth[0]
        result = half(*inputs).inverse_depth[0]
    assert not torch.equal(result, truth)
    assert result.dtype == torch.float32
    assert (result - truth).abs().mean() < 0.02 * (2.0 - 0.1)


# 43: turned cameras


def test_43_a_tiny_turn_changes_little(network):
    angle = 1e-7
    turned = _poses()
    turned[0, 1, 0, 0] = turned[0, 1, 2, 2] = math.cos(angle)
    turned[0, 1, 0, 2], turned[0, 1, 2, 0] = math.sin(angle), -math.sin(angle)
    before, after = (network(_features(), poses, *_bounds()).depth[0] for poses in (_poses(), turned))
    assert not torch.equal(before, after)
    assert torch.allclose(before, after, rtol=1e-3)


def test_43_a_half_turn_of_one_camera_only_turns_its_panorama():
    (features, _), candidates = _features(), _candidates(*_bounds())
    half_turn = torch.diag(torch.tensor((-1.0, 1.0, -1.0, 1.0)).double())
    poses = _poses()
    turned = torch.stack((poses[:, 0], poses[:, 1] @ half_turn), dim=1)
    rolled = torch.stack((features[:, 0], features[:, 1].roll(W // 2, -1)), dim=1)
    before = correlate_views(features, candidates, poses, "fixed")
    after = correlate_views(rolled, candidates, turned, "fixed")
    assert torch.allclose(after[:, 0], before[:, 0], atol=1e-11)
    assert torch.allclose(after[:, 1], before[:, 1].roll(W // 2, -1), atol=1e-11)


# 44: a depth range of 1e4


def test_44_over_a_depth_ratio_of_10000_each_candidate_can_be_told_exactly():
    bounds = [bound.float() for bound in _bounds(0.01, 100.0)]
    candidates = _candidates(*bounds, count=128)
    assert (candidates.diff(dim=2) > 0).all()
    for index in (0, 1, 64, 127):
        logits = torch.full((1, 2, 128, H, W), -1e4)
        logits[:, :, index] = 1e4
        assert torch.equal(regress_depth(3, logits, candidates).inverse_depth, candidates[:, :, index])


def test_44_over_a_depth_ratio_of_10000_a_float32_warp_is_as_exact_as_over_10():
    poses, candidates = _poses(), _candidates(*_bounds(0.01, 100.0), count=16)
    features = _noise(1, 8, H, W)
    pose = torch.linalg.inv(poses[:, 1]) @ poses[:, 0]
    truth = warp_panorama(features, candidates[0, :1], pose)
    single = warp_panorama(features.float(), candidates[0, :1].float(), pose.float())
    assert (single - truth).abs().max() < 2e-4


def test_44_over_a_depth_ratio_of_10000_depths_are_finite(network):
    depths = network(_features(), _poses(), *_bounds(0.01, 100.0))
    assert all(((depth >= 0.01 - 1e-9) & (depth <= 100 + 1e-6)).all() for depth in depths.depth)
