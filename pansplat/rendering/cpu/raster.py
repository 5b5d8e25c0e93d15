"""Compositing of tiles on the CPU, forward.

Source: docs/rendering.md, section 4. A tile is drawn in chunks of Gaussians. Each chunk is first listed by blocks of
4x2 pixels, one vector each; then each block takes its list front to back, with the transmittance and the sums in
registers. That leaves no branch inside that the processor could mistake.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pansplat.rendering.cpu.bits import list_bits
from pansplat.rendering.cpu.compiling import borrowing, kernel
from pansplat.rendering.cpu.memory import Lease
from pansplat.rendering.cpu.records import TILE
from pansplat.rendering.cpu.simd import (
    LANES,
    choose,
    element,
    exp2,
    fill,
    how_many,
    load,
    maximum,
    minimum,
    multiply_add,
    negative,
    put,
    side_by_side,
    some,
    spread,
    store,
)
from pansplat.rendering.cpu.tables import FLAT, Plane
from pansplat.rendering.cpu.threads import share
from pansplat.rendering.cpu.tile import (
    ACROSS,
    ALONG_ROW,
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    BLOCKS,
    CHUNK,
    CLOSED,
    CUT,
    EDGES,
    FEW,
    FORMS,
    LEVEL_ROW,
    MIDDLE,
    MOST,
    NOTHING,
    PIXELS,
    PLACE,
    ROWS,
    THIRD,
    WORDS,
    A,
    B,
    L,
    ask_ahead,
    gather,
    list_blocks,
    open_pixels,
    place_pixels,
    place_tile,
)

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

_PIECES = 8  # of work a thread
HALF = CHUNK + 64  # room for the powers of a block, and for what `list_bits` writes over


class Kept(NamedTuple):
    """What the forward leaves for the backward: how much passed before each chunk of a tile.

    Attributes:
        through: (row, PIXELS) float32, transmittances before each chunk drawn.
        rows: (tile + 1), where each tile's rows begin.
        drawn: (tile), how many chunks were drawn before the tile closed.
    """

    through: Floats
    rows: Longs
    drawn: Longs


def room_to_keep(starts: Longs, lease: Lease) -> Kept:
    """Room for what the backward of these tile lists needs."""
    chunks = -(-np.diff(starts) // CHUNK)
    rows = np.concatenate((np.zeros(1, np.int64), np.cumsum(chunks)))
    return Kept(lease.array((int(rows[-1]), PIXELS), np.float32), rows, np.zeros(len(chunks), np.int64))


def raster_forward(
    records: Floats,
    values: Floats,
    entries: Integers,
    starts: Longs,
    plane: Plane,
    sums: Floats,
    *,
    first_row: int = 0,
    kept: Kept | None = None,
    threads: int = 1,
) -> None:
    """Write the sums of weight x (values, 1) of a band of tile rows.

    Args:
        records, values, entries, starts: see `records`; `starts` covers whole rows of tiles.
        plane: the picture's pixels.
        sums: (channel + 2, height, width), written where the band lies.
        first_row: of tiles, the band's first.
        kept: filled in if given, for the backward.
        threads: to work on; the result does not depend on it.
    """
    pieces = pieces_of(starts, threads)
    flat = records.reshape(-1), values, entries.reshape(-1), starts
    table = plane.kind, plane.columns, plane.rows, plane.rotation
    room = kept or Kept(np.empty((0, PIXELS), np.float32), starts, starts)

    def draw(piece: int) -> None:
        _draw_tiles(*flat, *table, sums, *room, first_row, pieces[piece], pieces[piece + 1])

    share(draw, len(pieces) - 1, threads)


def pieces_of(starts: Longs, threads: int) -> list[int]:
    """Where to cut a band of tiles into pieces of about the same number of entries."""
    tiles = len(starts) - 1
    # Empty tiles are not free: count each as some entries.
    cost = starts - starts[0] + 32 * np.arange(tiles + 1)
    wanted = np.linspace(0, cost[-1], min(tiles, _PIECES * threads if threads > 1 else 1) + 1)
    return [int(cut) for cut in np.unique(np.searchsorted(cost, wanted))]


@kernel
def _draw_tiles(  # type: ignore[no-untyped-def]
    records, values, entries, starts, kind, columns, rows, rotation, sums, kept, kept_rows, drawn_chunks, first_row,
    low, high,
):  # fmt: skip
    tiles_across = (len(columns) + TILE - 1) // TILE
    num_values = values.shape[1]
    offsets, centre, place = np.empty(3 * PIXELS, np.float32), np.empty(3), np.empty(PLACE, np.float32)
    through, added = np.empty(PIXELS, np.float32), np.empty(num_values * PIXELS, np.float32)
    forms, colours = np.empty(FORMS * CHUNK, np.float32), np.empty(num_values * CHUNK, np.float32)
    touched = np.empty(WORDS * EDGES, np.uint64)
    powers, places = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF, np.uint8)
    exact = np.float32(0 if kind == FLAT else 1)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE, (first_row + tile // tiles_across) * TILE
        tile_is_wide, placed = place_tile(kind, columns, rows, rotation, left, top, centre, place), -1
        open_pixels(columns, rows, left, top, through)
        added[:] = 0
        chunks = 0
        for first in range(starts[tile], starts[tile + 1], CHUNK):
            count = min(CHUNK, starts[tile + 1] - first)
            if len(kept) > 0:
                _keep(through, kept, kept_rows[tile] + chunks)
            chunks += 1
            wide = gather(records, values, entries, first, count, place, exact, tile_is_wide, forms, colours)
            if placed != wide:
                place_pixels(kind, columns, rows, rotation, left, top, centre, place, wide, offsets)
                placed = np.int64(wide)
            list_blocks(entries, first, count, touched)
            is_open = False
            # The next block's powers are found before a block is drawn, so that their latencies hide each other.
            drawn, reached, following, half = -1, 0, 0, 0
            for block in range(BLOCKS + 1):
                if block < BLOCKS:
                    ask_ahead(records, values, entries, block, first + CHUNK)
                    if not some(load(through, block * LANES) > fill(np.float32(CLOSED))):
                        continue
                    following = find_powers(block, touched, wide, forms, offsets, powers, places, half)
                if drawn >= 0 and num_values == FEW:
                    is_open |= _draw_block(drawn, reached, powers, places, HALF - half, colours, through, added)
                elif drawn >= 0:
                    is_open |= _weigh_block(drawn, reached, powers, HALF - half, through)
                    _add_block(drawn, reached, powers, places, HALF - half, colours, num_values, added)
                drawn, reached, half = block, following, HALF - half
            if not is_open:
                break
        if len(kept) > 0:
            drawn_chunks[tile] = chunks
        _write_tile(through, added, sums, left, top, num_values)


@borrowing
def _keep(through, kept, row):  # type: ignore[no-untyped-def]
    for pixel in range(PIXELS):
        kept[row, pixel] = through[pixel]


@borrowing
def find_powers(block, touched, wide, forms, offsets, powers, places, start):  # type: ignore[no-untyped-def]
    """Log2 of the peak times the response at a block's pixels, for the Gaussians of the chunk that reach it.

    Returns:
        How many of `powers` (LANES each) and `places` (in the chunk) were written, front to back; one more that is
        nothing follows. Boxes have corners: some of them no pixel sees. Leaving those out would make each wait for the
        one before.
    """
    pixel = block * LANES
    x, y, z = load(offsets, pixel), load(offsets, PIXELS + pixel), load(offsets, 2 * PIXELS + pixel)
    total = _list_places(block, touched, places, start)
    zero = fill(np.float32(0))
    for at in range(start, start + total):
        s = np.int64(element(places, at))
        a, b, front = forms_at(wide, forms, s, x, y, z)
        if wide:
            front = choose(front > zero, front, fill(np.float32(np.nan)))
        q = multiply_add(a, a, b * b)
        below = multiply_add(maximum(zero, front), front, spread(forms, ALONG_ROW * CHUNK + s) * q)
        store(powers, at * LANES, spread(forms, LEVEL_ROW * CHUNK + s) - q / below)
    store(powers, (start + total) * LANES, fill(np.float32(NOTHING)))
    return total


@borrowing
def _list_places(block, touched, places, start):  # type: ignore[no-untyped-def]
    """Write down which Gaussians of the chunk reach a block, and one more; how many do."""
    at, column, row = start, block % ACROSS, ROWS + block // ACROSS
    for word in range(WORDS):
        bits = element(touched, word * EDGES + column) & element(touched, word * EDGES + row)
        list_bits(places, at, bits, word * 64)
        at += how_many(bits)
    put(places, at, np.uint8(0))
    return at - start


@borrowing
def forms_at(wide, forms, s, x, y, z):  # type: ignore[no-untyped-def]
    """A, B, L of Gaussian `s` of the chunk at a block's pixels, up to a factor a pixel, which powers do not see.

    The offsets from the Gaussian come first: small numbers, so that nothing large cancels in the sums.
    """
    x, y = x - spread(forms, MIDDLE * CHUNK + s), y - spread(forms, (MIDDLE + 1) * CHUNK + s)
    a = spread(forms, A * CHUNK + s) * x
    b = spread(forms, B * CHUNK + s) * x
    front = multiply_add(spread(forms, L * CHUNK + s), x, fill(np.float32(1)))
    a = multiply_add(spread(forms, (A + 1) * CHUNK + s), y, a)
    b = multiply_add(spread(forms, (B + 1) * CHUNK + s), y, b)
    front = multiply_add(spread(forms, (L + 1) * CHUNK + s), y, front)
    if wide:
        z = z - spread(forms, (THIRD + 3) * CHUNK + s)
        a = multiply_add(spread(forms, THIRD * CHUNK + s), z, a)
        b = multiply_add(spread(forms, (THIRD + 1) * CHUNK + s), z, b)
        front = multiply_add(spread(forms, (THIRD + 2) * CHUNK + s), z, front)
    return a, b, front


@borrowing
def opacity(power):  # type: ignore[no-untyped-def]
    """Alpha of a power: 0 below the cut, at most MOST."""
    alpha = minimum(exp2(power), fill(np.float32(MOST)))
    return choose(fill(np.float32(CUT)) <= power, alpha, fill(np.float32(0)))


@borrowing
def _draw_block(block, reached, powers, places, start, colours, through, added):  # type: ignore[no-untyped-def]
    """Draw what reaches a block, four values a Gaussian; whether it stays open."""
    pixel = block * LANES
    passes = load(through, pixel)
    sum0, sum1 = load(added, pixel), load(added, PIXELS + pixel)
    sum2, sum3 = load(added, 2 * PIXELS + pixel), load(added, 3 * PIXELS + pixel)
    for at in range(start, start + reached, 2):  # a half-full last turn adds nothing
        colour, other = FEW * np.int64(element(places, at)), FEW * np.int64(element(places, at + 1))
        alpha, beta = opacity(load(powers, at * LANES)), opacity(load(powers, at * LANES + LANES))
        weight = alpha * passes
        passes = multiply_add(negative(alpha), passes, passes)
        sum0 = multiply_add(weight, spread(colours, colour), sum0)
        sum1 = multiply_add(weight, spread(colours, colour + 1), sum1)
        sum2 = multiply_add(weight, spread(colours, colour + 2), sum2)
        sum3 = multiply_add(weight, spread(colours, colour + 3), sum3)
        weight = beta * passes
        passes = multiply_add(negative(beta), passes, passes)
        sum0 = multiply_add(weight, spread(colours, other), sum0)
        sum1 = multiply_add(weight, spread(colours, other + 1), sum1)
        sum2 = multiply_add(weight, spread(colours, other + 2), sum2)
        sum3 = multiply_add(weight, spread(colours, other + 3), sum3)
    store(through, pixel, passes)
    store(added, pixel, sum0)
    store(added, PIXELS + pixel, sum1)
    store(added, 2 * PIXELS + pixel, sum2)
    store(added, 3 * PIXELS + pixel, sum3)
    return some(passes > fill(np.float32(CLOSED)))


@borrowing
def _weigh_block(block, reached, powers, start, through):  # type: ignore[no-untyped-def]
    """Turn powers into weights; whether the block stays open."""
    passes = load(through, block * LANES)
    for at in range(start, start + reached):
        alpha = opacity(load(powers, at * LANES))
        store(powers, at * LANES, alpha * passes)
        passes = multiply_add(negative(alpha), passes, passes)
    store(through, block * LANES, passes)
    return some(passes > fill(np.float32(CLOSED)))


@borrowing
def _add_block(block, reached, weights, places, start, colours, num_values, added):  # type: ignore[no-untyped-def]
    """Add a block's weighted values to the sums, any number of them."""
    for channel in range(num_values):
        pixel = channel * PIXELS + block * LANES
        total = load(added, pixel)
        for at in range(start, start + reached):
            colour = num_values * np.int64(element(places, at)) + channel
            total = multiply_add(load(weights, at * LANES), spread(colours, colour), total)
        store(added, pixel, total)


@borrowing
def _write_tile(through, added, sums, left, top, num_values):  # type: ignore[no-untyped-def]
    """Copy a tile's sums into the picture; the weights of a ray and what passes sum to 1."""
    width, height = sums.shape[2], sums.shape[1]
    if left + TILE > width or top + TILE > height:
        _write_part(through, added, sums, left, top, num_values)
        return
    picture, one = sums.reshape(-1), fill(np.float32(1))
    for block in range(0, BLOCKS, 2):
        pixel = block * LANES
        at = (top + block // ACROSS * BLOCK_HEIGHT) * width + left + block % ACROSS * BLOCK_WIDTH
        for channel in range(num_values):
            plane, place = channel * PIXELS + pixel, channel * height * width + at
            upper, lower = side_by_side(load(added, plane), load(added, plane + LANES))
            store(picture, place, upper)
            store(picture, place + width, lower)
        place = num_values * height * width + at
        upper, lower = side_by_side(one - load(through, pixel), one - load(through, pixel + LANES))
        store(picture, place, upper)
        store(picture, place + width, lower)


@borrowing
def _write_part(through, added, sums, left, top, num_values):  # type: ignore[no-untyped-def]
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        if x < sums.shape[2] and y < sums.shape[1]:
            for channel in range(num_values):
                sums[channel, y, x] = added[channel * PIXELS + pixel]
            sums[num_values, y, x] = np.float32(1) - through[pixel]
