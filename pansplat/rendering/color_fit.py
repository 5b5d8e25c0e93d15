"""Colours of the Gaussians from the photographs, by comparison of each view's image with its own photograph.

A Gaussian covers several pixels, so that colours sampled from a photograph give a blurred image. An image is linear in
the colours: C = W c. Simultaneous iterative reconstruction (SIRT) solves it: c += r W' (photograph - W c) / (W' 1),
where r is the relaxation, and W' 1 sums the weights of a Gaussian over the image.

Source: Gregor and Benson, "Computational analysis and improvement of SIRT", 2008.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.gaussians.harmonics import SH_0, harmonics_basis
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.weights import compute_blending_weights

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
    """The Gaussians with the colours that fit each view's image to its photograph.

    The harmonics of degree 0 change; those of higher degree stay, and count with the direction from the photograph.

    Args:
        images: photographs of all views, RGB in [0, 1].
        cam2world: poses of the photographs, OpenCV axes, metres.
        masks: pixels that are compared.
    """
    harmonics = gaussians.harmonics.clone()
    for view, (image, pose, mask) in enumerate(zip(images, cam2world, masks, strict=True)):
        chosen = gaussians.views == view
        if chosen.any():
            harmonics[chosen, 0] = _fit_view(gaussians.select(chosen), image, pose, mask, config)
    return dataclasses.replace(gaussians, harmonics=harmonics)


@torch.no_grad()
def _fit_view(gaussians: Gaussians, image: Tensor, pose: Tensor, mask: Tensor, config: ColorFitConfig) -> Tensor:
    """The harmonics of degree 0 (n, 3) of a view's Gaussians."""
    size = (mask.shape[0], mask.shape[1])
    further = _directional_colors(gaussians, pose) if gaussians.degree else 0.0
    colors = (0.5 + SH_0 * gaussians.harmonics[:, 0] + further).clamp_min(0)
    image, mask = image.to(colors), mask.to(colors)
    weights = compute_blending_weights(gaussians, pose, size)
    coverage = weights.accumulate(mask[None]).clamp_min(_MIN_COVERAGE)
    for _ in range(config.steps_at(size[0])):
        error = (image - weights.blend(colors)) * mask
        colors = (colors + config.relaxation * weights.accumulate(error) / coverage).clamp_min(0)
    return (colors - 0.5 - further) / SH_0


def _directional_colors(gaussians: Gaussians, pose: Tensor) -> Tensor:
    """The colours (n, 3) by the harmonics of higher degree, as the camera sees them."""
    directions = functional.normalize(gaussians.means - pose[:3, 3].to(gaussians.means), dim=1)
    basis = harmonics_basis(directions, gaussians.degree)[:, 1:]
    return (basis[:, None] @ gaussians.harmonics[:, 1:])[:, 0]
