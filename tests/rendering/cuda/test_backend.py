"""The Triton kernels, on a GPU or interpreted, against the torch reference in float64, forward and backward."""

import dataclasses
import functools
import sys
import types

import pytest
import torch
from dense_renderer import BACKENDS, FIELDS, POSE, assert_dense, find_gradients, make_scene
from refusals import expect_error
from torch import Tensor

from pansplat.rendering import Rendering, cuda, rasterize, reference
from pansplat.rendering.rasterize import _select_backend

exhaustive = pytest.mark.exhaustive  # an intersection takes milliseconds in the interpreter
TRITON = dataclasses.replace(BACKENDS["triton"], gradient=1e-5)
EXACT = dataclasses.replace(TRITON, dtype=torch.float64)


def test_a_small_image_and_its_gradients_equal_float64_torch():
    assert_dense(TRITON, make_scene(3, scale=0.4, degree=1), {"size": (4, 8), "pose": POSE})


@exhaustive
def test_a_gaussian_over_many_tiles_has_the_gradient_of_float64_torch(monkeypatch):
    from pansplat.rendering.cuda import rasterize as stage

    monkeypatch.setattr(stage, "_MANY_TILES", 4)
    scene = make_scene(2, scale=1.5, extent=0.8, seed=1, degree=0)
    assert_dense(TRITON, scene, {"size": (48, 96), "pose": POSE})  # more than 16 tiles: a program sums in several steps


@exhaustive
def test_opaque_gaussians_around_the_camera_equal_float64_torch():
    scene = make_scene(12, scale=1.5, extent=0.6, seed=2, degree=0)
    scene = dataclasses.replace(scene, opacities=torch.linspace(0.5, 2.0, 12, dtype=torch.float64))
    # Triton's tiles stop early.
    early = dataclasses.replace(EXACT, image=2e-5, gradient=1e-3)
    (expected, _), _ = assert_dense(early, scene, {"size": (9, 18)})
    assert float(expected.alpha.detach().max()) > 0.9999  # several at the largest alpha


@exhaustive
def test_gaussians_behind_a_saturated_tile_are_left_out():
    scene = make_scene(130, scale=3.0, extent=0.1, seed=2, degree=0)
    ahead = torch.tensor((0.0, 0.0, 3.0), dtype=torch.float64)
    scene = dataclasses.replace(
        scene,
        means=(scene.means + ahead) @ POSE[:3, :3].T + POSE[:3, 3],
        opacities=torch.full_like(scene.opacities, 0.2),  # 32 of them do not saturate
    )
    early = dataclasses.replace(TRITON, image=1e-4, gradient=1e-3)
    options = {"size": (4, 4), "layout": "pinhole", "pose": POSE, "fields": (*FIELDS, "pose")}
    _, (expected, got) = assert_dense(early, scene, options)
    hidden = (got["opacities"] == 0) & (expected["opacities"] != 0)
    assert 20 < int(hidden.sum()) < 100


@exhaustive
def test_an_image_is_the_same_in_narrow_bands(monkeypatch):
    from pansplat.rendering.cuda import tiling

    scene, size = make_scene(12, scale=0.3, degree=0), (20, 40)

    def draw() -> tuple[Rendering, dict[str, Tensor]]:
        return EXACT(scene, POSE, size=size), find_gradients(EXACT, scene, POSE, size=size)

    (wide, gradients), bands = draw(), []
    with monkeypatch.context() as by_tiles:
        by_tiles.setattr(tiling, "_MAX_TILES", 3)  # indices of tiles are of 16 bits
        bands.append(draw())
    monkeypatch.setattr(tiling, "intersect_tiles", functools.partial(tiling.intersect_tiles, limit=1))
    bands.append(draw())
    for narrow, found in bands:
        assert torch.equal(narrow.color, wide.color) and torch.equal(narrow.depth, wide.depth)
        for name, expected in gradients.items():
            assert torch.allclose(found[name], expected, rtol=1e-12, atol=1e-12), name


def test_gaussians_on_the_cpu_are_refused_unless_interpreted(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    expect_error("on 'cpu'", lambda: rasterize(make_scene(1), POSE, size=(4, 8), backend="triton"))


@pytest.mark.parametrize(
    ("triton", "found"),
    [
        (None, "which is not installed"),
        (types.SimpleNamespace(__version__="3.1.0"), "which has version 3.1"),
        (types.SimpleNamespace(__version__="2.3.1+git"), "which has version 2.3"),
    ],
)
def test_a_missing_or_old_triton_is_an_error_and_auto_does_not_select_it(unchecked, monkeypatch, triton, found):
    monkeypatch.setitem(sys.modules, "triton", triton)
    expect_error(found, lambda: rasterize(make_scene(1), POSE, size=(4, 8), backend="triton"))
    assert select_automatically(is_cuda=True) is reference.rasterize_planes


def test_auto_selects_triton_only_on_cuda(unchecked, monkeypatch):
    assert select_automatically(is_cuda=True) is cuda.rasterize_planes
    assert select_automatically(is_cuda=False) is not cuda.rasterize_planes
    monkeypatch.setitem(sys.modules, "triton", types.SimpleNamespace(__version__="3.10.0.post1"))
    assert select_automatically(is_cuda=True) is cuda.rasterize_planes


def select_automatically(*, is_cuda: bool) -> object:
    device = torch.device("cuda" if is_cuda else "cpu")
    means = types.SimpleNamespace(is_cuda=is_cuda, device=device, dtype=torch.float32)
    return _select_backend("auto", types.SimpleNamespace(means=means, harmonics=torch.zeros(1, 1, 3)), "ewa")
