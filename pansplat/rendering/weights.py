"""An image as a linear function of the Gaussians' colours, C = W c, for several products with one W.

The CPU backend stores W (pansplat/rendering/cpu/weights.py). Elsewhere each product is an image or its gradient.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.rasterize import rasterize


@runtime_checkable
class BlendingWeights(Protocol):
    """The blending weights W of Gaussians in a panorama."""

    def blend(self, values: Float[Tensor, "n channel"]) -> Float[Tensor, "channel height width"]:
        """W c: the image of up to four values of each Gaussian, none below 0, over black."""
        ...

    def accumulate(self, image: Float[Tensor, "channel height width"]) -> Float[Tensor, "n channel"]:
        """W' x: for each Gaussian the sum over the pixels of weight times image, of up to four channels."""
        ...


def compute_blending_weights(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], size: tuple[int, int]
) -> BlendingWeights:
    """The weights of Gaussians in a panorama by the exact kernel, stored if the CPU backend can rasterise them.

    Args:
        gaussians: their harmonics are not used.
        cam2world: pose of the camera, OpenCV axes, metres.
        size: height and width of the panorama, pixels.
    """
    if gaussians.means.device.type == "cpu" and gaussians.means.dtype == torch.float32:
        from pansplat.rendering.cpu.weights import StoredWeights

        return StoredWeights(gaussians, cam2world, size)
    return _DifferentiatedWeights(gaussians, cam2world, size)


@dataclasses.dataclass(frozen=True, eq=False)
class _DifferentiatedWeights:
    """Weights that are computed for each product; W' x is a gradient of the image."""

    gaussians: Gaussians
    cam2world: Float[Tensor, "4 4"]
    size: tuple[int, int]

    def blend(self, values: Float[Tensor, "n channel"]) -> Float[Tensor, "channel height width"]:
        harmonics = ((values.detach() - 0.5) / SH_0)[:, None]
        gaussians = dataclasses.replace(self.gaussians, harmonics=harmonics)
        return rasterize(gaussians, self.cam2world, size=self.size).color

    def accumulate(self, image: Float[Tensor, "channel height width"]) -> Float[Tensor, "n channel"]:
        with torch.inference_mode(False), torch.enable_grad():
            harmonics = torch.zeros(  # half-grey is not clamped
                len(self.gaussians), 1, len(image), dtype=image.dtype, device=image.device, requires_grad=True
            )
            gaussians = dataclasses.replace(self.gaussians, harmonics=harmonics)
            drawn = rasterize(gaussians, self.cam2world.clone(), size=self.size).color
            # The gradient of a sum, because torch.autograd.grad imports sympy for the gradient of an image.
            (gradient,) = torch.autograd.grad((drawn * image).sum(), harmonics)
        return gradient[:, 0] / SH_0
