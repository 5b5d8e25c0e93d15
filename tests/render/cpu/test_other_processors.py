"""What is compiled is not bound to the processor at hand: code for 64-bit ARM can be made of the tile kernels."""

import llvmlite.binding as llvm
import numba as nb
import numpy as np
import pytest

from pansplat.render.cpu import raster, raster_backward
from pansplat.render.cpu.compiling import _OPTIONS
from pansplat.render.cpu.memory import Lease
from pansplat.render.cpu.records import FIELDS

_TRIPLE = "aarch64-unknown-linux-gnu"


def _draw(case):
    sums = np.empty((case.values.shape[1] + 1, *case.size), np.float32)
    kept = raster.room_to_keep(case.starts, lease := Lease())
    drawn = case.records, case.values, case.entries, case.starts
    raster.raster_forward(*drawn, case.plane, sums, kept=kept)
    grads = lease.array((len(case.entries), FIELDS), np.float32), np.empty((len(case.entries), 4), np.float32)
    raster_backward.raster_backward(*drawn, case.slots, case.plane, sums, kept, sums, *grads)


def _assembly(text):
    """The code for a 64-bit ARM of a module that was made for this machine."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    try:
        machine = llvm.Target.from_triple(_TRIPLE).create_target_machine(cpu="neoverse-n1", opt=1)
    except RuntimeError:
        pytest.skip("this LLVM cannot make code for ARM")
    kept = [line for line in text.splitlines() if not line.startswith(("target triple", "target datalayout"))]
    module = llvm.parse_assembly("\n".join(kept))
    module.triple, module.data_layout = _TRIPLE, str(machine.target_data)
    module.verify()
    return machine.emit_assembly(module)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["_draw_tiles", "_walk_tiles"])
def test_tile_kernels_become_vector_code_on_arm(name, make_case):
    _draw(make_case("equirect", (8, 16), 3))
    compiled = {"_draw_tiles": raster._draw_tiles, "_walk_tiles": raster_backward._walk_tiles}[name]
    (signature, *_) = compiled.signatures
    fresh = nb.njit(**_OPTIONS)(compiled.py_func)  # what comes from the disk is code of this machine already
    fresh.compile(signature)
    # Numba's reference counts were given an instruction of this machine when optimised for it; the rest was not.
    lines = fresh.inspect_llvm(signature).replace("@llvm.x86.atomic.sub.cc.i64", "@count_down").splitlines()
    text = "\n".join(line.replace(" immarg", "") if "@count_down" in line else line for line in lines)
    assert "llvm.x86" not in text
    code = _assembly(text)
    # Multiply and add, rounded once, on registers of four float32; and no function called for it.
    assert "fmla\tv" in code
    assert "fmaf" not in code and "exp2" not in code
