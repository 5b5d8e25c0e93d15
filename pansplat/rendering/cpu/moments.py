"""Moments of a Gaussian over the pixels of a tile, and the gradient of its record that they make.

Source: docs/rendering.md, section 3. A response depends on A / L and B / L alone, which a pixel has by a projection:
eight numbers, of which one only turns A and B into each other. So seven sums, and those for `along` and `level`, are
all that the pixels have to say, whatever tile or components the forms were found in.
"""

import math

import numpy as np

from pansplat.rendering.cpu.columns import columns_of
from pansplat.rendering.cpu.compiling import borrowing
from pansplat.rendering.cpu.raster import forms_at
from pansplat.rendering.cpu.records import FIELDS
from pansplat.rendering.cpu.simd import (
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
from pansplat.rendering.cpu.tile import ALONG_ROW, CHUNK, PIXELS, eight_records

GROUP = 4  # values whose gradients are summed at a time
MOMENTS = 16  # see `_sum_moments`
SHARES = 9  # where the sums of weight x upstream gradient begin
_LN2 = math.log(2)
PAIR = 2 * LANES  # numbers a pair of a Gaussian and a block: slopes and weights; one cache line
_LEAST = 1e-16  # of L^2 + along Q: only reached where the slope is 0
_AHEAD = 24  # Gaussians, between asking for a slot and writing it


@borrowing
def write_chunk(  # type: ignore[no-untyped-def]
    records, entries, first, count, slots, heads, pairs, slopes, wide, forms, offsets, upstream, num_values, moments,
    exact, grad_records, grad_values,
):  # fmt: skip
    """Write the gradients of a chunk's Gaussians to their slots."""
    last = first + count - 1
    for s in range(count):
        ahead = element(slots, min(first + s + _AHEAD, last))
        prefetch_to_write(grad_values, num_values * ahead)
        _sum_moments(s, heads, pairs, slopes, wide, forms, offsets, upstream, moments)
        row = num_values * slots[first + s]
        for value in range(min(GROUP, num_values)):
            put(grad_values, row + value, element(moments, MOMENTS * s + SHARES + value))
        for value in range(GROUP, num_values):
            put(grad_values, row + value, _share_of(s, heads, pairs, slopes, upstream, value))
    for s in range(0, count, LANES):
        _write_records(s, records, entries, first, count, slots, moments, exact, grad_records)


@borrowing
def _sum_moments(  # type: ignore[no-untyped-def]
    s, heads, pairs, slopes, wide, forms, offsets, upstream, moments
):
    """Sums over a Gaussian's pixels, with x = A / L, y = B / L, q = x^2 + y^2 and h = slope / (1 + along q)^2.
    All lack a factor log 2, for slopes are those by log alpha.

    They are those of h times x^2, x y, y^2, x, y, q x, q y, q^2, that of the slopes, and those of weight x upstream
    gradient of four values.
    """
    zero, one = fill(np.float32(0)), fill(np.float32(1))
    xx = xy = yy = by_x = by_y = q_x = q_y = by_along = by_level = zero
    share0 = share1 = share2 = share3 = zero
    along = spread(forms, ALONG_ROW * CHUNK + s)
    pair = np.int64(element(heads, s))
    while pair >= 0:
        pixel = LANES * np.int64(element(pairs, 2 * pair))
        slope, weight = load(slopes, pair * PAIR), load(slopes, pair * PAIR + LANES)
        pair = np.int64(element(pairs, 2 * pair + 1))
        x, y, z = load(offsets, pixel), load(offsets, PIXELS + pixel), load(offsets, 2 * PIXELS + pixel)
        a, b, front = forms_at(wide, forms, s, x, y, z)
        q = multiply_add(a, a, b * b)
        inverse = one / maximum(multiply_add(front, front, along * q), fill(np.float32(_LEAST)))
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
    store(moments, MOMENTS * s, totals(xx, xy, yy, by_x, by_y, q_x, q_y, by_along))
    store(moments, MOMENTS * s + LANES, totals(by_level, share0, share1, share2, share3, zero, zero, zero))


@borrowing
def _share_of(s, heads, pairs, slopes, upstream, value):  # type: ignore[no-untyped-def]
    """The gradient of a Gaussian's value: the sum over its pixels of weight x upstream gradient."""
    share = zero = fill(np.float32(0))
    pair = np.int64(element(heads, s))
    while pair >= 0:
        pixel = value * PIXELS + LANES * np.int64(element(pairs, 2 * pair))
        share = multiply_add(load(slopes, pair * PAIR + LANES), load(upstream, pixel), share)
        pair = np.int64(element(pairs, 2 * pair + 1))
    return first_lane(totals(share, zero, zero, zero, zero, zero, zero, zero))


@borrowing
def _write_records(  # type: ignore[no-untyped-def]
    s, records, entries, first, count, slots, moments, exact, grad_records
):
    """Turn the moments of eight Gaussians into gradients of their records, and write them to their slots.

    The ray's length is free: with L = 1, d - n = x p + y q, where p and q are such that a.p = b.q = 1 and
    a.q = b.p = l.p = l.q = 0. So x and y tell what the offset was.
    """
    at = MOMENTS * s
    xx, xy, yy, x, y, q_x, q_y, along = _rows(moments, at)
    level, _, _, _, _, _, _, _ = _rows(moments, at + LANES)
    n, a, b, front_a, front_b = _record(records, entries, first + s, first + count - 1)
    zero, one, two, on = fill(np.float32(0)), fill(np.float32(1)), fill(np.float32(2 * _LN2)), fill(exact)
    twice, half = two * on, fill(np.float32(_LN2))
    ahead = on * n[0], on * n[1], multiply_add(on, n[2], one - on)
    p, q = _cross(b, ahead), _cross(ahead, a)
    inverse = one / _dot(a, p)
    p = _combined(inverse, p, negative(front_a), n)
    q = _combined(inverse, q, negative(front_b), n)
    front = _combined(front_a, a, front_b, b)
    front = n[0] + front[0], n[1] + front[1], n[2] + front[2]
    by_front = _combined(twice * q_x, p, twice * q_y, q)
    by_a = _combined(two * (front_a * q_x - xx), p, two * (front_a * q_y - xy), q)
    by_b = _combined(two * (front_b * q_x - xy), p, two * (front_b * q_y - yy), q)
    by_n, back = _combined(two * x, a, two * y, b), negative(twice * (xx + yy))
    n_x = by_front[0] + multiply_add(back, front[0], by_n[0])
    n_y = by_front[1] + multiply_add(back, front[1], by_n[1])
    n_z = by_front[2] + multiply_add(back, front[2], by_n[2])
    # The moments have been read: the rows take their place.
    _store_rows(moments, at, transposed(n_x, n_y, n_z, zero, zero, zero, by_a[0], by_a[1]))
    _store_rows(
        moments,
        at + LANES,
        transposed(by_a[2], by_b[0], by_b[1], by_b[2], twice * q_x, twice * q_y, half * on * along, half * level),
    )
    for place in range(s, min(s + LANES, count)):
        row = FIELDS * slots[first + place]
        store_past_cache(grad_records, row, load(moments, MOMENTS * place))
        store_past_cache(grad_records, row + LANES, load(moments, MOMENTS * place + LANES))


@borrowing
def _record(records, entries, e, last):  # type: ignore[no-untyped-def]
    """n, a, b, front_a and front_b of eight Gaussians."""
    (n_x, n_y, n_z, _, _, _, a_x, a_y), rest = eight_records(records, entries, e, last)
    a_z, b_x, b_y, b_z, front_a, front_b, _, _ = rest
    return (n_x, n_y, n_z), (a_x, a_y, a_z), (b_x, b_y, b_z), front_a, front_b


@borrowing
def _cross(a, b):  # type: ignore[no-untyped-def]
    return (
        multiply_add(a[1], b[2], negative(a[2] * b[1])),
        multiply_add(a[2], b[0], negative(a[0] * b[2])),
        multiply_add(a[0], b[1], negative(a[1] * b[0])),
    )


@borrowing
def _dot(a, b):  # type: ignore[no-untyped-def]
    return multiply_add(a[0], b[0], multiply_add(a[1], b[1], a[2] * b[2]))


@borrowing
def _combined(s, a, t, b):  # type: ignore[no-untyped-def]
    """s a + t b"""
    return multiply_add(s, a[0], t * b[0]), multiply_add(s, a[1], t * b[1]), multiply_add(s, a[2], t * b[2])


@borrowing
def _rows(moments, at):  # type: ignore[no-untyped-def]
    """A column for each of eight numbers of eight Gaussians."""
    step = MOMENTS
    return columns_of(
        moments, at, at + step, at + 2 * step, at + 3 * step, at + 4 * step, at + 5 * step, at + 6 * step, at + 7 * step
    )


@borrowing
def _store_rows(moments, at, rows):  # type: ignore[no-untyped-def]
    for row in range(LANES):
        store(moments, at + row * MOMENTS, rows[row])
