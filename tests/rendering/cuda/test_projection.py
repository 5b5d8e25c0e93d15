"""The projection kernels, on a GPU or interpreted, against the torch reference, forward and backward."""

import dataclasses

import pytest
import torch

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.cuda.backend import project_gaussians
from pansplat.rendering.projection import ProjectedGaussians
from pansplat.rendering.projection import project_gaussians as reference

pytestmark = pytest.mark.exhaustive

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


@pytest.mark.parametrize(
    ("exact", "compensate", "by_covariance", "degree"),
    [
        (True, True, False, 4),
        (True, False, True, 3),
        (True, True, True, 2),
        (False, True, False, 1),
        (False, False, True, 0),
    ],
)
def test_projected_gaussians_equal_the_reference(
    exact, compensate, by_covariance, degree, make_scene, pose, triton_device
):
    scene = _make_degenerate(make_scene(150, seed=degree, degree=degree))  # more than one program
    covariances = _rounded(scene.covariances) if by_covariance else None
    options = dict(filter_variance=3e-4, compensate=compensate, exact=exact)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        same = None if covariances is None else covariances.to(dtype)
        expected = reference(scene.to(dtype=dtype), same, pose, **options)
        same = None if same is None else same.to(triton_device)
        got = project_gaussians(scene.to(dtype=dtype, device=triton_device), same, pose.to(triton_device), **options)
        for name, value in expected._asdict().items():
            found = getattr(got, name).cpu()
            assert found.dtype == value.dtype and found.shape == value.shape, name
            if value.numel():
                assert float((found - value).abs().max() / value.abs().max().clamp_min(1)) < tolerance, name


@pytest.mark.parametrize("by_covariance", [True, False])
@pytest.mark.parametrize("exact", [True, False])
def test_gradients_equal_those_of_the_reference(exact, by_covariance, make_scene, pose, monkeypatch, triton_device):
    from pansplat.rendering.cuda import projection_backward

    monkeypatch.setattr(projection_backward, "_CHUNK_SIZE", 50)
    scene = _make_degenerate(make_scene(70))  # more than one program
    generator = torch.Generator().manual_seed(0)
    found = []
    for function, device in ((reference, "cpu"), (project_gaussians, triton_device)):
        leaves = {name: getattr(scene, name).to(device, copy=True).requires_grad_() for name in _FIELDS}
        covariances = scene.covariances.to(device, copy=True).requires_grad_() if by_covariance else None
        camera = pose.to(device, copy=True).requires_grad_()
        changed, options = dataclasses.replace(scene.to(device=device), **leaves), dict(compensate=True, exact=exact)
        seen = function(changed, covariances, camera, filter_variance=3e-4, **options)
        seen = ProjectedGaussians(*(field.cpu() for field in seen))
        _any_loss(seen, generator.manual_seed(0)).backward()
        motion = camera.grad.cpu()
        turn = pose[:3, :3].T @ motion[:3, :3]
        leaves |= {} if covariances is None else {"covariances": covariances}
        gradients = {name: leaf.grad.cpu() for name, leaf in leaves.items() if leaf.grad is not None}
        gradients["pose"] = torch.cat((turn - turn.T, motion[:3, 3:]), dim=1)
        found.append(gradients)
    assert found[0].keys() == found[1].keys() and len(found[0]) == (5 if by_covariance else 6)
    for name, expected in found[0].items():
        assert float((found[1][name] - expected).norm() / expected.norm()) < 1e-10, name


def _make_degenerate(scene: Gaussians) -> Gaussians:
    """Set a quaternion, one scale of a Gaussian and all scales of another to zero."""
    scene.quats[3] = 0
    scene.scales[5, 1] = 0
    scene.scales[6] = 0
    return scene


def _rounded(covariances: torch.Tensor) -> torch.Tensor:
    """Covariances, some of them discs and needles that rounding made slightly indefinite."""
    rounded = covariances.clone()
    for thin in (1, 2):
        axes = torch.linalg.eigh(covariances[thin::7])
        flat = axes.eigenvalues.clone()
        flat[:, :thin] = -1e-5 * flat[:, 2:]
        rounded[thin::7] = axes.eigenvectors @ torch.diag_embed(flat) @ axes.eigenvectors.mT
    return rounded


def _any_loss(seen: ProjectedGaussians, generator: torch.Generator) -> torch.Tensor:
    """A loss of all fields; of the first two rows only through A^2 + B^2, which a rotation of the frame keeps."""
    random = [torch.rand(value.shape, generator=generator, dtype=value.dtype) for value in seen]
    total = sum((value * factor).sum() for value, factor in zip(seen, random, strict=True) if value is not seen.rows)
    if seen.rows.numel():
        pixels = seen.direction.detach() + 0.01 * torch.randn(seen.direction.shape, generator=generator).double()
        first, second, ahead = (seen.rows @ (pixels - seen.direction)[:, :, None])[:, :, 0].unbind(1)
        total = total + (first.square() + second.square()).sqrt().sum() + ahead.sum()
    return total
