"""The surfaces that a panorama shows, by its Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Scene

RAYS = 360  # number of directions around a camera in which walls are measured
_SHOWN, _OPAQUE = 0.1, 0.5  # least opacities of surfaces, and of those that hide and block
_ROWS, _COLUMNS = 180, 360  # cells of equal solid angles around a camera

RAY_ANGLES = (np.arange(RAYS) + 0.5) * 2 * math.pi / RAYS  # azimuths from forward to the right, radians
RAY_DIRECTIONS = np.stack((np.sin(RAY_ANGLES), np.cos(RAY_ANGLES)), axis=1)

Outline = Float[np.ndarray, "corner 2"]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surfaces that a panorama shows, by its Gaussians; those of coarse levels may be behind them.

    Attributes:
        center: of the camera, right, down and forward in level axes, metres.
        places: of the Gaussians relative to the camera, in the same axes, metres.
        is_opaque: which of them hide and block.
        base: their harmonics of degree 0.
    """

    center: Float[np.ndarray, "3"]
    places: Float[np.ndarray, "n 3"]
    is_opaque: Bool[np.ndarray, "n"]
    base: Float[Tensor, "n 3"]

    @cached_property
    def opaque(self) -> Float[np.ndarray, "m 3"]:
        """The places of opaque surfaces."""
        return self.places[self.is_opaque]

    @cached_property
    def distances(self) -> Float[np.ndarray, "m"]:
        """Those of opaque surfaces from the camera."""
        return np.linalg.norm(self.opaque, axis=1)

    @cached_property
    def colors(self) -> Float[np.ndarray, "m 3"]:
        """Those of opaque surfaces, without harmonics of higher degrees, in [0, 1]."""
        return (0.5 + SH_0 * self.base[self.is_opaque]).clamp(0, 1).double().numpy()

    @cached_property
    def samples(self) -> Float[np.ndarray, "k 3"]:
        """One place for each cell of equal solid angle: that of median distance.

        Pictures of much detail have more Gaussians: where they are and how many has no influence on what is measured
        here.
        """
        places, distances = self.places, np.maximum(np.linalg.norm(self.places, axis=1), 1e-9)
        columns = (np.arctan2(places[:, 0], places[:, 2]) / (2 * math.pi) % 1.0 * _COLUMNS).astype(int) % _COLUMNS
        cells = columns * _ROWS + ((places[:, 1] / distances + 1) / 2 * _ROWS).astype(int).clip(0, _ROWS - 1)
        order = np.lexsort((distances, cells))
        borders = np.flatnonzero(np.diff(cells[order], prepend=-1, append=-1))
        return places[order[(borders[:-1] + borders[1:] - 1) // 2]]


def find_surfaces(scene: Scene, level: Float[np.ndarray, "3 3"]) -> list[Surfaces]:
    """The surfaces that each view shows.

    Args:
        scene: with all Gaussians of each view.
        level: right, down and forward (columns) of a level camera (`TourGraph.level_axes`).
    """
    gaussians, found = scene.gaussians, []
    is_shown = (gaussians.opacities > _SHOWN) & (gaussians.levels <= 1) & gaussians.means.isfinite().all(dim=1)
    for view, center in enumerate(scene.cam2world[:, :3, 3].double().cpu().numpy()):
        own = is_shown & (gaussians.views == view)
        places = (gaussians.means[own].double().cpu().numpy() - center) @ level
        is_opaque = (gaussians.opacities[own] > _OPAQUE).cpu().numpy()
        found.append(Surfaces(level.T @ center, places, is_opaque, gaussians.harmonics[own, 0].cpu()))
    return found


def split_by_azimuth(
    flat: Float[np.ndarray, "n 2"], values: Float[np.ndarray, "n"], count: int
) -> list[Float[np.ndarray, "m"]]:
    """The values of the places in each of `count` equal sectors around a camera, from forward to the right.

    Args:
        flat: places (right, forward) relative to the camera.
        values: of the places.
    """
    sectors = ((np.arctan2(flat[:, 0], flat[:, 1]) / (2 * math.pi) % 1.0) * count).astype(int) % count
    order = np.argsort(sectors, kind="stable")
    return np.split(values[order], np.searchsorted(sectors[order], np.arange(1, count)))


def meet_outline(center: Float[np.ndarray, "2"], outline: Outline) -> tuple[np.ndarray, np.ndarray]:
    """Distance at which each ray meets the outline, and the number of that wall; infinite and -1 if it does not."""
    rays, along = RAY_DIRECTIONS, np.roll(outline, -1, axis=0) - outline
    cross = rays[:, None, 0] * along[:, 1] - rays[:, None, 1] * along[:, 0]
    offset = outline - center
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]) / cross
        position = (offset[:, 0] * rays[:, None, 1] - offset[:, 1] * rays[:, None, 0]) / cross
    distance = np.where((distance > 0) & (position >= 0) & (position <= 1), distance, np.inf)
    nearest = distance.argmin(axis=1)
    reached = distance[np.arange(RAYS), nearest]
    return reached, np.where(np.isfinite(reached), nearest, -1)
