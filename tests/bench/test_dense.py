"""The dense peer draws what the reference draws."""

from dataclasses import replace

import pytest
import torch

from pansplat.bench.dense import render_dense
from pansplat.bench.scenes import full_lattice_room
from pansplat.rendering import rasterize

HEIGHT = 16


@pytest.fixture
def pose():
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor((0.1, -0.05, 0.2))
    return pose


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_dense_equals_the_reference(pose, dtype, tolerance):
    room = full_lattice_room(HEIGHT, degree=1)
    expected = rasterize(room.to(dtype=torch.float64), pose, size=(HEIGHT, 2 * HEIGHT), backend="torch").color
    drawn = render_dense(room.to(dtype=dtype), pose, HEIGHT)
    assert float((drawn - expected).abs().max()) < tolerance


def test_dense_gradients_equal_the_references(pose):
    room = full_lattice_room(8, views=1).to(dtype=torch.float64)
    names = ("means", "scales", "quats", "opacities", "harmonics")
    upstream = torch.rand(3, 8, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = []
    for draw in (
        lambda g: render_dense(g, pose, 8),
        lambda g: rasterize(g, pose, size=(8, 16), backend="torch").color,
    ):
        leaves = {name: getattr(room, name).clone().requires_grad_() for name in names}
        found.append(torch.autograd.grad(draw(replace(room, **leaves)), list(leaves.values()), upstream))
    for one, other in zip(*found, strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-12)


def test_near_leaves_out_what_the_reference_leaves_out(pose):
    room = full_lattice_room(HEIGHT).to(dtype=torch.float64)
    expected = rasterize(room, pose, size=(HEIGHT, 2 * HEIGHT), near=2.0, backend="torch").color
    assert float((render_dense(room, pose, HEIGHT, near=2.0) - expected).abs().max()) < 1e-12
