"""Stage three: for each tile of a picture, the Gaussians that touch it, front to back.

A counting sort of (Gaussian, tile) pairs, in bands of tile rows so that memory is bounded whatever the scene. For the
backward every pair has a slot of its own, and one Gaussian's slots follow one another: tiles write their gradients
without meeting, and each Gaussian sums its own in a fixed order.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.memory import Lease
from pansplat.render.cpu.records import BOX_BITS, TILE
from pansplat.render.cpu.simd import element, prefetch, put
from pansplat.render.cpu.threads import share

LIMIT = 1 << 26  # pairs listed at a time: 512 MB
_SHIFT = TILE.bit_length() - 1
_LAST = TILE - 1
_SPARE = 8  # places: threads must not share a cache line
_AHEAD = 32  # Gaussians, between asking for what stands scattered and reading it
_SIDE = np.int64(0xFFFF)  # a box as one word: x0, x1, y0, y1 from the lowest bits up
_NOWHERE = np.int64(1 << 32)  # the empty box of boxes.py: first row 1, last row 0


class TileLists(NamedTuple):
    """The Gaussians that touch each tile of some rows of tiles.

    Attributes:
        first_row: of tiles.
        entries, starts: see records.py.
        slots: of each entry, counted within these lists; empty unless asked for.
        offsets: (n + 1), where each Gaussian's slots begin; empty unless asked for.
        lease: of the entries, slots and offsets.
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


@inlined
def _rows_of(word, low, high):
    """First row of tiles of a band that a packed box touches, and how many of them; 0 or less for none."""
    _, _, top, bottom = _tiles_of(word)
    top = max(top, low)
    return top, min(bottom, high - 1) - top + 1


@kernel
def _number(part, ends, words, columns, low, high, offsets):
    """Number the slots of one part of the scene, from 0 on: where each Gaussian's end."""
    total = np.int64(0)
    for g in range(ends[part], ends[part + 1]):
        _, down = _rows_of(words[g], low, high)
        total += _across(words[g], columns) * max(down, 0) if words[g] != _NOWHERE else 0
        offsets[g + 1] = total


@kernel
def _fetch(part, ends, order, words, columns, sorted_words, counts):
    """Copy the boxes of one part of the Gaussians in drawing order, and count those in each tile."""
    row = counts[part]
    row[:] = 0
    last = ends[part + 1] - 1
    for j in range(ends[part], ends[part + 1]):
        prefetch(words, np.int64(element(order, min(j + _AHEAD, last))))
        word = element(words, np.int64(element(order, j)))
        sorted_words[j] = word
        first, _, top, bottom = _tiles_of(word)
        across, down = _across(word, columns), bottom - top + 1
        if (across <= 2) & (down <= 2):  # most; with no branch that the processor could mistake
            corner, aside = top * columns + first, np.int64(across > 1)
            beyond = corner + (aside if first + 1 < columns else aside * (1 - columns))
            below = columns * (down - 1)
            put(row, corner, element(row, corner) + 1)
            put(row, beyond, element(row, beyond) + aside)
            put(row, corner + below, element(row, corner + below) + (down - 1))
            put(row, beyond + below, element(row, beyond + below) + aside * (down - 1))
            continue
        for i in range(top, bottom + 1):
            for k in range(first, first + across):
                row[i * columns + (k if k < columns else k - columns)] += 1


@kernel
def _gather(part, ends, order, numbers, sorted_numbers):
    """Copy numbers into drawing order: alone, so that the processor waits for many of them at once."""
    for j in range(ends[part], ends[part + 1]):
        sorted_numbers[j] = element(numbers, np.int64(element(order, j)))


@inlined
def _enter(number, box, tile, slot, places, entries, slots):
    """Write a tile's next entry."""
    _enter_if(np.int64(1), np.int64(0), number, box, tile, slot, places, entries, slots)


@inlined
def _enter_if(really, spare, number, box, tile, slot, places, entries, slots):
    """Write a tile's next entry if `really` is 1; if it is 0, something at the spare place."""
    at = element(places, tile)
    put(places, tile, at + really)
    at = at if really else spare
    put(entries, at, number | box << 32)
    if len(slots) > 0:
        put(slots, at, slot)


@inlined
def _enter_corners(spare, number, word, slot, low, columns, width, places, entries, slots):
    """Enter a Gaussian that touches at most two columns and two rows of tiles, with no branch to be mistaken."""
    first, last, top, bottom = _tiles_of(word)
    x0, x1, y0, y1 = word & _LAST, word >> 16 & _LAST, word >> 32 & _LAST, word >> 48 & _LAST
    aside, down = np.int64(first != last), bottom - top
    tile = (top - low) * columns + first
    beyond, below = tile + last - first, columns * down
    end = min(np.int64(_LAST), width - 1 - (first << _SHIFT))
    left, right = x0 | (end if aside else x1) << BOX_BITS, x1 << BOX_BITS
    upper, lower = (y0 | (np.int64(_LAST) if down else y1) << BOX_BITS) << (2 * BOX_BITS), y1 << (3 * BOX_BITS)
    _enter(number, left | upper, tile, slot, places, entries, slots)
    _enter_if(aside, spare, number, right | upper, beyond, slot + 1, places, entries, slots)
    slot += 1 + aside
    _enter_if(down, spare, number, left | lower, tile + below, slot, places, entries, slots)
    _enter_if(aside * down, spare, number, right | lower, beyond + below, slot + 1, places, entries, slots)


@kernel
def _list(part, ends, order, words, columns, low, high, width, all_places, sorted_offsets, entries, slots):
    """Enter one part of the Gaussians, in drawing order, in the lists of the tiles of a band.

    Args:
        entries, slots: with `_SPARE` to spare for each part.
    """
    places, spare = all_places[part], len(entries) - _SPARE * (part + 1)
    for j in range(ends[part], ends[part + 1]):
        word, number, slot = element(words, j), np.int64(element(order, j)), np.int64(0)
        if len(slots) > 0:
            slot = element(sorted_offsets, j)
        first, last, top, bottom = _tiles_of(word)
        x0, x1, y0, y1 = word & _SIDE, word >> 16 & _SIDE, word >> 32 & _SIDE, word >> 48
        across = _across(word, columns)
        small = (across <= 2) & (bottom - top <= 1) & ((x1 >= x0) | (first > last))
        if small & (top >= low) & (bottom < high):
            _enter_corners(spare, number, word, slot, low, columns, width, places, entries, slots)
            continue
        for i in range(max(top, low), min(bottom + 1, high)):
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
    words, own = boxes.view(np.int64)[:, 0], Lease()
    ends = np.linspace(0, len(order), threads + 1).astype(np.int64)
    sorted_words, counts = own.array(len(order), np.int64), np.empty((threads, rows * columns), np.int64)
    share(lambda part: _fetch(part, ends, order, words, columns, sorted_words, counts), threads, threads)
    per_row = counts.sum(axis=0).reshape(rows, columns).sum(axis=1)
    for low, high in _bands(per_row.tolist(), limit):
        lease, band = Lease(), counts[:, low * columns : high * columns]
        offsets = _numbered(words, columns, low, high, lease, threads) if slots else np.empty(0, np.int64)
        sorted_offsets = own.array(len(order) if slots else 0, np.int64)
        if slots:
            share(_bound(_gather, ends, order, offsets, sorted_offsets), threads, threads)
        totals = band.sum(axis=0)
        starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(totals)))
        places = starts[:-1] + np.cumsum(band, axis=0) - band
        count = int(starts[-1])
        entries = lease.array(count + _SPARE * threads, np.int64)
        numbers = lease.array(len(entries) if slots else 0, np.int64)
        band_list = columns, low, high, size[1], places, sorted_offsets, entries, numbers
        share(_bound(_list, ends, order, sorted_words, *band_list), threads, threads)
        yield TileLists(low, entries[:count].view(np.int32).reshape(-1, 2), starts, numbers[:count], offsets, lease)


def _numbered(words: np.ndarray, columns: int, low: int, high: int, lease: Lease, threads: int) -> np.ndarray:
    """Where each Gaussian's slots in a band begin."""
    ends = np.linspace(0, len(words), threads + 1).astype(np.int64)
    offsets = lease.array(len(words) + 1, np.int64)
    offsets[0] = 0
    share(_bound(_number, ends, words, columns, low, high, offsets), threads, threads)
    for part in range(1, threads):
        offsets[ends[part] + 1 : ends[part + 1] + 1] += offsets[ends[part]]
    return offsets


def _bands(per_row: list[int], limit: int) -> Iterator[tuple[int, int]]:
    """Split rows into runs whose pairs sum to at most `limit`, one row at least."""
    low, total = 0, 0
    for row, count in enumerate(per_row):
        if row > low and total + count > limit:
            yield low, row
            low, total = row, 0
        total += count
    yield low, len(per_row)


def _bound(work: Callable[..., None], *arguments: object) -> Callable[[int], None]:
    """A kernel with all its arguments but the first."""
    return lambda part: work(part, *arguments)
