"""Vectors of eight float64: what works on numbers works on them, lane by lane."""

import math

import numpy as np
import pytest

from pansplat.rendering.cpu.runtime import kernel
from pansplat.rendering.cpu.simd import LANES
from pansplat.rendering.cpu.wide import align_stack, bits_of, either, fill_wide, get, keep, mantissa_and_exponent


@kernel
def _arithmetic(rows):
    align_stack()
    a, b = get(rows, 0, 0), get(rows, 1, 0)
    keep(rows, 2, 0, a + 2 * b - 1)
    keep(rows, 3, 0, 1 / a * b / 3)
    keep(rows, 4, 0, math.sqrt(abs(a)) - max(b, 0.5))
    keep(rows, 5, 0, math.copysign(2.0, -a))
    keep(rows, 6, 0, either((a < b) & (b >= 0), a, fill_wide(7.0)))
    mantissa, exponent = mantissa_and_exponent(abs(a))
    keep(rows, 7, 0, mantissa)
    keep(rows, 8, 0, exponent)
    return bits_of(a <= 0), bits_of(a > b), bits_of(a == a)


@pytest.fixture
def rows():
    found = np.zeros((9, LANES))
    found[:2] = np.random.default_rng(0).standard_normal((2, LANES)) * 10.0 ** np.arange(-4, 4)
    return found


def test_vectors_calculate_as_numbers_do(rows):
    a, b = rows[:2].copy()
    _arithmetic(rows)
    assert np.allclose(rows[2], a + 2 * b - 1, rtol=1e-15, atol=1e-15)  # a product and a sum may be rounded once
    assert np.allclose(rows[3], b / a / 3, rtol=1e-15)
    assert np.allclose(rows[4], np.sqrt(np.abs(a)) - np.maximum(b, 0.5), rtol=1e-15)
    assert np.array_equal(rows[5], np.copysign(2.0, -a))
    assert np.array_equal(rows[6], np.where((a < b) & (b >= 0), a, 7.0))


def test_a_number_is_its_mantissa_times_two_to_its_exponent(rows):
    a = rows[0].copy()
    _arithmetic(rows)
    assert np.array_equal(rows[7] * 2.0 ** rows[8], np.abs(a))
    assert (rows[7] >= math.sqrt(0.5)).all() and (rows[7] < math.sqrt(2)).all()


def test_comparisons_are_bits_and_false_for_what_is_no_number(rows):
    rows[0, 3] = np.nan
    a, b = rows[:2].copy()
    found = _arithmetic(rows)
    for bits, expected in zip(found, (a <= 0, a > b, a == a), strict=True):
        assert [bool(bits >> lane & 1) for lane in range(LANES)] == expected.tolist()
