"""What the tiles of the CPU rasteriser read: one record and one row of values a Gaussian, one entry a tile.

Source: docs/rendering.md, section 3, in powers of two. With the vectors and numbers of a record, and
k a unit direction near the pixel's d:

    A = a.(d - n),  B = b.(d - n),  L = 1 + l.(d - n),  l = n + front_a a + front_b b
    alpha = min(0.99, 2^(level - Q / (L^2 + along Q))),  Q = A^2 + B^2

so a and b are the page's times sqrt(HALF_LOG2_E), `along` is its S' over HALF_LOG2_E, and `log2_peak` is log2 of the
peak. n is stored as a float32 and its residual, so that n - k has no cancellation. For the classic kernel n is the
point in pixels (z = 0), d the pixel's centre, a_y = a_z = b_z = 0, along = l_along_a = l_along_b = 0, and L is 1.

Only A / L and B / L count, and a.n = b.n = 0. Gradients of records are those with each ray as long as makes L = 1.

Arrays, all C-contiguous numpy:

    records   float32 (n, RECORD_SIZE)       best aligned to 64 bytes: one cache line a Gaussian
    values    float32 (n, channel + 1)  colours, then the radius in metres
    intersections   int32   (e, 2)            index of the Gaussian, and its box within the tile (see `BOX_BITS`)
    starts    int64   (tile + 1)        where each tile's intersections begin, front to back; tiles row by row
    slots     int32   (e)               for the backward: the row of gradients that the entry writes; int64 if it must
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from pansplat.rendering.panorama import Picture

# The pixels of one picture as the tile kernels read them: two short tables and a rotation.


TILE_SIZE = 32
"""Side of a tile, pixels."""

RECORD_SIZE = 16
"""Numbers a record."""

DIRECTION = 0  # n rounded to float32: x, y, z
DIRECTION_RESIDUAL = 3  # n minus that: x, y, z
ROW_A = 6  # a: x, y, z
ROW_B = 9  # b: x, y, z
L_ALONG_A = 12
L_ALONG_B = 13
RADIAL_VARIANCE = 14
LOG2_PEAK = 15

HALF_LOG2_E = 0.5 * math.log2(math.e)
"""exp(-q / 2) = 2^(-HALF_LOG2_E q)."""

BOX_BITS = 8
"""An entry's box is x0 + (x1 << 8) + (y0 << 16) + (y1 << 24): its first and last pixel column and row counted from
the tile's own corner, 0 to 31, both ends included. It may be larger than needed: what lies outside the ellipse has
an alpha below the cut. A box that wraps into both ends of one tile takes the tile's full width."""


EQUIRECT_RAYS = 0  # columns: sine, cosine of longitude; rows: of latitude
PINHOLE_RAYS = 1  # columns: x of the ray (x, y, 1); rows: y
PIXEL_CENTRES = 2  # columns, rows: pixel centres, for the classic kernel


class PixelTables(NamedTuple):
    """One picture's pixels; each is the outer product of a column and a row.

    Attributes:
        kind: EQUIRECT_RAYS, PINHOLE_RAYS or PIXEL_CENTRES.
        columns: float64 (width, 2).
        rows: float64 (height, 2).
        rotation: float64 (3, 3), the picture's axes in the camera's; used by PINHOLE_RAYS.
    """

    kind: int
    columns: npt.NDArray[np.float64]
    rows: npt.NDArray[np.float64]
    rotation: npt.NDArray[np.float64]

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-len(self.rows) // TILE_SIZE), -(-len(self.columns) // TILE_SIZE)


def tabulate_pixels(picture: Picture, *, exact: bool) -> PixelTables:
    """The tables of a picture, for the exact kernel or the classic one.

    Source: docs/rendering.md, section 6.
    """
    height, width = picture.size
    x, y = (np.arange(extent, dtype=np.float64) + 0.5 for extent in (width, height))
    rotation = np.ascontiguousarray(picture.rotation.to("cpu", torch.float64).numpy())
    if not exact:
        return PixelTables(PIXEL_CENTRES, _table(x, np.zeros(width)), _table(y, np.zeros(height)), rotation)
    if picture.is_panorama:
        longitude, latitude = (2 * x / width - 1) * np.pi, (y / height - 0.5) * np.pi
        columns, rows = (_table(np.sin(angle), np.cos(angle)) for angle in (longitude, latitude))
        return PixelTables(EQUIRECT_RAYS, columns, rows, rotation)
    x, y = (x - 0.5 * width) / picture.focal, (y - 0.5 * height) / picture.focal
    return PixelTables(PINHOLE_RAYS, _table(x, np.zeros(width)), _table(y, np.zeros(height)), rotation)


def _table(first: npt.NDArray[Any], second: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    return np.stack((first, second), axis=1)
