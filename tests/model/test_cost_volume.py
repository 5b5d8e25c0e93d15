"""The spherical cost volume: the original's numbers, its ablations, and the sphere's symmetries."""

from dataclasses import replace

import pytest
import torch

from pansplat.errors import InputError
from pansplat.geometry.warp import warp_panorama
from pansplat.model.cost_volume import (
    CostVolumeConfig,
    SphericalCostVolume,
    SweepLevel,
    candidates_around,
    correlate_views,
    first_candidates,
    regress_depth,
)
from pansplat.model.feature_pyramid import FeaturePyramid, FeaturePyramidConfig

_SMALL = CostVolumeConfig(
    mono_channels=3, levels=(SweepLevel(2, 8, 6, 32), SweepLevel(1, 4, 4, 32))
)  # fmt: skip
_BOUNDS = (torch.full((1, 2), 0.1, dtype=torch.float64), torch.full((1, 2), 2.0, dtype=torch.float64))


def _noise(*shape, seed=3):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _inputs(views=2, batch=1):
    """Features of two levels, poses, bounds and monocular features."""
    poses = torch.eye(4, dtype=torch.float64).repeat(batch, views, 1, 1)
    poses[..., :3, 3] = 0.5 * _noise(batch, views, 3)
    features = [_noise(batch, views, 8, 8, 16), _noise(batch, views, 4, 16, 32), _noise(batch, views, 2, 32, 64)]
    bounds = (torch.full((batch, views), depth, dtype=torch.float64) for depth in (0.5, 10.0))
    return features, poses, *bounds, _noise(batch, views, 3, 16, 32)


def _relative(result, truth):
    return float((result - truth).abs().max() / truth.std())


@pytest.fixture(scope="module")
def small(randomize):
    return randomize(SphericalCostVolume(_SMALL, "fixed"))


# Parity


def _mono_features(truth):
    """A map of which each level's resizing picks the monocular features that the original saw."""
    mono = torch.zeros(2, 32, 256, 512)
    for stage, factor in enumerate((32, 16, 8)):
        for row in (0, 1):
            for column in (0, 1):  # the four middle pixels of each block
                i, j = factor // 2 - 1 + row, factor // 2 - 1 + column
                mono[:, :, i::factor, j::factor] = truth[f"s{stage}.unet_in"][:, -32:]
    return mono[None]


def _predict(truth, network):
    features = [truth[f"backbone.feat.{stage}"] for stage in range(4)]
    with torch.inference_mode():
        return network(features, truth["in.extrinsics"], truth["in.near"], truth["in.far"], _mono_features(truth))


def test_depths_are_the_originals(golden, load_recipe):
    truth = golden("pansplat_64x128_fp32attn")
    network = load_recipe(SphericalCostVolume(CostVolumeConfig(), "official"), "cost_volume")
    refined = []
    for level in network.levels.values():
        level.refine.register_forward_hook(lambda module, inputs, output: refined.append((inputs[0], output)))
    depths = _predict(truth, network)
    for stage, level in enumerate(depths.levels):
        assert level.level == 3 - stage
        assert _relative(refined[stage][0][0], truth[f"s{stage}.unet_in"]) < 2e-4
        assert _relative(refined[stage][1][0], truth[f"s{stage}.unet_out"]) < 2e-4
        assert _relative(level.logits, truth[f"s{stage}.logits"]) < 2e-4
        assert _relative(level.inverse_depth, truth[f"s{stage}.disp"]) < 2e-4
        assert _relative(level.depth, truth[f"s{stage}.depth"]) < 2e-4
        assert _relative(level.confidence[0], truth[f"s{stage}.pdf_max"][:, 0]) < 2e-4
        if stage:
            assert _relative(level.candidates, truth[f"s{stage}.candidates"]) < 2e-4


def test_bfloat16_attention_is_the_originals_up_to_flipped_roundings(golden, load_recipe):
    """The last bit of a float32 flips a rounding to bfloat16, and a flip grows to 1% of a deviation in the end."""
    single, half = golden("pansplat_64x128_fp32attn"), golden("pansplat_64x128_bf16attn")
    pyramid = load_recipe(FeaturePyramid(FeaturePyramidConfig(), "official", "bfloat16"), "features")
    network = load_recipe(SphericalCostVolume(CostVolumeConfig(), "official", "bfloat16"), "cost_volume")
    with torch.inference_mode():
        features = pyramid(single["in.image"])
    depths = _predict(single | {f"backbone.feat.{stage}": maps for stage, maps in enumerate(features)}, network)
    for stage, level in enumerate(depths.levels):
        assert _relative(level.depth, half[f"s{stage}.depth"]) < 0.02
        assert _relative(level.confidence[0], half[f"s{stage}.pdf_max"][:, 0]) < 0.04
        assert _relative(level.depth, single[f"s{stage}.depth"]) > 2e-3


def test_fixed_depths_are_not_the_originals(golden, load_recipe):
    truth = golden("pansplat_64x128_fp32attn")
    depths = _predict(truth, load_recipe(SphericalCostVolume(CostVolumeConfig(), "fixed"), "cost_volume"))
    assert all(_relative(level.depth, truth[f"s{stage}.depth"]) > 0.1 for stage, level in enumerate(depths.levels))


# Candidates and their mean


def test_the_first_candidates_run_evenly_from_far_to_near():
    candidates = first_candidates(_BOUNDS, 5, (2, 4))
    assert candidates.shape == (1, 2, 5, 2, 4)
    assert torch.allclose(candidates[0, 1, :, 1, 3], torch.tensor((0.1, 0.575, 1.05, 1.525, 2.0)).double())


def test_later_candidates_lie_about_the_centre_within_the_bounds():
    centre = torch.tensor((0.2, 1.0)).double().expand(1, 2, 3, 2)
    candidates = candidates_around(centre, torch.full((1, 2), 0.1).double(), _BOUNDS, 4)
    assert torch.allclose(candidates[0, 0, :, 0, 0], torch.tensor((0.1, 0.1, 0.2, 0.3)).double())
    assert torch.allclose(candidates[0, 0, :, 0, 1], torch.tensor((0.8, 0.9, 1.0, 1.1)).double())


def test_the_spacing_halves_from_level_to_level(small):
    features, *rest = _inputs()
    first, second = (level.candidates for level in small(features, *rest).levels)
    inside = (second > 0.1 + 1e-9) & (second < 2 - 1e-9)
    steps = second.diff(dim=2)[inside[:, :, 1:] & inside[:, :, :-1]]
    assert torch.allclose(steps, first.diff(dim=2).mean() / 2, atol=1e-12)


def test_a_certain_candidate_is_the_result():
    candidates = first_candidates(_BOUNDS, 5, (2, 4))
    logits = torch.full((1, 2, 5, 2, 4), -1e4).double()
    logits[:, :, 3] = 1e4
    level = regress_depth(1, logits, candidates)
    assert torch.equal(level.inverse_depth, candidates[:, :, 3])
    assert torch.equal(level.depth, 1 / candidates[:, :, 3])
    assert torch.equal(level.confidence, torch.ones(1, 2, 2, 4).double())


# Correlation of views


def test_each_view_is_correlated_with_the_mean_of_the_others():
    (features, *_), poses, near, far, _ = _inputs(views=3)
    candidates = first_candidates((1 / far, 1 / near), 4, (8, 16))
    result = correlate_views(features, candidates, poses, "fixed")
    for view in range(3):
        others = []
        for other in {0, 1, 2} - {view}:
            pose = torch.linalg.inv(poses[:, other]) @ poses[:, view]
            warped = warp_panorama(features[:, other], candidates[:, view], pose)
            others.append((features[:, view, :, None] * warped).sum(dim=1) / 8**0.5)
        assert torch.allclose(result[:, view], (others[0] + others[1]) / 2, atol=1e-12)


def test_a_view_twice_over_tells_no_more_than_once():
    (features, *_), poses, near, far, _ = _inputs()
    candidates = first_candidates((1 / far, 1 / near), 4, (8, 16))
    twice = torch.cat((features, features[:, 1:]), dim=1), torch.cat((poses, poses[:, 1:]), dim=1)
    result = correlate_views(twice[0], torch.cat((candidates, candidates[:, 1:]), dim=1), twice[1], "fixed")
    assert torch.allclose(result[:, 0], correlate_views(features, candidates, poses, "fixed")[:, 0], atol=1e-12)


# The whole


def test_half_a_turn_of_the_panoramas_turns_the_depths(small):
    features, poses, near, far, mono = _inputs()
    depths = small(features, poses, near, far, mono)
    half_turn = torch.diag(torch.tensor((-1.0, 1.0, -1.0, 1.0)).double())
    rolled = [maps.roll(maps.shape[-1] // 2, -1) for maps in features]
    turned = small(rolled, poses @ half_turn, near, far, mono.roll(16, -1))
    for before, after in zip(depths.levels, turned.levels, strict=True):
        width = before.depth.shape[-1]
        assert torch.allclose(after.depth, before.depth.roll(width // 2, -1), rtol=1e-10)
        assert torch.allclose(after.logits, before.logits.roll(width // 2, -1), atol=1e-10)


def test_moving_the_world_does_not_change_depth(small):
    features, poses, near, far, mono = _inputs()
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3] = torch.linalg.qr(_noise(3, 3))[0]
    world[:3, :3] *= torch.linalg.det(world[:3, :3]).sign()
    world[:3, 3] = torch.tensor((100.0, -7.0, 3.0))
    before, after = small(features, poses, near, far, mono), small(features, world @ poses, near, far, mono)
    assert torch.allclose(after.depth[-1], before.depth[-1], rtol=1e-9)


def test_scaling_the_world_scales_depth_where_the_centre_is_no_input(randomize):
    # Later levels also see the centre as a number, in 1 / metres.
    network = randomize(SphericalCostVolume(replace(_SMALL, sweep="single"), "fixed"))
    features, poses, near, far, mono = _inputs()
    scaled = poses.clone()
    scaled[..., :3, 3] *= 7
    before, after = network(features, poses, near, far, mono), network(features, scaled, 7 * near, 7 * far, mono)
    assert torch.allclose(after.depth[0], 7 * before.depth[0], rtol=1e-10)


@pytest.mark.parametrize("views", [2, 3, 4])
def test_the_order_of_the_views_does_not_matter(small, views):
    features, poses, near, far, mono = _inputs(views)
    order = torch.arange(views).flip(0)
    before = small(features, poses, near, far, mono)
    after = small([maps[:, order] for maps in features], poses[:, order], near, far, mono[:, order])
    assert torch.allclose(after.depth[-1], before.depth[-1][:, order], rtol=1e-9)


def test_batch_items_do_not_see_each_other(small):
    inputs = _inputs(batch=2)
    alone = [[maps[1:] for maps in inputs[0]], *(tensor[1:] for tensor in inputs[1:])]
    assert torch.allclose(small(*alone).depth[-1], small(*inputs).depth[-1][1:], rtol=1e-9)


def test_depths_lie_within_the_bounds(small):
    depths = small(*_inputs())
    assert [tuple(depth.shape) for depth in depths.depth] == [(1, 2, 8, 16), (1, 2, 16, 32)]
    assert all((depth >= 0.5 - 1e-9).all() and (depth <= 10 + 1e-9).all() for depth in depths.depth)
    assert all((level.confidence >= 1 / 6).all() and (level.confidence <= 1).all() for level in depths.levels)
    assert depths.logits is depths.levels[-1].logits and depths.candidates is depths.levels[-1].candidates


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


def test_gradient_reaches_every_parameter_and_the_features(small):
    small.zero_grad()
    features, *rest = _inputs()
    features = [maps.requires_grad_() for maps in features]
    sum(inverse.square().sum() for inverse in small(features, *rest).inverse_depth).backward()
    assert features[0].grad.abs().max() > 0 and features[1].grad.abs().max() > 0 and features[2].grad is None
    assert all(parameter.grad.abs().max() > 1e-12 for parameter in small.parameters())


def test_no_gradient_flows_from_a_level_to_the_coarser(small):
    small.zero_grad()
    small(*_inputs()).inverse_depth[1].sum().backward()
    assert all(parameter.grad is None for parameter in small.levels["2"].parameters())
    assert any(parameter.grad is not None for parameter in small.levels["1"].parameters())


# Refusals


@pytest.mark.parametrize(
    ("compat", "views", "message"), [("fixed", 1, "two or more views, got 1"), ("official", 3, "exactly two views")]
)
def test_a_number_of_views_that_cannot_be_swept_is_refused(compat, views, message):
    with pytest.raises(InputError, match=message):
        SphericalCostVolume(_SMALL, compat)(*_inputs(views))


def test_maps_that_the_unet_cannot_halve_are_refused(small):
    features, *rest = _inputs()
    with pytest.raises(InputError, match="that 4 divides, got 6x12"):
        small([features[0][..., :6, :12]], *rest)


def test_monocular_features_must_come_exactly_where_they_are_used(small, randomize):
    *rest, mono = _inputs()
    with pytest.raises(ValueError, match="mono_channels=3"):
        small(*rest)
    with pytest.raises(ValueError, match="mono_channels=0"):
        randomize(SphericalCostVolume(replace(_SMALL, mono_channels=0), "fixed"))(*rest, mono)
