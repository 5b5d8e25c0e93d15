"""Random augmentation of samples: images, poses, masks and depth change consistently.

A rotated panorama is the image of a rotated camera, so its pose is rotated too. A mirrored panorama is the image of the
mirrored world.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.inputs.views import Sample, Views

_COLOUR = 0.1  # scale of random changes of brightness, contrast, hue and gamma
_MIRROR = torch.diag(torch.tensor((-1.0, 1.0, 1.0, 1.0), dtype=torch.float64))


def augment(sample: Sample, generator: np.random.Generator) -> Sample:
    """Change a sample at random, all its views alike: yaw, in half of the samples left and right, and colours."""
    columns = int(generator.integers(sample.context.images.shape[-1]))
    is_mirrored = generator.random() < 0.5
    change_colour = _sample_colour_change(generator)

    def augment_views(views: Views) -> Views:
        if is_mirrored:
            views = mirror_views(views)
        views = roll_views(views, [columns] * len(views.images))
        return replace(views, images=change_colour(views.images).clamp(0, 1))

    return Sample(sample.name, augment_views(sample.context), augment_views(sample.targets))


def roll_views(views: Views, columns: list[int]) -> Views:
    """Rotate cameras about their vertical axes: pixels move right by whole columns."""
    width = views.images.shape[-1]
    angles = torch.tensor(columns, dtype=torch.float64) * (-2 * math.pi / width)  # forward, +z, moves towards +x
    sine, cosine, zero, one = angles.sin(), angles.cos(), torch.zeros_like(angles), torch.ones_like(angles)
    rotations = torch.stack((cosine, zero, sine, zero, one, zero, -sine, zero, cosine), dim=-1).reshape(-1, 3, 3)
    cam2world = views.cam2world.clone()
    cam2world[:, :3, :3] = cam2world[:, :3, :3] @ rotations

    def roll(maps: Tensor) -> Tensor:
        return torch.stack([m.roll(c, dims=-1) for m, c in zip(maps, columns, strict=True)]) if columns else maps

    return _replace_maps(views, roll, cam2world)


def mirror_views(views: Views) -> Views:
    """Mirror the world at its plane x = 0; left and right are exchanged in each image."""
    return _replace_maps(views, lambda maps: maps.flip(-1), _MIRROR @ views.cam2world @ _MIRROR)


def _replace_maps(views: Views, change: Callable[[Tensor], Tensor], cam2world: Float[Tensor, "view 4 4"]) -> Views:
    """The views with changed images, masks, depths and holes, and with other poses."""
    maps = {name: getattr(views, name) for name in ("images", "masks", "depths", "holes")}
    return replace(views, cam2world=cam2world, **{n: None if m is None else change(m) for n, m in maps.items()})


def _sample_colour_change(
    generator: np.random.Generator,
) -> Callable[[Float[Tensor, "view 3 h w"]], Float[Tensor, "view 3 h w"]]:
    """A change of images: random gains and mixing of the channels, gamma, contrast about mid-grey, and offset."""
    gains = np.exp(generator.normal(0, _COLOUR, size=3) * 0.5 + generator.normal(0, _COLOUR))
    mixing = generator.normal(0, 0.3 * _COLOUR, size=(3, 3))
    np.fill_diagonal(mixing, 0)
    matrix = torch.from_numpy(np.diag(gains) @ (np.eye(3) + mixing - np.diag(mixing.sum(axis=1)))).float()
    gamma, contrast = np.exp(generator.normal(0, _COLOUR, size=2)).tolist()
    offset = torch.from_numpy(generator.normal(0, 0.2 * _COLOUR, size=3)).float()

    def change(images: Tensor) -> Tensor:
        mixed = torch.einsum("ij,njhw->nihw", matrix, images.clamp_min(0) ** gamma)
        return (mixed - 0.5) * contrast + 0.5 + offset[:, None, None]

    return change
