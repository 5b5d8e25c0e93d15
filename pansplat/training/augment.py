"""Random augmentation of samples: images, poses, masks and depth change consistently.

A rotated panorama is the image of a rotated camera, so its pose is rotated too. A mirrored panorama is the image of the
mirrored world. Radial depth is moved, never interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from pansplat.geometry.equirect import pixel_directions, sample_equirect, uv_from_directions
from pansplat.inputs.views import Sample, Views

_MIRROR = torch.diag(torch.tensor((-1.0, 1.0, 1.0, 1.0), dtype=torch.float64))


@dataclass(frozen=True)
class Augmentation:
    """Kinds and strengths of augmentation."""

    yaw: Literal["off", "shared", "each"] = "shared"
    """Rotation about the vertical camera axes by whole pixels: one for all views of a sample, or one for each view."""
    mirror: Literal["off", "half"] = "half"
    """Mirror a sample with probability 1/2."""
    tilt_degrees: Annotated[float, Meta(ge=0, le=180)] = 0.0
    """Largest tilt of each view off its vertical axis; resamples the images."""
    colour: Annotated[float, Meta(ge=0, le=1)] = 0.1
    """Strength of changes of brightness, contrast, hue and gamma, the same for all views; 0 for none."""
    exposure: Annotated[float, Meta(ge=0, le=10)] = 0.0
    """Largest difference in exposure between views, in stops; 0 for none."""


def augment(sample: Sample, settings: Augmentation, generator: np.random.Generator) -> Sample:
    """Change a sample at random. Its geometry stays consistent."""
    views, targets = sample.context, sample.targets
    width = views.images.shape[-1]
    shared = int(generator.integers(width))
    mirrored = settings.mirror == "half" and generator.random() < 0.5
    change = _sample_colour_change(settings.colour, generator)

    def augment_views(part: Views) -> Views:
        if mirrored:
            part = mirror_views(part)
        count = len(part.images)
        if settings.tilt_degrees > 0:
            part = rotate_views(part, _sample_tilts(count, settings.tilt_degrees, generator))
        if settings.yaw != "off":
            each = generator.integers(width, size=count).tolist()
            part = roll_views(part, [shared] * count if settings.yaw == "shared" else each)
        images = _change_colour(part.images, change)
        if settings.exposure > 0:
            stops = generator.uniform(-settings.exposure / 2, settings.exposure / 2, size=count)
            images = images * torch.from_numpy(2**stops).float()[:, None, None, None]
        return replace(part, images=images.clamp(0, 1))

    return Sample(sample.name, augment_views(views), augment_views(targets))


def roll_views(views: Views, columns: list[int]) -> Views:
    """Rotate cameras about their vertical axes: pixels move right by whole columns."""
    width = views.images.shape[-1]
    angles = torch.tensor(columns, dtype=torch.float64) * (-2 * math.pi / width)

    def roll(maps: Tensor) -> Tensor:
        return torch.stack([m.roll(c, dims=-1) for m, c in zip(maps, columns, strict=True)]) if columns else maps

    return _replace_maps(views, roll, _rotate(views.cam2world, _rotations_about_y(angles)))


def mirror_views(views: Views) -> Views:
    """Mirror the world at its plane x = 0; left and right are exchanged in each image."""
    return _replace_maps(views, lambda maps: maps.flip(-1), _MIRROR @ views.cam2world @ _MIRROR)


def rotate_views(views: Views, rotations: Float[Tensor, "view 3 3"]) -> Views:
    """Rotate cameras by `rotations` (new camera axes in old camera axes).

    Images are resampled bilinearly, depth and masks by nearest neighbour.
    """
    height, width = views.images.shape[-2:]
    rays = pixel_directions(height, width, dtype=torch.float64)
    images, masks, depths = [], [], []
    for i, rotation in enumerate(rotations):
        uv = uv_from_directions(rays @ rotation.T)
        images.append(sample_equirect(views.images[i], uv))
        row = (uv[..., 1] * height).long().clamp(0, height - 1)
        column = (uv[..., 0] * width).long().remainder(width)
        masks.append(views.masks[i][row, column])
        if views.depths is not None:
            depths.append(views.depths[i][row, column])
    if not images:
        return views
    return replace(
        views,
        images=torch.stack(images),
        masks=torch.stack(masks),
        depths=torch.stack(depths) if depths else None,
        cam2world=_rotate(views.cam2world, rotations),
    )


def _replace_maps(views: Views, change: Callable[[Tensor], Tensor], cam2world: Float[Tensor, "view 4 4"]) -> Views:
    """The views with changed images, masks and depths, and with other poses."""
    depths = None if views.depths is None else change(views.depths)
    return replace(views, images=change(views.images), masks=change(views.masks), depths=depths, cam2world=cam2world)


def _rotate(cam2world: Float[Tensor, "view 4 4"], rotations: Float[Tensor, "view 3 3"]) -> Float[Tensor, "view 4 4"]:
    rotated = cam2world.clone()
    rotated[:, :3, :3] = cam2world[:, :3, :3] @ rotations
    return rotated


def _rotations_about_y(angles: Float[Tensor, "view"]) -> Float[Tensor, "view 3 3"]:
    """Rotations by angles in radians; +z moves towards +x."""
    sine, cosine, zero, one = angles.sin(), angles.cos(), torch.zeros_like(angles), torch.ones_like(angles)
    rows = (cosine, zero, sine, zero, one, zero, -sine, zero, cosine)
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def _sample_tilts(count: int, max_degrees: float, generator: np.random.Generator) -> Float[Tensor, "view 3 3"]:
    """Rotations about random horizontal axes."""
    angle = torch.from_numpy(np.radians(generator.uniform(0, max_degrees, size=count)))
    azimuth = torch.from_numpy(generator.uniform(0, 2 * np.pi, size=count))
    turn = _rotations_about_y(azimuth)
    sine, cosine, zero, one = angle.sin(), angle.cos(), torch.zeros_like(angle), torch.ones_like(angle)
    pitch = torch.stack((one, zero, zero, zero, cosine, -sine, zero, sine, cosine), dim=-1).reshape(-1, 3, 3)
    return turn @ pitch @ turn.transpose(-1, -2)


@dataclass(frozen=True)
class _ColourChange:
    gamma: float
    contrast: float
    matrix: Float[Tensor, "3 3"]
    offset: Float[Tensor, "3"]


def _sample_colour_change(strength: float, generator: np.random.Generator) -> _ColourChange:
    """Random gains and mixing of the channels, gamma, contrast about mid-grey, and offset."""
    gains = np.exp(generator.normal(0, strength, size=3) * 0.5 + generator.normal(0, strength))
    mixing = generator.normal(0, 0.3 * strength, size=(3, 3))
    np.fill_diagonal(mixing, 0)
    matrix = np.diag(gains) @ (np.eye(3) + mixing - np.diag(mixing.sum(axis=1)))
    gamma, contrast = np.exp(generator.normal(0, strength, size=2))
    offset = generator.normal(0, 0.2 * strength, size=3)
    matrix, offset = (torch.from_numpy(values).float() for values in (matrix, offset))
    return _ColourChange(float(gamma), float(contrast), matrix, offset)


def _change_colour(images: Float[Tensor, "view 3 h w"], change: _ColourChange) -> Float[Tensor, "view 3 h w"]:
    mixed = torch.einsum("ij,njhw->nihw", change.matrix, images.clamp_min(0) ** change.gamma)
    return (mixed - 0.5) * change.contrast + 0.5 + change.offset[:, None, None]
