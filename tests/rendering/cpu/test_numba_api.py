"""Numba's private interface is present; without it kernels are compiled more often and give the same results."""

import gc
import subprocess
import sys

import numba
import numpy as np
import pytest

from pansplat.rendering.cpu import numba_api, runtime
from pansplat.rendering.cpu.runtime import announce_compilation, inline_kernel, kernel

_OF_NUMBA = (
    "core.event.install_listener",
    "core.event.Listener",
    "core.types.unliteral",
    "core.codegen.JITCPUCodegen.magic_tuple",
    *(f"core.cpu.CPUTargetOptions.{option}" for option in numba_api._OPTIONS),
)
_OF_KERNELS = ("_cache._cache_file._source_stamp", "get_call_template", "py_func")


def test_numba_has_the_private_interface_that_the_kernels_use():
    cached = kernel(_add)
    missing = [f"numba.{path}" for path in _OF_NUMBA if numba_api._find(numba, path) is None]
    missing += [f"{type(cached).__name__}.{path}" for path in _OF_KERNELS if numba_api._find(cached, path) is None]
    assert not missing, (
        f"numba {numba.__version__} has no {', '.join(missing)}: the CPU kernels are slower to start without; find "
        "what replaces it in pansplat/rendering/cpu/numba_api.py, and state the versions there"
    )


def _add(numbers, step):
    for i in range(len(numbers)):
        numbers[i] += step * step
    return numbers.sum()


@pytest.mark.parametrize("hidden", [path.rpartition(".")[2] for path in (*_OF_NUMBA, *_OF_KERNELS)])
def test_without_a_private_name_kernels_give_the_same_results(hidden, tmp_path, monkeypatch):
    find = numba_api._find
    hide = lambda owner, path: None if path.rpartition(".")[2] == hidden else find(owner, path)  # noqa: E731
    monkeypatch.setattr(numba_api, "_find", hide)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    add = inline_kernel(_add)

    def run(numbers):
        return add(numbers, 3) + numbers[0]

    with announce_compilation():
        assert kernel(run)(np.arange(4.0)) == 51.0
    assert gc.isenabled()


def test_a_kernel_that_cannot_be_stamped_is_not_cached(monkeypatch):
    assert numba_api._find(kernel(_add), "_cache._cache_file") is not None
    monkeypatch.setattr(runtime, "set_source_stamp", lambda compiled, stamp: False)
    assert numba_api._find(kernel(_add), "_cache._cache_file") is None


_RASTERIZE = """
import sys, torch
from pansplat.rendering.cpu import numba_api
if sys.argv[1] == "hidden":
    numba_api._find = lambda owner, path: None
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize
torch.manual_seed(0)
scene = Gaussians(
    torch.randn(99, 3, requires_grad=True), torch.full((99, 3), 0.1), torch.randn(99, 4), torch.rand(99),
    torch.randn(99, 4, 3), torch.zeros(99, dtype=torch.int64), torch.zeros(99, dtype=torch.int64),
)
image = rasterize(scene, torch.eye(4), size=(40, 80), backend="numba")
image.color.square().sum().backward()
print(image.color.tolist(), scene.means.grad.tolist())
"""


@pytest.mark.exhaustive
def test_without_the_private_interface_the_rasteriser_gives_the_same_bits():
    run = [sys.executable, "-c", _RASTERIZE]
    results = [subprocess.run([*run, way], capture_output=True, text=True, check=True) for way in ("all", "hidden")]
    assert results[0].stdout == results[1].stdout and len(results[0].stdout) > 10_000
