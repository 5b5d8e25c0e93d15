"""Numbers in groups of three or four a Gaussian, as arrays hold them, turned into rows of float64 and back.

A row holds one number of each Gaussian of a block.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.cgutils import unpack_tuple

from pansplat.rendering.cpu.runtime import inline_kernel
from pansplat.rendering.cpu.simd import LANES, element, emitted, lanes, load, prefetch, put, store

_FLOATS, _DOUBLES = (ir.VectorType(kind, LANES) for kind in (ir.FloatType(), ir.DoubleType()))
_FOUR = ir.VectorType(ir.FloatType(), 4)
_INT = ir.IntType(32)
_INTS = ir.VectorType(_INT, LANES)
AHEAD = 128  # Gaussians: asked for while those before them are worked on


@emitted
def load_rounded(context, array, index):  # type: ignore[no-untyped-def]
    """Eight elements of a float64 array from `index` on, as float32."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        found = builder.load(_pointer(context, builder, sig, args, _DOUBLES))
        found.align = 8
        return builder.fptrunc(found, _FLOATS)

    return lanes(array, types.intp), generate


@emitted
def store_widened(context, array, index, value):  # type: ignore[no-untyped-def]
    """Write eight elements of a float64 array from `index` on."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        place = _pointer(context, builder, sig, args, _DOUBLES)
        builder.store(builder.fpext(args[2], _DOUBLES), place).align = 8
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


@emitted
def larger(context, sizes, value):  # type: ignore[no-untyped-def]
    """The larger of sizes found so far and a vector's: bits without the sign, so what is no number counts too."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        before, size = builder.bitcast(args[0], _INTS), builder.shl(builder.bitcast(args[1], _INTS), _ints(1))
        found = builder.select(builder.icmp_unsigned(">", before, size), before, size)
        return builder.bitcast(found, _FLOATS)

    return lanes(lanes, lanes), generate


@emitted
def any_reaches(context, sizes, bound):  # type: ignore[no-untyped-def]
    """Whether a size of `larger` reaches a bound, given as twice its bits."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        single = builder.insert_element(ir.Constant(_INTS, ir.Undefined), args[1], _INT(0))
        bounds = builder.shuffle_vector(single, single, _ints(0))
        reached = builder.icmp_unsigned(">=", builder.bitcast(args[0], _INTS), bounds)
        byte = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(reached, byte), byte(0))

    return types.boolean(lanes, types.uint32), generate


@emitted
def load_four(context, array, index):  # type: ignore[no-untyped-def]
    """Four elements of a float32 array from `index` on, and four zeros."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        found = builder.load(_pointer(context, builder, sig, args, _FOUR))
        found.align = 4
        chosen = ir.VectorType(_INT, LANES)([_INT(lane) for lane in range(LANES)])
        return builder.shuffle_vector(found, ir.Constant(_FOUR, None), chosen)

    return lanes(array, types.intp), generate


@emitted
def apart(context, vectors):  # type: ignore[no-untyped-def]
    """Of k vectors that hold eight groups of k numbers: the first of each group, the second, and so on."""
    size = len(vectors)
    places = [[divmod(size * lane + j, LANES) for lane in range(LANES)] for j in range(size)]
    return vectors(vectors), _gather(places)


@emitted
def together(context, vectors):  # type: ignore[no-untyped-def]
    """Undo `apart`."""
    size = len(vectors)
    places = [[divmod(LANES * j + lane, size)[::-1] for lane in range(LANES)] for j in range(size)]
    return vectors(vectors), _gather(places)


def _gather(places: list[list[tuple[int, int]]]) -> Callable[..., Any]:
    """Code for vectors whose lanes are taken from those given: for each lane, from which and from where."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        given = unpack_tuple(builder, args[0])
        made = []
        for row in places:
            sources = sorted({source for source, _ in row})
            found = given[sources[0]]
            chosen = [place if source == sources[0] else 0 for source, place in row]
            for turn, source in enumerate(sources[1:]):
                before = range(LANES) if turn else chosen
                chosen = [
                    LANES + place if whence == source else old for (whence, place), old in zip(row, before, strict=True)
                ]
                mask = ir.VectorType(_INT, LANES)([_INT(lane) for lane in chosen])
                found = builder.shuffle_vector(found, given[source], mask)
            made.append(found)
        return context.make_tuple(builder, sig.return_type, made)

    return generate


def _ints(number: int) -> ir.Constant:
    return _INTS([_INT(number)] * LANES)


def _pointer(context: Any, builder: Any, sig: Any, args: Any, kind: Any) -> Any:
    array = context.make_array(sig.args[0])(context, builder, args[0])
    return builder.bitcast(builder.gep(array.data, [args[1]]), kind.as_pointer())


@inline_kernel
def quarters(numbers, first):
    """Eight groups of four from `first` on: the first of each group, the second, and so on."""
    return apart(
        (
            load(numbers, first),
            load(numbers, first + LANES),
            load(numbers, first + 2 * LANES),
            load(numbers, first + 3 * LANES),
        )
    )


@inline_kernel
def read_ones(numbers, start, count, rows, row, largest):
    """Turn `count` numbers from `start` on into a row; `numbers` is flat. Return the largest sizes, see `larger`."""
    flat, width, whole = rows.reshape(-1), rows.shape[1], count // LANES * LANES
    for at in range(0, whole, LANES):
        x = load(numbers, start + at)
        prefetch(numbers, start + AHEAD + at)
        largest = larger(largest, x)
        store_widened(flat, row * width + at, x)
    _read_rest(numbers, 1, start, whole, count, flat, width, row)
    return largest


@inline_kernel
def read_threes(numbers, start, count, rows, row, largest):
    """Turn groups of three into three rows from `row` on, likewise."""
    flat, width, whole = rows.reshape(-1), rows.shape[1], count // LANES * LANES
    for at in range(0, whole, LANES):
        first, place = 3 * (start + at), row * width + at
        prefetch(numbers, first + 3 * AHEAD)
        prefetch(numbers, first + 3 * AHEAD + 2 * LANES)
        a, b, c = load(numbers, first), load(numbers, first + LANES), load(numbers, first + 2 * LANES)
        largest = larger(larger(larger(largest, a), b), c)
        x, y, z = apart((a, b, c))
        store_widened(flat, place, x)
        store_widened(flat, place + width, y)
        store_widened(flat, place + 2 * width, z)
    _read_rest(numbers, 3, start, whole, count, flat, width, row)
    return largest


@inline_kernel
def read_fours(numbers, start, count, rows, row, largest):
    """Turn groups of four into rows, likewise."""
    flat, width, whole = rows.reshape(-1), rows.shape[1], count // LANES * LANES
    for at in range(0, whole, LANES):
        first, place = 4 * (start + at), row * width + at
        prefetch(numbers, first + 4 * AHEAD)
        prefetch(numbers, first + 4 * AHEAD + 2 * LANES)
        a, b = load(numbers, first), load(numbers, first + LANES)
        c, d = load(numbers, first + 2 * LANES), load(numbers, first + 3 * LANES)
        largest = larger(larger(larger(larger(largest, a), b), c), d)
        w, x, y, z = apart((a, b, c, d))
        store_widened(flat, place, w)
        store_widened(flat, place + width, x)
        store_widened(flat, place + 2 * width, y)
        store_widened(flat, place + 3 * width, z)
    _read_rest(numbers, 4, start, whole, count, flat, width, row)
    return largest


@inline_kernel
def _read_rest(numbers, size, start, whole, count, flat, width, row):
    for i in range(whole, count):
        for j in range(size):
            put(flat, (row + j) * width + i, np.float64(element(numbers, size * (start + i) + j)))


@inline_kernel
def write_ones(rows, row, start, count, numbers):
    """Turn a row into `count` numbers from `start` on, rounded; `numbers` is flat."""
    flat, width, whole = rows.reshape(-1), rows.shape[1], count // LANES * LANES
    for at in range(0, whole, LANES):
        store(numbers, start + at, load_rounded(flat, row * width + at))
    _write_rest(flat, width, row, 1, start, whole, count, numbers)


@inline_kernel
def write_threes(rows, row, start, count, numbers):
    """Turn three rows from `row` on into groups of three, likewise."""
    flat, width, whole = rows.reshape(-1), rows.shape[1], count // LANES * LANES
    for at in range(0, whole, LANES):
        first, place = 3 * (start + at), row * width + at
        x, y, z = together(
            (load_rounded(flat, place), load_rounded(flat, place + width), load_rounded(flat, place + 2 * width))
        )
        store(numbers, first, x)
        store(numbers, first + LANES, y)
        store(numbers, first + 2 * LANES, z)
    _write_rest(flat, width, row, 3, start, whole, count, numbers)


@inline_kernel
def write_fours(rows, row, start, count, numbers):
    """Turn four rows into groups, likewise."""
    flat, width, whole = rows.reshape(-1), rows.shape[1], count // LANES * LANES
    for at in range(0, whole, LANES):
        first, place = 4 * (start + at), row * width + at
        w, x, y, z = together(
            (
                load_rounded(flat, place),
                load_rounded(flat, place + width),
                load_rounded(flat, place + 2 * width),
                load_rounded(flat, place + 3 * width),
            )
        )
        store(numbers, first, w)
        store(numbers, first + LANES, x)
        store(numbers, first + 2 * LANES, y)
        store(numbers, first + 3 * LANES, z)
    _write_rest(flat, width, row, 4, start, whole, count, numbers)


@inline_kernel
def _write_rest(flat, width, row, size, start, whole, count, numbers):
    for i in range(whole, count):
        for j in range(size):
            put(numbers, size * (start + i) + j, np.float32(element(flat, (row + j) * width + i)))
