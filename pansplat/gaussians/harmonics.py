"""Real spherical harmonics in the order and with the signs that 3DGS files use.

Convention: index k = l^2 + l + m, m = -l..l; the sign is (-1)^m relative to the orthonormal real harmonics
without the Condon-Shortley phase, so k = 1, 2, 3 are -y, z, -x.

Source: PanSplat, section 3.3 (degree 4 colours). Degree 4 continues the sign rule, as common 3DGS
implementations do.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 4


def _norm(rational: float) -> float:
    return math.sqrt(rational / math.pi)


def basis(directions: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch k"]:
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
        values += [
            c * x * y,
            -c * y * z,
            0.25 * _norm(5) * (2 * zz - xx - yy),
            -c * x * z,
            0.5 * c * (xx - yy),
        ]
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


def evaluate(
    harmonics: Float[Tensor, "*batch k channel"], directions: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch channel"]:
    """Colour seen along unit directions (camera to mean, world axes): max(0, 0.5 + sum_k Y_k c_k)."""
    degree = math.isqrt(harmonics.shape[-2]) - 1
    if (degree + 1) ** 2 != harmonics.shape[-2] or not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"`harmonics` must hold 1, 4, 9, 16 or 25 coefficients, got {harmonics.shape[-2]}")
    # relu, not clamp: its slope at exactly 0 is 0, so a colour that is off stays off.
    return torch.relu((basis(directions, degree)[..., None, :] @ harmonics)[..., 0, :] + 0.5)
