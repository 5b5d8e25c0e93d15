"""After the warm-up, no command has to compile a kernel."""

import subprocess
import sys

_CHECK = """
import sys
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher
from pansplat import warm_up
warm_up.main()
for module in [m for name, m in sys.modules.items() if name.startswith(("pansplat.rendering.cpu", "pansplat.sweep"))]:
    for kernel in vars(module).values():
        if isinstance(kernel, Dispatcher) and not isinstance(kernel._cache, NullCache):
            assert kernel.signatures, f"{module.__name__}.{kernel.__name__}"
"""


def test_warm_up_compiles_every_cached_kernel_of_the_rasteriser_and_the_sweep() -> None:
    done = subprocess.run([sys.executable, "-c", _CHECK], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("CPU kernels are compiled")
