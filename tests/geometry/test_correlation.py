"""Warping by depth candidates, and the correlation with the warped features."""

import math

import pytest
import torch
from synthetic_scenes import draw_noise

from pansplat.geometry import correlation
from pansplat.geometry.correlation import correlate
from pansplat.geometry.equirect import pixel_directions, sample_equirect, uv_from_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.geometry.warp import relative_pose, warp_panorama, warp_positions

SAMPLINGS = ("sphere", "corners")
H, W = 8, 16


def _inverse_depth(*shape):
    return 0.05 + 2 * torch.rand(shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def _poses(count, baseline=0.5):
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, :3, :3] = rotations_from_quats(draw_noise(count, 4, seed=1))
    poses[:, :3, 3] = baseline * draw_noise(count, 3, seed=2)
    return poses


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("height", [8, 30, 64])
def test_identity_pose_warps_to_identity(height, dtype):
    maps = draw_noise(1, 3, height, 2 * height).to(dtype)
    inverse_depth = _inverse_depth(1, 4, height, 2 * height).to(dtype)
    warped = warp_panorama(maps, inverse_depth, torch.eye(4)[None])
    error = (warped - maps[:, :, None]).abs().max()
    assert error < (2e-4 if dtype == torch.float32 else 1e-12)
    columns, rows = warp_positions(inverse_depth, torch.eye(4)[None], "sphere")
    assert torch.equal(columns, torch.arange(2 * height).to(dtype).expand_as(columns))
    assert torch.equal(rows, torch.arange(height).to(dtype)[:, None].expand_as(rows))


def test_a_warp_samples_the_panorama_at_the_projected_point():
    maps, inverse_depth, poses = draw_noise(2, 3, H, W), _inverse_depth(2, 4, H, W), _poses(2)
    points = pixel_directions(H, W, dtype=torch.float64) / inverse_depth[..., None]
    points = torch.einsum("nij,ndhwj->ndhwi", poses[:, :3, :3], points) + poses[:, None, None, None, :3, 3]
    truth = torch.stack([sample_equirect(image, uv_from_directions(p)) for image, p in zip(maps, points, strict=True)])
    assert torch.allclose(warp_panorama(maps, inverse_depth, poses), truth, atol=1e-11)


def test_the_official_warp_is_reproduced(golden):
    units = golden("units")
    feature, depth = units["warp.feature"], units["warp.depth"]
    warped = warp_panorama(feature, 1 / depth, units["warp.pose"], "corners")
    error = (warped - units["warp.out"]).abs().max() / units["warp.out"].std()
    assert error < 2e-4
    fixed = warp_panorama(feature, 1 / depth, units["warp.pose"], "sphere")
    assert (fixed - units["warp.out"]).abs().max() / units["warp.out"].std() > 0.5


def test_a_relative_pose_keeps_double_precision():
    near_origin, shift = _poses(2), torch.tensor((1e4, -2e4, 3e4), dtype=torch.float64)
    moved = near_origin.clone()
    moved[:, :3, 3] += shift
    assert torch.allclose(relative_pose(moved[0], moved[1]), relative_pose(near_origin[0], near_origin[1]), atol=1e-10)
    assert relative_pose(moved[0].float(), moved[1].float()).dtype == torch.float64
    point = torch.tensor((1.0, 2.0, 3.0, 1.0), dtype=torch.float64)
    assert torch.allclose(near_origin[1] @ relative_pose(*near_origin) @ point, near_origin[0] @ point, atol=1e-12)


def _truth(reference, other, inverse_depth, pose, sampling):
    warped = warp_panorama(other, inverse_depth, pose, sampling)
    return (reference[:, :, None] * warped).sum(dim=1) / math.sqrt(reference.shape[1])


def _inputs(channels=5, candidates=7, height=H):
    return (
        draw_noise(2, channels, height, 2 * height, seed=5),
        draw_noise(2, channels, height, 2 * height, seed=6),
        _inverse_depth(2, candidates, height, 2 * height),
        _poses(2),
    )


@pytest.fixture(params=["warps", "kernels"])
def backend(request, monkeypatch):
    """Both ways to correlate."""
    monkeypatch.setattr(correlation, "_uses_kernels", lambda features: request.param == "kernels")


@pytest.mark.slow
@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_correlation_is_the_product_with_the_warped_panorama(sampling):
    reference, other, inverse_depth, poses = _inputs()
    reference.requires_grad_()
    other.requires_grad_()
    truth = _truth(reference, other, inverse_depth, poses, sampling)
    result = correlate(reference, other, inverse_depth, poses, sampling)
    assert torch.allclose(result, truth, atol=1e-12)
    upstream = torch.randn_like(truth)
    expected = torch.autograd.grad(truth, (reference, other), upstream)
    for gradient, right in zip(torch.autograd.grad(result, (reference, other), upstream), expected, strict=True):
        assert torch.allclose(gradient, right, atol=1e-12)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_float32_correlation_is_within_1e_4_of_float64(sampling):
    inputs = _inputs(channels=64, candidates=16, height=32)
    truth = _truth(*inputs, sampling)
    single = correlate(*(tensor.float() for tensor in inputs), sampling)
    # Rounding can move a sample across the map's border, where zeros begin.
    error = (single - truth).abs().flatten().sort().values
    assert error[int(0.999 * len(error))] < 1e-4 * truth.std()
    assert sampling == "corners" or error[-1] < 3e-4 * truth.std()


@pytest.mark.usefixtures("backend")
def test_chunks_do_not_change_the_correlation(monkeypatch):
    reference, other, inverse_depth, poses = _inputs()

    def run():
        a, b = reference.clone().requires_grad_(), other.clone().requires_grad_()
        result = correlate(a, b, inverse_depth, poses, "sphere")
        return (result, *torch.autograd.grad(result.square().sum(), (a, b)))

    whole = run()
    monkeypatch.setattr(correlation, "_CHUNK", 1)
    for part, expected in zip(run(), whole, strict=True):
        assert torch.allclose(part, expected, atol=1e-12)


def test_the_number_of_threads_does_not_change_the_correlations_bits(run_with_threads, monkeypatch):
    reference, other, inverse_depth, poses = (tensor.float() for tensor in _inputs(height=32))
    positions = warp_positions(inverse_depth, poses, "sphere")
    monkeypatch.setattr(correlation, "warp_positions", lambda *_: positions)
    reference.requires_grad_()
    other.requires_grad_()

    def run():
        forward = correlate(reference, other, inverse_depth, poses)
        return forward, *torch.autograd.grad(forward, (reference, other), forward.detach())

    first, *others = run_with_threads(run)
    for threaded in others:
        assert torch.equal(first[0], threaded[0])
        for found, expected in zip(threaded[1:], first[1:], strict=True):  # the order of the sums over bands differs
            assert torch.allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_features_are_multiplied_in_float32(dtype):
    reference, other, inverse_depth, poses = (tensor.float() for tensor in _inputs())
    reference, other = reference.to(dtype).requires_grad_(), other.to(dtype).requires_grad_()
    result = correlate(reference, other, inverse_depth, poses)
    assert result.dtype == torch.float32
    assert torch.equal(result, correlate(reference.float(), other.float(), inverse_depth, poses))
    result.sum().backward()
    assert reference.grad.dtype == dtype and torch.isfinite(reference.grad).all()


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_pose_with_nan_gives_nan(sampling):
    reference, other, inverse_depth, poses = _inputs()
    poses[1, 0, 3] = math.nan
    result = correlate(reference, other, inverse_depth, poses, sampling)
    assert torch.isfinite(result[0]).all() and result[1].isnan().all()
