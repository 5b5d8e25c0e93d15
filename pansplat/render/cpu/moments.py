"""Moments of a Gaussian over the pixels of a tile, and the gradient of its record that they make.

Source: docs/rendering.md, section 3. The forms are linear in a pixel's offset from the Gaussian, so the derivatives by
them, summed alone and times the offset, are all that the pixels have to say.
"""

import numpy as np

from pansplat.render.cpu.columns import columns_of
from pansplat.render.cpu.compiling import inlined
from pansplat.render.cpu.raster import forms_at
from pansplat.render.cpu.records import FIELDS
from pansplat.render.cpu.simd import (
    LANES,
    element,
    fill,
    first_lane,
    load,
    maximum,
    multiply_add,
    negative,
    prefetch_to_write,
    put,
    spread,
    store,
    store_past_cache,
    totals,
    transposed,
)
from pansplat.render.cpu.tile import A_X, ALONG_ROW, B_X, CHUNK, FRONTS, L_X, PIXELS

GROUP = 4  # values whose gradients are summed at a time
MOMENTS = 16  # (x, y, z, 1) of A, of B, of L; along; level; two to spare
PAIR = 2 * LANES  # numbers a pair of a Gaussian and a block: slopes and weights; one cache line
_LEAST = 1e-16  # of L^2 + along Q: only reached where the slope is 0
_AHEAD = 24  # Gaussians, between asking for a slot and writing it


@inlined
def write_chunk(  # type: ignore[no-untyped-def]
    first, count, slots, heads, pairs, slopes, forms, offsets, upstream, num_values, moments, shares, exact,
    grad_records, grad_values,
):  # fmt: skip
    """Write the gradients of a chunk's Gaussians to their slots."""
    last = first + count - 1
    for s in range(count):
        ahead = element(slots, min(first + s + _AHEAD, last))
        prefetch_to_write(grad_values, num_values * ahead)
        _sum_moments(s, heads, pairs, slopes, forms, offsets, upstream, moments, shares)
        row = num_values * slots[first + s]
        for value in range(min(GROUP, num_values)):
            put(grad_values, row + value, element(shares, value))
        for value in range(GROUP, num_values):
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
        slope, weight = load(slopes, pair * PAIR), load(slopes, pair * PAIR + LANES)
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
    store(moments, MOMENTS * s, totals(a_x, a_y, a_z, a_one, b_x, b_y, b_z, b_one))
    store(moments, MOMENTS * s + LANES, totals(l_x, l_y, l_z, l_one, by_along, by_level, zero, zero))
    store(shares, 0, totals(share0, share1, share2, share3, zero, zero, zero, zero))


@inlined
def _share_of(s, heads, pairs, slopes, upstream, value):  # type: ignore[no-untyped-def]
    """The gradient of a Gaussian's value: the sum over its pixels of weight x upstream gradient."""
    share = zero = fill(np.float32(0))
    pair = np.int64(element(heads, s))
    while pair >= 0:
        pixel = value * PIXELS + LANES * np.int64(element(pairs, 2 * pair))
        share = multiply_add(load(slopes, pair * PAIR + LANES), load(upstream, pixel), share)
        pair = np.int64(element(pairs, 2 * pair + 1))
    return first_lane(totals(share, zero, zero, zero, zero, zero, zero, zero))


@inlined
def _write_records(  # type: ignore[no-untyped-def]
    s, first, count, slots, forms, moments, exact, grad_records
):
    """Turn the moments of eight Gaussians into gradients of their records, and write them to their slots."""
    at = MOMENTS * s
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
        store_past_cache(grad_records, row, load(moments, MOMENTS * place))
        store_past_cache(grad_records, row + LANES, load(moments, MOMENTS * place + LANES))


@inlined
def _column(forms, row, s):  # type: ignore[no-untyped-def]
    return load(forms, row * CHUNK + s), load(forms, (row + 1) * CHUNK + s), load(forms, (row + 2) * CHUNK + s)


@inlined
def _rows(moments, at):  # type: ignore[no-untyped-def]
    """A column for each of eight numbers of eight Gaussians."""
    step = MOMENTS
    return columns_of(
        moments, at, at + step, at + 2 * step, at + 3 * step, at + 4 * step, at + 5 * step, at + 6 * step, at + 7 * step
    )


@inlined
def _store_rows(moments, at, rows):  # type: ignore[no-untyped-def]
    for row in range(LANES):
        store(moments, at + row * MOMENTS, rows[row])
