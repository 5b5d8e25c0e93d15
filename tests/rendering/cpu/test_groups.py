"""Groups of three and four numbers turned into rows and back."""

import numpy as np
import pytest

from pansplat.rendering.cpu.groups import (
    any_reaches,
    read_fours,
    read_ones,
    read_threes,
    write_fours,
    write_ones,
    write_threes,
)
from pansplat.rendering.cpu.runtime import kernel
from pansplat.rendering.cpu.simd import fill

_LANES = 16
_BOUND = np.uint32(2 * int(np.float32(1e30).view(np.uint32)))


@kernel
def _read(ones, threes, fours, start, count, rows, bound):
    sizes = read_ones(ones, start, count, rows, 0, fill(np.float32(0)))
    sizes = read_threes(threes, start, count, rows, 1, sizes)
    return any_reaches(read_fours(fours, start, count, rows, 4, sizes), bound)


@kernel
def _write(rows, start, count, ones, threes, fours):
    write_ones(rows, 0, start, count, ones)
    write_threes(rows, 1, start, count, threes)
    write_fours(rows, 4, start, count, fours)


def _groups(seed=0):
    rng = np.random.default_rng(seed)
    return [rng.standard_normal((30, size)).astype(np.float32) for size in (1, 3, 4)]


@pytest.mark.parametrize("count", [1, 7, 8, 9, 16])
def test_rows_are_the_groups_transposed_and_turn_back_into_them(count):
    groups = _groups()
    rows = np.full((8, _LANES), np.nan)
    assert not _read(*(group.reshape(-1) for group in groups), 5, count, rows, _BOUND)
    assert np.array_equal(rows[:, :count], np.concatenate(groups, axis=1)[5 : 5 + count].T)
    assert np.isnan(rows[:, count:]).all()

    written = [np.full_like(group, -9) for group in groups]
    _write(rows, 3, count, *(group.reshape(-1) for group in written))
    for group, copy in zip(groups, written, strict=True):
        assert np.array_equal(copy[3 : 3 + count], group[5 : 5 + count])
        assert (copy[:3] == -9).all() and (copy[3 + count :] == -9).all()


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e30, -2e30])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_number_that_is_none_or_absurdly_large_is_noticed_wherever_it_stands(number, which):
    for place in range(8):
        groups = _groups()
        groups[which][5 + place, -1] = number
        assert _read(*(group.reshape(-1) for group in groups), 5, 8, np.zeros((8, _LANES)), _BOUND)
