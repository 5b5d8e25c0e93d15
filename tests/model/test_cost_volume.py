"""Spherical cost volume and U-Net: agreement with the official code, candidates, ablations, symmetries, hard cases."""

import math
from dataclasses import replace

import pytest
import torch

from pansplat.errors import InputError
from pansplat.geometry.correlation import correlate
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.geometry.warp import warp_panorama
from pansplat.model.cost_volume import (
    CostVolumeConfig,
    JointAttention,
    ResBlock,
    SphericalCostVolume,
    SweepLevel,
    UNet,
    correlate_views,
    make_candidates_around,
    make_first_candidates,
    regress_depth,
)

_SMALL = CostVolumeConfig(mono_channels=3, levels=(SweepLevel(2, 8, 6, 32), SweepLevel(1, 4, 4, 32)))
_BOUNDS = (torch.full((1, 2), 0.1, dtype=torch.float64), torch.full((1, 2), 2.0, dtype=torch.float64))
H, W = 8, 16  # of the coarsest map


def _noise(*shape, seed=3, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def _inputs(views=2, batch=1):
    """Features of two levels and one that is not used, poses, bounds and monocular features."""
    poses = torch.eye(4, dtype=torch.float64).repeat(batch, views, 1, 1)
    poses[..., :3, 3] = 0.5 * _noise(batch, views, 3)
    features = [_noise(batch, views, 8, 8, 16), _noise(batch, views, 4, 16, 32), _noise(batch, views, 2, 32, 64)]
    bounds = (torch.full((batch, views), depth, dtype=torch.float64) for depth in (0.5, 10.0))
    return features, poses, *bounds, _noise(batch, views, 3, 16, 32)


@pytest.fixture(scope="module")
def small(randomize):
    return randomize(SphericalCostVolume(_SMALL, "fixed"))


@pytest.mark.exhaustive
@pytest.mark.slow
@pytest.mark.shared
def test_depths_match_the_official_code(run_official, golden, error):
    truth, run = golden("pansplat_64x128_fp32attn"), run_official()
    for stage, level in enumerate(run.outputs["cost_volume"].levels):
        assert level.level == 3 - stage
        refine = f"cost_volume.levels.{level.level}.refine"
        assert error(run.inputs[refine][0], truth[f"s{stage}.unet_in"]) < 2e-4
        assert error(run.outputs[refine][0], truth[f"s{stage}.unet_out"]) < 2e-4
        assert error(level.logits, truth[f"s{stage}.logits"]) < 2e-4
        assert error(level.inverse_depth, truth[f"s{stage}.disp"]) < 2e-4
        assert error(level.depth, truth[f"s{stage}.depth"]) < 2e-4
        assert error(level.confidence[0], truth[f"s{stage}.pdf_max"][:, 0]) < 2e-4
        if stage:
            assert error(level.candidates, truth[f"s{stage}.candidates"]) < 2e-4


# Candidates and their mean


def test_the_first_candidates_run_evenly_from_far_to_near():
    candidates = make_first_candidates(_BOUNDS, 5, (2, 4))
    assert candidates.shape == (1, 2, 5, 2, 4)
    assert torch.allclose(candidates[0, 1, :, 1, 3], torch.tensor((0.1, 0.575, 1.05, 1.525, 2.0)).double())


def test_later_candidates_lie_around_the_centre_within_the_bounds():
    centre = torch.tensor((0.2, 1.0)).double().expand(1, 2, 3, 2)
    candidates = make_candidates_around(centre, torch.full((1, 2), 0.1).double(), _BOUNDS, 4)
    assert torch.allclose(candidates[0, 0, :, 0, 0], torch.tensor((0.1, 0.1, 0.2, 0.3)).double())
    assert torch.allclose(candidates[0, 0, :, 0, 1], torch.tensor((0.8, 0.9, 1.0, 1.1)).double())


def test_the_spacing_halves_from_level_to_level(small):
    features, *rest = _inputs()
    first, second = (level.candidates for level in small(features, *rest).levels)
    inside = (second > 0.1 + 1e-9) & (second < 2 - 1e-9)
    steps = second.diff(dim=2)[inside[:, :, 1:] & inside[:, :, :-1]]
    assert torch.allclose(steps, first.diff(dim=2).mean() / 2, atol=1e-12)


# Correlation of views


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


# Symmetries, ablations, gradients


def test_scaling_the_world_scales_the_depth_of_a_single_level(randomize):
    # Finer levels also read the centre, in 1 / metres.
    network = randomize(SphericalCostVolume(replace(_SMALL, sweep="single"), "fixed"))
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


@pytest.mark.parametrize(
    "changes", [{"sweep": "single"}, {"mono_channels": 0}, {"refinement": "none"}, {"levels": _SMALL.levels[:1]}]
)
def test_each_ablation_runs(randomize, changes):
    config = replace(_SMALL, **changes)
    network = randomize(SphericalCostVolume(config, "fixed"))
    features, poses, near, far, mono = _inputs()
    depths = network(features, poses, near, far, mono if config.mono_channels else None)
    assert len(depths.levels) == len(network.levels) == (2 if config.swept_levels == _SMALL.levels else 1)
    assert any("unet" in name for name, _ in network.named_parameters()) == (config.refinement == "unet")


def test_no_gradient_flows_from_a_level_to_the_coarser(small):
    small.zero_grad()
    small(*_inputs()).inverse_depth[1].sum().backward()
    assert all(parameter.grad is None for parameter in small.levels["2"].parameters())
    assert any(parameter.grad is not None for parameter in small.levels["1"].parameters())


# Refusals


@pytest.mark.parametrize(
    ("compat", "views", "message"), [("fixed", 1, "two or more views, got 1"), ("official", 3, "exactly two views")]
)
def test_unusable_numbers_of_views_are_refused(compat, views, message):
    with pytest.raises(InputError, match=message):
        SphericalCostVolume(_SMALL, compat)(*_inputs(views))


def test_maps_that_the_unet_cannot_halve_are_refused(small):
    features, *rest = _inputs()
    with pytest.raises(InputError, match="that 4 divides, got 6x12"):
        small([features[0][..., :6, :12]], *rest)


def test_monocular_features_must_be_given_exactly_if_configured(small, randomize):
    *rest, mono = _inputs()
    with pytest.raises(ValueError, match="mono_channels=3"):
        small(*rest)
    with pytest.raises(ValueError, match="mono_channels=0"):
        randomize(SphericalCostVolume(replace(_SMALL, mono_channels=0), "fixed"))(*rest, mono)


# Hard cases, in fixed mode with two views and without monocular features


_HARD_CASES = replace(_SMALL, mono_channels=0)


def _features(dtype=torch.float64):
    return [_noise(1, 2, 8, H, W, dtype=dtype), _noise(1, 2, 4, 2 * H, 2 * W, dtype=dtype)]


def _translation(vector):
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, 3] = vector
    return pose


def _poses(baseline=(0.7, 0.1, -0.3)):
    return torch.stack((_translation(torch.zeros(3)), _translation(torch.tensor(baseline))), dim=1)


def _bounds(near=0.5, far=10.0):
    return torch.full((1, 2), near, dtype=torch.float64), torch.full((1, 2), far, dtype=torch.float64)


def _candidates(near, far, count=6, size=(H, W)):
    return make_first_candidates((1 / far, 1 / near), count, size)


@pytest.fixture(scope="module")
def network(randomize):
    return randomize(SphericalCostVolume(_HARD_CASES, "fixed"))


@pytest.mark.hard_case(38)
def test_identical_views_give_finite_depths_and_gradients(network):
    network.zero_grad()
    depths = network(_features(), _poses((0, 0, 0)), *_bounds())
    assert all(torch.isfinite(depth).all() for depth in depths.depth)
    sum(depth.sum() for depth in depths.depth).backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in network.parameters())


@pytest.mark.hard_case(39)
def test_at_the_epipole_all_candidates_have_the_same_cost():
    ray = pixel_directions(H, W, dtype=torch.float64)[3, 5]
    pose = _translation(-0.3 * ray)  # nearer than all candidates
    volume = correlate(*_noise(2, 1, 8, H, W), _candidates(*_bounds())[0, :1], pose)[0, :, 3, 5]
    assert torch.allclose(volume, volume[:1].expand_as(volume), atol=1e-12)


@pytest.mark.hard_case(40)
def test_samples_continue_across_the_seam_and_the_poles():
    """A rotated camera samples a smooth field on the sphere without a jump."""
    height, width = 64, 128
    field = pixel_directions(height, width, dtype=torch.float64).movedim(-1, 0)[None]
    for quat in ((0.0, 1.0, 0.0, 0.0), (0.7, 0.7, 0.1, 0.0), (0.1, 0.0, 0.9, 0.3)):
        pose = torch.eye(4, dtype=torch.float64)[None].clone()
        pose[0, :3, :3] = rotations_from_quats(torch.tensor(quat, dtype=torch.float64))
        warped = warp_panorama(field, torch.ones(1, 1, height, width).double(), pose)[0, :, 0]
        truth = torch.einsum("ij,jhw->ihw", pose[0, :3, :3], field[0])
        assert (warped - truth).abs().max() < 2e-3  # a jump would be of the order of 1


@pytest.mark.hard_case(41)
def test_equal_bounds_give_that_depth(network):
    depths = network(_features(), _poses(), *_bounds(2.0, 2.0))
    assert all(torch.allclose(depth, torch.tensor(2.0).double(), rtol=1e-12) for depth in depths.depth)


@pytest.mark.hard_case(41)
def test_finer_levels_have_candidates_around_a_single_candidate(randomize):
    config = CostVolumeConfig(mono_channels=0, levels=(SweepLevel(2, 8, 1, 32), SweepLevel(1, 4, 4, 32)))
    level = randomize(SphericalCostVolume(config, "fixed"))(_features(), _poses(), *_bounds()).levels[1]
    expected = torch.tensor((0.1, 0.1, 1.05, 2.0)).double()  # about the middle, by half the range, clamped
    assert torch.allclose(level.candidates[0, 0, :, 3, 3], expected)


@pytest.mark.hard_case(42)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_logits_choose_one_candidate_or_their_mean_in_float32(dtype):
    candidates = _candidates(*(bound.float() for bound in _bounds()))
    logits = torch.full((1, 2, 6, H, W), -1e4, dtype=dtype)
    logits[:, :, 4] = 1e4
    level = regress_depth(2, logits.requires_grad_(), candidates)
    assert level.inverse_depth.dtype == torch.float32
    assert torch.equal(level.inverse_depth, candidates[:, :, 4])
    level.inverse_depth.sum().backward()
    assert torch.isfinite(logits.grad).all()
    level = regress_depth(2, torch.zeros_like(logits), candidates)
    assert torch.allclose(level.inverse_depth, candidates.mean(dim=2), rtol=1e-6)


@pytest.mark.hard_case(42)
@pytest.mark.parametrize("backend", ["torch", "kernel"])
def test_products_beyond_half_precision_do_not_overflow(backend):
    features = torch.full((1, 128, H, W), 30.0, dtype=torch.float16).requires_grad_()
    pose = _poses()[:, 1]
    result = correlate(features, features, _candidates(*_bounds())[0, :1].float(), pose, "sphere", backend)
    assert torch.allclose(result, torch.tensor(128 * 900 / math.sqrt(128)), rtol=1e-4)
    result.mean().backward()
    assert torch.isfinite(features.grad).all()


@pytest.mark.hard_case(43)
def test_a_half_turn_of_one_camera_rolls_its_panorama_only():
    (features, _), candidates = _features(), _candidates(*_bounds())
    half_turn = torch.diag(torch.tensor((-1.0, 1.0, -1.0, 1.0)).double())
    poses = _poses()
    turned = torch.stack((poses[:, 0], poses[:, 1] @ half_turn), dim=1)
    rolled = torch.stack((features[:, 0], features[:, 1].roll(W // 2, -1)), dim=1)
    before = correlate_views(features, candidates, poses, "fixed")
    after = correlate_views(rolled, candidates, turned, "fixed")
    assert torch.allclose(after[:, 0], before[:, 0], atol=1e-11)
    assert torch.allclose(after[:, 1], before[:, 1].roll(W // 2, -1), atol=1e-11)


@pytest.mark.hard_case(44)
def test_over_a_depth_ratio_of_10000_each_candidate_is_exact():
    bounds = [bound.float() for bound in _bounds(0.01, 100.0)]
    candidates = _candidates(*bounds, count=128)
    assert (candidates.diff(dim=2) > 0).all()
    for index in (0, 1, 64, 127):
        logits = torch.full((1, 2, 128, H, W), -1e4)
        logits[:, :, index] = 1e4
        assert torch.equal(regress_depth(3, logits, candidates).inverse_depth, candidates[:, :, index])


# U-Net


@pytest.fixture(scope="module")
def unet(randomize):
    return randomize(UNet(32, "sphere"))


def test_rolling_by_a_pixel_of_the_bottleneck_rolls_the_output(unet):
    maps = _noise(1, 2, 32, 8, 16)
    assert torch.allclose(unet(maps.roll(4, -1)), unet(maps).roll(4, -1), atol=1e-11)


def test_views_depend_on_each_other_and_batch_items_do_not(unet):
    maps = _noise(2, 2, 32, 4, 8)
    before = unet(maps)
    maps[0, 1] += 1
    moved = (unet(maps) - before).abs().amax(dim=(2, 3, 4))
    assert moved[0].min() > 1e-3 and moved[1].max() < 1e-12


def test_an_untrained_block_is_its_shortcut():
    maps = _noise(2, 32, 4, 8)
    assert torch.equal(ResBlock(32, 32, "sphere").double()(maps), maps)
    block = ResBlock(32, 64, "sphere").double()
    assert torch.equal(block(maps), block.shortcut(maps))


def test_untrained_attention_adds_zero():
    maps = _noise(2, 32, 4, 8)
    assert torch.equal(JointAttention(32, "float32").double()(maps, 2), maps)
