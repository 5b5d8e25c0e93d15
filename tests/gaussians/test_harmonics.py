"""Spherical harmonics: orthonormal, in 3DGS order and signs, differentiable."""

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from pansplat.gaussians.harmonics import basis, evaluate


def _random_directions(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)


def test_basis_is_orthonormal_on_the_sphere():
    nodes, weights = np.polynomial.legendre.leggauss(12)  # exact for polynomials of degree 23
    longitude = torch.arange(24, dtype=torch.float64) * (2 * math.pi / 24)
    z = torch.tensor(nodes)[:, None].expand(12, 24)
    ring = torch.sqrt(1 - z * z)
    directions = torch.stack((ring * torch.cos(longitude), ring * torch.sin(longitude), z), dim=-1)
    area = torch.tensor(weights)[:, None].expand(12, 24) * (2 * math.pi / 24)
    y = basis(directions, 4).reshape(-1, 25)
    gram = y.T @ (y * area.reshape(-1, 1))
    assert torch.allclose(gram, torch.eye(25, dtype=torch.float64), atol=1e-12)


def test_basis_equals_scipys_with_the_sign_of_3dgs():
    directions = _random_directions(50)
    x, y, z = directions.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    ours = basis(directions, 4).numpy()
    for degree in range(5):
        for order in range(-degree, degree + 1):
            complex_value = sph_harm_y(degree, abs(order), polar, azimuth)  # holds the phase (-1)^m already
            part = complex_value.imag if order < 0 else complex_value.real
            expected = part * (math.sqrt(2) if order else 1)
            np.testing.assert_allclose(ours[:, degree * degree + degree + order], expected, atol=1e-12)


def test_first_coefficients_are_those_of_3dgs_files():
    x, y, z = 0.48, 0.6, 0.64
    expected = [
        0.28209479177387814, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    got = basis(torch.tensor([x, y, z], dtype=torch.float64), 3)
    assert torch.allclose(got, torch.tensor(expected, dtype=torch.float64), atol=1e-14)


@pytest.mark.parametrize("degree", range(5))
def test_every_coefficient_changes_the_colour(degree: int):
    direction = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.7], dtype=torch.float64), dim=0)
    count = (degree + 1) ** 2
    dark = evaluate(torch.zeros(count, 3, dtype=torch.float64), direction)
    assert torch.equal(dark, torch.full((3,), 0.5, dtype=torch.float64))
    for k in range(count):
        one = torch.zeros(count, 3, dtype=torch.float64)
        one[k, 1] = 0.1
        change = evaluate(one, direction) - dark
        assert change[1].abs() > 1e-4 and change[0] == change[2] == 0


def test_colour_is_differentiable_in_coefficients_and_direction():
    directions = _random_directions(3, seed=1).requires_grad_()
    generator = torch.Generator().manual_seed(2)
    harmonics = (0.1 * torch.randn(3, 25, 3, generator=generator, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(evaluate, (harmonics, directions))


def test_colour_never_is_negative_and_has_no_slope_where_it_is_off():
    harmonics = torch.tensor([[[-9.0, -0.5 / 0.28209479177387814, 1.0]]], dtype=torch.float64, requires_grad=True)
    colour = evaluate(harmonics, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    colour.sum().backward()
    assert colour[0, 0] == 0 and harmonics.grad is not None
    assert harmonics.grad[0, 0, 0] == 0 and harmonics.grad[0, 0, 2] > 0


def test_basis_refuses_unknown_degrees():
    with pytest.raises(ValueError, match=r"`degree` must be 0\.\.4, got 5"):
        basis(torch.ones(3), 5)
    with pytest.raises(ValueError, match="1, 4, 9, 16 or 25"):
        evaluate(torch.zeros(5, 3), torch.ones(3))
