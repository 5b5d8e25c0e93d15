"""Losses of training: error and perceptual distance of images, error of depth, and the auxiliary heads' image loss.

Source: PanSplat, section 3.5; docs/official.md, section 11; docs/paper.md, P4 and P5 (differences of paper and code).
Images are not clamped. Levels of depth are coarse to fine; the finest has weight 1, each coarser one `decay` times the
weight of the next finer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float
from msgspec import Meta
from torch import Tensor
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.evaluation.lpips import Backbone, Lpips, find_backbone, load_lpips
from pansplat.geometry.equirect import pad_equirect
from pansplat.system.options import Weight

DepthForm = Literal["depth", "inverse_depth"]
Images = Float[Tensor, "batch 3 height width"]
PixelWeights = Float[Tensor, "batch height width"]


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms."""

    square: Weight = 1.0
    """Weight of the mean squared error of the colours."""
    perceptual: Weight = 0.1
    """Weight of LPIPS, or of its substitute (lambda in the paper)."""
    depth: Weight = 0.05
    """Weight of the depth loss, for data with true depth (alpha in the paper)."""
    depth_form: DepthForm = "depth"
    """depth: absolute error in metres, with the true depth resized to each level (the paper). inverse_depth: absolute
    error in 1 / metres, with each level resized to the true depth (the official code)."""
    decay: Annotated[float, Meta(ge=0, le=1)] = 0.9
    """Weight of a level of the cost volume relative to the next finer one (gamma in the paper)."""


PAPER = LossWeights()
CODE = LossWeights(perceptual=0.05, depth=0.1, depth_form="inverse_depth")


@dataclass(frozen=True)
class ImageLoss:
    """The two terms of the image loss before their weights, and their weighted sum."""

    square: Float[Tensor, ""]
    perceptual: Float[Tensor, ""]
    total: Float[Tensor, ""]


def image_loss(
    prediction: Images,
    target: Images,
    perceptual: Lpips | Structure | None,
    weights: LossWeights = PAPER,
    *,
    pixel_weights: PixelWeights | None = None,
) -> ImageLoss:
    """Mean squared error and perceptual distance of images.

    Args:
        perceptual: LPIPS or its substitute; None for no perceptual term.
        pixel_weights: weights of the pixels; None for equal weights.
    """
    square = mean_square(prediction, target, pixel_weights)
    distance = square.new_zeros(())
    if perceptual is not None and weights.perceptual:
        distance = perceptual(prediction, target, pixel_weights).mean()
    return ImageLoss(square, distance, weights.square * square + weights.perceptual * distance)


def mean_square(prediction: Images, target: Images, pixel_weights: PixelWeights | None = None) -> Float[Tensor, ""]:
    """Mean squared error over all values, weighted by `pixel_weights` if given."""
    errors = (prediction - target).square().mean(1)
    return errors.mean() if pixel_weights is None else weighted_mean(errors, pixel_weights)


def depth_loss(
    depths: Sequence[Float[Tensor, "batch view _ _"]],
    true_depth: Float[Tensor, "batch view height width"],
    near: float | Float[Tensor, "batch view"],
    far: float | Float[Tensor, "batch view"],
    *,
    form: DepthForm = "depth",
    decay: float = 0.9,
    masks: Bool[Tensor, "batch view height width"] | None = None,
) -> Float[Tensor, ""]:
    """Absolute error of the depth of each level: in metres ("depth") or 1 / metres ("inverse_depth").

    In the form "depth" the true depth is downsampled by nearest neighbour, because interpolated depth lies between
    surfaces. In the form "inverse_depth" the prediction is upsampled bilinearly, without wrap-around.

    Args:
        depths: radial, metres, coarse to fine; no level is larger than the true depth.
        true_depth: radial, metres; values that are not strictly between `near` and `far` are unknown.
        masks: True for pixels with a weight.
    """
    near, far = (bound[..., None, None] if isinstance(bound, Tensor) and bound.ndim else bound for bound in (near, far))
    known = (true_depth > near) & (true_depth < far)
    known = known if masks is None else known & masks
    total = true_depth.new_zeros(())
    for coarser, depth in enumerate(reversed(depths)):
        total = total + decay**coarser * _level_loss(depth, true_depth, known, form)
    return total


def _level_loss(depth: Tensor, truth: Tensor, known: Tensor, form: DepthForm) -> Tensor:
    if form == "depth":
        truth, known = _nearest(truth, depth.shape[-2:]), _nearest(known.to(truth), depth.shape[-2:]) > 0.5
        errors = (depth - torch.where(known, truth, depth)).abs()
    else:
        size = truth.shape[-2:]
        depth = functional.interpolate(depth, size, mode="bilinear", align_corners=False)
        # Unknown pixels get the predicted depth, because infinity times a weight of zero would be NaN.
        errors = (1 / depth - 1 / torch.where(known, truth, depth.detach())).abs()
    return weighted_mean(errors, known)


def _nearest(maps: Tensor, size: Sequence[int]) -> Tensor:
    return functional.interpolate(maps, tuple(size), mode="nearest-exact")


def auxiliary_loss(
    images: Sequence[Images],
    target: Images,
    perceptual: Lpips | Structure | None,
    weights: LossWeights = PAPER,
    *,
    pixel_weights: PixelWeights | None = None,
) -> Float[Tensor, ""]:
    """Image loss of renderings of each level of the cost volume alone; for real data without true depth.

    Args:
        images: rendered from the Gaussians of the auxiliary heads, coarse to fine.
    """
    total = target.new_zeros(())
    for coarser, image in enumerate(reversed(images)):
        loss = image_loss(image, target, perceptual, weights, pixel_weights=pixel_weights)
        total = total + weights.decay**coarser * loss.total
    return total


def weighted_mean(errors: Float[Tensor, "*shape"], weights: Tensor) -> Float[Tensor, ""]:
    """Weighted mean; 0 with zero gradients if all weights are 0. The weights have the shape of the errors."""
    weights = weights.to(errors)
    return (errors * weights).sum() / weights.sum().clamp_min(torch.finfo(errors.dtype).tiny)


PerceptualName = Literal["auto", "lpips-vgg", "lpips-alex", "lpips-squeeze", "structure"]

_SCALES = 3  # scales at which images are compared, each half the size of the one before
_SIGMA, _RADIUS = 1.5, 5  # pixels; standard deviation and radius of the window
_C1, _C2 = 0.01**2, 0.03**2  # squares of SSIM's K1 and K2, for images in [0, 1]
_BACKBONES: dict[str, Backbone] = {"lpips-vgg": "vgg", "lpips-alex": "alex", "lpips-squeeze": "squeeze"}


def choose_perceptual(
    name: PerceptualName = "auto", folder: Path | None = None, device: torch.device | None = None
) -> Lpips | Structure:
    """The distance of a name; "auto" selects LPIPS with vgg, alex or squeeze if its files are found, else "structure".

    Args:
        folder: folder of the LPIPS weights; see `load_lpips`.
        device: device of the LPIPS weights; the CPU by default.
    """
    if name in _BACKBONES:
        return load_lpips(_BACKBONES[name], folder).to(device)
    if name == "structure":
        return Structure()
    if name == "auto":
        backbone = find_backbone(folder)
        return load_lpips(backbone, folder).to(device) if backbone else Structure()
    raise InputError(f"`perceptual` must be auto, structure or one of {', '.join(_BACKBONES)}, got {name!r}")


class Structure:
    """A distance without weights: mean over three scales of (1 - SSIM) / 2 plus the absolute difference of gradients.

    It replaces LPIPS where the LPIPS files are missing. It compares edges and local structure, is not calibrated to
    human judgement, and has another scale: 0 for equal images, about 0.3 for unrelated ones. Windows and gradients wrap
    around at +-180 degrees, windows also over the poles.

    Source: Wang et al., doi:10.1109/TIP.2003.819861 (SSIM); the sum of an SSIM and a gradient term is ours.
    """

    name = "structure"

    def __call__(
        self, prediction: Images, target: Images, weights: PixelWeights | None = None
    ) -> Float[Tensor, "batch"]:
        """One distance per pair of panoramas in [0, 1]. Pixels of weight 0 have no effect."""
        pixel_weights = torch.ones_like(target[:, :1]) if weights is None else weights[:, None].to(target)
        prediction = torch.where(pixel_weights > 0, prediction, target)
        total, scales = target.new_zeros(len(target)), 0
        while scales < _SCALES:
            distance = (1 - ssim_map(prediction, target)) / 2 + _gradient_difference(prediction, target)
            total = total + (distance.mean(1, keepdim=True) * pixel_weights).sum(dim=(1, 2, 3)) / pixel_weights.sum(
                dim=(1, 2, 3)
            ).clamp_min(torch.finfo(target.dtype).tiny)
            scales += 1
            if target.shape[-2] % 2 or target.shape[-2] < 4 * _RADIUS:
                break  # cannot be halved again
            prediction, target, pixel_weights = (
                functional.avg_pool2d(maps, 2) for maps in (prediction, target, pixel_weights)
            )
        return total / scales


def ssim_map(prediction: Images, target: Images) -> Images:
    """Structural similarity at every pixel of a panorama, with an 11 x 11 Gaussian window on the sphere.

    Source: Wang et al., doi:10.1109/TIP.2003.819861, equation 13.
    """
    mean_a, mean_b = _window_mean(prediction), _window_mean(target)
    variance_a = _window_mean(prediction.square()) - mean_a.square()
    variance_b = _window_mean(target.square()) - mean_b.square()
    covariance = _window_mean(prediction * target) - mean_a * mean_b
    numerator = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    return numerator / ((mean_a.square() + mean_b.square() + _C1) * (variance_a + variance_b + _C2))


def _window_mean(maps: Images) -> Images:
    offsets = torch.arange(-_RADIUS, _RADIUS + 1, dtype=torch.float64)
    kernel = torch.exp(-0.5 * (offsets / _SIGMA).square())
    kernel = (kernel / kernel.sum()).to(maps)
    padded = pad_equirect(maps.flatten(0, 1)[:, None], _RADIUS, "sphere")
    means = functional.conv2d(functional.conv2d(padded, kernel.reshape(1, 1, -1, 1)), kernel.reshape(1, 1, 1, -1))
    return means[:, 0].unflatten(0, maps.shape[:2])


def _gradient_difference(prediction: Images, target: Images) -> Images:
    """Mean absolute difference of the gradients along x and y (differences to the right and lower neighbour)."""
    difference = prediction - target
    right = difference.roll(-1, -1) - difference
    below = functional.pad(difference[..., 1:, :] - difference[..., :-1, :], (0, 0, 0, 1))
    return (right.abs() + below.abs()) / 2
