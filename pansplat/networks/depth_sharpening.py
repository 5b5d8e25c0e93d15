"""Sharp depth of a single panorama: the estimate of the depth network, with the edges of a large photograph.

An encoder of the depth network's form sees the photograph at several times the size that the depth network saw. The
estimate enters at each scale of the decoder, which returns a correction at 1/2. Each pixel of the full size is then a
weighted mean of the nine nearest of these depths, so that it may belong wholly to one side of an edge.

Source of the weighted upsampling: Teed and Deng, https://arxiv.org/abs/2003.12039, section 3.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle, relu, unfold

from pansplat.geometry.equirect import pad_equirect, resize_equirect
from pansplat.networks.depth_network import (
    MAX_LOG_SCALE,
    MEAN_LOG_DEPTH,
    DepthEstimate,
    DepthNetworkConfig,
    RoomNetwork,
)
from pansplat.networks.layers import PanoramaConv2d, Size, convolve_and_normalize

_ESTIMATE_CHANNELS = 3  # log-depth, its log-scale, latitude
_NEIGHBOURS = 9  # pixels around a pixel and itself, whose depths it chooses from


@dataclass(frozen=True)
class SharpeningConfig(DepthNetworkConfig):
    """Widths of the network, and the size that it is trained for."""

    height: Size = 384
    """Height of the panoramas, pixels."""
    selection_channels: Size = 48
    """Channels from which the weights of the neighbours follow."""


class DepthSharpening(RoomNetwork):
    """From an estimate of depth and a larger panorama to depth with sharp edges."""

    def __init__(self, config: SharpeningConfig | None = None) -> None:
        config = config or SharpeningConfig()
        super().__init__(config, _ESTIMATE_CHANNELS)
        self.config, width = config, config.decoder_channels[-1]
        self.head = PanoramaConv2d(width, 2, 3, border="sphere")
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.full = PanoramaConv2d(width + 12, config.selection_channels, 3, border="sphere", bias=False)
        self.full_norm = nn.BatchNorm2d(config.selection_channels)
        self.mask = nn.Conv2d(config.selection_channels, 4 * _NEIGHBOURS, 1)

    def forward(
        self, images: Float[Tensor, "batch 3 height width"], estimate: DepthEstimate
    ) -> tuple[Float[Tensor, "batch height width"], DepthEstimate]:
        """Log-depth at the panoramas' size, and the estimate at half of it.

        Args:
            images: RGB in [0, 1]; 32 divides their height.
            estimate: the depth network's estimate of the same panoramas, at any size.
        """
        x, encoded = self.encode_room(images)
        known = torch.stack((estimate.log_depth - MEAN_LOG_DEPTH, estimate.log_scale), dim=1).float()
        for merge, skip in zip(self.decoder, reversed(encoded[:-1]), strict=True):
            height = skip.shape[-2]
            latitude = (torch.arange(height, device=x.device) + 0.5) / height * 2 - 1
            rows = latitude[:, None].expand(len(x), 1, height, 2 * height)
            x = merge(x, skip, torch.cat((_resize(known, height), rows), dim=1).to(skip.dtype))
        correction = self.head(x).float()
        height = correction.shape[-2]
        log_depth, log_scale = (_resize(map[:, None].float(), height)[:, 0] for map in estimate)
        half = DepthEstimate(
            log_depth + correction[:, 0],
            MAX_LOG_SCALE * torch.tanh((log_scale + correction[:, 1]) / MAX_LOG_SCALE),
        )
        return self._select(x, images, half.log_depth), half

    def _select(
        self, features: Float[Tensor, "batch c h w"], images: Float[Tensor, "batch 3 2*h 2*w"], depth: Tensor
    ) -> Float[Tensor, "batch 2*h 2*w"]:
        """Depth at twice the size: each pixel is a weighted mean of the nine nearest values."""
        inputs = torch.cat((features, pixel_unshuffle(images, 2).to(features.dtype)), dim=1)
        maps = self.mask(relu(convolve_and_normalize(self.full, self.full_norm, inputs)))
        weights = maps.float().unflatten(1, (_NEIGHBOURS, 4)).softmax(dim=1)
        neighbours = unfold(pad_equirect(depth[:, None], 1, "sphere"), 3).unflatten(-1, depth.shape[-2:])
        return pixel_shuffle((weights * neighbours[:, :, None]).sum(dim=1), 2)[:, 0]


def _resize(maps: Float[Tensor, "batch c h w"], height: int) -> Float[Tensor, "batch c height 2*height"]:
    return maps if maps.shape[-2] == height else resize_equirect(maps, (height, 2 * height))
