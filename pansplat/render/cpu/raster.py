"""Compositing of tiles on the CPU, forward.

Source: docs/rendering.md, section 4. A tile is drawn in chunks of Gaussians. Each chunk is first listed by blocks of
4x2 pixels, one vector each; then each block takes its list front to back, with the transmittance and the sums in
registers. That leaves no branch inside that the processor could mistake.
"""

import numpy as np
import numpy.typing as npt

from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.records import TILE
from pansplat.render.cpu.simd import (
    LANES,
    choose,
    exp2,
    fill,
    load,
    minimum,
    multiply_add,
    some,
    spread,
    store,
)
from pansplat.render.cpu.tables import FLAT, Plane
from pansplat.render.cpu.threads import share
from pansplat.render.cpu.tile import (
    A_ONE,
    A_X,
    ACROSS,
    ALONG_ROW,
    B_ONE,
    B_X,
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    BLOCKS,
    CHUNK,
    CLOSED,
    CUT,
    FORMS,
    L_ONE,
    L_X,
    LEVEL_ROW,
    MOST,
    PIXELS,
    gather,
    place_tile,
)

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

_PIECES = 8  # of work a thread
_GROUP = 4  # values summed in one pass


def raster_forward(
    records: Floats,
    values: Floats,
    entries: Integers,
    starts: Longs,
    plane: Plane,
    sums: Floats,
    *,
    first_row: int = 0,
    threads: int = 1,
) -> None:
    """Write the sums of weight x (values, 1) of a band of tile rows.

    Args:
        records, values, entries, starts: see `records`; `starts` covers whole rows of tiles.
        plane: the picture's pixels.
        sums: (channel + 2, height, width), written where the band lies.
        first_row: of tiles, the band's first.
        threads: to work on; the result does not depend on it.
    """
    pieces = pieces_of(starts, threads)
    flat = records.reshape(-1), values, entries.reshape(-1), starts
    table = plane.kind, plane.columns, plane.rows, plane.rotation

    def draw(piece: int) -> None:
        _draw_tiles(*flat, *table, sums, first_row, pieces[piece], pieces[piece + 1])

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
    records, values, entries, starts, kind, columns, rows, rotation, sums, first_row, low, high
):
    width = len(columns)
    tiles_across = (width + TILE - 1) // TILE
    num_values = values.shape[1]
    groups = (num_values + _GROUP - 1) // _GROUP
    offsets, middle = np.empty(3 * PIXELS, np.float32), np.empty(6, np.float32)
    through, added = np.empty(PIXELS, np.float32), np.empty(groups * _GROUP * PIXELS, np.float32)
    forms = np.empty(FORMS * CHUNK, np.float32)
    colours = np.zeros(groups * _GROUP * CHUNK, np.float32)
    lists, counts = np.empty(BLOCKS * CHUNK, np.uint8), np.zeros(BLOCKS, np.int64)
    weights = np.empty(CHUNK * LANES, np.float32)
    exact = np.float32(0 if kind == FLAT else 1)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE, (first_row + tile // tiles_across) * TILE
        place_tile(kind, columns, rows, rotation, left, top, offsets, middle, through)
        added[:] = 0
        for first in range(starts[tile], starts[tile + 1], CHUNK):
            count = min(CHUNK, starts[tile + 1] - first)
            gather(records, entries, first, count, middle, exact, forms)
            _gather_values(values, entries, first, count, colours)
            _list_blocks(entries, first, count, lists, counts)
            is_open = False
            for block in range(BLOCKS):
                if groups == 1:
                    is_open |= _draw_block(block, counts[block], lists, forms, colours, offsets, through, added)
                else:
                    is_open |= _weigh_block(block, counts[block], lists, forms, offsets, through, weights)
                    _add_block(block, counts[block], lists, weights, colours, added)
                counts[block] = 0
            if not is_open:
                break
        _write_tile(through, added, sums, left, top, num_values)


@inlined
def _gather_values(values, entries, first, count, colours):  # type: ignore[no-untyped-def]
    for at in range(count):
        index = entries[2 * (first + at)]
        for channel in range(values.shape[1]):
            colours[channel * CHUNK + at] = values[index, channel]


@inlined
def _list_blocks(entries, first, count, lists, counts):  # type: ignore[no-untyped-def]
    """List for each block, in order, the Gaussians of the chunk whose boxes touch it."""
    for at in range(count):
        box = entries[2 * (first + at) + 1]
        left, right = (box & 255) // BLOCK_WIDTH, ((box >> 8) & 255) // BLOCK_WIDTH
        top, bottom = ((box >> 16) & 255) // BLOCK_HEIGHT, ((box >> 24) & 255) // BLOCK_HEIGHT
        for y in range(top, bottom + 1):
            for block in range(y * ACROSS + left, y * ACROSS + right + 1):
                lists[block * CHUNK + counts[block]] = at
                counts[block] += 1


@inlined
def opacity(forms, s, x, y, z, through):  # type: ignore[no-untyped-def]
    """Alpha of Gaussian `s` of the chunk at the pixels of a block; 0 where a pixel is closed."""
    a, b, front = _forms_at(forms, s, x, y, z)
    q = multiply_add(a, a, b * b)
    below = multiply_add(front, front, spread(forms, ALONG_ROW * CHUNK + s) * q)
    power = spread(forms, LEVEL_ROW * CHUNK + s) - q / below
    zero = fill(np.float32(0))
    seen = (fill(np.float32(CUT)) <= power) & (front > zero) & (through > fill(np.float32(CLOSED)))
    return choose(seen, minimum(exp2(power), fill(np.float32(MOST))), zero)


@inlined
def _forms_at(forms, s, x, y, z):  # type: ignore[no-untyped-def]
    a = multiply_add(spread(forms, A_X * CHUNK + s), x, spread(forms, A_ONE * CHUNK + s))
    b = multiply_add(spread(forms, B_X * CHUNK + s), x, spread(forms, B_ONE * CHUNK + s))
    front = multiply_add(spread(forms, L_X * CHUNK + s), x, spread(forms, L_ONE * CHUNK + s))
    a = multiply_add(spread(forms, (A_X + 1) * CHUNK + s), y, a)
    b = multiply_add(spread(forms, (B_X + 1) * CHUNK + s), y, b)
    front = multiply_add(spread(forms, (L_X + 1) * CHUNK + s), y, front)
    a = multiply_add(spread(forms, (A_X + 2) * CHUNK + s), z, a)
    b = multiply_add(spread(forms, (B_X + 2) * CHUNK + s), z, b)
    front = multiply_add(spread(forms, (L_X + 2) * CHUNK + s), z, front)
    return a, b, front


@inlined
def _draw_block(block, count, lists, forms, colours, offsets, through, added):  # type: ignore[no-untyped-def]
    """Draw a block's list, four values a Gaussian; whether it stays open."""
    pixel = block * LANES
    passes = load(through, pixel)
    if not some(passes > fill(np.float32(CLOSED))):
        return False
    x, y, z = load(offsets, pixel), load(offsets, PIXELS + pixel), load(offsets, 2 * PIXELS + pixel)
    sum0, sum1 = load(added, pixel), load(added, PIXELS + pixel)
    sum2, sum3 = load(added, 2 * PIXELS + pixel), load(added, 3 * PIXELS + pixel)
    for place in range(block * CHUNK, block * CHUNK + count):
        s = np.int64(lists[place])
        weight = opacity(forms, s, x, y, z, passes) * passes
        passes = passes - weight
        sum0 = multiply_add(weight, spread(colours, s), sum0)
        sum1 = multiply_add(weight, spread(colours, CHUNK + s), sum1)
        sum2 = multiply_add(weight, spread(colours, 2 * CHUNK + s), sum2)
        sum3 = multiply_add(weight, spread(colours, 3 * CHUNK + s), sum3)
    store(through, pixel, passes)
    store(added, pixel, sum0)
    store(added, PIXELS + pixel, sum1)
    store(added, 2 * PIXELS + pixel, sum2)
    store(added, 3 * PIXELS + pixel, sum3)
    return some(passes > fill(np.float32(CLOSED)))


@inlined
def _weigh_block(block, count, lists, forms, offsets, through, weights):  # type: ignore[no-untyped-def]
    """The weights of a block's list at its pixels; whether the block stays open."""
    pixel = block * LANES
    passes = load(through, pixel)
    x, y, z = load(offsets, pixel), load(offsets, PIXELS + pixel), load(offsets, 2 * PIXELS + pixel)
    for at in range(count):
        s = np.int64(lists[block * CHUNK + at])
        weight = opacity(forms, s, x, y, z, passes) * passes
        passes = passes - weight
        store(weights, at * LANES, weight)
    store(through, pixel, passes)
    return some(passes > fill(np.float32(CLOSED)))


@inlined
def _add_block(block, count, lists, weights, colours, added):  # type: ignore[no-untyped-def]
    """Add a block's weighted values to the sums, four at a time."""
    for first in range(0, len(added) // PIXELS, _GROUP):
        pixel, column = first * PIXELS + block * LANES, first * CHUNK
        sum0, sum1 = load(added, pixel), load(added, PIXELS + pixel)
        sum2, sum3 = load(added, 2 * PIXELS + pixel), load(added, 3 * PIXELS + pixel)
        for at in range(count):
            s = column + np.int64(lists[block * CHUNK + at])
            weight = load(weights, at * LANES)
            sum0 = multiply_add(weight, spread(colours, s), sum0)
            sum1 = multiply_add(weight, spread(colours, CHUNK + s), sum1)
            sum2 = multiply_add(weight, spread(colours, 2 * CHUNK + s), sum2)
            sum3 = multiply_add(weight, spread(colours, 3 * CHUNK + s), sum3)
        store(added, pixel, sum0)
        store(added, PIXELS + pixel, sum1)
        store(added, 2 * PIXELS + pixel, sum2)
        store(added, 3 * PIXELS + pixel, sum3)


@inlined
def _write_tile(through, added, sums, left, top, num_values):  # type: ignore[no-untyped-def]
    """Copy a tile's sums into the picture; the weights of a ray and what passes sum to 1."""
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        if x < sums.shape[2] and y < sums.shape[1]:
            for channel in range(num_values):
                sums[channel, y, x] = added[channel * PIXELS + pixel]
            sums[num_values, y, x] = np.float32(1) - through[pixel]
