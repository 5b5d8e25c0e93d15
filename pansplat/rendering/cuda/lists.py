"""Which Gaussians touch which tile, in drawing order: sorted once by depth, then only by tile.

Source: docs/rendering.md, section 4 (order) and 5 (boxes).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.rendering.cuda.layout import TILE
from pansplat.rendering.reference import bands, tile_grid, tile_ranges

_ENTRIES = 1 << 24
"""Entries listed at a time: at some 40 bytes each while they are sorted, and 70 to 130 in backward."""

_TILES = 1 << 15
"""Tiles listed at a time: their numbers are sorted as 16-bit integers, half the passes of 32."""

_EMITTED: tl.constexpr = tl.constexpr(512)  # entries a program


@dataclass(frozen=True, eq=False)
class Instances:
    """Gaussians on pictures: one for each picture that a Gaussian is seen on, picture by picture, front to back.

    Attributes:
        records: which record each draws.
        ranges: first column, columns, first row, rows of its tiles; rows go on from picture to picture.
        pictures: how many instances each picture has.
        grid: rows and columns of tiles, all pictures' rows together.
    """

    records: Int[Tensor, "m"]
    ranges: Int[Tensor, "m 4"]
    pictures: list[int]
    grid: tuple[int, int]


@dataclass(frozen=True, eq=False)
class TileLists:
    """For each tile of some rows of tiles, the records it draws, front to back.

    Attributes:
        rows: first row of tiles, and one past the last.
        entries: records, tile after tile.
        starts: where each tile's entries begin, and the end of the last.
        slots: where each entry stood when all of an instance's entries were together.
        ends: where each instance's entries ended then.
    """

    rows: tuple[int, int]
    entries: Int[Tensor, "e"]
    starts: Int[Tensor, "starts"]
    slots: Int[Tensor, "e"]
    ends: Int[Tensor, "m"]


def list_instances(
    boxes: list[Float[Tensor, "_n 4"]],
    keys: list[Float[Tensor, "_n"]],
    bases: list[int],
    size: tuple[int, int],
    *,
    wraps: bool,
) -> Instances:
    """The Gaussians seen on each picture, front to back.

    Args:
        boxes: on each picture, pixels; left > right where not seen.
        keys: what to sort by on each picture.
        bases: number of the first Gaussian's record, for each picture.
        size: height and width of each picture, pixels.
        wraps: whether column `width` is column 0 again.
    """
    rows, columns = tile_grid(*size, TILE)
    records, ranges, counts = [], [], []
    order = last = None
    for picture, (box, key, base) in enumerate(zip(boxes, keys, bases, strict=True)):
        if order is None or key is not last:  # by distance all pictures share one order
            order, last = torch.argsort(key, stable=True), key
        touched = tile_ranges(box[order], size, wraps, TILE)
        seen = torch.nonzero((touched[:, 1] > 0) & (touched[:, 3] > 0))[:, 0]
        touched = touched[seen]
        touched[:, 2] += picture * rows
        records.append((order[seen] + base).int())
        ranges.append(touched.int())
        counts.append(len(seen))
    return Instances(torch.cat(records), torch.cat(ranges), counts, (len(boxes) * rows, columns))


def list_tiles(instances: Instances, limit: int = _ENTRIES) -> Iterator[TileLists]:
    """Lists for all tiles, in bands of tile rows with about `limit` entries at most."""
    rows, columns = instances.grid
    num_columns, first_row, num_rows = instances.ranges.long()[:, 1:].unbind(1)
    # Entries in each row of tiles, by differences at the instances' ends.
    change = torch.zeros(rows + 1, dtype=torch.int64, device=first_row.device)
    change.index_add_(0, first_row, num_columns)
    change.index_add_(0, first_row + num_rows, -num_columns)
    per_row = change.cumsum(0)[:rows].tolist()
    for low, high in _short_bands(bands(per_row, limit), max(1, _TILES // columns)):
        top = first_row.clamp_min(low)
        count = ((first_row + num_rows).clamp_max(high) - top).clamp_min(0) * num_columns
        ends = count.cumsum(0)
        total = sum(per_row[low:high])
        tiles = torch.empty(total, dtype=torch.int16, device=ends.device)
        entries = torch.empty(total, dtype=torch.int32, device=ends.device)
        if total:
            grid = (triton.cdiv(total, _EMITTED.value),)
            emit_kernel[grid](
                ends, instances.ranges, instances.records, tiles, entries, len(ends), total, low, columns,
                len(ends).bit_length(), num_warps=4,
            )  # fmt: skip
        tiles, slots = torch.sort(tiles, stable=True)
        numbers = torch.arange((high - low) * columns, dtype=torch.int32, device=ends.device)
        starts = torch.nn.functional.pad(torch.searchsorted(tiles.int(), numbers), (0, 1), value=total)
        yield TileLists((low, high), entries[slots], starts.int(), slots.int(), ends)


def _short_bands(longer: Iterator[tuple[int, int]], limit: int) -> Iterator[tuple[int, int]]:
    """Runs of rows cut into runs of at most `limit`."""
    for low, high in longer:
        for start in range(low, high, limit):
            yield start, min(start + limit, high)


@triton.jit(do_not_specialize=["num", "total", "low", "columns", "steps"])
@no_type_check
def emit_kernel(ends, ranges, records, tiles, entries, num, total, low, columns, steps):
    """Writes the tile and the record of each entry, instance after instance, each one's tiles row by row."""
    entry = tl.program_id(0).to(tl.int64) * _EMITTED + tl.arange(0, _EMITTED)
    inside = entry < total
    # The entry's instance: the first that ends behind it.
    first = tl.zeros([_EMITTED], tl.int32)
    past = first + num
    for _ in range(steps):
        middle = (first + past) // 2
        ended = tl.load(ends + middle, mask=inside & (first < past), other=0) <= entry
        first, past = tl.where(ended & (first < past), middle + 1, first), tl.where(ended, past, middle)
    before = tl.load(ends + first - 1, mask=inside & (first > 0), other=0)
    step = (entry - before).to(tl.int32)
    box = ranges + first.to(tl.int64) * 4
    across = tl.load(box + 1, mask=inside, other=1)
    column = (tl.load(box, mask=inside, other=0) + step % across) % columns
    row = tl.maximum(tl.load(box + 2, mask=inside, other=0), low) - low + step // across
    tl.store(tiles + entry, (row * columns + column).to(tl.int16), mask=inside)
    tl.store(entries + entry, tl.load(records + first, mask=inside, other=0), mask=inside)
