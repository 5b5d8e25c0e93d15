"""Records turned into columns and back."""

import numpy as np
import pytest

from pansplat.rendering.cpu.columns import read_columns, write_columns
from pansplat.rendering.cpu.records import RECORD_SIZE
from pansplat.rendering.cpu.runtime import kernel

_LANES = 16


@kernel
def _read(records, start, count, columns):
    read_columns(records, start, count, columns, _LANES)


@kernel
def _write(columns, start, count, records):
    write_columns(columns, _LANES, start, count, records)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 16])
def test_columns_are_the_records_transposed_and_the_last_one_fills_up(count, workspace):
    records = np.random.default_rng(0).standard_normal((30, RECORD_SIZE)).astype(np.float32)
    columns = np.full((RECORD_SIZE, _LANES), np.nan, np.float32)
    _read(records.reshape(-1), 5, count, columns.reshape(-1))
    filled = -(-count // 8) * 8
    expected = records[5 + np.minimum(np.arange(filled), count - 1)].T
    assert np.array_equal(columns[:, :filled], expected) and np.isnan(columns[:, filled:]).all()

    written = workspace.array((30, RECORD_SIZE), np.float32)
    written[:] = -1
    _write(columns.reshape(-1), 8, count, written.reshape(-1))
    assert np.array_equal(written[8 : 8 + count], records[5 : 5 + count])
    assert (written[:8] == -1).all() and (written[8 + count :] == -1).all()
