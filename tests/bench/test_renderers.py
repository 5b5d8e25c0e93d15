"""The dense renderer equals the reference; unavailable renderers give a reason."""

from dataclasses import replace

import pytest
import torch

from pansplat.bench.raster_cases import RasterCase
from pansplat.bench.renderers import render_case, render_dense, unavailable_reason
from pansplat.bench.scenes import full_lattice_room
from pansplat.rendering import rasterize

HEIGHT = 16


@pytest.fixture
def pose():
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor((0.1, -0.05, 0.2))
    return pose


@pytest.mark.parametrize(
    ("dtype", "near", "tolerance"),
    [(torch.float64, 0.05, 1e-12), (torch.float64, 2.0, 1e-12), (torch.float32, 0.05, 2e-5)],
)
def test_dense_equals_the_reference(pose, dtype, near, tolerance):
    room = full_lattice_room(HEIGHT, degree=1)
    size = (HEIGHT, 2 * HEIGHT)
    expected = rasterize(room.to(dtype=torch.float64), pose, size=size, near=near, backend="torch").color
    rendered = render_dense(room.to(dtype=dtype), pose, HEIGHT, near=near)
    assert float((rendered - expected).abs().max()) < tolerance


def test_dense_gradients_equal_those_of_the_reference(pose):
    room = full_lattice_room(8, views=1).to(dtype=torch.float64)
    names = ("means", "scales", "quats", "opacities", "harmonics")
    grad_color = torch.rand(3, 8, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = []
    for render in (
        lambda g: render_dense(g, pose, 8),
        lambda g: rasterize(g, pose, size=(8, 16), backend="torch").color,
    ):
        leaves = {name: getattr(room, name).clone().requires_grad_() for name in names}
        found.append(torch.autograd.grad(render(replace(room, **leaves)), list(leaves.values()), grad_color))
    for one, other in zip(*found, strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-12)


def test_torch_and_dense_are_always_available_and_equal(pose):
    assert unavailable_reason("torch") is None and unavailable_reason("dense") is None
    room = full_lattice_room(8)
    images = [render_case(RasterCase(backend, 8), room, pose).color for backend in ("dense", "torch")]
    assert torch.allclose(*images, atol=1e-5)


@pytest.mark.skipif(torch.cuda.is_available(), reason="tests a machine without CUDA")
def test_triton_is_unavailable_without_cuda():
    assert unavailable_reason("triton") == "there is no CUDA device"
