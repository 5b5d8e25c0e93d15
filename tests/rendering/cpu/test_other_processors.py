"""What is compiled is not bound to the processor at hand: code for 64-bit ARM can be made of the tile kernels."""

import os
import subprocess
import sys

import llvmlite.binding as llvm
import pytest

_TRIPLE = "aarch64-unknown-linux-gnu"
# An older processor's code is made, and by a process of its own: what this one has compiled may use an instruction for
# lists of bits that only the newest have.
_OLDER = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt"}
_CHILD = """
import importlib, sys
import numba
from pansplat.rendering.cpu import beside
from pansplat.rendering.cpu.compiling import _OPTIONS
(task,) = (task for task in beside.theirs(gradients=True) if task.name == sys.argv[1])
kernel = getattr(importlib.import_module(f"pansplat.rendering.cpu.{task.module}"), task.name)
fresh = numba.njit(**_OPTIONS)(kernel.py_func)  # what comes from the disk is code of a machine already
fresh.compile(task.arguments)
print(fresh.inspect_llvm(fresh.signatures[0]))
"""


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
def test_tile_kernels_become_vector_code_on_arm(name):
    command = [sys.executable, "-c", _CHILD, name]
    found = subprocess.run(command, env={**os.environ, **_OLDER}, check=True, capture_output=True, text=True).stdout
    # Numba's reference counts were given an instruction of this machine when optimised for it; the rest was not.
    lines = found.replace("@llvm.x86.atomic.sub.cc.i64", "@count_down").splitlines()
    text = "\n".join(line.replace(" immarg", "") if "@count_down" in line else line for line in lines)
    assert "llvm.x86" not in text
    code = _assembly(text)
    # Multiply and add, rounded once, on registers of four float32; and no function called for it.
    assert "fmla\tv" in code
    assert "fmaf" not in code and "exp2" not in code
