"""The PanSplat network: from wide-baseline panoramas to Gaussians on a spherical pyramid; Figure 3 of the paper.

Source: Zhang et al., PanSplat: 4K panorama synthesis with feed-forward Gaussian splatting, CVPR 2025.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor, nn

from pansplat.gaussians.scene import Gaussians
from pansplat.model.cost_volume import CostVolumeConfig, Depths, SphericalCostVolume
from pansplat.model.feature_pyramid import FeaturePyramid, FeaturePyramidConfig
from pansplat.model.heads import GaussianHeads, HeadsConfig, MatchedViews, TileGaussians, merge_tiles
from pansplat.model.mono_depth import MonocularDepth
from pansplat.networks.layers import Compat, Images, PerView, Poses, Precision, autocast_convolutions, resize
from pansplat.networks.weights import ModelName

MATCHING_HEIGHT = 512
"""Largest height of the images for feature matching; the heads read them at full size."""


@dataclass(frozen=True)
class PanSplatConfig:
    """Shape of the network; shipped weights fix all of it."""

    features: FeaturePyramidConfig = field(default_factory=FeaturePyramidConfig)
    cost_volume: CostVolumeConfig = field(default_factory=CostVolumeConfig)
    heads: HeadsConfig = field(default_factory=HeadsConfig)

    def __post_init__(self) -> None:
        swept = self.cost_volume.levels[-1].candidates
        if self.heads.candidates != swept:
            raise ValueError(f"`heads.candidates` must be the {swept} of the finest sweep, got {self.heads.candidates}")
        if self.heads.feature_channels != self.features.channels[::-1]:
            raise ValueError(
                f"`heads.feature_channels` must be {self.features.channels[::-1]}, the channels of the features "
                f"coarse to fine, got {self.heads.feature_channels}"
            )


@dataclass(frozen=True)
class Prediction:
    """Output of the network.

    Attributes:
        gaussians: one set for each batch item, labelled with level and view.
        matched: intermediate features and depths.
    """

    gaussians: list[Gaussians]
    matched: MatchedViews

    @property
    def depths(self) -> Depths:
        """Depth of each view at the swept levels, coarse to fine."""
        return self.matched.depths


class PanSplat(nn.Module):
    """Feature pyramid, monocular depth, spherical cost volume, residual Gaussian heads.

    Args:
        compat: "official" computes the numbers of the official code with its defects; "fixed" corrects them.
        precision: number type of all convolutions; depths, correlations and positions are not affected.
        attention_precision: number type that attention rounds to; bfloat16 in the official code.
    """

    model: ModelName = "pansplat"
    """Name in files of weights."""

    def __init__(
        self,
        config: PanSplatConfig | None = None,
        compat: Compat = "fixed",
        *,
        precision: Precision = "float32",
        attention_precision: Precision = "float32",
    ) -> None:
        super().__init__()
        config = config or PanSplatConfig()
        self.config = config
        self.compat: Compat = compat
        self.precision: Precision = precision
        self.attention_precision: Precision = attention_precision
        self.features = FeaturePyramid(config.features, compat, attention_precision, precision)
        self.mono_depth = MonocularDepth(compat) if config.cost_volume.mono_channels else None
        self.cost_volume = SphericalCostVolume(config.cost_volume, compat, attention_precision, precision)
        self.heads = GaussianHeads(config.heads, compat, precision)

    def match_views(self, images: Images, cam2world: Poses, near: PerView, far: PerView) -> MatchedViews:
        """Compute features and depths of all views, the inputs of the heads."""
        features = self.features(self._resize_for_matching(images))
        mono_features = None
        if self.mono_depth is not None:
            with autocast_convolutions(self.precision, images.device):
                mono_features = self.mono_depth(images).to(images.dtype)
        depths = self.cost_volume(features, cam2world, near, far, mono_features)
        return MatchedViews(images, features, depths, cam2world, near, far)

    def lift_gaussians(
        self, matched: MatchedViews, *, tiles: int = 1, only: Sequence[int] | None = None
    ) -> Iterator[TileGaussians]:
        """Yield the Gaussians tile by tile to bound memory; see `GaussianHeads.iterate_tiles`."""
        return self.heads.iterate_tiles(matched, tiles=tiles, only=only)

    def forward(self, images: Images, cam2world: Poses, near: PerView, far: PerView, *, tiles: int = 1) -> Prediction:
        """Predict from posed panoramas.

        Args:
            near, far: bounds of the depth, metres.
            tiles: tiles along each side of the panorama.
        """
        matched = self.match_views(images, cam2world, near, far)
        return Prediction(merge_tiles(list(self.lift_gaussians(matched, tiles=tiles)), self.compat), matched)

    def _resize_for_matching(self, images: Images) -> Float[Tensor, "batch view 3 h w"]:
        if images.shape[-2] <= MATCHING_HEIGHT:
            return images
        small = resize(images.flatten(0, 1), (MATCHING_HEIGHT, 2 * MATCHING_HEIGHT), self.compat)
        return small.unflatten(0, images.shape[:2])
