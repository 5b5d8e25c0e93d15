"""Which Gaussians touch which tile of a picture, in drawing order."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

TILE = 8  # pixels
_MARGIN = 0.01  # pixels added around each box, far more than rounding
_ENTRIES = 1 << 22  # entries listed at a time


@dataclass(frozen=True, eq=False)
class TileLists:
    """For each tile of some rows of tiles, the Gaussians that touch it, front to back.

    Attributes:
        tiles: index of the first tile, and one past the last, in the picture's row-major order of tiles.
        entries: Gaussian indices, tile after tile.
        starts: where each tile's entries begin, and the end of the last.
    """

    tiles: tuple[int, int]
    entries: Int[Tensor, "e"]
    starts: Int[Tensor, "t"]


def tile_grid(height: int, width: int, tile: int = TILE) -> tuple[int, int]:
    """Number of rows and columns of tiles that cover a picture."""
    return -(-height // tile), -(-width // tile)


def list_tiles(
    boxes: Float[Tensor, "n 4"],
    order: Int[Tensor, "n"],
    size: tuple[int, int],
    *,
    wraps: bool,
    limit: int = _ENTRIES,
) -> Iterator[TileLists]:
    """Lists for all tiles, in bands of tile rows with about `limit` entries at most.

    Args:
        boxes: left, right, top, bottom, pixels; left > right where a Gaussian is not seen.
        order: Gaussians front to back.
        size: height and width, pixels.
        wraps: whether column `width` is column 0 again.
    """
    rows, columns = tile_grid(*size)
    ranges = tile_ranges(boxes[order], size, wraps)
    seen = torch.nonzero((ranges[:, 1] > 0) & (ranges[:, 3] > 0))[:, 0]
    order, (first_column, num_columns, first_row, num_rows) = order[seen], ranges[seen].unbind(1)
    # Entries in each row of tiles, by differences at the boxes' ends.
    change = torch.zeros(rows + 1, dtype=torch.int64, device=boxes.device)
    change.index_add_(0, first_row, num_columns)
    change.index_add_(0, first_row + num_rows, -num_columns)
    for low, high in bands(change.cumsum(0)[:rows].tolist(), limit):
        top = first_row.clamp_min(low)
        count = (torch.minimum(first_row + num_rows, torch.as_tensor(high)) - top).clamp_min(0) * num_columns
        inside = torch.repeat_interleave(torch.arange(len(order), device=boxes.device), count)
        step = torch.arange(len(inside), device=boxes.device) - (count.cumsum(0) - count)[inside]
        across = num_columns[inside]
        column = (first_column[inside] + step % across) % columns
        tile = (top[inside] - low + step // across) * columns + column
        tile, place = torch.sort(tile, stable=True)
        per_tile = torch.bincount(tile, minlength=(high - low) * columns)
        starts = torch.cat((per_tile.new_zeros(1), per_tile.cumsum(0)))
        yield TileLists((low * columns, high * columns), order[inside[place]], starts)


def tile_ranges(
    boxes: Float[Tensor, "n 4"], size: tuple[int, int], wraps: bool, tile: int = TILE
) -> Int[Tensor, "n 4"]:
    """First column, number of columns, first row, number of rows of the tiles that each box touches."""
    height, width = size
    columns = tile_grid(height, width, tile)[1]
    left, right, top, bottom = boxes.unbind(1)
    hidden = (left > right) | (top > bottom)
    # Pixels whose centres lie inside; limited as floats, before the cast can overflow.
    first_x, first_y = (torch.ceil(edge - 0.5 - _MARGIN) for edge in (left, top))
    last_x, last_y = (torch.floor(edge - 0.5 + _MARGIN) for edge in (right, bottom))
    hidden |= (first_y > height - 1) | (last_y < 0) | (last_y < first_y) | (last_x < first_x)
    first_y, last_y = first_y.clamp(0, height - 1).long() // tile, last_y.clamp(0, height - 1).long() // tile
    if wraps:
        everywhere = last_x - first_x >= width - 1
        start = torch.remainder(first_x, width).long().clamp(0, width - 1)
        end = torch.remainder(last_x, width).long().clamp(0, width - 1)
        first_x, last_x = start // tile, end // tile
        wrapped = end < start
        num_x = torch.where(wrapped, columns - first_x + last_x + 1, last_x - first_x + 1)
        everywhere |= num_x >= columns
        first_x = torch.where(everywhere, 0, first_x)
        num_x = torch.where(everywhere, columns, num_x)
    else:
        hidden |= (first_x > width - 1) | (last_x < 0)
        first_x = first_x.clamp(0, width - 1).long() // tile
        num_x = last_x.clamp(0, width - 1).long() // tile - first_x + 1
    ranges = torch.stack((first_x, num_x, first_y, last_y - first_y + 1), dim=1)
    return torch.where(hidden[:, None], torch.zeros_like(ranges), ranges)


def bands(per_row: list[int], limit: int) -> Iterator[tuple[int, int]]:
    """Split rows into runs whose entries sum to at most `limit` (a single row may hold more)."""
    low, total = 0, 0
    for row, count in enumerate(per_row):
        if row > low and total + count > limit:
            yield low, row
            low, total = row, 0
        total += count
    yield low, len(per_row)
