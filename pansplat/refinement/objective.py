"""What a refinement minimises: the difference of renderings and photographs.

Images are compared by their absolute error and by that of their gradients (differences of neighbouring pixels), both
weighted by solid angle. Blocks of pixels are held out of the loss; their error shows whether the scene improves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.geometry.equirect import pixel_directions, row_weights, sample_equirect, uv_from_directions
from pansplat.rendering import Rendering

_BLOCK_ROWS = 32  # largest number of rows of blocks of a photograph; some blocks are held out


@dataclass(frozen=True, eq=False)
class PixelWeights:
    """Weights of an image's pixels and of its gradients to the right and downwards: solid angles over the sphere's.

    The sum of each is about the share that is not masked.
    """

    pixels: Float[Tensor, "height width"]
    right: Float[Tensor, "height width"]
    below: Float[Tensor, "height width"]

    @classmethod
    def from_mask(cls, mask: Bool[Tensor, "height width"]) -> PixelWeights:
        """Solid angles of the pixels in a mask, relative to the sphere. A gradient needs both of its pixels."""
        height, width = mask.shape
        area = row_weights(height).to(mask.device).float()[:, None] * mask
        area = area / (row_weights(height).sum() * width)
        below = functional.pad(torch.minimum(area[1:], area[:-1]), (0, 0, 0, 1))
        return cls(area, torch.minimum(area, area.roll(-1, 1)), below)


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph, and weights of its pixels.

    Attributes:
        unmasked: weights of all pixels that are compared.
        fitted: weights of the pixels that are not held out.
        held_out: weights of the pixels that are held out.
    """

    image: Float[Tensor, "3 height width"]
    unmasked: PixelWeights
    fitted: PixelWeights
    held_out: Float[Tensor, "height width"]

    @classmethod
    def split(
        cls,
        image: Float[Tensor, "3 height width"],
        mask: Bool[Tensor, "height width"],
        fraction: float,
        generator: torch.Generator,
    ) -> Photograph:
        """Hold out a fraction of the blocks, chosen at random."""
        height, width = mask.shape
        rows = min(_BLOCK_ROWS, height)
        blocks = (torch.rand(1, 1, rows, 2 * rows, generator=generator) < fraction).to(mask.device)
        held_out = functional.interpolate(blocks.float(), (height, width), mode="nearest")[0, 0] > 0
        whole = PixelWeights.from_mask(mask)
        return cls(image, whole, PixelWeights.from_mask(mask & ~held_out), whole.pixels * held_out)

    def shrink(self, height: int) -> Float[Tensor, "4 height width"]:
        """The image and, as the last channel, the share of unmasked pixels, by area average."""
        maps = torch.cat((self.image, (self.unmasked.pixels > 0)[None].to(self.image)))
        return functional.interpolate(maps[None], (height, 2 * height), mode="area")[0]


def image_difference(error: Float[Tensor, "3 height width"], weights: PixelWeights) -> Float[Tensor, ""]:
    """Mean absolute error of the colours, plus the mean of those of the gradients to the right and downwards."""
    # A sum of absolute values is the product of the error and of the sum's gradient; this takes half the time of
    # automatic differentiation.
    with torch.no_grad():
        slopes = error.sign().mul_(weights.pixels)
        for axis, factors in ((2, weights.right), (1, weights.below)):
            rises = error.roll(-1, axis).sub_(error).sign_().mul_(0.5 * factors)
            slopes.sub_(rises).add_(rises.roll(1, axis))
    return (error * slopes).sum() / len(error)


def compare_places(
    drawn: Rendering,
    pose: Float[Tensor, "4 4"],
    photographs: Sequence[tuple[Float[Tensor, "4 height width"], Float[Tensor, "4 4"]]],
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """How much the colours of a panorama differ from those that photographs show at its surfaces.

    Args:
        drawn: the panorama.
        pose: pose of the panorama's camera.
        photographs: results of `Photograph.shrink` at the panorama's size, each with its pose.

    Returns:
        The least mean absolute difference from a photograph, and the solid angle of each pixel, which is 0 without a
        surface, and where all photographs are masked.
    """
    height, width = drawn.depth.shape
    rays = pixel_directions(height, width, dtype=torch.float64, device=drawn.depth.device)
    points = (rays * drawn.depth[..., None]) @ pose[:3, :3].T.to(rays) + pose[:3, 3].to(rays)
    least = torch.full_like(drawn.depth, math.inf)
    for maps, camera in photographs:
        uv = uv_from_directions((points - camera[:3, 3].to(rays)) @ camera[:3, :3].to(rays))
        *color, unmasked = sample_equirect(maps, uv)
        difference = (drawn.color - torch.stack(color)).abs().mean(0)
        least = torch.minimum(least, torch.where(unmasked > 0.999, difference, math.inf))
    is_compared = (drawn.alpha > 0.5) & least.isfinite()
    return torch.where(is_compared, least, 0), row_weights(height).to(least)[:, None] * is_compared
