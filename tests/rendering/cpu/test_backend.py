"""The numba backend, forward and backward: its accuracy, and its behaviour in a program."""

import dataclasses

import pytest
import torch
from dense_renderer import BACKENDS, POSE, find_gradients, make_scene

from pansplat.errors import InputError
from pansplat.rendering import rasterize, reference
from pansplat.rendering.cpu import rasterize_planes, tiling
from pansplat.rendering.rasterize import _select_backend

NUMBA = BACKENDS["numba"]


@pytest.fixture
def scene():
    return make_scene(300, scale=0.15, degree=2, seed=1).to(dtype=torch.float32)


def test_bands_change_no_bit_of_the_image(scene, monkeypatch):
    def draw():
        options = {"size": (50, 70), "layout": "pinhole"}
        return NUMBA(scene, POSE, **options).color, find_gradients(NUMBA, scene, POSE, **options)

    whole, gradients = draw()
    monkeypatch.setattr(tiling, "MAX_INTERSECTIONS", 20)
    banded, banded_gradients = draw()
    assert torch.equal(whole, banded)
    for name, gradient in gradients.items():  # slots are added band by band, so in another order
        torch.testing.assert_close(banded_gradients[name], gradient, rtol=1e-4, atol=1e-5 * float(gradient.abs().max()))


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


def test_other_kernels_and_channels_are_refused(scene):
    gray = dataclasses.replace(scene, harmonics=scene.harmonics[..., :1])
    assert _select_backend("auto", gray, "ray") is reference.rasterize_planes
    for given, kernel in ((scene, "ewa"), (gray, "ray")):
        with pytest.raises(InputError, match=f"kernel '{kernel}' and . channels"):
            rasterize(given, POSE, size=(8, 16), layout="cubemap", kernel=kernel, backend="numba")


def test_a_side_longer_than_32767_pixels_is_refused(scene):
    with pytest.raises(InputError, match="at most 32767 pixels a side"):
        rasterize(scene, POSE, size=(1, 40000), layout="pinhole", backend="numba")
