"""Rotation of spherical harmonics: colours turn with the world, at every degree."""

from collections.abc import Callable

import pytest
import torch

from pansplat.gaussians.harmonics import basis
from pansplat.gaussians.harmonics_rotation import rotate_harmonics, rotation_matrices
from pansplat.geometry.pose import rotations_from_quats


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("degree", range(5))
def test_a_turned_colour_seen_from_turned_directions_is_the_same(degree: int):
    rotation = rotations_from_quats(_random(4))
    harmonics = _random((degree + 1) ** 2, 3, seed=1)
    directions = torch.nn.functional.normalize(_random(40, 3, seed=2), dim=-1)
    before = basis(directions, degree) @ harmonics
    after = basis(directions @ rotation.T, degree) @ rotate_harmonics(harmonics, rotation)
    assert torch.allclose(before, after, atol=1e-13)


def test_rotations_compose_and_keep_lengths_and_degrees_apart():
    a, b = rotations_from_quats(_random(2, 4))
    matrices = rotation_matrices(torch.stack((a, b, a @ b)), 4)
    assert torch.allclose(matrices[0] @ matrices[1], matrices[2], atol=1e-13)
    assert torch.allclose(matrices[0] @ matrices[0].T, torch.eye(25, dtype=torch.float64), atol=1e-13)
    assert bool((matrices[:, 4:9, 9:16] == 0).all())
    unturned = rotation_matrices(torch.eye(3, dtype=torch.float64), 4)
    assert torch.allclose(unturned, torch.eye(25, dtype=torch.float64), atol=1e-14)


def test_degree_one_turns_as_the_axes_do():
    rotation = rotations_from_quats(_random(4, seed=3))
    axes = torch.tensor(((0.0, -1, 0), (0, 0, 1), (-1, 0, 0)), dtype=torch.float64)  # Y_1..3 are -y, z, -x
    assert torch.allclose(rotation_matrices(rotation, 1)[1:, 1:], axes @ rotation @ axes.T, atol=1e-14)


def test_rotation_keeps_the_number_type_and_is_differentiable():
    harmonics, rotation = _random(2, 25, 3), rotations_from_quats(_random(4))
    assert rotate_harmonics(harmonics.float(), rotation).dtype == torch.float32
    assert torch.autograd.gradcheck(rotate_harmonics, (harmonics.requires_grad_(), rotation.requires_grad_()))


def test_unknown_degrees_are_refused():
    with pytest.raises(ValueError, match=r"`degree` must be 0\.\.4, got 5"):
        rotation_matrices(torch.eye(3, dtype=torch.float64), 5)


@pytest.mark.shared
def test_the_originals_rotation_is_ours_in_its_own_axes(golden: Callable[[str], dict[str, torch.Tensor]]):
    """It turns coefficients of a basis whose polar axis is y; the colours agree in every direction."""
    units = golden("units")
    polar_y = torch.tensor(((0.0, 0, 1), (1, 0, 0), (0, 1, 0)), dtype=torch.float64)
    for before, after, rotation in zip(
        units["sh.in"].double(), units["sh.out"].double(), units["sh.rotations"].double(), strict=True
    ):
        flip = torch.diag(torch.tensor((-1.0, 1, -1), dtype=torch.float64))
        turn = polar_y @ flip @ rotation @ flip @ polar_y.T
        assert torch.allclose(rotate_harmonics(before.T, turn).T, after, atol=5e-5)  # its own float32 error is 1e-5
