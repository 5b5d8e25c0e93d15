"""Layout of the CPU rasteriser's arrays: records, values, tile intersections and pixel tables.

Source: docs/rendering.md, section 3, with powers of two for exponentials. With n the unit direction of the
Gaussian, d the ray of a pixel, and a, b, l the footprint rows:

    A = a.(d - n),  B = b.(d - n),  L = 1 + l.(d - n),  l = n + l_along_a a + l_along_b b
    alpha = min(0.99, 2^(log2_peak - Q / (L^2 + radial_variance Q))),  Q = A^2 + B^2

So a and b are sqrt(HALF_LOG2_E) times those of docs/rendering.md, and radial_variance is its S' over HALF_LOG2_E. n is
stored as a float32 vector and its residual, so that n minus another direction has no cancellation.

Only A / L and B / L matter, and a.n = b.n = 0. Gradients of records are those for rays scaled so that L = 1.

Arrays, all C-contiguous numpy:

    records        float32 (n, RECORD_SIZE)  one cache line per Gaussian if aligned to 64 bytes
    values         float32 (n, 4)            RGB, then the radial distance in metres
    intersections  int32   (e, 2)            index of the Gaussian, and its box within the tile (see `BOX_BITS`)
    starts         int64   (tile + 1)        first intersection of each tile, front to back; tiles row by row
    slots          int32   (e)               row of the gradient arrays that an intersection writes; int64 if needed
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from pansplat.rendering.image_planes import ImagePlane

TILE_SIZE = 32
"""Side of a tile, pixels."""

RECORD_SIZE = 16
"""Numbers in a record."""

DIRECTION = 0  # n as float32: x, y, z
DIRECTION_RESIDUAL = 3  # n minus its float32 value: x, y, z
ROW_A = 6  # a: x, y, z
ROW_B = 9  # b: x, y, z
L_ALONG_A = 12
L_ALONG_B = 13
RADIAL_VARIANCE = 14
LOG2_PEAK = 15

HALF_LOG2_E = 0.5 * math.log2(math.e)
"""exp(-q / 2) = 2^(-HALF_LOG2_E q)."""

BOX_BITS = 8
"""A box within a tile is x0 + (x1 << 8) + (y0 << 16) + (y1 << 24): first and last pixel column and row, 0 to 31,
inclusive. It may be larger than the footprint: the alpha cut removes the other pixels. A box that wraps around the
panorama and reaches both ends of one tile has the tile's full width."""

EQUIRECT_RAYS = 0  # columns: sine and cosine of the longitude; rows: sine and cosine of the latitude
PINHOLE_RAYS = 1  # columns: x of the ray (x, y, 1); rows: y
COLUMN_RAYS = 2  # a panorama of which each column is a column of blocks: see `tabulate_columns`
BLOCK_WIDTH = 4  # pixels of a raster block


class PixelTables(NamedTuple):
    """The pixels of one image plane, each given by a column and a row.

    Attributes:
        kind: EQUIRECT_RAYS, PINHOLE_RAYS or COLUMN_RAYS.
        columns: float64 (width, 2).
        rows: float64 (height, 2); for COLUMN_RAYS (height, 2 BLOCK_WIDTH).
        rotation: float64 (3, 3), the image plane's axes in the camera's; used by PINHOLE_RAYS.
    """

    kind: int
    columns: npt.NDArray[np.float64]
    rows: npt.NDArray[np.float64]
    rotation: npt.NDArray[np.float64]

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-len(self.rows) // TILE_SIZE), -(-len(self.columns) // TILE_SIZE)


def tabulate_pixels(plane: ImagePlane) -> PixelTables:
    """Pixel tables of an image plane.

    Source: docs/rendering.md, section 6.
    """
    height, width = plane.size
    x, y = (np.arange(extent, dtype=np.float64) + 0.5 for extent in (width, height))
    rotation = np.ascontiguousarray(plane.rotation.to("cpu", torch.float64).numpy())
    if plane.is_panorama:
        longitude, latitude = (2 * x / width - 1) * np.pi, (y / height - 0.5) * np.pi
        columns, rows = (_table(np.sin(angle), np.cos(angle)) for angle in (longitude, latitude))
        return PixelTables(EQUIRECT_RAYS, columns, rows, rotation)
    x, y = (x - 0.5 * width) / plane.focal, (y - 0.5 * height) / plane.focal
    return PixelTables(PINHOLE_RAYS, _table(x, np.zeros(width)), _table(y, np.zeros(height)), rotation)


def tabulate_columns(plane: ImagePlane, low: int, high: int) -> PixelTables:
    """Pixel tables of columns `low` to `high` - 1 of a panorama, folded so that a block has pixels of one column only.

    Column j of the panorama is columns 4 j to 4 j + 3 of the folded image, and its row i is row i // 4, column
    4 j + i % 4. A block evaluates every Gaussian that reaches it for all of its pixels.
    """
    tables = tabulate_pixels(plane)
    folded = -(-len(tables.rows) // BLOCK_WIDTH) * BLOCK_WIDTH
    rows = np.pad(tables.rows, ((0, folded - len(tables.rows)), (0, 0)), mode="edge")
    columns = np.repeat(tables.columns[low:high], BLOCK_WIDTH, axis=0)
    return PixelTables(COLUMN_RAYS, columns, rows.reshape(-1, 2 * BLOCK_WIDTH), tables.rotation)


def _table(first: npt.NDArray[Any], second: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    return np.stack((first, second), axis=1)
