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
from pansplat.render.cpu.raster import HALF, Floats, Integers, Longs, find_powers, forms_at, opacity, pieces_of
from pansplat.render.cpu.records import FIELDS, TILE
from pansplat.render.cpu.simd import (
    LANES,
    choose,
    element,
    fill,
    first_lane,
    load,
    maximum,
    multiply_add,
    negative,
    prefetch_to_write,
    put,
    some,
    spread,
    store,
    totals,
    transposed,
)
from pansplat.render.cpu.tables import FLAT, Plane
from pansplat.render.cpu.threads import share
from pansplat.render.cpu.tile import (
    A_X,
    ACROSS,
    ALONG_ROW,
    B_X,
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    BLOCKS,
    CHUNK,
    CLOSED,
    EDGES,
    FORMS,
    FRONTS,
    L_X,
    MOST,
    PIXELS,
    WORDS,
    gather,
    list_blocks,
    place_tile,
)

_GROUP = 4  # values whose gradients are summed at a time
_MOMENTS = 16  # (x, y, z, 1) of A, of B, of L; along; level; two to spare
_LEAST = 1e-16  # of L^2 + along Q: only reached where the slope is 0
_LN2 = math.log(2)
_PAIR = 2 * LANES  # numbers a pair: alphas, later slopes, and weights; one cache line
_PAIRS = 1 << 16  # room for pairs of a segment, at least those of a chunk
_CHUNKS = 32  # most in a segment
_AHEAD = 24  # Gaussians, between asking for a slot and writing it


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
    planes = (num_values + _GROUP - 1) // _GROUP * _GROUP
    offsets, middle, through = np.empty(3 * PIXELS, np.float32), np.empty(6, np.float32), np.empty(PIXELS, np.float32)
    upstream, behind = np.zeros((planes + 2) * PIXELS, np.float32), np.empty(PIXELS, np.float32)
    forms = np.empty((_CHUNKS, FORMS * CHUNK), np.float32)
    colours = np.empty((_CHUNKS, num_values * CHUNK), np.float32)
    # Of each pair also its block, and the same Gaussian's pair before; where a block's pairs begin.
    slopes = np.empty(_PAIRS * _PAIR, np.float32)
    pairs, heads = np.empty(2 * _PAIRS, np.int32), np.empty((_CHUNKS, CHUNK), np.int32)
    begins = np.empty((_CHUNKS, BLOCKS + 1), np.int64)
    touched = np.empty(WORDS * EDGES, np.uint64)
    powers, places = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF, np.int32)
    moments, shares = np.empty(_MOMENTS * CHUNK, np.float32), np.empty(LANES, np.float32)
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
                _write_chunk(
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
        store(slopes, pair * _PAIR, alpha)
        store(slopes, pair * _PAIR + LANES, alpha * passes)
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
            alpha, weight = load(slopes, pair * _PAIR), load(slopes, pair * _PAIR + LANES)
            worth = base
            for value in range(num_values):
                worth = multiply_add(load(upstream, value * PIXELS + pixel), spread(colours, colour + value), worth)
            earned = weight * worth
            slope = multiply_add(negative(alpha / (one - alpha)), beyond, earned) * fill(np.float32(_LN2))
            store(slopes, pair * _PAIR, choose(most > alpha, slope, zero))
            beyond = beyond + earned
            put(pairs, 2 * pair, np.int32(block))
        store(behind, pixel, beyond)


@inlined
def _write_chunk(  # type: ignore[no-untyped-def]
    first, count, slots, heads, pairs, slopes, forms, offsets, upstream, num_values, moments, shares, exact,
    grad_records, grad_values,
):  # fmt: skip
    """Write the gradients of a chunk's Gaussians to their slots."""
    last = first + count - 1
    for s in range(count):
        ahead = element(slots, min(first + s + _AHEAD, last))
        prefetch_to_write(grad_records, FIELDS * ahead)
        prefetch_to_write(grad_values, num_values * ahead)
        _sum_moments(s, heads, pairs, slopes, forms, offsets, upstream, moments, shares)
        row = num_values * slots[first + s]
        for value in range(min(_GROUP, num_values)):
            put(grad_values, row + value, element(shares, value))
        for value in range(_GROUP, num_values):
            put(grad_values, row + value, _share_of(s, heads, pairs, slopes, upstream, value))
    for s in range(0, count, LANES):
        _write_records(s, first, count, slots, forms, moments, exact, grad_records)


@inlined
def _sum_moments(  # type: ignore[no-untyped-def]
    s, heads, pairs, slopes, forms, offsets, upstream, moments, shares
):
    """Sums over a Gaussian's pixels of the derivatives by A, B, L, times the pixel's offset and 1; by along, level.

    Those by A and B lack a factor -2, that by L a factor 2. And the sums of weight x upstream gradient of four values.
    """
    zero, one = fill(np.float32(0)), fill(np.float32(1))
    a_x = a_y = a_z = a_one = b_x = b_y = b_z = b_one = zero
    l_x = l_y = l_z = l_one = by_along = by_level = zero
    share0 = share1 = share2 = share3 = zero
    along = spread(forms, ALONG_ROW * CHUNK + s)
    pair = np.int64(element(heads, s))
    while pair >= 0:
        pixel = LANES * np.int64(element(pairs, 2 * pair))
        slope, weight = load(slopes, pair * _PAIR), load(slopes, pair * _PAIR + LANES)
        pair = np.int64(element(pairs, 2 * pair + 1))
        x, y, z = load(offsets, pixel), load(offsets, PIXELS + pixel), load(offsets, 2 * PIXELS + pixel)
        a, b, front, x, y, z = forms_at(forms, s, x, y, z)
        q = multiply_add(a, a, b * b)
        inverse = one / maximum(multiply_add(front, front, along * q), fill(np.float32(_LEAST)))
        ratio = q * inverse
        scaled = slope * inverse
        by_q = multiply_add(negative(scaled * along), ratio, scaled)
        a, b, front = a * by_q, b * by_q, front * (scaled * ratio)
        a_x, a_y, a_z, a_one = multiply_add(a, x, a_x), multiply_add(a, y, a_y), multiply_add(a, z, a_z), a_one + a
        b_x, b_y, b_z, b_one = multiply_add(b, x, b_x), multiply_add(b, y, b_y), multiply_add(b, z, b_z), b_one + b
        l_x, l_y, l_z = multiply_add(front, x, l_x), multiply_add(front, y, l_y), multiply_add(front, z, l_z)
        l_one = l_one + front
        by_along, by_level = multiply_add(slope * ratio, ratio, by_along), by_level + slope
        share0 = multiply_add(weight, load(upstream, pixel), share0)
        share1 = multiply_add(weight, load(upstream, pixel + PIXELS), share1)
        share2 = multiply_add(weight, load(upstream, pixel + 2 * PIXELS), share2)
        share3 = multiply_add(weight, load(upstream, pixel + 3 * PIXELS), share3)
    store(moments, _MOMENTS * s, totals(a_x, a_y, a_z, a_one, b_x, b_y, b_z, b_one))
    store(moments, _MOMENTS * s + LANES, totals(l_x, l_y, l_z, l_one, by_along, by_level, zero, zero))
    store(shares, 0, totals(share0, share1, share2, share3, zero, zero, zero, zero))


@inlined
def _share_of(s, heads, pairs, slopes, upstream, value):  # type: ignore[no-untyped-def]
    """The gradient of a Gaussian's value: the sum over its pixels of weight x upstream gradient."""
    share = zero = fill(np.float32(0))
    pair = np.int64(element(heads, s))
    while pair >= 0:
        pixel = value * PIXELS + LANES * np.int64(element(pairs, 2 * pair))
        share = multiply_add(load(slopes, pair * _PAIR + LANES), load(upstream, pixel), share)
        pair = np.int64(element(pairs, 2 * pair + 1))
    return first_lane(totals(share, zero, zero, zero, zero, zero, zero, zero))


@inlined
def _write_records(  # type: ignore[no-untyped-def]
    s, first, count, slots, forms, moments, exact, grad_records
):
    """Turn the moments of eight Gaussians into gradients of their records, and write them to their slots."""
    at = _MOMENTS * s
    a_x, a_y, a_z, a_one, b_x, b_y, b_z, b_one = _rows(moments, at)
    l_x, l_y, l_z, l_one, along, level, _, _ = _rows(moments, at + LANES)
    less, on, zero = fill(np.float32(-2)), fill(exact), fill(np.float32(0))
    twice = on + on
    a, b, front = _column(forms, A_X, s), _column(forms, B_X, s), _column(forms, L_X, s)
    front_a, front_b = load(forms, FRONTS * CHUNK + s), load(forms, (FRONTS + 1) * CHUNK + s)
    # What the moments lack: a factor -2, or 2.
    a_x, a_y, a_z, a_one = less * a_x, less * a_y, less * a_z, less * a_one
    b_x, b_y, b_z, b_one = less * b_x, less * b_y, less * b_z, less * b_one
    l_x, l_y, l_z, l_one = twice * l_x, twice * l_y, twice * l_z, twice * l_one
    n_x = l_x - multiply_add(a[0], a_one, multiply_add(b[0], b_one, front[0] * l_one))
    n_y = l_y - multiply_add(a[1], a_one, multiply_add(b[1], b_one, front[1] * l_one))
    n_z = l_z - multiply_add(a[2], a_one, multiply_add(b[2], b_one, front[2] * l_one))
    by_front_a = multiply_add(a[0], l_x, multiply_add(a[1], l_y, a[2] * l_z))
    by_front_b = multiply_add(b[0], l_x, multiply_add(b[1], l_y, b[2] * l_z))
    a_x, a_y, a_z = multiply_add(front_a, l_x, a_x), multiply_add(front_a, l_y, a_y), multiply_add(front_a, l_z, a_z)
    b_x, b_y, b_z = multiply_add(front_b, l_x, b_x), multiply_add(front_b, l_y, b_y), multiply_add(front_b, l_z, b_z)
    # The moments have been read: the rows take their place.
    _store_rows(moments, at, transposed(n_x, n_y, n_z, zero, zero, zero, a_x, a_y))
    _store_rows(moments, at + LANES, transposed(a_z, b_x, b_y, b_z, by_front_a, by_front_b, on * along, level))
    for place in range(s, min(s + LANES, count)):
        row = FIELDS * slots[first + place]
        store(grad_records, row, load(moments, _MOMENTS * place))
        store(grad_records, row + LANES, load(moments, _MOMENTS * place + LANES))


@inlined
def _column(forms, row, s):  # type: ignore[no-untyped-def]
    return load(forms, row * CHUNK + s), load(forms, (row + 1) * CHUNK + s), load(forms, (row + 2) * CHUNK + s)


@inlined
def _rows(moments, at):  # type: ignore[no-untyped-def]
    """A column for each of eight numbers of eight Gaussians."""
    return transposed(
        load(moments, at),
        load(moments, at + _MOMENTS),
        load(moments, at + 2 * _MOMENTS),
        load(moments, at + 3 * _MOMENTS),
        load(moments, at + 4 * _MOMENTS),
        load(moments, at + 5 * _MOMENTS),
        load(moments, at + 6 * _MOMENTS),
        load(moments, at + 7 * _MOMENTS),
    )


@inlined
def _store_rows(moments, at, rows):  # type: ignore[no-untyped-def]
    for row in range(LANES):
        store(moments, at + row * _MOMENTS, rows[row])


@inlined
def _write_nothing(slots, first, end, num_values, grad_records, grad_values):  # type: ignore[no-untyped-def]
    """Zeros for Gaussians behind a closed tile."""
    for entry in range(first, end):
        row = FIELDS * slots[entry]
        store(grad_records, row, fill(np.float32(0)))
        store(grad_records, row + LANES, fill(np.float32(0)))
        for value in range(num_values):
            put(grad_values, num_values * slots[entry] + value, np.float32(0))
