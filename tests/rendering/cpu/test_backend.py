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
def make_colored_scene(make_scene):
    """Makes scenes of float32 Gaussians with harmonics of degree 2."""

    def make(channels=3, count=300):
        scene = make_scene(count, scale=0.15, degree=2, seed=1).to(dtype=torch.float32)
        harmonics = 0.4 * torch.randn(count, 9, channels, generator=torch.Generator().manual_seed(7))
        return dataclasses.replace(scene, harmonics=harmonics)

    return make


@pytest.fixture
def scene(make_colored_scene):
    return make_colored_scene()


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


def test_a_number_that_is_unusable_in_one_channel_drops_the_gaussian_in_all(make_colored_scene, pose):
    scene = make_colored_scene(channels=5)
    scene.harmonics[::3, 0, 4] = torch.nan
    drawn = rasterize_planes(scene, pose, _planes("pinhole"), RasterOptions())
    kept = scene.select(torch.arange(len(scene)) % 3 > 0)
    assert torch.equal(drawn, rasterize_planes(kept, pose, _planes("pinhole"), RasterOptions()))


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


def test_the_ewa_kernel_is_refused(scene, pose):
    with pytest.raises(InputError, match="has kernel 'ray' only, got kernel 'ewa'; use backend='torch'"):
        rasterize(scene, pose, size=(8, 16), layout="cubemap", kernel="ewa", backend="numba")


def test_float64_gaussians_have_float64_images_and_gradients(scene, pose):
    scene = scene.to(dtype=torch.float64)
    scene.means.requires_grad_()
    image = rasterize(scene, pose, size=(8, 16), backend="numba")
    image.color.sum().backward()
    assert image.color.dtype == scene.means.grad.dtype == torch.float64


def test_a_side_longer_than_32767_pixels_is_refused(scene, pose):
    with pytest.raises(InputError, match="at most 32767 pixels a side"):
        rasterize(scene, pose, size=(1, 40000), layout="pinhole", backend="numba")
