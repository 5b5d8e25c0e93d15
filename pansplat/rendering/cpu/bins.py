"""Stage three: for each tile of a picture, the Gaussians that touch it, in the order of their numbers.

A counting sort of (Gaussian, tile) pairs, in bands of tile rows so that memory is bounded whatever the scene. For the
backward every pair has a slot of its own, and one Gaussian's slots follow one another: tiles write their gradients
without meeting, and each Gaussian sums its own in a fixed order.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from pansplat.rendering.cpu.compiling import inlined, kernel
from pansplat.rendering.cpu.memory import Lease
from pansplat.rendering.cpu.records import BOX_BITS, TILE
from pansplat.rendering.cpu.simd import element, prefetch_to_write, put
from pansplat.rendering.cpu.threads import share

LIMIT = 1 << 26  # pairs listed at a time: 512 MB
_SHIFT = TILE.bit_length() - 1
_LAST = TILE - 1
_PARTS = 4  # of the scene a thread: some processors are slower than others
_HELD = 512  # pairs noted before they are entered: two small loops take half as long as one large
_AHEAD = 16  # entries of a tile, between asking for their place and writing it
_SIDE = np.int64(0xFFFF)  # a box as one word: x0, x1, y0, y1 from the lowest bits up
NOWHERE = np.int64(1 << 32)  # a box as one word, the empty one of boxes.py: first row 1, last row 0


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


@kernel
def _count(part, ends, words, rows, columns, counts):
    """Count the Gaussians of one part of the scene in each tile.

    Args:
        rows, columns: of tiles.
        counts: (part, tile), written.
    """
    # As steps up and down between neighbouring tiles: the places of a box are apart, whatever its size.
    across, row = columns + 1, counts[part]
    steps = np.zeros((rows + 1) * across, np.int64)
    for g in range(ends[part], ends[part + 1]):
        word = element(words, g)
        first, last, top, bottom = _tiles_of(word)
        upper, lower = top * across, (bottom + 1 if word != NOWHERE else top) * across
        if (word >> 16 & _SIDE) < (word & _SIDE):  # goes on at the left
            if last < first:
                _add(steps, upper, 1)
                _add(steps, lower, -1)
            else:
                first, last = np.int64(0), columns - 1
        _add(steps, upper + first, 1)
        _add(steps, upper + last + 1, -1)
        _add(steps, lower + first, -1)
        _add(steps, lower + last + 1, 1)
    for i in range(rows):
        total = np.int64(0)
        for k in range(columns):
            total += steps[i * across + k]
            row[i * columns + k] = total + (row[(i - 1) * columns + k] if i > 0 else 0)


@inlined
def _add(numbers, at, step):
    """Add to one element."""
    put(numbers, at, element(numbers, at) + step)


@inlined
def _note(tile, number, box, at, tiles, pairs):
    """Write down a pair of a Gaussian and a tile."""
    put(tiles, at, tile)
    put(pairs, at, number | box << 32)


@inlined
def _note_corners(number, word, low, columns, width, held, tiles, pairs):
    """Note a Gaussian that touches at most two columns and two rows of tiles, with no branch to be mistaken.

    Returns:
        How many pairs are held then; each is written over by the next unless it counts.
    """
    first, last, top, bottom = _tiles_of(word)
    x0, x1, y0, y1 = word & _LAST, word >> 16 & _LAST, word >> 32 & _LAST, word >> 48 & _LAST
    aside, down = np.int64(first != last), bottom - top
    end = min(np.int64(_LAST), width - 1 - (first << _SHIFT))
    left, right = x0 | (end if aside else x1) << BOX_BITS, x1 << BOX_BITS
    upper, lower = (y0 | (np.int64(_LAST) if down else y1) << BOX_BITS) << (2 * BOX_BITS), y1 << (3 * BOX_BITS)
    above, below = (top - low) * columns, (bottom - low) * columns
    _note(above + first, number, left | upper, held, tiles, pairs)
    _note(above + last, number, right | upper, held + 1, tiles, pairs)
    held += 1 + aside
    _note(below + first, number, left | lower, held, tiles, pairs)
    held += down
    _note(below + last, number, right | lower, held, tiles, pairs)
    return held + (aside & down)


@inlined
def _note_all(number, word, low, high, columns, width, held, tiles, pairs):
    """Note a Gaussian that touches any tiles of a band; how many pairs are held then."""
    first, _, top, bottom = _tiles_of(word)
    x0, x1, y0, y1 = word & _SIDE, word >> 16 & _SIDE, word >> 32 & _SIDE, word >> 48
    for i in range(max(top, low), min(bottom + 1, high) if word != NOWHERE else low):
        corner = i << _SHIFT
        rows = max(y0 - corner, 0) << (2 * BOX_BITS) | min(y1 - corner, _LAST) << (3 * BOX_BITS)
        for k in range(first, first + _across(word, columns)):
            column = k if k < columns else k - columns
            left, right = _columns_in_tile(x0, x1, column, width)
            _note((i - low) * columns + column, number, left | right << BOX_BITS | rows, held, tiles, pairs)
            held += 1
    return held


@kernel
def _list(part, ends, words, columns, low, high, width, all_places, first_slots, entries, slots, offsets):
    """Enter one part of the Gaussians in the lists of the tiles of a band.

    Args:
        low, high: rows of tiles.
        all_places: (part, tile of the band), where each part's entries begin.
        first_slots: of each part.
        entries: words of 64 bits.
        slots: if there are any, each entry's is written.
        offsets: likewise, where each Gaussian's slots end.
    """
    places, slot, held = all_places[part], first_slots[part], np.int64(0)
    room = _HELD + len(places) + 4
    tiles, pairs = np.empty(room, np.int64), np.empty(room, np.int64)
    for g in range(ends[part], ends[part + 1]):
        word = element(words, g)
        first, last, top, bottom = _tiles_of(word)
        small = (last - first <= 1) & (bottom - top <= 1) & ((word >> 16 & _SIDE) >= (word & _SIDE))
        if small & (top >= low) & (bottom < high) & (word != NOWHERE):
            held = _note_corners(g, word, low, columns, width, held, tiles, pairs)
        else:
            held = _note_all(g, word, low, high, columns, width, held, tiles, pairs)
        if len(offsets) > 0:
            put(offsets, g + 1, slot + held)
        if held >= _HELD or g == ends[part + 1] - 1:
            for k in range(held):
                tile = element(tiles, k)
                place = element(places, tile)
                put(places, tile, place + 1)
                put(entries, place, element(pairs, k))
                prefetch_to_write(entries, place + _AHEAD)
                if len(slots) > 0:
                    put(slots, place, slots.dtype.type(slot + k))
                    prefetch_to_write(slots, place + _AHEAD)
            slot, held = slot + held, np.int64(0)


def list_tiles(
    boxes: np.ndarray, size: tuple[int, int], *, slots: bool, threads: int, limit: int = LIMIT
) -> Iterator[TileLists]:
    """Lists for all tiles, in bands of tile rows with at most `limit` pairs (a single row may hold more).

    Args:
        boxes: (n, 4) int16, see boxes.py.
        size: height and width, pixels.
        slots: whether to number the pairs for the backward.
        threads: to work on; the lists do not depend on it.
        limit: number of pairs.
    """
    rows, columns = (-(-side // TILE) for side in size)
    words = boxes.view(np.int64)[:, 0]
    parts = _PARTS * threads if threads > 1 else 1
    ends = np.linspace(0, len(words), parts + 1).astype(np.int64)
    all_counts = np.empty((parts, rows * columns), np.int64)
    share(lambda part: _count(part, ends, words, rows, columns, all_counts), parts, threads)
    per_row = all_counts.sum(axis=0).reshape(rows, columns).sum(axis=1)
    for low, high in _bands(per_row.tolist(), limit):
        counts, lease = all_counts[:, low * columns : high * columns], Lease()
        starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts.sum(axis=0))))
        places, per_part = starts[:-1] + np.cumsum(counts, axis=0) - counts, counts.sum(axis=1)
        count = int(starts[-1])
        entries = lease.array(count, np.int64)
        numbers = lease.array(count if slots else 0, np.int32 if count < 2**31 else np.int64)
        offsets = lease.array(len(words) + 1 if slots else 0, np.int64)
        offsets[:1] = 0
        lists = places, np.cumsum(per_part) - per_part, entries, numbers, offsets
        share(_bound(_list, ends, words, columns, low, high, size[1], *lists), parts, threads)
        yield TileLists(low, entries.view(np.int32).reshape(-1, 2), starts, numbers, offsets, lease)


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
