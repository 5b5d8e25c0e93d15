"""Compositing of tiles on the CPU, backward.

Source: docs/rendering.md, sections 3 and 4. The forward kept how much passes before each chunk of a tile, so chunks are
taken back to front, each with all it needs in the second cache. Block by block the weights of what reaches it are found
front to back, then the slopes back to front: what a ray meets behind a Gaussian is blended from the back, as a mean, so
that nothing is divided by a transmittance. Last Gaussian by Gaussian: their moments over all their blocks stay in
registers, and become the gradient of the record. Each entry writes a slot of its own.
"""

import numpy as np

from pansplat.rendering.cpu.compiling import borrowing, kernel
from pansplat.rendering.cpu.moments import GROUP, MOMENTS, PAIR, write_chunk
from pansplat.rendering.cpu.raster import HALF, Floats, Integers, Kept, Longs, find_powers, opacity, pieces_of
from pansplat.rendering.cpu.records import FIELDS, TILE
from pansplat.rendering.cpu.simd import (
    LANES,
    choose,
    element,
    fill,
    load,
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
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    BLOCKS,
    CHUNK,
    CLOSED,
    EDGES,
    FORMS,
    MOST,
    PIXELS,
    PLACE,
    WORDS,
    ask_ahead,
    gather,
    list_blocks,
    place_pixels,
    place_tile,
)

_PAIRS = BLOCKS * CHUNK  # of a Gaussian and a block, the most a chunk can have


def raster_backward(
    records: Floats,
    values: Floats,
    entries: Integers,
    starts: Longs,
    slots: Integers | Longs,
    plane: Plane,
    sums: Floats,
    kept: Kept,
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
        sums, kept: what `raster_forward` wrote.
        grad_sums: gradient of the sums, the same shape.
        grad_records: (slot, FIELDS), written at the entries' slots; directions in the columns DIRECTION, zeros in REST.
            Starts on a multiple of 32 bytes: nobody reads it soon, so it is written past the caches.
        grad_values: (slot, channel + 1), written likewise.
        first_row: of tiles, the band's first.
        threads: to work on; the result does not depend on it.
    """
    assert grad_records.size == 0 or grad_records.ctypes.data % (4 * LANES) == 0
    pieces = pieces_of(starts, threads)
    drawn = records.reshape(-1), values, entries.reshape(-1), starts, slots
    table = plane.kind, plane.columns, plane.rows, plane.rotation
    gradients = sums, *kept, grad_sums, grad_records.reshape(-1), grad_values.reshape(-1)

    def walk(piece: int) -> None:
        _walk_tiles(*drawn, *table, *gradients, first_row, pieces[piece], pieces[piece + 1])

    share(walk, len(pieces) - 1, threads)


@kernel
def _walk_tiles(  # type: ignore[no-untyped-def]
    records, values, entries, starts, slots, kind, columns, rows, rotation, sums, kept, kept_rows, drawn_chunks,
    grad_sums, grad_records, grad_values, first_row, low, high,
):  # fmt: skip
    tiles_across = (len(columns) + TILE - 1) // TILE
    num_values = values.shape[1]
    planes = (num_values + GROUP - 1) // GROUP * GROUP
    offsets, centre, place = np.empty(3 * PIXELS, np.float32), np.empty(3), np.empty(PLACE, np.float32)
    upstream, behind = np.zeros((planes + 2) * PIXELS, np.float32), np.empty(PIXELS, np.float32)
    forms, colours = np.empty(FORMS * CHUNK, np.float32), np.zeros(num_values * CHUNK + GROUP, np.float32)
    # Of each pair also its block, and the same Gaussian's pair before.
    slopes, pairs = np.empty(_PAIRS * PAIR, np.float32), np.empty(2 * _PAIRS, np.int32)
    heads, touched = np.empty(CHUNK, np.int32), np.empty(WORDS * EDGES, np.uint64)
    powers, places = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF, np.uint8)
    alphas, weights = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF * LANES, np.float32)
    seen = np.empty(2 * HALF, np.int32)
    moments = np.empty(MOMENTS * CHUNK, np.float32)
    exact = np.float32(0 if kind == FLAT else 1)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE, (first_row + tile // tiles_across) * TILE
        tile_is_wide, placed = place_tile(kind, columns, rows, rotation, left, top, centre, place), -1
        _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream)
        begin, end, chunks = starts[tile], starts[tile + 1], drawn_chunks[tile]
        _write_nothing(slots, begin + CHUNK * chunks, end, num_values, grad_records, grad_values)
        for pixel in range(PIXELS):
            behind[pixel] = -upstream[(planes + 1) * PIXELS + pixel]
        for chunk in range(chunks - 1, -1, -1):
            first = begin + chunk * CHUNK
            count = min(CHUNK, end - first)
            wide = gather(records, values, entries, first, count, place, exact, tile_is_wide, forms, colours)
            if placed != wide:
                place_pixels(kind, columns, rows, rotation, left, top, centre, place, wide, offsets)
                placed = np.int64(wide)
            list_blocks(entries, first, count, touched)
            following = first - CHUNK
            if chunk == 0:  # the next tile's last
                following = end + CHUNK * (drawn_chunks[min(tile + 1, high - 1)] - 1)
            _find_slopes(
                records, values, entries, following, wide, forms, colours, touched, offsets,
                kept[kept_rows[tile] + chunk], num_values, planes, upstream, behind, powers, places, alphas, weights,
                seen, slopes, pairs, heads,
            )  # fmt: skip
            write_chunk(
                records, entries, first, count, slots, heads, pairs, slopes, wide, forms, offsets, upstream,
                num_values, moments, exact, grad_records, grad_values,
            )  # fmt: skip


@borrowing
def _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream):  # type: ignore[no-untyped-def]
    """The tile's gradients by blocks, 0 off the picture; last that of the weights' sum, less the ray's total.

    The weights and what passes sum to 1. So a constant may be taken off what all that a ray meets is worth, and off
    what lies beyond: about the mean, which leaves small numbers to subtract.
    """
    height, width = grad_sums.shape[1], grad_sums.shape[2]
    if left + TILE > width or top + TILE > height:
        _read_part(sums, grad_sums, left, top, num_values, planes, upstream)
        return
    given, drawn = grad_sums.reshape(-1), sums.reshape(-1)
    for block in range(0, BLOCKS, 2):
        pixel, first, second = block * LANES, fill(np.float32(0)), fill(np.float32(0))
        at = (top + block // ACROSS * BLOCK_HEIGHT) * width + left + block % ACROSS * BLOCK_WIDTH
        for channel in range(num_values + 1):
            place = channel * height * width + at
            gradient, other_gradient = side_by_side(load(given, place), load(given, place + width))
            value, other_value = side_by_side(load(drawn, place), load(drawn, place + width))
            first = multiply_add(gradient, value, first)
            second = multiply_add(other_gradient, other_value, second)
            own = (channel if channel < num_values else planes) * PIXELS + pixel
            store(upstream, own, gradient)
            store(upstream, own + LANES, other_gradient)
        own = planes * PIXELS + pixel
        store(upstream, own, load(upstream, own) - first)
        store(upstream, own + LANES, load(upstream, own + LANES) - second)
        store(upstream, own + PIXELS, first)
        store(upstream, own + PIXELS + LANES, second)


@borrowing
def _read_part(sums, grad_sums, left, top, num_values, planes, upstream):  # type: ignore[no-untyped-def]
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


@borrowing
def _find_slopes(  # type: ignore[no-untyped-def]
    records, values, entries, next_first, wide, forms, colours, touched, offsets, through, num_values, planes,
    upstream, behind, powers, places, alphas, weights, seen, slopes, pairs, heads,
):  # fmt: skip
    """Find the derivatives of the loss by the powers of a chunk's Gaussians, block by block, and their weights."""
    heads[:] = -1
    # Three blocks are at work at a time, so that their latencies hide each other, and what is counted in one is long
    # known when it is needed: the powers of one, the weights of the one before, the slopes of the one before that.
    weighed, left, taken, reached, half, pair = -1, 0, -1, 0, 0, 0
    for block in range(BLOCKS + 2):
        following, is_open = 0, False
        if block < BLOCKS:
            ask_ahead(records, values, entries, block, next_first)
            is_open = some(load(through, block * LANES) > fill(np.float32(CLOSED)))
            if not is_open:
                continue
            following = find_powers(block, touched, wide, forms, offsets, powers, places, half)
        kept = 0
        if taken >= 0:
            kept = _weigh_block(taken, reached, powers, places, HALF - half, through, half, alphas, weights, seen)
        if weighed >= 0:
            _slope_block(
                weighed, left, alphas, weights, seen, HALF - half, colours, num_values, planes, upstream, behind,
                slopes, pairs, heads, pair,
            )  # fmt: skip
            pair += left
        weighed, left, taken, reached, half = taken, kept, block if is_open else -1, following, HALF - half


@borrowing
def _weigh_block(  # type: ignore[no-untyped-def]
    block, reached, powers, places, start, through, begin, alphas, weights, seen
):
    """Find alphas and weights of what reaches a block; what no pixel sees is left out.

    Returns:
        How many are written, from `begin` on.
    """
    passes, to = load(through, block * LANES), begin
    for at in range(start, start + reached):
        alpha = opacity(load(powers, at * LANES))
        store(alphas, to * LANES, alpha)
        store(weights, to * LANES, alpha * passes)
        put(seen, to, np.int32(element(places, at)))
        passes = multiply_add(negative(alpha), passes, passes)
        # Written over by the next if nobody sees it: no branch, for none could be foretold.
        to += np.int64(some(alpha > fill(np.float32(0))))
    return to - begin


@borrowing
def _slope_block(  # type: ignore[no-untyped-def]
    block, left, alphas, weights, seen, begin, colours, num_values, planes, upstream, behind, slopes, pairs, heads,
    pair,
):  # fmt: skip
    """Write down the pairs of a block, back to front: slopes, weights, the block, the same Gaussian's pair before."""
    most, zero = fill(np.float32(MOST)), fill(np.float32(0))
    pixel = block * LANES
    beyond, base = load(behind, pixel), load(upstream, planes * PIXELS + pixel)
    for at in range(begin + left - 1, begin - 1, -1):
        s = np.int64(element(seen, at))
        alpha, weight = load(alphas, at * LANES), load(weights, at * LANES)
        worth = base
        for value in range(0, planes, GROUP):  # beyond the last stand other finite numbers, times 0
            own, colour = value * PIXELS + pixel, num_values * s + value
            worth = multiply_add(load(upstream, own), spread(colours, colour), worth)
            worth = multiply_add(load(upstream, own + PIXELS), spread(colours, colour + 1), worth)
            worth = multiply_add(load(upstream, own + 2 * PIXELS), spread(colours, colour + 2), worth)
            worth = multiply_add(load(upstream, own + 3 * PIXELS), spread(colours, colour + 3), worth)
        gained = worth - beyond
        store(slopes, pair * PAIR, choose(most > alpha, weight * gained, zero))
        store(slopes, pair * PAIR + LANES, weight)
        beyond = multiply_add(alpha, gained, beyond)
        put(pairs, 2 * pair, np.int32(block))
        put(pairs, 2 * pair + 1, element(heads, s))
        put(heads, s, np.int32(pair))
        pair += 1
    store(behind, pixel, beyond)


@borrowing
def _write_nothing(slots, first, end, num_values, grad_records, grad_values):  # type: ignore[no-untyped-def]
    """Zeros for Gaussians behind a closed tile."""
    for entry in range(first, end):
        row = FIELDS * slots[entry]
        store(grad_records, row, fill(np.float32(0)))
        store(grad_records, row + LANES, fill(np.float32(0)))
        for value in range(num_values):
            put(grad_values, num_values * slots[entry] + value, np.float32(0))
