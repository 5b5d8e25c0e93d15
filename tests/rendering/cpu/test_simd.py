import numba
import numpy as np
import pytest

from pansplat.rendering.cpu import simd

FIRST = np.array((3, -1, 0.5, 8, -2, 0.25, 7, -9), dtype=np.float32)
SECOND = np.array((1, 2, -4, 8, 0.5, -3, 6, 10), dtype=np.float32)
SQUARE = np.arange(64, dtype=np.float32).reshape(8, 8) ** 2


@numba.njit
def _arithmetic(a, b, out):
    x, y = simd.load(a, 0), simd.load(b, 0)
    simd.store(out, 0, x + y)
    simd.store(out, 8, x - y)
    simd.store(out, 16, x * y)
    simd.store(out, 24, x / y)
    simd.store(out, 32, simd.multiply_add(x, y, x))
    simd.store(out, 40, simd.negative(x))
    simd.store(out, 48, simd.minimum(x, y))
    simd.store(out, 56, simd.maximum(x, y))


def test_arithmetic_is_numpys_lane_by_lane():
    out = np.empty((8, 8), np.float32)
    _arithmetic(FIRST, SECOND, out.reshape(-1))
    a, b = FIRST, SECOND
    assert np.array_equal(out, (a + b, a - b, a * b, a / b, a * b + a, -a, np.minimum(a, b), np.maximum(a, b)))


@numba.njit
def _masks(a, b, out):
    x, y = simd.load(a, 0), simd.load(b, 0)
    zero = simd.fill(np.float32(0))
    simd.store(out, 0, simd.choose(x <= y, x, zero))
    simd.store(out, 8, simd.choose(x > y, x, zero))
    simd.store(out, 16, simd.choose((x <= y) & (y > zero), x, zero))
    return simd.some(x > y), simd.some(x > x)


def test_masks_choose_lane_by_lane():
    out = np.empty((3, 8), np.float32)
    assert _masks(FIRST, SECOND, out.reshape(-1)) == (True, False)
    a, b = FIRST, SECOND
    expected = np.where(a <= b, a, 0), np.where(a > b, a, 0), np.where((a <= b) & (b > 0), a, 0)
    assert np.array_equal(out, expected)


@pytest.mark.parametrize("symbol", ["<=", ">"])
def test_what_is_not_a_number_compares_false(symbol):
    nothing, out = np.full(8, np.nan, np.float32), np.empty(24, np.float32)
    _masks(nothing, SECOND, out)
    assert np.array_equal(out, np.zeros(24))


@numba.njit
def _moves(a, out):
    simd.store(out, 1, simd.load(a, 3))
    simd.store(out, 9, simd.spread(a, 5))
    simd.put(out, 0, simd.first_lane(simd.load(a, 6)))
    simd.copy_four(out, 16, a, 12)
    simd.prefetch(a, 0)
    return simd.element(a, 2)


def test_numbers_are_moved_from_and_to_any_place():
    numbers, out = np.arange(16, dtype=np.float32), np.zeros(20, np.float32)
    assert _moves(numbers, out) == 2
    assert np.array_equal(out, [6, *range(3, 11), *[5] * 7, *range(12, 16)])


@numba.njit
def _columns(square, out):
    rows = simd.transposed(
        simd.load(square, 0),
        simd.load(square, 8),
        simd.load(square, 16),
        simd.load(square, 24),
        simd.load(square, 32),
        simd.load(square, 40),
        simd.load(square, 48),
        simd.load(square, 56),
    )
    for row in range(8):
        simd.store(out, 8 * row, rows[row])
    simd.store(out, 64, simd.totals(rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7]))


def test_a_square_is_transposed_and_its_columns_summed():
    out = np.empty((9, 8), np.float32)
    _columns(SQUARE.reshape(-1), out.reshape(-1))
    assert np.array_equal(out[:8], SQUARE.T)
    assert np.array_equal(out[8], SQUARE.sum(axis=0))


@numba.njit
def _side_by_side(square, out):
    upper, lower = simd.side_by_side(simd.load(square, 0), simd.load(square, 8))
    again, other = simd.side_by_side(upper, lower)
    simd.store(out, 0, upper)
    simd.store(out, 8, lower)
    simd.store(out, 16, again)
    simd.store(out, 24, other)


def test_two_blocks_of_pixels_become_two_rows_and_rows_become_blocks():
    out = np.empty((4, 8), np.float32)
    _side_by_side(SQUARE.reshape(-1), out.reshape(-1))
    left, right = SQUARE[0].reshape(2, 4), SQUARE[1].reshape(2, 4)
    assert np.array_equal(out[:2], np.concatenate((left, right), axis=1))
    assert np.array_equal(out[2:], SQUARE[:2])


@numba.njit
def _count_bits(words):
    return [simd.how_many(word) for word in words]


def test_bits_are_counted_in_all_of_a_word():
    words = np.array((0, 1, 0b1011, 1 << 63, 2**64 - 1), dtype=np.uint64)
    assert _count_bits(words) == [0, 1, 3, 1, 64]


@numba.njit
def _powers(values, out):
    for at in range(0, len(values), 8):
        simd.store(out, at, simd.exp2(simd.load(values, at)))


def test_powers_of_two_are_within_two_roundings():
    values = np.linspace(-126, 127, 80_000, dtype=np.float32)
    out = np.empty_like(values)
    _powers(values, out)
    assert np.abs(out / np.exp2(values.astype(np.float64)) - 1).max() < 2e-7
    whole = np.arange(-128, 128, dtype=np.float32)
    out = np.empty_like(whole)
    _powers(whole, out)
    assert np.array_equal(out[2:], np.ldexp(np.float32(1), np.arange(-126, 128)))
