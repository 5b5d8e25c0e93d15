"""Depth of several posed panoramas: each view's monocular depth, refined by comparison with the other views.

Each pixel has depth candidates around its present depth. At each candidate three quantities are measured in the other
view: the correlation of learned features, the correlation of normalised image patches, and whether the candidate lies
on, before or behind the other view's present surface. A U-Net maps these volumes and the monocular features to a
correction of the depth, with its uncertainty. Candidates are ratios of depth; the unit of the poses has no influence.

Source: PanSplat, section 3.2 (a cost volume of few candidates around a coarser depth), with the candidates of each
pixel centred on the monocular depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, normalize, relu, unfold

from pansplat.geometry.correlation import correlate
from pansplat.geometry.equirect import pad_equirect, pixel_directions
from pansplat.geometry.warp import relative_pose, sample_maps, warp_positions
from pansplat.networks.depth_network import (
    MAX_LOG_SCALE,
    DepthEstimate,
    DepthNetwork,
    DepthNetworkConfig,
    UpsampleAndMerge,
)
from pansplat.networks.efficientnet import CHANNELS
from pansplat.networks.layers import ConvNorm, Factor, PanoramaConv2d, Size, to_channels_last

_PATCH, _PATCH_STEP = 3, 2  # width of a patch, and pixels between its samples
_PATCH_NOISE = 0.02  # standard deviation of a patch below which its correlation fades
_AGREEMENT_SCALE = 0.1  # ratio of log-distances at which a candidate is clearly before or behind a surface


@dataclass(frozen=True)
class RefinementConfig:
    """Settings of the refinement."""

    mono: DepthNetworkConfig = field(default_factory=DepthNetworkConfig)
    candidates: Size = 27
    reach: Factor = 1.2
    """Logarithm of the ratio of the outermost candidates to the present depth."""
    concentration: Factor = 0.7
    """Fraction of the reach that grows with the square of the candidate's index."""
    matching_channels: Size = 16
    channels: tuple[Size, Size, Size] = (40, 64, 96)
    """Channels of the U-Net at 1/2, 1/4 and 1/8."""


class Observations(NamedTuple):
    """What the networks see of a set of views, once for all iterations.

    Attributes:
        features: decoded monocular features at 1/2.
        encoded: the encoder's features.
        matching: features that are compared between views, at 1/2.
        patches: normalised patches of the images at 1/2.
    """

    features: Float[Tensor, "view c h w"]
    encoded: list[Tensor]
    matching: Float[Tensor, "view d h w"]
    patches: Float[Tensor, "view e h w"]


class DepthRefinement(nn.Module):
    """Monocular depth, and its refinement by the other views."""

    def __init__(self, config: RefinementConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or RefinementConfig()
        self.mono = DepthNetwork(config.mono)
        decoded, fine, middle, coarse = config.mono.decoder_channels[-1], *config.channels
        self.matching = nn.Sequential(
            PanoramaConv2d(decoded + CHANNELS[0] + CHANNELS[1], 48, 1, border="sphere"),
            nn.ReLU(),
            PanoramaConv2d(48, config.matching_channels, 3, border="sphere"),
        )
        count = config.candidates
        # On the meta device, arithmetic of torch tensors imports the compiler for a second.
        u = np.linspace(-1, 1, count)
        steps = config.reach * ((1 - config.concentration) * u + config.concentration * u * np.abs(u))
        self.register_buffer("candidates", torch.from_numpy(steps).float())
        self.enter = _ConvNorm(3 * count + decoded + 1, fine, 1)
        self.fine = _ConvNorm(fine, fine, 3)
        self.to_middle = _ConvNorm(fine + CHANNELS[1], middle, 3)
        self.to_coarse = _ConvNorm(middle + CHANNELS[2], coarse, 3)
        self.coarse = _ConvNorm(coarse, coarse, 3)
        self.up_middle = UpsampleAndMerge(coarse + middle, middle)
        self.up_fine = UpsampleAndMerge(middle + fine, fine)
        self.head = nn.Conv2d(fine, count + 2, 1)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def observe(self, images: Float[Tensor, "view 3 height width"]) -> tuple[DepthEstimate, Observations]:
        """The monocular estimate of each view in camera heights, and the input of `refine`; RGB in [0, 1]."""
        features, encoded = self.mono.encode(images)
        estimate = self.mono.estimate(features)
        low = interpolate(encoded[1], scale_factor=2, mode="nearest")
        matching = normalize(self.matching(torch.cat((features, encoded[0], low), dim=1)), dim=1)
        return estimate, Observations(features, encoded, matching, _make_patches(avg_pool2d(images, 2)))

    def refine(
        self,
        observed: Observations,
        estimate: DepthEstimate,
        cam2world: Float[Tensor, "view 4 4"],
        pairs: list[tuple[int, int]],
    ) -> DepthEstimate:
        """A better estimate of each view, from its present one in the unit of the poses.

        Args:
            pairs: (view, other view); each view occurs at least once. Volumes of several others are averaged.
        """
        views, others = [p[0] for p in pairs], [p[1] for p in pairs]
        start = estimate.log_depth.detach()
        poses = relative_pose(cam2world[views], cam2world[others])
        candidates = start[views][:, None] + self.candidates[:, None, None]
        inverse = (-candidates).exp()
        matching = correlate(observed.matching[views], observed.matching[others], inverse, poses)
        matching = matching * math.sqrt(self.config.matching_channels)
        with torch.no_grad():
            patches, agreement = self._compare(observed, estimate, candidates, inverse, poses, views, others)
        volumes = torch.cat((matching, patches, agreement), dim=1)
        mean = _average_by_view(volumes, views, len(start))
        log_scale = estimate.log_scale.detach()[:, None]
        fine = self.fine(self.enter(torch.cat((mean, observed.features, log_scale), dim=1)))
        middle = self.to_middle(torch.cat((avg_pool2d(fine, 2), observed.encoded[1]), dim=1))
        coarse = self.coarse(self.to_coarse(torch.cat((avg_pool2d(middle, 2), observed.encoded[2]), dim=1)))
        decoded = self.up_fine(self.up_middle(coarse, middle), fine)
        maps = self.head(decoded)
        probabilities = maps[:, :-2].softmax(dim=1)
        offset = (probabilities * self.candidates[:, None, None]).sum(dim=1) + maps[:, -2]
        return DepthEstimate(start + offset, MAX_LOG_SCALE * torch.tanh((maps[:, -1] - 2.0) / MAX_LOG_SCALE))

    def _compare(
        self,
        observed: Observations,
        estimate: DepthEstimate,
        candidates: Tensor,
        inverse: Tensor,
        poses: Tensor,
        views: list[int],
        others: list[int],
    ) -> tuple[Tensor, Tensor]:
        """Correlation of the patches, and the position of each candidate relative to the other view's surface."""
        columns, rows = warp_positions(inverse, poses, "sphere")
        patches = _multiply_at(observed.patches[views], observed.patches[others], columns, rows)
        ones = torch.ones_like(estimate.log_depth[views][:, None])
        surface = _multiply_at(ones, estimate.log_depth.detach()[others][:, None], columns, rows)
        height, width = candidates.shape[-2:]
        rays = pixel_directions(height, width, dtype=torch.float32, device=candidates.device)
        rotated = torch.einsum("nij,hwj->nihw", poses[:, :3, :3].float(), rays)
        along = torch.einsum("nihw,ni->nhw", rotated, poses[:, :3, 3].float())[:, None]
        square = (poses[:, :3, 3].float() ** 2).sum(dim=1)[:, None, None, None]
        # |r d + t|^2 = d^2 (1 + 2 (r t) / d + |t|^2 / d^2)
        ratio = (1 + 2 * along * inverse + square * inverse * inverse).clamp_min(1e-6)
        distance = candidates + 0.5 * ratio.log()
        return patches, torch.tanh((distance - surface) / _AGREEMENT_SCALE)


def _multiply_at(
    reference: Float[Tensor, "pair c h w"],
    other: Float[Tensor, "pair c h w"],
    columns: Float[Tensor, "pair d h w"],
    rows: Float[Tensor, "pair d h w"],
) -> Float[Tensor, "pair d h w"]:
    """Dot products of each pixel's features with samples of the other view's, without gradient."""
    return torch.einsum("nchw,ncdhw->ndhw", reference, sample_maps(other, columns, rows, "sphere"))


class _ConvNorm(ConvNorm):
    """Convolution, batch normalisation, ReLU, in channels-last memory layout."""

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__(inputs, outputs, kernel, border="sphere", activate=relu)

    def forward(self, maps: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch d h w"]:
        return super().forward(to_channels_last(maps))


def _make_patches(images: Float[Tensor, "view 3 h w"]) -> Float[Tensor, "view c h w"]:
    """Grey patches of each pixel with mean 0 and norm 1, or less in patches without texture."""
    height, width = images.shape[-2:]
    grey = images.mean(dim=1, keepdim=True)
    padded = pad_equirect(grey, _PATCH // 2 * _PATCH_STEP, "sphere")
    patches = unfold(padded, _PATCH, dilation=_PATCH_STEP).unflatten(-1, (height, width))
    patches = patches - patches.mean(dim=1, keepdim=True)
    deviation = patches.square().sum(dim=1, keepdim=True)
    return patches / (deviation + _PATCH**2 * _PATCH_NOISE**2).sqrt()


def _average_by_view(volumes: Float[Tensor, "pair c h w"], views: list[int], count: int) -> Float[Tensor, "view c h w"]:
    index = torch.tensor(views, device=volumes.device)
    sums = volumes.new_zeros(count, *volumes.shape[1:]).index_add(0, index, volumes)
    numbers = torch.bincount(index, minlength=count).to(volumes)
    return sums / numbers[:, None, None, None]
