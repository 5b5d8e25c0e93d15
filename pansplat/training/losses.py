"""What training makes small: the picture's error, its look, the depth's error, and the auxiliary heads' pictures.

Source: PanSplat, section 3.5; OFFICIAL.md, section 11, and P4 and P5 of section 17 for where paper and code differ.
Pictures are not clamped. Levels of depth are coarse to fine; the finest counts in full, each coarser one `decay` times
as much as the next finer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.evaluation.lpips import Backbone, find_backbone, load_lpips
from pansplat.geometry.equirect import pad_equirect, row_weights

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


PerceptualName = Literal["auto", "lpips-vgg", "lpips-alex", "lpips-squeeze", "structure"]

_SCALES = 3
_SIGMA, _RADIUS = 1.5, 5  # pixels
_C1, _C2 = 0.01**2, 0.03**2  # for pictures in [0, 1]
_BACKBONES: dict[str, Backbone] = {"lpips-vgg": "vgg", "lpips-alex": "alex", "lpips-squeeze": "squeeze"}


@runtime_checkable
class Perceptual(Protocol):
    """Distances of pairs of pictures, 0 for equal ones; differentiable.

    Attributes:
        name: such as "lpips-vgg" or "structure".
    """

    name: str

    def __call__(
        self,
        prediction: Float[Tensor, "batch 3 height width"],
        target: Float[Tensor, "batch 3 height width"],
        weights: Float[Tensor, "batch height width"] | None = None,
    ) -> Float[Tensor, "batch"]:
        """One distance a pair; a pixel of weight 0 has no part in it."""
        ...


def choose_perceptual(
    name: PerceptualName = "auto", folder: Path | None = None, device: torch.device | None = None
) -> Perceptual:
    """The measure of that name; "auto" takes LPIPS with vgg, alex or squeeze, whose files are here, else "structure".

    Args:
        folder: of LPIPS's weights; see `load_lpips`.
        device: for its weights; by default the processor's memory.

    Raises:
        InputError: no such name, or LPIPS is asked for by name and its files are missing.
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
    """Mean over three scales, each half as large, of (1 - SSIM) / 2 and of the absolute differences of gradients.

    Windows and gradients know the sphere: they go on over the seam and, for windows, over the poles.

    Source: Wang et al., doi:10.1109/TIP.2003.819861 (SSIM); the sum of an SSIM and a gradient term is ours.
    """

    name = "structure"

    def __call__(
        self,
        prediction: Float[Tensor, "batch 3 height width"],
        target: Float[Tensor, "batch 3 height width"],
        weights: Float[Tensor, "batch height width"] | None = None,
    ) -> Float[Tensor, "batch"]:
        """One distance a pair of panoramas in [0, 1]; a pixel of weight 0 has no part in it."""
        counted = torch.ones_like(target[:, :1]) if weights is None else weights[:, None].to(target)
        prediction = torch.where(counted > 0, prediction, target)
        total, scales = target.new_zeros(len(target)), 0
        while scales < _SCALES:
            unlike = (1 - ssim_map(prediction, target)) / 2 + _gradient_difference(prediction, target)
            total = total + (unlike.mean(1, keepdim=True) * counted).sum(dim=(1, 2, 3)) / counted.sum(
                dim=(1, 2, 3)
            ).clamp_min(torch.finfo(target.dtype).tiny)
            scales += 1
            if target.shape[-2] % 2 or target.shape[-2] < 4 * _RADIUS:
                break  # nothing is left to halve
            prediction, target, counted = (functional.avg_pool2d(maps, 2) for maps in (prediction, target, counted))
        return total / scales


def ssim_map(
    prediction: Float[Tensor, "batch 3 height width"], target: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, "batch 3 height width"]:
    """Structural similarity about every pixel of a panorama: an 11 x 11 Gaussian window on the sphere.

    Source: Wang et al., doi:10.1109/TIP.2003.819861, equation 13.
    """
    mean_a, mean_b = _window_mean(prediction), _window_mean(target)
    variance_a = _window_mean(prediction.square()) - mean_a.square()
    variance_b = _window_mean(target.square()) - mean_b.square()
    covariance = _window_mean(prediction * target) - mean_a * mean_b
    alike = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    return alike / ((mean_a.square() + mean_b.square() + _C1) * (variance_a + variance_b + _C2))


def _window_mean(maps: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch 3 height width"]:
    offsets = torch.arange(-_RADIUS, _RADIUS + 1, dtype=torch.float64)
    kernel = torch.exp(-0.5 * (offsets / _SIGMA).square())
    kernel = (kernel / kernel.sum()).to(maps)
    padded = pad_equirect(maps.flatten(0, 1)[:, None], _RADIUS, "sphere")
    means = functional.conv2d(functional.conv2d(padded, kernel.reshape(1, 1, -1, 1)), kernel.reshape(1, 1, 1, -1))
    return means[:, 0].unflatten(0, maps.shape[:2])


def _gradient_difference(
    prediction: Float[Tensor, "batch 3 height width"], target: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, "batch 3 height width"]:
    """Absolute differences of the differences to the right and the lower neighbour, half of each."""
    apart = prediction - target
    right = apart.roll(-1, -1) - apart
    below = functional.pad(apart[..., 1:, :] - apart[..., :-1, :], (0, 0, 0, 1))
    return (right.abs() + below.abs()) / 2
