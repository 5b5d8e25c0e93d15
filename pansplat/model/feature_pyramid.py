"""Feature pyramid network: an encoder, a cross-view transformer at the coarsest level, a decoder.

The transformer attends within 2 x 2 windows, inside a view and across views; every second block shifts the windows by
half a window. Each view attends to the tokens of all other views jointly. Half a turn of the panoramas maps windows to
windows, so with `compat="fixed"` it rolls the output exactly; other rolls change which tokens share a window.

Source: PanSplat, section 3.1 and Figure 3; docs/official.md, section 4.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor, nn

from pansplat.geometry.equirect import Border
from pansplat.networks.layers import (
    Compat,
    ConvNorm,
    Images,
    Maps,
    Precision,
    Size,
    ViewMaps,
    attend,
    autocast_convolutions,
    choose_border,
    require_size,
    require_views,
    to_channels_last,
    upsample,
)

# Mean and standard deviation of ImageNet colours.
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class TransformerConfig:
    """Shape of the transformer; shipped weights fix all of it."""

    channels: Size = 128
    blocks: Annotated[int, Meta(ge=1, le=64)] = 6
    splits: Annotated[int, Meta(ge=1, le=2)] = 2
    """Windows along each side of the map."""
    expansion: Annotated[int, Meta(ge=1, le=16)] = 4
    """Hidden channels of the feed-forward part, in multiples of its input."""


@dataclass(frozen=True)
class FeaturePyramidConfig:
    """Shape of the feature pyramid; shipped weights fix all of it."""

    channels: tuple[Size, Size, Size, Size] = (32, 64, 96, 128)
    """Channels of levels 0 (finest) to 3."""
    transformer: TransformerConfig = field(default_factory=TransformerConfig)


class FeaturePyramid(nn.Module):
    """Features of levels 3 to 0, at 1/8 to 1/1 of the image size; F^l in the paper."""

    def __init__(
        self,
        config: FeaturePyramidConfig,
        compat: Compat,
        attention_precision: Precision = "float32",
        precision: Precision = "float32",
    ) -> None:
        super().__init__()
        self.compat: Compat = compat
        self.precision: Precision = precision
        self.encoder = Encoder(config.channels, choose_border(compat))
        self.transformer = Transformer(config.transformer, compat, attention_precision)
        self.decoder = Decoder(config.channels, compat)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # convolves faster

    def forward(self, images: Images) -> list[Float[Tensor, "batch view _ _ _"]]:
        """Compute features of RGB images in [0, 1], coarse to fine."""
        batch_and_view = images.shape[:2]
        require_views(images.shape[1], self.compat)
        height, width = images.shape[-2:]
        require_size(height, width, 32 if self.compat == "fixed" else 16)
        with autocast_convolutions(self.precision, images.device):
            fine_to_coarse = self.encoder(normalize(images.flatten(0, 1)))
            coarsest = fine_to_coarse[-1].unflatten(0, batch_and_view).to(images.dtype)
            refined = to_channels_last(self.transformer(coarsest).flatten(0, 1))
            coarse_to_fine = self.decoder(refined, fine_to_coarse[:-1])
        return [features.unflatten(0, batch_and_view).to(images.dtype) for features in coarse_to_fine]


class Encoder(nn.Module):
    """Convolutions; each level's map has half the size of the finer one."""

    def __init__(self, channels: tuple[int, int, int, int], border: Border) -> None:
        super().__init__()
        c0, c1, c2, c3 = channels
        self.levels = nn.ModuleList(
            (
                _make_level(3, (c0, 7), (c0, 5), border=border),
                _make_level(c0, (c1, 5), (c1, 3), (c1, 3), border=border, stride=2),
                _make_level(c1, (c2, 5), (c2, 3), (c2, 3), border=border, stride=2),
                _make_level(c2, (c3, 3), (c3, 3), (c3, 3), border=border, stride=2),
            )
        )

    def forward(self, images: Float[Tensor, "image 3 height width"]) -> list[Float[Tensor, "image _ _ _"]]:
        """Maps of levels 0 to 3, fine to coarse."""
        fine_to_coarse = []
        maps = images
        for level in self.levels:
            maps = level(maps)
            fine_to_coarse.append(maps)
        return fine_to_coarse


class Decoder(nn.Module):
    """From coarse to fine: the upsampled coarser map plus the encoder's map of the level."""

    def __init__(self, channels: tuple[int, int, int, int], compat: Compat) -> None:
        super().__init__()
        self.compat: Compat = compat
        *finer, width = channels
        border = choose_border(compat)
        self.laterals = nn.ModuleList(nn.Conv2d(c, width, 1) for c in finer)
        outputs = [*((c, 3) for c in finer), (width, 1)]
        self.outputs = nn.ModuleList(
            ConvNorm(width, c, kernel, border=border, bias=True, activate=_silu) for c, kernel in outputs
        )

    def forward(
        self, coarsest: Maps, fine_to_coarse: list[Float[Tensor, "image _ _ _"]]
    ) -> list[Float[Tensor, "image _ _ _"]]:
        """Features of levels 3 to 0, coarse to fine.

        Args:
            coarsest: output of the transformer, level 3.
            fine_to_coarse: the encoder's maps of levels 0 to 2.
        """
        if self.training:
            return self._decode(coarsest, fine_to_coarse)
        # In eval mode images are independent. One at a time, only one image's largest maps are in memory.
        images = [
            self._decode(coarsest[i : i + 1], [maps[i : i + 1] for maps in fine_to_coarse])
            for i in range(coarsest.shape[0])
        ]
        return [torch.cat(level) for level in zip(*images, strict=True)]

    def _decode(self, coarsest: Tensor, fine_to_coarse: list[Tensor]) -> list[Tensor]:
        maps = coarsest
        features = [self.outputs[-1](maps)]
        for level in (2, 1, 0):
            maps = upsample(maps, 2, self.compat).add_(self.laterals[level](fine_to_coarse[level]))
            features.append(self.outputs[level](maps))
        return features


def _leaky_relu(maps: Tensor) -> Tensor:
    return nn.functional.leaky_relu(maps, 0.1, inplace=True)


def _silu(maps: Tensor) -> Tensor:
    """The official form of SiLU; torch's own rounds differently."""
    return maps * maps.sigmoid()


def normalize(images: Float[Tensor, "image 3 height width"]) -> Float[Tensor, "image 3 height width"]:
    """Subtract ImageNet's mean colour and divide by its standard deviation."""
    mean, std = (torch.tensor(values).to(images)[:, None, None] for values in (_MEAN, _STD))
    return (images - mean) / std


def _make_level(inputs: int, *convs: tuple[int, int], border: Border, stride: int = 1) -> nn.Sequential:
    """Convolutions of an encoder's level: their outputs and kernels; `stride` is that of the first."""
    layers = []
    for outputs, kernel in convs:
        layers.append(ConvNorm(inputs, outputs, kernel, border=border, stride=stride, activate=_leaky_relu))
        inputs, stride = outputs, 1
    return nn.Sequential(*layers)


class Transformer(nn.Module):
    """Blocks of self- and cross-attention over the views' maps."""

    def __init__(self, config: TransformerConfig, compat: Compat, precision: Precision = "float32") -> None:
        super().__init__()
        self.config = config
        self.compat: Compat = compat
        self.blocks = nn.ModuleList(TransformerBlock(config, precision) for _ in range(config.blocks))
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(self, maps: ViewMaps) -> ViewMaps:
        """Add the position encoding and refine the maps; an InputError if they cannot be split into windows."""
        height, width = maps.shape[-2:]
        splits = self.config.splits
        require_size(height, width, 2 * splits if self.compat == "fixed" else splits)
        window = (height // splits, width // splits)
        encoding = encode_positions(*window, self.config.channels).to(maps).repeat(1, splits, splits)
        shift = (window[0] // 2, window[1] // 2)
        mask = make_shift_mask(height, width, splits, self.compat).to(maps)
        tokens = (maps + encoding).movedim(2, -1)  # batch view height width channel
        for index, block in enumerate(self.blocks):
            shifted = index % 2 == 1
            if shifted:
                tokens = tokens.roll((-shift[0], -shift[1]), dims=(2, 3))
            windows = split_windows(tokens, splits)
            windows = block(windows, mask if shifted else None)
            tokens = merge_windows(windows, height, width)
            if shifted:
                tokens = tokens.roll(shift, dims=(2, 3))
        return tokens.movedim(-1, 2)


class TransformerBlock(nn.Module):
    """Self-attention, cross-attention to the other views' tokens at the block's input, feed-forward network."""

    def __init__(self, config: TransformerConfig, precision: Precision) -> None:
        super().__init__()
        self.within = WindowAttention(config.channels, precision)
        self.across = WindowAttention(config.channels, precision)
        hidden = 2 * config.channels * config.expansion
        self.widen = nn.Linear(2 * config.channels, hidden, bias=False)
        self.narrow = nn.Linear(hidden, config.channels, bias=False)
        self.norm = nn.LayerNorm(config.channels)

    def forward(
        self, tokens: Float[Tensor, "batch view window token channel"], mask: Float[Tensor, "window token token"] | None
    ) -> Float[Tensor, "batch view window token channel"]:
        block_input = tokens
        tokens = tokens + self.within(tokens, tokens, mask)
        others = concatenate_other_views(block_input)
        if mask is not None:
            mask = mask.repeat(1, 1, block_input.shape[1] - 1)
        message = self.across(tokens, others, mask)
        message = self.narrow(nn.functional.gelu(self.widen(torch.cat((tokens, message), dim=-1))))
        return tokens + self.norm(message)


class WindowAttention(nn.Module):
    """Single-head attention inside each window, projected and normalised."""

    def __init__(self, channels: int, precision: Precision) -> None:
        super().__init__()
        self.precision: Precision = precision
        self.query = nn.Linear(channels, channels, bias=False)
        self.key = nn.Linear(channels, channels, bias=False)
        self.value = nn.Linear(channels, channels, bias=False)
        self.merge = nn.Linear(channels, channels, bias=False)
        self.norm = nn.LayerNorm(channels)

    def forward(
        self,
        tokens: Float[Tensor, "batch view window token channel"],
        source: Float[Tensor, "batch view window key channel"],
        mask: Float[Tensor, "window token key"] | None,
    ) -> Float[Tensor, "batch view window token channel"]:
        queries, keys, values = self.query(tokens), self.key(source), self.value(source)
        # Windows take the place of heads, because torch's fused kernels need four axes.
        attended = attend(
            queries.flatten(0, 1),
            keys.flatten(0, 1),
            values.flatten(0, 1),
            mask=None if mask is None else mask[None],
            precision=self.precision,
        )
        return self.norm(self.merge(attended.unflatten(0, queries.shape[:2])))


def concatenate_other_views(
    tokens: Float[Tensor, "batch view window token channel"],
) -> Float[Tensor, "batch view window others channel"]:
    """Concatenate the tokens of all other views, for each view."""
    views = tokens.shape[1]
    return torch.cat([tokens.roll(-offset, dims=1) for offset in range(1, views)], dim=3)


def split_windows(
    tokens: Float[Tensor, "batch view height width channel"], splits: int
) -> Float[Tensor, "batch view window token channel"]:
    """Split a map into splits x splits windows; windows and their tokens are in row-major order."""
    batch, views, height, width, channels = tokens.shape
    rows, columns = height // splits, width // splits
    windows = tokens.reshape(batch, views, splits, rows, splits, columns, channels).transpose(3, 4)
    return windows.reshape(batch, views, splits * splits, rows * columns, channels)


def merge_windows(
    windows: Float[Tensor, "batch view window token channel"], height: int, width: int
) -> Float[Tensor, "batch view height width channel"]:
    """Invert `split_windows`."""
    batch, views, count, _, channels = windows.shape
    splits = math.isqrt(count)
    rows, columns = height // splits, width // splits
    tokens = windows.reshape(batch, views, splits, splits, rows, columns, channels).transpose(3, 4)
    return tokens.reshape(batch, views, height, width, channels)


def encode_positions(height: int, width: int, channels: int) -> Float[Tensor, "channel height width"]:
    """Encode the row (first half of the channels) and the column in a window by sines.

    Source: DETR (Carion et al. 2020), with coordinates counted from 1 and scaled to 2 pi.
    """
    per_axis = channels // 2
    index = torch.arange(per_axis, dtype=torch.float32)
    wavelengths = 10000 ** (2 * torch.div(index, 2, rounding_mode="floor") / per_axis)

    def encode(size: int) -> Float[Tensor, "size channel"]:
        position = torch.arange(1, size + 1, dtype=torch.float32) / (size + 1e-6) * (2 * math.pi)
        angles = position[:, None] / wavelengths
        return torch.where(index % 2 == 0, angles.sin(), angles.cos())

    rows = encode(height)[:, None].expand(height, width, per_axis)
    columns = encode(width)[None].expand(height, width, per_axis)
    return torch.cat((rows, columns), dim=-1).movedim(-1, 0)


def make_shift_mask(height: int, width: int, splits: int, compat: Compat) -> Float[Tensor, "window token token"]:
    """Additive attention mask of shifted windows; it separates tokens that are not neighbours on the panorama.

    The shift wraps rows and columns around. "fixed" separates wrapped rows only, because a panorama's columns do wrap;
    "official" separates both.
    """
    rows, columns = (_label_shifted_regions(size, size // splits) for size in (height, width))
    if compat == "fixed":
        columns = torch.zeros_like(columns)
    regions = (3 * rows[:, None] + columns).reshape(1, 1, height, width, 1)
    tokens = split_windows(regions, splits)[0, 0, :, :, 0]
    apart = tokens[:, :, None] != tokens[:, None, :]
    return torch.zeros(apart.shape).masked_fill(apart, -100.0 if compat == "official" else -math.inf)


def _label_shifted_regions(size: int, window: int) -> Float[Tensor, "size"]:
    """Label each row or column after the shift: 0 before the last window, 1 and 2 in its halves; 2 wrapped around."""
    position = torch.arange(size)
    return (position >= size - window).float() + (position >= size - window // 2).float()
