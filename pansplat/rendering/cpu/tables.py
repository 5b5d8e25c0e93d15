"""The pixels of one picture as the tile kernels read them: two short tables and a rotation."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from pansplat.rendering.cpu.records import TILE
from pansplat.rendering.panorama import Picture

PANORAMA = 0  # columns: sine, cosine of longitude; rows: of latitude
PINHOLE = 1  # columns: x of the ray (x, y, 1); rows: y
FLAT = 2  # columns, rows: pixel centres, for the classic kernel


class Plane(NamedTuple):
    """One picture's pixels; each is the outer product of a column and a row.

    Attributes:
        kind: PANORAMA, PINHOLE or FLAT.
        columns: float64 (width, 2).
        rows: float64 (height, 2).
        rotation: float64 (3, 3), the picture's axes in the camera's; used by PINHOLE.
    """

    kind: int
    columns: npt.NDArray[np.float64]
    rows: npt.NDArray[np.float64]
    rotation: npt.NDArray[np.float64]

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-len(self.rows) // TILE), -(-len(self.columns) // TILE)


def plane_of(picture: Picture, *, exact: bool) -> Plane:
    """The tables of a picture, for the exact kernel or the classic one.

    Source: docs/rendering.md, section 6.
    """
    height, width = picture.size
    x, y = (np.arange(extent, dtype=np.float64) + 0.5 for extent in (width, height))
    rotation = np.ascontiguousarray(picture.rotation.to("cpu", torch.float64).numpy())
    if not exact:
        return Plane(FLAT, _table(x, np.zeros(width)), _table(y, np.zeros(height)), rotation)
    if picture.is_panorama:
        longitude, latitude = (2 * x / width - 1) * np.pi, (y / height - 0.5) * np.pi
        columns, rows = (_table(np.sin(angle), np.cos(angle)) for angle in (longitude, latitude))
        return Plane(PANORAMA, columns, rows, rotation)
    x, y = (x - 0.5 * width) / picture.focal, (y - 0.5 * height) / picture.focal
    return Plane(PINHOLE, _table(x, np.zeros(width)), _table(y, np.zeros(height)), rotation)


def _table(first: npt.NDArray[Any], second: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    return np.stack((first, second), axis=1)
