"""Gradients: gradcheck for every input, equality with the dense renderer's, zero where nothing is drawn."""

import dataclasses
import functools
import math

import pytest
import torch

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize as _rasterize

rasterize = functools.partial(_rasterize, backend="torch")  # float32 too

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


def _leaves(scene: Gaussians) -> dict[str, torch.Tensor]:
    return {name: getattr(scene, name).detach().clone().requires_grad_() for name in _FIELDS}


@pytest.mark.parametrize(
    ("layout", "kernel", "lowpass"),
    [
        ("equirect", "ray", "angular"),
        ("pinhole", "ray", "3dgs"),
        ("pinhole", "ewa", "angular"),
        ("pinhole", "ewa", "3dgs"),
        ("cubemap", "ray", "angular"),
    ],
)
def test_gradients_equal_finite_differences_for_every_input(layout, kernel, lowpass, make_scene, pose):
    scene = make_scene(3, scale=0.5, seed=3, degree=1)
    in_view = torch.tensor((0.3, 0.3, 0.2), dtype=torch.float64) * scene.means + torch.tensor((0.0, 0.0, 1.5))
    scene = dataclasses.replace(scene, means=in_view @ pose[:3, :3].T + pose[:3, 3])
    leaves = _leaves(scene)
    background = torch.tensor((0.3, 0.6, 0.9), dtype=torch.float64, requires_grad=True)

    def draw(*values):
        *fields, back, camera = values
        changed = dataclasses.replace(scene, **dict(zip(_FIELDS, fields, strict=True)))
        got = rasterize(
            changed, camera, size=(2, 4), layout=layout, kernel=kernel, lowpass=lowpass,
            vertical_fov_degrees=120.0, face_size=2, background=back,
        )  # fmt: skip
        return got.color, got.alpha, got.depth

    inputs = (*leaves.values(), background, pose.clone().requires_grad_())
    assert all(float(output.detach().abs().max()) > 0.1 for output in draw(*inputs))
    assert torch.autograd.gradcheck(draw, inputs, eps=1e-6, atol=1e-6, fast_mode=False)


@pytest.mark.parametrize("kernel", ["ray", "ewa"])
@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_through_many_blocks_equal_the_dense_renderers(kernel, lowpass, dtype, make_scene, dense, pose):
    scene = make_scene(150, scale=0.3, seed=5)  # several blocks in each of 2 x 3 tiles
    target = torch.rand(5, 13, 18, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    camera = pose.clone().requires_grad_()
    leaves = _leaves(scene)
    literal = dense(Gaussians(**leaves, levels=scene.levels, views=scene.views), camera, (13, 18),
                    fov=80.0, kernel=kernel, lowpass=lowpass)  # fmt: skip
    loss = (literal[0] * target[:3]).sum() + (literal[1] * target[3]).sum() + (literal[2] * target[4]).sum()
    loss.backward()
    ours, our_camera = _leaves(scene.to(dtype=dtype)), pose.clone().requires_grad_()
    got = rasterize(
        Gaussians(**ours, levels=scene.levels, views=scene.views), our_camera, size=(13, 18),
        layout="pinhole", vertical_fov_degrees=80.0, kernel=kernel, lowpass=lowpass,
    )  # fmt: skip
    depth = (got.depth * got.alpha * target[4]).sum()
    ((got.color * target[:3]).sum() + (got.alpha * target[3]).sum() + depth).backward()
    tolerance = 1e-9 if dtype == torch.float64 else 2e-4
    for name in _FIELDS:
        expected, found = leaves[name].grad, ours[name].grad
        assert expected is not None and found is not None and found.dtype == dtype
        assert float((found - expected).norm() / expected.norm()) < tolerance, name
    assert camera.grad is not None and our_camera.grad is not None
    # Off the rigid motions the two formulas differ; along them they agree.
    motions = []
    for gradient in (camera.grad, our_camera.grad):
        turn = pose[:3, :3].T @ gradient[:3, :3]
        motions.append(torch.cat((turn - turn.T, gradient[:3, 3:]), dim=1))
    assert float((motions[1] - motions[0]).norm() / motions[0].norm()) < tolerance


def test_gradients_of_what_is_not_drawn_are_zero(make_scene, pose):
    scene = make_scene(24, scale=0.3).to(dtype=torch.float32)
    leaves = _leaves(scene)
    with torch.no_grad():
        leaves["means"][0] = math.nan
        leaves["scales"][1, 1] = math.inf
        leaves["opacities"][2] = math.nan
        leaves["harmonics"][3, 0, 0] = math.inf
        leaves["quats"][4, 2] = math.nan
        leaves["means"][5] = pose[:3, 3].float()  # at the camera
        leaves["opacities"][6] = 0.0
        leaves["opacities"][7] = -3.0
        leaves["scales"][8] = 0.0  # a point: nothing is left of it
    got = rasterize(Gaussians(**leaves, levels=scene.levels, views=scene.views), pose, size=(12, 24))
    (got.color.sum() + got.depth.sum()).backward()
    assert got.info is not None and (got.info.dropped, got.info.near) == (5, 1)
    for leaf in leaves.values():
        assert leaf.grad is not None and torch.isfinite(leaf.grad).all()
        assert float(leaf.grad[:9].abs().max()) == 0 and float(leaf.grad[9:].abs().max()) > 0


@pytest.mark.parametrize("thin", [(0,), (0, 1), (0, 1, 2)])
def test_gradients_of_discs_needles_and_zero_quaternions_are_finite(thin, make_scene, pose):
    scene = make_scene(60, scale=0.4)
    leaves = _leaves(scene)
    with torch.no_grad():
        leaves["scales"][:, thin] = 0
        leaves["quats"][::3] = 0
    for kernel in ("ray", "ewa"):
        for lowpass in ("angular", "3dgs"):
            scene = Gaussians(**leaves, levels=scene.levels, views=scene.views)
            got = rasterize(scene, pose, size=(10, 20), layout="cubemap", kernel=kernel, lowpass=lowpass)
            (got.color.sum() + got.depth.sum()).backward()
    for leaf in leaves.values():
        assert leaf.grad is not None and torch.isfinite(leaf.grad).all()


def test_gradients_are_finite_with_the_camera_inside_gaussians(make_scene):
    scene = make_scene(20, scale=2.0, spread=0.4)
    for dtype in (torch.float32, torch.float64):
        leaves = _leaves(scene.to(dtype=dtype))
        drawn = Gaussians(**leaves, levels=scene.levels, views=scene.views)
        got = rasterize(drawn, torch.eye(4, dtype=torch.float64), size=(12, 24), layout="cubemap")
        got.color.sum().backward()
        assert all(leaf.grad is not None and torch.isfinite(leaf.grad).all() for leaf in leaves.values())


def test_a_clamped_opacity_has_no_gradient():
    label = torch.zeros(1, dtype=torch.int64)
    opacity = torch.tensor([5.0], dtype=torch.float64, requires_grad=True)
    scene = Gaussians(
        torch.tensor([[0.0, 0, 2]], dtype=torch.float64), torch.full((1, 3), 1.9, dtype=torch.float64),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64), opacity,
        torch.ones(1, 1, 3, dtype=torch.float64), label, label,
    )  # fmt: skip
    eye = torch.eye(4, dtype=torch.float64)
    rasterize(scene, eye, size=(1, 1), layout="pinhole", lowpass="3dgs").color.sum().backward()
    assert opacity.grad is not None and float(opacity.grad) == 0


def test_a_second_derivative_is_refused_clearly(make_scene, pose):
    scene = make_scene(3, scale=0.5)
    leaves = _leaves(scene)
    drawn = rasterize(Gaussians(**leaves, levels=scene.levels, views=scene.views), pose, size=(4, 8))
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(drawn.color.sum(), leaves["means"], create_graph=True)


def test_backward_twice_over_a_kept_graph_doubles_the_gradient(make_scene, pose):
    scene = make_scene(20)
    leaves = _leaves(scene)
    loss = rasterize(Gaussians(**leaves, levels=scene.levels, views=scene.views), pose, size=(8, 16)).color.sum()
    loss.backward(retain_graph=True)
    once = {name: leaf.grad.clone() for name, leaf in leaves.items() if leaf.grad is not None}
    loss.backward()
    assert len(once) == 5
    for name, leaf in leaves.items():
        assert leaf.grad is not None and torch.allclose(leaf.grad, 2 * once[name])
