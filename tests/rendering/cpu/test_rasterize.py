"""Sums over an image equal the dense sums in float64, on this processor and on others."""

import os
import subprocess
import sys

import llvmlite.binding as llvm
import numpy as np
import pytest

from pansplat.rendering.cpu.rasterize import rasterize_forward


def _rasterize(case, *, threads=1):
    sums = np.full((case.values.shape[1] + 1, *case.size), np.nan, np.float32)
    rasterize_forward(case.records, case.values, case.intersections, case.starts, case.tables, sums, threads=threads)
    return sums


def _compare(case):
    expected = case.dense()[0].numpy()
    assert expected[-1].max() > 0.1
    np.testing.assert_allclose(_rasterize(case), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind", ["equirect", "pinhole"])
@pytest.mark.parametrize("size", [(32, 64), (1, 1), (2, 3), (33, 31), (5, 100)])
def test_images_equal_the_dense_sums(kind, size, make_case):
    _compare(make_case(kind, size, 150))


@pytest.mark.parametrize("num_values", [1, 2, 5, 9])
def test_any_number_of_values_is_summed(num_values, make_case):
    _compare(make_case("pinhole", (24, 40), 150, num_values=num_values))


def test_several_chunks_are_composited_in_order(make_case):
    _compare(make_case("equirect", (32, 64), 700))


def test_a_gaussian_that_needs_three_components_equals_the_dense_sums(one_too_wide):
    _compare(one_too_wide)


def test_only_blocks_that_the_box_reaches_are_composited(make_case):
    case = make_case("pinhole", (32, 32), 1).flatten()
    case.intersections[:, 1] = 9 | 13 << 8 | 5 << 16 | 6 << 24
    expected = np.zeros((32, 32), bool)
    expected[4:8, 8:16] = True  # blocks are 4 pixels wide and 2 high
    assert np.array_equal(_rasterize(case)[-1] > 0, expected)


def test_a_footprint_is_not_mirrored_behind_the_camera(make_case):
    case = make_case("equirect", (32, 64), 1)
    # A wide footprint towards +z. The same cone opens towards -z, where only L is negative.
    case.records[0] = (0, 0, 1, 0, 0, 0, 5, 0, 0, 0, 5, 0, 0, 0, 0, -0.1)
    alpha = _rasterize(case)[-1]
    assert alpha[:, 16:48].max() > 0.8
    assert not alpha[:, :16].any() and not alpha[:, 48:].any()


def test_weights_of_many_gaussians_sum_to_one(make_case):
    case = make_case("pinhole", (8, 8), 20_000, opacity=(0.02, 1.5)).flatten()
    case.values[:] = 0.7
    sums = _rasterize(case)
    np.testing.assert_allclose(sums[:-1], 0.7, atol=2e-6)
    np.testing.assert_allclose(sums[-1], 1, atol=1e-6)


# Kernels for other processors are compiled in a separate process, since numba reads the processor once.

_HASWELL = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt"}
_X86_64 = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""}
_RASTERIZE = """
import sys
import numpy as np
from pansplat.rendering.cpu import rasterize, rasterize_backward
from pansplat.rendering.cpu.records import PixelTables
from pansplat.rendering.cpu.runtime import Workspace
case = np.load(sys.argv[1])
tables = PixelTables(int(case["kind"]), case["columns"], case["rows"], case["rotation"])
scene = [case[name] for name in ("records", "values", "intersections", "starts")]
sums = np.zeros_like(case["grad_sums"])
workspace = Workspace()
saved = rasterize.allocate_saved(case["starts"], workspace)
rasterize.rasterize_forward(*scene, tables, sums, saved=saved)
grads = workspace.array((len(scene[2]), 16), np.float32), np.empty((len(scene[2]), 4), np.float32)
rasterize_backward.rasterize_backward(*scene, case["slots"], tables, sums, saved, case["grad_sums"], *grads)
kernels = rasterize._rasterize_tiles, rasterize_backward._rasterize_tiles_backward
code = [kernel.inspect_llvm(kernel.signatures[0]) for kernel in kernels]
np.savez(sys.argv[2], sums=sums, records=grads[0], values=grads[1], code=code)
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
def test_code_for_other_processors_is_vectorised_and_gives_the_same_result(processor, make_case, tmp_path):
    case = make_case("equirect", (40, 80), 200)
    upstream = np.random.default_rng(5).standard_normal((5, 40, 80)).astype(np.float32)
    names = "records", "values", "intersections", "starts", "slots"
    arrays = {name: getattr(case, name) for name in names} | case.tables._asdict()
    np.savez(tmp_path / "case.npz", **arrays, grad_sums=upstream)
    environment = {**os.environ, **processor, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    files = str(tmp_path / "case.npz"), str(tmp_path / "result.npz")
    subprocess.run([sys.executable, "-c", _RASTERIZE, *files], env=environment, check=True)
    result = np.load(files[1])
    sums, grad_records, grad_values = case.dense(upstream)
    np.testing.assert_allclose(result["sums"], sums.numpy(), rtol=0, atol=2e-6)
    for expected, slots in ((grad_records, result["records"]), (grad_values, result["values"])):
        error = case.reduce(slots) - expected.numpy()
        assert np.linalg.norm(error) <= 1e-5 * np.linalg.norm(expected)
    for code in result["code"].tolist():
        # Only numba's reference counting uses an instruction of this machine.
        lines = code.replace("@llvm.x86.atomic.sub.cc.i64", "@count_down").splitlines()
        code = "\n".join(line.replace(" immarg", "") if "@count_down" in line else line for line in lines)
        assert "llvm.x86" not in code
        assembly = _arm_assembly(code)
        assert "fmla\tv" in assembly  # fused multiply-add on vectors of four float32
        assert "fmaf" not in assembly and "exp2" not in assembly  # no function calls
