"""Vectors of eight float64 inside numba kernels, for arithmetic on eight Gaussians at once.

Only inside compiled code: `+ - * /`, comparisons, `abs`, `max`, `math.sqrt` and `math.copysign` work on them, and on
them and numbers, so a formula written for numbers serves for vectors too. Loops that LLVM turns into vectors by itself
ask each time whether their arrays overlap, and go back to memory after each step.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.cgutils import alloca_once, get_or_insert_function
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

from pansplat.rendering.cpu.simd import LANES, emitted, lanes, mask

_DOUBLE, _INT, _LONG = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _DOUBLES, _LONGS = (ir.VectorType(kind, LANES) for kind in (ir.FloatType(), _DOUBLE, _LONG))
_FLAGS = ("contract", "nsz")  # as in compiling.py
_LINE = 64  # bytes
_NEAREST = 1.5 * 2.0**52  # added to a small whole number, it leaves it in the low bits
_NEAREST_BITS = 0x4338000000000000
_ROOT_HALF_BITS = 0x3FE6A09E667F3BCD


class _Wide(types.Type):
    """Eight float64."""


wide = _Wide("wide")


@register_model(_Wide)
class _WideModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _DOUBLES)


def _register(symbol: Any, result: Any, emit: Callable[[ir.IRBuilder, Any, Any], Any]) -> None:
    """Teach numba an operator on two vectors, or on a vector and a number."""
    pairs = (wide, wide), (wide, types.float64), (types.float64, wide)
    cases = [signature(result, *pair) for pair in pairs]
    infer_global(symbol)(type(symbol.__name__, (ConcreteTemplate,), {"cases": cases}))

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vectors = (a if kind is wide else _splat(builder, a) for a, kind in zip(args, sig.args, strict=True))
        return emit(builder, *vectors)

    for pair in pairs:
        lower_builtin(symbol, *pair)(generate)


def _register_alone(symbol: Any, emit: Callable[[ir.IRBuilder, Any], Any]) -> None:
    infer_global(symbol)(type(symbol.__name__, (ConcreteTemplate,), {"cases": [signature(wide, wide)]}))
    lower_builtin(symbol, wide)(lambda context, builder, sig, args: emit(builder, *args))


def _call(builder: ir.IRBuilder, name: str, *args: Any) -> Any:
    kind = ir.FunctionType(_DOUBLES, [_DOUBLES] * len(args))
    return builder.call(get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f64"), args)


_register(operator.add, wide, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
_register(operator.sub, wide, lambda builder, a, b: builder.fsub(a, b, flags=_FLAGS))
_register(operator.mul, wide, lambda builder, a, b: builder.fmul(a, b, flags=_FLAGS))
_register(operator.truediv, wide, lambda builder, a, b: builder.fdiv(a, b, flags=_FLAGS))
_register(max, wide, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
_register(math.copysign, wide, lambda builder, a, b: _call(builder, "copysign", a, b))
_register(operator.lt, mask, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_register(operator.le, mask, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_register(operator.gt, mask, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_register(operator.ge, mask, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_register(operator.eq, mask, lambda builder, a, b: builder.fcmp_ordered("==", a, b))
_register_alone(operator.neg, lambda builder, a: builder.fneg(a))
_register_alone(abs, lambda builder, a: _call(builder, "fabs", a))
_register_alone(math.sqrt, lambda builder, a: _call(builder, "sqrt", a))


@emitted
def align_stack(context):  # type: ignore[no-untyped-def]
    """At the start of a kernel: let vectors that find no register lie within cache lines, not across them."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        # LLVM aligns the stack only for what is there before it chooses registers: a vector that seems to be used.
        place = alloca_once(builder, _DOUBLES)
        place.align = _LINE
        kind = ir.FunctionType(ir.VoidType(), [place.type])
        builder.asm(kind, "", "r,~{memory}", [place], side_effect=True)
        return context.get_dummy_value()

    return types.void(), generate


@emitted
def get(context, rows, row, column):  # type: ignore[no-untyped-def]
    """Eight elements of a row of a float64 array, from a column on."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        found = builder.load(_place(context, builder, sig, args))
        found.align = 8
        return found

    return wide(rows, types.intp, types.intp), generate


@emitted
def keep(context, rows, row, column, value):  # type: ignore[no-untyped-def]
    """Write eight elements of a row of a float64 array, from a column on."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[3], _place(context, builder, sig, args)).align = 8
        return context.get_dummy_value()

    return types.void(rows, types.intp, types.intp, wide), generate


@emitted
def widened(context, value):  # type: ignore[no-untyped-def]
    """Eight float32 as float64."""
    return wide(lanes), lambda context, builder, sig, args: builder.fpext(args[0], _DOUBLES)


@emitted
def rounded(context, value):  # type: ignore[no-untyped-def]
    """Eight float64 rounded to float32."""
    return lanes(wide), lambda context, builder, sig, args: builder.fptrunc(args[0], _FLOATS)


@emitted
def fill_wide(context, number):  # type: ignore[no-untyped-def]
    """A number in every lane."""
    return wide(types.float64), lambda context, builder, sig, args: _splat(builder, args[0])


@emitted
def either(context, condition, yes, no):  # type: ignore[no-untyped-def]
    """`yes` where the condition holds, elsewhere `no`."""
    return wide(mask, wide, wide), lambda context, builder, sig, args: builder.select(*args)


@emitted
def bits_of(context, condition):  # type: ignore[no-untyped-def]
    """Eight truth values as the lowest bits of a number."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _LONG)

    return types.uint64(mask), generate


@emitted
def store_mask(context, array, index, condition):  # type: ignore[no-untyped-def]
    """Write eight truth values as bytes from `index` on."""
    bytes_ = ir.VectorType(ir.IntType(8), LANES)

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.bitcast(builder.gep(data, [args[1]]), bytes_.as_pointer())
        builder.store(builder.zext(args[2], bytes_), place).align = 1
        return context.get_dummy_value()

    return types.void(array, types.intp, mask), generate


@emitted
def mantissa_and_exponent(context, value):  # type: ignore[no-untyped-def]
    """m in [sqrt 1/2, sqrt 2) and a whole number e so that the value, above 0 and not subnormal, is m 2^e."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(args[0], _LONGS)
        exponent = builder.ashr(builder.sub(bits, _longs(_ROOT_HALF_BITS)), _longs(52))
        mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, _longs(52))), _DOUBLES)
        shifted = builder.bitcast(builder.add(exponent, _longs(_NEAREST_BITS)), _DOUBLES)
        number = builder.fsub(shifted, _DOUBLES([_DOUBLE(_NEAREST)] * LANES))
        return context.make_tuple(builder, sig.return_type, (mantissa, number))

    return types.UniTuple(wide, 2)(wide), generate


def _place(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    array = context.make_array(sig.args[0])(context, builder, args[0])
    width = builder.extract_value(array.shape, 1)
    index = builder.add(builder.mul(args[1], width), args[2])
    return builder.bitcast(builder.gep(array.data, [index]), _DOUBLES.as_pointer())


def _longs(number: int) -> ir.Constant:
    return _LONGS([_LONG(number)] * LANES)


def _splat(builder: Any, number: Any) -> Any:
    single = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), number, _INT(0))
    zeros = ir.Constant(ir.VectorType(_INT, LANES), None)
    return builder.shuffle_vector(single, single, zeros)
