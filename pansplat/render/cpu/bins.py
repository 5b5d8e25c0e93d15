"""Stage three: for each tile of a picture, the Gaussians that touch it, front to back.

A counting sort of (Gaussian, tile) pairs, in bands of tile rows so that memory is bounded whatever the scene. For the
backward every pair has a slot of its own, and one Gaussian's slots follow one another: tiles write their gradients
without meeting, and each Gaussian sums its own in a fixed order.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.memory import Lease
from pansplat.render.cpu.records import BOX_BITS, TILE
from pansplat.render.cpu.threads import share

LIMIT = 1 << 26  # pairs listed at a time: 512 MB
_SHIFT = TILE.bit_length() - 1
_LAST = TILE - 1
_SIDE = np.int64(0xFFFF)  # a box as one word: x0, x1, y0, y1 from the lowest bits up
_NOWHERE = np.int64(1 << 32)  # the empty box of boxes.py: first row 1, last row 0


class TileLists(NamedTuple):
    """The Gaussians that touch each tile of some rows of tiles.

    Attributes:
        first_row: of tiles.
        entries, starts: see records.py.
        slots: of each entry, counted within these lists; empty unless asked for.
        offsets: (n + 1), where each Gaussian's slots begin; empty unless asked for.
        lease: of the entries and slots.
    """

    first_row: int
    entries: np.ndarray
    starts: np.ndarray
    slots: np.ndarray
    offsets: np.ndarray
    lease: Lease


@inlined
def _across(word, columns):
    """How many columns of tiles a packed box touches, going on at the left if it wraps."""
    first, last, _, _ = _tiles_of(word)
    if (word >> 16 & _SIDE) >= (word & _SIDE):
        return last - first + 1
    return min(columns - first + last + 1, columns)


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


@inlined
def _tiles_of(word):
    """First and last column and row of the tiles that a packed box touches, wherever it wraps."""
    shift = np.int64(_SHIFT)
    return (word & _SIDE) >> shift, (word >> 16 & _SIDE) >> shift, (word >> 32 & _SIDE) >> shift, word >> 48 >> shift


@kernel
def _count(part, ends, words, columns, low, high, counts, pairs):
    """Count the Gaussians in each tile, in one part of the scene, and the tiles that each touches (if asked for)."""
    row = counts[part]
    row[:] = 0
    for g in range(ends[part], ends[part + 1]):
        first, _, top, bottom = _tiles_of(words[g])
        if words[g] == _NOWHERE or bottom < low or top >= high:
            continue
        top, bottom = max(top, low), min(bottom, high - 1)
        across = _across(words[g], columns)
        if len(pairs) > 0:
            pairs[g + 1] = (bottom - top + 1) * across
        for i in range(top - low, bottom - low + 1):
            tile = i * columns
            row[tile + first] += 1
            for k in range(first + 1, first + across):
                row[tile + (k if k < columns else k - columns)] += 1


@kernel
def _fetch(part, ends, order, words, offsets, sorted_words, sorted_offsets):
    """Copy the boxes and first slots of one part of the Gaussians in drawing order.

    On its own, without a branch, so that the processor waits for many of the scattered boxes at once.
    """
    for j in range(ends[part], ends[part + 1]):
        sorted_words[j] = words[order[j]]
    if len(offsets) > 0:
        for j in range(ends[part], ends[part + 1]):
            sorted_offsets[j] = offsets[order[j]]


@inlined
def _enter(number, box, tile, slot, places, entries, slots):
    """Write a tile's next entry."""
    at = places[tile]
    places[tile] = at + 1
    entries[at] = number | box << 32
    if len(slots) > 0:
        slots[at] = slot


@kernel
def _list(part, cuts, order, words, columns, low, width, places, sorted_offsets, entries, slots):
    """Enter the Gaussians, in drawing order, in the lists of the tiles of one part of the band's rows."""
    low_row, high_row = cuts[part], cuts[part + 1]
    for j in range(len(order)):
        first, last, top, bottom = _tiles_of(words[j])
        if bottom < low_row or top >= high_row:
            continue
        x0, x1, y0, y1 = words[j] & _SIDE, words[j] >> 16 & _SIDE, words[j] >> 32 & _SIDE, words[j] >> 48
        number, across = np.int64(order[j]), last - first + 1
        slot = np.int64(0)
        if len(slots) > 0:  # counted from the band's first row, whoever lists what is above
            slot = sorted_offsets[j]
        if (across == 1) & (top == bottom) & (x1 >= x0):  # most
            box = (
                x0 & _LAST | (x1 & _LAST) << BOX_BITS | (y0 & _LAST) << (2 * BOX_BITS) | (y1 & _LAST) << (3 * BOX_BITS)
            )
            _enter(number, box, (top - low) * columns + first, slot, places, entries, slots)
            continue
        across = _across(words[j], columns)
        slot += (max(top, low_row) - max(top, low)) * across
        for i in range(max(top, low_row), min(bottom + 1, high_row)):
            corner = i << _SHIFT
            rows = max(y0 - corner, 0) << (2 * BOX_BITS) | min(y1 - corner, _LAST) << (3 * BOX_BITS)
            for k in range(first, first + across):
                column = k if k < columns else k - columns
                left, right = _columns_in_tile(x0, x1, column, width)
                _enter(
                    number, left | right << BOX_BITS | rows, (i - low) * columns + column, slot, places, entries, slots
                )
                slot += 1


def list_tiles(
    order: np.ndarray,
    boxes: np.ndarray,
    size: tuple[int, int],
    *,
    slots: bool,
    threads: int,
    limit: int = LIMIT,
) -> Iterator[TileLists]:
    """Lists for all tiles, in bands of tile rows with at most `limit` pairs (a single row may hold more).

    Args:
        order: Gaussians front to back, int32.
        boxes: (n, 4) int16, see boxes.py.
        size: height and width, pixels.
        slots: whether to number the pairs for the backward.
        threads: to work on; the lists do not depend on it.
        limit: number of pairs.
    """
    rows, columns = (-(-side // TILE) for side in size)
    words = boxes.view(np.int64)[:, 0]
    whole = _counted(words, columns, (0, rows), slots, threads)
    per_row = whole[0].reshape(rows, columns).sum(axis=1)
    bands = list(_bands(per_row.tolist(), limit))
    for low, high in bands:
        counted = whole if len(bands) == 1 else _counted(words, columns, (low, high), slots, threads)
        yield _band(order, words, size[1], (low, high), per_row[low:high], *counted, threads)


def _counted(
    words: np.ndarray, columns: int, band: tuple[int, int], slots: bool, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Number of Gaussians in each tile of a band, and where each Gaussian's slots begin (if asked for)."""
    ends = np.linspace(0, len(words), threads + 1).astype(np.int64)
    counts = np.empty((threads, (band[1] - band[0]) * columns), np.int64)
    offsets = np.zeros(len(words) + 1 if slots else 0, np.int64)
    share(lambda part: _count(part, ends, words, columns, *band, counts, offsets), threads, threads)
    return counts.sum(axis=0), np.cumsum(offsets, out=offsets)


def _band(
    order: np.ndarray,
    words: np.ndarray,
    width: int,
    band: tuple[int, int],
    per_row: np.ndarray,
    counts: np.ndarray,
    offsets: np.ndarray,
    threads: int,
) -> TileLists:
    columns, slots = len(counts) // (band[1] - band[0]), len(offsets) > 0
    starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    own, lease = Lease(), Lease()
    sorted_words, places = own.array(len(order), np.int64), starts[:-1].copy()
    sorted_offsets = own.array(len(order) if slots else 0, np.int64)
    ends = np.linspace(0, len(order), threads + 1).astype(np.int64)
    share(lambda part: _fetch(part, ends, order, words, offsets, sorted_words, sorted_offsets), threads, threads)
    entries = lease.array(int(starts[-1]), np.int64)
    numbers = lease.array(len(entries) if slots else 0, np.int64)
    # Rows of tiles shared out so that each thread has about as many pairs.
    cuts = band[0] + np.searchsorted(np.cumsum(per_row), np.linspace(0, per_row.sum(), threads + 1)[1:-1])
    cuts = np.concatenate((band[:1], cuts, band[1:])).astype(np.int64)
    share(
        lambda part: _list(
            part, cuts, order, sorted_words, columns, band[0], width, places, sorted_offsets, entries, numbers
        ),
        threads,
        threads,
    )
    return TileLists(band[0], entries.view(np.int32).reshape(-1, 2), starts, numbers, offsets, lease)


def _bands(per_row: list[int], limit: int) -> Iterator[tuple[int, int]]:
    """Split rows into runs whose pairs sum to at most `limit`, one row at least."""
    low, total = 0, 0
    for row, count in enumerate(per_row):
        if row > low and total + count > limit:
            yield low, row
            low, total = row, 0
        total += count
    yield low, len(per_row)
