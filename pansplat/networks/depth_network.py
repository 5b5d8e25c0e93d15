"""Depth of a single upright panorama, with its uncertainty.

An EfficientNet-Lite0 encodes the panorama. Attention between all cells of 1/32 gives each cell the whole room. A U-Net
decoder returns, at 1/2, the logarithm of radial depth in units of the camera's height over the floor, and the logarithm
of the scale of a Laplace distribution around it. The unit makes depth independent of the unit of the poses, and the
edge of the floor determines it.

All maps continue over the seam and the poles; a panorama that is turned by 32 pixels has the same depth, turned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu

from pansplat.model.layers import PanoramaConv2d, Size, TwoConvs, attend, convolve_and_normalize
from pansplat.networks.efficientnet import CHANNELS, EfficientNetLite0

MAX_LOG_SCALE = 3.0  # limit of the logarithm of the Laplace scale
MEAN_LOG_DEPTH = 0.6  # mean log-depth of the generated homes that it was trained on, in camera heights


@dataclass(frozen=True)
class DepthNetworkConfig:
    """Widths of the depth network."""

    room_channels: Size = 192
    """Channels of the cells at 1/32."""
    attention_layers: Annotated[int, Meta(ge=0, le=64)] = 2
    attention_heads: Size = 6
    decoder_channels: tuple[Size, Size, Size, Size] = field(default=(128, 80, 48, 32))
    """Channels at 1/16, 1/8, 1/4 and 1/2."""


class DepthEstimate(NamedTuple):
    """A Laplace distribution of the logarithm of depth at each pixel.

    Attributes:
        log_depth: median.
        log_scale: logarithm of the mean absolute deviation.
    """

    log_depth: Float[Tensor, "batch h w"]
    log_scale: Float[Tensor, "batch h w"]


class RoomNetwork(nn.Module):
    """An encoder of panoramas, attention between all cells of 1/32, and a decoder to 1/2.

    Args:
        extra: channels that enter each scale of the decoder with the encoder's features.
    """

    def __init__(self, config: DepthNetworkConfig, extra: int = 0) -> None:
        super().__init__()
        self.encoder = EfficientNetLite0()
        room = config.room_channels
        self.room = PanoramaConv2d(CHANNELS[-1], room, 1, border="sphere", bias=False)
        self.room_norm = nn.BatchNorm2d(room)
        self.attention = nn.ModuleList(
            RoomAttention(room, config.attention_heads) for _ in range(config.attention_layers)
        )
        widths = (room, *config.decoder_channels)
        self.decoder = nn.ModuleList(
            UpsampleAndMerge(widths[n] + skip + extra, widths[n + 1]) for n, skip in enumerate(reversed(CHANNELS[:-1]))
        )

    def encode_room(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[Tensor, list[Tensor]]:
        """The cells after attention, in float32 or float64, and the encoder's features at 1/2 to 1/32."""
        encoded = self.encoder(images)
        x = relu(convolve_and_normalize(self.room, self.room_norm, encoded[-1]))
        with torch.autocast(x.device.type, enabled=False):
            x = x.to(torch.promote_types(x.dtype, torch.float32))
            for layer in self.attention:
                x = layer(x)
        return x, encoded


class DepthNetwork(RoomNetwork):
    """Monocular depth of panoramas."""

    def __init__(self, config: DepthNetworkConfig | None = None) -> None:
        config = config or DepthNetworkConfig()
        super().__init__(config)
        self.config = config
        self.head = nn.Conv2d(config.decoder_channels[-1], 2, 1)
        nn.init.zeros_(self.head.weight)
        nn.init.constant_(self.head.bias, 0)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> DepthEstimate:
        """Depth in camera heights at half the size of panoramas, RGB in [0, 1]; 32 divides their height."""
        features, _ = self.encode(images)
        return self.estimate(features)

    def estimate(self, features: Float[Tensor, "batch c h w"]) -> DepthEstimate:
        """The estimate of decoded features."""
        maps = self.head(features)
        log_scale = MAX_LOG_SCALE * torch.tanh((maps[:, 1] - 1.0) / MAX_LOG_SCALE)
        return DepthEstimate(maps[:, 0] + MEAN_LOG_DEPTH, log_scale)

    def encode(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> tuple[Float[Tensor, "batch c h w"], list[Tensor]]:
        """Decoded features at 1/2, and the encoder's features at 1/2 to 1/32."""
        x, encoded = self.encode_room(images)
        for merge, skip in zip(self.decoder, reversed(encoded[:-1]), strict=True):
            x = merge(x, skip)
        return x, encoded


class UpsampleAndMerge(TwoConvs):
    """Doubles the size of maps and merges them with others of that size by two convolutions."""

    def forward(self, x: Float[Tensor, "batch c height width"], *others: Tensor) -> Float[Tensor, "batch e h w"]:
        return relu(self.convolve(torch.cat((interpolate(x, scale_factor=2, mode="nearest"), *others), dim=1)))


class RoomAttention(nn.Module):
    """Attention between all cells of a panorama, and a feed-forward layer, each with a shortcut.

    A bias of the logits depends on the latitudes of the two cells and on their difference in longitude, so that a
    turned panorama has turned features.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.project_in = nn.Linear(channels, 3 * channels)
        self.project_out = nn.Linear(channels, channels)
        self.position_bias = nn.Sequential(nn.Linear(_POSITION_NUMBERS, 32), nn.GELU(), nn.Linear(32, heads))
        self.latitude = nn.Linear(2, channels)
        self.feed_forward = nn.Sequential(
            nn.Linear(channels, 2 * channels), nn.GELU(), nn.Linear(2 * channels, channels)
        )

    def forward(self, maps: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch channel height width"]:
        height, width = maps.shape[-2:]
        latitudes, pairs = _encode_positions(height, width, maps)
        x = maps.flatten(2).transpose(1, 2)  # batch cell channel
        inner = self.norm1(x) + self.latitude(latitudes)
        queries, keys, values = self.project_in(inner).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        bias = self.position_bias(pairs)  # row_i row_j column_difference head
        offsets = torch.arange(width, device=maps.device)
        difference = (offsets[:, None] - offsets) % width
        bias = bias[:, :, difference].permute(4, 0, 2, 1, 3).flatten(3).flatten(1, 2)  # head cell cell
        x = x + self.project_out(attend(queries, keys, values, mask=bias[None]).transpose(1, 2).flatten(2))
        x = x + self.feed_forward(self.norm2(x))
        return x.transpose(1, 2).unflatten(-1, (height, width))


_POSITION_NUMBERS = 10


def _encode_positions(height: int, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Encoded latitudes of the cells (cell 2), and of pairs of rows and column differences (row row column number)."""
    rows = (torch.arange(height, device=like.device, dtype=like.dtype) + 0.5) / height * math.pi - math.pi / 2
    turns = torch.arange(width, device=like.device, dtype=like.dtype) / width * 2 * math.pi
    latitude = torch.stack((rows.sin(), rows.cos()), dim=-1)
    turn = torch.stack(
        (turns.sin(), turns.cos(), (2 * turns).sin(), (2 * turns).cos(), (4 * turns).sin(), (4 * turns).cos()), dim=-1
    )
    shape = (height, height, width)
    pairs = torch.cat(
        (
            latitude[:, None, None].expand(*shape, 2),
            latitude[None, :, None].expand(*shape, 2),
            turn[None, None].expand(*shape, 6),
        ),
        dim=-1,
    )
    return latitude.repeat_interleave(width, dim=0), pairs
