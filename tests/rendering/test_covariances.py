"""World covariances in place of scales and quaternions: the same pictures and gradients, and what is refused."""

import dataclasses

import pytest
import torch

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize

_OPTIONS = [
    dict(layout="equirect", kernel="ray", lowpass="angular"),
    dict(layout="pinhole", kernel="ray", lowpass="3dgs"),
    dict(layout="pinhole", kernel="ewa", lowpass="angular"),
    dict(layout="cubemap", kernel="ewa", lowpass="3dgs", order="z"),
]


@pytest.mark.parametrize("options", _OPTIONS, ids=lambda o: "-".join(o.values()))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_covariances_of_the_scene_change_nothing(options, dtype, make_scene, pose):
    scene = make_scene(80, scale=0.2)
    expected = rasterize(scene, pose, size=(16, 32), **options)
    rounded, given = scene.to(dtype=dtype), scene.covariances.to(dtype)
    got = rasterize(rounded, pose, size=(16, 32), covariances=given, backend="torch", **options)
    tolerance = 1e-9 if dtype == torch.float64 else 2e-5
    assert float(expected.alpha.mean()) > 0.05 and got.color.dtype == dtype
    for name in ("color", "alpha"):
        assert (getattr(got, name) - getattr(expected, name)).abs().max() < tolerance


def test_scales_and_quaternions_are_not_read_beside_covariances(make_scene, pose):
    scene = make_scene(20, scale=0.3)
    covariances = scene.covariances
    blind = dataclasses.replace(scene, scales=torch.full_like(scene.scales, torch.nan), quats=0 * scene.quats)
    for options in _OPTIONS:
        expected = rasterize(scene, pose, size=(8, 16), covariances=covariances, **options)
        assert torch.equal(
            rasterize(blind, pose, size=(8, 16), covariances=covariances, **options).color, expected.color
        )


@pytest.mark.parametrize("options", _OPTIONS[:3], ids=lambda o: "-".join(o.values()))
def test_gradients_of_covariances_equal_finite_differences(options, make_scene, pose):
    scene = make_scene(3, scale=0.5, seed=3, degree=0)
    in_view = torch.tensor((0.3, 0.3, 0.2), dtype=torch.float64) * scene.means + torch.tensor((0.0, 0.0, 1.5))
    scene = dataclasses.replace(scene, means=in_view @ pose[:3, :3].T + pose[:3, 3])

    def draw(factors, means, opacities, camera):
        changed = dataclasses.replace(scene, means=means, opacities=opacities)
        covariances = factors @ factors.transpose(1, 2)
        got = rasterize(changed, camera, size=(2, 4), covariances=covariances, vertical_fov_degrees=120.0, **options)
        return got.color, got.alpha, got.depth

    inputs = [
        t.clone().requires_grad_()
        for t in (torch.linalg.cholesky(scene.covariances), scene.means, scene.opacities, pose)
    ]
    assert all(float(output.detach().abs().max()) > 0.1 for output in draw(*inputs))
    assert torch.autograd.gradcheck(draw, inputs, eps=1e-6, atol=1e-6)


def test_each_entry_of_a_symmetric_pair_gets_half_the_slope(make_scene, pose):
    scene = make_scene(6, scale=0.4, degree=0)
    covariances = scene.covariances.clone().requires_grad_()
    rasterize(scene, pose, size=(8, 16), covariances=covariances).color.sum().backward()
    assert covariances.grad is not None and covariances.grad.any()
    assert torch.allclose(covariances.grad, covariances.grad.transpose(1, 2), rtol=0, atol=1e-12)


def test_covariances_that_do_not_fit_are_refused(make_scene, pose, unchecked):
    scene = make_scene(4)
    for shape in ((3, 3, 3), (4, 3), (4, 2, 2), (1, 4, 3, 3)):
        with pytest.raises(InputError, match=r"`covariances` must have shape \(4, 3, 3\), one matrix a Gaussian, got"):
            rasterize(scene, pose, size=(4, 8), covariances=torch.zeros(shape))


def test_no_gaussians_need_no_covariances(make_scene, pose):
    scene = make_scene(2).select(torch.zeros(2, dtype=torch.bool))
    assert isinstance(scene, Gaussians)
    got = rasterize(scene, pose, size=(4, 8), covariances=torch.zeros(0, 3, 3, dtype=torch.float64))
    assert not got.color.any()
