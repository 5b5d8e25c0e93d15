"""Numba's private interface is present; without it kernels are compiled more often and give the same results."""

import gc

import numba
import numpy as np
import pytest

from pansplat.system import kernels, numba_api
from pansplat.system.kernels import announce_compilation, inline_kernel, kernel

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
        "what replaces it in pansplat/system/numba_api.py, and state the versions there and in pyproject.toml"
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
    monkeypatch.setattr(kernels, "set_source_stamp", lambda compiled, stamp: False)
    assert numba_api._find(kernel(_add), "_cache._cache_file") is None
