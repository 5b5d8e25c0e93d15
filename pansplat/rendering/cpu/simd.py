"""Vectors of eight float32 inside numba kernels: what a register holds, and the operations on it.

LLVM maps them to one AVX register, or to two of SSE or NEON. On processors that pass 512 bits in two halves eight
lanes are as fast as sixteen and fit a Gaussian's outline better.

Only inside compiled code: `+ - * /` and `<= > &` work on `lanes` and masks, the functions below do the rest.
Arrays are float32 and C-contiguous, indexed flat.
"""

import inspect
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.cgutils import get_or_insert_function
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 8

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_FLOATS = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT, LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_ALIGN = 4  # bytes: what float32 arrays promise

# 2^x on [-1/2, 1/2]: least largest relative error (9.2e-8) among polynomials of degree 5 that are 1 at 0.
_EXP2 = (1.0, 0.6931470036506653, 0.24022242426872253, 0.05550733581185341, 0.009671512991189957, 0.001326472731307149)
_ROUND = 1.5 * 2.0**23  # added, it leaves the nearest integer in the low bits


class _Lanes(types.Type):
    """Eight float32."""


class _Mask(types.Type):
    """Eight truth values."""


lanes = _Lanes("lanes")
mask = _Mask("mask")


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _FLOATS)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BITS)


def _register(symbol: Any, result: Any, operand: Any, emit: Callable[[ir.IRBuilder, Any, Any], Any]) -> None:
    """Teach numba an operator on two vectors."""
    infer_global(symbol)(type(symbol.__name__, (ConcreteTemplate,), {"cases": [signature(result, operand, operand)]}))
    lower_builtin(symbol, operand, operand)(lambda context, builder, sig, args: emit(builder, *args))


_register(operator.add, lanes, lanes, ir.IRBuilder.fadd)
_register(operator.sub, lanes, lanes, ir.IRBuilder.fsub)
_register(operator.mul, lanes, lanes, ir.IRBuilder.fmul)
_register(operator.truediv, lanes, lanes, ir.IRBuilder.fdiv)
_register(operator.le, mask, lanes, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_register(operator.gt, mask, lanes, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_register(operator.and_, mask, mask, ir.IRBuilder.and_)


def emitted(function: Callable[..., Any]) -> Any:
    """Have numba call a function that emits LLVM's code itself."""
    # The tests' check of annotations wraps every function; numba needs the bare one.
    return intrinsic(inspect.unwrap(function))


@emitted
def load(context, array, index):  # type: ignore[no-untyped-def]
    """Eight elements from `index` on."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        value = builder.load(_vector_pointer(context, builder, sig, args))
        value.align = _ALIGN
        return value

    return lanes(array, types.intp), generate


@emitted
def store(context, array, index, value):  # type: ignore[no-untyped-def]
    """Write eight elements from `index` on."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[2], _vector_pointer(context, builder, sig, args)).align = _ALIGN
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


@emitted
def store_past_cache(context, array, index, value):  # type: ignore[no-untyped-def]
    """Write eight elements that nobody reads soon; their place must be a multiple of 32 bytes."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        written = builder.store(args[2], _vector_pointer(context, builder, sig, args))
        written.align = 4 * LANES
        written.set_metadata("nontemporal", builder.module.add_metadata([_INT(1)]))
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


@emitted
def spread(context, array, index):  # type: ignore[no-untyped-def]
    """Element `index` in every lane."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _splat(builder, builder.load(pointer_to(context, builder, sig, args)))

    return lanes(array, types.intp), generate


@emitted
def fill(context, number):  # type: ignore[no-untyped-def]
    """A number in every lane."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _splat(builder, args[0])

    return lanes(types.float32), generate


@emitted
def multiply_add(context, a, b, c):  # type: ignore[no-untyped-def]
    """A b + c, rounded once where the processor can."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _multiply_add(builder, *args)

    return lanes(lanes, lanes, lanes), generate


@emitted
def negative(context, value):  # type: ignore[no-untyped-def]
    """The value with its sign turned."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.fneg(args[0])

    return lanes(lanes), generate


@emitted
def choose(context, condition, yes, no):  # type: ignore[no-untyped-def]
    """`yes` where the condition holds, elsewhere `no`."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.select(*args)

    return lanes(mask, lanes, lanes), generate


@emitted
def minimum(context, a, b):  # type: ignore[no-untyped-def]
    """The smaller of two, `b` where `a` is not a number."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return lanes(lanes, lanes), generate


@emitted
def maximum(context, a, b):  # type: ignore[no-untyped-def]
    """The larger of two, `b` where `a` is not a number."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return lanes(lanes, lanes), generate


@emitted
def some(context, condition):  # type: ignore[no-untyped-def]
    """Whether any lane is true."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        byte = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], byte), byte(0))

    return types.boolean(mask), generate


@emitted
def exp2(context, value):  # type: ignore[no-untyped-def]
    """2^value within 2e-7 relative, for -126 <= value <= 127; anything elsewhere."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        shifted = builder.fadd(args[0], _constant(_ROUND))
        rest = builder.fsub(args[0], builder.fsub(shifted, _constant(_ROUND)))
        power = _constant(_EXP2[-1])
        for coefficient in reversed(_EXP2[:-1]):
            power = _multiply_add(builder, power, rest, _constant(coefficient))
        exponent = builder.shl(builder.bitcast(shifted, _INTS), _INTS([_INT(23)] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, _INTS), exponent), _FLOATS)

    return lanes(lanes), generate


@emitted
def totals(context, a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    """The sums of the lanes of eight vectors, in order."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        rows, half = list(args), LANES // 2
        while half:
            # Pair row i with row i + half; fold the two halves of every group of 2 half lanes.
            pairs = zip(rows[:half], rows[half:], strict=True)
            rows = [builder.fadd(*_halves(builder, low, high, half)) for low, high in pairs]
            half //= 2
        return rows[0]

    return lanes(*[lanes] * LANES), generate


@emitted
def first_lane(context, value):  # type: ignore[no-untyped-def]
    """The first of eight numbers."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.extract_element(args[0], _INT(0))

    return types.float32(lanes), generate


@emitted
def transposed(context, a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    """Eight vectors as the rows of a square, turned into its columns."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        rows, half = list(args), LANES // 2
        while half:
            turned = list(rows)
            for row in range(LANES):
                if not row & half:
                    turned[row], turned[row + half] = _halves(builder, rows[row], rows[row + half], half)
            rows, half = turned, half // 2
        return context.make_tuple(builder, sig.return_type, rows)

    return types.UniTuple(lanes, LANES)(*[lanes] * LANES), generate


@emitted
def side_by_side(context, a, b):  # type: ignore[no-untyped-def]
    """Two vectors of two rows of four each, as two rows of eight; and back, for it is its own inverse."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return context.make_tuple(builder, sig.return_type, _halves(builder, *args, LANES // 2))

    return types.UniTuple(lanes, 2)(lanes, lanes), generate


@emitted
def how_many(context, bits):  # type: ignore[no-untyped-def]
    """How many bits of an unsigned 64-bit number are set."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.ctpop(args[0])

    return types.intp(types.uint64), generate


@emitted
def element(context, array, index):  # type: ignore[no-untyped-def]
    """One element; unlike array[index] it does not ask whether the index counts from the end."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load(pointer_to(context, builder, sig, args))

    return array.dtype(array, types.intp), generate


@emitted
def put(context, array, index, value):  # type: ignore[no-untyped-def]
    """Write one element, likewise."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[2], pointer_to(context, builder, sig, args))
        return context.get_dummy_value()

    return types.void(array, types.intp, array.dtype), generate


@emitted
def copy_four(context, target, at, source, index):  # type: ignore[no-untyped-def]
    """Copy four float32 from `index` of one array on to `at` of another."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        four = ir.VectorType(_FLOAT, 4).as_pointer()
        places = [
            builder.gep(context.make_array(sig.args[i])(context, builder, args[i]).data, [args[i + 1]]) for i in (0, 2)
        ]
        found = builder.load(builder.bitcast(places[1], four))
        found.align = _ALIGN
        builder.store(found, builder.bitcast(places[0], four)).align = _ALIGN
        return context.get_dummy_value()

    return types.void(target, types.intp, source, types.intp), generate


@emitted
def prefetch(context, array, index):  # type: ignore[no-untyped-def]
    """Ask for the cache line of element `index`, to be read."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _prefetch(context, builder, sig, args, 0)

    return types.void(array, types.intp), generate


@emitted
def prefetch_to_write(context, array, index):  # type: ignore[no-untyped-def]
    """Ask for the cache line of element `index`, to be written."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _prefetch(context, builder, sig, args, 1)

    return types.void(array, types.intp), generate


def _prefetch(context: Any, builder: Any, sig: Any, args: Any, writes: int) -> Any:
    pointer = builder.bitcast(pointer_to(context, builder, sig, args), ir.IntType(8).as_pointer())
    kind = ir.FunctionType(ir.VoidType(), [pointer.type, _INT, _INT, _INT])
    function = get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    builder.call(function, [pointer, _INT(writes), _INT(3 if writes else 2), _INT(1)])
    return context.get_dummy_value()


def pointer_to(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Where element `args[1]` of the array `args[0]` is."""
    array = context.make_array(sig.args[0])(context, builder, args[0])
    return builder.gep(array.data, [args[1]])


def _vector_pointer(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.bitcast(pointer_to(context, builder, sig, args), _FLOATS.as_pointer())


def _constant(number: float) -> ir.Constant:
    return _FLOATS([_FLOAT(number)] * LANES)


def _splat(builder: Any, number: Any) -> Any:
    single = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), number, _INT(0))
    return _shuffle(builder, single, single, [0] * LANES)


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    # Not llvm.fma, which calls a function for every lane where the processor has no such instruction.
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
    return builder.call(get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{LANES}f32"), [a, b, c])


def _halves(builder: Any, low: Any, high: Any, half: int) -> tuple[Any, Any]:
    """First halves of each group of 2 half lanes of `low` and of `high`, then the second halves."""
    first = [lane if not lane & half else LANES + lane - half for lane in range(LANES)]
    return _shuffle(builder, low, high, first), _shuffle(builder, low, high, [lane + half for lane in first])


def _shuffle(builder: Any, low: Any, high: Any, chosen: list[int]) -> Any:
    return builder.shuffle_vector(low, high, _INTS([_INT(lane) for lane in chosen]))
