"""What training makes small: the picture's error, its look, the depth's error, and the auxiliary heads' pictures.

Source: PanSplat, section 3.5; OFFICIAL.md, section 11, and P4 and P5 of section 17 for where paper and code differ.
Pictures are not clamped. Levels of depth are coarse to fine; the finest counts in full, each coarser one `decay` times
as much as the next finer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.geometry.equirect import row_weights
from pansplat.training.perceptual import Perceptual

DepthForm = Literal["depth", "inverse_depth"]


@dataclass(frozen=True)
class LossWeights:
    """How much each part of the loss counts."""

    square: float = 1.0
    """Of the mean squared error of the colours."""
    perceptual: float = 0.1
    """Of LPIPS, or what stands in for it (lambda in the paper)."""
    depth: float = 0.05
    """Of the depth loss, where there is true depth (alpha in the paper)."""
    depth_form: DepthForm = "depth"
    """depth: absolute error in metres against the true depth made as small as each level (the paper). inverse_depth:
    absolute error of 1 / metres with each level made as large as the true depth (the original code)."""
    decay: float = 0.9
    """How much a level of the cost volume counts against the next finer one (gamma in the paper)."""


PAPER = LossWeights()
CODE = LossWeights(perceptual=0.05, depth=0.1, depth_form="inverse_depth")
LOSS_WEIGHTS = {"paper": PAPER, "code": CODE}


@dataclass(frozen=True)
class ImageLoss:
    """The two parts of a picture's loss, each before its weight, and their weighted sum."""

    square: Float[Tensor, ""]
    perceptual: Float[Tensor, ""]
    total: Float[Tensor, ""]


def image_loss(
    prediction: Float[Tensor, "batch 3 height width"],
    target: Float[Tensor, "batch 3 height width"],
    perceptual: Perceptual | None,
    weights: LossWeights = PAPER,
    *,
    pixel_weights: Float[Tensor, "batch height width"] | None = None,
) -> ImageLoss:
    """Mean squared error and perceptual distance of pictures.

    Args:
        perceptual: LPIPS or its substitute; None for neither.
        pixel_weights: how much each pixel counts; by default all alike. See `pixel_weights_of`.
    """
    square = mean_square(prediction, target, pixel_weights)
    look = square.new_zeros(())
    if perceptual is not None and weights.perceptual:
        look = perceptual(prediction, target, pixel_weights).mean()
    return ImageLoss(square, look, weights.square * square + weights.perceptual * look)


def mean_square(
    prediction: Float[Tensor, "batch 3 height width"],
    target: Float[Tensor, "batch 3 height width"],
    pixel_weights: Float[Tensor, "batch height width"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared error over all values, or over the pixels that count."""
    errors = (prediction - target).square().mean(1)
    return errors.mean() if pixel_weights is None else weighted_mean(errors, pixel_weights)


def pixel_weights_of(
    masks: Bool[Tensor, "batch height width"] | None, shape: tuple[int, int, int], *, spherical: bool = False
) -> Float[Tensor, "batch height width"] | None:
    """How much each pixel counts; None where all count alike.

    Args:
        masks: True where a pixel counts.
        shape: batch, height, width.
        spherical: whether a pixel counts by its solid angle. Off in paper and code, which weigh all pixels alike.
    """
    if masks is None and not spherical:
        return None
    weights = torch.ones(shape) if masks is None else masks.float()
    return weights * row_weights(shape[1]).to(weights)[:, None] if spherical else weights


def depth_loss(
    depths: Sequence[Float[Tensor, "batch view _ _"]],
    true_depth: Float[Tensor, "batch view height width"],
    near: float | Float[Tensor, "batch view"],
    far: float | Float[Tensor, "batch view"],
    *,
    form: DepthForm = "depth",
    decay: float = 0.9,
    masks: Bool[Tensor, "batch view height width"] | None = None,
    spherical: bool = False,
) -> Float[Tensor, ""]:
    """Absolute error of the levels' depths: in metres ("depth") or 1 / metres ("inverse_depth").

    In the form "depth" the truth is made smaller by taking the pixel nearest to each centre, as mixtures of two
    surfaces are no depth; in the other the prediction is made larger, bilinearly and without wrapping.

    Args:
        depths: radial, metres, coarse to fine; each level smaller than the truth or as large.
        true_depth: radial, metres; what is not strictly between `near` and `far` is unknown.
        masks: True where a pixel counts.
        spherical: whether a pixel counts by its solid angle.
    """
    near, far = (bound[..., None, None] if isinstance(bound, Tensor) and bound.ndim else bound for bound in (near, far))
    known = (true_depth > near) & (true_depth < far)
    known = known if masks is None else known & masks
    total = true_depth.new_zeros(())
    for coarser, depth in enumerate(reversed(depths)):
        total = total + decay**coarser * _level_loss(depth, true_depth, known, form, spherical)
    return total


def _level_loss(depth: Tensor, truth: Tensor, known: Tensor, form: DepthForm, spherical: bool) -> Tensor:
    if form == "depth":
        truth, known = _nearest(truth, depth.shape[-2:]), _nearest(known.to(truth), depth.shape[-2:]) > 0.5
        errors = (depth - torch.where(known, truth, depth)).abs()
    else:
        size = truth.shape[-2:]
        depth = functional.interpolate(depth, size, mode="bilinear", align_corners=False)
        # Unknown pixels get the prediction's own depth: an infinity times zero would be no number.
        errors = (1 / depth - 1 / torch.where(known, truth, depth.detach())).abs()
    weights = known.to(errors)
    if spherical:
        weights = weights * row_weights(weights.shape[-2]).to(weights)[:, None]
    return weighted_mean(errors, weights)


def _nearest(maps: Tensor, size: Sequence[int]) -> Tensor:
    return functional.interpolate(maps, tuple(size), mode="nearest-exact")


def auxiliary_loss(
    pictures: Sequence[Float[Tensor, "batch 3 height width"]],
    target: Float[Tensor, "batch 3 height width"],
    perceptual: Perceptual | None,
    weights: LossWeights = PAPER,
    *,
    pixel_weights: Float[Tensor, "batch height width"] | None = None,
) -> Float[Tensor, ""]:
    """The image loss of what each level of the cost volume makes by itself; for real data, without true depth.

    Args:
        pictures: drawn from the auxiliary heads' Gaussians, coarse to fine.
    """
    total = target.new_zeros(())
    for coarser, picture in enumerate(reversed(pictures)):
        loss = image_loss(picture, target, perceptual, weights, pixel_weights=pixel_weights)
        total = total + weights.decay**coarser * loss.total
    return total


def weighted_mean(errors: Float[Tensor, "*shape"], weights: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Mean of what counts; 0, with zero gradients, where nothing does."""
    weights = weights.to(errors)
    return (errors * weights).sum() / weights.sum().clamp_min(torch.finfo(errors.dtype).tiny)
