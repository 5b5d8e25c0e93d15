"""What tells how alike two pictures look: LPIPS where its weights are here, else a measure without weights.

The measure without weights, "structure", stands in for LPIPS so that training runs on a bare machine. It is no LPIPS:
it compares edges and local structure, it knows nothing of what makes pictures look alike to people, and its values
are on another scale (0 for equal pictures, around 0.3 for unrelated ones).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.evaluation.lpips import Backbone, find_backbone, load_lpips
from pansplat.geometry.equirect import pad_equirect

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
