"""Cross-view transformer of the coarsest features: attention within windows, inside a view and across views.

The map is split into 2 x 2 windows whatever its size; every second block shifts the windows by half of one, so that
neighbours meet. Two views see each other; with more, a view's queries meet the tokens of all others jointly.

Rolling the panoramas by half a turn maps windows onto windows. With `compat="fixed"` it therefore rolls the output
exactly; other rolls change which tokens share a window.

Source: PanSplat, section 3.1 (a Swin transformer with cross-view attention); OFFICIAL.md, section 4.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pansplat.model.layers import AttentionPrecision, Compat, attend, require_size


@dataclass(frozen=True)
class TransformerConfig:
    """Shape of the transformer; shipped weights fix all of it."""

    channels: int = 128
    blocks: int = 6
    splits: int = 2
    """Windows along each side of the map."""
    expansion: int = 4
    """Hidden channels of the feed-forward part, in multiples of its input."""


class Transformer(nn.Module):
    """Blocks of self- and cross-attention over the views' maps."""

    def __init__(self, config: TransformerConfig, compat: Compat, precision: AttentionPrecision = "float32") -> None:
        super().__init__()
        self.config = config
        self.compat: Compat = compat
        self.blocks = nn.ModuleList(TransformerBlock(config, precision) for _ in range(config.blocks))
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(
        self, maps: Float[Tensor, "batch view channel height width"]
    ) -> Float[Tensor, "batch view channel height width"]:
        """Refine the maps of all views; the position encoding is added first.

        Raises:
            InputError: the map cannot be split into windows and shifted by half a window.
        """
        height, width = maps.shape[-2:]
        splits = self.config.splits
        require_size(height, width, 2 * splits if self.compat == "fixed" else splits)
        window = (height // splits, width // splits)
        encoding = position_encoding(*window, self.config.channels).to(maps).repeat(1, splits, splits)
        shift = (window[0] // 2, window[1] // 2)
        mask = shift_mask(height, width, splits, self.compat).to(maps)
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
    """Self-attention, then attention to the other views as they entered the block, then the feed-forward part."""

    def __init__(self, config: TransformerConfig, precision: AttentionPrecision) -> None:
        super().__init__()
        self.within = WindowAttention(config.channels, precision)
        self.across = WindowAttention(config.channels, precision)
        hidden = 2 * config.channels * config.expansion
        self.widen = nn.Linear(2 * config.channels, hidden, bias=False)
        self.narrow = nn.Linear(hidden, config.channels, bias=False)
        self.norm = nn.LayerNorm(config.channels)

    def forward(
        self,
        tokens: Float[Tensor, "batch view window token channel"],
        mask: Float[Tensor, "window token token"] | None,
    ) -> Float[Tensor, "batch view window token channel"]:
        entering = tokens
        tokens = tokens + self.within(tokens, tokens, mask)
        others = other_views(entering)
        if mask is not None:
            mask = mask.repeat(1, 1, entering.shape[1] - 1)
        message = self.across(tokens, others, mask)
        message = self.narrow(nn.functional.gelu(self.widen(torch.cat((tokens, message), dim=-1))))
        return tokens + self.norm(message)


class WindowAttention(nn.Module):
    """One head of attention inside each window, merged and normalised."""

    def __init__(self, channels: int, precision: AttentionPrecision) -> None:
        super().__init__()
        self.precision: AttentionPrecision = precision
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
        # The windows take the place of heads: torch's fused kernels want four axes.
        attended = attend(
            queries.flatten(0, 1),
            keys.flatten(0, 1),
            values.flatten(0, 1),
            mask=None if mask is None else mask[None],
            precision=self.precision,
        )
        return self.norm(self.merge(attended.unflatten(0, queries.shape[:2])))


def other_views(
    tokens: Float[Tensor, "batch view window token channel"],
) -> Float[Tensor, "batch view window others channel"]:
    """For each view, the tokens of all other views one after another."""
    views = tokens.shape[1]
    return torch.cat([tokens.roll(-offset, dims=1) for offset in range(1, views)], dim=3)


def split_windows(
    tokens: Float[Tensor, "batch view height width channel"], splits: int
) -> Float[Tensor, "batch view window token channel"]:
    """The map as splits x splits windows, row by row, tokens of a window row by row."""
    batch, views, height, width, channels = tokens.shape
    rows, columns = height // splits, width // splits
    windows = tokens.reshape(batch, views, splits, rows, splits, columns, channels).transpose(3, 4)
    return windows.reshape(batch, views, splits * splits, rows * columns, channels)


def merge_windows(
    windows: Float[Tensor, "batch view window token channel"], height: int, width: int
) -> Float[Tensor, "batch view height width channel"]:
    """The inverse of `split_windows`."""
    batch, views, count, _, channels = windows.shape
    splits = math.isqrt(count)
    rows, columns = height // splits, width // splits
    tokens = windows.reshape(batch, views, splits, splits, rows, columns, channels).transpose(3, 4)
    return tokens.reshape(batch, views, height, width, channels)


def position_encoding(height: int, width: int, channels: int) -> Float[Tensor, "channel height width"]:
    """Sines and cosines of the row (first half of the channels) and the column in a window.

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


def shift_mask(height: int, width: int, splits: int, compat: Compat) -> Float[Tensor, "window token token"]:
    """What is added to the attention logits of shifted windows, so that only true neighbours meet.

    Shifting wraps rows and columns around. The panorama's columns do wrap, its rows do not; the original parts both.
    """
    rows, columns = (_shifted_regions(size, size // splits) for size in (height, width))
    if compat == "fixed":
        columns = torch.zeros_like(columns)
    regions = (3 * rows[:, None] + columns).reshape(1, 1, height, width, 1)
    tokens = split_windows(regions, splits)[0, 0, :, :, 0]
    apart = tokens[:, :, None] != tokens[:, None, :]
    return torch.zeros(apart.shape).masked_fill(apart, -100.0 if compat == "official" else -math.inf)


def _shifted_regions(size: int, window: int) -> Float[Tensor, "size"]:
    """Region of each row (or column) after the shift: all windows but the last, the last's half, what came around."""
    position = torch.arange(size)
    return (position >= size - window).float() + (position >= size - window // 2).float()
