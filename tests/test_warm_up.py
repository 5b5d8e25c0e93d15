"""The warm-up compiles all CPU kernels."""

import subprocess
import sys

import pytest

_CHECK = """
import sys
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher
from pansplat import warm_up
for name in warm_up.STEPS:
    warm_up.compile_kernels(name)
modules = [m for name, m in sys.modules.items() if name.startswith(("pansplat.rendering.cpu", "pansplat.sweep"))]
kernels = {k for m in modules for k in vars(m).values() if isinstance(k, Dispatcher)}
called_by_kernels = {name for kernel in kernels for name in kernel.py_func.__code__.co_names}
for kernel in kernels:
    if kernel.__name__ not in called_by_kernels and not isinstance(kernel._cache, NullCache):
        assert kernel.signatures, kernel
"""


@pytest.mark.slow
def test_warm_up_compiles_every_kernel_of_the_rasteriser_and_the_sweep() -> None:
    done = subprocess.run([sys.executable, "-c", _CHECK], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_command_compiles_all_groups_and_states_the_time() -> None:
    done = subprocess.run([sys.executable, "-m", "pansplat.warm_up"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("CPU kernels are compiled")
