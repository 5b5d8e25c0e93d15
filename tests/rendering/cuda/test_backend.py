"""The Triton kernels, on a GPU or interpreted, against the torch reference in float64, forward and backward."""

import dataclasses
import functools
import sys
import types

import pytest
import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import cuda, rasterize, reference
from pansplat.rendering.rasterize import _select_backend

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")
exhaustive = pytest.mark.exhaustive  # an intersection takes milliseconds in the interpreter


def _gradients(scene: Gaussians, camera: Tensor, dtype: torch.dtype, **options):
    """An image and the gradients of a random loss of all of it, by name; `pose` along rigid motions."""
    device = "cuda" if torch.cuda.is_available() and options["backend"] == "triton" else "cpu"

    def make_leaf(value: Tensor, dtype: torch.dtype = dtype) -> Tensor:
        return value.detach().to(device, dtype, copy=True).requires_grad_()

    leaves = {name: make_leaf(getattr(scene, name)) for name in _FIELDS}
    leaves["pose"] = make_leaf(camera, camera.dtype)
    leaves["background"] = make_leaf(torch.linspace(0.2, 0.9, scene.harmonics.shape[2]))
    changed = dataclasses.replace(scene.to(device=device), **{name: leaves[name] for name in _FIELDS})
    got = rasterize(changed, leaves["pose"], background=leaves["background"], **options)
    everything = torch.cat((got.color, got.alpha[None], (got.depth * got.alpha)[None])).cpu()
    target = torch.rand(everything.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (everything.double() * target).sum().backward()
    gradients = {name: leaf.grad.cpu() for name, leaf in leaves.items() if leaf.grad is not None}
    turn = camera[:3, :3].T @ gradients["pose"][:3, :3]
    gradients["pose"] = torch.cat((turn - turn.T, gradients["pose"][:3, 3:]), dim=1)
    return everything.detach(), gradients, got.info


def _compare(
    scene: Gaussians,
    camera: Tensor,
    dtype: torch.dtype,
    tolerances: tuple[float, float],
    *,
    invisible: tuple[str, ...] = (),
    **options,
):
    """Assert that Triton's image and gradients equal those of float64 torch, and return both.

    Args:
        tolerances: largest error of a pixel, and relative error of a gradient by norm.
        invisible: gradients that are too small to compare.
    """
    expected = _gradients(scene, camera, torch.float64, backend="torch", **options)
    got = _gradients(scene, camera, dtype, backend="triton", **options)
    assert float((got[0] - expected[0]).abs().max()) < tolerances[0]
    assert got[1].keys() == expected[1].keys()
    for name in expected[1].keys() - set(invisible):
        error = float((got[1][name] - expected[1][name]).norm() / expected[1][name].norm())
        assert error < tolerances[1], name
    return expected, got


def test_a_small_image_and_its_gradients_equal_float64_torch(make_scene, pose):
    scene = make_scene(3, scale=0.4, degree=1)
    _, got = _compare(scene, pose, torch.float32, (2e-6, 1e-5), size=(4, 8), layout="equirect")
    assert got[2].backend == "triton" and got[2].intersections > 0 and got[2].bytes > 0


@exhaustive
def test_a_gaussian_over_many_tiles_has_the_gradient_of_float64_torch(make_scene, pose, monkeypatch):
    from pansplat.rendering.cuda import rasterize as stage

    monkeypatch.setattr(stage, "_MANY_TILES", 4)
    scene = make_scene(2, scale=1.5, extent=0.8, seed=1, degree=0)
    _, got = _compare(scene, pose, torch.float32, (1e-5, 1e-5), size=(48, 96), layout="equirect")
    assert got[2].intersections > 2 * 16  # each has its own program, which sums in more than one step


@exhaustive
def test_opaque_gaussians_around_the_camera_equal_float64_torch(make_scene):
    scene = make_scene(12, scale=1.5, extent=0.6, seed=2, degree=0)
    scene = dataclasses.replace(scene, opacities=torch.linspace(0.5, 2.0, 12, dtype=torch.float64))
    camera = torch.eye(4, dtype=torch.float64)
    # Triton's tiles stop early.
    expected, _ = _compare(scene, camera, torch.float64, (2e-5, 1e-3), size=(9, 18), layout="equirect")
    assert float(expected[0][3].max()) > 0.9999  # several at the largest alpha


@exhaustive
def test_gaussians_behind_a_saturated_tile_are_left_out(make_scene, pose):
    scene = make_scene(130, scale=3.0, extent=0.1, seed=2, degree=0)
    ahead = torch.tensor((0.0, 0.0, 3.0), dtype=torch.float64)
    scene = dataclasses.replace(
        scene,
        means=(scene.means + ahead) @ pose[:3, :3].T + pose[:3, 3],
        opacities=torch.full_like(scene.opacities, 0.2),  # 32 of them do not saturate
    )
    options = dict(size=(4, 4), layout="pinhole")
    expected, got = _compare(scene, pose, torch.float32, (1e-4, 1e-3), invisible=("background",), **options)
    hidden = (got[1]["opacities"] == 0) & (expected[1]["opacities"] != 0)
    assert 20 < int(hidden.sum()) < 100


@exhaustive
def test_an_image_is_the_same_in_narrow_bands(make_scene, pose, monkeypatch):
    from pansplat.rendering.cuda import tiling

    scene = make_scene(12, scale=0.3, degree=0)
    options = dict(backend="triton", size=(20, 40), layout="equirect")
    wide = _gradients(scene, pose, torch.float64, **options)
    with monkeypatch.context() as by_tiles:
        by_tiles.setattr(tiling, "_MAX_TILES", 3)  # indices of tiles are of 16 bits
        rows = _gradients(scene, pose, torch.float64, **options)
    monkeypatch.setattr(tiling, "intersect_tiles", functools.partial(tiling.intersect_tiles, limit=1))
    for narrow in (rows, _gradients(scene, pose, torch.float64, **options)):
        assert torch.equal(narrow[0], wide[0]) and narrow[2].intersections == wide[2].intersections
        assert narrow[2].bytes < wide[2].bytes
        for name, expected in wide[1].items():
            assert torch.allclose(narrow[1][name], expected, rtol=1e-12, atol=1e-12), name


def test_gaussians_on_the_cpu_are_refused_unless_interpreted(make_scene, pose, monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(InputError, match="needs Gaussians on a CUDA device, got them on 'cpu'"):
        rasterize(make_scene(1), pose, size=(4, 8), backend="triton")


@pytest.mark.parametrize(
    ("triton", "found"),
    [
        (None, "which is not installed"),
        (types.SimpleNamespace(__version__="3.1.0"), "which has version 3.1"),
        (types.SimpleNamespace(__version__="2.3.1+git"), "which has version 2.3"),
    ],
)
def test_a_missing_or_old_triton_is_an_error_and_auto_does_not_select_it(
    make_scene, pose, unchecked, monkeypatch, triton, found
):
    monkeypatch.setitem(sys.modules, "triton", triton)
    with pytest.raises(InputError, match=f"needs the package triton 3.2 or newer, {found}"):
        rasterize(make_scene(1), pose, size=(4, 8), backend="triton")
    assert select_automatically(is_cuda=True) is reference.rasterize_planes


def test_auto_selects_triton_only_on_cuda(unchecked, monkeypatch):
    assert select_automatically(is_cuda=True) is cuda.rasterize_planes
    assert select_automatically(is_cuda=False) is not cuda.rasterize_planes
    monkeypatch.setitem(sys.modules, "triton", types.SimpleNamespace(__version__="3.10.0.post1"))
    assert select_automatically(is_cuda=True) is cuda.rasterize_planes


def select_automatically(*, is_cuda: bool) -> object:
    device = torch.device("cuda" if is_cuda else "cpu")
    means = types.SimpleNamespace(is_cuda=is_cuda, device=device, dtype=torch.float32)
    return _select_backend("auto", types.SimpleNamespace(means=means), "ewa")
