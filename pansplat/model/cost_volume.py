"""Hierarchical spherical cost volume: from features to inverse depth, level by level.

Each level sweeps candidate spheres about the result of the coarser one, correlates the views' features, refines the
volume with a U-Net, and takes the mean of the candidates under the softmax of its logits.

Source: PanSplat, section 3.2 and Figure 3; OFFICIAL.md, section 6. The candidates' spacing halves from level to
level, as in the original (the paper keeps it; OFFICIAL.md, P3).
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from pansplat.geometry.correlation import correlate
from pansplat.geometry.equirect import Border
from pansplat.geometry.warp import Sampling, relative_pose
from pansplat.model.layers import (
    AttentionPrecision,
    Compat,
    PanoramaConv2d,
    Precision,
    border_of,
    convolving,
    require_rigid,
    require_size,
    require_views,
    resize,
    upsample,
)
from pansplat.model.unet import UNet, UNetConfig

_UNET_MULTIPLE = 4  # what a U-Net of three scales divides the map by


@dataclass(frozen=True)
class SweepLevel:
    """Shape of one level of the cost volume."""

    level: int
    """0 would be the finest, at the image's size."""
    channels: int
    """Of the features."""
    candidates: int
    width: int
    """Channels of the U-Net."""


_HIERARCHY = (
    SweepLevel(level=3, channels=128, candidates=128, width=128),
    SweepLevel(level=2, channels=96, candidates=64, width=64),
    SweepLevel(level=1, channels=64, candidates=32, width=32),
)


@dataclass(frozen=True)
class CostVolumeConfig:
    """Shape of the cost volume; shipped weights fix all of it."""

    sweep: Literal["hierarchical", "single"] = "hierarchical"
    """All levels, or the coarsest alone."""
    mono_channels: int = 32
    """Of the monocular features; 0 goes without."""
    refinement: Literal["unet", "none"] = "unet"
    """Whether a U-Net refines the volume, or a 1x1 convolution alone mixes it."""
    levels: tuple[SweepLevel, ...] = _HIERARCHY
    """Coarse to fine."""

    @property
    def swept_levels(self) -> tuple[SweepLevel, ...]:
        """Coarse to fine."""
        return self.levels if self.sweep == "hierarchical" else self.levels[:1]


@dataclass(frozen=True)
class LevelDepth:
    """What one level of the cost volume knows."""

    level: int
    inverse_depth: Float[Tensor, "batch view height width"]
    """1 / metres."""
    confidence: Float[Tensor, "batch view height width"]
    """Largest probability of a candidate."""
    logits: Float[Tensor, "batch view candidate height width"]
    candidates: Float[Tensor, "batch view candidate height width"]
    """Inverse depths, 1 / metres; the first is the farthest."""

    @property
    def depth(self) -> Float[Tensor, "batch view height width"]:
        """Radial, metres."""
        return 1 / self.inverse_depth


@dataclass(frozen=True)
class Depths:
    """Depth of all views at each swept level, coarse to fine."""

    levels: tuple[LevelDepth, ...]

    @property
    def inverse_depth(self) -> list[Float[Tensor, "batch view _ _"]]:
        """1 / metres, coarse to fine."""
        return [level.inverse_depth for level in self.levels]

    @property
    def depth(self) -> list[Float[Tensor, "batch view _ _"]]:
        """Radial, metres, coarse to fine."""
        return [level.depth for level in self.levels]

    @property
    def confidence(self) -> list[Float[Tensor, "batch view _ _"]]:
        """Largest probability of a candidate, coarse to fine."""
        return [level.confidence for level in self.levels]

    @property
    def logits(self) -> Float[Tensor, "batch view candidate h w"]:
        """Of the finest swept level."""
        return self.levels[-1].logits

    @property
    def candidates(self) -> Float[Tensor, "batch view candidate h w"]:
        """Inverse depths of the finest swept level, 1 / metres."""
        return self.levels[-1].candidates


class SphericalCostVolume(nn.Module):
    """Inverse depth of every view, coarse to fine."""

    def __init__(
        self,
        config: CostVolumeConfig,
        compat: Compat,
        attention_precision: AttentionPrecision = "float32",
        precision: Precision = "float32",
    ) -> None:
        super().__init__()
        self.config = config
        self.precision: Precision = precision
        self.compat: Compat = compat
        # Keys are the paper's numbers of the levels.
        self.levels = nn.ModuleDict()
        for index, sweep in enumerate(config.swept_levels):
            self.levels[str(sweep.level)] = LevelRefinement(
                sweep, config, first=index == 0, compat=compat, precision=attention_precision
            )
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # convolves faster

    def forward(
        self,
        features: list[Float[Tensor, "batch view _ _ _"]],
        cam2world: Float[Tensor, "batch view 4 4"],
        near: Float[Tensor, "batch view"],
        far: Float[Tensor, "batch view"],
        mono_features: Float[Tensor, "batch view mono height width"] | None = None,
    ) -> Depths:
        """Sweep, refine and regress at each level.

        Args:
            features: of the feature pyramid, coarse to fine; maps finer than the sweep are left alone.
            cam2world: rigid, metres.
            near: nearest depth that is looked for, metres, > 0.
            far: farthest, metres.
            mono_features: of the monocular network, at any size.

        Raises:
            InputError: too few views (or too many for the original), a pose that is not rigid, or maps the U-Net
                cannot halve.
            ValueError: monocular features missing or surplus.
        """
        require_views(cam2world.shape[1], self.compat)
        require_rigid(cam2world)
        if (mono_features is None) != (self.config.mono_channels == 0):
            raise ValueError(f"mono_channels={self.config.mono_channels}, but `mono_features` say otherwise")
        bounds = (1 / far, 1 / near)
        done: list[LevelDepth] = []
        for sweep, level_features in zip(self.config.swept_levels, features, strict=False):
            height, width = level_features.shape[-2:]
            require_size(height, width, _UNET_MULTIPLE)
            centre = upsampled_centre(done[-1].inverse_depth, self.compat) if done else None
            first_count = self.config.swept_levels[0].candidates
            if centre is None:
                candidates = first_candidates(bounds, first_count, (height, width))
            else:
                step = (bounds[1] - bounds[0]) / max(1, first_count - 1) / 2 ** len(done)
                candidates = candidates_about(centre, step, bounds, sweep.candidates)
            volume = correlate_views(level_features, candidates, cam2world, self.compat)
            with convolving(self.precision, volume.device):
                logits = self.levels[str(sweep.level)](volume, level_features, centre, mono_features)
            done.append(regress(sweep.level, logits.to(level_features.dtype), candidates))
        return Depths(tuple(done))


class LevelRefinement(nn.Module):
    """From a level's cost volume to the logits of its candidates: paper's C to C~."""

    def __init__(
        self, sweep: SweepLevel, config: CostVolumeConfig, *, first: bool, compat: Compat, precision: AttentionPrecision
    ) -> None:
        super().__init__()
        self.compat: Compat = compat
        border = border_of(compat)
        inputs = sweep.candidates + sweep.channels + (0 if first else 1) + config.mono_channels
        self.shortcut = nn.Conv2d(inputs, sweep.width, 1)
        self.refine = VolumeRefinement(inputs, sweep.width, border, precision) if config.refinement == "unet" else None
        self.head = nn.Sequential(
            PanoramaConv2d(sweep.width, 2 * sweep.width, 3, border=border),
            nn.GELU(),
            PanoramaConv2d(2 * sweep.width, sweep.candidates, 3, border=border),
        )

    def forward(
        self,
        volume: Float[Tensor, "batch view candidate height width"],
        features: Float[Tensor, "batch view channel height width"],
        centre: Float[Tensor, "batch view height width"] | None,
        mono_features: Float[Tensor, "batch view mono h w"] | None,
    ) -> Float[Tensor, "batch view candidate height width"]:
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

    def __init__(self, inputs: int, width: int, border: Border, precision: AttentionPrecision) -> None:
        super().__init__()
        self.entry = PanoramaConv2d(inputs, width, 3, border=border)
        self.norm = nn.GroupNorm(8, width)
        self.unet = UNet(UNetConfig(width), border, precision)
        self.exit = PanoramaConv2d(width, width, 3, border=border)

    def forward(
        self, inputs: Float[Tensor, "batch view channel height width"]
    ) -> Float[Tensor, "batch view c height width"]:
        views = inputs.shape[:2]
        entered = functional.gelu(self.norm(self.entry(inputs.flatten(0, 1))))
        refined = self.unet(entered.unflatten(0, views))
        return self.exit(refined.flatten(0, 1)).unflatten(0, views)


def first_candidates(
    bounds: tuple[Float[Tensor, "batch view"], Float[Tensor, "batch view"]], count: int, size: tuple[int, int]
) -> Float[Tensor, "batch view candidate height width"]:
    """Inverse depths evenly from far to near, the same for every pixel; one alone is in the middle."""
    low, high = (bound[:, :, None] for bound in bounds)
    fraction = torch.linspace(0, 1, count).to(low) if count > 1 else torch.full((1,), 0.5).to(low)
    candidates = low + fraction * (high - low)
    return candidates[..., None, None].expand(*candidates.shape, *size)


def candidates_about(
    centre: Float[Tensor, "batch view height width"],
    step: Float[Tensor, "batch view"],
    bounds: tuple[Float[Tensor, "batch view"], Float[Tensor, "batch view"]],
    count: int,
) -> Float[Tensor, "batch view candidate height width"]:
    """Inverse depths about each pixel's own, clamped to the bounds."""
    low, high = (bound[:, :, None, None, None] for bound in bounds)
    offsets = torch.arange(-(count // 2), count - count // 2).to(centre)[:, None, None]
    candidates = centre[:, :, None] + step[:, :, None, None, None] * offsets
    return torch.minimum(torch.maximum(candidates, low), high)


def upsampled_centre(
    inverse_depth: Float[Tensor, "batch view height width"], compat: Compat
) -> Float[Tensor, "batch view h w"]:
    """The coarser level's result at twice its size; no gradient flows back through it."""
    return upsample(inverse_depth.detach(), 2, compat)


def correlate_views(
    features: Float[Tensor, "batch view channel height width"],
    candidates: Float[Tensor, "batch view candidate height width"],
    cam2world: Float[Tensor, "batch view 4 4"],
    compat: Compat,
) -> Float[Tensor, "batch view candidate height width"]:
    """Each view's correlation with the others, averaged over them."""
    total = _correlate_round(features, candidates, cam2world, 1, compat)
    for offset in range(2, features.shape[1]):
        total = total + _correlate_round(features, candidates, cam2world, offset, compat)
    return total / (features.shape[1] - 1)


def _correlate_round(features: Tensor, candidates: Tensor, cam2world: Tensor, offset: int, compat: Compat) -> Tensor:
    """Each view's correlation with the one that comes `offset` views later, counted round."""
    sampling: Sampling = "sphere" if compat == "fixed" else "corners"
    correlation = correlate(
        features.flatten(0, 1),
        features.roll(-offset, dims=1).flatten(0, 1),
        candidates.flatten(0, 1),
        relative_pose(cam2world, cam2world.roll(-offset, dims=1)).flatten(0, 1),
        sampling,
    )
    return correlation.unflatten(0, features.shape[:2])


def regress(
    level: int,
    logits: Float[Tensor, "batch view candidate height width"],
    candidates: Float[Tensor, "batch view candidate height width"],
) -> LevelDepth:
    """The mean of the candidates under the softmax of the logits, in float32 at least."""
    probability = torch.softmax(logits.to(torch.promote_types(logits.dtype, torch.float32)), dim=2)
    inverse_depth = (probability * candidates).sum(dim=2)
    return LevelDepth(level, inverse_depth, probability.amax(dim=2), logits, candidates)
