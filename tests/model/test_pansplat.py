"""The whole PanSplat: agreement with the official code, symmetries of the fixed network, precision."""

import dataclasses
import math

import pytest
import torch

from pansplat.gaussians.harmonics import rotate_harmonics
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import HeadsConfig
from pansplat.model.pansplat import PanSplat, PanSplatConfig


@pytest.fixture(scope="module")
def network(small_config) -> PanSplat:
    torch.manual_seed(0)
    return PanSplat(small_config, "fixed").double().eval()


@pytest.fixture(scope="module")
def prediction(network, make_inputs):
    with torch.no_grad():
        return network(*make_inputs())


# Agreement with the official code


@pytest.mark.shared
def test_official_prediction_matches_the_official_code(run_official, golden, error):
    """From a converted checkpoint, images and poses to Gaussians."""
    truth, gaussians = golden("pansplat_64x128_fp32attn"), run_official().gaussians
    y_z_x = torch.tensor(((0.0, 0, 1), (1, 0, 0), (0, 1, 0)))
    errors = {}
    for stage in range(4):
        for view in range(2):
            part = gaussians.select((gaussians.levels == 3 - stage) & (gaussians.views == view))
            prefix = f"g.s{stage}.v{view}"
            found = {name: getattr(part, name) for name in ("means", "covariances", "opacities", "scales")}
            found["harmonics"] = rotate_harmonics(part.harmonics, y_z_x).transpose(1, 2)
            for name, tensor in found.items():
                errors[stage, view, name] = error(tensor, truth[f"{prefix}.{name}"])
            in_camera = truth["in.extrinsics"][0, view, :3, :3].T @ rotations_from_quats(part.quats)
            expected = rotations_from_quats(truth[f"{prefix}.rotations"].roll(1, dims=-1))
            errors[stage, view, "rotations"] = error(in_camera, expected)
    assert max(errors.values()) < 2e-4, errors


@pytest.mark.slow
@pytest.mark.shared
def test_official_prediction_with_bfloat16_attention_is_near_the_official_code(run_official, golden, error):
    """Float32 rounding flips some roundings to bfloat16, which grow to 3e-2 of a standard deviation."""
    truth, run = golden("pansplat_64x128_bf16attn"), run_official(attention="bfloat16")
    errors = {}
    for stage, level in enumerate(run.outputs["cost_volume"].levels):
        errors[stage, "inverse depth"] = error(level.inverse_depth, truth[f"s{stage}.disp"])
        errors[stage, "depth"] = error(level.depth, truth[f"s{stage}.depth"])
        errors[stage, "confidence"] = error(level.confidence[0], truth[f"s{stage}.pdf_max"][:, 0])
        assert error(level.depth, run_official().outputs["cost_volume"].depth[stage]) > 2e-3  # attention is rounded
    for stage in range(4):
        for view in range(2):
            part = run.gaussians.select((run.gaussians.levels == 3 - stage) & (run.gaussians.views == view))
            for name in ("means", "opacities", "scales"):
                errors[stage, view, name] = error(getattr(part, name), truth[f"g.s{stage}.v{view}.{name}"])
    assert max(errors.values()) < 5e-2, errors


@pytest.mark.shared
def test_fixed_prediction_differs_from_the_official_one(run_official, golden, error):
    truth, run = golden("pansplat_64x128_fp32attn"), run_official("fixed")
    for stage in range(4):
        assert error(run.outputs["features"][stage], truth[f"backbone.feat.{stage}"]) > 0.1
    for stage, depth in enumerate(run.outputs["cost_volume"].depth):
        assert error(depth, truth[f"s{stage}.depth"]) > 0.1


# Symmetries of the fixed network


def test_rotating_the_world_rotates_the_prediction(network, prediction, make_inputs):
    images, poses, near, far = make_inputs()
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


def test_rolling_panoramas_and_turning_poses_by_half_a_turn_keeps_the_scene(small_config, make_inputs):
    """With a Gaussian at each pixel, so that both predictions have the same points."""
    torch.manual_seed(0)
    heads = dataclasses.replace(small_config.heads, lattice="pixel", emitted="finest")
    network = PanSplat(dataclasses.replace(small_config, heads=heads), "fixed").double().eval()
    images, poses, near, far = make_inputs()
    half_turn = torch.diag(torch.tensor((-1.0, 1.0, -1.0, 1.0), dtype=torch.float64))
    with torch.no_grad():
        before = network(images, poses, near, far)
        after = network(images.roll(64, dims=-1), poses @ half_turn, near, far)
    for a, b in zip(after.depths.depth, before.depths.depth, strict=True):
        assert torch.allclose(a, b.roll(b.shape[-1] // 2, dims=-1), atol=1e-9)
    for name in ("means", "scales", "opacities"):
        a, b = (getattr(output.gaussians[0], name).unflatten(0, (2, 64, 128)) for output in (after, before))
        assert torch.allclose(a, b.roll(64, dims=2), atol=1e-9)


@pytest.mark.slow
def test_tiled_prediction_equals_untiled(network, prediction, make_inputs):
    with torch.no_grad():
        tiled = network(*make_inputs(), tiles=4).gaussians[0]
    assert torch.allclose(prediction.gaussians[0].means, tiled.means, atol=1e-11)
    assert torch.allclose(prediction.gaussians[0].harmonics, tiled.harmonics, atol=1e-11)


def test_matching_and_lifting_equal_the_prediction(network, prediction, make_inputs):
    with torch.no_grad():
        (part,) = network.lift_gaussians(network.match_views(*make_inputs()))
    assert torch.equal(part.gaussians[0].means, prediction.gaussians[0].means)


# Views, sizes, configurations


def test_each_of_three_views_has_gaussians(network, make_inputs):
    with torch.no_grad():
        gaussians = network(*make_inputs(views=3)).gaussians[0]
    assert gaussians.views.unique().tolist() == [0, 1, 2]
    assert bool(torch.isfinite(gaussians.means).all())


def test_large_panoramas_are_matched_at_low_and_lifted_at_full_resolution(network, monkeypatch, make_inputs):
    monkeypatch.setattr("pansplat.model.pansplat.MATCHING_HEIGHT", 64)
    with torch.no_grad():
        output = network(*make_inputs(128))
    assert output.matched.features[-1].shape[-2:] == (64, 128)
    assert output.depths.depth[-1].shape[-2:] == (32, 64)
    assert int((output.gaussians[0].levels == 0).sum()) == 2 * int(256**2 / math.pi)


@pytest.mark.slow
@pytest.mark.parametrize("compat", ["official", "fixed"])
def test_gradients_reach_every_weight_and_the_images(compat, small_config, make_inputs):
    """Coarser levels get gradients from a loss of their own: finer levels detach them."""
    torch.manual_seed(0)
    network, (images, poses, near, far) = PanSplat(small_config, compat).double().eval(), make_inputs()
    output = network(images.requires_grad_(), poses, near, far)
    gaussians = output.gaussians[0]
    losses = [gaussians.means.square().sum(), gaussians.harmonics.sum(), gaussians.opacities.sum()]
    losses += [depth.sum() for depth in output.depths.inverse_depth[:-1]]
    torch.stack(losses).sum().backward()
    assert images.grad is not None and bool(torch.isfinite(images.grad).all())
    assert not [name for name, parameter in network.named_parameters() if parameter.grad is None]


def test_the_monocular_network_exists_only_if_configured_and_is_frozen(network, small_config):
    assert network.mono_depth is None
    config = dataclasses.replace(
        small_config, cost_volume=dataclasses.replace(small_config.cost_volume, mono_channels=32)
    )
    with torch.device("meta"):
        assert not any(parameter.requires_grad for parameter in PanSplat(config).mono_depth.parameters())


def test_heads_read_the_candidates_of_a_single_swept_level(small_config, make_inputs):
    single = dataclasses.replace(small_config.cost_volume, sweep="single")
    with pytest.raises(ValueError, match=r"`heads\.candidates` must be the 8 of the finest sweep, got 4"):
        dataclasses.replace(small_config, cost_volume=single)
    heads = dataclasses.replace(small_config.heads, candidates=8)
    network = PanSplat(dataclasses.replace(small_config, cost_volume=single, heads=heads)).double().eval()
    with torch.no_grad():
        output = network(*make_inputs())
    assert len(output.depths.levels) == 1 and output.gaussians[0].levels.unique().tolist() == [0, 1, 2, 3]


def test_heads_that_do_not_fit_the_features_are_refused(small_config):
    with pytest.raises(ValueError, match=r"must be \(16, 8, 8, 4\), the channels of the features"):
        dataclasses.replace(small_config, heads=dataclasses.replace(small_config.heads, feature_channels=(8, 8, 8, 4)))


# Precision


@pytest.mark.slow
def test_bfloat16_prediction_is_close_to_float32_and_in_float32(randomize, make_inputs):
    config = PanSplatConfig(
        features=FeaturePyramidConfig(channels=(8, 8, 16, 32), transformer=TransformerConfig(channels=32, blocks=2)),
        cost_volume=CostVolumeConfig(
            mono_channels=0, levels=(SweepLevel(3, 32, 16, 32), SweepLevel(2, 16, 8, 32), SweepLevel(1, 8, 8, 32))
        ),
        heads=HeadsConfig(feature_channels=(32, 16, 8, 8), candidates=8),
    )
    inputs = [tensor.float() for tensor in make_inputs()]
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
