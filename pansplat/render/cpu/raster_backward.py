"""Compositing of tiles on the CPU, backward.

Source: docs/rendering.md, sections 3 and 4. A tile is swept front to back as in the forward, block by block, keeping
the weights of each pair of a Gaussian and a block. Then back to front: what lies behind a Gaussian is summed from the
back, where it is small, so that nothing cancels and nothing is divided by a transmittance. Last Gaussian by Gaussian:
their moments over all their blocks stay in registers, and become the gradient of the record. Each entry writes a slot
of its own. A tile with more pairs than there is room for is taken in segments, swept once more from a kept beginning.
"""

import math

import numpy as np

from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.moments import GROUP, MOMENTS, PAIR, write_chunk
from pansplat.render.cpu.raster import HALF, Floats, Integers, Longs, find_powers, opacity, pieces_of
from pansplat.render.cpu.records import FIELDS, TILE
from pansplat.render.cpu.simd import (
    LANES,
    choose,
    element,
    fill,
    load,
    multiply_add,
    negative,
    put,
    some,
    spread,
    store,
)
from pansplat.render.cpu.tables import FLAT, Plane
from pansplat.render.cpu.threads import share
from pansplat.render.cpu.tile import (
    ACROSS,
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    BLOCKS,
    CHUNK,
    CLOSED,
    EDGES,
    FORMS,
    MOST,
    PIXELS,
    WORDS,
    gather,
    list_blocks,
    place_tile,
)

_LN2 = math.log(2)
_PAIRS = 1 << 16  # room for pairs of a segment, at least those of a chunk
_CHUNKS = 32  # most in a segment


def raster_backward(
    records: Floats,
    values: Floats,
    entries: Integers,
    starts: Longs,
    slots: Longs,
    plane: Plane,
    sums: Floats,
    grad_sums: Floats,
    grad_records: Floats,
    grad_values: Floats,
    *,
    first_row: int = 0,
    threads: int = 1,
) -> None:
    """Write each entry's gradient into its slot.

    Args:
        records, values, entries, starts, slots: as in `raster_forward`.
        plane: the picture's pixels.
        sums: what `raster_forward` wrote.
        grad_sums: gradient of the sums, the same shape.
        grad_records: (slot, FIELDS), written at the entries' slots; directions in the columns DIRECTION, zeros in REST.
        grad_values: (slot, channel + 1), written likewise.
        first_row: of tiles, the band's first.
        threads: to work on; the result does not depend on it.
    """
    pieces = pieces_of(starts, threads)
    drawn = records.reshape(-1), values, entries.reshape(-1), starts, slots
    table = plane.kind, plane.columns, plane.rows, plane.rotation
    gradients = sums, grad_sums, grad_records.reshape(-1), grad_values.reshape(-1)

    def walk(piece: int) -> None:
        _walk_tiles(*drawn, *table, *gradients, first_row, pieces[piece], pieces[piece + 1])

    share(walk, len(pieces) - 1, threads)


@kernel
def _walk_tiles(  # type: ignore[no-untyped-def]
    records, values, entries, starts, slots, kind, columns, rows, rotation, sums, grad_sums, grad_records,
    grad_values, first_row, low, high,
):  # fmt: skip
    tiles_across = (len(columns) + TILE - 1) // TILE
    num_values = values.shape[1]
    planes = (num_values + GROUP - 1) // GROUP * GROUP
    offsets, middle, through = np.empty(3 * PIXELS, np.float32), np.empty(6, np.float32), np.empty(PIXELS, np.float32)
    upstream, behind = np.zeros((planes + 2) * PIXELS, np.float32), np.empty(PIXELS, np.float32)
    forms = np.empty((_CHUNKS, FORMS * CHUNK), np.float32)
    colours = np.empty((_CHUNKS, num_values * CHUNK), np.float32)
    # Of each pair also its block, and the same Gaussian's pair before; where a block's pairs begin.
    slopes = np.empty(_PAIRS * PAIR, np.float32)
    pairs, heads = np.empty(2 * _PAIRS, np.int32), np.empty((_CHUNKS, CHUNK), np.int32)
    begins = np.empty((_CHUNKS, BLOCKS + 1), np.int64)
    touched = np.empty(WORDS * EDGES, np.uint64)
    powers, places = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF, np.int32)
    moments, shares = np.empty(MOMENTS * CHUNK, np.float32), np.empty(LANES, np.float32)
    exact = np.float32(0 if kind == FLAT else 1)
    most = (np.max(starts[low + 1 : high + 1] - starts[low:high]) + CHUNK - 1) // CHUNK
    kept, marks = np.empty((most, PIXELS), np.float32), np.empty(most + 1, np.int64)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE, (first_row + tile // tiles_across) * TILE
        place_tile(kind, columns, rows, rotation, left, top, offsets, middle, through)
        _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream)
        begin, end, segment, ahead = starts[tile], starts[tile + 1], 0, True
        while begin < end:
            if ahead:
                marks[segment] = begin
                kept[segment] = through
            following, is_open = _sweep(
                records, values, entries, begin, end, middle, exact, offsets, through, forms, colours, touched,
                powers, places, slopes, pairs, heads, begins,
            )  # fmt: skip
            if ahead and is_open and following < end:
                begin, segment = following, segment + 1
                continue
            if ahead:
                _write_nothing(slots, following, end, num_values, grad_records, grad_values)
                ahead = False
                for pixel in range(PIXELS):
                    behind[pixel] = -upstream[(planes + 1) * PIXELS + pixel] * through[pixel]
            for chunk in range((following - begin - 1) // CHUNK, -1, -1):
                first = begin + chunk * CHUNK
                count = min(CHUNK, following - first)
                _find_slopes(begins[chunk], pairs, colours[chunk], num_values, planes, upstream, behind, slopes)
                write_chunk(
                    first, count, slots, heads[chunk], pairs, slopes, forms[chunk], offsets, upstream,
                    num_values, moments, shares, exact, grad_records, grad_values,
                )  # fmt: skip
            segment -= 1
            if segment < 0:
                break
            begin, end = marks[segment], begin
            through[:] = kept[segment]


@inlined
def _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream):  # type: ignore[no-untyped-def]
    """The tile's gradients by blocks, 0 off the picture; last that of the weights' sum, less the ray's total.

    The weights and what passes sum to 1. So a constant may be taken off what all that a ray meets is worth, and off
    what lies beyond: about the mean, which leaves small numbers to subtract.
    """
    height, width = grad_sums.shape[1], grad_sums.shape[2]
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        total = np.float32(0)
        for channel in range(num_values + 1):
            gradient = np.float32(0)
            if x < width and y < height:
                gradient = grad_sums[channel, y, x]
                total += gradient * sums[channel, y, x]
            upstream[(channel if channel < num_values else planes) * PIXELS + pixel] = gradient
        upstream[planes * PIXELS + pixel] -= total
        upstream[(planes + 1) * PIXELS + pixel] = total


@inlined
def _sweep(  # type: ignore[no-untyped-def]
    records, values, entries, begin, end, middle, exact, offsets, through, forms, colours, touched,
    powers, places, slopes, pairs, heads, begins,
):  # fmt: skip
    """Keep the pairs of a segment: whole chunks from entry `begin` on, while there is room and a block is open.

    Returns:
        The entry behind the segment, and whether the tile is still open there.
    """
    first, chunk, pair, is_open = begin, 0, 0, True
    while is_open and first < end and chunk < _CHUNKS and pair + BLOCKS * CHUNK <= _PAIRS:
        count = min(CHUNK, end - first)
        gather(records, values, entries, first, count, middle, exact, forms[chunk], colours[chunk])
        list_blocks(entries, first, count, touched)
        heads[chunk] = -1
        is_open, drawn, reached, half = False, -1, 0, 0
        for block in range(BLOCKS + 1):
            following = 0
            if block < BLOCKS and some(load(through, block * LANES) > fill(np.float32(CLOSED))):
                following = find_powers(block, count, touched, forms[chunk], offsets, powers, places, half)
            if drawn >= 0:
                begins[chunk, drawn] = pair
                is_open |= _keep_pairs(
                    drawn, reached, powers, places, HALF - half, through, slopes, pairs, heads[chunk], pair
                )
                pair += reached
            drawn, reached, half = block, following, HALF - half
        begins[chunk, BLOCKS] = pair
        first, chunk = first + count, chunk + 1
    return first, is_open


@inlined
def _keep_pairs(  # type: ignore[no-untyped-def]
    block, reached, powers, places, start, through, slopes, pairs, heads, pair
):
    """Write down the alphas and weights of what reaches a block; whether it stays open."""
    passes = load(through, block * LANES)
    for at in range(start, start + reached):
        s = np.int64(element(places, at))
        alpha = opacity(load(powers, at * LANES))
        store(slopes, pair * PAIR, alpha)
        store(slopes, pair * PAIR + LANES, alpha * passes)
        passes = multiply_add(negative(alpha), passes, passes)
        put(pairs, 2 * pair, np.int32(s))
        put(pairs, 2 * pair + 1, element(heads, s))
        put(heads, s, np.int32(pair))
        pair += 1
    store(through, block * LANES, passes)
    return some(passes > fill(np.float32(CLOSED)))


@inlined
def _find_slopes(  # type: ignore[no-untyped-def]
    begins, pairs, colours, num_values, planes, upstream, behind, slopes
):
    """Turn the alphas of a chunk's pairs into derivatives of the loss by their powers, back to front.

    A pair's Gaussian gives way to its block, which is what comes next.
    """
    most, one, zero = fill(np.float32(MOST)), fill(np.float32(1)), fill(np.float32(0))
    for block in range(BLOCKS):
        pixel = block * LANES
        beyond, base = load(behind, pixel), load(upstream, planes * PIXELS + pixel)
        for pair in range(begins[block + 1] - 1, begins[block] - 1, -1):
            colour = num_values * np.int64(element(pairs, 2 * pair))
            alpha, weight = load(slopes, pair * PAIR), load(slopes, pair * PAIR + LANES)
            worth = base
            for value in range(num_values):
                worth = multiply_add(load(upstream, value * PIXELS + pixel), spread(colours, colour + value), worth)
            earned = weight * worth
            slope = multiply_add(negative(alpha / (one - alpha)), beyond, earned) * fill(np.float32(_LN2))
            store(slopes, pair * PAIR, choose(most > alpha, slope, zero))
            beyond = beyond + earned
            put(pairs, 2 * pair, np.int32(block))
        store(behind, pixel, beyond)


@inlined
def _write_nothing(slots, first, end, num_values, grad_records, grad_values):  # type: ignore[no-untyped-def]
    """Zeros for Gaussians behind a closed tile."""
    for entry in range(first, end):
        row = FIELDS * slots[entry]
        store(grad_records, row, fill(np.float32(0)))
        store(grad_records, row + LANES, fill(np.float32(0)))
        for value in range(num_values):
            put(grad_values, num_values * slots[entry] + value, np.float32(0))
