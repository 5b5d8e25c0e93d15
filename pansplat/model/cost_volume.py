"""Hierarchical spherical cost volume: from features to inverse depth, coarse to fine.

Each level tests depth candidates around the result of the coarser one: it correlates the features of the views at
every candidate, refines the volume with a U-Net and regresses the mean of the candidates under the softmax of the
logits. The U-Net attends across positions and views at its bottleneck.

The candidate spacing halves from level to level, as in the official code; the paper keeps it (docs/paper.md, P3).

Source: PanSplat, section 3.2 and Figure 3; docs/official.md, sections 6 and 7.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor, nn
from torch.nn import functional

from pansplat.geometry.correlation import correlate
from pansplat.geometry.equirect import Border
from pansplat.geometry.warp import Sampling, relative_pose
from pansplat.model.layers import (
    Compat,
    ConvNorm,
    Maps,
    PanoramaConv2d,
    PerView,
    Poses,
    Precision,
    Size,
    ViewMaps,
    Volume,
    attend,
    autocast_convolutions,
    choose_border,
    make_head,
    require_rigid,
    require_size,
    require_views,
    resize,
    to_channels_last,
    upsample,
)

_UNET_SCALES = 3
_UNET_MULTIPLE = 2 ** (_UNET_SCALES - 1)

_GROUPS = 8  # groups of the group normalisation
_HEAD_CHANNELS = 32  # channels of one attention head


@dataclass(frozen=True)
class SweepLevel:
    """Shape of one level of the cost volume."""

    level: Annotated[int, Meta(ge=0, le=3)]
    """Pyramid level of the features; the map has 2^-level of the image's size."""
    channels: Size
    """Channels of the features."""
    candidates: Size
    """Depth candidates per pixel."""
    width: Size
    """Channels of the U-Net."""


_HIERARCHY = (
    SweepLevel(level=3, channels=128, candidates=128, width=128),
    SweepLevel(level=2, channels=96, candidates=64, width=64),
    SweepLevel(level=1, channels=64, candidates=32, width=32),
)


@dataclass(frozen=True)
class CostVolumeConfig:
    """Shape of the cost volume; shipped weights fix all of it."""

    mono_channels: Annotated[int, Meta(ge=0, le=4096)] = 32
    """Channels of the monocular features; 0 for none."""
    refinement: Literal["unet", "none"] = "unet"
    """Refine the volume by a U-Net plus a 1x1 convolution, or by the convolution only."""
    levels: tuple[SweepLevel, ...] = _HIERARCHY
    """Coarse to fine."""

    def __post_init__(self) -> None:
        levels, hierarchy = [level.level for level in self.levels], [level.level for level in _HIERARCHY]
        first = hierarchy.index(levels[0]) if levels and levels[0] in hierarchy else 0
        if levels != hierarchy[first : first + len(levels)]:
            raise ValueError(f"`levels` must be consecutive ones of {hierarchy}, coarse to fine, got {levels}")


@dataclass(frozen=True)
class LevelDepth:
    """Result of one level of the cost volume."""

    level: int
    inverse_depth: Float[Tensor, "batch view height width"]
    """1 / metres."""
    confidence: Float[Tensor, "batch view height width"]
    """Largest probability of a candidate."""
    logits: Volume
    candidates: Volume
    """Inverse depths, 1 / metres, from far to near."""

    @property
    def depth(self) -> Float[Tensor, "batch view height width"]:
        """The estimated radial depth of the level, metres."""
        return 1 / self.inverse_depth


@dataclass(frozen=True)
class Depths:
    """Depth of all views at each swept level, coarse to fine."""

    levels: tuple[LevelDepth, ...]

    @property
    def inverse_depth(self) -> list[Float[Tensor, "batch view _ _"]]:
        """Inverse depth, 1 / metres, coarse to fine."""
        return [level.inverse_depth for level in self.levels]

    @property
    def depth(self) -> list[Float[Tensor, "batch view _ _"]]:
        """Radial depth, metres, coarse to fine."""
        return [level.depth for level in self.levels]


class SphericalCostVolume(nn.Module):
    """Regresses the inverse depth of every view, coarse to fine."""

    def __init__(
        self,
        config: CostVolumeConfig,
        compat: Compat,
        attention_precision: Precision = "float32",
        precision: Precision = "float32",
    ) -> None:
        super().__init__()
        self.config = config
        self.precision: Precision = precision
        self.compat: Compat = compat
        # Keys are pyramid levels.
        self.levels = nn.ModuleDict()
        for index, sweep in enumerate(config.levels):
            self.levels[str(sweep.level)] = LevelRefinement(
                sweep, config, first=index == 0, compat=compat, precision=attention_precision
            )
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # convolves faster

    def forward(
        self,
        features: list[Float[Tensor, "batch view _ _ _"]],
        cam2world: Poses,
        near: PerView,
        far: PerView,
        mono_features: Float[Tensor, "batch view mono height width"] | None = None,
    ) -> Depths:
        """Correlate, refine and regress at each level.

        Args:
            features: maps of the feature pyramid, coarse to fine; maps finer than the swept levels are not used.
            cam2world: rigid poses, metres.
            near: smallest depth candidate, metres, > 0.
            far: largest depth candidate, metres.
            mono_features: features of the monocular network, at any size.

        Raises:
            ValueError: `mono_features` are missing, or given although `mono_channels` is 0.
        """
        require_views(cam2world.shape[1], self.compat)
        require_rigid(cam2world)
        if (mono_features is None) != (self.config.mono_channels == 0):
            raise ValueError(
                "`mono_features` must be given if and only if mono_channels > 0, got "
                f"mono_channels={self.config.mono_channels}"
            )
        bounds = (1 / far, 1 / near)
        regressed: list[LevelDepth] = []
        for sweep, level_features in zip(self.config.levels, features, strict=False):
            height, width = level_features.shape[-2:]
            require_size(height, width, _UNET_MULTIPLE)
            if not regressed:
                centre, candidates = None, make_first_candidates(bounds, sweep.candidates, (height, width))
            else:
                centre = upsample(regressed[-1].inverse_depth.detach(), 2, self.compat)
                intervals = max(1, self.config.levels[0].candidates - 1)
                step = (bounds[1] - bounds[0]) / intervals / 2 ** len(regressed)
                candidates = make_candidates_around(centre, step, bounds, sweep.candidates)
            volume = correlate_views(level_features, candidates, cam2world, self.compat)
            with autocast_convolutions(self.precision, volume.device):
                logits = self.levels[str(sweep.level)](volume, level_features, centre, mono_features)
            regressed.append(regress_depth(sweep.level, logits.to(level_features.dtype), candidates))
        return Depths(tuple(regressed))


class LevelRefinement(nn.Module):
    """Computes the logits of a level's candidates from its cost volume; in the paper C~ from C."""

    def __init__(
        self,
        sweep: SweepLevel,
        config: CostVolumeConfig,
        *,
        first: bool,
        compat: Compat,
        precision: Precision,
    ) -> None:
        super().__init__()
        self.compat: Compat = compat
        border = choose_border(compat)
        inputs = sweep.candidates + sweep.channels + (0 if first else 1) + config.mono_channels
        self.shortcut = nn.Conv2d(inputs, sweep.width, 1)
        self.refine = VolumeRefinement(inputs, sweep.width, border, precision) if config.refinement == "unet" else None
        self.head = make_head(sweep.width, 2 * sweep.width, sweep.candidates, border)

    def forward(
        self,
        volume: Volume,
        features: ViewMaps,
        centre: Float[Tensor, "batch view height width"] | None,
        mono_features: Float[Tensor, "batch view mono h w"] | None,
    ) -> Volume:
        parts = [volume.to(features.dtype), features]
        if centre is not None:
            parts.append(centre[:, :, None].to(features.dtype))
        if mono_features is not None:
            height, width = features.shape[-2:]
            resized = resize(mono_features.flatten(0, 1), (height, width), self.compat)
            parts.append(resized.unflatten(0, features.shape[:2]))
        inputs = torch.cat(parts, dim=2)
        refined = self.shortcut(inputs.flatten(0, 1))
        if self.refine is not None:
            refined = refined + self.refine(inputs).flatten(0, 1)
        return self.head(refined).unflatten(0, volume.shape[:2])


class VolumeRefinement(nn.Module):
    """A U-Net between two convolutions."""

    def __init__(self, inputs: int, width: int, border: Border, precision: Precision) -> None:
        super().__init__()
        self.entry = PanoramaConv2d(inputs, width, 3, border=border)
        self.norm = nn.GroupNorm(_GROUPS, width)
        self.unet = UNet(width, border, precision)
        self.exit = PanoramaConv2d(width, width, 3, border=border)

    def forward(self, inputs: ViewMaps) -> Float[Tensor, "batch view c height width"]:
        views = inputs.shape[:2]
        entered = functional.gelu(self.norm(self.entry(inputs.flatten(0, 1))))
        refined = self.unet(entered.unflatten(0, views))
        return self.exit(refined.flatten(0, 1)).unflatten(0, views)


def make_first_candidates(bounds: tuple[PerView, PerView], count: int, size: tuple[int, int]) -> Volume:
    """Evenly spaced inverse depths from far to near, equal for all pixels; a single one is the mean of the bounds."""
    low, high = (bound[:, :, None] for bound in bounds)
    fraction = torch.linspace(0, 1, count).to(low) if count > 1 else torch.full((1,), 0.5).to(low)
    candidates = low + fraction * (high - low)
    return candidates[..., None, None].expand(*candidates.shape, *size)


def make_candidates_around(
    centre: Float[Tensor, "batch view height width"], step: PerView, bounds: tuple[PerView, PerView], count: int
) -> Volume:
    """Inverse depths around each pixel's centre, clamped to the bounds."""
    low, high = (bound[:, :, None, None, None] for bound in bounds)
    offsets = torch.arange(-(count // 2), count - count // 2).to(centre)[:, None, None]
    candidates = centre[:, :, None] + step[:, :, None, None, None] * offsets
    return torch.minimum(torch.maximum(candidates, low), high)


def correlate_views(features: ViewMaps, candidates: Volume, cam2world: Poses, compat: Compat) -> Volume:
    """Mean correlation of each view with all other views."""
    total = _correlate_neighbours(features, candidates, cam2world, 1, compat)
    for offset in range(2, features.shape[1]):
        total = total + _correlate_neighbours(features, candidates, cam2world, offset, compat)
    return total / (features.shape[1] - 1)


def _correlate_neighbours(
    features: Tensor, candidates: Tensor, cam2world: Tensor, offset: int, compat: Compat
) -> Tensor:
    """Correlate view i with view (i + offset) mod the number of views."""
    sampling: Sampling = "sphere" if compat == "fixed" else "corners"
    correlation = correlate(
        features.flatten(0, 1),
        features.roll(-offset, dims=1).flatten(0, 1),
        candidates.flatten(0, 1),
        relative_pose(cam2world, cam2world.roll(-offset, dims=1)).flatten(0, 1),
        sampling,
    )
    return correlation.unflatten(0, features.shape[:2])


def regress_depth(level: int, logits: Volume, candidates: Volume) -> LevelDepth:
    """Regress the mean of the candidates under the softmax of the logits, in float32 or float64."""
    probability = torch.softmax(logits.to(torch.promote_types(logits.dtype, torch.float32)), dim=2)
    inverse_depth = (probability * candidates).sum(dim=2)
    return LevelDepth(level, inverse_depth, probability.amax(dim=2), logits, candidates)


class UNet(nn.Module):
    """2-D U-Net of three scales over the maps of all views; scale 0 has the input's size, the last is the bottleneck.

    Each scale is half of the previous one; all maps have the same channels. Attention is at the bottleneck.

    Source: PanSplat, section 3.2 (after MVSplat, after the U-Net of latent diffusion).
    """

    def __init__(self, channels: int, border: Border, precision: Precision = "float32") -> None:
        super().__init__()
        last = _UNET_SCALES - 1
        self.stem = PanoramaConv2d(channels, channels, 3, border=border)
        self.encoder = nn.ModuleList(
            EncoderScale(channels, border, precision, bottleneck=scale == last) for scale in range(_UNET_SCALES)
        )
        self.middle = nn.ModuleList(ResBlock(channels, channels, border) for _ in range(2))
        self.decoder = nn.ModuleList(
            DecoderScale(channels, border, precision, bottleneck=scale == last, finest=scale == 0)
            for scale in range(_UNET_SCALES)
        )
        self.exit = ConvNorm(channels, channels, border=border, bias=True, groups=_GROUPS)

    def forward(self, maps: ViewMaps) -> ViewMaps:
        """Refine the maps of all views; `_UNET_MULTIPLE` must divide height and width."""
        views = maps.shape[1]
        x = self.stem(maps.flatten(0, 1))
        skips = [x]
        for scale in self.encoder:
            x = scale(x, views, skips)
        for block in self.middle:
            x = block(x)
        for scale in reversed(self.decoder):
            x = scale(x, views, skips)
        return functional.silu(self.exit(x)).unflatten(0, maps.shape[:2])


class EncoderScale(nn.Module):
    """A residual block, then attention (at the bottleneck) or a convolution of stride 2 (elsewhere)."""

    def __init__(self, channels: int, border: Border, precision: Precision, *, bottleneck: bool) -> None:
        super().__init__()
        self.block = ResBlock(channels, channels, border)
        self.attention = JointAttention(channels, precision) if bottleneck else None
        self.downsample = None if bottleneck else PanoramaConv2d(channels, channels, 3, stride=2, border=border)

    def forward(self, x: Maps, views: int, skips: list[Tensor]) -> Float[Tensor, "image channel h w"]:
        """Return the next scale's map; append the maps for the decoder to `skips`."""
        x = self.block(x)
        if self.attention is not None:
            x = self.attention(x, views)
        skips.append(x)
        if self.downsample is not None:
            x = self.downsample(x)
            skips.append(x)
        return x


class DecoderScale(nn.Module):
    """Two residual blocks with skip connections, attention at the bottleneck, upsampling."""

    def __init__(self, channels: int, border: Border, precision: Precision, *, bottleneck: bool, finest: bool) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(ResBlock(2 * channels, channels, border) for _ in range(2))
        self.attentions = nn.ModuleList(JointAttention(channels, precision) for _ in range(2)) if bottleneck else None
        self.upsample = None if finest else PanoramaConv2d(channels, channels, 3, border=border)

    def forward(self, x: Maps, views: int, skips: list[Tensor]) -> Float[Tensor, "image channel h w"]:
        """Return the next scale's map; pop two maps from the end of `skips`."""
        for index, block in enumerate(self.blocks):
            x = block(torch.cat((x, skips.pop()), dim=1))
            if self.attentions is not None:
                x = self.attentions[index](x, views)
        if self.upsample is not None:
            x = self.upsample(functional.interpolate(x, scale_factor=2, mode="nearest"))
        return x


class ResBlock(nn.Module):
    """Two convolutions plus a shortcut; after initialisation the convolutions give zero."""

    def __init__(self, inputs: int, outputs: int, border: Border) -> None:
        super().__init__()
        self.first = ConvNorm(inputs, outputs, border=border, bias=True, groups=_GROUPS)
        self.second = ConvNorm(outputs, outputs, border=border, bias=True, groups=_GROUPS)
        nn.init.zeros_(self.second.norm.weight)
        self.shortcut = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, maps: Maps) -> Float[Tensor, "image c height width"]:
        inner = functional.silu(self.second(functional.silu(self.first(maps))))
        return inner + self.shortcut(maps)


class JointAttention(nn.Module):
    """Adds attention over the positions of all views to the input; after initialisation it adds zero."""

    def __init__(self, channels: int, precision: Precision) -> None:
        super().__init__()
        self.precision: Precision = precision
        self.heads = channels // _HEAD_CHANNELS
        self.project_in = nn.Linear(channels, 3 * channels)
        self.project_out = nn.Linear(channels, channels)
        self.norm = nn.GroupNorm(_GROUPS, channels)
        nn.init.zeros_(self.norm.weight)

    def forward(self, maps: Maps, views: int) -> Maps:
        count, channels, height, width = maps.shape
        projected = _apply_per_pixel(self.project_in, maps).movedim(1, -1)
        tokens = projected.reshape(count // views, views * height * width, 3 * channels)
        # The channels of a head are its query, its key and its value, in this order.
        queries, keys, values = tokens.unflatten(-1, (self.heads, 3, _HEAD_CHANNELS)).permute(3, 0, 2, 1, 4)
        attended = attend(queries, keys, values, precision=self.precision)
        merged = attended.transpose(1, 2).reshape(count, height, width, channels).movedim(-1, 1)
        return maps + self.norm(_apply_per_pixel(self.project_out, to_channels_last(merged)))


def _apply_per_pixel(linear: nn.Linear, maps: Maps) -> Float[Tensor, "image c height width"]:
    """Apply a linear layer to the channels of every pixel, as a 1x1 convolution."""
    return functional.conv2d(maps, linear.weight[:, :, None, None], linear.bias)
