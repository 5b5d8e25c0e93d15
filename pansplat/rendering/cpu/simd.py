"""SIMD vectors of eight float32 or float64 inside numba kernels, and transposes between arrays and vectors.

They exist in compiled code only. `+ - * /`, unary minus, comparisons, `min` and `max` work on vectors, `&` on masks;
`abs`, `math.sqrt` and `math.copysign` work on `f64x8`. One operand of an `f64x8` may be a float64, so a formula for
numbers also works on vectors. Loops that LLVM vectorises by itself check whether their arrays overlap and write every
intermediate value to memory; these vectors stay in registers.

LLVM maps an `f32x8` to one AVX register, or to two of SSE or NEON. On processors that execute 512-bit operations in two
halves, eight lanes are as fast as sixteen, and fewer of them lie outside a footprint.

Arrays are C-contiguous. `array` and `numbers` are flat; `rows` is 2-D.
"""

import inspect
import math
import operator
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from llvmlite import ir
from numba.extending import intrinsic, lower_builtin, models, register_model

from pansplat.rendering.cpu.records import RECORD_SIZE
from pansplat.system.kernels import inline_kernel
from pansplat.system.numba_api import (
    ConcreteTemplate,
    get_or_insert_function,
    infer_global,
    processor_features,
    signature,
    types,
)

LANES = 8

_BYTE, _INT, _LONG, _FLOAT, _DOUBLE = ir.IntType(8), ir.IntType(32), ir.IntType(64), ir.FloatType(), ir.DoubleType()
_BYTES, _INTS, _LONGS, _FLOATS, _DOUBLES, _BITS = (
    ir.VectorType(kind, LANES) for kind in (_BYTE, _INT, _LONG, _FLOAT, _DOUBLE, ir.IntType(1))
)
_FOUR_FLOATS = ir.VectorType(_FLOAT, 4)
_ELEMENT = object()  # stands for the type of an array's elements
_VECTOR_TYPES = {"f32x8": _FLOATS, "f64x8": _DOUBLES, "mask": _BITS}
_ALIGNMENT = {_FLOATS: 4, _FOUR_FLOATS: 4, _DOUBLES: 8, _BYTES: 1}  # bytes; alignment of each type's elements
_F64_FLAGS = ("contract", "nsz")  # the options of fastmath in system/kernels.py

# 2^x on [-1/2, 1/2]: least maximum relative error (9.2e-8) among polynomials of degree 5 that are 1 at 0.
_EXP2 = (1.0, 0.6931470036506653, 0.24022242426872253, 0.05550733581185341, 0.009671512991189957, 0.001326472731307149)
_ROUND_F32 = 1.5 * 2.0**23  # added to a number, it gives the nearest integer in the low bits
_ROUND_F64 = 1.5 * 2.0**52
_ROUND_F64_BITS = 0x4338000000000000
_ROOT_HALF_BITS = 0x3FE6A09E667F3BCD  # bits of sqrt(1/2)


class _Vector(types.Type):
    """A SIMD vector, named as in `_VECTOR_TYPES`."""


f32x8, f64x8, mask = (_Vector(name) for name in _VECTOR_TYPES)


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR_TYPES[kind.name])


def _register(symbol: Any, emit: Callable[..., Any], *cases: Any) -> None:
    """Make numba apply an operator to vectors; a float64 operand is broadcast."""
    infer_global(symbol)(type(symbol.__name__, (ConcreteTemplate,), {"cases": list(cases)}))

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        operands = (
            _splat(builder, value, _DOUBLES) if kind == types.float64 else value
            for value, kind in zip(args, sig.args, strict=True)
        )
        return emit(builder, *operands)

    for case in cases:
        lower_builtin(symbol, *case.args)(generate)


def _f64_cases(result: Any) -> list[Any]:
    return [signature(result, *pair) for pair in ((f64x8, f64x8), (f64x8, types.float64), (types.float64, f64x8))]


def _compare(relation: str, builder: ir.IRBuilder, a: Any, b: Any) -> Any:
    return builder.fcmp_ordered(relation, a, b)


def _select_if(relation: str, builder: ir.IRBuilder, a: Any, b: Any) -> Any:
    """`a` where the relation holds, else `b`; `b` if one of them is NaN."""
    return builder.select(builder.fcmp_ordered(relation, a, b), a, b)


def _call_f64(name: str, builder: ir.IRBuilder, *args: Any) -> Any:
    kind = ir.FunctionType(_DOUBLES, [_DOUBLES] * len(args))
    return builder.call(get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f64"), args)


_ARITHMETIC = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
_RELATIONS = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=", operator.eq: "=="}
for _symbol, _name in _ARITHMETIC.items():
    _emit = getattr(ir.IRBuilder, _name)
    _register(_symbol, _emit, signature(f32x8, f32x8, f32x8))
    _register(_symbol, partial(_emit, flags=_F64_FLAGS), *_f64_cases(f64x8))
for _symbol, _relation in _RELATIONS.items():
    _register(_symbol, partial(_compare, _relation), signature(mask, f32x8, f32x8), *_f64_cases(mask))
for _symbol, _relation in ((min, "<"), (max, ">")):
    _register(_symbol, partial(_select_if, _relation), signature(f32x8, f32x8, f32x8), *_f64_cases(f64x8))
_register(operator.neg, ir.IRBuilder.fneg, signature(f32x8, f32x8), signature(f64x8, f64x8))
_register(operator.and_, ir.IRBuilder.and_, signature(mask, mask, mask))
_register(abs, partial(_call_f64, "fabs"), signature(f64x8, f64x8))
_register(math.sqrt, partial(_call_f64, "sqrt"), signature(f64x8, f64x8))
_register(math.copysign, partial(_call_f64, "copysign"), *_f64_cases(f64x8))


def llvm_intrinsic(function: Callable[..., Any]) -> Any:
    """Make a function that types its arguments and emits LLVM code callable in kernels."""
    return intrinsic(inspect.unwrap(function))  # the tests' annotation checks wrap every function


def _with_signature(function: Callable[..., Any], emit: Callable[..., Any], *parameters: str) -> Any:
    """An intrinsic with the name of `emit` and these parameters, by which numba binds arguments."""
    function = inspect.unwrap(function)
    function.__name__, function.__doc__ = emit.__name__, emit.__doc__
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    named = [inspect.Parameter(name, kind) for name in ("context", *parameters)]
    function.__signature__ = inspect.Signature(named)
    return llvm_intrinsic(function)


def _result(context: Any, builder: Any, kind: Any, emitted: Any) -> Any:
    """An emitted value in the form that numba expects of an intrinsic."""
    if kind == types.void:
        return context.get_dummy_value()
    return context.make_tuple(builder, kind, emitted) if isinstance(kind, types.UniTuple) else emitted


def _operation(result: Any, *operands: Any) -> Callable[..., Any]:
    """Make `emit(builder, *values)` callable in kernels, for values of these types."""

    def decorate(emit: Callable[..., Any]) -> Any:
        emit = inspect.unwrap(emit)

        def typed(context, *args):
            def generate(context, builder, sig, args):
                return _result(context, builder, result, emit(builder, *args))

            return result(*operands), generate

        return _with_signature(typed, emit, *(f"operand{i}" for i in range(len(operands))))

    return decorate


def _access(result: Any, *operands: Any) -> Callable[..., Any]:
    """Make `emit(builder, pointer, *values)` callable in kernels, with an array and an index for the pointer.

    Args:
        result, operands: types, or `_ELEMENT` for that of the array's elements.
    """

    def decorate(emit: Callable[..., Any]) -> Any:
        emit = inspect.unwrap(emit)

        def typed(context, array, index, *args):
            returned, *values = (array.dtype if kind is _ELEMENT else kind for kind in (result, *operands))

            def generate(context, builder, sig, args):
                array, index, *values = args
                pointer = _pointer(context, builder, sig.args[0], array, index)
                return _result(context, builder, returned, emit(builder, pointer, *values))

            return returned(array, types.intp, *values), generate

        return _with_signature(typed, emit, "array", "index", *(f"value{i}" for i in range(len(operands))))

    return decorate


# --- load, store, prefetch, broadcast ---
#
# A pointer is given as an array and an index: `load(array, index)`.


@_access(f32x8)
def load(builder, pointer):
    """Eight elements of a float32 array from `index` on."""
    return _load(builder, pointer, _FLOATS)


@_access(f32x8)
def load_four(builder, pointer):
    """Four elements of a float32 array from `index` on, and four zeros."""
    four = _load(builder, pointer, _FOUR_FLOATS)
    return _shuffle(builder, four, ir.Constant(_FOUR_FLOATS, None), range(LANES))


@_access(f32x8)
def load_broadcast(builder, pointer):
    """Element `index` of a float32 array in every lane."""
    return _splat(builder, builder.load(pointer), _FLOATS)


@_access(_ELEMENT)
def load_scalar(builder, pointer):
    """One element, without the check of `array[index]` for a negative index."""
    return builder.load(pointer)


@_access(types.void, f32x8)
def store(builder, pointer, value):
    """Write eight elements of a float32 array from `index` on."""
    _store(builder, value, pointer)


@_access(types.void, f32x8)
def store_nontemporal(builder, pointer, value):
    """Write eight elements that are not read soon; their address must be a multiple of 32 bytes."""
    stored = _store(builder, value, pointer)
    stored.align = 4 * LANES
    stored.set_metadata("nontemporal", builder.module.add_metadata([_INT(1)]))


@_access(types.void, mask)
def store_mask(builder, pointer, condition):
    """Write the lanes of a mask as bytes from `index` on."""
    _store(builder, builder.zext(condition, _BYTES), pointer)


@_access(types.void, _ELEMENT)
def store_scalar(builder, pointer, value):
    """Write one element, without a check of the index."""
    builder.store(value, pointer)


@_access(types.void)
def prefetch(builder, pointer):
    """Prefetch the cache line of element `index` for a read."""
    _prefetch(builder, pointer, is_write=0, locality=2)


@_access(types.void)
def prefetch_for_write(builder, pointer):
    """Prefetch the cache line of element `index` for a write."""
    _prefetch(builder, pointer, is_write=1, locality=3)


@llvm_intrinsic
def load_row(context, rows, row, column):
    """Eight elements of a row of a float64 array, from a column on."""

    def generate(context, builder, sig, args):
        return _load(builder, _row_pointer(context, builder, sig.args[0], *args), _DOUBLES)

    return f64x8(rows, types.intp, types.intp), generate


@llvm_intrinsic
def store_row(context, rows, row, column, value):
    """Write eight elements of a row of a float64 array, from a column on."""

    def generate(context, builder, sig, args):
        *place, value = args
        _store(builder, value, _row_pointer(context, builder, sig.args[0], *place))
        return context.get_dummy_value()

    return types.void(rows, types.intp, types.intp, f64x8), generate


@llvm_intrinsic
def copy_four(context, target, target_index, source, source_index):
    """Copy four float32 from one array to another."""

    def generate(context, builder, sig, args):
        target, source = (_pointer(context, builder, sig.args[i], args[i], args[i + 1]) for i in (0, 2))
        _store(builder, _load(builder, source, _FOUR_FLOATS), target)
        return context.get_dummy_value()

    return types.void(target, types.intp, source, types.intp), generate


@llvm_intrinsic
def broadcast(context, number):
    """A number in every lane: an `f32x8` of a float32, else an `f64x8`."""
    single, vector = (types.float32, f32x8) if number == types.float32 else (types.float64, f64x8)
    return vector(single), lambda context, builder, sig, args: _splat(builder, args[0], _VECTOR_TYPES[vector.name])


# --- arithmetic, masks, bits ---


@_operation(f64x8, f32x8)
def to_f64(builder, value):
    """Eight float32 as float64."""
    return builder.fpext(value, _DOUBLES)


@_operation(f32x8, f64x8)
def to_f32(builder, value):
    """Eight float64 rounded to float32."""
    return builder.fptrunc(value, _FLOATS)


@_operation(f32x8, f32x8, f32x8, f32x8)
def multiply_add(builder, a, b, c):
    """a b + c, rounded once if the processor has such an instruction."""
    return _multiply_add(builder, a, b, c)


@_operation(f32x8, f32x8)
def exp2(builder, value):
    """2^value within 2e-7 relative, for -126 <= value <= 127; undefined elsewhere."""
    shifted = builder.fadd(value, _constant(_FLOATS, _ROUND_F32))
    fraction = builder.fsub(value, builder.fsub(shifted, _constant(_FLOATS, _ROUND_F32)))
    power = _constant(_FLOATS, _EXP2[-1])
    for coefficient in reversed(_EXP2[:-1]):
        power = _multiply_add(builder, power, fraction, _constant(_FLOATS, coefficient))
    exponent = builder.shl(builder.bitcast(shifted, _INTS), _constant(_INTS, 23))
    return builder.bitcast(builder.add(builder.bitcast(power, _INTS), exponent), _FLOATS)


@_operation(types.UniTuple(f64x8, 2), f64x8)
def mantissa_and_exponent(builder, value):
    """m in [sqrt 1/2, sqrt 2) and a whole number e with value = m 2^e; the value is above 0 and not subnormal."""
    bits = builder.bitcast(value, _LONGS)
    exponent = builder.ashr(builder.sub(bits, _constant(_LONGS, _ROOT_HALF_BITS)), _constant(_LONGS, 52))
    mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, _constant(_LONGS, 52))), _DOUBLES)
    shifted = builder.bitcast(builder.add(exponent, _constant(_LONGS, _ROUND_F64_BITS)), _DOUBLES)
    return mantissa, builder.fsub(shifted, _constant(_DOUBLES, _ROUND_F64))


@llvm_intrinsic
def select(context, condition, if_true, if_false):
    """`if_true` in the lanes where the condition holds, `if_false` in the others."""
    return if_true(mask, if_true, if_true), lambda context, builder, sig, args: builder.select(*args)


@_operation(types.boolean, mask)
def any_lane(builder, condition):
    """Whether any lane of a mask is true."""
    return _any(builder, condition)


@_operation(types.intp, types.uint64)
def popcount(builder, bits):
    """Number of set bits of an unsigned 64-bit number."""
    return builder.ctpop(bits)


@llvm_intrinsic
def list_set_bits(context, array, index, bits, base):
    """Write the positions of an unsigned 64-bit number's set bits, plus `base`, as bytes from `index` on.

    Up to 64 bytes are overwritten.
    """

    def generate(context, builder, sig, args):
        array, index, bits, base = args
        has_compress = "+avx512vbmi2" in processor_features(context)
        emit = _compress_positions if has_compress else _loop_over_set_bits
        emit(builder, _pointer(context, builder, sig.args[0], array, index), bits, builder.trunc(base, _BYTE))
        return context.get_dummy_value()

    return types.void(array, types.intp, types.uint64, types.intp), generate


# --- movement between lanes ---


@_operation(f32x8, *[f32x8] * LANES)
def lane_sums(builder, *rows):
    """The sums over the lanes of eight vectors, in order."""
    half = LANES // 2
    while half:
        # Pair row i with row i + half; add the two halves of every group of `2 * half` lanes.
        pairs = zip(rows[:half], rows[half:], strict=True)
        rows = [builder.fadd(*_halves(builder, low, high, half)) for low, high in pairs]
        half //= 2
    return rows[0]


@_operation(types.UniTuple(f32x8, LANES), *[f32x8] * LANES)
def transpose(builder, *rows):
    """The columns of the 8 x 8 matrix whose rows are these vectors."""
    half = LANES // 2
    while half:
        swapped = list(rows)
        for row in range(LANES):
            if not row & half:
                swapped[row], swapped[row + half] = _halves(builder, rows[row], rows[row + half], half)
        rows, half = swapped, half // 2
    return rows


# --- arrays of structures to structures of arrays, and back ---


@inline_kernel
def load_transposed(numbers, r0, r1, r2, r3, r4, r5, r6, r7):
    """The columns of eight rows of eight float32, given the index of each row's first number."""
    return transpose(
        load(numbers, r0), load(numbers, r1), load(numbers, r2), load(numbers, r3),
        load(numbers, r4), load(numbers, r5), load(numbers, r6), load(numbers, r7),
    )  # fmt: skip


@inline_kernel
def records_to_soa(records, start, count, soa, width):
    """Turn `count` records into rows of `width` float32, one per field; past `count` the last record is repeated.

    Args:
        records, soa: flat.
        start: the first record.
        count: at most `width`.
    """
    last = start + count - 1
    for i in range(0, count, LANES):
        g = start + i
        r0, r1 = RECORD_SIZE * g, RECORD_SIZE * min(g + 1, last)
        r2, r3 = RECORD_SIZE * min(g + 2, last), RECORD_SIZE * min(g + 3, last)
        r4, r5 = RECORD_SIZE * min(g + 4, last), RECORD_SIZE * min(g + 5, last)
        r6, r7 = RECORD_SIZE * min(g + 6, last), RECORD_SIZE * min(g + 7, last)
        for half in range(0, RECORD_SIZE, LANES):
            columns = load_transposed(
                records, r0 + half, r1 + half, r2 + half, r3 + half, r4 + half, r5 + half, r6 + half, r7 + half
            )
            for field in range(LANES):
                store(soa, (half + field) * width + i, columns[field])


@inline_kernel
def soa_to_records(soa, width, start, count, records):
    """Turn rows of `width` float32, one per field, into `count` records from `start` on.

    Args:
        soa, records: flat.
        count: at most `width`.
    """
    whole = count // LANES * LANES
    for i in range(0, whole, LANES):
        for half in range(0, RECORD_SIZE, LANES):
            r = half * width + i
            columns = load_transposed(
                soa, r, r + width, r + 2 * width, r + 3 * width, r + 4 * width, r + 5 * width, r + 6 * width,
                r + 7 * width,
            )  # fmt: skip
            for lane in range(LANES):
                store_nontemporal(records, RECORD_SIZE * (start + i + lane) + half, columns[lane])
    for i in range(whole, count):
        for field in range(RECORD_SIZE):
            records[RECORD_SIZE * (start + i) + field] = soa[field * width + i]


# --- LLVM code shared by several operations ---


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


def _row_pointer(context: Any, builder: Any, kind: Any, rows: Any, row: Any, column: Any) -> Any:
    array = context.make_array(kind)(context, builder, rows)
    width = builder.extract_value(array.shape, 1)
    return builder.gep(array.data, [builder.add(builder.mul(row, width), column)])


def _load(builder: Any, pointer: Any, kind: Any) -> Any:
    loaded = builder.load(builder.bitcast(pointer, kind.as_pointer()))
    loaded.align = _ALIGNMENT[kind]
    return loaded


def _store(builder: Any, value: Any, pointer: Any) -> Any:
    stored = builder.store(value, builder.bitcast(pointer, value.type.as_pointer()))
    stored.align = _ALIGNMENT[value.type]
    return stored


def _prefetch(builder: Any, pointer: Any, *, is_write: int, locality: int) -> None:
    pointer = builder.bitcast(pointer, _BYTE.as_pointer())
    kind = ir.FunctionType(ir.VoidType(), [pointer.type, _INT, _INT, _INT])
    function = get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    builder.call(function, [pointer, _INT(is_write), _INT(locality), _INT(1)])


def _constant(kind: Any, number: float) -> ir.Constant:
    return kind([kind.element(number)] * kind.count)


def _splat(builder: Any, number: Any, kind: Any) -> Any:
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), number, _INT(0))
    return _shuffle(builder, single, single, [0] * kind.count)


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    # Not llvm.fma: without such an instruction it calls a function for every lane.
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
    return builder.call(get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{LANES}f32"), [a, b, c])


def _any(builder: Any, bits: Any) -> Any:
    number = ir.IntType(LANES)
    return builder.icmp_unsigned("!=", builder.bitcast(bits, number), number(0))


def _halves(builder: Any, low: Any, high: Any, half: int) -> tuple[Any, Any]:
    """The first halves of each group of `2 * half` lanes of `low` and of `high`, and the second halves."""
    first = [lane if not lane & half else LANES + lane - half for lane in range(LANES)]
    return _shuffle(builder, low, high, first), _shuffle(builder, low, high, [lane + half for lane in first])


def _shuffle(builder: Any, low: Any, high: Any, chosen: Iterable[int]) -> Any:
    lanes = [_INT(lane) for lane in chosen]
    return builder.shuffle_vector(low, high, ir.VectorType(_INT, len(lanes))(lanes))


def _compress_positions(builder: Any, pointer: Any, bits: Any, base: Any) -> None:
    """List set bits by AVX-512's compress instruction."""
    kind, flags = ir.VectorType(_BYTE, 64), ir.VectorType(ir.IntType(1), 64)
    positions = builder.add(kind([_BYTE(position) for position in range(64)]), _splat(builder, base, kind))
    function = get_or_insert_function(
        builder.module, ir.FunctionType(kind, [kind, kind, flags]), "llvm.x86.avx512.mask.compress.v64i8"
    )
    undefined = ir.Constant(kind, ir.Undefined)
    found = builder.call(function, [positions, undefined, builder.bitcast(bits, flags)])
    builder.store(found, builder.bitcast(pointer, kind.as_pointer())).align = 1


def _loop_over_set_bits(builder: Any, pointer: Any, bits: Any, base: Any) -> None:
    """List set bits one by one."""
    before, one = builder.block, bits.type(1)
    test, body, after = (builder.append_basic_block(name) for name in ("test", "body", "after"))
    builder.branch(test)
    builder.position_at_end(test)
    left, to = builder.phi(bits.type), builder.phi(pointer.type)
    builder.cbranch(builder.icmp_unsigned("!=", left, bits.type(0)), body, after)
    builder.position_at_end(body)
    position = builder.trunc(builder.cttz(left, ir.IntType(1)(1)), _BYTE)
    builder.store(builder.add(position, base), to)
    left.add_incoming(bits, before)
    left.add_incoming(builder.and_(left, builder.sub(left, one)), body)
    to.add_incoming(pointer, before)
    to.add_incoming(builder.gep(to, [_INT(1)]), body)
    builder.branch(test)
    builder.position_at_end(after)
