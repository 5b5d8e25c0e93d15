"""Stage three: for each tile of a picture, the Gaussians that touch it, front to back.

A counting sort of (Gaussian, tile) pairs, in bands of tile rows so that memory is bounded whatever the scene. For the
backward every pair has a slot of its own, and one Gaussian's slots follow one another: tiles write their gradients
without meeting, and each Gaussian sums its own in a fixed order.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.observe import PIECE
from pansplat.render.cpu.records import BOX_BITS, TILE
from pansplat.render.cpu.threads import share

LIMIT = 1 << 26  # pairs listed at a time: 512 MB
_SHIFT = TILE.bit_length() - 1
_LAST = TILE - 1


class TileLists(NamedTuple):
    """The Gaussians that touch each tile of some rows of tiles.

    Attributes:
        first_row: of tiles.
        entries, starts: see records.py.
        slots: of each entry, counted within these lists; empty unless asked for.
        offsets: (n + 1), where each Gaussian's slots begin; empty unless asked for.
    """

    first_row: int
    entries: np.ndarray
    starts: np.ndarray
    slots: np.ndarray
    offsets: np.ndarray


@inlined
def _tile_columns(x0, x1, columns):
    """The first column of tiles that a box touches, and how many, going on at the left if it wraps."""
    first, last = np.int64(x0) >> _SHIFT, np.int64(x1) >> _SHIFT
    if x1 >= x0:
        return first, last - first + 1
    return first, min(columns - first + last + 1, columns)


@inlined
def _tile_rows(y0, y1, low, high):
    """The first row of tiles in [low, high) that a box touches, and how many; none where y1 < y0."""
    first, last = max(np.int64(y0) >> _SHIFT, low), min(np.int64(y1) >> _SHIFT, high - 1)
    return first, max(last - first + 1, 0) if y1 >= y0 else 0


@inlined
def _columns_in_tile(x0, x1, column, width):
    """First and last pixel column of a box within a tile, counted from the tile's corner."""
    corner = column << _SHIFT
    end = min(np.int64(_LAST), width - 1 - corner)
    low, high = max(x0 - corner, 0), min(x1 - corner, end)
    if x1 >= x0:
        return low, high
    from_left, to_right = x1 >= corner, x0 <= corner + end
    if from_left == to_right:
        return np.int64(0), end
    return (np.int64(0), high) if from_left else (low, end)


@kernel
def _count_rows(piece, boxes, columns, change):
    """Add up, as differences from row to row, how many pairs each row of tiles has."""
    for g in range(piece * PIECE, min((piece + 1) * PIECE, boxes.shape[0])):
        if boxes[g, 3] >= boxes[g, 2]:
            across = _tile_columns(boxes[g, 0], boxes[g, 1], columns)[1]
            change[piece, boxes[g, 2] >> _SHIFT] += across
            change[piece, (boxes[g, 3] >> _SHIFT) + 1] -= across


@kernel
def _count_pairs(piece, boxes, columns, low, high, counts):
    """Count the tiles that each Gaussian touches."""
    for g in range(piece * PIECE, min((piece + 1) * PIECE, boxes.shape[0])):
        down = _tile_rows(boxes[g, 2], boxes[g, 3], low, high)[1]
        counts[g + 1] = down * _tile_columns(boxes[g, 0], boxes[g, 1], columns)[1]


@kernel
def _fetch(part, ends, order, packed, sorted_packed):
    """Copy the boxes of one part of the Gaussians, whole words, in drawing order.

    On its own, without a branch, so that the processor waits for many of the scattered boxes at once.
    """
    for j in range(ends[part], ends[part + 1]):
        sorted_packed[j] = packed[order[j]]


@kernel
def _count_tiles(part, ends, boxes, columns, low, high, counts):
    """Count one part of the Gaussians in each tile."""
    row = counts[part]
    row[:] = 0
    for j in range(ends[part], ends[part + 1]):
        first, across = _tile_columns(boxes[j, 0], boxes[j, 1], columns)
        top, down = _tile_rows(boxes[j, 2], boxes[j, 3], low, high)
        for i in range(top - low, top - low + down):
            for k in range(first, first + across):
                row[i * columns + (k if k < columns else k - columns)] += 1


@kernel
def _places(counts, starts):
    """Turn counts into where each part's entries of each tile go, and the tiles' starts."""
    total = 0
    for tile in range(counts.shape[1]):
        starts[tile] = total
        for part in range(counts.shape[0]):
            count = counts[part, tile]
            counts[part, tile] = total
            total += count
    starts[counts.shape[1]] = total


@kernel
def _list(part, ends, order, sorted_boxes, columns, low, high, width, places, offsets, entries, slots):
    """Enter one part of the Gaussians, in drawing order, in the lists of the tiles they touch."""
    row = places[part]
    for j in range(ends[part], ends[part + 1]):
        x0, x1 = np.int64(sorted_boxes[j, 0]), np.int64(sorted_boxes[j, 1])
        y0, y1 = np.int64(sorted_boxes[j, 2]), np.int64(sorted_boxes[j, 3])
        first, across = _tile_columns(x0, x1, columns)
        top, down = _tile_rows(y0, y1, low, high)
        slot = offsets[order[j]] if len(slots) > 0 else 0
        for i in range(top, top + down):
            corner = i << _SHIFT
            bottom = max(y0 - corner, 0) << (2 * BOX_BITS) | min(y1 - corner, _LAST) << (3 * BOX_BITS)
            for k in range(first, first + across):
                column = k if k < columns else k - columns
                left, right = _columns_in_tile(x0, x1, column, width)
                tile = (i - low) * columns + column
                at = row[tile]
                row[tile] = at + 1
                entries[at, 0] = order[j]
                entries[at, 1] = left | right << BOX_BITS | bottom
                if len(slots) > 0:
                    slots[at] = slot
                    slot += 1


def list_tiles(
    order: np.ndarray, boxes: np.ndarray, size: tuple[int, int], *, slots: bool, threads: int, limit: int = LIMIT
) -> Iterator[TileLists]:
    """Lists for all tiles, in bands of tile rows with at most `limit` pairs (a single row may hold more).

    Args:
        order: Gaussians front to back, int32.
        boxes: (n, 4) int16, see boxes.py.
        size: height and width, pixels.
        slots: whether to number the pairs for the backward.
        threads: to work on.
    """
    rows, columns = (-(-side // TILE) for side in size)
    pieces = -(-len(boxes) // PIECE)
    change = np.zeros((pieces, rows + 1), np.int64)
    share(lambda piece: _count_rows(piece, boxes, columns, change), pieces, threads)
    per_row = np.cumsum(change.sum(axis=0))[:rows]
    for low, high in _bands(per_row.tolist(), limit):
        yield _band(order, boxes, size[1], columns, (low, high), slots, threads)


def _band(
    order: np.ndarray,
    boxes: np.ndarray,
    width: int,
    columns: int,
    band: tuple[int, int],
    wants_slots: bool,
    threads: int,
) -> TileLists:
    parts = threads if len(order) > PIECE else 1
    ends = np.linspace(0, len(order), parts + 1).astype(np.int64)
    counts = np.empty((parts, (band[1] - band[0]) * columns), np.int64)
    starts = np.empty(counts.shape[1] + 1, np.int64)
    packed, sorted_boxes = boxes.view(np.int64)[:, 0], np.empty((len(order), 4), np.int16)
    sorted_packed = sorted_boxes.view(np.int64)[:, 0]

    def count(part: int) -> None:
        _fetch(part, ends, order, packed, sorted_packed)
        _count_tiles(part, ends, sorted_boxes, columns, *band, counts)

    share(count, parts, threads)
    _places(counts, starts)
    offsets = np.zeros(len(boxes) + 1 if wants_slots else 0, np.int64)
    if wants_slots:
        pieces = -(-len(boxes) // PIECE)
        share(lambda piece: _count_pairs(piece, boxes, columns, *band, offsets), pieces, threads)
        np.cumsum(offsets, out=offsets)
    entries = np.empty((int(starts[-1]), 2), np.int32)
    slots = np.empty(len(entries) if wants_slots else 0, np.int64)
    share(
        lambda part: _list(part, ends, order, sorted_boxes, columns, *band, width, counts, offsets, entries, slots),
        parts,
        threads,
    )
    return TileLists(band[0], entries, starts, slots, offsets)


def _bands(per_row: list[int], limit: int) -> Iterator[tuple[int, int]]:
    """Split rows into runs whose pairs sum to at most `limit`, one row at least."""
    low, total = 0, 0
    for row, count in enumerate(per_row):
        if row > low and total + count > limit:
            yield low, row
            low, total = row, 0
        total += count
    yield low, len(per_row)
