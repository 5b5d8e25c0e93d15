"""Smooth gains: factors of the photographs, after which they show a surface in the same colour.

The exposure of a tone-mapped photograph differs from place to place. Where the surfaces of views agree, the ratio of
the mean colour of a point in all photographs that show it to that in one photograph, smoothed over the sphere, is the
gain of that photograph: for two photographs the square root of the ratio of their colours.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import pixel_directions, row_weights, sample_equirect, uv_from_directions
from pansplat.rendering.rasterize import rasterize

_HEIGHT = 64  # rows of the images whose colours are compared
_ROWS = 32  # rows of the grid of gains; each is 5.6 degrees high
# Standard deviations of the kernel, radians, and weights: the wider parts count where little agrees near a place.
_KERNEL = ((math.radians(8), 1.0), (math.radians(32), 1e-2), (math.pi, 1e-4))
_TOLERANCE = 0.05  # largest difference of log-distance of surfaces that agree
_MIN_COLOR, _MAX_COLOR = 0.02, 0.98  # limits of colours that are compared; a camera clips those beyond
_OUTLIER = 0.1  # difference of log-colours from the smooth gain that halves the weight of a place
_ROUNDS = 4  # rounds of reweighted least squares


@torch.no_grad()
def estimate_gains(
    images: Float[Tensor, "view 3 height width"],
    depths: Float[Tensor, "view h w"],
    cam2world: Float[Tensor, "view 4 4"],
    masks: Bool[Tensor, "view height width"],
) -> Float[Tensor, "view 3 rows columns"]:
    """Logarithms of the gains of each photograph, on a coarse panorama.

    Args:
        images: the photographs, RGB in [0, 1].
        depths: radial distances of the surfaces of each view, metres; 0 where there is none.
        masks: pixels that are compared.
    """
    size = (depths.shape[-2], depths.shape[-1])
    colors = functional.interpolate(images.float(), size, mode="area")
    known = functional.interpolate(masks[:, None].float(), size, mode="area")[:, 0] > 0.999
    known &= (depths > 0) & (colors.amin(1) > _MIN_COLOR) & (colors.amax(1) < _MAX_COLOR)
    logs, poses = torch.where(known[:, None], colors, 1).log(), cam2world.to(images.device)
    rays = pixel_directions(*size, dtype=torch.float64, device=images.device)
    grid = pixel_directions(_ROWS, 2 * _ROWS, dtype=torch.float64, device=images.device).flatten(0, 1)
    angles = (grid @ rays.flatten(0, 1).T).clamp(-1, 1).acos()
    kernel = sum(weight * (-0.5 * (angles / deviation).square()).exp() for deviation, weight in _KERNEL)
    kernel = (kernel * row_weights(size[0]).to(angles).repeat_interleave(size[1])).float()
    gains = torch.zeros(len(images), 3, _ROWS, 2 * _ROWS, device=images.device)
    for view, pose in enumerate(poses):
        points = (rays * depths[view, ..., None]) @ pose[:3, :3].T + pose[:3, 3]
        total, count = torch.zeros_like(logs[view]), torch.ones_like(depths[view])
        for other in range(len(images)):
            offsets = (points - poses[other, :3, 3]) @ poses[other, :3, :3]
            maps = torch.cat((logs[other], depths[other, None], known[other, None].float()))
            sampled = sample_equirect(maps.float(), uv_from_directions(offsets))
            is_near = (offsets.norm(dim=-1) / sampled[3]).log().abs() < _TOLERANCE
            agrees = (known[view] & is_near & (sampled[4] > 0.999) & (other != view)).float()
            total, count = total + agrees * (sampled[:3] - logs[view]), count + agrees
        target = (total / count).flatten(1)
        weights = start = (count > 1).float().flatten()
        for _ in range(_ROUNDS):
            smooth = (target * weights) @ kernel.T / (kernel @ weights).clamp_min(1e-12)
            gains[view] = smooth.unflatten(1, (_ROWS, -1))
            outliers = (target - sample_equirect(gains[view], uv_from_directions(rays)).flatten(1)).norm(dim=0)
            weights = start / (1 + (outliers / _OUTLIER).square())
    return gains


@torch.no_grad()
def measure_gains(
    gaussians: Gaussians,
    images: Float[Tensor, "view 3 height width"],
    cam2world: Float[Tensor, "view 4 4"],
    masks: Bool[Tensor, "view height width"],
    *,
    joint: bool,
) -> Float[Tensor, "view 3 rows columns"]:
    """`estimate_gains` with the surfaces of Gaussians, which are drawn together (joint) or view by view."""
    shown = [gaussians if joint else gaussians.select(gaussians.views == view) for view in range(len(cam2world))]
    drawn = [rasterize(*each, size=(_HEIGHT, 2 * _HEIGHT)) for each in zip(shown, cam2world, strict=True)]
    depths = torch.stack([torch.where(each.alpha > 0.5, each.depth, 0) for each in drawn])
    return estimate_gains(images, depths, cam2world, masks)


def equalize_images(
    images: Float[Tensor, "view 3 height width"], gains: Float[Tensor, "view 3 rows columns"]
) -> Float[Tensor, "view 3 height width"]:
    """The photographs times their gains, given by logarithms."""
    uv = uv_from_directions(pixel_directions(*images.shape[-2:], device=images.device))
    return torch.stack([image * sample_equirect(each, uv).exp() for image, each in zip(images, gains, strict=True)])


def equalize_gaussians(
    gaussians: Gaussians, gains: Float[Tensor, "view 3 rows columns"], cam2world: Float[Tensor, "view 4 4"]
) -> Gaussians:
    """The Gaussians with colours times the gains, given by logarithms, that their view has in their directions."""
    harmonics = gaussians.harmonics.clone()
    for view, pose in enumerate(cam2world.to(gaussians.means)):
        own = gaussians.views == view
        uv = uv_from_directions((gaussians.means[own] - pose[:3, 3]) @ pose[:3, :3])
        factors = sample_equirect(gains[view], uv).exp().T
        harmonics[own] *= factors[:, None]
        harmonics[own, 0] += 0.5 / SH_0 * (factors - 1)
    return dataclasses.replace(gaussians, harmonics=harmonics)
