"""Multi-level features of the panoramas: an encoder, attention across views at the coarsest level, a decoder.

Source: PanSplat, section 3.1 and Figure 3 (the feature pyramid network); OFFICIAL.md, section 4.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pansplat.geometry.equirect import Border
from pansplat.model.layers import (
    AttentionPrecision,
    Compat,
    PanoramaConv2d,
    Precision,
    border_of,
    convolving,
    normalized_convolution,
    require_size,
    require_views,
    to_channels_last,
    upsample,
)
from pansplat.model.transformer import Transformer, TransformerConfig

# Mean and standard deviation of ImageNet's colours.
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class FeaturePyramidConfig:
    """Shape of the feature pyramid; shipped weights fix all of it."""

    channels: tuple[int, int, int, int] = (32, 64, 96, 128)
    """Of levels 0 (finest) to 3."""
    transformer: TransformerConfig = field(default_factory=TransformerConfig)


class FeaturePyramid(nn.Module):
    """Features of levels 3 to 0, at 1/8 to 1/1 of the image; paper's F^l."""

    def __init__(
        self,
        config: FeaturePyramidConfig,
        compat: Compat,
        attention_precision: AttentionPrecision = "float32",
        precision: Precision = "float32",
    ) -> None:
        super().__init__()
        self.compat: Compat = compat
        self.precision: Precision = precision
        self.encoder = Encoder(config.channels, border_of(compat))
        self.transformer = Transformer(config.transformer, compat, attention_precision)
        self.decoder = Decoder(config.channels, compat)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # convolves faster

    def forward(self, images: Float[Tensor, "batch view 3 height width"]) -> list[Float[Tensor, "batch view _ _ _"]]:
        """Features of all views, coarse to fine, of RGB images in [0, 1].

        Raises:
            InputError: too few views (or too many for the original), or a size that 16 (fixed: 32) does not divide.
        """
        batch_and_view = images.shape[:2]
        require_views(images.shape[1], self.compat)
        height, width = images.shape[-2:]
        require_size(height, width, 32 if self.compat == "fixed" else 16)
        with convolving(self.precision, images.device):
            fine_to_coarse = self.encoder(normalize(images.flatten(0, 1)))
            coarsest = fine_to_coarse[-1].unflatten(0, batch_and_view).to(images.dtype)
            refined = to_channels_last(self.transformer(coarsest).flatten(0, 1))
            coarse_to_fine = self.decoder(refined, fine_to_coarse[:-1])
        return [features.unflatten(0, batch_and_view).to(images.dtype) for features in coarse_to_fine]


class Encoder(nn.Module):
    """Convolutions that halve the map from level to level."""

    def __init__(self, channels: tuple[int, int, int, int], border: Border) -> None:
        super().__init__()
        c0, c1, c2, c3 = channels
        self.levels = nn.ModuleList(
            (
                nn.Sequential(ConvNormAct(3, c0, 7, border), ConvNormAct(c0, c0, 5, border)),
                _halving_level(c0, c1, 5, border),
                _halving_level(c1, c2, 5, border),
                _halving_level(c2, c3, 3, border),
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
    """Coarse maps flow down to the finer levels, where the encoder's maps join them."""

    def __init__(self, channels: tuple[int, int, int, int], compat: Compat) -> None:
        super().__init__()
        self.compat: Compat = compat
        *finer, width = channels
        border = border_of(compat)
        self.laterals = nn.ModuleList(nn.Conv2d(c, width, 1) for c in finer)
        self.outputs = nn.ModuleList([LevelOutput(width, c, 3, border) for c in finer])
        self.outputs.append(LevelOutput(width, width, 1, border))

    def forward(
        self,
        coarsest: Float[Tensor, "image channel height width"],
        fine_to_coarse: list[Float[Tensor, "image _ _ _"]],
    ) -> list[Float[Tensor, "image _ _ _"]]:
        """Features of levels 3 to 0, coarse to fine, of the coarsest map and the encoder's maps of levels 0 to 2."""
        if self.training:
            return self._decode(coarsest, fine_to_coarse)
        # Outside training no image depends on another; the widest maps are held for one at a time.
        images = [
            self._decode(coarsest[i : i + 1], [maps[i : i + 1] for maps in fine_to_coarse])
            for i in range(coarsest.shape[0])
        ]
        return [torch.cat(level) for level in zip(*images, strict=True)]

    def _decode(self, coarsest: Tensor, fine_to_coarse: list[Tensor]) -> list[Tensor]:
        flow = coarsest
        features = [self.outputs[-1](flow)]
        for level in (2, 1, 0):
            flow = upsample(flow, 2, self.compat).add_(self.laterals[level](fine_to_coarse[level]))
            features.append(self.outputs[level](flow))
        return features


class ConvNormAct(nn.Module):
    """Convolution without bias, batch normalisation, leaky ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int, border: Border, stride: int = 1) -> None:
        super().__init__()
        self.conv = PanoramaConv2d(inputs, outputs, kernel, stride=stride, bias=False, border=border)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, maps: Float[Tensor, "image channel height width"]) -> Float[Tensor, "image c h w"]:
        return nn.functional.leaky_relu(normalized_convolution(self.conv, self.norm, maps), 0.1, inplace=True)


class LevelOutput(nn.Module):
    """Convolution, batch normalisation, SiLU: from the decoder's flow to a level's features."""

    def __init__(self, inputs: int, outputs: int, kernel: int, border: Border) -> None:
        super().__init__()
        self.conv = PanoramaConv2d(inputs, outputs, kernel, border=border)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, flow: Float[Tensor, "image channel height width"]) -> Float[Tensor, "image c height width"]:
        made = normalized_convolution(self.conv, self.norm, flow)
        return made * made.sigmoid()  # as the original writes SiLU: torch's own rounds otherwise


def normalize(images: Float[Tensor, "image 3 height width"]) -> Float[Tensor, "image 3 height width"]:
    """Colours less ImageNet's mean, in its standard deviations."""
    mean, std = (torch.tensor(values).to(images)[:, None, None] for values in (_MEAN, _STD))
    return (images - mean) / std


def _halving_level(inputs: int, outputs: int, kernel: int, border: Border) -> nn.Sequential:
    return nn.Sequential(
        ConvNormAct(inputs, outputs, kernel, border, stride=2),
        ConvNormAct(outputs, outputs, 3, border),
        ConvNormAct(outputs, outputs, 3, border),
    )
