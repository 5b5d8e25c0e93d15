"""The numba backend whole, forward and backward, against the float64 reference; and how it behaves in a program."""

import dataclasses
import multiprocessing
import os
import threading

import pytest
import torch

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize, reference
from pansplat.rendering.cpu import rasterize_planes, tiling
from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.rasterize import RasterOptions

_NAMES = ("means", "quats", "scales", "opacities", "harmonics")
_SIZES = {"equirect": (40, 80), "pinhole": (50, 70), "cubemap": (40, 80)}
_CASES = [
    (layout, kernel, order, lowpass)
    for layout in _SIZES
    for kernel in ("ray", "ewa")
    for order in ("radial", "z")
    for lowpass in ("angular", "3dgs")
    if (layout, kernel) != ("equirect", "ewa")
]


def _pictures(layout):
    return image_planes(layout, _SIZES[layout], vertical_fov_degrees=80.0, face_size=None, device=torch.device("cpu"))


def _scene(make_scene, channels=3, count=300):
    scene = make_scene(count, scale=0.15, degree=2, seed=1).to(dtype=torch.float32)
    harmonics = 0.4 * torch.randn(count, 9, channels, generator=torch.Generator().manual_seed(7))
    return dataclasses.replace(scene, harmonics=harmonics)


def _run(backend, scene, pose, layout, options, dtype, covariances=None):
    """Sums of a backend, and the gradients of a random combination of them."""
    leaves = {name: getattr(scene, name).to(dtype).requires_grad_() for name in _NAMES}
    camera = pose.clone().requires_grad_()
    if covariances is not None:
        leaves["covariances"] = covariances.to(dtype).requires_grad_()
    given = dataclasses.replace(scene, **{name: leaves[name] for name in _NAMES})
    drawn = backend(given, leaves.get("covariances"), camera, _pictures(layout), options)
    weights = torch.randn(drawn.sums.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    (drawn.sums.double() * weights).sum().backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    turn = pose[:3, :3].T @ camera.grad[:3, :3]
    gradients["pose"] = torch.cat((turn - turn.T, camera.grad[:3, 3:]), dim=1)
    return drawn, gradients


def _compare(scene, pose, layout, options, covariances=None):
    expected, wanted = _run(reference.rasterize_planes, scene, pose, layout, options, torch.float64, covariances)
    found, got = _run(rasterize_planes, scene, pose, layout, options, torch.float32, covariances)
    truth, ours = expected.sums.detach(), found.sums.detach()
    scale = float(truth.abs().max().clamp_min(1))
    assert float(truth[:, -1].max()) > 0.5
    assert float((ours.double() - truth).abs().max()) < 2e-6 * scale
    assert ours.dtype == torch.float32
    assert got.keys() == wanted.keys()
    for name, gradient in wanted.items():
        error = float((got[name].double() - gradient).norm() / gradient.norm())
        assert error < 1e-5, f"{name}: {error}"
    assert (found.info.total, found.info.dropped, found.info.near) == (len(scene), 0, expected.info.near)
    assert found.info.backend == "numba" and found.info.bytes > 0


@pytest.mark.parametrize(("layout", "kernel", "order", "lowpass"), _CASES)
def test_pictures_and_gradients_are_the_references(layout, kernel, order, lowpass, make_scene, pose):
    _compare(_scene(make_scene), pose, layout, RasterOptions(kernel, order, lowpass, 0.05, False))


@pytest.mark.parametrize(("layout", "kernel"), [("equirect", "ray"), ("pinhole", "ewa"), ("cubemap", "ray")])
@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
def test_covariances_are_drawn_as_the_reference_draws_them(layout, kernel, lowpass, make_scene, pose):
    scene = _scene(make_scene)
    _compare(scene, pose, layout, RasterOptions(kernel, "radial", lowpass, 0.05, False), scene.covariances)


@pytest.mark.parametrize("channels", [1, 2, 5, 32])
def test_any_number_of_channels_is_drawn(channels, make_scene, pose):
    _compare(_scene(make_scene, channels), pose, "equirect", RasterOptions("ray", "radial", "angular", 0.05, False))


@pytest.mark.parametrize("kernel", ["ray", "ewa"])
def test_bands_change_no_bit(kernel, make_scene, pose, monkeypatch):
    scene, options = _scene(make_scene), RasterOptions(kernel, "radial", "angular", 0.05, False)
    whole, gradients = _run(rasterize_planes, scene, pose, "pinhole", options, torch.float32)
    monkeypatch.setattr(tiling, "MAX_INTERSECTIONS", 20)
    banded, banded_gradients = _run(rasterize_planes, scene, pose, "pinhole", options, torch.float32)
    assert torch.equal(whole.sums, banded.sums)
    for name, gradient in gradients.items():  # sums of slots, here first by band
        torch.testing.assert_close(banded_gradients[name], gradient, rtol=1e-4, atol=1e-5 * float(gradient.abs().max()))


@pytest.mark.parametrize(("layout", "kernel"), [("equirect", "ray"), ("cubemap", "ewa")])
def test_pictures_and_gradients_are_the_same_bits_on_any_number_of_threads(layout, kernel, make_scene, pose):
    scene, options = _scene(make_scene, count=20000), RasterOptions(kernel, "radial", "angular", 0.05, False)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 5):
            torch.set_num_threads(threads)
            results.append(_run(rasterize_planes, scene, pose, layout, options, torch.float32))
    finally:
        torch.set_num_threads(before)
    (first, gradients), *others = results
    for drawn, same in others:
        assert torch.equal(drawn.sums, first.sums)
        assert all(torch.equal(same[name], gradients[name]) for name in gradients)


def test_only_the_gradients_asked_for_are_made(make_scene, pose):
    scene = _scene(make_scene)
    scene.opacities.requires_grad_()
    drawn = rasterize_planes(
        scene, None, pose, _pictures("pinhole"), RasterOptions("ray", "radial", "angular", 0.05, False)
    )
    drawn.sums.sum().backward()
    assert scene.opacities.grad is not None and scene.opacities.grad.any()
    assert all(getattr(scene, name).grad is None for name in _NAMES if name != "opacities")


def test_without_grad_nothing_is_kept(make_scene, pose):
    scene, options = _scene(make_scene), RasterOptions("ray", "radial", "angular", 0.05, False)
    plain = rasterize_planes(scene, None, pose, _pictures("pinhole"), options)
    scene.means.requires_grad_()
    recorded = rasterize_planes(scene, None, pose, _pictures("pinhole"), options)
    with torch.no_grad():
        drawn = rasterize_planes(scene, None, pose, _pictures("pinhole"), options)
    assert not drawn.sums.requires_grad
    assert set(drawn.info.seconds) == {"project", "bounds", "intersect", "sort", "rasterize"}
    assert drawn.info.bytes == plain.info.bytes < recorded.info.bytes


def test_second_derivatives_are_refused(make_scene, pose):
    scene = _scene(make_scene)
    scene.means.requires_grad_()
    picture = rasterize(scene, pose, size=(16, 32), backend="numba")
    with pytest.raises(RuntimeError, match="second derivatives of a rendering are not available"):
        torch.autograd.grad(picture.color.sum(), scene.means, create_graph=True)


def test_the_backward_may_be_asked_for_twice(make_scene, pose):
    scene = _scene(make_scene)
    scene.means.requires_grad_()
    total = rasterize(scene, pose, size=(16, 32), backend="numba").color.sum()
    first = torch.autograd.grad(total, scene.means, retain_graph=True)[0]
    rasterize(scene, pose, size=(32, 64), backend="numba")  # which must not take the memory kept for it
    assert torch.equal(torch.autograd.grad(total, scene.means)[0], first)


def test_float32_in_main_memory_is_drawn_by_numba_unless_asked_otherwise(make_scene, pose):
    scene = _scene(make_scene)
    assert rasterize(scene, pose, size=(8, 16)).info.backend == "numba"
    assert rasterize(scene.to(dtype=torch.bfloat16), pose, size=(8, 16)).info.backend == "numba"
    assert rasterize(scene.to(dtype=torch.float64), pose, size=(8, 16)).info.backend == "torch"
    assert rasterize(scene, pose, size=(8, 16), backend="torch").info.backend == "torch"


def test_float64_is_drawn_in_float32_and_given_back(make_scene, pose):
    scene = _scene(make_scene).to(dtype=torch.float64)
    scene.means.requires_grad_()
    picture = rasterize(scene, pose, size=(8, 16), backend="numba")
    picture.color.sum().backward()
    assert picture.color.dtype == scene.means.grad.dtype == torch.float64


def test_strict_names_the_first_gaussian_that_is_not_finite(make_scene, pose):
    scene = _scene(make_scene)
    scene.scales[17, 1] = float("nan")
    options = {"size": (8, 16), "backend": "numba"}
    assert rasterize(scene, pose, **options).info.dropped == 1
    with pytest.raises(InputError, match=r"got 1 of 300 that do not \(the first is number 17\)"):
        rasterize(scene, pose, strict=True, **options)


def test_a_side_that_a_box_cannot_hold_is_refused(make_scene, pose):
    with pytest.raises(InputError, match="at most 32767 pixels a side"):
        rasterize(_scene(make_scene), pose, size=(1, 40000), layout="pinhole", backend="numba")


def test_two_threads_may_draw_at_once(make_scene, pose):
    scene, options = _scene(make_scene, count=5000), RasterOptions("ray", "radial", "angular", 0.05, False)
    alone = [_run(rasterize_planes, scene, pose, layout, options, torch.float32) for layout in ("equirect", "cubemap")]
    together = {}

    def work(layout):
        for _ in range(5):
            together[layout] = _run(rasterize_planes, scene, pose, layout, options, torch.float32)

    threads = [threading.Thread(target=work, args=(layout,)) for layout in ("equirect", "cubemap")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for (drawn, gradients), layout in zip(alone, ("equirect", "cubemap"), strict=True):
        assert torch.equal(together[layout][0].sums, drawn.sums)
        assert all(torch.equal(together[layout][1][name], gradients[name]) for name in gradients)


def _in_child(scene: Gaussians, pose, queue):
    queue.put(rasterize(scene, pose, size=(16, 32), backend="numba").color.double().sum().item())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_draws_what_its_parent_drew(make_scene, pose):
    scene, before = _scene(make_scene), torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        expected = rasterize(scene, pose, size=(16, 32), backend="numba").color.double().sum().item()
        torch.set_num_threads(2)
        context = multiprocessing.get_context("fork")
        queue = context.Queue()
        child = context.Process(target=_in_child, args=(scene, pose, queue))
        child.start()
        assert queue.get(timeout=60) == expected
        child.join()
        assert child.exitcode == 0
    finally:
        torch.set_num_threads(before)
