"""Harmonics as the original's rasteriser shows them: one coefficient on the wrong axis, degree 4 not at all.

Source: OFFICIAL.md, section 10.3 and trap T4.
"""

import functools
import math

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.harmonics_rotation import rotation_matrices

_DEGREE = 3
# The original's x, y, z axes of harmonics in the world's: z, x, y.
_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def as_the_original_draws(harmonics: Float[Tensor, "*batch k channel"]) -> Float[Tensor, "*batch drawn channel"]:
    """Coefficients, of degree 3 at most, whose colours are those that the original's rasteriser makes of these.

    In the original's axes coefficient 14 multiplies x (x^2 - y^2) in place of z (x^2 - y^2). On the unit sphere
    that is a sum of the harmonics 3, 13 and 15, so the exact renderers can draw it. Degrees above 3 are left out.
    """
    drawn = harmonics[..., : (_DEGREE + 1) ** 2, :]
    if drawn.shape[-2] < 16:
        return drawn
    return _trap().to(drawn) @ drawn


@functools.lru_cache
@torch.inference_mode(False)  # kept for calls that need gradients too
def _trap() -> Float[Tensor, "16 16"]:
    """What the original's rasteriser does to coefficients in world axes; float64."""
    # With |d| = 1: x (x^2 - y^2) = 0.4 x - 0.1 x (4 z^2 - x^2 - y^2) + 0.5 x (x^2 - 3 y^2).
    norm = math.sqrt(105 / math.pi) / 4
    parts = {3: (0.4, math.sqrt(3 / math.pi) / 2), 13: (-0.1, math.sqrt(10.5 / math.pi) / 4),
             15: (0.5, math.sqrt(17.5 / math.pi) / 4)}  # fmt: skip
    own = torch.eye(16, dtype=torch.float64)
    own[14, 14] = 0
    for k, (share, other_norm) in parts.items():
        own[k, 14] = -share * norm / other_norm
    turn = rotation_matrices(torch.tensor(_AXES, dtype=torch.float64), _DEGREE)
    return turn.T @ own @ turn
