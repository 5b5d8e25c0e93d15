"""The places of the bits set in a word, as a list of bytes, inside numba kernels."""

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.cgutils import get_or_insert_function

from pansplat.rendering.cpu.simd import emitted, pointer_to

_BYTE = ir.IntType(8)
_INT = ir.IntType(32)


@emitted
def list_bits(context, array, index, bits, base):  # type: ignore[no-untyped-def]
    """Write down the places of the bits set of an unsigned 64-bit number, plus `base`, as bytes from `index` on.

    64 bytes may be written over.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        (_, _, bits, base), pointer = args, pointer_to(context, builder, sig, args)
        base = builder.trunc(base, _BYTE)
        if "+avx512vbmi2" in context.codegen().magic_tuple()[2].split(","):
            _pack_bits(builder, pointer, bits, base)
        else:
            _walk_bits(builder, pointer, bits, base)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.uint64, types.intp), generate


def _pack_bits(builder: Any, pointer: Any, bits: Any, base: Any) -> None:
    """List bits by the one instruction that some processors have for it."""
    many, flags = ir.VectorType(_BYTE, 64), ir.VectorType(ir.IntType(1), 64)
    undefined = ir.Constant(many, ir.Undefined)
    bases = builder.insert_element(undefined, base, _INT(0))
    bases = builder.shuffle_vector(bases, bases, ir.VectorType(_INT, 64)([_INT(0)] * 64))
    places = builder.add(many([_BYTE(place) for place in range(64)]), bases)
    kind = ir.FunctionType(many, [many, many, flags])
    function = get_or_insert_function(builder.module, kind, "llvm.x86.avx512.mask.compress.v64i8")
    found = builder.call(function, [places, undefined, builder.bitcast(bits, flags)])
    builder.store(found, builder.bitcast(pointer, many.as_pointer())).align = 1


def _walk_bits(builder: Any, pointer: Any, bits: Any, base: Any) -> None:
    """List bits one by one."""
    before, one = builder.block, bits.type(1)
    look, take, after = (builder.append_basic_block(name) for name in ("look", "take", "after"))
    builder.branch(look)
    builder.position_at_end(look)
    left, to = builder.phi(bits.type), builder.phi(pointer.type)
    builder.cbranch(builder.icmp_unsigned("!=", left, bits.type(0)), take, after)
    builder.position_at_end(take)
    place = builder.trunc(builder.cttz(left, ir.IntType(1)(1)), _BYTE)
    builder.store(builder.add(place, base), to)
    left.add_incoming(bits, before)
    left.add_incoming(builder.and_(left, builder.sub(left, one)), take)
    to.add_incoming(pointer, before)
    to.add_incoming(builder.gep(to, [_INT(1)]), take)
    builder.branch(look)
    builder.position_at_end(after)
