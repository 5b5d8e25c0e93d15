"""Colours of the Gaussians from the photographs, by comparison of each view's image with its own photograph.

A Gaussian covers several pixels, so that colours sampled from a photograph give a blurred image. An image is linear in
the colours: C = A c. Simultaneous iterative reconstruction (SIRT) solves it: c += r (photograph - A c) A / (1 A), where
r is the relaxation, and 1 A sums the weights of a Gaussian over the image.

Source: Gregor and Benson, "Computational analysis and improvement of SIRT", 2008.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.rasterize import rasterize

_MIN_COVERAGE = 1e-3  # pixels


@dataclass(frozen=True)
class ColorFitConfig:
    """Settings of the fit of colours."""

    steps: int = 4
    """For photographs of up to 1024 rows."""
    relaxation: float = 1.8
    """Converges below 2."""

    def steps_at(self, height: int) -> int:
        """Steps for photographs of a height: the number of Gaussians is limited, so that one covers more pixels of a
        large photograph, and the iteration converges later.
        """
        return self.steps * max(1, height // 1024)


def fit_colors(
    gaussians: Gaussians,
    images: Float[Tensor, "view 3 height width"],
    cam2world: Float[Tensor, "view 4 4"],
    masks: Bool[Tensor, "view height width"],
    config: ColorFitConfig,
) -> Gaussians:
    """The Gaussians with the colours that fit each view's image to its photograph; harmonics of degree 0.

    Args:
        images: photographs of all views, RGB in [0, 1].
        cam2world: poses of the photographs, OpenCV axes, metres.
        masks: pixels that are compared.
    """
    with torch.inference_mode(False), torch.enable_grad():  # the copies are not inference tensors
        harmonics = gaussians.harmonics.clone()
        for view, (image, pose, mask) in enumerate(zip(images, cam2world, masks, strict=True)):
            chosen = gaussians.views == view
            if chosen.any():
                harmonics[chosen] = _fit_view(
                    gaussians.select(chosen), image.float().clone(), pose.clone(), mask.clone(), config
                )
    return dataclasses.replace(gaussians, harmonics=harmonics)


def _fit_view(gaussians: Gaussians, image: Tensor, pose: Tensor, mask: Tensor, config: ColorFitConfig) -> Tensor:
    """The harmonics (n, 1, 3) of a view's Gaussians."""
    harmonics, size = gaussians.harmonics, (mask.shape[0], mask.shape[1])
    coverage: Tensor | None = None
    for _ in range(config.steps_at(size[0])):
        variable = harmonics.clone().requires_grad_()
        drawn = rasterize(dataclasses.replace(gaussians, harmonics=variable), pose, size=size).color
        if coverage is None:
            (total,) = torch.autograd.grad((drawn * mask).sum(), variable, retain_graph=True)
            coverage = (total / SH_0).clamp_min(_MIN_COVERAGE)
        # Of a sum: torch.autograd.grad imports sympy for the gradient of an image.
        (product,) = torch.autograd.grad((drawn * ((image - drawn.detach()) * mask)).sum(), variable)
        harmonics = harmonics + config.relaxation / SH_0**2 * product / coverage
    return harmonics
