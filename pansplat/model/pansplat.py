"""PanSplat: wide-baseline panoramas in, Gaussians on a spherical pyramid out. Read it beside the paper's figure 3.

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
from pansplat.model.heads import GaussianHeads, HeadsConfig, TileGaussians
from pansplat.model.layers import AttentionPrecision, Compat, Precision, autocast_convolutions, resize
from pansplat.model.mono_depth import MonocularDepth

MATCHING_HEIGHT = 512
"""Features are matched at this height at most; the heads see the panoramas as they are."""


@dataclass(frozen=True)
class PanSplatConfig:
    """Shape of the network; shipped weights fix all of it."""

    features: FeaturePyramidConfig = field(default_factory=FeaturePyramidConfig)
    cost_volume: CostVolumeConfig = field(default_factory=CostVolumeConfig)
    heads: HeadsConfig = field(default_factory=HeadsConfig)

    def __post_init__(self) -> None:
        swept = self.cost_volume.swept_levels[-1].candidates
        if self.heads.candidates != swept:
            raise ValueError(f"`heads.candidates` must be the {swept} of the finest sweep, got {self.heads.candidates}")
        if self.heads.feature_channels != self.features.channels[::-1]:
            raise ValueError(
                f"`heads.feature_channels` must be {self.features.channels[::-1]}, those of the features coarse to "
                f"fine, got {self.heads.feature_channels}"
            )


@dataclass(frozen=True)
class MatchedViews:
    """What is known of the panoramas before a Gaussian is made."""

    images: Float[Tensor, "batch view 3 height width"]
    features: Sequence[Float[Tensor, "batch view _ _ _"]]
    """Coarse to fine."""
    depths: Depths
    cam2world: Float[Tensor, "batch view 4 4"]
    near: Float[Tensor, "batch view"]
    far: Float[Tensor, "batch view"]


@dataclass(frozen=True)
class PanSplatOutput:
    """A prediction.

    Attributes:
        gaussians: a set a batch item; their labels tell level and view.
        matched: features and depths on the way there.
    """

    gaussians: list[Gaussians]
    matched: MatchedViews

    @property
    def depths(self) -> Depths:
        """Depth of each view at the swept levels, coarse to fine."""
        return self.matched.depths


class PanSplat(nn.Module):
    """Features, monocular depth, spherical cost volume, residual Gaussian heads.

    Args:
        compat: "official" computes what the original does, its defects included, so that its weights give its
            numbers; "fixed" corrects them.
        precision: number type of all convolutions; depths, correlations and positions stay as they are.
        attention_precision: what attention rounds its inputs to; the original's was bfloat16.
    """

    def __init__(
        self,
        config: PanSplatConfig | None = None,
        compat: Compat = "fixed",
        *,
        precision: Precision = "float32",
        attention_precision: AttentionPrecision = "float32",
    ) -> None:
        super().__init__()
        config = config or PanSplatConfig()
        self.config = config
        self.compat: Compat = compat
        self.precision: Precision = precision
        self.attention_precision: AttentionPrecision = attention_precision
        self.features = FeaturePyramid(config.features, compat, attention_precision, precision)
        self.mono_depth = MonocularDepth(compat) if config.cost_volume.mono_channels else None
        self.cost_volume = SphericalCostVolume(config.cost_volume, compat, attention_precision, precision)
        self.heads = GaussianHeads(config.heads, compat, precision)

    def forward(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        cam2world: Float[Tensor, "batch view 4 4"],
        near: Float[Tensor, "batch view"],
        far: Float[Tensor, "batch view"],
        *,
        tiles: int = 1,
    ) -> PanSplatOutput:
        """Predict from RGB in [0, 1] and OpenCV cam2world poses; `near` and `far` in metres.

        Raises:
            InputError: too few views (or too many for the original), or a size the pyramid cannot halve.
        """
        matched = self.match_views(images, cam2world, near, far)
        gaussians = self.heads(images, matched.features, matched.depths, cam2world, near, far, tiles=tiles)
        return PanSplatOutput(gaussians, matched)

    def match_views(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        cam2world: Float[Tensor, "batch view 4 4"],
        near: Float[Tensor, "batch view"],
        far: Float[Tensor, "batch view"],
    ) -> MatchedViews:
        """Features and depths of all views: everything before the heads."""
        features = self.features(self._matching_size(images))
        mono_features = None
        if self.mono_depth is not None:
            with autocast_convolutions(self.precision, images.device):
                mono_features = self.mono_depth(images).to(images.dtype)
        depths = self.cost_volume(features, cam2world, near, far, mono_features)
        return MatchedViews(images, features, depths, cam2world, near, far)

    def lift_gaussians(
        self, matched: MatchedViews, *, tiles: int = 1, only: Sequence[int] | None = None
    ) -> Iterator[TileGaussians]:
        """Gaussians tile by tile, for bounded memory; `only` names the tiles wanted, row by row from 0."""
        m = matched
        return self.heads.iterate_tiles(
            m.images, m.features, m.depths, m.cam2world, m.near, m.far, tiles=tiles, only=only
        )

    def _matching_size(self, images: Float[Tensor, "batch view 3 height width"]) -> Float[Tensor, "batch view 3 h w"]:
        if images.shape[-2] <= MATCHING_HEIGHT:
            return images
        small = resize(images.flatten(0, 1), (MATCHING_HEIGHT, 2 * MATCHING_HEIGHT), self.compat)
        return small.unflatten(0, images.shape[:2])
