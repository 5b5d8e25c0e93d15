"""LPIPS: how different two pictures look, as the activations of an image classifier tell.

The classifiers (VGG-16, AlexNet, SqueezeNet 1.1) and the weights of their channels are read from the user's files;
nothing is fetched. Layers are numbered as torchvision numbers them, so that its files fit.

Source: Zhang et al., The unreasonable effectiveness of deep features as a perceptual metric, CVPR 2018, equation 1;
version 0.1 of its weights. OFFICIAL.md, sections 11 and 13: the paper's figures are those of VGG.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.evaluation.lpips_bands import banded_distances, distances

Backbone = Literal["vgg", "alex", "squeeze"]

SMALLEST = 32
"""Pixels that a picture must have along each side, or nothing is left for the last layers."""

# What the classifiers were trained on, for pictures in [-1, 1].
_MEAN = (-0.030, -0.088, -0.188)
_DEVIATION = (0.458, 0.448, 0.450)
# Pictures of more pixels are looked at in bands of so many by VGG, whose activations are the largest.
_WHOLE, _BAND = 1 << 19, 1 << 18

_VGG = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512)  # outputs; 0 is a pooling
# inputs, squeezed, expanded by each of two; 0 is a pooling
_SQUEEZE = ((64, 16, 64), (128, 16, 64), 0, (128, 32, 128), (256, 32, 128), 0, (256, 48, 192), (384, 48, 192))

# Layers whose activations are compared, and how many channels they have.
TAPS: dict[Backbone, dict[int, int]] = {
    "vgg": {3: 64, 8: 128, 15: 256, 22: 512, 29: 512},
    "alex": {1: 64, 4: 192, 7: 384, 9: 256, 11: 256},
    "squeeze": {1: 64, 4: 128, 7: 256, 9: 384, 10: 384, 11: 512, 12: 512},
}


class Lpips(nn.Module):
    """The metric with its weights, all fixed; differentiable in the pictures.

    Args:
        backbone: which classifier.
    """

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone: Backbone = backbone
        self.name = f"lpips-{backbone}"
        self.features = _LAYERS[backbone]()
        self.heads = nn.ParameterList(torch.zeros(channels) for channels in TAPS[backbone].values())
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> Lpips:
        """Stays as it is: a yardstick does not learn."""
        return super().train(False)

    def forward(
        self,
        prediction: Float[Tensor, "batch 3 height width"],
        target: Float[Tensor, "batch 3 height width"],
        weights: Float[Tensor, "batch height width"] | None = None,
    ) -> Float[Tensor, "batch"]:
        """The distance of each pair of pictures; 0 for equal ones.

        Args:
            prediction, target: RGB in [0, 1]; values outside are taken as they are.
            weights: how much each pixel counts; by default all alike. A pixel of weight 0 has no part at all: what
                `prediction` shows there is not looked at.

        Raises:
            InputError: when the pictures are too small for the classifier.
        """
        if min(target.shape[-2:]) < SMALLEST:
            size = "x".join(str(side) for side in target.shape[-2:])
            raise InputError(
                f"LPIPS needs pictures of {SMALLEST} pixels or more along each side, got {size}; "
                "choose a larger height, or do without LPIPS"
            )
        if weights is not None:
            prediction = torch.where(weights[:, None] > 0, prediction, target)
        total = target.new_zeros(len(target))
        for apart in self._distances(self._normalized(prediction), self._normalized(target)):
            total = total + _mean(apart, weights)
        return total

    @torch.no_grad()
    def of_pictures(
        self, prediction: Float[Tensor, "3 height width"], target: Float[Tensor, "3 height width"]
    ) -> float:
        """The distance of two single pictures, as a figure."""
        return float(self(prediction[None], target[None]))

    def _distances(self, a: Tensor, b: Tensor) -> Iterator[Float[Tensor, "batch _ _"]]:
        """One map a layer that is compared."""
        if self.backbone == "vgg" and a.shape[-2] * a.shape[-1] > _WHOLE:
            return banded_distances(a, b, self.features, self.heads, _BAND)
        activations = (self._activations(maps) for maps in (a, b))
        return (distances(*pair, head) for head, *pair in zip(self.heads, *activations, strict=True))

    def _normalized(self, images: Tensor) -> Tensor:
        mean, deviation = (images.new_tensor(values)[:, None, None] for values in (_MEAN, _DEVIATION))
        return (2 * images - 1 - mean) / deviation

    def _activations(self, maps: Tensor) -> list[Tensor]:
        kept = []
        for index, layer in enumerate(self.features):
            maps = layer(maps)
            if index in TAPS[self.backbone]:
                kept.append(maps)
        return kept


def _mean(
    maps: Float[Tensor, "batch h w"], weights: Float[Tensor, "batch height width"] | None
) -> Float[Tensor, "batch"]:
    """Mean over the pixels of a layer, each counting as much as the pixels it stands for."""
    if weights is None:
        return maps.mean(dim=(1, 2))
    counted = functional.adaptive_avg_pool2d(weights[:, None].to(maps), (maps.shape[-2], maps.shape[-1]))[:, 0]
    return (maps * counted).sum(dim=(1, 2)) / counted.sum(dim=(1, 2)).clamp_min(torch.finfo(maps.dtype).tiny)


class _Fire(nn.Module):
    """Fewer channels by a 1x1 convolution, then more by a 1x1 and a 3x3 one side by side."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        few = functional.relu(self.squeeze(maps))
        return functional.relu(torch.cat((self.expand1x1(few), self.expand3x3(few)), dim=1))


def _vgg() -> nn.Sequential:
    layers: list[nn.Module] = []
    inputs = 3
    for outputs in _VGG:
        if outputs == 0:
            layers.append(nn.MaxPool2d(2))
            continue
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
        inputs = outputs
    return nn.Sequential(*layers)


def _alex() -> nn.Sequential:
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    )


def _squeeze() -> nn.Sequential:
    layers: list[nn.Module] = [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), nn.MaxPool2d(3, 2, ceil_mode=True)]
    for shape in (*_SQUEEZE, (384, 64, 256), (512, 64, 256)):
        layers.append(_Fire(*shape) if isinstance(shape, tuple) else nn.MaxPool2d(3, 2, ceil_mode=True))
    return nn.Sequential(*layers)


_LAYERS = {"vgg": _vgg, "alex": _alex, "squeeze": _squeeze}
