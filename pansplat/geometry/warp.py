"""Warping between posed panoramas.

A depth candidate is an inverse depth. The point at this depth on a pixel's ray has a position in the other camera's
panorama; the warp samples the panorama at this position.

There are two kinds of sampling. `sphere` is exact: pixel centres at half-integers, columns wrap, rows continue over the
poles. `corners` is the official sampling: rays pass through half-integer centres, but samples are placed as if the
corner pixels' centres lay on the border, with zeros outside. It shifts even the identity by up to half a pixel.

No gradient flows to poses and candidates.

Source: PanSplat, section 3.2; docs/official.md, section 6.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from pansplat.geometry.equirect import pad_equirect, pixel_directions
from pansplat.geometry.pose import invert_pose

Sampling = Literal["sphere", "corners"]


def relative_pose(
    reference: Float[Tensor, "*batch 4 4"], other: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 4 4"]:
    """From the reference camera's axes to the other's, of two cam2world poses; float64 against cancellation."""
    return invert_pose(other.double()) @ reference.double()


def warp_positions(
    inverse_depth: Float[Tensor, "pair candidate height width"], pose: Float[Tensor, "pair 4 4"], sampling: Sampling
) -> tuple[Float[Tensor, "pair candidate height width"], Float[Tensor, "pair candidate height width"]]:
    """Column and row in the other panorama of each pixel at each depth candidate; 0 is the first pixel's centre.

    Args:
        inverse_depth: 1 / metres, >= 0; 0 is a point at infinity (not with `corners`).
        pose: from the reference camera's axes to the other's, rigid, metres.

    A point at the other camera's centre has no direction; its position is finite.
    """
    height, width = inverse_depth.shape[-2:]
    rays = pixel_directions(height, width, dtype=inverse_depth.dtype, device=inverse_depth.device)
    pose = pose.to(inverse_depth)
    rotated = torch.einsum("nij,hwj->inhw", pose[:, :3, :3], rays)[:, :, None]
    translation = pose[:, :3, 3].T[:, :, None, None, None]
    if sampling == "corners":
        return _corner_positions(rotated / inverse_depth + translation)
    points = rotated + translation * inverse_depth
    return _sphere_positions(points, rays)


def _sphere_positions(points: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Positions by the angles between each pixel's ray and its point: exact for the identity pose."""
    height, width = rays.shape[:2]
    x, y, z = points
    ray_x, ray_y, ray_z = rays.unbind(-1)
    # Unlike torch.hypot, these round identically in scalar and vector code.
    flat, ray_flat = (x * x + z * z).sqrt(), (ray_x * ray_x + ray_z * ray_z).sqrt()
    east = torch.atan2(x * ray_z - z * ray_x, z * ray_z + x * ray_x)
    down = torch.atan2(y * ray_flat - flat * ray_y, flat * ray_flat + y * ray_y)
    columns = torch.arange(width, dtype=x.dtype, device=x.device) + east * (width / (2 * math.pi))
    rows = torch.arange(height, dtype=x.dtype, device=x.device)[:, None] + down * (height / math.pi)
    return columns.remainder(width), rows.clamp(-0.5, height - 0.5)


def _corner_positions(points: Tensor) -> tuple[Tensor, Tensor]:
    """The official positions. A sine that rounds above one is clamped; the official code has NaN there."""
    height, width = points.shape[-2:]
    x, y, z = points
    y = y / (x * x + y * y + z * z).sqrt().clamp(min=1e-3)
    u = torch.atan2(x, z) / (2 * math.pi) + 0.5
    v = torch.asin(y.clamp(-1, 1)) / math.pi + 0.5
    return u * (width - 1), v * (height - 1)


def sample_maps(
    maps: Float[Tensor, "pair channel height width"],
    columns: Float[Tensor, "pair candidate h w"],
    rows: Float[Tensor, "pair candidate h w"],
    sampling: Sampling,
) -> Float[Tensor, "pair channel candidate h w"]:
    """Bilinear samples of maps at positions from `warp_positions`."""
    if sampling == "sphere":
        maps, columns, rows = pad_equirect(maps, 1, "sphere"), columns + 1, rows + 1
    height, width = maps.shape[-2:]
    grid = torch.stack((2 * columns / (width - 1) - 1, 2 * rows / (height - 1) - 1), dim=-1)
    samples = functional.grid_sample(maps, grid.flatten(1, 2), padding_mode="zeros", align_corners=True)
    return samples.unflatten(2, columns.shape[1:3])


def warp_panorama(
    maps: Float[Tensor, "pair channel height width"],
    inverse_depth: Float[Tensor, "pair candidate height width"],
    pose: Float[Tensor, "pair 4 4"],
    sampling: Sampling = "sphere",
) -> Float[Tensor, "pair channel candidate height width"]:
    """The other panorama warped into the reference view, for each depth candidate of the reference pixels.

    Args:
        maps: the other panorama.
        inverse_depth: candidates of the reference pixels, 1 / metres.
        pose: from the reference camera's axes to the other's.
    """
    with torch.no_grad():
        columns, rows = warp_positions(inverse_depth, pose, sampling)
    return sample_maps(maps, columns, rows, sampling)
