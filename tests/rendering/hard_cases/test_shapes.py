"""Hard cases 10, 14, 15, 16 and 23: shapes at the limits of both kernels."""

import dataclasses
import math

import pytest
import torch

from pansplat.errors import InputError

_PINHOLE = {"layout": "pinhole", "vertical_fov_degrees": 90.0}


@pytest.mark.hard_case(10)
@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
def test_ewa_clamps_means_outside_the_view(lowpass, render, balls, equals_dense):
    means = [(14 * 0.3, 0.1, 0.3), (-0.5, 0.9, 0.21), (0.3, 1.4, 1.0), (0.1, -0.1, 2.0)]
    scene = balls(means, sigma=[1.5, 0.4, 0.5, 0.3], colours=torch.rand(4, 3, dtype=torch.float64))
    assert all(abs(x / z) > 1.3 or abs(y / z) > 1.3 for x, y, z in means[:3])
    for i in range(4):
        assert (
            float(render(scene.select(torch.tensor([i])), kernel="ewa", lowpass=lowpass, **_PINHOLE).alpha.max()) > 0.02
        )
    equals_dense(render, scene, kernel="ewa", order="z", lowpass=lowpass, slack=4, **_PINHOLE)


@pytest.mark.hard_case(10)
def test_where_ewa_clamps_the_gradient_is_that_of_the_centre(render, balls, leaves):
    """The clamped Jacobian does not depend on x / z."""
    scene = leaves(balls((2.0, 0.0, 1.0), 0.6).to(dtype=render.dtype))
    render(scene, kernel="ewa", **_PINHOLE).alpha.sum().backward()
    step, sums = 1e-3, []
    for side in (-step, step):
        sums.append(float(render(balls((2.0 + side, 0.0, 1.0), 0.6), kernel="ewa", **_PINHOLE).alpha.double().sum()))
    assert float(scene.means.grad[0, 0]) == pytest.approx((sums[1] - sums[0]) / (2 * step), rel=0.05)


@pytest.mark.torch_float32
@pytest.mark.hard_case(14)
@pytest.mark.parametrize("axis", [0, 1, 2], ids=["x", "y", "z"])
@pytest.mark.parametrize("kernel", ["ray", "ewa"])
def test_needles_of_ten_thousand_to_one_equal_the_dense_renderer(axis, kernel, render, balls, equals_dense):
    render.skip_interpreted(axis != 0)
    scene = balls([(0.1, 0.1, 2.0), (-0.6, 0.3, 1.5)], colours=torch.rand(2, 3, dtype=torch.float64))
    scales = torch.full((2, 3), 1e-4, dtype=torch.float64)
    scales[:, axis] = 1.0
    quats = torch.tensor([[0.95, 0.1, -0.05, 0.2], [1.0, 0, 0, 0]], dtype=torch.float64)
    scene = dataclasses.replace(scene, scales=scales, quats=quats)
    fields = ("means", "scales", "opacities", "harmonics")
    equals_dense(render, scene, kernel=kernel, lowpass="3dgs", fields=fields, slack=10, **_PINHOLE)


@pytest.mark.hard_case(15)
def test_a_disc_that_faces_the_camera_has_its_closed_form(render, balls):
    size, sigma = (render.height + 1, 2 * render.height + 1), 0.5
    scene = balls((0, 0, 2.0))
    scene = dataclasses.replace(scene, scales=torch.tensor([[sigma, sigma, 0.0]], dtype=torch.float64))
    alpha = render(scene, size=size, lowpass="3dgs", **_PINHOLE).alpha.double()
    focal = 0.5 * size[0]
    x = (torch.arange(size[1], dtype=torch.float64) + 0.5 - 0.5 * size[1]) / focal
    y = (torch.arange(size[0], dtype=torch.float64) + 0.5 - 0.5 * size[0]) / focal
    squared = (x.square() + y[:, None].square()) / ((sigma / 2) ** 2 + 0.3 / focal**2)
    expected = 0.8 * torch.exp(-0.5 * squared)
    assert (alpha - torch.where(expected >= 1 / 255, expected, 0)).abs().max() < 10 * render.image


@pytest.mark.slow
@pytest.mark.hard_case(15)
@pytest.mark.parametrize("kernel", ["ray", "ewa"])
@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
def test_discs_on_edge_lines_and_points_vanish_or_stay_finite(kernel, lowpass, render, balls, gradients):
    render.skip_interpreted((kernel, lowpass) not in (("ray", "angular"), ("ewa", "3dgs")))
    flat = {"edge-on disc": (0.0, 0.5, 0.5), "line": (0.0, 0.0, 0.5), "line aside": (0.5, 0, 0), "point": (0, 0, 0)}
    for name, scales in flat.items():
        scene = balls((0, 0, 2.0))
        scene = dataclasses.replace(scene, scales=torch.tensor([scales], dtype=torch.float64))
        options = {"kernel": kernel, "lowpass": lowpass, **_PINHOLE}
        alpha = render(scene, **options).alpha
        assert torch.isfinite(alpha).all()
        if lowpass == "angular":
            assert not alpha.any(), name  # a shape without area has no energy
        for field, gradient in gradients(render, scene, **options).items():
            assert torch.isfinite(gradient).all(), (name, field)
            assert lowpass == "3dgs" or not gradient.any()


@pytest.mark.hard_case(16)
def test_specks_of_a_twentieth_pixel_keep_their_energy(render, balls, equals_dense):
    """The alpha cut removes a known fraction of a Gaussian's mass: cut / peak."""
    count, apart, focal = 9, 5, 1000.0
    size = (count * apart, count * apart)
    y, x = torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij")
    places = torch.stack((x, y), dim=-1).double().reshape(-1, 2) * (apart + 1 / count) + 2.5  # all sub-pixel positions
    ahead = torch.cat(((places - 0.5 * size[0]) / focal, torch.ones(count**2, 1, dtype=torch.float64)), dim=1)
    scene = balls(torch.nn.functional.normalize(ahead, dim=1), 0.05 / focal, 1.0)
    fov = 2 * math.degrees(math.atan(0.5 * size[0] / focal))
    energies = {}
    for lowpass in ("angular", "3dgs"):
        alpha = render(scene, size=size, layout="pinhole", vertical_fov_degrees=fov, lowpass=lowpass).alpha.double()
        energies[lowpass] = float(alpha.sum()) / (2 * math.pi * 0.05**2 * count**2)
    peak = 0.05**2 / (0.05**2 + 0.1)
    assert energies["angular"] / (1 - 1 / 255 / peak) == pytest.approx(1, abs=0.01)
    assert energies["3dgs"] > 10  # adds variance without lowering the opacity
    speck = balls((0.02, 0.01, 1.0), 0.3 * math.pi / render.height, 1.0)
    equals_dense(render, speck, fields=("means", "scales", "opacities", "harmonics"), slack=2)


@pytest.mark.hard_case(23)
@pytest.mark.parametrize("kernel", ["ray", "ewa"])
def test_covariances_equal_scales_and_quaternions(kernel, render, make_scene, pose, leaves, loss_of):
    scene = make_scene(10, scale=0.6, degree=1).to(dtype=render.dtype)
    options = {"kernel": kernel, "layout": "pinhole", "vertical_fov_degrees": 110.0}
    by_shape, by_matrix = leaves(scene), leaves(scene)
    covariances = by_matrix.covariances
    expected, got = render(by_shape, pose, **options), render(by_matrix, pose, covariances=covariances, **options)
    assert float(expected.alpha.detach().mean()) > 0.05
    assert (got.color - expected.color).detach().abs().max() < 4 * render.image
    loss_of(expected).backward()
    loss_of(got).backward()
    for name in ("means", "scales", "quats", "opacities", "harmonics"):
        found, reference = getattr(by_matrix, name).grad, getattr(by_shape, name).grad
        assert float((found - reference).norm()) < 4 * render.gradient * float(reference.norm()), name


@pytest.mark.slow
@pytest.mark.hard_case(23)
def test_matrices_that_are_not_covariances_are_dropped_and_counted(render, balls, leaves, loss_of):
    scene = balls([(0, 0, 2.0), (0.5, 0, 2.0), (-0.5, 0, 2.0)], 0.3)
    good = scene.covariances
    broken = {
        "negative": torch.diag(torch.tensor((0.1, -0.1, 0.1), dtype=torch.float64)),
        "indefinite": torch.tensor([[0.1, 0.3, 0], [0.3, 0.1, 0], [0, 0, 0.1]], dtype=torch.float64),
        "not finite": torch.full((3, 3), math.nan, dtype=torch.float64),
    }
    others = scene.select(torch.tensor([0, 2]))
    expected = render(others, covariances=good[[0, 2]].to(render.dtype))
    for name, matrix in broken.items():
        covariances = torch.stack((good[0], matrix, good[2])).to(render.dtype).requires_grad_()
        inputs = leaves(scene.to(dtype=render.dtype))
        got = render(inputs, covariances=covariances)
        assert got.info is not None and got.info.dropped == 1, name
        assert torch.equal(got.color, expected.color)
        loss_of(got).backward()
        for gradient in (covariances.grad, inputs.means.grad, inputs.opacities.grad):
            assert torch.isfinite(gradient).all() and not gradient[1].any() and gradient[0].any(), name
        with pytest.raises(InputError, match=r"1 of 3 .*number 1"):
            render(scene, covariances=covariances.detach(), strict=True)
    assert torch.equal(render(scene, covariances=good).alpha, render(scene, covariances=good.to(render.dtype)).alpha)


@pytest.mark.hard_case(23)
def test_a_disc_rounded_to_a_slightly_negative_covariance_is_rendered(render, balls):
    scene = balls((0, 0, 2.0), 0.3)
    flat = torch.diag(torch.tensor((0.09, 0.09, -1e-7), dtype=torch.float64))[None]
    got = render(scene, covariances=flat)
    assert got.info is not None and got.info.dropped == 0 and float(got.alpha.max()) > 0.05
    assert torch.isfinite(got.color).all()
