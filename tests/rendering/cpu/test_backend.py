"""The numba backend, forward and backward: its accuracy, and its behaviour in a program."""

import dataclasses

import pytest
import torch

from pansplat.errors import InputError
from pansplat.rendering import rasterize, reference
from pansplat.rendering.cpu import rasterize_planes, tiling
from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.rasterize import RasterOptions, _select_backend

_NAMES = ("means", "quats", "scales", "opacities", "harmonics")
_SIZES = {"equirect": (40, 80), "pinhole": (50, 70), "cubemap": (40, 80)}


def _planes(layout):
    return image_planes(layout, _SIZES[layout], vertical_fov_degrees=80.0)


@pytest.fixture
def scene(make_scene):
    return make_scene(300, scale=0.15, degree=2, seed=1).to(dtype=torch.float32)


def _run(scene, pose, layout, options=None, *, backend=rasterize_planes, dtype=torch.float32):
    """Sums of a backend, and the gradients of a random combination of them."""
    leaves = {name: getattr(scene, name).to(dtype).requires_grad_() for name in _NAMES}
    camera = pose.clone().requires_grad_()
    given = dataclasses.replace(scene, **{name: leaves[name] for name in _NAMES})
    result = backend(given, camera, _planes(layout), options or RasterOptions())
    weights = torch.randn(result.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    (result.double() * weights).sum().backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    turn = pose[:3, :3].T @ camera.grad[:3, :3]
    gradients["pose"] = torch.cat((turn - turn.T, camera.grad[:3, 3:]), dim=1)
    return result, gradients


def test_bands_change_no_bit_of_the_sums(scene, pose, monkeypatch):
    whole, gradients = _run(scene, pose, "pinhole")
    monkeypatch.setattr(tiling, "MAX_INTERSECTIONS", 20)
    banded, banded_gradients = _run(scene, pose, "pinhole")
    assert torch.equal(whole, banded)
    for name, gradient in gradients.items():  # slots are added band by band, so in another order
        torch.testing.assert_close(banded_gradients[name], gradient, rtol=1e-4, atol=1e-5 * float(gradient.abs().max()))


def test_without_grad_nothing_is_saved(scene, pose):
    scene.means.requires_grad_()
    with torch.no_grad():
        assert not rasterize_planes(scene, pose, _planes("pinhole"), RasterOptions()).requires_grad


@pytest.mark.parametrize(
    ("dtype", "kernel", "name", "expected"),
    [
        (torch.float32, "ray", "auto", rasterize_planes),
        (torch.float64, "ray", "auto", reference.rasterize_planes),
        (torch.float32, "ray", "torch", reference.rasterize_planes),
        (torch.float32, "ewa", "auto", reference.rasterize_planes),
    ],
)
def test_numba_is_the_default_backend_for_float32_and_the_exact_kernel(dtype, kernel, name, expected, scene):
    assert _select_backend(name, scene.to(dtype=dtype), kernel) is expected


def test_other_kernels_and_channels_are_refused(scene, pose):
    gray = dataclasses.replace(scene, harmonics=scene.harmonics[..., :1])
    assert _select_backend("auto", gray, "ray") is reference.rasterize_planes
    for given, kernel in ((scene, "ewa"), (gray, "ray")):
        with pytest.raises(InputError, match=f"kernel '{kernel}' and . channels"):
            rasterize(given, pose, size=(8, 16), layout="cubemap", kernel=kernel, backend="numba")


def test_float64_gaussians_have_float64_images_and_gradients(scene, pose):
    scene = scene.to(dtype=torch.float64)
    scene.means.requires_grad_()
    image = rasterize(scene, pose, size=(8, 16), backend="numba")
    image.color.sum().backward()
    assert image.color.dtype == scene.means.grad.dtype == torch.float64


def test_a_side_longer_than_32767_pixels_is_refused(scene, pose):
    with pytest.raises(InputError, match="at most 32767 pixels a side"):
        rasterize(scene, pose, size=(1, 40000), layout="pinhole", backend="numba")
