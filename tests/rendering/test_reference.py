"""The torch reference against closed forms, a dense float64 renderer and finite differences; its tile intersections."""

import dataclasses
import functools
import math

import pytest
import torch

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import pixel_directions
from pansplat.rendering import rasterize as _rasterize
from pansplat.rendering import reference
from pansplat.rendering.reference import intersect_tiles

rasterize = functools.partial(_rasterize, backend="torch")  # float32 too

_ORIGIN = torch.eye(4, dtype=torch.float64)
_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


# --- images ---


@pytest.mark.parametrize("mean", [(1.0, -0.7, 1.3), (0, -2.0, 0), (-0.1, 0.2, -3.0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_ball_has_its_closed_form(mean, dtype, balls):
    height, sigma, opacity = 64, 0.1, 0.8
    got = rasterize(balls(mean, sigma, opacity).to(dtype=dtype), _ORIGIN, size=(height, 2 * height))
    mean = torch.tensor(mean, dtype=torch.float64)
    radius = mean.norm()
    cosine = pixel_directions(height, 2 * height, dtype=torch.float64) @ (mean / radius)
    sine2 = 1 - cosine**2
    own, filtered = (sigma / radius) ** 2, (sigma / radius) ** 2 + 0.1 * (math.pi / height) ** 2
    q = sine2 / (filtered * cosine**2 + own * sine2)
    alpha = (opacity * own / filtered) * torch.exp(-q / 2)
    alpha = torch.where((cosine > 0) & (alpha >= 1 / 255), alpha, 0)
    tolerance = 2e-6 if dtype == torch.float32 else 1e-13
    assert got.alpha.dtype == got.color.dtype == got.depth.dtype == dtype
    assert (got.alpha - alpha).abs().max() < tolerance
    colour = torch.tensor((0.9, 0.4, 0.2), dtype=torch.float64)[:, None, None]
    assert (got.color - alpha * colour).abs().max() < tolerance
    assert torch.allclose(got.depth.double(), torch.where(alpha > 0, radius, 0.0), rtol=1e-6)
    assert 0 < float((alpha > 0).double().mean()) < 0.1


_CASES = [
    dict(layout="equirect", kernel="ray", order="radial", lowpass="angular"),
    dict(layout="equirect", kernel="ray", order="z", lowpass="3dgs"),
    dict(layout="pinhole", kernel="ray", order="radial", lowpass="3dgs"),
    dict(layout="pinhole", kernel="ray", order="z", lowpass="angular"),
    dict(layout="pinhole", kernel="ewa", order="radial", lowpass="angular"),
    dict(layout="pinhole", kernel="ewa", order="z", lowpass="3dgs"),
]


@pytest.mark.parametrize("options", _CASES, ids=lambda o: "-".join(o.values()))
@pytest.mark.parametrize(("count", "scale"), [(200, 0.02), (120, 0.5)])
def test_images_equal_dense_float64(options, count, scale, make_scene, dense, pose):
    scene = make_scene(count, scale=scale, seed=count)
    panorama = options["layout"] == "equirect"
    size, fov = ((22, 44), None) if panorama else ((22, 30), 70.0)
    order = "radial" if panorama else options["order"]
    dense_options = {"fov": fov, "kernel": options["kernel"], "order": order, "lowpass": options["lowpass"]}
    color, alpha, depth = dense(scene, pose, size, **dense_options)
    got = rasterize(scene, pose, size=size, vertical_fov_degrees=70.0, **options)
    assert float(alpha.mean()) > 0.01
    assert (got.color - color).abs().max() < 1e-10
    assert (got.alpha - alpha).abs().max() < 1e-10
    assert (got.depth * got.alpha - depth).abs().max() < 1e-10
    single = rasterize(scene.to(dtype=torch.float32), pose, size=size, vertical_fov_degrees=70.0, **options)
    assert (single.color - color).abs().max() < 1e-5
    assert (single.color - color).abs().mean() < 5e-7


# --- gradients ---


def _leaves(scene: Gaussians) -> dict[str, torch.Tensor]:
    return {name: getattr(scene, name).detach().clone().requires_grad_() for name in _FIELDS}


@pytest.mark.slow
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
@pytest.mark.parametrize("by_covariance", [False, True], ids=["scales", "covariances"])
def test_gradients_equal_finite_differences_for_every_input(layout, kernel, lowpass, by_covariance, make_scene, pose):
    scene = make_scene(3, scale=0.5, seed=3, degree=1)
    in_view = torch.tensor((0.3, 0.3, 0.2), dtype=torch.float64) * scene.means + torch.tensor((0.0, 0.0, 1.5))
    channels = torch.cat((scene.harmonics, -scene.harmonics[:, :, :2]), dim=2)  # five
    scene = dataclasses.replace(scene, means=in_view @ pose[:3, :3].T + pose[:3, 3], harmonics=channels)
    factors = torch.linalg.cholesky(scene.covariances)

    def render(*values):
        *fields, background, camera, factors = values
        changed = dataclasses.replace(scene, **dict(zip(_FIELDS, fields, strict=True)))
        got = rasterize(
            changed, camera, size=(2, 4), layout=layout, kernel=kernel, lowpass=lowpass, vertical_fov_degrees=120.0,
            face_size=2, background=background, covariances=factors @ factors.mT if by_covariance else None,
        )  # fmt: skip
        return got.color, got.alpha, got.depth

    background = torch.tensor((0.3, 0.6, 0.9, 0.1, 0.2), dtype=torch.float64, requires_grad=True)
    cameras = pose.clone().requires_grad_(), factors.requires_grad_(by_covariance)
    inputs = (*_leaves(scene).values(), background, *cameras)
    assert all(float(output.detach().abs().max()) > 0.1 for output in render(*inputs))
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-6, fast_mode=True)


@pytest.mark.parametrize("kernel", ["ray", "ewa"])
@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_through_many_blocks_equal_the_dense_renderers(kernel, lowpass, dtype, make_scene, dense, pose):
    scene = make_scene(150, scale=0.3, seed=5)  # several blocks in each of 2 x 3 tiles
    target = torch.rand(5, 13, 18, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    options = dict(kernel=kernel, lowpass=lowpass)
    camera, leaves = pose.clone().requires_grad_(), _leaves(scene)
    expected_images = dense(dataclasses.replace(scene, **leaves), camera, (13, 18), fov=80.0, **options)
    loss = (
        (expected_images[0] * target[:3]).sum()
        + (expected_images[1] * target[3]).sum()
        + (expected_images[2] * target[4]).sum()
    )
    loss.backward()
    ours, our_camera = _leaves(scene.to(dtype=dtype)), pose.clone().requires_grad_()
    changed = dataclasses.replace(scene, **ours)
    got = rasterize(changed, our_camera, size=(13, 18), layout="pinhole", vertical_fov_degrees=80.0, **options)
    depth = (got.depth * got.alpha * target[4]).sum()
    ((got.color * target[:3]).sum() + (got.alpha * target[3]).sum() + depth).backward()
    tolerance = 1e-9 if dtype == torch.float64 else 2e-4
    for name in _FIELDS:
        expected, found = leaves[name].grad, ours[name].grad
        assert expected is not None and found is not None and found.dtype == dtype
        assert float((found - expected).norm() / expected.norm()) < tolerance, name
    assert camera.grad is not None and our_camera.grad is not None
    # The two formulas agree along rigid motions only.
    motions = []
    for gradient in (camera.grad, our_camera.grad):
        turn = pose[:3, :3].T @ gradient[:3, :3]
        motions.append(torch.cat((turn - turn.T, gradient[:3, 3:]), dim=1))
    assert float((motions[1] - motions[0]).norm() / motions[0].norm()) < tolerance


def test_a_second_backward_over_a_retained_graph_doubles_the_gradient(make_scene, pose):
    scene = make_scene(20)
    leaves = _leaves(scene)
    loss = rasterize(dataclasses.replace(scene, **leaves), pose, size=(8, 16)).color.sum()
    loss.backward(retain_graph=True)
    once = {name: leaf.grad.clone() for name, leaf in leaves.items() if leaf.grad is not None}
    loss.backward()
    assert len(once) == 5
    for name, leaf in leaves.items():
        assert leaf.grad is not None and torch.allclose(leaf.grad, 2 * once[name])


# --- tile intersections ---


def test_an_image_is_the_same_in_narrow_bands(make_scene, pose, monkeypatch):
    scene = make_scene(120, scale=0.3)
    whole = rasterize(scene, pose, size=(40, 80))
    monkeypatch.setattr(reference, "intersect_tiles", functools.partial(intersect_tiles, limit=50))
    assert torch.equal(rasterize(scene, pose, size=(40, 80)).color, whole.color)
    assert math.isfinite(float(whole.color.sum()))
