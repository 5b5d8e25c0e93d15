"""Image metrics, and the cross-fade baseline.

Images are RGB; only PSNR clamps them to [0, 1]. Masks are True where a pixel counts.

Source: PanSplat, section 4; the official protocol (docs/official.md, section 13), by value.
"""

from __future__ import annotations

import math

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.geometry.equirect import pad_equirect, pixel_directions, rotate_equirect, row_weights
from pansplat.geometry.pose import blend_weights

_SSIM_SIGMA = 1.5  # pixels
_SSIM_RADIUS = 5  # pixels: an 11 x 11 window


def psnr(prediction: Float[Tensor, "3 height width"], target: Float[Tensor, "3 height width"]) -> float:
    """Peak signal-to-noise ratio in dB, both images clamped to [0, 1]; infinite when they are equal."""
    _check_shapes(prediction, target)
    return _to_decibels(float((prediction.double().clamp(0, 1) - target.double().clamp(0, 1)).square().mean()))


def ws_psnr(
    prediction: Float[Tensor, "3 height width"],
    target: Float[Tensor, "3 height width"],
    *,
    mask: Bool[Tensor, "height width"] | None = None,
) -> float:
    """PSNR in dB with pixels weighted by their solid angle; infinite when the images are equal.

    Source: Sun, Lu and Yu, weighted-to-spherically-uniform quality evaluation, doi:10.1109/LSP.2017.2720693.
    """
    _check_shapes(prediction, target, mask)
    error = (prediction.double() - target.double()).square().mean(0)
    weights = row_weights(error.shape[0]).to(error.device)[:, None].expand_as(error)
    weights = weights if mask is None else weights * mask
    total = float(weights.sum())
    return _to_decibels(float((error * weights).sum()) / total if total > 0 else math.nan)


def ssim(prediction: Float[Tensor, "3 height width"], target: Float[Tensor, "3 height width"]) -> float:
    """Mean structural similarity of the three channels: Gaussian window, sample covariance, border cropped.

    Source: Wang et al., doi:10.1109/TIP.2003.819861, with the settings of the official protocol: 11 x 11
    window of sigma 1.5, K = (0.01, 0.03), data range 1, only windows inside the image.
    """
    _check_shapes(prediction, target)
    if min(prediction.shape[-2:]) <= 2 * _SSIM_RADIUS:
        raise ValueError(f"`prediction` must be larger than 10 x 10 pixels, got {tuple(prediction.shape[-2:])}")
    a, b = (image.detach().cpu().double().numpy() for image in (prediction, target))
    mean_a, mean_b = _average_windows(a), _average_windows(b)
    samples = (2 * _SSIM_RADIUS + 1) ** 2
    unbiased = samples / (samples - 1)
    variance_a = unbiased * (_average_windows(a * a) - mean_a**2)
    variance_b = unbiased * (_average_windows(b * b) - mean_b**2)
    covariance = unbiased * (_average_windows(a * b) - mean_a * mean_b)
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    similarity /= (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    return float(similarity.mean())


def _average_windows(image: np.ndarray) -> np.ndarray:
    """Gaussian-weighted local means (3 H W) of all windows inside the image."""
    offsets = np.arange(-_SSIM_RADIUS, _SSIM_RADIUS + 1)
    kernel = np.exp(-0.5 * (offsets / _SSIM_SIGMA) ** 2)
    kernel /= kernel.sum()
    inside = slice(_SSIM_RADIUS, -_SSIM_RADIUS)
    columns = scipy.ndimage.correlate1d(image, kernel, axis=1)
    return scipy.ndimage.correlate1d(columns, kernel, axis=2)[:, inside, inside]


def _to_decibels(mean_square: float) -> float:
    return -10 * math.log10(mean_square) if mean_square > 0 else (math.inf if mean_square == 0 else math.nan)


def _check_shapes(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> None:
    if prediction.shape != target.shape or prediction.ndim != 3:
        shapes = f"{tuple(prediction.shape)} and {tuple(target.shape)}"
        raise ValueError(f"`prediction` and `target` must both be (3, height, width), got {shapes}")
    if mask is not None and mask.shape != target.shape[1:]:
        raise ValueError(f"`mask` must be {tuple(target.shape[1:])}, got {tuple(mask.shape)}")


def cross_fade(
    images: Float[Tensor, "view 3 height width"], cam2world: Float[Tensor, "view 4 4"], target: Float[Tensor, "4 4"]
) -> Float[Tensor, "3 height width"]:
    """The baseline without geometry: inputs rotated to the target's orientation, weighted by inverse distance."""
    poses, target = cam2world.double(), target.double()
    weights = blend_weights(target[:3, 3], poses[:, :3, 3]).to(images)
    faded = torch.zeros_like(images[0])
    for image, pose, weight in zip(images, poses, weights, strict=True):
        faded += weight * rotate_equirect(image, pose[:3, :3].T @ target[:3, :3])
    return faded


def distortion(
    inverse_depth: Float[Tensor, "height width"], offset: Float[Tensor, "3"], ahead: Float[Tensor, "3"]
) -> tuple[float, float]:
    """Shares of a moved camera's picture, ahead and aside, where a view's surface is torn (docs/evaluation.md).

    They are from 0 to 1, NaN if nothing counts.

    Args:
        inverse_depth: 1 / radial distance of the surface; NaN where there is none: pixels beside these do not count.
        offset, ahead: place of the moved camera, and direction of the flight, in the view's axes.
    """
    height, width = inverse_depth.shape
    rays, step, weights = pixel_directions(height, width, dtype=torch.float64), math.pi / height, row_weights(height)
    moved = functional.normalize(rays - inverse_depth.double()[..., None] * offset.double(), dim=-1).permute(2, 0, 1)
    padded = pad_equirect(moved, 1)
    east, south = padded[:, 1:-1, 2:] - moved, padded[:, 2:, 1:-1] - moved
    jacobian = torch.stack((east / weights[:, None], south)) / step
    radius = max(round(math.radians(1) / step), 1)
    padded = pad_equirect(jacobian, radius)
    padded[..., (*range(radius), *range(-radius, 0)), :] *= -1  # beyond a pole, east and south are opposite
    mean = functional.avg_pool2d(padded, 2 * radius + 1, stride=1)
    torn = (jacobian - mean).square().sum((0, 1)) > 0.3**2 * mean.square().sum((0, 1))
    area = (torch.linalg.cross(mean[0], mean[1], dim=0).norm(dim=0) * weights[:, None]).nan_to_num()
    x, _, z = functional.normalize(ahead.double() * torch.tensor((1.0, 0.0, 1.0)), dim=0).tolist()
    cosines = x * moved[0] + z * moved[2], (z * moved[0] - x * moved[2]).abs()
    seen = area * (torch.stack(cosines) > math.cos(math.radians(40)))
    around_ahead, around_sides = ((seen * torn).sum((1, 2)) / seen.sum((1, 2))).tolist()
    return around_ahead, around_sides
