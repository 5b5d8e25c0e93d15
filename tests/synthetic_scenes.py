"""Gaussians for tests: round or flat ones at given places, the walls of a box room that a camera sees; poses, noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.geometry.pose import rotations_from_quats


def make_balls(
    means: Float[Tensor, "n 3"],
    size: float | Tensor,
    opacity: float | Tensor = 0.9,
    *,
    color: Tensor | None = None,
    harmonics: Tensor | None = None,
    levels: int | Tensor = 0,
    views: int | Tensor = 0,
) -> Gaussians:
    """Gaussians in float32 that are not turned.

    Args:
        means: centres.
        size: scales, of all, of each (n 1), of each axis (3) or of both (n 3).
        opacity: of all or of each.
        color: (n 3), from 0 to 1, instead of `harmonics`; without both they are grey.
        levels, views: of all or of each.
    """
    count = len(means)
    if color is not None:
        harmonics = ((color.float() - 0.5) / SH_0)[:, None]
    return Gaussians(
        means=means.float(),
        scales=torch.as_tensor(size, dtype=torch.float32).expand(count, 3).clone(),
        quats=torch.tensor((1.0, 0, 0, 0)).repeat(count, 1),
        opacities=torch.as_tensor(opacity, dtype=torch.float32).expand(count).clone(),
        harmonics=torch.zeros(count, 1, 3) if harmonics is None else harmonics,
        levels=torch.as_tensor(levels).expand(count).clone(),
        views=torch.as_tensor(views).expand(count).clone(),
    )


def see_box(
    low: Float[Tensor, "3"], high: Float[Tensor, "3"], camera: Float[Tensor, "3"], count: int
) -> Float[Tensor, "count 3"]:
    """The points of a box room that rays of equal density from a camera in it meet, float64."""
    low, high, camera = (torch.as_tensor(np.asarray(corner), dtype=torch.float64) for corner in (low, high, camera))
    rays = fibonacci_directions(count).double() + 1e-9
    return camera + (torch.where(rays > 0, high - camera, low - camera) / rays).amin(dim=1, keepdim=True) * rays


def place_cameras(*places: tuple[float, float, float]) -> Float[Tensor, "view 4 4"]:
    """Poses of cameras that are not turned."""
    poses = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
    poses[:, :3, 3] = torch.tensor(places, dtype=torch.float64)
    return poses


def turn_camera(quat: Sequence[float] | Tensor, place: tuple[float, float, float]) -> Float[Tensor, "4 4"]:
    """The pose of a camera with this rotation."""
    (pose,) = place_cameras(place)
    pose[:3, :3] = rotations_from_quats(torch.as_tensor(quat, dtype=torch.float64))
    return pose


def draw_noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def approx_of_8_bits(decibels: float) -> Any:
    """A PSNR up to the rounding of an image to 8 bits: half a step of the root of the mean square error."""
    return pytest.approx(decibels, abs=20 * math.log10(1 + 0.5 / 255 * 10 ** (decibels / 20)))
