"""ALIKED: keypoints of an image, and descriptors that deform with the surface.

A pyramid of four levels gives each pixel 128 features. A head scores the pixels as keypoints; local maxima are refined
below a pixel. The descriptor of a keypoint aggregates features at 16 positions that the network chooses around it.

The features of a pixel are computed for the pixels that a descriptor needs, and the score head's first layer acts on
the levels before they are enlarged. Both give the numbers of the full map, with a tenth of its memory.

Source: X. Zhao et al., ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable Transformation,
IEEE TIM 2023 (aliked-n16); J. Dai et al., Deformable Convolutional Networks, ICCV 2017. Batch normalisation is part of
the convolutions' weights (assets/recipe/homes/pansplat_homes/matcher.py).
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from pansplat.model.layers import to_channels_last

_CHANNELS = (16, 32, 64, 128)  # channels of the levels
_STRIDES = (1, 2, 8, 32)  # pixels; steps of the levels
_LEVEL_FEATURES = 32  # features of a pixel that each level gives
DESCRIPTOR = 4 * _LEVEL_FEATURES
_SAMPLES = 16  # positions in the image that a descriptor is made of
_RADIUS = 2  # pixels; a keypoint has the largest score within this distance
_TEMPERATURE = 0.1  # temperature of the softmax of the scores around a keypoint, which gives its position
_MAX_OFFSET = 0.25  # largest offset of a deformed kernel, relative to the image's longer side

Levels = list[Float[Tensor, "1 32 _ _"]]
"""Features of the four levels at their own resolution; a pixel's features are all four, interpolated."""


class DeformedConv(nn.Module):
    """A convolution of 3x3 whose nine samples are displaced by offsets that another convolution predicts."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.offset = nn.Conv2d(channels, 18, 3, padding=1)
        self.conv = nn.Conv2d(channels, out, 3, padding=1)

    def forward(self, maps: Float[Tensor, "image channel h w"]) -> Float[Tensor, "image out h w"]:
        count, channels, height, width = maps.shape
        limit = _MAX_OFFSET * max(height, width)
        offset = self.offset(maps).clamp(-limit, limit).unflatten(1, (9, 2))  # offset of each sample: y, x
        rows = torch.arange(height, dtype=maps.dtype, device=maps.device)[:, None]
        columns = torch.arange(width, dtype=maps.dtype, device=maps.device)
        tap = torch.arange(9, dtype=torch.long, device=maps.device)[:, None, None]
        y, x = rows + (tap // 3 - 1) + offset[:, :, 0], columns + (tap % 3 - 1) + offset[:, :, 1]
        grid = torch.stack((2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1), dim=-1)  # image 9 h w 2
        samples = functional.grid_sample(maps, grid.flatten(1, 2), align_corners=True)  # image channel 9*h w
        samples = samples.view(count, channels * 9, height, width)
        return functional.conv2d(samples, self.conv.weight.flatten(1)[:, :, None, None], self.conv.bias)


class _Block(nn.Module):
    """Two convolutions, with a shortcut on all levels but the finest."""

    def __init__(self, level: int) -> None:
        super().__init__()
        before, after = _CHANNELS[level - 1] if level else 3, _CHANNELS[level]
        if level < 2:
            self.first: nn.Module = nn.Conv2d(before, after, 3, padding=1)
            self.second: nn.Module = nn.Conv2d(after, after, 3, padding=1)
        else:
            self.first, self.second = DeformedConv(before, after), DeformedConv(after, after)
        self.shortcut = nn.Conv2d(before, after, 1) if level else None

    def forward(self, maps: Tensor) -> Tensor:
        inner = self.second(functional.selu(self.first(maps)))
        return functional.selu(inner if self.shortcut is None else inner + self.shortcut(maps))


class Aliked(nn.Module):
    """The network aliked-n16, for one image at a time."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(_Block(level) for level in range(4))
        self.reduce = nn.ModuleList(nn.Conv2d(c, _LEVEL_FEATURES, 1, bias=False) for c in _CHANNELS)
        self.score = nn.ModuleList(
            nn.Conv2d(before, after, size, padding=size // 2, bias=False)
            for before, after, size in ((DESCRIPTOR, 8, 1), (8, 4, 3), (4, 4, 3), (4, 1, 3))
        )
        self.offset = nn.ModuleList((nn.Conv2d(DESCRIPTOR, 2 * _SAMPLES, 3), nn.Linear(32, 2 * _SAMPLES)))
        self.mix = nn.Linear(DESCRIPTOR, DESCRIPTOR, bias=False)
        self.aggregate = nn.Parameter(torch.zeros(_SAMPLES, DESCRIPTOR, DESCRIPTOR))

    def forward(
        self, image: Float[Tensor, "3 h w"], allowed: Bool[Tensor, "h w"], count: int
    ) -> tuple[Float[Tensor, "keypoint 2"], Float[Tensor, "keypoint 128"]]:
        """Keypoints and unit descriptors, strongest first.

        Args:
            image: RGB in [0, 1]; the sides are multiples of 32.
            allowed: pixels where a keypoint may be.
            count: largest number of keypoints.

        Returns:
            Positions x, y in pixels, 0 at the centre of the first one, and descriptors.
        """
        levels = self.extract(image)
        points = find_keypoints(self.score_pixels(levels), allowed, count)
        return points, self.describe(levels, points)

    def extract(self, image: Float[Tensor, "3 h w"]) -> Levels:
        """The features of the four levels."""
        maps, levels = to_channels_last(image[None]), []
        for level, (block, reduce) in enumerate(zip(self.blocks, self.reduce, strict=True)):
            if level:
                maps = functional.avg_pool2d(maps, _STRIDES[level] // _STRIDES[level - 1])
            maps = block(maps)
            levels.append(functional.selu(reduce(maps)))
        return levels

    def score_pixels(self, levels: Levels) -> Float[Tensor, "h w"]:
        """Scores of all pixels as keypoints, in [0, 1]."""
        size = levels[0].shape[-2:]
        parts = self.score[0].get_parameter("weight").split(_LEVEL_FEATURES, dim=1)
        maps = torch.zeros(1, 8, *size, device=levels[0].device)
        for level, part in zip(levels, parts, strict=True):
            maps += functional.interpolate(functional.conv2d(level, part), size, mode="bilinear", align_corners=True)
        for layer in self.score[1:]:
            maps = layer(functional.selu(maps))
        return torch.sigmoid(maps[0, 0])

    def describe(self, levels: Levels, points: Float[Tensor, "keypoint 2"]) -> Float[Tensor, "keypoint 128"]:
        """Unit descriptors of keypoints."""
        height, width = levels[0].shape[-2:]
        steps = torch.arange(3, device=points.device) - 1
        square = torch.stack((steps.repeat(3), steps.repeat_interleave(3)), dim=-1)  # x, y of 3x3 pixels
        centre = points.long().clamp(min=1).minimum(torch.tensor((width - 3, height - 3), device=points.device))
        around = _pixel_features(levels, (centre[:, None] + square).flatten(0, 1)).unflatten(0, (-1, 9))
        offset = functional.selu(self.offset[0](around.mT.unflatten(2, (3, 3)))[:, :, 0, 0])
        limit = _MAX_OFFSET * max(height, width)
        offset = self.offset[1](offset).clamp(-limit, limit).unflatten(1, (2, _SAMPLES)).mT
        positions = (points[:, None] + offset).flatten(0, 1)
        corner = positions.floor()
        x, y = (positions - corner).unbind(dim=1)
        samples = torch.zeros(len(positions), DESCRIPTOR, device=points.device)
        for step_x, step_y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            weight = (x if step_x else 1 - x) * (y if step_y else 1 - y)
            pixels = corner.long() + torch.tensor((step_x, step_y), device=points.device)
            samples += weight[:, None] * _pixel_features(levels, pixels)
        samples = functional.selu(self.mix(samples)).view(len(points), _SAMPLES * DESCRIPTOR)
        return functional.normalize(samples @ self.aggregate.flatten(0, 1), dim=1)


def _pixel_features(levels: Levels, pixels: Int[Tensor, "n 2"]) -> Float[Tensor, "n 128"]:
    """Unit features of pixels x, y; zero outside the image."""
    height, width = levels[0].shape[-2:]
    x, y = pixels.unbind(dim=1)
    grid = torch.stack((2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1), dim=-1)[None, None]
    fine = levels[0][0, :, y.clamp(0, height - 1), x.clamp(0, width - 1)]
    coarse = [functional.grid_sample(level, grid, align_corners=True)[0, :, 0] for level in levels[1:]]
    features = functional.normalize(torch.cat((fine, *coarse)).T, dim=1)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return features * inside[:, None]


def find_keypoints(
    scores: Float[Tensor, "h w"], allowed: Bool[Tensor, "h w"], count: int
) -> Float[Tensor, "keypoint 2"]:
    """Positions of the highest local maxima, x, y in pixels, highest first.

    The position is the mean of the 5x5 pixels around the maximum, weighted by the exponential of their scores.
    """
    width = scores.shape[1]
    inner = torch.zeros_like(allowed)
    inner[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS] = allowed[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]
    peaks = torch.where(_local_maxima(scores) & inner, scores, 0.0).flatten()
    places = peaks.nonzero()[:, 0]
    index = places[peaks[places].argsort(descending=True, stable=True)[:count]]  # equal scores keep the order of places
    steps = torch.arange(-_RADIUS, _RADIUS + 1, device=scores.device)
    square = torch.stack((steps.repeat(5), steps.repeat_interleave(5)), dim=-1)
    around = scores.flatten()[index[:, None] + square[:, 0] + width * square[:, 1]]
    centre = torch.stack((index % width, index // width), dim=1)
    return centre + torch.softmax(around / _TEMPERATURE, dim=1) @ square.to(scores)


def _local_maxima(scores: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Pixels with the highest score in their square, and those that are it after the others' squares are cleared."""

    def spread(maps: Tensor) -> Tensor:
        size = 2 * _RADIUS + 1
        rows = functional.max_pool2d(maps[None], (1, size), stride=1, padding=(0, _RADIUS))
        return functional.max_pool2d(rows, (size, 1), stride=1, padding=(_RADIUS, 0))[0]

    found = scores == spread(scores)
    for _ in range(2):
        cleared = spread(found.to(scores)) > 0
        left = torch.where(cleared, 0.0, scores)
        found |= (left == spread(left)) & ~cleared
    return found
