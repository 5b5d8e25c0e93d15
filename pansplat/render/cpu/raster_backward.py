"""Compositing of tiles on the CPU, backward.

Source: docs/rendering.md, sections 3 and 4. The forward kept how much passes before each chunk of a tile, so chunks are
taken back to front, each with all it needs in the second cache. Block by block the weights of what reaches it are found
front to back, then the slopes back to front: what lies behind a Gaussian is summed from the back, where it is small, so
that nothing cancels and nothing is divided by a transmittance. Last Gaussian by Gaussian: their moments over all their
blocks stay in registers, and become the gradient of the record. Each entry writes a slot of its own.
"""

import math

import numpy as np

from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.moments import GROUP, MOMENTS, PAIR, write_chunk
from pansplat.render.cpu.raster import HALF, Floats, Integers, Kept, Longs, find_powers, opacity, pieces_of
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
    side_by_side,
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
    ask_ahead,
    gather,
    list_blocks,
    place_tile,
)

_LN2 = math.log(2)
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
    offsets, middle, through = np.empty(3 * PIXELS, np.float32), np.empty(6, np.float32), np.empty(PIXELS, np.float32)
    upstream, behind = np.zeros((planes + 2) * PIXELS, np.float32), np.empty(PIXELS, np.float32)
    forms, colours = np.empty(FORMS * CHUNK, np.float32), np.zeros(num_values * CHUNK + GROUP, np.float32)
    # Of each pair also its block, and the same Gaussian's pair before.
    slopes, pairs = np.empty(_PAIRS * PAIR, np.float32), np.empty(2 * _PAIRS, np.int32)
    heads, touched, found = (
        np.empty(CHUNK, np.int32),
        np.empty(WORDS * EDGES, np.uint64),
        np.zeros(WORDS + 2, np.uint64),
    )
    powers, places = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF, np.int32)
    weights = np.empty(HALF * LANES, np.float32)
    moments, shares = np.empty(MOMENTS * CHUNK, np.float32), np.empty(LANES, np.float32)
    exact = np.float32(0 if kind == FLAT else 1)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE, (first_row + tile // tiles_across) * TILE
        place_tile(kind, columns, rows, rotation, left, top, offsets, middle, through)
        _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream)
        begin, end, chunks = starts[tile], starts[tile + 1], drawn_chunks[tile]
        _write_nothing(slots, begin + CHUNK * chunks, end, num_values, grad_records, grad_values)
        last = kept[kept_rows[tile] + chunks]
        for pixel in range(PIXELS):
            behind[pixel] = -upstream[(planes + 1) * PIXELS + pixel] * last[pixel]
        for chunk in range(chunks - 1, -1, -1):
            first = begin + chunk * CHUNK
            count = min(CHUNK, end - first)
            gather(records, values, entries, first, count, middle, exact, forms, colours)
            list_blocks(entries, first, count, touched)
            following = first - CHUNK
            if chunk == 0:  # the next tile's last
                following = end + CHUNK * (drawn_chunks[min(tile + 1, high - 1)] - 1)
            _find_slopes(
                records, values, entries, following, forms, colours, touched, found, offsets,
                kept[kept_rows[tile] + chunk], num_values, planes, upstream, behind, powers, places, weights, slopes,
                pairs, heads,
            )  # fmt: skip
            write_chunk(
                first, count, slots, heads, pairs, slopes, forms, offsets, upstream, num_values, moments, shares,
                exact, grad_records, grad_values,
            )  # fmt: skip


@inlined
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


@inlined
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


@inlined
def _find_slopes(  # type: ignore[no-untyped-def]
    records, values, entries, next_first, forms, colours, touched, found, offsets, through, num_values, planes,
    upstream, behind, powers, places, weights, slopes, pairs, heads,
):  # fmt: skip
    """Find the derivatives of the loss by the powers of a chunk's Gaussians, block by block, and their weights."""
    heads[:] = -1
    # As in the forward, the next block's powers are found before a block is taken.
    taken, reached, following, half, pair = -1, 0, 0, 0, 0
    for block in range(BLOCKS + 1):
        if block < BLOCKS:
            ask_ahead(records, values, entries, block, next_first)
            if not some(load(through, block * LANES) > fill(np.float32(CLOSED))):
                continue
            following = find_powers(block, touched, forms, offsets, found, powers, places, half)
        if taken >= 0:
            start = HALF - half
            reached = _weigh_block(taken, reached, powers, places, start, through, weights)
            _slope_block(
                taken, reached, powers, places, start, weights, colours, num_values, planes, upstream, behind, slopes,
                pairs, heads, pair,
            )  # fmt: skip
            pair += reached
        taken, reached, half = block, following, HALF - half


@inlined
def _weigh_block(block, reached, powers, places, start, through, weights):  # type: ignore[no-untyped-def]
    """Turn the powers of what reaches a block into alphas, and find its weights; what no pixel sees is left out.

    Returns:
        How many are left.
    """
    passes, left = load(through, block * LANES), 0
    for at in range(reached):
        alpha = opacity(load(powers, (start + at) * LANES))
        store(powers, (start + left) * LANES, alpha)
        store(weights, left * LANES, alpha * passes)
        put(places, start + left, element(places, start + at))
        passes = multiply_add(negative(alpha), passes, passes)
        # Written over by the next if nobody sees it: no branch, for none could be foretold.
        left += np.int64(some(alpha > fill(np.float32(0))))
    return left


@inlined
def _slope_block(  # type: ignore[no-untyped-def]
    block, reached, alphas, places, start, weights, colours, num_values, planes, upstream, behind, slopes, pairs,
    heads, pair,
):  # fmt: skip
    """Write down the pairs of a block, back to front: slopes, weights, the block, the same Gaussian's pair before."""
    most, one, zero = fill(np.float32(MOST)), fill(np.float32(1)), fill(np.float32(0))
    pixel = block * LANES
    beyond, base = load(behind, pixel), load(upstream, planes * PIXELS + pixel)
    for at in range(reached - 1, -1, -1):
        s = np.int64(element(places, start + at))
        alpha, weight = load(alphas, (start + at) * LANES), load(weights, at * LANES)
        worth = base
        for value in range(0, planes, GROUP):  # beyond the last stand other finite numbers, times 0
            own, colour = value * PIXELS + pixel, num_values * s + value
            worth = multiply_add(load(upstream, own), spread(colours, colour), worth)
            worth = multiply_add(load(upstream, own + PIXELS), spread(colours, colour + 1), worth)
            worth = multiply_add(load(upstream, own + 2 * PIXELS), spread(colours, colour + 2), worth)
            worth = multiply_add(load(upstream, own + 3 * PIXELS), spread(colours, colour + 3), worth)
        earned = weight * worth
        slope = multiply_add(negative(alpha / (one - alpha)), beyond, earned) * fill(np.float32(_LN2))
        store(slopes, pair * PAIR, choose(most > alpha, slope, zero))
        store(slopes, pair * PAIR + LANES, weight)
        beyond = beyond + earned
        put(pairs, 2 * pair, np.int32(block))
        put(pairs, 2 * pair + 1, element(heads, s))
        put(heads, s, np.int32(pair))
        pair += 1
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
