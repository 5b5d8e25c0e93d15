"""Tile intersections, front to back, and the pixels of each tile.

Source: docs/rendering.md, sections 3 to 5. Gaussians are sorted once by depth, then intersections only by tile.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.reference import split_rows, tile_grid, tile_ranges

TILE_SIZE = 16  # pixels

_MAX_INTERSECTIONS = 1 << 24
"""Intersections in a band: about 40 bytes each while they are sorted, 70 to 130 in backward."""

_MAX_TILES = 1 << 15
"""Tiles in a band: their indices are sorted as 16-bit integers, in half the passes of 32."""

_BLOCK_SIZE: tl.constexpr = tl.constexpr(512)  # intersections that one program processes


@dataclass(frozen=True, eq=False)
class Instances:
    """Pairs of a record and an image plane it is visible on, plane by plane, front to back.

    Attributes:
        records: index of each record.
        ranges: first column, columns, first row, rows of its tiles; rows are numbered through all planes.
        planes: number of instances on each plane.
        grid: rows of tiles of all planes, and columns.
    """

    records: Int[Tensor, "m"]
    ranges: Int[Tensor, "m 4"]
    planes: list[int]
    grid: tuple[int, int]


@dataclass(frozen=True, eq=False)
class TileIntersections:
    """For each tile of a band of tile rows, the records that intersect it, front to back.

    Attributes:
        rows: first row of tiles, and one past the last.
        record_ids: indices of records, tile after tile.
        starts: start of each tile in `record_ids`, and the end of the last tile.
        slots: position of each intersection before the sort by tile; those of an instance are adjacent.
        ends: end of each instance's slots.
    """

    rows: tuple[int, int]
    record_ids: Int[Tensor, "e"]
    starts: Int[Tensor, "starts"]
    slots: Int[Tensor, "e"]
    ends: Int[Tensor, "m"]


def sort_instances(
    boxes: list[Float[Tensor, "_n 4"]],
    keys: list[Float[Tensor, "_n"]],
    bases: list[int],
    size: tuple[int, int],
    *,
    wraps: bool,
) -> Instances:
    """Sort the visible records of each image plane front to back.

    Args:
        boxes: on each plane, pixels; left > right where not seen.
        keys: depths to sort by, on each plane.
        bases: index of the first record of each plane.
        size: height and width of each plane, pixels.
        wraps: column `width` is column 0.
    """
    rows, columns = tile_grid(*size, TILE_SIZE)
    records, ranges, counts = [], [], []
    order = last = None
    for plane, (box, key, base) in enumerate(zip(boxes, keys, bases, strict=True)):
        if order is None or key is not last:  # planes that sort by distance share one order
            order, last = torch.argsort(key, stable=True), key
        touched = tile_ranges(box, size, wraps, TILE_SIZE).int()
        touched[:, 2] += plane * rows
        seen = order[((touched[:, 1] > 0) & (touched[:, 3] > 0))[order]]
        records.append((seen + base).int())
        ranges.append(touched[seen])
        counts.append(len(seen))
    return Instances(torch.cat(records), torch.cat(ranges), counts, (len(boxes) * rows, columns))


def intersect_tiles(instances: Instances, limit: int = _MAX_INTERSECTIONS) -> Iterator[TileIntersections]:
    """List the intersections of all tiles, in bands of tile rows with at most `limit` intersections (or one row)."""
    rows, columns = instances.grid
    num_columns, first_row, num_rows = instances.ranges.long()[:, 1:].unbind(1)
    most = max(1, _MAX_TILES // columns)
    total = int((num_columns * num_rows).sum())
    bands = [(0, rows, total)]
    if total > limit or rows > most:
        per_row = _count_in_rows(num_columns, first_row, num_rows, rows)
        ends_of_bands = (
            (row, min(row + most, end)) for first, end in split_rows(per_row, limit) for row in range(first, end, most)
        )
        bands = [(low, high, sum(per_row[low:high])) for low, high in ends_of_bands]
    for low, high, total in bands:
        top = first_row.clamp_min(low)
        count = ((first_row + num_rows).clamp_max(high) - top).clamp_min(0) * num_columns
        ends = count.cumsum(0)
        tiles = torch.empty(total, dtype=torch.int16, device=ends.device)
        record_ids = torch.empty(total, dtype=torch.int32, device=ends.device)
        if total:
            grid = (triton.cdiv(total, _BLOCK_SIZE.value),)
            intersect_kernel[grid](
                ends, instances.ranges, instances.records, tiles, record_ids, len(ends), total, low, columns,
                len(ends).bit_length(), num_warps=4,
            )  # fmt: skip
        tiles, slots = torch.sort(tiles, stable=True)
        numbers = torch.arange((high - low) * columns, dtype=torch.int32, device=ends.device)
        starts = torch.nn.functional.pad(torch.searchsorted(tiles.int(), numbers), (0, 1), value=total)
        yield TileIntersections((low, high), record_ids[slots], starts.int(), slots.int(), ends)


def _count_in_rows(
    num_columns: Int[Tensor, "m"], first_row: Int[Tensor, "m"], num_rows: Int[Tensor, "m"], rows: int
) -> list[int]:
    """Count the intersections in each row of tiles, from differences at the instances' ends."""
    change = torch.zeros(rows + 1, dtype=torch.int64, device=first_row.device)
    change.index_add_(0, first_row, num_columns)
    change.index_add_(0, first_row + num_rows, -num_columns)
    return change.cumsum(0)[:rows].tolist()  # type: ignore[no-any-return]


@triton.jit(do_not_specialize=["num", "total", "low", "columns", "steps"])
@no_type_check
def intersect_kernel(ends, ranges, records, tiles, record_ids, num, total, low, columns, steps):
    """Write the tile and the record of each slot; an instance's slots are its tiles, row by row."""
    slot = tl.program_id(0).to(tl.int64) * _BLOCK_SIZE + tl.arange(0, _BLOCK_SIZE)
    inside = slot < total
    # Binary search for the slot's instance: the first that ends after it.
    first = tl.zeros([_BLOCK_SIZE], tl.int32)
    past = first + num
    for _ in range(steps):
        middle = (first + past) // 2
        ended = tl.load(ends + middle, mask=inside & (first < past), other=0) <= slot
        first, past = tl.where(ended & (first < past), middle + 1, first), tl.where(ended, past, middle)
    before = tl.load(ends + first - 1, mask=inside & (first > 0), other=0)
    step = (slot - before).to(tl.int32)
    box = ranges + first.to(tl.int64) * 4
    across = tl.load(box + 1, mask=inside, other=1)
    column = (tl.load(box, mask=inside, other=0) + step % across) % columns
    row = tl.maximum(tl.load(box + 2, mask=inside, other=0), low) - low + step // across
    tl.store(tiles + slot, (row * columns + column).to(tl.int16), mask=inside)
    tl.store(record_ids + slot, tl.load(records + first, mask=inside, other=0), mask=inside)


@dataclass(frozen=True, eq=False)
class TilePixels:
    """Pixels of all planes by tile, relative to the tile's centre; tiles are row by row.

    Attributes:
        centres: centres of the tiles, rounded to the kernels' type, and the residual of the rounding.
        offsets: pixel minus centre.
    """

    centres: Float[Tensor, "tile both axis"]
    offsets: Float[Tensor, "tile axis pixel"]


def tile_pixels(planes: list[ImagePlane], *, exact: bool, dtype: torch.dtype) -> TilePixels:
    """Arrange the pixels of image planes of one size by tile; tiles beyond an edge repeat the last row or column.

    Args:
        exact: points are directions in camera axes, not x, y in pixels.
        dtype: the kernels' type.
    """
    tables = [_arrange_pixels(plane, exact, dtype) for plane in planes]
    return TilePixels(*(torch.cat(table) for table in zip(*tables, strict=True)))


def _arrange_pixels(
    plane: ImagePlane, exact: bool, dtype: torch.dtype
) -> tuple[Float[Tensor, "tile both axis"], Float[Tensor, "tile axis pixel"]]:
    points = plane.directions() if exact else plane.coordinates()
    rows, columns = tile_grid(*plane.size, TILE_SIZE)
    y = torch.arange(rows * TILE_SIZE, device=points.device).clamp_max(plane.size[0] - 1)
    x = torch.arange(columns * TILE_SIZE, device=points.device).clamp_max(plane.size[1] - 1)
    points = points[y][:, x].reshape(rows, TILE_SIZE, columns, TILE_SIZE, -1).permute(0, 2, 4, 1, 3)
    points = points.reshape(rows * columns, -1, TILE_SIZE * TILE_SIZE)
    centres = points.mean(dim=2)
    rounded = centres.to(dtype)
    both = torch.stack((rounded, (centres - rounded.double()).to(dtype)), dim=1)
    return both, (points - centres[:, :, None]).to(dtype)
