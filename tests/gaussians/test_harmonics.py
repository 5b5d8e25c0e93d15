"""Spherical harmonics: orthonormal, in 3DGS order and signs, differentiable, rotated; the official evaluation."""

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from synthetic_scenes import draw_noise

from pansplat.gaussians.harmonics import evaluate_harmonics, harmonics_basis, rotate_harmonics
from pansplat.geometry.pose import rotations_from_quats


def _directions(count: int, seed: int = 0) -> torch.Tensor:
    return torch.nn.functional.normalize(draw_noise(count, 3, seed=seed), dim=-1)


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
    harmonics = (0.1 * draw_noise(3, 25, 3, seed=2)).requires_grad_()
    assert torch.autograd.gradcheck(evaluate_harmonics, (harmonics, directions))


@pytest.mark.parametrize("degree", range(5))
def test_rotated_harmonics_have_the_same_colours_in_rotated_directions(degree: int):
    rotation = rotations_from_quats(draw_noise(4))
    harmonics = draw_noise((degree + 1) ** 2, 3, seed=1)
    directions = _directions(40, seed=2)
    before = harmonics_basis(directions, degree) @ harmonics
    after = harmonics_basis(directions @ rotation.T, degree) @ rotate_harmonics(harmonics, rotation)
    assert torch.allclose(before, after, atol=1e-13)


def test_rotation_keeps_the_dtype_and_passes_gradcheck():
    harmonics, rotation = draw_noise(2, 25, 3), rotations_from_quats(draw_noise(4))
    assert rotate_harmonics(harmonics.float(), rotation).dtype == torch.float32
    given = harmonics.requires_grad_(), rotation.requires_grad_()
    assert torch.autograd.gradcheck(rotate_harmonics, given, fast_mode=True)


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
