"""The MVSplat baseline on panoramas: one cost volume at 1/4 of the image, one Gaussian per pixel.

It uses PanSplat's layers. With `compat="official"` nothing wraps at the seam, as in the official code; with "fixed"
convolutions, resizing and correlation continue across seam and poles.

Source: Chen et al., MVSplat, https://arxiv.org/abs/2403.14627; docs/official.md, section 16.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import gelu, instance_norm, interpolate, relu

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import Border
from pansplat.model.base import Network
from pansplat.model.cost_volume import (
    CostVolumeConfig,
    Depths,
    LevelDepth,
    LevelRefinement,
    SweepLevel,
    VolumeRefinement,
    correlate_views,
    make_first_candidates,
    regress_depth,
)
from pansplat.model.feature_pyramid import Transformer, TransformerConfig, normalize
from pansplat.model.heads import AdapterConfig, TileGaussians, adapt_gaussians
from pansplat.model.layers import (
    Compat,
    Images,
    Maps,
    PanoramaConv2d,
    PerView,
    Poses,
    Precision,
    Size,
    ViewMaps,
    make_head,
    require_size,
    require_views,
    upsample,
)
from pansplat.model.tiles import make_lattice_uv, move_points

_SCALE = 4  # image size over the size of the cost volume
_ENCODER_CHANNELS = (64, 64, 96, 96, 128, 128)  # of the residual blocks


@dataclass(frozen=True)
class MVSplatConfig:
    """Shape of the network; shipped weights fix all of it."""

    channels: Size = 128
    """Channels of the features."""
    candidates: Size = 128
    """Depth candidates per pixel."""
    width: Size = 128
    """Channels of the cost volume's U-Net."""
    refine_width: Size = 32
    """Channels of the U-Net at the image's size."""
    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    adapter: AdapterConfig = field(default_factory=AdapterConfig)


@dataclass(frozen=True)
class MatchedViews:
    """Features and depths of all views, at 1/4 of the image's size.

    Attributes:
        features: output of the transformer.
        encoded: output of the encoder, input of the transformer.
    """

    images: Images
    features: Float[Tensor, "batch view channel h w"]
    encoded: Float[Tensor, "batch view channel h w"]
    depths: Depths
    cam2world: Poses
    near: PerView
    far: PerView


class MVSplat(Network):
    """Features and a cost volume at 1/4 scale, and one Gaussian for each pixel."""

    model = "mvsplat"

    def __init__(
        self,
        config: MVSplatConfig | None = None,
        compat: Compat = "fixed",
        *,
        attention_precision: Precision = "float32",
    ) -> None:
        super().__init__()
        config = config or MVSplatConfig()
        self.config = config
        self.compat: Compat = compat
        self.attention_precision: Precision = attention_precision
        border = _choose_border(compat)
        channels, fine = config.channels, config.refine_width
        self.features = Features(config, compat, attention_precision)
        self.depth = SweptDepth(config, compat, attention_precision)
        self.upsampler = PanoramaConv2d(2 * channels, channels, 3, border=border)
        self.project = PanoramaConv2d(channels, fine, 3, border=border)
        self.refine = VolumeRefinement(3 + fine + 2, fine, border, attention_precision, scales=5)
        outputs = 2 + config.adapter.num_parameters
        self.to_gaussians = make_head(fine + 3 + channels, 2 * outputs, outputs, border)
        self.to_depth = make_head(fine, 2 * fine, 2, border)

    def match_views(self, images: Images, cam2world: Poses, near: PerView, far: PerView) -> MatchedViews:
        """Compute features and depths of all views at 1/4 scale."""
        require_views(images.shape[1], self.compat)
        height, width = images.shape[-2:]
        require_size(height, width, 16)
        features, encoded = self.features(images)
        swept = self.depth.regress(features, cam2world, near, far)
        return MatchedViews(images, features, encoded, Depths((swept,)), cam2world, near, far)

    def lift_gaussians(
        self, matched: MatchedViews, *, tiles: int = 1, only: Sequence[int] | None = None
    ) -> Iterator[TileGaussians]:
        """Yield all Gaussians at once; `tiles` and `only` have no effect because the U-Net reads whole panoramas."""
        views, swept = matched.images.shape[1], matched.depths.levels[-1]
        images = matched.images.flatten(0, 1)
        features = self.upsampler(torch.cat((matched.features, matched.encoded), dim=2).flatten(0, 1))
        features = gelu(upsample(features, _SCALE, self.compat))
        inverse_depth = upsample(swept.inverse_depth, _SCALE, self.compat).flatten(0, 1)
        confidence = interpolate(swept.confidence, scale_factor=_SCALE, mode="nearest").flatten(0, 1)
        maps = (images, self.project(features), inverse_depth[:, None], confidence[:, None])
        refined = self.refine(torch.cat(maps, dim=1).unflatten(0, (-1, views))).flatten(0, 1)
        poses, near, far = (tensor.flatten(0, 1) for tensor in (matched.cam2world, matched.near, matched.far))
        by_view = [
            self._lift_view(
                torch.cat((refined[i], images[i], features[i])),
                self.to_depth(refined[i : i + 1])[0],
                inverse_depth[i],
                (1 / far[i], 1 / near[i]),
                poses[i],
                i % views,
            )
            for i in range(len(images))
        ]
        items = [Gaussians.cat(by_view[start : start + views]) for start in range(0, len(images), views)]
        yield TileGaussians(items, torch.arange(len(items[0])))

    def _lift_view(
        self,
        maps: Float[Tensor, "channel height width"],
        corrections: Float[Tensor, "2 height width"],
        inverse_depth: Float[Tensor, "height width"],
        bounds: tuple[Float[Tensor, ""], Float[Tensor, ""]],
        cam2world: Float[Tensor, "4 4"],
        view: int,
    ) -> Gaussians:
        """One view's Gaussians, one for each pixel, in row-major order.

        Args:
            maps: input of `to_gaussians`.
            corrections: correction of the inverse depth, and opacity logit.
            bounds: smallest and largest inverse depth.
        """
        height = maps.shape[-2]
        outputs = self.to_gaussians(maps[None])[0].flatten(1).T.contiguous()
        offsets, parameters = outputs.split((2, self.config.adapter.num_parameters), dim=-1)
        correction, opacity_logits = corrections.flatten(1)
        uv = make_lattice_uv("pixel", height).to(maps.device)
        return adapt_gaussians(
            parameters,
            move_points(uv, offsets, "pixel", height),
            1 / (inverse_depth.flatten() + correction).clamp(*bounds),
            torch.sigmoid(opacity_logits),
            cam2world,
            map_height=height,
            colors=None,
            level=0,
            view=view,
            config=self.config.adapter,
            compat=self.compat,
        )


class Features(nn.Module):
    """Features of all views at 1/4 scale: outputs of the transformer and of the encoder."""

    def __init__(self, config: MVSplatConfig, compat: Compat, precision: Precision) -> None:
        super().__init__()
        self.encoder = Encoder(config.channels, _choose_border(compat))
        self.transformer = Transformer(config.transformer, compat, precision)

    def forward(
        self, images: Images
    ) -> tuple[Float[Tensor, "batch view channel h w"], Float[Tensor, "batch view channel h w"]]:
        encoded = self.encoder(normalize(images.flatten(0, 1))).unflatten(0, images.shape[:2])
        return self.transformer(encoded), encoded


class Encoder(nn.Module):
    """A CNN to 1/4 scale with instance normalisation.

    Source: UniMatch, https://arxiv.org/abs/2211.05783.
    """

    def __init__(self, channels: int, border: Border) -> None:
        super().__init__()
        self.stem = PanoramaConv2d(3, _ENCODER_CHANNELS[0], 7, stride=2, bias=False, border=border)
        before = (_ENCODER_CHANNELS[0], *_ENCODER_CHANNELS)
        self.blocks = nn.ModuleList(
            ResidualBlock(before[i], after, stride=2 if i == 2 else 1, border=border)
            for i, after in enumerate(_ENCODER_CHANNELS)
        )
        self.exit = nn.Conv2d(_ENCODER_CHANNELS[-1], channels, 1)

    def forward(self, images: Float[Tensor, "image 3 height width"]) -> Float[Tensor, "image channel h w"]:
        maps = relu(instance_norm(self.stem(images)))
        for block in self.blocks:
            maps = block(maps)
        return self.exit(maps)


class ResidualBlock(nn.Module):
    """Two convolutions with instance normalisation, plus a shortcut."""

    def __init__(self, inputs: int, outputs: int, *, stride: int, border: Border) -> None:
        super().__init__()
        self.conv1 = PanoramaConv2d(inputs, outputs, 3, stride=stride, bias=False, border=border)
        self.conv2 = PanoramaConv2d(outputs, outputs, 3, bias=False, border=border)
        self.shortcut = nn.Identity()
        if inputs != outputs:
            self.shortcut = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride=stride), nn.InstanceNorm2d(outputs))

    def forward(self, maps: Maps) -> Float[Tensor, "image c h w"]:
        """Maps of `outputs` channels; their sides are divided by the stride."""
        inner = relu(instance_norm(self.conv1(maps)))
        inner = relu(instance_norm(self.conv2(inner)))
        return relu(self.shortcut(maps) + inner)


class SweptDepth(LevelRefinement):
    """Inverse depth from a cost volume at 1/4 scale."""

    def __init__(self, config: MVSplatConfig, compat: Compat, precision: Precision) -> None:
        sweep = SweepLevel(2, config.channels, config.candidates, config.width)
        border, without_mono = _choose_border(compat), CostVolumeConfig(mono_channels=0)
        super().__init__(sweep, without_mono, first=True, compat=compat, precision=precision, border=border)
        self.candidates = config.candidates

    def regress(self, features: ViewMaps, cam2world: Poses, near: PerView, far: PerView) -> LevelDepth:
        """The inverse depth of all views, from their features at 1/4 scale."""
        height, width = features.shape[-2:]
        candidates = make_first_candidates((1 / far, 1 / near), self.candidates, (height, width))
        volume = correlate_views(features, candidates, cam2world, self.compat)
        return regress_depth(2, self(volume, features, None, None), candidates)


def _choose_border(compat: Compat) -> Border:
    return "sphere" if compat == "fixed" else "zeros"
