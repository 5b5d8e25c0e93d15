"""Compositing of tiles on the CPU, backward.

Source: docs/rendering.md, sections 3 and 4. The forward kept how much passes before each chunk of a tile, so chunks are
taken back to front, each with all it needs in the second cache. Block by block the weights of what reaches it are found
front to back, then the slopes back to front: what a ray meets behind a Gaussian is blended from the back, as a mean, so
that nothing is divided by a transmittance. Last Gaussian by Gaussian: their moments over all their blocks stay in
registers, and become the gradient of the record. Each entry writes a slot of its own.
"""

import math

import numpy as np

from pansplat.rendering.cpu.rasterize import (
    ACROSS,
    ALONG_ROW,
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    BLOCKS,
    CHUNK_SIZE,
    CLOSED,
    EDGES,
    FORMS,
    HALF,
    MOST,
    PIXELS,
    PLACE,
    WORDS,
    Floats,
    Integers,
    Longs,
    SavedForBackward,
    ask_ahead,
    eight_records,
    find_powers,
    forms_at,
    gather,
    list_blocks,
    opacity,
    place_pixels,
    place_tile,
)
from pansplat.rendering.cpu.records import PIXEL_CENTRES, RECORD_SIZE, TILE_SIZE, PixelTables
from pansplat.rendering.cpu.runtime import inline_kernel_no_refcount, kernel, parallel_for
from pansplat.rendering.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
    first_lane,
    join_halves,
    lane_sums,
    load,
    load_broadcast,
    load_scalar,
    load_transposed,
    multiply_add,
    prefetch_for_write,
    select,
    store,
    store_nontemporal,
    store_scalar,
    transpose,
)
from pansplat.rendering.cpu.tiling import split_tiles

# Moments of a Gaussian over the pixels of a tile, and the gradient of its record that they make.
#
# Source: docs/rendering.md, section 3. A response depends on A / L and B / L alone, which a pixel has by a projection:
# eight numbers, of which one only turns A and B into each other. So seven sums, and those for `along` and `level`, are
# all that the pixels have to say, whatever tile or components the forms were found in.


_PAIRS = BLOCKS * CHUNK_SIZE  # of a Gaussian and a block, the most a chunk can have


def rasterize_backward(
    records: Floats,
    values: Floats,
    intersections: Integers,
    starts: Longs,
    slots: Integers | Longs,
    plane: PixelTables,
    sums: Floats,
    kept: SavedForBackward,
    grad_sums: Floats,
    grad_records: Floats,
    grad_values: Floats,
    *,
    first_row: int = 0,
    threads: int = 1,
) -> None:
    """Write each entry's gradient into its slot.

    Args:
        records, values, intersections, starts, slots: as in `rasterize_forward`.
        plane: the picture's pixels.
        sums, kept: what `rasterize_forward` wrote.
        grad_sums: gradient of the sums, the same shape.
        grad_records: (slot, RECORD_SIZE), written; directions in the columns DIRECTION, zeros in DIRECTION_RESIDUAL.
            Starts on a multiple of 32 bytes: nobody reads it soon, so it is written past the caches.
        grad_values: (slot, channel + 1), written likewise.
        first_row: of tiles, the band's first.
        threads: to work on; the result does not depend on it.
    """
    assert grad_records.size == 0 or grad_records.ctypes.data % (4 * LANES) == 0
    pieces = split_tiles(starts, threads)
    drawn = records.reshape(-1), values, intersections.reshape(-1), starts, slots
    table = plane.kind, plane.columns, plane.rows, plane.rotation
    gradients = sums, *kept, grad_sums, grad_records.reshape(-1), grad_values.reshape(-1)

    def walk(piece: int) -> None:
        _walk_tiles(*drawn, *table, *gradients, first_row, pieces[piece], pieces[piece + 1])

    parallel_for(walk, len(pieces) - 1, threads)


@kernel
def _walk_tiles(  # type: ignore[no-untyped-def]
    records, values, intersections, starts, slots, kind, columns, rows, rotation, sums, kept, kept_rows, drawn_chunks,
    grad_sums, grad_records, grad_values, first_row, low, high,
):  # fmt: skip
    tiles_across = (len(columns) + TILE_SIZE - 1) // TILE_SIZE
    num_values = values.shape[1]
    planes = (num_values + GROUP - 1) // GROUP * GROUP
    offsets, centre, place = np.empty(3 * PIXELS, np.float32), np.empty(3), np.empty(PLACE, np.float32)
    upstream, behind = np.zeros((planes + 2) * PIXELS, np.float32), np.empty(PIXELS, np.float32)
    forms, colours = np.empty(FORMS * CHUNK_SIZE, np.float32), np.zeros(num_values * CHUNK_SIZE + GROUP, np.float32)
    # Of each pair also its block, and the same Gaussian's pair before.
    slopes, pairs = np.empty(_PAIRS * PAIR, np.float32), np.empty(2 * _PAIRS, np.int32)
    heads, touched = np.empty(CHUNK_SIZE, np.int32), np.empty(WORDS * EDGES, np.uint64)
    powers, places = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF, np.uint8)
    alphas, weights = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF * LANES, np.float32)
    seen = np.empty(2 * HALF, np.int32)
    moments = np.empty(MOMENTS * CHUNK_SIZE, np.float32)
    exact = np.float32(0 if kind == PIXEL_CENTRES else 1)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE_SIZE, (first_row + tile // tiles_across) * TILE_SIZE
        tile_is_wide, placed = place_tile(kind, columns, rows, rotation, left, top, centre, place), -1
        _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream)
        begin, end, chunks = starts[tile], starts[tile + 1], drawn_chunks[tile]
        _write_nothing(slots, begin + CHUNK_SIZE * chunks, end, num_values, grad_records, grad_values)
        for pixel in range(PIXELS):
            behind[pixel] = -upstream[(planes + 1) * PIXELS + pixel]
        for chunk in range(chunks - 1, -1, -1):
            first = begin + chunk * CHUNK_SIZE
            count = min(CHUNK_SIZE, end - first)
            wide = gather(records, values, intersections, first, count, place, exact, tile_is_wide, forms, colours)
            if placed != wide:
                place_pixels(kind, columns, rows, rotation, left, top, centre, place, wide, offsets)
                placed = np.int64(wide)
            list_blocks(intersections, first, count, touched)
            following = first - CHUNK_SIZE
            if chunk == 0:  # the next tile's last
                following = end + CHUNK_SIZE * (drawn_chunks[min(tile + 1, high - 1)] - 1)
            _find_slopes(
                records, values, intersections, following, wide, forms, colours, touched, offsets,
                kept[kept_rows[tile] + chunk], num_values, planes, upstream, behind, powers, places, alphas, weights,
                seen, slopes, pairs, heads,
            )  # fmt: skip
            write_chunk(
                records, intersections, first, count, slots, heads, pairs, slopes, wide, forms, offsets, upstream,
                num_values, moments, exact, grad_records, grad_values,
            )  # fmt: skip


@inline_kernel_no_refcount
def _read_upstream(sums, grad_sums, left, top, num_values, planes, upstream):  # type: ignore[no-untyped-def]
    """The tile's gradients by blocks, 0 off the picture; last that of the weights' sum, less the ray's total.

    The weights and what passes sum to 1. So a constant may be taken off what all that a ray meets is worth, and off
    what lies beyond: about the mean, which leaves small numbers to subtract.
    """
    height, width = grad_sums.shape[1], grad_sums.shape[2]
    if left + TILE_SIZE > width or top + TILE_SIZE > height:
        _read_part(sums, grad_sums, left, top, num_values, planes, upstream)
        return
    given, drawn = grad_sums.reshape(-1), sums.reshape(-1)
    for block in range(0, BLOCKS, 2):
        pixel, first, second = block * LANES, broadcast(np.float32(0)), broadcast(np.float32(0))
        at = (top + block // ACROSS * BLOCK_HEIGHT) * width + left + block % ACROSS * BLOCK_WIDTH
        for channel in range(num_values + 1):
            place = channel * height * width + at
            gradient, other_gradient = join_halves(load(given, place), load(given, place + width))
            value, other_value = join_halves(load(drawn, place), load(drawn, place + width))
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


@inline_kernel_no_refcount
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


@inline_kernel_no_refcount
def _find_slopes(  # type: ignore[no-untyped-def]
    records, values, intersections, next_first, wide, forms, colours, touched, offsets, through, num_values, planes,
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
            ask_ahead(records, values, intersections, block, next_first)
            is_open = any_lane(load(through, block * LANES) > broadcast(np.float32(CLOSED)))
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


@inline_kernel_no_refcount
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
        store_scalar(seen, to, np.int32(load_scalar(places, at)))
        passes = multiply_add(-alpha, passes, passes)
        # Written over by the next if nobody sees it: no branch, for none could be foretold.
        to += np.int64(any_lane(alpha > broadcast(np.float32(0))))
    return to - begin


@inline_kernel_no_refcount
def _slope_block(  # type: ignore[no-untyped-def]
    block, left, alphas, weights, seen, begin, colours, num_values, planes, upstream, behind, slopes, pairs, heads,
    pair,
):  # fmt: skip
    """Write down the pairs of a block, back to front: slopes, weights, the block, the same Gaussian's pair before."""
    most, zero = broadcast(np.float32(MOST)), broadcast(np.float32(0))
    pixel = block * LANES
    beyond, base = load(behind, pixel), load(upstream, planes * PIXELS + pixel)
    for at in range(begin + left - 1, begin - 1, -1):
        s = np.int64(load_scalar(seen, at))
        alpha, weight = load(alphas, at * LANES), load(weights, at * LANES)
        worth = base
        for value in range(0, planes, GROUP):  # beyond the last stand other finite numbers, times 0
            own, colour = value * PIXELS + pixel, num_values * s + value
            worth = multiply_add(load(upstream, own), load_broadcast(colours, colour), worth)
            worth = multiply_add(load(upstream, own + PIXELS), load_broadcast(colours, colour + 1), worth)
            worth = multiply_add(load(upstream, own + 2 * PIXELS), load_broadcast(colours, colour + 2), worth)
            worth = multiply_add(load(upstream, own + 3 * PIXELS), load_broadcast(colours, colour + 3), worth)
        gained = worth - beyond
        store(slopes, pair * PAIR, select(most > alpha, weight * gained, zero))
        store(slopes, pair * PAIR + LANES, weight)
        beyond = multiply_add(alpha, gained, beyond)
        store_scalar(pairs, 2 * pair, np.int32(block))
        store_scalar(pairs, 2 * pair + 1, load_scalar(heads, s))
        store_scalar(heads, s, np.int32(pair))
        pair += 1
    store(behind, pixel, beyond)


@inline_kernel_no_refcount
def _write_nothing(slots, first, end, num_values, grad_records, grad_values):  # type: ignore[no-untyped-def]
    """Zeros for Gaussians behind a closed tile."""
    for entry in range(first, end):
        row = RECORD_SIZE * slots[entry]
        store(grad_records, row, broadcast(np.float32(0)))
        store(grad_records, row + LANES, broadcast(np.float32(0)))
        for value in range(num_values):
            store_scalar(grad_values, num_values * slots[entry] + value, np.float32(0))


GROUP = 4  # values whose gradients are summed at a time
MOMENTS = 16  # see `_sum_moments`
SHARES = 9  # where the sums of weight x upstream gradient begin
_LN2 = math.log(2)
PAIR = 2 * LANES  # numbers a pair of a Gaussian and a block: slopes and weights; one cache line
_LEAST = 1e-16  # of L^2 + along Q: only reached where the slope is 0
_AHEAD = 24  # Gaussians, between asking for a slot and writing it


@inline_kernel_no_refcount
def write_chunk(  # type: ignore[no-untyped-def]
    records, intersections, first, count, slots, heads, pairs, slopes, wide, forms, offsets, upstream, num_values,
    moments, exact, grad_records, grad_values,
):  # fmt: skip
    """Write the gradients of a chunk's Gaussians to their slots."""
    last = first + count - 1
    for s in range(count):
        ahead = load_scalar(slots, min(first + s + _AHEAD, last))
        prefetch_for_write(grad_values, num_values * ahead)
        _sum_moments(s, heads, pairs, slopes, wide, forms, offsets, upstream, moments)
        row = num_values * slots[first + s]
        for value in range(min(GROUP, num_values)):
            store_scalar(grad_values, row + value, load_scalar(moments, MOMENTS * s + SHARES + value))
        for value in range(GROUP, num_values):
            store_scalar(grad_values, row + value, _share_of(s, heads, pairs, slopes, upstream, value))
    for s in range(0, count, LANES):
        _write_records(s, records, intersections, first, count, slots, moments, exact, grad_records)


@inline_kernel_no_refcount
def _sum_moments(  # type: ignore[no-untyped-def]
    s, heads, pairs, slopes, wide, forms, offsets, upstream, moments
):
    """Sums over a Gaussian's pixels, with x = A / L, y = B / L, q = x^2 + y^2 and h = slope / (1 + along q)^2.
    All lack a factor log 2, for slopes are those by log alpha.

    They are those of h times x^2, x y, y^2, x, y, q x, q y, q^2, that of the slopes, and those of weight x upstream
    gradient of four values.
    """
    zero, one = broadcast(np.float32(0)), broadcast(np.float32(1))
    xx = xy = yy = by_x = by_y = q_x = q_y = by_along = by_level = zero
    share0 = share1 = share2 = share3 = zero
    along = load_broadcast(forms, ALONG_ROW * CHUNK_SIZE + s)
    pair = np.int64(load_scalar(heads, s))
    while pair >= 0:
        pixel = LANES * np.int64(load_scalar(pairs, 2 * pair))
        slope, weight = load(slopes, pair * PAIR), load(slopes, pair * PAIR + LANES)
        pair = np.int64(load_scalar(pairs, 2 * pair + 1))
        x, y, z = load(offsets, pixel), load(offsets, PIXELS + pixel), load(offsets, 2 * PIXELS + pixel)
        a, b, front = forms_at(wide, forms, s, x, y, z)
        q = multiply_add(a, a, b * b)
        inverse = one / max(multiply_add(front, front, along * q), broadcast(np.float32(_LEAST)))
        scaled = slope * inverse * inverse  # h / L^4
        ahead, across = scaled * front, scaled * q
        by_along, by_level = multiply_add(across, q, by_along), by_level + slope
        across, ahead = ahead * q, ahead * front
        q_x, q_y = multiply_add(across, a, q_x), multiply_add(across, b, q_y)
        x, y = ahead * a, ahead * b
        xx, xy, yy = multiply_add(x, a, xx), multiply_add(x, b, xy), multiply_add(y, b, yy)
        by_x, by_y = multiply_add(x, front, by_x), multiply_add(y, front, by_y)
        share0 = multiply_add(weight, load(upstream, pixel), share0)
        share1 = multiply_add(weight, load(upstream, pixel + PIXELS), share1)
        share2 = multiply_add(weight, load(upstream, pixel + 2 * PIXELS), share2)
        share3 = multiply_add(weight, load(upstream, pixel + 3 * PIXELS), share3)
    store(moments, MOMENTS * s, lane_sums(xx, xy, yy, by_x, by_y, q_x, q_y, by_along))
    store(moments, MOMENTS * s + LANES, lane_sums(by_level, share0, share1, share2, share3, zero, zero, zero))


@inline_kernel_no_refcount
def _share_of(s, heads, pairs, slopes, upstream, value):  # type: ignore[no-untyped-def]
    """The gradient of a Gaussian's value: the sum over its pixels of weight x upstream gradient."""
    share = zero = broadcast(np.float32(0))
    pair = np.int64(load_scalar(heads, s))
    while pair >= 0:
        pixel = value * PIXELS + LANES * np.int64(load_scalar(pairs, 2 * pair))
        share = multiply_add(load(slopes, pair * PAIR + LANES), load(upstream, pixel), share)
        pair = np.int64(load_scalar(pairs, 2 * pair + 1))
    return first_lane(lane_sums(share, zero, zero, zero, zero, zero, zero, zero))


@inline_kernel_no_refcount
def _write_records(  # type: ignore[no-untyped-def]
    s, records, intersections, first, count, slots, moments, exact, grad_records
):
    """Turn the moments of eight Gaussians into gradients of their records, and write them to their slots.

    The ray's length is free: with L = 1, d - n = x p + y q, where p and q are such that a.p = b.q = 1 and
    a.q = b.p = l.p = l.q = 0. So x and y tell what the offset was.
    """
    at = MOMENTS * s
    xx, xy, yy, x, y, q_x, q_y, along = _rows(moments, at)
    level, _, _, _, _, _, _, _ = _rows(moments, at + LANES)
    n, a, b, front_a, front_b = _record(records, intersections, first + s, first + count - 1)
    zero, one, two, on = (
        broadcast(np.float32(0)),
        broadcast(np.float32(1)),
        broadcast(np.float32(2 * _LN2)),
        broadcast(exact),
    )
    twice, half = two * on, broadcast(np.float32(_LN2))
    ahead = on * n[0], on * n[1], multiply_add(on, n[2], one - on)
    p, q = _cross(b, ahead), _cross(ahead, a)
    inverse = one / _dot(a, p)
    p = _combined(inverse, p, -front_a, n)
    q = _combined(inverse, q, -front_b, n)
    front = _combined(front_a, a, front_b, b)
    front = n[0] + front[0], n[1] + front[1], n[2] + front[2]
    by_front = _combined(twice * q_x, p, twice * q_y, q)
    by_a = _combined(two * (front_a * q_x - xx), p, two * (front_a * q_y - xy), q)
    by_b = _combined(two * (front_b * q_x - xy), p, two * (front_b * q_y - yy), q)
    by_n, back = _combined(two * x, a, two * y, b), -(twice * (xx + yy))
    n_x = by_front[0] + multiply_add(back, front[0], by_n[0])
    n_y = by_front[1] + multiply_add(back, front[1], by_n[1])
    n_z = by_front[2] + multiply_add(back, front[2], by_n[2])
    # The moments have been read: the rows take their place.
    _store_rows(moments, at, transpose(n_x, n_y, n_z, zero, zero, zero, by_a[0], by_a[1]))
    _store_rows(
        moments,
        at + LANES,
        transpose(by_a[2], by_b[0], by_b[1], by_b[2], twice * q_x, twice * q_y, half * on * along, half * level),
    )
    for place in range(s, min(s + LANES, count)):
        row = RECORD_SIZE * slots[first + place]
        store_nontemporal(grad_records, row, load(moments, MOMENTS * place))
        store_nontemporal(grad_records, row + LANES, load(moments, MOMENTS * place + LANES))


@inline_kernel_no_refcount
def _record(records, intersections, e, last):  # type: ignore[no-untyped-def]
    """n, a, b, front_a and front_b of eight Gaussians."""
    (n_x, n_y, n_z, _, _, _, a_x, a_y), rest = eight_records(records, intersections, e, last)
    a_z, b_x, b_y, b_z, front_a, front_b, _, _ = rest
    return (n_x, n_y, n_z), (a_x, a_y, a_z), (b_x, b_y, b_z), front_a, front_b


@inline_kernel_no_refcount
def _cross(a, b):  # type: ignore[no-untyped-def]
    return (
        multiply_add(a[1], b[2], -(a[2] * b[1])),
        multiply_add(a[2], b[0], -(a[0] * b[2])),
        multiply_add(a[0], b[1], -(a[1] * b[0])),
    )


@inline_kernel_no_refcount
def _dot(a, b):  # type: ignore[no-untyped-def]
    return multiply_add(a[0], b[0], multiply_add(a[1], b[1], a[2] * b[2]))


@inline_kernel_no_refcount
def _combined(s, a, t, b):  # type: ignore[no-untyped-def]
    """s a + t b"""
    return multiply_add(s, a[0], t * b[0]), multiply_add(s, a[1], t * b[1]), multiply_add(s, a[2], t * b[2])


@inline_kernel_no_refcount
def _rows(moments, at):  # type: ignore[no-untyped-def]
    """A column for each of eight numbers of eight Gaussians."""
    step = MOMENTS
    return load_transposed(
        moments, at, at + step, at + 2 * step, at + 3 * step, at + 4 * step, at + 5 * step, at + 6 * step, at + 7 * step
    )


@inline_kernel_no_refcount
def _store_rows(moments, at, rows):  # type: ignore[no-untyped-def]
    for row in range(LANES):
        store(moments, at + row * MOMENTS, rows[row])
