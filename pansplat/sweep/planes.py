"""Which planes a scene has: how much of the agreed surfaces lies on each plane across the scene's axes.

Before there are surfaces, pixels vote (`votes`); what they voted for stays a candidate.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.surface import Surface, world_points

_BIN = 1 / 9  # of `near`: 5 cm indoors
_LITTLE, _MUCH = 2e-4, 2e-2  # shares of all directions between which support counts
_HORIZONTAL = 0  # axis 0 points down
MIN_FLOOR = 0.9  # of `near`, from the camera
_FLOOR_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class PlaneSupport:
    """Histograms (3, bins) of the planes' offsets along each axis from `origin`, as shares of all directions.

    `bin` is a bin's width, metres. `votes` (3, bins), in [0, 1], are the planes that pixels voted for, and
    `floor_ceiling` the offsets down and up (negative) of those among them, metres, infinite where none stood out.
    """

    axes: np.ndarray
    origin: np.ndarray
    histogram: np.ndarray
    bin: float
    votes: np.ndarray
    floor_ceiling: tuple[float, float] = (math.inf, -math.inf)

    @property
    def offsets(self) -> np.ndarray:
        """Offsets (bins) of the bins' middles, metres."""
        bins = self.histogram.shape[1]
        return (np.arange(bins) - bins // 2 + 0.5) * self.bin

    def _bin(self, offset: np.ndarray) -> np.ndarray:
        middle = self.histogram.shape[1] // 2
        return np.clip(np.floor(offset / self.bin).astype(np.int64) + middle, 0, self.histogram.shape[1] - 1)

    def share(self, axis: int, cam2world: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Support in [0, 1], (2, n), of planes at distances 1 / `inverse` on the negative and positive side."""
        centre = self.axes[axis] @ (cam2world[:3, 3] - self.origin)
        index = np.stack([self._bin(centre + sign / inverse) for sign in (-1, 1)])
        found = np.log1p(self.histogram[axis, index] / _LITTLE) / np.log1p(_MUCH / _LITTLE)
        return np.clip(np.maximum(found, self.votes[axis, index]), 0, 1)

    def backs(self, axis: int, cam2world: np.ndarray, other: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Which planes at distances 1 / `inverse` on the negative and positive side, (2, n), stand between two cameras.

        Each camera would see a face of its own.
        """
        here, there = (self.axes[axis] @ pose[:3, 3] for pose in (cam2world, other))
        return np.stack([sign * (here - there) + 1 / inverse <= 0 for sign in (-1, 1)])

    def floor_below(self, cam2world: np.ndarray) -> float:
        """How far below a camera the floor is that pixels voted for, metres; infinite where there is none."""
        return self.floor_ceiling[0] - float(self.axes[_HORIZONTAL] @ (cam2world[:3, 3] - self.origin))

    def bounds(self, cam2world: np.ndarray) -> tuple[float, float]:
        """How far the scene reaches down and up (negative) from a camera, metres; infinite where unknown."""
        horizontal = self.histogram[_HORIZONTAL]
        middle, gap = len(horizontal) // 2, round(MIN_FLOOR / _BIN)
        camera = self.axes[_HORIZONTAL] @ (cam2world[:3, 3] - self.origin)
        bounds = []
        for voted, start, part, sign in (
            (self.floor_ceiling[0], middle + gap, horizontal[middle + gap :], 1),
            (self.floor_ceiling[1], 0, horizontal[: middle - gap], -1),
        ):
            peak = start + int(part.argmax())
            offset = voted
            if math.isinf(voted) and horizontal[max(peak - 2, 0) : peak + 3].sum() > _FLOOR_SHARE:
                offset = self.offsets[peak]
            bounds.append(1.06 * (offset - camera) + sign * self.bin)
        return bounds[0], bounds[1]


def no_support(cam2world: np.ndarray, axes: np.ndarray, near: float, far: float) -> PlaneSupport:
    """Of no plane, around the mean of the cameras; `near` sets the bins' width, `far` how far they reach."""
    width = near * _BIN
    nothing = np.zeros((3, 2 * int(1.5 * far / width)))
    return PlaneSupport(axes, cam2world[:, :3, 3].mean(axis=0), nothing, width, nothing)


def plane_support(
    surfaces: Sequence[Surface], agreed: Sequence[np.ndarray], cam2world: np.ndarray, known: PlaneSupport
) -> PlaneSupport:
    """The support so far, its histogram collected anew from the pixels (h, w) that the views agree on."""
    histogram = np.zeros_like(known.histogram)
    bins = histogram.shape[1]
    for surface, sure, pose in zip(surfaces, agreed, cam2world, strict=True):
        height, width = surface.inverse_depth.shape
        area = np.repeat(row_weights(height).numpy()[:, None], width, axis=1)
        area /= area.sum() * len(surfaces)
        points = world_points(surface, pose) - known.origin
        for axis in range(3):
            chosen = sure & (surface.family == axis + 1)
            index = known._bin(points[chosen] @ known.axes[axis])
            histogram[axis] += np.bincount(index, weights=area[chosen], minlength=bins)
    return dataclasses.replace(known, histogram=cv2.GaussianBlur(histogram, (9, 1), 1.0))
