"""Spherical harmonics: orthonormal, in 3DGS order and signs, differentiable, rotated; the official evaluation."""

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from pansplat.gaussians.harmonics import (
    evaluate_harmonics,
    harmonics_basis,
    official_harmonics,
    rotate_harmonics,
    rotation_matrices,
)
from pansplat.geometry.pose import rotations_from_quats


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _directions(count: int, seed: int = 0) -> torch.Tensor:
    return torch.nn.functional.normalize(_random(count, 3, seed=seed), dim=-1)


def test_basis_equals_scipys_with_the_sign_of_3dgs():
    directions = _directions(50)
    x, y, z = directions.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    ours = harmonics_basis(directions, 4).numpy()
    for degree in range(5):
        for order in range(-degree, degree + 1):
            complex_value = sph_harm_y(degree, abs(order), polar, azimuth)  # includes the phase (-1)^m
            part = complex_value.imag if order < 0 else complex_value.real
            expected = part * (math.sqrt(2) if order else 1)
            np.testing.assert_allclose(ours[:, degree * degree + degree + order], expected, atol=1e-12)


def test_colour_is_differentiable_in_coefficients_and_direction():
    directions = _directions(3, seed=1).requires_grad_()
    harmonics = (0.1 * _random(3, 25, 3, seed=2)).requires_grad_()
    assert torch.autograd.gradcheck(evaluate_harmonics, (harmonics, directions))


def test_colours_are_not_negative_and_have_no_gradient_at_zero():
    harmonics = torch.tensor([[[-9.0, -0.5 / 0.28209479177387814, 1.0]]], dtype=torch.float64, requires_grad=True)
    colour = evaluate_harmonics(harmonics, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    colour.sum().backward()
    assert colour[0, 0] == 0 and harmonics.grad is not None
    assert harmonics.grad[0, 0, 0] == 0 and harmonics.grad[0, 0, 2] > 0


def test_unknown_degrees_are_refused():
    with pytest.raises(ValueError, match=r"`degree` must be 0\.\.4, got 5"):
        harmonics_basis(torch.ones(3), 5)
    with pytest.raises(ValueError, match="1, 4, 9, 16 or 25"):
        evaluate_harmonics(torch.zeros(5, 3), torch.ones(3))
    with pytest.raises(ValueError, match=r"`degree` must be 0\.\.4, got 5"):
        rotation_matrices(torch.eye(3, dtype=torch.float64), 5)


@pytest.mark.parametrize("degree", range(5))
def test_rotated_harmonics_have_the_same_colours_in_rotated_directions(degree: int):
    rotation = rotations_from_quats(_random(4))
    harmonics = _random((degree + 1) ** 2, 3, seed=1)
    directions = _directions(40, seed=2)
    before = harmonics_basis(directions, degree) @ harmonics
    after = harmonics_basis(directions @ rotation.T, degree) @ rotate_harmonics(harmonics, rotation)
    assert torch.allclose(before, after, atol=1e-13)


def test_rotation_keeps_the_dtype_and_passes_gradcheck():
    harmonics, rotation = _random(2, 25, 3), rotations_from_quats(_random(4))
    assert rotate_harmonics(harmonics.float(), rotation).dtype == torch.float32
    assert torch.autograd.gradcheck(rotate_harmonics, (harmonics.requires_grad_(), rotation.requires_grad_()))


@pytest.mark.shared
def test_the_official_rotation_equals_ours_in_its_axes(golden):
    """Its basis has the polar axis y."""
    units = golden("units")
    polar_y = torch.tensor(((0.0, 0, 1), (1, 0, 0), (0, 1, 0)), dtype=torch.float64)
    for before, after, rotation in zip(
        units["sh.in"].double(), units["sh.out"].double(), units["sh.rotations"].double(), strict=True
    ):
        flip = torch.diag(torch.tensor((-1.0, 1, -1), dtype=torch.float64))
        our_rotation = polar_y @ flip @ rotation @ flip @ polar_y.T
        assert torch.allclose(rotate_harmonics(before.T, our_rotation).T, after, atol=5e-5)  # float32 error: 1e-5


_TO_WORLD = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)  # the official x, y, z are z, x, y


def _official_basis(directions: torch.Tensor) -> torch.Tensor:
    """The sixteen functions of docs/official.md, section 10.3, in world axes, with its coefficient 14."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        (
            torch.full_like(x, 0.28209479), -0.48860251 * x, 0.48860251 * y, -0.48860251 * z,
            1.09254843 * z * x, -1.09254843 * x * y, 0.31539157 * (2 * yy - zz - xx), -1.09254843 * z * y,
            0.54627422 * (zz - xx), -0.59004359 * x * (3 * zz - xx), 2.89061144 * z * x * y,
            -0.45704580 * x * (4 * yy - zz - xx), 0.37317633 * y * (2 * yy - 3 * zz - 3 * xx),
            -0.45704580 * z * (4 * yy - zz - xx), 1.44530572 * z * (zz - xx), -0.59004359 * z * (zz - 3 * xx),
        ),
        dim=-1,
    )  # fmt: skip


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16, 25])
def test_official_colours_are_those_of_the_official_basis(coefficients):
    harmonics, directions = 0.3 * _random(40, coefficients, 3), _directions(40, seed=1)
    kept = min(coefficients, 16)
    expected = (_official_basis(directions)[:, None, :kept] @ harmonics[:, :kept])[:, 0] + 0.5
    world = rotate_harmonics(harmonics, _TO_WORLD)
    got = evaluate_harmonics(official_harmonics(world), directions)
    assert torch.allclose(got, expected.clamp_min(0), rtol=0, atol=1e-7)
    apart = float((evaluate_harmonics(world, directions) - got).abs().max())
    assert (apart > 0.05) == (coefficients >= 16) and (coefficients >= 16 or apart == 0)
