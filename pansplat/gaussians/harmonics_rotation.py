"""Spherical harmonics seen from turned axes: how their coefficients change when the world turns.

Source: PanSplat, section 3.3 (colours are predicted in camera axes and turned to the world's). The original turns
them about the wrong axes (OFFICIAL.md trap T3); the matrices here are exact for any rotation and degree.
"""

import functools
import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.harmonics import basis


def rotation_matrices(rotations: Float[Tensor, "*batch 3 3"], degree: int) -> Float[Tensor, "*batch k k"]:
    """Matrices D(R) that turn coefficients: sum_k (D c)_k Y_k(R d) = sum_k c_k Y_k(d) in every direction d.

    The integral of Y_j(R d) Y_k(d) over the sphere, by a quadrature that is exact for these products. D is
    orthogonal, has a block a degree, and D(A B) = D(A) D(B).

    Raises:
        ValueError: when the degree is not 0..4.
    """
    directions, weights = _quadrature(degree)
    directions, weights = directions.to(rotations), weights.to(rotations)
    turned = basis(torch.einsum("...ij,qj->...qi", rotations, directions), degree)
    matrices = turned.transpose(-1, -2) @ (basis(directions, degree) * weights[:, None])
    block = torch.tensor([math.isqrt(k) for k in range((degree + 1) ** 2)], device=matrices.device)
    return torch.where(block[:, None] == block, matrices, 0)


def rotate_harmonics(
    harmonics: Float[Tensor, "*batch k channel"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch k channel"]:
    """Coefficients of the same colours after the world was turned by `rotation`."""
    degree = math.isqrt(harmonics.shape[-2]) - 1
    matrix = rotation_matrices(rotation.double(), degree).to(harmonics)
    return (harmonics.transpose(-1, -2) @ matrix.T).transpose(-1, -2)  # one product, however many Gaussians


@functools.lru_cache
@torch.inference_mode(False)  # kept for calls that need gradients too
def _quadrature(degree: int) -> tuple[Tensor, Tensor]:
    """Directions (q 3) and weights (q), float64, that integrate products of two harmonics of a degree exactly."""
    z, weight = np.polynomial.legendre.leggauss(degree + 1)
    count = 2 * degree + 1
    longitude = np.arange(count) * (2 * np.pi / count)
    radius = np.sqrt(1 - z * z)[:, None]
    x, y = radius * np.cos(longitude), radius * np.sin(longitude)
    directions = np.stack((x, y, np.broadcast_to(z[:, None], x.shape)), axis=-1).reshape(-1, 3)
    weights = np.repeat(weight * 2 * np.pi / count, count)
    return torch.from_numpy(directions), torch.from_numpy(weights)
