"""A 2-D U-Net over the maps of all views, whose bottleneck attends across positions and views at once.

Source: PanSplat, section 3.2 (after MVSplat, after the U-Net of latent diffusion); OFFICIAL.md, section 7.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from pansplat.geometry.equirect import Border
from pansplat.model.layers import AttentionPrecision, PanoramaConv2d, attend, to_channels_last

_GROUPS = 8  # of every normalisation
_HEAD_CHANNELS = 32


@dataclass(frozen=True)
class UNetConfig:
    """Shape of a U-Net."""

    channels: int
    """Of every map."""
    scales: int = 3
    """Sizes of the map, each half of the one before. Attention is at the last."""


class UNet(nn.Module):
    """Encoder, middle and decoder; scale 0 is the input's size, the last is the bottleneck."""

    def __init__(self, config: UNetConfig, border: Border, precision: AttentionPrecision = "float32") -> None:
        super().__init__()
        channels, last = config.channels, config.scales - 1
        self.stem = PanoramaConv2d(channels, channels, 3, border=border)
        self.encoder = nn.ModuleList(
            EncoderScale(channels, border, precision, bottleneck=scale == last) for scale in range(config.scales)
        )
        self.middle = nn.ModuleList(ResBlock(channels, channels, border) for _ in range(2))
        self.decoder = nn.ModuleList(
            DecoderScale(channels, border, precision, bottleneck=scale == last, finest=scale == 0)
            for scale in range(config.scales)
        )
        self.exit = ConvNorm(channels, channels, border)

    def forward(
        self, maps: Float[Tensor, "batch view channel height width"]
    ) -> Float[Tensor, "batch view channel height width"]:
        """Refine the maps of all views; height and width must halve `scales - 1` times."""
        views = maps.shape[1]
        flow = self.stem(maps.flatten(0, 1))
        skips = [flow]
        for scale in self.encoder:
            flow = scale(flow, views, skips)
        for block in self.middle:
            flow = block(flow)
        for scale in reversed(self.decoder):
            flow = scale(flow, views, skips)
        return functional.silu(self.exit(flow)).unflatten(0, maps.shape[:2])


class EncoderScale(nn.Module):
    """A residual block, attention at the bottleneck, and elsewhere a convolution that halves the map."""

    def __init__(self, channels: int, border: Border, precision: AttentionPrecision, *, bottleneck: bool) -> None:
        super().__init__()
        self.block = ResBlock(channels, channels, border)
        self.attention = JointAttention(channels, precision) if bottleneck else None
        self.downsample = None if bottleneck else PanoramaConv2d(channels, channels, 3, stride=2, border=border)

    def forward(
        self, flow: Float[Tensor, "image channel height width"], views: int, skips: list[Tensor]
    ) -> Float[Tensor, "image channel h w"]:
        """The next scale's map; what the decoder will want again is added to `skips`."""
        flow = self.block(flow)
        if self.attention is not None:
            flow = self.attention(flow, views)
        skips.append(flow)
        if self.downsample is not None:
            flow = self.downsample(flow)
            skips.append(flow)
        return flow


class DecoderScale(nn.Module):
    """Two residual blocks that each take a skip, attention at the bottleneck, and a doubling of the map."""

    def __init__(
        self, channels: int, border: Border, precision: AttentionPrecision, *, bottleneck: bool, finest: bool
    ) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(ResBlock(2 * channels, channels, border) for _ in range(2))
        self.attentions = nn.ModuleList(JointAttention(channels, precision) for _ in range(2)) if bottleneck else None
        self.upsample = None if finest else PanoramaConv2d(channels, channels, 3, border=border)

    def forward(
        self, flow: Float[Tensor, "image channel height width"], views: int, skips: list[Tensor]
    ) -> Float[Tensor, "image channel h w"]:
        """The next scale's map; takes its skips off the end of `skips`."""
        for index, block in enumerate(self.blocks):
            flow = block(torch.cat((flow, skips.pop()), dim=1))
            if self.attentions is not None:
                flow = self.attentions[index](flow, views)
        if self.upsample is not None:
            flow = self.upsample(functional.interpolate(flow, scale_factor=2, mode="nearest"))
        return flow


class ConvNorm(nn.Module):
    """Convolution and group normalisation."""

    def __init__(self, inputs: int, outputs: int, border: Border) -> None:
        super().__init__()
        self.conv = PanoramaConv2d(inputs, outputs, 3, border=border)
        self.norm = nn.GroupNorm(_GROUPS, outputs)

    def forward(self, maps: Float[Tensor, "image channel height width"]) -> Float[Tensor, "image c height width"]:
        return self.norm(self.conv(maps))


class ResBlock(nn.Module):
    """Two convolutions beside a shortcut; before training the shortcut is all."""

    def __init__(self, inputs: int, outputs: int, border: Border) -> None:
        super().__init__()
        self.first = ConvNorm(inputs, outputs, border)
        self.second = ConvNorm(outputs, outputs, border)
        nn.init.zeros_(self.second.norm.weight)
        self.shortcut = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, maps: Float[Tensor, "image channel height width"]) -> Float[Tensor, "image c height width"]:
        inner = functional.silu(self.second(functional.silu(self.first(maps))))
        return inner + self.shortcut(maps)


class JointAttention(nn.Module):
    """Attention among the positions of all views at once, added to the map; before training it adds nothing."""

    def __init__(self, channels: int, precision: AttentionPrecision) -> None:
        super().__init__()
        self.precision: AttentionPrecision = precision
        self.heads = channels // _HEAD_CHANNELS
        self.project_in = nn.Linear(channels, 3 * channels)
        self.project_out = nn.Linear(channels, channels)
        self.norm = nn.GroupNorm(_GROUPS, channels)
        nn.init.zeros_(self.norm.weight)

    def forward(
        self, maps: Float[Tensor, "image channel height width"], views: int
    ) -> Float[Tensor, "image channel height width"]:
        count, channels, height, width = maps.shape
        projected = _at_each_pixel(self.project_in, maps).movedim(1, -1)
        tokens = projected.reshape(count // views, views * height * width, 3 * channels)
        # Each head's query, key and value lie one after another.
        queries, keys, values = tokens.unflatten(-1, (self.heads, 3, _HEAD_CHANNELS)).permute(3, 0, 2, 1, 4)
        attended = attend(queries, keys, values, precision=self.precision)
        merged = attended.transpose(1, 2).reshape(count, height, width, channels).movedim(-1, 1)
        return maps + self.norm(_at_each_pixel(self.project_out, to_channels_last(merged)))


def _at_each_pixel(
    linear: nn.Linear, maps: Float[Tensor, "image channel height width"]
) -> Float[Tensor, "image c height width"]:
    """A linear layer across the channels, as the convolution that it is in the original."""
    return functional.conv2d(maps, linear.weight[:, :, None, None], linear.bias)
