"""Compositing of tiles on the CPU, backward.

Source: docs/rendering.md, sections 3 and 4. A tile is walked front to back again, in the forward's chunks. First block by
block: what a ray still has to gather is its total less what it has, so nothing is divided by a transmittance. That leaves
each pair of Gaussian and block with the slopes of its eight powers. Then Gaussian by Gaussian: their moments over all
its blocks stay in registers, and become the gradient of its record. Each entry writes a slot of its own.
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
    load,
    maximum,
    multiply_add,
    negative,
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
    records,
    values,
    entries,
    starts,
    slots,
    kind,
    columns,
    rows,
    rotation,
    sums,
    grad_sums,
    grad_records,
    grad_values,
    first_row,
    low,
    high,
):
    tiles_across = (len(columns) + TILE - 1) // TILE
    num_values = values.shape[1]
    planes = (num_values + _GROUP - 1) // _GROUP * _GROUP
    offsets, middle, through = np.empty(3 * PIXELS, np.float32), np.empty(6, np.float32), np.empty(PIXELS, np.float32)
    upstream, rest = np.zeros((planes + 1) * PIXELS, np.float32), np.empty(PIXELS, np.float32)
    forms, colours = np.empty(FORMS * CHUNK, np.float32), np.empty(num_values * CHUNK, np.float32)
    touched = np.empty(WORDS * EDGES, np.uint64)
    powers, places = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF, np.int32)
    # Pairs of a Gaussian and a block: slopes of the powers, weights, the block, the same Gaussian's pair before.
    slopes, weights = np.empty(BLOCKS * CHUNK * LANES, np.float32), np.empty(BLOCKS * CHUNK * LANES, np.float32)
    pairs, heads = np.empty(2 * BLOCKS * CHUNK, np.int32), np.empty(CHUNK, np.int32)
    moments, shares = np.empty(_MOMENTS * CHUNK, np.float32), np.empty(LANES, np.float32)
    exact = np.float32(0 if kind == FLAT else 1)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE, (first_row + tile // tiles_across) * TILE
        place_tile(kind, columns, rows, rotation, left, top, offsets, middle, through)
        _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream, rest)
        is_open = True
        for first in range(starts[tile], starts[tile + 1], CHUNK):
            count = min(CHUNK, starts[tile + 1] - first)
            if not is_open:
                _write_nothing(slots, first, count, num_values, grad_records, grad_values)
                continue
            gather(records, values, entries, first, count, middle, exact, forms, colours)
            list_blocks(entries, first, count, touched)
            heads[:] = -1
            is_open, drawn, reached, half, pair = False, -1, 0, 0, 0
            for block in range(BLOCKS + 1):
                if block < BLOCKS:
                    if not some(load(through, block * LANES) > fill(np.float32(CLOSED))):
                        continue
                    following = find_powers(block, touched, forms, offsets, powers, places, half)
                if drawn >= 0:
                    is_open |= _find_slopes(
                        drawn, reached, powers, places, HALF - half, colours, num_values, planes, upstream, through, rest,
                        slopes, weights, pairs, heads, pair,
                    )  # fmt: skip
                    pair += reached
                drawn, reached, half = block, following, HALF - half
            for s in range(count):
                _sum_moments(s, heads, pairs, slopes, forms, offsets, moments)
                row = num_values * slots[first + s]
                _sum_shares(s, heads, pairs, weights, upstream, num_values, shares, grad_values, row)
            for s in range(0, count, LANES):
                _write_records(s, first, count, slots, forms, moments, exact, grad_records)


@inlined
def _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream, behind):  # type: ignore[no-untyped-def]
    """The tile's gradients by blocks; the last, of the weights' sum, less the ray's total of gradient x sum.

    The weights and what passes sum to 1, so a constant may be taken off what all of a ray's Gaussians are worth, and
    off its total. Taking the total itself leaves small numbers to add up.
    """
    height, width = sums.shape[1], sums.shape[2]
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        total = np.float32(0)
        for channel in range(num_values + 1):
            plane = channel if channel < num_values else planes
            gradient = np.float32(0)
            if x < width and y < height:
                gradient = grad_sums[channel, y, x]
                total += gradient * sums[channel, y, x]
            upstream[plane * PIXELS + pixel] = gradient
        upstream[planes * PIXELS + pixel] -= total
        behind[pixel] = 0


@inlined
def _find_slopes(  # type: ignore[no-untyped-def]
    block, reached, powers, places, start, colours, num_values, planes, upstream, through, rest,
    slopes, weights, pairs, heads, pair,
):  # fmt: skip
    """Derivatives of the loss by the powers of what reaches a block; whether it stays open."""
    pixel = block * LANES
    passes, behind = load(through, pixel), load(rest, pixel)
    most, one, zero = fill(np.float32(MOST)), fill(np.float32(1)), fill(np.float32(0))
    base = load(upstream, planes * PIXELS + pixel)
    for at in range(start, start + reached):
        s = np.int64(element(places, at))
        alpha = opacity(load(powers, at * LANES))
        weight = alpha * passes
        worth = base
        for channel in range(num_values):
            worth = multiply_add(
                load(upstream, channel * PIXELS + pixel), spread(colours, num_values * s + channel), worth
            )
        behind = multiply_add(negative(weight), worth, behind)
        slope = multiply_add(passes, worth, negative(behind / (one - alpha)))
        slope = choose(most > alpha, slope * (alpha * fill(np.float32(_LN2))), zero)
        passes = multiply_add(negative(alpha), passes, passes)
        store(slopes, pair * LANES, slope)
        store(weights, pair * LANES, weight)
        put(pairs, 2 * pair, np.int32(block))
        put(pairs, 2 * pair + 1, element(heads, s))
        put(heads, s, np.int32(pair))
        pair += 1
    store(through, pixel, passes)
    store(rest, pixel, behind)
    return some(passes > fill(np.float32(CLOSED)))


@inlined
def _sum_moments(s, heads, pairs, slopes, forms, offsets, moments):  # type: ignore[no-untyped-def]
    """Sums over a Gaussian's pixels of the derivatives by A, B, L, times the pixel's offset and 1; by along, level.

    Those by A and B lack a factor -2, that by L a factor 2.
    """
    zero, one = fill(np.float32(0)), fill(np.float32(1))
    a_x = a_y = a_z = a_one = b_x = b_y = b_z = b_one = zero
    l_x = l_y = l_z = l_one = by_along = by_level = zero
    along = spread(forms, ALONG_ROW * CHUNK + s)
    pair = np.int64(element(heads, s))
    while pair >= 0:
        pixel = LANES * np.int64(element(pairs, 2 * pair))
        slope = load(slopes, pair * LANES)
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
    store(moments, _MOMENTS * s, totals(a_x, a_y, a_z, a_one, b_x, b_y, b_z, b_one))
    store(moments, _MOMENTS * s + LANES, totals(l_x, l_y, l_z, l_one, by_along, by_level, zero, zero))


@inlined
def _sum_shares(  # type: ignore[no-untyped-def]
    s, heads, pairs, weights, upstream, num_values, shares, grad_values, row
):
    """Write the gradient of a Gaussian's values: sums over its pixels of weight x upstream gradient."""
    zero = fill(np.float32(0))
    for channel in range(0, num_values, _GROUP):
        sum0 = sum1 = sum2 = sum3 = zero
        pair = np.int64(element(heads, s))
        while pair >= 0:
            pixel = channel * PIXELS + LANES * np.int64(element(pairs, 2 * pair))
            weight = load(weights, pair * LANES)
            pair = np.int64(element(pairs, 2 * pair + 1))
            sum0 = multiply_add(weight, load(upstream, pixel), sum0)
            sum1 = multiply_add(weight, load(upstream, pixel + PIXELS), sum1)
            sum2 = multiply_add(weight, load(upstream, pixel + 2 * PIXELS), sum2)
            sum3 = multiply_add(weight, load(upstream, pixel + 3 * PIXELS), sum3)
        store(shares, 0, totals(sum0, sum1, sum2, sum3, zero, zero, zero, zero))
        for value in range(min(_GROUP, num_values - channel)):
            put(grad_values, row + channel + value, element(shares, value))


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
def _write_nothing(slots, first, count, num_values, grad_records, grad_values):  # type: ignore[no-untyped-def]
    """Zeros for Gaussians behind a closed tile."""
    for entry in range(first, first + count):
        row = FIELDS * slots[entry]
        store(grad_records, row, fill(np.float32(0)))
        store(grad_records, row + LANES, fill(np.float32(0)))
        for value in range(num_values):
            put(grad_values, num_values * slots[entry] + value, np.float32(0))
