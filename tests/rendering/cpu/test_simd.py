"""SIMD vectors give the results of numpy in every lane; transposes convert arrays to rows and back."""

import math

import numba
import numpy as np
import pytest
from numba.core import types

from pansplat.rendering.cpu import simd
from pansplat.rendering.cpu.records import RECORD_SIZE
from pansplat.rendering.cpu.runtime import kernel
from pansplat.rendering.cpu.simd import LANES, load, load_row, store, store_row

FIRST = np.array((3, -1, 0.5, 8, -2, 0.25, 7, -9), dtype=np.float32)
SECOND = np.array((1, 2, -4, 8, 0.5, -3, 6, 10), dtype=np.float32)
SQUARE = np.arange(64, dtype=np.float32).reshape(8, 8) ** 2
WIDTH = 16  # of the rows that arrays are turned into


@numba.njit
def _f32_arithmetic(a, b, out):
    x, y, zero = load(a, 0), load(b, 0), simd.broadcast(np.float32(0))
    store(out, 0, x + y)
    store(out, 8, x - y)
    store(out, 16, x * y)
    store(out, 24, x / y)
    store(out, 32, simd.multiply_add(x, y, x))
    store(out, 40, -x)
    store(out, 48, min(x, y))
    store(out, 56, max(x, y))
    store(out, 64, simd.select(x <= y, x, zero))
    store(out, 72, simd.select(x > y, x, zero))
    store(out, 80, simd.select((x <= y) & (y > zero), x, zero))
    return simd.any_lane(x > y), simd.any_lane(x > x)


def test_f32_arithmetic_equals_numpy():
    out = np.empty((11, 8), np.float32)
    assert _f32_arithmetic(FIRST, SECOND, out.reshape(-1)) == (True, False)
    a, b = FIRST, SECOND
    assert np.array_equal(out[:8], (a + b, a - b, a * b, a / b, a * b + a, -a, np.minimum(a, b), np.maximum(a, b)))
    assert np.array_equal(out[8:], (np.where(a <= b, a, 0), np.where(a > b, a, 0), np.where((a <= b) & (b > 0), a, 0)))


def test_comparisons_with_nan_are_false():
    nan, out = np.full(8, np.nan, np.float32), np.empty((11, 8), np.float32)
    _f32_arithmetic(nan, SECOND, out.reshape(-1))
    assert not out[8:].any()


@kernel
def _f64_arithmetic(rows):
    simd.align_stack()
    a, b = load_row(rows, 0, 0), load_row(rows, 1, 0)
    store_row(rows, 2, 0, a + 2 * b - 1)
    store_row(rows, 3, 0, 1 / a * b / 3)
    store_row(rows, 4, 0, math.sqrt(abs(a)) - max(b, 0.5))
    store_row(rows, 5, 0, math.copysign(2.0, -a))
    store_row(rows, 6, 0, simd.select((a < b) & (b >= 0), a, simd.broadcast(7.0)))
    mantissa, exponent = simd.mantissa_and_exponent(abs(a))
    store_row(rows, 7, 0, mantissa)
    store_row(rows, 8, 0, exponent)
    store_row(rows, 9, 0, simd.to_f64(simd.to_f32(a)))
    return simd.mask_bits(a <= 0), simd.mask_bits(a > b), simd.mask_bits(a == a)


def test_f64_arithmetic_equals_numpy():
    rows = np.zeros((10, LANES))
    rows[:2] = np.random.default_rng(0).standard_normal((2, LANES)) * 10.0 ** np.arange(-4, 4)
    a, b = rows[:2].copy()
    _f64_arithmetic(rows)
    assert np.allclose(rows[2], a + 2 * b - 1, rtol=1e-15, atol=1e-15)  # a product and a sum may be rounded once
    assert np.allclose(rows[3], b / a / 3, rtol=1e-15)
    assert np.allclose(rows[4], np.sqrt(np.abs(a)) - np.maximum(b, 0.5), rtol=1e-15)
    assert np.array_equal(rows[5], np.copysign(2.0, -a))
    assert np.array_equal(rows[6], np.where((a < b) & (b >= 0), a, 7.0))
    assert np.array_equal(rows[7] * 2.0 ** rows[8], np.abs(a))
    assert (rows[7] >= math.sqrt(0.5)).all() and (rows[7] < math.sqrt(2)).all()
    assert np.array_equal(rows[9], a.astype(np.float32))


def test_mask_bits_equal_numpy_comparisons():
    rows = np.zeros((10, LANES))
    rows[:2] = np.random.default_rng(0).standard_normal((2, LANES))
    rows[0, 3] = np.nan
    a, b = rows[:2].copy()
    for bits, expected in zip(_f64_arithmetic(rows), (a <= 0, a > b, a == a), strict=True):
        assert [bool(bits >> lane & 1) for lane in range(LANES)] == expected.tolist()


@numba.njit
def _moves(a, out):
    store(out, 1, load(a, 3))
    store(out, 9, simd.load_broadcast(a, 5))
    simd.store_scalar(out, 0, simd.first_lane(load(a, 6)))
    simd.copy_four(out, 16, a, 12)
    simd.prefetch(a, 0)
    store(out, 20, simd.load_four(a, 2))
    return simd.load_scalar(a, 2)


def test_loads_and_stores_need_no_alignment():
    numbers, out = np.arange(16, dtype=np.float32), np.zeros(28, np.float32)
    assert _moves(numbers, out) == 2
    assert np.array_equal(out, [6, *range(3, 11), *[5] * 7, *range(12, 16), 2, 3, 4, 5, 0, 0, 0, 0])


@numba.njit
def _square(square, out):
    rows = simd.load_transposed(square, 0, 8, 16, 24, 32, 40, 48, 56)
    for row in range(8):
        store(out, 8 * row, rows[row])
    store(out, 64, simd.lane_sums(rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7]))
    upper, lower = simd.join_halves(load(square, 0), load(square, 8))
    again, other = simd.join_halves(upper, lower)
    store(out, 72, upper)
    store(out, 80, lower)
    store(out, 88, again)
    store(out, 96, other)


def test_matrices_are_transposed_and_summed_and_halves_joined():
    out = np.empty((13, 8), np.float32)
    _square(SQUARE.reshape(-1), out.reshape(-1))
    assert np.array_equal(out[:8], SQUARE.T)
    assert np.array_equal(out[8], SQUARE.sum(axis=0))
    left, right = SQUARE[0].reshape(2, 4), SQUARE[1].reshape(2, 4)
    assert np.array_equal(out[9:11], np.concatenate((left, right), axis=1))
    assert np.array_equal(out[11:], SQUARE[:2])


@numba.njit
def _exp2(values, out):
    for at in range(0, len(values), 8):
        store(out, at, simd.exp2(load(values, at)))


def test_exp2_is_within_two_roundings():
    values = np.linspace(-126, 127, 80_000, dtype=np.float32)
    out = np.empty_like(values)
    _exp2(values, out)
    assert np.abs(out / np.exp2(values.astype(np.float64)) - 1).max() < 2e-7
    whole = np.arange(-128, 128, dtype=np.float32)
    out = np.empty_like(whole)
    _exp2(whole, out)
    assert np.array_equal(out[2:], np.ldexp(np.float32(1), np.arange(-126, 128)))


@simd._access(types.void, types.uint64, types.intp)
def _list_in_a_loop(builder, pointer, bits, base):
    """The code of `list_set_bits` for processors without AVX-512's compress instruction."""
    simd._loop_over_set_bits(builder, pointer, bits, builder.trunc(base, simd._BYTE))


@numba.njit
def _list(out, word):
    simd.list_set_bits(out, 3, word, 128)
    return simd.popcount(word)


@numba.njit
def _list_without_compress(out, word):
    _list_in_a_loop(out, 3, word, 128)
    return simd.popcount(word)


@pytest.mark.parametrize("listed", [_list, _list_without_compress])
@pytest.mark.parametrize("positions", [[], [0], [63], [3, 5, 62], list(range(64))])
def test_set_bits_are_counted_and_listed_in_order(listed, positions):
    out = np.full(80, 255, np.uint8)
    assert listed(out, np.uint64(sum(1 << position for position in positions))) == len(positions)
    assert out[3 : 3 + len(positions)].tolist() == [128 + position for position in positions]
    assert (out[:3] == 255).all() and (out[67:] == 255).all()


_BOUND = np.uint32(2 * int(np.float32(1e30).view(np.uint32)))


@kernel
def _aos_to_soa(ones, threes, fours, start, count, rows, bound):
    largest = simd.aos1_to_soa(ones, start, count, rows, 0, simd.broadcast(np.float32(0)))
    largest = simd.aos3_to_soa(threes, start, count, rows, 1, largest)
    return simd.any_magnitude_reaches(simd.aos4_to_soa(fours, start, count, rows, 4, largest), bound)


@kernel
def _soa_to_aos(rows, start, count, ones, threes, fours):
    simd.soa_to_aos1(rows, 0, start, count, ones)
    simd.soa_to_aos3(rows, 1, start, count, threes)
    simd.soa_to_aos4(rows, 4, start, count, fours)


def _groups():
    rng = np.random.default_rng(0)
    return [rng.standard_normal((30, size)).astype(np.float32) for size in (1, 3, 4)]


@pytest.mark.parametrize("count", [1, 7, 8, 9, 16])
def test_soa_rows_are_the_transposed_groups_and_convert_back(count):
    groups = _groups()
    rows = np.full((8, WIDTH), np.nan)
    assert not _aos_to_soa(*(group.reshape(-1) for group in groups), 5, count, rows, _BOUND)
    assert np.array_equal(rows[:, :count], np.concatenate(groups, axis=1)[5 : 5 + count].T)
    assert np.isnan(rows[:, count:]).all()

    written = [np.full_like(group, -9) for group in groups]
    _soa_to_aos(rows, 3, count, *(group.reshape(-1) for group in written))
    for group, copy in zip(groups, written, strict=True):
        assert np.array_equal(copy[3 : 3 + count], group[5 : 5 + count])
        assert (copy[:3] == -9).all() and (copy[3 + count :] == -9).all()


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e30, -2e30])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_nan_or_large_number_is_reported_in_every_lane(number, which):
    for lane in range(LANES):
        groups = _groups()
        groups[which][5 + lane, -1] = number
        assert _aos_to_soa(*(group.reshape(-1) for group in groups), 5, 8, np.zeros((8, WIDTH)), _BOUND)


@kernel
def _records_to_soa(records, start, count, soa):
    simd.records_to_soa(records, start, count, soa, WIDTH)


@kernel
def _soa_to_records(soa, start, count, records):
    simd.soa_to_records(soa, WIDTH, start, count, records)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 16])
def test_soa_rows_are_the_transposed_records_padded_with_the_last_one(count, workspace):
    records = np.random.default_rng(0).standard_normal((30, RECORD_SIZE)).astype(np.float32)
    soa = np.full((RECORD_SIZE, WIDTH), np.nan, np.float32)
    _records_to_soa(records.reshape(-1), 5, count, soa.reshape(-1))
    filled = -(-count // 8) * 8
    expected = records[5 + np.minimum(np.arange(filled), count - 1)].T
    assert np.array_equal(soa[:, :filled], expected) and np.isnan(soa[:, filled:]).all()

    written = workspace.array((30, RECORD_SIZE), np.float32)
    written[:] = -1
    _soa_to_records(soa.reshape(-1), 8, count, written.reshape(-1))
    assert np.array_equal(written[8 : 8 + count], records[5 : 5 + count])
    assert (written[:8] == -1).all() and (written[8 + count :] == -1).all()
