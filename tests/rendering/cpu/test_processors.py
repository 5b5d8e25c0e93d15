"""Kernels for other processors are vectorised and give the same images and gradients.

They are compiled in a separate process, since numba reads the processor once.
"""

import dataclasses
import os
import subprocess
import sys

import llvmlite.binding as llvm
import numpy as np
import pytest
import torch
from dense_renderer import make_scene

from pansplat.rendering import rasterize

_HASWELL = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt"}
_X86_64 = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""}
_RASTERIZE = """
import sys
import numpy as np, torch
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize
from pansplat.rendering.cpu import rasterize as forward, rasterize_backward as backward
given = torch.load(sys.argv[1])
means = given["means"].requires_grad_()
image = rasterize(Gaussians(**given), torch.eye(4), size=(40, 80), backend="numba").color
image.square().sum().backward()
kernels = forward._rasterize_tiles, backward._rasterize_tiles_backward
code = [kernel.inspect_llvm(kernel.signatures[0]) for kernel in kernels]
np.savez(sys.argv[2], image=image.detach(), gradient=means.grad, code=code)
"""


def _arm_assembly(code):
    """64-bit ARM assembly of an LLVM module that was made for this machine."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    triple = "aarch64-unknown-linux-gnu"
    try:
        machine = llvm.Target.from_triple(triple).create_target_machine(cpu="neoverse-n1", opt=1)
    except RuntimeError:
        pytest.skip("this LLVM cannot generate code for ARM")
    lines = [line for line in code.splitlines() if not line.startswith(("target triple", "target datalayout"))]
    module = llvm.parse_assembly("\n".join(lines))
    module.triple, module.data_layout = triple, str(machine.target_data)
    module.verify()
    return machine.emit_assembly(module)


@pytest.mark.exhaustive
@pytest.mark.parametrize("processor", [_HASWELL, _X86_64], ids=["haswell", "x86-64"])
def test_code_for_other_processors_is_vectorised_and_gives_the_same_result(processor, tmp_path):
    scene = make_scene(200, scale=0.15).to(dtype=torch.float32)
    fields = {field.name: getattr(scene, field.name) for field in dataclasses.fields(scene)}
    torch.save(fields, tmp_path / "scene.pt")
    files = str(tmp_path / "scene.pt"), str(tmp_path / "result.npz")
    environment = {**os.environ, **processor, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", _RASTERIZE, *files], env=environment, check=True)
    result, truth = np.load(files[1]), scene.to(dtype=torch.float64)
    truth.means.requires_grad_()
    expected = rasterize(truth, torch.eye(4), size=(40, 80), backend="torch").color
    expected.square().sum().backward()
    np.testing.assert_allclose(result["image"], expected.detach().numpy(), rtol=0, atol=2e-6)
    gradient = truth.means.grad.numpy()
    assert np.linalg.norm(result["gradient"] - gradient) <= 1e-5 * np.linalg.norm(gradient)
    for code in result["code"].tolist():
        # Only numba's reference counting uses an instruction of this machine.
        lines = code.replace("@llvm.x86.atomic.sub.cc.i64", "@count_down").splitlines()
        code = "\n".join(line.replace(" immarg", "") if "@count_down" in line else line for line in lines)
        assert "llvm.x86" not in code
        assembly = _arm_assembly(code)
        assert "fmla\tv" in assembly  # fused multiply-add on vectors of four float32
        assert "fmaf" not in assembly and "exp2" not in assembly  # no function calls
