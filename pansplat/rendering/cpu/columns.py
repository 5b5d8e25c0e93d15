"""Rows of eight numbers turned into columns and back: one Gaussian a row in memory, one number a row in arithmetic."""

from pansplat.rendering.cpu.records import RECORD_SIZE
from pansplat.rendering.cpu.runtime import inline_kernel
from pansplat.rendering.cpu.simd import LANES, load, store, store_past_cache, transposed


@inline_kernel
def columns_of(numbers, r0, r1, r2, r3, r4, r5, r6, r7):  # type: ignore[no-untyped-def]
    """The columns of eight rows of eight numbers, given where the rows begin."""
    return transposed(
        load(numbers, r0),
        load(numbers, r1),
        load(numbers, r2),
        load(numbers, r3),
        load(numbers, r4),
        load(numbers, r5),
        load(numbers, r6),
        load(numbers, r7),
    )


@inline_kernel
def read_columns(records, start, count, columns, lanes):  # type: ignore[no-untyped-def]
    """Turn `count` records into rows of `lanes` numbers, one a field; past `count` the last is repeated.

    Args:
        records, columns: flat.
        start: the first record.
        count: at most `lanes`.
    """
    last = start + count - 1
    for at in range(0, count, LANES):
        g = start + at
        r0, r1 = RECORD_SIZE * g, RECORD_SIZE * min(g + 1, last)
        r2, r3 = RECORD_SIZE * min(g + 2, last), RECORD_SIZE * min(g + 3, last)
        r4, r5 = RECORD_SIZE * min(g + 4, last), RECORD_SIZE * min(g + 5, last)
        r6, r7 = RECORD_SIZE * min(g + 6, last), RECORD_SIZE * min(g + 7, last)
        for half in range(0, RECORD_SIZE, LANES):
            found = columns_of(
                records, r0 + half, r1 + half, r2 + half, r3 + half, r4 + half, r5 + half, r6 + half, r7 + half
            )
            for field in range(LANES):
                store(columns, (half + field) * lanes + at, found[field])


@inline_kernel
def write_columns(columns, lanes, start, count, records):  # type: ignore[no-untyped-def]
    """Turn rows of `lanes` numbers, one a field, into `count` records from `start` on.

    Args:
        columns, records: flat.
        count: at most `lanes`.
    """
    whole = count // LANES * LANES
    for at in range(0, whole, LANES):
        first = columns_of(
            columns, at, at + lanes, at + 2 * lanes, at + 3 * lanes, at + 4 * lanes, at + 5 * lanes, at + 6 * lanes,
            at + 7 * lanes,
        )  # fmt: skip
        c = 8 * lanes + at
        second = columns_of(
            columns, c, c + lanes, c + 2 * lanes, c + 3 * lanes, c + 4 * lanes, c + 5 * lanes, c + 6 * lanes,
            c + 7 * lanes,
        )  # fmt: skip
        for place in range(LANES):
            row = RECORD_SIZE * (start + at + place)
            store_past_cache(records, row, first[place])
            store_past_cache(records, row + LANES, second[place])
    for at in range(whole, count):
        for field in range(RECORD_SIZE):
            records[RECORD_SIZE * (start + at) + field] = columns[field * lanes + at]
