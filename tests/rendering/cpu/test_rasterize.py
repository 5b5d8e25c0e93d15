"""TODO."""

import dataclasses
import os
import pickle
import subprocess
import sys

import llvmlite.binding as llvm
import numpy as np
import pytest
import torch

import pansplat
from pansplat.rendering.cpu import rasterize, rasterize_backward
from pansplat.rendering.cpu.rasterize import rasterize_forward
from pansplat.rendering.cpu.records import TILE_SIZE

# What is compiled is not bound to the processor at hand: code for 64-bit ARM can be made of the tile kernels.


def _draw(case, *, threads=1):
    sums = np.full((case.values.shape[1] + 1, *case.size), np.nan, np.float32)
    rasterize_forward(case.records, case.values, case.intersections, case.starts, case.tables, sums, threads=threads)
    return sums


@pytest.mark.parametrize("kind", ["equirect", "pinhole", "ewa"])
@pytest.mark.parametrize("size", [(32, 64), (1, 1), (2, 3), (33, 31), (5, 100)])
def test_pictures_are_the_dense_sums(kind, size, make_case):
    case = make_case(kind, size, 150)
    expected = case.dense()[0].numpy()
    assert expected[-1].max() > 0.1
    np.testing.assert_allclose(_draw(case), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("num_values", [1, 2, 5, 9])
def test_any_number_of_values_is_summed(num_values, make_case):
    case = make_case("pinhole", (24, 40), 150, num_values=num_values)
    np.testing.assert_allclose(_draw(case), case.dense()[0].numpy(), rtol=0, atol=2e-6)


def test_more_gaussians_than_a_chunk_are_drawn_in_order(make_case):
    case = make_case("equirect", (32, 64), 700)
    np.testing.assert_allclose(_draw(case), case.dense()[0].numpy(), rtol=0, atol=2e-6)


@pytest.mark.parametrize("threads", [2, 3, 5])
def test_any_number_of_threads_draws_the_same_bits(threads, make_case):
    case = make_case("equirect", (96, 192), 60)
    assert np.array_equal(_draw(case), _draw(case, threads=threads))


def test_a_band_is_its_part_of_the_picture(make_case):
    case = make_case("pinhole", (100, 60), 60)
    whole, across = _draw(case), case.tables.tiles[1]
    band = np.zeros_like(whole)
    starts = np.ascontiguousarray(case.starts[across : 3 * across + 1])
    rasterize_forward(case.records, case.values, case.intersections, starts, case.tables, band, first_row=1)
    inside = slice(TILE_SIZE, 3 * TILE_SIZE)
    assert np.array_equal(band[:, inside], whole[:, inside])
    assert not band[:, :TILE_SIZE].any() and not band[:, 3 * TILE_SIZE :].any()


def test_no_entries_leave_an_empty_picture(make_case):
    case = make_case("equirect", (32, 64), 0)
    assert np.array_equal(_draw(case), np.zeros((5, 32, 64)))


def test_only_blocks_that_touch_the_box_are_drawn(make_case):
    case = make_case("ewa", (32, 32), 1)
    case.records[0, 6:12] = 1e-3 * np.array((1, 0, 0, 0, 1, 0))  # covers the tile
    case.intersections[:, 1] = 9 | 13 << 8 | 5 << 16 | 6 << 24
    drawn = _draw(case)[-1] > 0
    expected = np.zeros((32, 32), bool)
    expected[4:8, 8:16] = True  # blocks are four wide and two high
    assert np.array_equal(drawn, expected)


def test_nothing_is_drawn_behind_the_camera(make_case):
    case = make_case("equirect", (32, 64), 1)
    # Towards z, and as wide as a hand: the same cone opens backwards, where only L is negative.
    case.records[0] = (0, 0, 1, 0, 0, 0, 5, 0, 0, 0, 5, 0, 0, 0, 0, -0.1)
    alpha = _draw(case)[-1]
    assert alpha[:, 16:48].max() > 0.8
    assert not alpha[:, :16].any() and not alpha[:, 48:].any()


def test_weights_and_what_passes_sum_to_one_however_many_overlap(make_case):
    case = make_case("ewa", (8, 8), 20_000, opacity=(0.02, 1.5))
    case.records[:, 6:12] = 1e-3 * np.array((1, 0, 0, 0, 1, 0))
    case.values[:] = 0.7
    sums = _draw(case)
    np.testing.assert_allclose(sums[:-1], 0.7, atol=2e-6)
    np.testing.assert_allclose(sums[-1], 1, atol=1e-6)


def test_one_gaussian_too_wide_for_two_components_is_drawn_like_the_others(one_too_wide):
    np.testing.assert_allclose(_draw(one_too_wide), one_too_wide.dense()[0].numpy(), rtol=0, atol=2e-6)


_CHILD = """
import sys
import numpy as np
from pansplat.rendering.cpu.runtime import Workspace
from pansplat.rendering.cpu.rasterize import rasterize_forward, allocate_saved
from pansplat.rendering.cpu.rasterize_backward import rasterize_backward
from pansplat.rendering.cpu.records import PixelTables
given = np.load(sys.argv[1])
plane = PixelTables(int(given["kind"]), given["columns"], given["rows"], given["rotation"])
drawn = [given[name] for name in ("records", "values", "intersections", "starts")]
sums = np.zeros_like(given["grad_sums"])
workspace = Workspace()
kept = allocate_saved(given["starts"], workspace)
rasterize_forward(*drawn, plane, sums, saved=kept)
grads = workspace.array((len(drawn[2]), 16), np.float32), np.empty((len(drawn[2]), 4), np.float32)
rasterize_backward(*drawn, given["slots"], plane, sums, kept, given["grad_sums"], *grads)
np.savez(sys.argv[2], sums=sums, records=grads[0], values=grads[1])
"""


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["haswell", "x86-64"])
def test_processors_with_narrower_vectors_draw_the_same(processor, make_case, tmp_path):
    case = make_case("equirect", (40, 80), 200)
    upstream = np.random.default_rng(5).standard_normal((5, 40, 80)).astype(np.float32)
    plane = case.tables._asdict()
    drawn = {"records": case.records, "values": case.values, "intersections": case.intersections, "starts": case.starts}
    np.savez(tmp_path / "case.npz", **plane, **drawn, slots=case.slots, grad_sums=upstream)
    features = "" if processor != "haswell" else "+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt"
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": processor,
        "NUMBA_CPU_FEATURES": features,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }
    files = tmp_path / "case.npz", tmp_path / "drawn.npz"
    subprocess.run([sys.executable, "-c", _CHILD, *map(str, files)], env=environment, check=True)
    drawn = np.load(files[1])
    sums, by_records, by_values = case.dense(upstream)
    np.testing.assert_allclose(drawn["sums"], sums.numpy(), rtol=0, atol=2e-6)
    for expected, slots in ((by_records, drawn["records"]), (by_values, drawn["values"])):
        error = case.reduce(slots) - expected.numpy()
        assert np.linalg.norm(error) <= 1e-5 * np.linalg.norm(expected)


_TRIPLE = "aarch64-unknown-linux-gnu"
# An older processor's code is made, and by a process of its own: what this one has compiled may use an instruction for
# lists of bits that only the newest have.
_OLDER = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt"}
_EMIT_LLVM = """
import importlib, pickle, sys
import numba
from pansplat.rendering.cpu.runtime import _OPTIONS
module, name, signature = pickle.load(sys.stdin.buffer)
function = getattr(importlib.import_module(module), name).py_func
fresh = numba.njit(**_OPTIONS)(function)  # code from the cache has been compiled for this machine
fresh.compile(signature)
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
@pytest.mark.parametrize("tile_kernel", [rasterize._rasterize_tiles, rasterize_backward._rasterize_tiles_backward])
def test_tile_kernels_become_vector_code_on_arm(tile_kernel, make_scene, pose):
    scene = make_scene(2, scale=0.1)
    scene = dataclasses.replace(scene, means=scene.means.float().requires_grad_())
    pansplat.rasterize(scene.to(dtype=torch.float32), pose, size=(8, 16), backend="numba").color.sum().backward()
    given = pickle.dumps((tile_kernel.py_func.__module__, tile_kernel.__name__, tile_kernel.signatures[0]))
    environment = {**os.environ, **_OLDER}
    command = [sys.executable, "-c", _EMIT_LLVM]
    found = subprocess.run(command, env=environment, check=True, capture_output=True, input=given).stdout.decode()
    # Numba's reference counts were given an instruction of this machine when optimised for it; the rest was not.
    lines = found.replace("@llvm.x86.atomic.sub.cc.i64", "@count_down").splitlines()
    text = "\n".join(line.replace(" immarg", "") if "@count_down" in line else line for line in lines)
    assert "llvm.x86" not in text
    code = _assembly(text)
    # Multiply and add, rounded once, on registers of four float32; and no function called for it.
    assert "fmla\tv" in code
    assert "fmaf" not in code and "exp2" not in code
