"""Gradients of stage three: from that of an image to those of records and values, one slot per intersection.

Source: docs/rendering.md, sections 3 and 4. The forward saved the transmittance before each chunk of a tile, so chunks
are processed back to front, each with all its data in the L2 cache. In each block the weights are recomputed front to
back, then gradients back to front. The mean gradient by weight behind each Gaussian is blended from the back, without a
division by a transmittance. Then the gradient sums of each Gaussian over all its blocks are accumulated in registers
and converted to the gradient of its record.

An alpha depends on a pixel through A / L and B / L alone, which are a projective map of the pixel. This map has eight
parameters, and a rotation of A and B into each other has no effect on the alpha. So seven sums, and two for the radial
variance and the peak, are sufficient statistics of a tile's pixels in any frame.
"""

import math

import numpy as np

from pansplat.constants import MAX_ALPHA
from pansplat.rendering.cpu.rasterize import (
    BUFFER_SIZE,
    CHUNK_SIZE,
    CHUNK_WORDS,
    FOOTPRINT_SIZE,
    MIN_TRANSMITTANCE,
    NUM_BLOCKS,
    NUM_MASKS,
    RADIAL_VARIANCE,
    TILE_FRAME_SIZE,
    TILE_PIXELS,
    VALUE_LANES,
    Floats,
    Integers,
    Longs,
    SavedForBackward,
    compute_alpha,
    compute_log2_alphas,
    evaluate_footprint,
    image_position,
    load_chunk,
    load_eight_records,
    mark_blocks,
    prefetch_slice,
    set_tile_frame,
    set_tile_pixels,
)
from pansplat.rendering.cpu.records import RECORD_SIZE, TILE_SIZE, PixelTables
from pansplat.rendering.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
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
from pansplat.rendering.cpu.tiling import parallel_for_tiles
from pansplat.system.kernels import inline_kernel_no_refcount, kernel

_MAX_PAIRS = NUM_BLOCKS * CHUNK_SIZE  # pairs of a Gaussian and a block, in a chunk
_PAIR_SIZE = 2 * LANES  # numbers in a pair: gradients by log alpha, and weights; one cache line
_NUM_SUMS = 16  # numbers for each Gaussian, as `_accumulate_gradient_sums` lists them
_VALUE_SUMS = 9  # index of the first sum of values
_LN2 = math.log(2)
_MIN_DIVISOR = 1e-16  # smallest L^2 + radial_variance Q in a division; only reached where the gradient is 0
_WRITE_AHEAD = 24  # Gaussians between the prefetch of a slot and the write to it


def rasterize_backward(
    records: Floats,
    values: Floats,
    intersections: Integers,
    starts: Longs,
    slots: Integers | Longs,
    tables: PixelTables,
    sums: Floats,
    saved: SavedForBackward,
    grad_sums: Floats,
    grad_records: Floats,
    grad_values: Floats,
    *,
    first_row: int = 0,
    threads: int = 1,
) -> None:
    """Write each intersection's gradient to its slot.

    Args:
        records, values, intersections, starts: as in `rasterize_forward`.
        slots: see records.py.
        sums, saved: outputs of `rasterize_forward`.
        grad_sums: gradient of the sums, of the same shape.
        grad_records: (slot, RECORD_SIZE), written; zeros in DIRECTION_RESIDUAL. Aligned to 32 bytes, for non-temporal
            stores.
        grad_values: (slot, VALUE_LANES), written.
        first_row: first row of tiles of the band.
    """
    assert grad_records.size == 0 or grad_records.ctypes.data % (4 * LANES) == 0
    scene = records.reshape(-1), values, intersections.reshape(-1), starts, slots
    gradients = sums, *saved, grad_sums, grad_records.reshape(-1), grad_values.reshape(-1)
    parallel_for_tiles(_rasterize_tiles_backward, (*scene, *tables, *gradients, first_row), starts, threads)


@kernel
def _rasterize_tiles_backward(
    records, values, intersections, starts, slots, kind, columns, rows, rotation, sums, saved_transmittance,
    saved_rows, saved_num_chunks, grad_sums, grad_records, grad_values, first_row, low, high,
):  # fmt: skip
    tiles_across = (len(columns) + TILE_SIZE - 1) // TILE_SIZE
    offsets, centre = np.empty(3 * TILE_PIXELS, np.float32), np.empty(3)
    frame = np.empty(TILE_FRAME_SIZE, np.float32)
    tile_grads, behind = np.empty((VALUE_LANES + 2) * TILE_PIXELS, np.float32), np.empty(TILE_PIXELS, np.float32)
    tile_values = np.empty((VALUE_LANES + 1) * TILE_PIXELS, np.float32)
    footprints = np.empty(FOOTPRINT_SIZE * CHUNK_SIZE, np.float32)
    chunk_values = np.empty(VALUE_LANES * CHUNK_SIZE, np.float32)
    # `links` holds the block of each pair and the previous pair of the same Gaussian: a linked list from `heads` on.
    pairs, links = np.empty(_MAX_PAIRS * _PAIR_SIZE, np.float32), np.empty(2 * _MAX_PAIRS, np.int32)
    heads, masks = np.empty(CHUNK_SIZE, np.int32), np.empty(CHUNK_WORDS * NUM_MASKS, np.uint64)
    log2_alphas, indices = np.empty(2 * BUFFER_SIZE * LANES, np.float32), np.empty(2 * BUFFER_SIZE, np.uint8)
    alphas = np.empty(2 * BUFFER_SIZE * LANES, np.float32)
    weights = np.empty(2 * BUFFER_SIZE * LANES, np.float32)
    visible = np.empty(2 * BUFFER_SIZE, np.int32)
    gradient_sums = np.empty(_NUM_SUMS * CHUNK_SIZE, np.float32)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE_SIZE, (first_row + tile // tiles_across) * TILE_SIZE
        tile_is_3d, pixels_are_3d = set_tile_frame(kind, columns, rows, rotation, left, top, centre, frame), -1
        _load_tile_gradients(sums, grad_sums, left, top, tile_grads, tile_values)
        begin, end, num_chunks = starts[tile], starts[tile + 1], saved_num_chunks[tile]
        _write_zeros(slots, begin + CHUNK_SIZE * num_chunks, end, grad_records, grad_values)
        for pixel in range(TILE_PIXELS):
            behind[pixel] = -tile_grads[(VALUE_LANES + 1) * TILE_PIXELS + pixel]
        for chunk in range(num_chunks - 1, -1, -1):
            first = begin + chunk * CHUNK_SIZE
            count = min(CHUNK_SIZE, end - first)
            is_3d = load_chunk(
                records, values, intersections, first, count, frame, tile_is_3d, footprints, chunk_values
            )
            if pixels_are_3d != is_3d:
                set_tile_pixels(kind, columns, rows, rotation, left, top, centre, frame, is_3d, offsets)
                pixels_are_3d = np.int64(is_3d)
            mark_blocks(intersections, first, count, masks)
            next_first = first - CHUNK_SIZE
            if chunk == 0:  # the next chunk is the last one of the next tile
                next_first = end + CHUNK_SIZE * (saved_num_chunks[min(tile + 1, high - 1)] - 1)
            _backpropagate_chunk(
                records, values, intersections, next_first, is_3d, footprints, chunk_values, masks, offsets,
                saved_transmittance[saved_rows[tile] + chunk], tile_grads, behind, log2_alphas, indices, alphas,
                weights, visible, pairs, links, heads,
            )  # fmt: skip
            _write_chunk_gradients(
                records, intersections, first, count, slots, heads, links, pairs, is_3d, footprints, offsets,
                tile_grads, gradient_sums, grad_records, grad_values,
            )  # fmt: skip


@inline_kernel_no_refcount
def _load_tile_gradients(sums, grad_sums, left, top, tile_grads, values):
    """Load a tile's gradients by blocks, 0 outside the image; then write two more rows.

    These are the gradient of the sum of the weights minus the dot product of gradients and sums, and this dot
    product. The weights and the final transmittance sum to 1, so a constant may be subtracted from the value of each
    Gaussian and of the background. With their mean as this constant, the differences are small.

    Args:
        values: scratch of (VALUE_LANES + 1) TILE_PIXELS numbers.
    """
    height, width, num_rows = grad_sums.shape[1], grad_sums.shape[2], VALUE_LANES + 1
    for pixel in range(TILE_PIXELS):
        x, y = image_position(pixel, left, top)
        is_inside = x < width and y < height
        for row in range(num_rows):
            tile_grads[row * TILE_PIXELS + pixel] = grad_sums[row, y, x] if is_inside else np.float32(0)
            values[row * TILE_PIXELS + pixel] = sums[row, y, x] if is_inside else np.float32(0)
    for pixel in range(0, TILE_PIXELS, LANES):
        total = broadcast(np.float32(0))
        for row in range(pixel, num_rows * TILE_PIXELS, TILE_PIXELS):
            total = multiply_add(load(tile_grads, row), load(values, row), total)
        last = VALUE_LANES * TILE_PIXELS + pixel
        store(tile_grads, last, load(tile_grads, last) - total)
        store(tile_grads, last + TILE_PIXELS, total)


@inline_kernel_no_refcount
def _backpropagate_chunk(
    records, values, intersections, next_first, is_3d, footprints, chunk_values, masks, offsets, transmittance,
    tile_grads, behind, log2_alphas, indices, alphas, weights, visible, pairs, links, heads,
):  # fmt: skip
    """Compute weights and gradients by log alpha of a chunk's pairs, block by block."""
    heads[:] = -1
    # Three blocks are in progress at a time (software pipelining): log2 alphas of one, weights of the previous one,
    # gradients of the one before. Their latencies overlap, and each loop count is computed long before its loop.
    ready, num_ready, weighted, num_weighted, begin, pair = -1, 0, -1, 0, 0, 0
    for block in range(NUM_BLOCKS + 2):
        num_next, is_unfinished = 0, False
        if block < NUM_BLOCKS:
            prefetch_slice(records, values, intersections, block, next_first)
            is_unfinished = any_lane(load(transmittance, block * LANES) > broadcast(np.float32(MIN_TRANSMITTANCE)))
            if not is_unfinished:
                continue
            num_next = compute_log2_alphas(block, masks, is_3d, footprints, offsets, log2_alphas, indices, begin)
        other, num_visible = BUFFER_SIZE - begin, 0
        if ready >= 0:
            num_visible = _compute_block_weights(
                ready, num_ready, log2_alphas, indices, other, transmittance, begin, alphas, weights, visible
            )
        if weighted >= 0:
            _backpropagate_block(
                weighted, num_weighted, alphas, weights, visible, other, chunk_values, tile_grads, behind, pairs,
                links, heads, pair,
            )  # fmt: skip
            pair += num_weighted
        weighted, num_weighted, ready, num_ready = ready, num_visible, block if is_unfinished else -1, num_next
        begin = other


@inline_kernel_no_refcount
def _compute_block_weights(block, count, log2_alphas, indices, begin, transmittance, output, alphas, weights, visible):
    """Compute alphas and weights of the Gaussians that a pixel of the block sees; return their number.

    Args:
        log2_alphas, indices: numbers of `count` Gaussians, from `begin` on.
        alphas, weights, visible: written from `output` on; `visible` holds indices within the chunk.
    """
    transmitted, end = load(transmittance, block * LANES), output
    for at in range(begin, begin + count):
        alpha = compute_alpha(load(log2_alphas, at * LANES))
        store(alphas, end * LANES, alpha)
        store(weights, end * LANES, alpha * transmitted)
        store_scalar(visible, end, np.int32(load_scalar(indices, at)))
        transmitted = multiply_add(-alpha, transmitted, transmitted)
        # The next Gaussian overwrites this one if no pixel sees it: a branch would be mispredicted.
        end += np.int64(any_lane(alpha > broadcast(np.float32(0))))
    return end - output


@inline_kernel_no_refcount
def _backpropagate_block(
    block, count, alphas, weights, visible, begin, chunk_values, tile_grads, behind, pairs, links, heads, pair
):
    """Write a block's pairs, back to front: gradients by log alpha, weights, and their links."""
    max_alpha, zero = broadcast(np.float32(MAX_ALPHA)), broadcast(np.float32(0))
    pixel = block * LANES
    mean_behind, base = load(behind, pixel), load(tile_grads, VALUE_LANES * TILE_PIXELS + pixel)
    for at in range(begin + count - 1, begin - 1, -1):
        s = np.int64(load_scalar(visible, at))
        alpha, weight = load(alphas, at * LANES), load(weights, at * LANES)
        grad_weight = base
        for value in range(VALUE_LANES):
            factor = load_broadcast(chunk_values, VALUE_LANES * s + value)
            grad_weight = multiply_add(load(tile_grads, value * TILE_PIXELS + pixel), factor, grad_weight)
        difference = grad_weight - mean_behind
        store(pairs, pair * _PAIR_SIZE, select(max_alpha > alpha, weight * difference, zero))
        store(pairs, pair * _PAIR_SIZE + LANES, weight)
        mean_behind = multiply_add(alpha, difference, mean_behind)
        store_scalar(links, 2 * pair, np.int32(block))
        store_scalar(links, 2 * pair + 1, load_scalar(heads, s))
        store_scalar(heads, s, np.int32(pair))
        pair += 1
    store(behind, pixel, mean_behind)


@inline_kernel_no_refcount
def _write_zeros(slots, first, end, grad_records, grad_values):
    """Write zero gradients for the Gaussians behind a tile's last composited chunk."""
    for e in range(first, end):
        row = RECORD_SIZE * slots[e]
        store(grad_records, row, broadcast(np.float32(0)))
        store(grad_records, row + LANES, broadcast(np.float32(0)))
        for value in range(VALUE_LANES):
            store_scalar(grad_values, VALUE_LANES * slots[e] + value, np.float32(0))


# --- gradient sums ---


@inline_kernel_no_refcount
def _write_chunk_gradients(
    records, intersections, first, count, slots, heads, links, pairs, is_3d, footprints, offsets, tile_grads,
    gradient_sums, grad_records, grad_values,
):  # fmt: skip
    """Write the gradients of a chunk's records and values to their slots."""
    last = first + count - 1
    for s in range(count):
        prefetch_for_write(grad_values, VALUE_LANES * load_scalar(slots, min(first + s + _WRITE_AHEAD, last)))
        _accumulate_gradient_sums(s, heads, links, pairs, is_3d, footprints, offsets, tile_grads, gradient_sums)
        row = VALUE_LANES * slots[first + s]
        for value in range(VALUE_LANES):
            store_scalar(grad_values, row + value, load_scalar(gradient_sums, _NUM_SUMS * s + _VALUE_SUMS + value))
    for s in range(0, count, LANES):
        _write_record_gradients(s, records, intersections, first, count, slots, gradient_sums, grad_records)


@inline_kernel_no_refcount
def _accumulate_gradient_sums(s, heads, links, pairs, is_3d, footprints, offsets, tile_grads, gradient_sums):
    """Sums over a Gaussian's pixels, without a factor log 2, since `gradient` is by log alpha.

    With x = A / L, y = B / L, q = x^2 + y^2 and h = gradient / (1 + radial_variance q)^2, these are the sums of h times
    x^2, x y, y^2, x, y, q x, q y and q^2, of the gradient, and of the weight times the gradients of four values.
    """
    zero, one = broadcast(np.float32(0)), broadcast(np.float32(1))
    xx = xy = yy = sum_x = sum_y = qx = qy = qq = sum_gradient = zero
    value0 = value1 = value2 = value3 = zero
    radial_variance = load_broadcast(footprints, RADIAL_VARIANCE * CHUNK_SIZE + s)
    pair = np.int64(load_scalar(heads, s))
    while pair >= 0:
        pixel = LANES * np.int64(load_scalar(links, 2 * pair))
        gradient, weight = load(pairs, pair * _PAIR_SIZE), load(pairs, pair * _PAIR_SIZE + LANES)
        pair = np.int64(load_scalar(links, 2 * pair + 1))
        x, y, z = load(offsets, pixel), load(offsets, TILE_PIXELS + pixel), load(offsets, 2 * TILE_PIXELS + pixel)
        a, b, front = evaluate_footprint(is_3d, footprints, s, x, y, z)
        q = multiply_add(a, a, b * b)
        inverse = one / max(multiply_add(front, front, radial_variance * q), broadcast(np.float32(_MIN_DIVISOR)))
        scaled = gradient * inverse * inverse  # h / L^4
        by_front, by_q = scaled * front, scaled * q
        qq, sum_gradient = multiply_add(by_q, q, qq), sum_gradient + gradient
        by_q, by_front = by_front * q, by_front * front
        qx, qy = multiply_add(by_q, a, qx), multiply_add(by_q, b, qy)
        x, y = by_front * a, by_front * b
        xx, xy, yy = multiply_add(x, a, xx), multiply_add(x, b, xy), multiply_add(y, b, yy)
        sum_x, sum_y = multiply_add(x, front, sum_x), multiply_add(y, front, sum_y)
        value0 = multiply_add(weight, load(tile_grads, pixel), value0)
        value1 = multiply_add(weight, load(tile_grads, pixel + TILE_PIXELS), value1)
        value2 = multiply_add(weight, load(tile_grads, pixel + 2 * TILE_PIXELS), value2)
        value3 = multiply_add(weight, load(tile_grads, pixel + 3 * TILE_PIXELS), value3)
    at = _NUM_SUMS * s
    store(gradient_sums, at, lane_sums(xx, xy, yy, sum_x, sum_y, qx, qy, qq))
    store(gradient_sums, at + LANES, lane_sums(sum_gradient, value0, value1, value2, value3, zero, zero, zero))


@inline_kernel_no_refcount
def _write_record_gradients(s, records, intersections, first, count, slots, gradient_sums, grad_records):
    """Convert the sums of eight Gaussians to the gradients of their records, and write these to their slots.

    The length of a ray is arbitrary. For L = 1, d - n = x p + y q, where a.p = b.q = 1 and a.q = b.p = l.p = l.q = 0.
    """
    at = _NUM_SUMS * s
    xx, xy, yy, sum_x, sum_y, qx, qy, qq = _load_columns(gradient_sums, at)
    sum_gradient, _, _, _, _, _, _, _ = _load_columns(gradient_sums, at + LANES)
    low, high = load_eight_records(records, intersections, first + s, first + count - 1)
    n_x, n_y, n_z, _, _, _, a_x, a_y = low
    a_z, b_x, b_y, b_z, l_along_a, l_along_b, _, _ = high
    n, a, b = (n_x, n_y, n_z), (a_x, a_y, a_z), (b_x, b_y, b_z)
    zero, one = broadcast(np.float32(0)), broadcast(np.float32(1))
    two, half = broadcast(np.float32(2 * _LN2)), broadcast(np.float32(_LN2))
    p, q = _cross(b, n), _cross(n, a)
    inverse = one / _dot(a, p)
    p = _combine(inverse, p, -l_along_a, n)
    q = _combine(inverse, q, -l_along_b, n)
    l_row = _combine(l_along_a, a, l_along_b, b)
    l_row = n[0] + l_row[0], n[1] + l_row[1], n[2] + l_row[2]
    grad_l = _combine(two * qx, p, two * qy, q)
    grad_a = _combine(two * (l_along_a * qx - xx), p, two * (l_along_a * qy - xy), q)
    grad_b = _combine(two * (l_along_b * qx - xy), p, two * (l_along_b * qy - yy), q)
    across, back = _combine(two * sum_x, a, two * sum_y, b), -(two * (xx + yy))
    grad_n_x = grad_l[0] + multiply_add(back, l_row[0], across[0])
    grad_n_y = grad_l[1] + multiply_add(back, l_row[1], across[1])
    grad_n_z = grad_l[2] + multiply_add(back, l_row[2], across[2])
    # The gradients overwrite the sums, which are in registers.
    low = transpose(grad_n_x, grad_n_y, grad_n_z, zero, zero, zero, grad_a[0], grad_a[1])
    high = transpose(grad_a[2], grad_b[0], grad_b[1], grad_b[2], two * qx, two * qy, half * qq, half * sum_gradient)
    _store_rows(gradient_sums, at, low)
    _store_rows(gradient_sums, at + LANES, high)
    for i in range(s, min(s + LANES, count)):
        row = RECORD_SIZE * slots[first + i]
        store_nontemporal(grad_records, row, load(gradient_sums, _NUM_SUMS * i))
        store_nontemporal(grad_records, row + LANES, load(gradient_sums, _NUM_SUMS * i + LANES))


@inline_kernel_no_refcount
def _cross(a, b):
    return (
        multiply_add(a[1], b[2], -(a[2] * b[1])),
        multiply_add(a[2], b[0], -(a[0] * b[2])),
        multiply_add(a[0], b[1], -(a[1] * b[0])),
    )


@inline_kernel_no_refcount
def _dot(a, b):
    return multiply_add(a[0], b[0], multiply_add(a[1], b[1], a[2] * b[2]))


@inline_kernel_no_refcount
def _combine(s, a, t, b):
    """s a + t b"""
    return multiply_add(s, a[0], t * b[0]), multiply_add(s, a[1], t * b[1]), multiply_add(s, a[2], t * b[2])


@inline_kernel_no_refcount
def _load_columns(sums, at):
    """Columns of eight numbers of eight Gaussians."""
    r = _NUM_SUMS
    return load_transposed(sums, at, at + r, at + 2 * r, at + 3 * r, at + 4 * r, at + 5 * r, at + 6 * r, at + 7 * r)


@inline_kernel_no_refcount
def _store_rows(sums, at, rows):
    for row in range(LANES):
        store(sums, at + row * _NUM_SUMS, rows[row])
