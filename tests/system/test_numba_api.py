"""Numba's private interface is present in the installed version."""

import numba
import pytest

from pansplat.system.kernels import kernel

_OF_NUMBA = (
    *("core.event.register", "core.event.Listener", "core.types.unliteral"),
    "core.codegen.JITCPUCodegen.magic_tuple",
    *(f"core.cpu.CPUTargetOptions.{option}" for option in ("no_cfunc_wrapper", "no_cpython_wrapper", "forceinline")),
    "core.cpu.CPUTargetOptions._nrt",
)
_OF_KERNELS = "_cache._cache_file._source_stamp", "_cache.cache_path", "get_call_template", "py_func"


@pytest.mark.parametrize("path", [*_OF_NUMBA, *_OF_KERNELS])
def test_numba_has_the_private_interface_that_the_kernels_use(path):
    owner = numba if path in _OF_NUMBA else kernel(lambda number: number)
    for name in path.split("."):
        assert hasattr(owner, name), (
            f"numba {numba.__version__} has no {path}: find its substitute in pansplat/system/numba_api.py, and state "
            "the versions there and in pyproject.toml"
        )
        owner = getattr(owner, name)
