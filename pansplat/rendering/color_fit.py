"""Colours of the Gaussians from the photographs, by comparison of each view's image with its own photograph.

A Gaussian covers several pixels, so that colours sampled from a photograph give a blurred image. An image is linear in
the colours: C = W c. Simultaneous iterative reconstruction (SIRT) solves it: c += r W' (photograph - W c) / (W' 1),
where r is the relaxation, and W' 1 sums the weights of a Gaussian over the image. Gaussians that are drawn together are
fitted to all photographs: both products are then sums over these.

Source: Gregor and Benson, "Computational analysis and improvement of SIRT", 2008.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.gaussians.harmonics import SH_0, harmonics_basis
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.weights import draw_colors

_STEPS = 4  # steps for photographs of up to 1024 rows; taller ones have more
_RELAXATION = 1.8  # factor of a step, which converges below 2
_MIN_COVERAGE = 1e-3  # least sum of a Gaussian's weights that a step is divided by, pixels
_MIN_COLOR = 1e-6  # the rasteriser clamps colours below 0, which would have no gradient


def count_steps(height: int) -> int:
    """Steps for photographs of a height: the number of Gaussians is limited, so that one covers more pixels of a large
    photograph, and the iteration converges later.
    """
    return _STEPS * max(1, height // 1024)


@torch.inference_mode(False)  # a step is a gradient
def fit_colors(
    gaussians: Gaussians,
    images: Float[Tensor, "view 3 height width"],
    cam2world: Float[Tensor, "view 4 4"],
    masks: Bool[Tensor, "view height width"],
    *,
    joint: bool = False,
) -> Gaussians:
    """The Gaussians with the colours that fit each view's image to its photograph.

    The harmonics of degree 0 change; those of higher degree stay, and count with the direction from the photograph.

    Args:
        images: photographs of all views, RGB in [0, 1].
        cam2world: poses of the photographs, OpenCV axes, metres.
        masks: pixels that are compared.
        joint: whether the Gaussians of all views are drawn together, and fitted to all photographs.
    """
    photographs = list(zip(images, cam2world, masks, strict=True))
    if joint:
        groups = [(torch.ones_like(gaussians.views, dtype=torch.bool), photographs)]
    else:
        groups = [(gaussians.views == view, [photograph]) for view, photograph in enumerate(photographs)]
    harmonics = gaussians.harmonics.clone()
    for chosen, compared in groups:
        if chosen.any():
            harmonics[chosen, 0] = _fit(gaussians.select(chosen), compared)
    return dataclasses.replace(gaussians, harmonics=harmonics)


@torch.no_grad()
def _fit(gaussians: Gaussians, photographs: Sequence[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
    """The harmonics of degree 0 (n, 3) of Gaussians that are drawn together.

    Args:
        photographs: each with its pose and its mask.
    """
    change = torch.zeros_like(gaussians.harmonics[:, 0])
    coverage = torch.zeros_like(change)
    for step in range(count_steps(photographs[0][0].shape[-2])):
        total = torch.zeros_like(change)
        for image, pose, mask in photographs:
            compared = mask.to(change)
            colors = (_evaluate_colors(gaussians, pose) + change).clamp_min(_MIN_COLOR).requires_grad_()
            with torch.enable_grad():
                drawn = draw_colors(gaussians, pose, colors, (image.shape[-2], image.shape[-1]))
                covered = (drawn * compared).sum()
                error = ((drawn - image.to(change)).square() * compared).sum()
            if not step:
                coverage += torch.autograd.grad(covered, colors, retain_graph=True)[0]
            total -= 0.5 * torch.autograd.grad(error, colors)[0]
        change += _RELAXATION * total / coverage.clamp_min(_MIN_COVERAGE)
    return gaussians.harmonics[:, 0] + change / SH_0


def _evaluate_colors(gaussians: Gaussians, pose: Tensor) -> Tensor:
    """The colours (n, 3) as the camera sees them, which may be below 0."""
    if not gaussians.degree:
        return 0.5 + SH_0 * gaussians.harmonics[:, 0]
    directions = functional.normalize(gaussians.means - pose[:3, 3].to(gaussians.means), dim=1)
    basis = harmonics_basis(directions, gaussians.degree)
    return 0.5 + (basis[:, None] @ gaussians.harmonics)[:, 0]
