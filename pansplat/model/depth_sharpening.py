"""Sharp depth of a single panorama: the estimate of the depth network, with the edges of a large photograph.

An encoder of the depth network's form sees the photograph at several times the size that the depth network saw. The
estimate enters at each scale of the decoder, which returns a correction at 1/2. Each pixel of the full size is then a
weighted mean of the nine nearest of these depths, so that it may belong wholly to one side of an edge.

Source of the weighted upsampling: Teed and Deng, https://arxiv.org/abs/2003.12039, section 3.3.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle, pixel_unshuffle, relu, unfold

from pansplat.geometry.equirect import pad_equirect, resize_equirect
from pansplat.model.depth_network import MAX_LOG_SCALE, MEAN_LOG_DEPTH, DepthEstimate, RoomAttention
from pansplat.model.efficientnet import CHANNELS, EfficientNetLite0
from pansplat.model.layers import PanoramaConv2d, Size, convolve_and_normalize

_ESTIMATE_CHANNELS = 3  # log-depth, its log-scale, latitude
_NEIGHBOURS = 9  # whose depths a pixel chooses from


@dataclass(frozen=True)
class SharpeningConfig:
    """Widths of the network, and the size that it is trained for."""

    height: Size = 384
    """Height of the panoramas, pixels."""
    room_channels: Size = 192
    attention_layers: Annotated[int, Meta(ge=0, le=64)] = 2
    attention_heads: Size = 6
    decoder_channels: tuple[Size, Size, Size, Size] = field(default=(128, 80, 48, 32))
    """Channels at 1/16, 1/8, 1/4 and 1/2."""
    selection_channels: Size = 48
    """Channels from which the weights of the neighbours follow."""


class DepthSharpening(nn.Module):
    """From an estimate of depth and a larger panorama to depth with sharp edges."""

    def __init__(self, config: SharpeningConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or SharpeningConfig()
        self.encoder = EfficientNetLite0()
        room = config.room_channels
        self.room = PanoramaConv2d(CHANNELS[-1], room, 1, border="sphere", bias=False)
        self.room_norm = nn.BatchNorm2d(room)
        self.attention = nn.ModuleList(
            RoomAttention(room, config.attention_heads) for _ in range(config.attention_layers)
        )
        widths = (room, *config.decoder_channels)
        self.decoder = nn.ModuleList(
            _UpsampleAndMerge(widths[n], skip, widths[n + 1]) for n, skip in enumerate(reversed(CHANNELS[:-1]))
        )
        self.head = PanoramaConv2d(widths[-1], 2, 3, border="sphere")
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.full = PanoramaConv2d(widths[-1] + 12, config.selection_channels, 3, border="sphere", bias=False)
        self.full_norm = nn.BatchNorm2d(config.selection_channels)
        self.mask = nn.Conv2d(config.selection_channels, 4 * _NEIGHBOURS, 1)

    def forward(
        self, images: Float[Tensor, "batch 3 height width"], estimate: DepthEstimate
    ) -> tuple[Float[Tensor, "batch height width"], DepthEstimate]:
        """Log-depth at the panoramas' size, and the estimate at half of it.

        Args:
            images: RGB in [0, 1]; 32 divides their height.
            estimate: of the same panoramas by the depth network, at any size.
        """
        encoded = self.encoder(images)
        x = relu(convolve_and_normalize(self.room, self.room_norm, encoded[-1]))
        with torch.autocast(x.device.type, enabled=False):
            x = x.float()
            for layer in self.attention:
                x = layer(x)
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


class _UpsampleAndMerge(nn.Module):
    """Doubles the size of maps and merges them with the encoder's features and the estimate by two convolutions."""

    def __init__(self, inputs: int, skip: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = PanoramaConv2d(inputs + skip + _ESTIMATE_CHANNELS, outputs, 3, border="sphere", bias=False)
        self.norm1 = nn.BatchNorm2d(outputs)
        self.conv2 = PanoramaConv2d(outputs, outputs, 3, border="sphere", bias=False)
        self.norm2 = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor, skip: Tensor, estimate: Tensor) -> Float[Tensor, "batch c h w"]:
        x = torch.cat((interpolate(x, scale_factor=2, mode="nearest"), skip, estimate), dim=1)
        x = relu(convolve_and_normalize(self.conv1, self.norm1, x))
        return relu(convolve_and_normalize(self.conv2, self.norm2, x))


def _resize(maps: Float[Tensor, "batch c h w"], height: int) -> Float[Tensor, "batch c height 2*height"]:
    return maps if maps.shape[-2] == height else resize_equirect(maps, (height, 2 * height))
