"""The correlation of a spherical sweep in the original's own order of operations, so that every bit is its own.

`pansplat.geometry.correlation` computes the same numbers but for their last bits, in a fraction of time and memory.

Source: OFFICIAL.md, section 6, steps 3 and 4.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

_CHUNK = 1 << 25
"""Numbers in the warped features that exist at a time."""


@torch.no_grad()
def original_grid(
    inverse_depth: Float[Tensor, "pair candidate height width"], pose: Float[Tensor, "pair 4 4"]
) -> Float[Tensor, "pair candidate height width 2"]:
    """Where the other panorama shows each pixel at each inverse depth, x and y in [-1, 1].

    Args:
        inverse_depth: 1 / metres, > 0.
        pose: from reference camera axes to the other's, rigid, metres.
    """
    count, candidates, height, width = inverse_depth.shape
    u = (torch.arange(width).to(inverse_depth) + 0.5) / width
    v = (torch.arange(height).to(inverse_depth) + 0.5) / height
    longitude = (2 * math.pi * u - math.pi).expand(height, width)
    latitude = (math.pi * v - math.pi / 2)[:, None].expand(height, width)
    level = latitude.cos()
    rays = torch.stack((level * longitude.sin(), latitude.sin(), level * longitude.cos())).flatten(1)
    turned = torch.matmul(pose[:, :3, :3], rays.expand(count, 3, -1))
    points = turned[:, :, None] * (1 / inverse_depth).reshape(count, 1, candidates, -1) + pose[:, :3, 3, None, None]
    x, y, z = (points / points.norm(dim=1, keepdim=True).clamp(min=1e-3)).unbind(1)
    longitude, latitude = torch.atan2(x, z), torch.asin(y.clamp(-1, 1))
    grid = torch.stack(
        (2 * ((longitude + math.pi) / (2 * math.pi)) - 1, 2 * ((latitude + math.pi / 2) / math.pi) - 1), dim=-1
    )
    return grid.reshape(count, candidates, height, width, 2)


def correlate_as_the_original(
    reference: Float[Tensor, "pair channel height width"],
    other: Float[Tensor, "pair channel height width"],
    inverse_depth: Float[Tensor, "pair candidate height width"],
    reference_pose: Float[Tensor, "pair 4 4"],
    other_pose: Float[Tensor, "pair 4 4"],
) -> Float[Tensor, "pair candidate height width"]:
    """What `sweep.correlate` gives with the sampling "corners", of cam2world poses (metres)."""
    channels, height = reference.shape[1:3]
    pose = (torch.inverse(other_pose) @ reference_pose).to(inverse_depth)
    correlations = []
    for some in inverse_depth.split(max(1, _CHUNK // reference.numel()), dim=1):
        grid = original_grid(some, pose).flatten(1, 2)
        warped = functional.grid_sample(other, grid, padding_mode="zeros", align_corners=True)
        warped = warped.unflatten(2, (-1, height))
        correlations.append((reference[:, :, None] * warped).sum(dim=1) / channels**0.5)
    return torch.cat(correlations, dim=1)
