"""An image as a linear function of the Gaussians' colours, C = W c, with the blending weights W.

Products with W are images, and products with its transpose are their gradients by the colours.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.rasterize import rasterize


def draw_colors(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], colors: Float[Tensor, "n 3"], size: tuple[int, int]
) -> Float[Tensor, "3 height width"]:
    """W c: the panorama of Gaussians with these colours, which are above 0, seen from every direction, over black."""
    drawn = dataclasses.replace(gaussians, harmonics=((colors - 0.5) / SH_0)[:, None])
    return rasterize(drawn, cam2world.clone(), size=size).color  # a tensor of torch.inference_mode has no gradient


def sum_weights(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], image: Float[Tensor, "height width"]
) -> Float[Tensor, "n"]:
    """W' x: for each Gaussian the sum over a panorama's pixels of its blending weight times the image.

    Args:
        gaussians: their harmonics are not used.
        cam2world: pose of the camera, OpenCV axes, metres.
        image: factor of each pixel.
    """
    with torch.enable_grad():
        colors = torch.full_like(gaussians.means, 0.5, requires_grad=True)
        drawn = draw_colors(gaussians, cam2world, colors, (image.shape[0], image.shape[1]))
        # The gradient of a sum, because torch.autograd.grad imports sympy for the gradient of an image.
        (gradient,) = torch.autograd.grad((drawn[0] * image).sum(), colors)
    return gradient[:, 0]
