"""The warm-up compiles all CPU kernels, and the default model does not import the paper's package."""

import subprocess
import sys

import pytest

_CHECK = """
import sys
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher
from pansplat.cli import warm_up
warm_up.main()
packages = "pansplat.rendering.cpu", "pansplat.sweep", "pansplat.refinement"
modules = [m for name, m in sys.modules.items() if name.startswith(packages)]
kernels = {k for m in modules for k in vars(m).values() if isinstance(k, Dispatcher)}
called_by_kernels = {name for kernel in kernels for name in kernel.py_func.__code__.co_names}
for kernel in kernels:
    if kernel.__name__ not in called_by_kernels and not isinstance(kernel._cache, NullCache):
        assert kernel.signatures, kernel
assert not [name for name in sys.modules if name.startswith("pansplat.model")]
"""


@pytest.mark.slow
def test_the_command_compiles_every_kernel_and_states_the_time_without_the_package_of_the_paper() -> None:
    done = subprocess.run([sys.executable, "-c", _CHECK], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("CPU kernels are compiled")
