"""Where a level's Gaussians stand on the panorama."""

from __future__ import annotations

import functools
import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.geometry.equirect import uv_from_directions
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size, official_fibonacci_uv

Lattice = Literal["fibonacci", "pixel"]
_NARROWEST = 0.01  # at the poles a pixel is taken to be at most 100 times as wide in longitude


@functools.lru_cache(maxsize=16)
@torch.inference_mode(False)  # kept for calls that need gradients too
def lattice_uv(lattice: Lattice, height: int, *, exact: bool = True) -> Float[Tensor, "n 2"]:
    """Normalised panorama coordinates of the points of a level whose map is `height` x `2 height`, float64.

    A Fibonacci lattice covers the sphere evenly, from the bottom pole up; pixels come row by row and crowd at the
    poles. Not to be changed in place: calls share it.

    Args:
        exact: float64 throughout; otherwise the points of the original's float32 arithmetic.

    Source: PanSplat, section 3.3.
    """
    if lattice == "pixel":
        v, u = torch.meshgrid(
            (torch.arange(height, dtype=torch.float64) + 0.5) / height,
            (torch.arange(2 * height, dtype=torch.float64) + 0.5) / (2 * height),
            indexing="ij",
        )
        return torch.stack((u, v), dim=-1).reshape(-1, 2)
    count = lattice_size(2 * height)
    return uv_from_directions(fibonacci_directions(count)) if exact else official_fibonacci_uv(count)


def move_points(
    uv: Float[Tensor, "n 2"], raw_offsets: Float[Tensor, "n 2"], lattice: Lattice, height: int
) -> Float[Tensor, "n 2"]:
    """Points moved by what the network says, at most half a map pixel each way; they may cross the seam or a pole.

    On a Fibonacci lattice a pixel is as wide in longitude as it must be to span the same arc at every latitude.
    """
    width = torch.full_like(uv[:, 0], 2 * height)
    if lattice == "fibonacci":
        width = width * torch.sin(uv[:, 1] * math.pi).clamp_min(_NARROWEST)
    pixel = torch.stack((1 / width, torch.full_like(width, 1 / height)), dim=-1)
    return uv.to(raw_offsets) + (torch.sigmoid(raw_offsets) - 0.5) * pixel.to(raw_offsets)
