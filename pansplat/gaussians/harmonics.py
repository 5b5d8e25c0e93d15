"""Real spherical harmonics in the order and with the signs of 3DGS files: evaluation and rotation.

Convention: index k = l^2 + l + m, m = -l..l; the sign is (-1)^m relative to the orthonormal real harmonics
without the Condon-Shortley phase, so k = 1, 2, 3 are -y, z, -x.

Source: PanSplat, section 3.3: degree 4, predicted in camera axes and rotated to the world's. Degree 4 continues the
sign rule, as common 3DGS implementations do. The official code rotates about the wrong axes (docs/official.md, trap
T3) and evaluates a wrong basis function (section 10.3, trap T4).
"""

import functools
import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 4  # 25 harmonics a channel, as the official model (docs/official.md)
SH_0 = 0.28209479177387814  # value of the harmonic of degree 0, which is constant
_OFFICIAL_DEGREE = 3  # the degree that the official rasteriser evaluates
# The official x, y, z axes of the harmonics in world axes: z, x, y.
_OFFICIAL_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def _norm(rational: float) -> float:
    return math.sqrt(rational / math.pi)


def harmonics_basis(directions: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch k"]:
    """Harmonics of degree 0..`degree` at unit directions, k = (degree + 1)^2 values each."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"`degree` must be 0..{MAX_DEGREE}, got {degree}")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, 0.5 * _norm(1))]
    if degree >= 1:
        c = 0.5 * _norm(3)
        values += [-c * y, c * z, -c * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        c = 0.5 * _norm(15)
        values += [c * x * y, -c * y * z, 0.25 * _norm(5) * (2 * zz - xx - yy), -c * x * z, 0.5 * c * (xx - yy)]
    if degree >= 3:
        values += _cubic(x, y, z)
    if degree >= 4:
        values += _quartic(x, y, z)
    return torch.stack(values, dim=-1)


def _cubic(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """The seven harmonics of degree 3."""
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3 = 0.25 * _norm(10.5), 0.5 * _norm(105), 0.25 * _norm(17.5)
    return [
        -c3 * y * (3 * xx - yy),
        c2 * x * y * z,
        -c1 * y * (4 * zz - xx - yy),
        0.25 * _norm(7) * z * (2 * zz - 3 * xx - 3 * yy),
        -c1 * x * (4 * zz - xx - yy),
        0.5 * c2 * z * (xx - yy),
        -c3 * x * (xx - 3 * yy),
    ]


def _quartic(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """The nine harmonics of degree 4, on the unit sphere."""
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3, c4 = 0.75 * _norm(2.5), 0.75 * _norm(5), 0.75 * _norm(17.5), 0.75 * _norm(35)
    return [
        c4 * x * y * (xx - yy),
        -c3 * y * z * (3 * xx - yy),
        c2 * x * y * (7 * zz - 1),
        -c1 * y * z * (7 * zz - 3),
        0.1875 * _norm(1) * (zz * (35 * zz - 30) + 3),
        -c1 * x * z * (7 * zz - 3),
        0.5 * c2 * (xx - yy) * (7 * zz - 1),
        -c3 * x * z * (xx - 3 * yy),
        0.25 * c4 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
    ]


def evaluate_harmonics(
    harmonics: Float[Tensor, "*batch k channel"], directions: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch channel"]:
    """Colour seen along unit directions (camera to mean, world axes): max(0, 0.5 + sum_k Y_k c_k)."""
    degree = math.isqrt(harmonics.shape[-2]) - 1
    if (degree + 1) ** 2 != harmonics.shape[-2] or not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"`harmonics` must hold 1, 4, 9, 16 or 25 coefficients, got {harmonics.shape[-2]}")
    # relu, not clamp: its gradient at exactly 0 is 0.
    return torch.relu((harmonics_basis(directions, degree)[..., None, :] @ harmonics)[..., 0, :] + 0.5)


def rotation_matrices(rotations: Float[Tensor, "*batch 3 3"], degree: int) -> Float[Tensor, "*batch k k"]:
    """Matrices D(R) that rotate coefficients: sum_k (D c)_k Y_k(R d) = sum_k c_k Y_k(d) in every direction d.

    D is the integral of Y_j(R d) Y_k(d) over the sphere, computed by an exact quadrature. It is orthogonal and
    block-diagonal by degree, and D(A B) = D(A) D(B).

    Raises:
        ValueError: when the degree is not 0..4.
    """
    directions, weights = _quadrature(degree)
    directions, weights = directions.to(rotations), weights.to(rotations)
    rotated = harmonics_basis(torch.einsum("...ij,qj->...qi", rotations, directions), degree)
    matrices = rotated.transpose(-1, -2) @ (harmonics_basis(directions, degree) * weights[:, None])
    block = torch.tensor([math.isqrt(k) for k in range((degree + 1) ** 2)], device=matrices.device)
    return torch.where(block[:, None] == block, matrices, 0)


def rotate_harmonics(
    harmonics: Float[Tensor, "*batch k channel"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch k channel"]:
    """Coefficients of the same colours after a rotation of the world."""
    degree = math.isqrt(harmonics.shape[-2]) - 1
    matrix = rotation_matrices(rotation.double(), degree).to(harmonics)
    return (harmonics.transpose(-1, -2) @ matrix.T).transpose(-1, -2)


@functools.lru_cache
@torch.inference_mode(False)  # the cached tensors are used with gradients too
def _quadrature(degree: int) -> tuple[Tensor, Tensor]:
    """Directions (q 3) and weights (q), float64, of an exact quadrature for products of two harmonics of a degree."""
    z, weight = np.polynomial.legendre.leggauss(degree + 1)
    count = 2 * degree + 1
    longitude = np.arange(count) * (2 * np.pi / count)
    radius = np.sqrt(1 - z * z)[:, None]
    x, y = radius * np.cos(longitude), radius * np.sin(longitude)
    directions = np.stack((x, y, np.broadcast_to(z[:, None], x.shape)), axis=-1).reshape(-1, 3)
    weights = np.repeat(weight * 2 * np.pi / count, count)
    return torch.from_numpy(directions), torch.from_numpy(weights)


def official_harmonics(harmonics: Float[Tensor, "*batch k channel"]) -> Float[Tensor, "*batch k_official channel"]:
    """Coefficients, of degree 3 at most, with the colours that the official rasteriser gives `harmonics`.

    In the official axes, coefficient 14 multiplies x (x^2 - y^2) in place of z (x^2 - y^2). On the unit sphere this is
    a sum of the harmonics 3, 13 and 15. The official rasteriser ignores degrees above 3.

    Source: docs/official.md, section 10.3 and trap T4.
    """
    kept = harmonics[..., : (_OFFICIAL_DEGREE + 1) ** 2, :]
    return kept if kept.shape[-2] < 16 else _official_matrix().to(kept) @ kept


@functools.lru_cache
@torch.inference_mode(False)  # the cached tensors are used with gradients too
def _official_matrix() -> Float[Tensor, "16 16"]:
    """Map from coefficients to those of `official_harmonics`, both in world axes; float64."""
    # With |d| = 1: x (x^2 - y^2) = 0.4 x - 0.1 x (4 z^2 - x^2 - y^2) + 0.5 x (x^2 - 3 y^2).
    norm = math.sqrt(105 / math.pi) / 4
    parts = {3: (0.4, math.sqrt(3 / math.pi) / 2), 13: (-0.1, math.sqrt(10.5 / math.pi) / 4),
             15: (0.5, math.sqrt(17.5 / math.pi) / 4)}  # fmt: skip
    matrix = torch.eye(16, dtype=torch.float64)
    matrix[14, 14] = 0
    for k, (factor, other_norm) in parts.items():
        matrix[k, 14] = -factor * norm / other_norm
    rotation = rotation_matrices(torch.tensor(_OFFICIAL_AXES, dtype=torch.float64), _OFFICIAL_DEGREE)
    return rotation.T @ matrix @ rotation
