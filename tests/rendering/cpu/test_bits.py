import numba
import numpy as np
import pytest
from numba.core import types

from pansplat.rendering.cpu import bits
from pansplat.rendering.cpu.simd import emitted, pointer_to


@emitted
def _list_one_by_one(context, array, index, word, base):  # type: ignore[no-untyped-def]
    """What `list_bits` does on processors without an instruction for it."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        pointer = pointer_to(context, builder, sig, args)
        bits._walk_bits(builder, pointer, args[2], builder.trunc(args[3], bits._BYTE))
        return context.get_dummy_value()

    return types.void(array, types.intp, types.uint64, types.intp), generate


@numba.njit
def _at_once(out, word):
    bits.list_bits(out, 3, word, 128)


@numba.njit
def _one_by_one(out, word):
    _list_one_by_one(out, 3, word, 128)


@pytest.mark.parametrize("listed", [_at_once, _one_by_one])
@pytest.mark.parametrize("places", [[], [0], [63], [3, 5, 62], list(range(64))])
def test_the_places_of_all_bits_are_listed_in_order(listed, places):
    out = np.full(80, 255, np.uint8)
    listed(out, np.uint64(sum(1 << place for place in places)))
    assert out[3 : 3 + len(places)].tolist() == [128 + place for place in places]
    assert (out[:3] == 255).all() and (out[67:] == 255).all()
