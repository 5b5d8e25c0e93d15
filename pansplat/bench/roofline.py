"""What the machine could do at most, measured, and how much of it a picture asks for.

The peaks are reached by small kernels of vector code: independent chains of fused multiply-adds that never leave the
registers, and the triad a = b + s c over arrays far larger than the caches (24 bytes would move with the line that
is read before it is written; 12 are counted, as STREAM does).
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import llvmlite.ir as ir
import numba as nb
import numpy as np
from llvmlite import binding
from numba.core import cgutils
from numba.extending import intrinsic

_CHAINS = 12  # more than latency x units of the processors we know, few enough for 16 registers
_STEPS = 1 << 22
_ELEMENTS = 1 << 24  # 64 MB an array
_ROUNDS = 20  # the best counts: others may use the machine


def fma_peak(threads: int) -> float:
    """Single-precision multiply-adds of all threads together, 10^9 operations a second (a multiply-add is two)."""
    lanes = _lanes()
    flops = 2.0 * lanes * _CHAINS * _STEPS
    _chains(np.float32(0.5), 1)
    return _best(lambda _: _chains(np.float32(0.5), _STEPS), threads, flops)


def bandwidth(threads: int) -> float:
    """Memory traffic of the triad on all threads together, 10^9 bytes a second."""
    size = _ELEMENTS // threads
    arrays = [tuple(np.full(size, value, np.float32) for value in (0.0, 1.0, 2.0)) for _ in range(threads)]
    _triad(*(array[:16] for array in arrays[0]))
    return _best(lambda number: _triad(*arrays[number]), threads, 12.0 * size)


def _best(work: Callable[[int], object], threads: int, amount: float) -> float:
    """10^9 units of work a second, of the fastest of several rounds; `amount` is what one thread does."""
    best = 0.0
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(_ROUNDS):
            began = time.perf_counter()
            list(pool.map(work, range(threads)))
            best = max(best, threads * amount / (time.perf_counter() - began) / 1e9)
    return best


def _lanes() -> int:
    """Single-precision numbers in one of this processor's vectors."""
    features = binding.get_host_cpu_features()
    if features.get("avx512f"):
        return 16
    return 8 if features.get("avx") else 4


@intrinsic
def _multiply_adds(typing: Any, factor: Any, count: Any) -> Any:
    """Chains of v = v x factor + 1 in registers, `count` long; returns their sum so that none is left out."""
    del typing, factor, count
    lanes = _lanes()

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        del context, signature
        kind = ir.VectorType(ir.FloatType(), lanes)
        factor = ir.Constant(kind, ir.Undefined)
        for lane in range(lanes):
            factor = builder.insert_element(factor, arguments[0], ir.Constant(ir.IntType(32), lane))
        one = ir.Constant(kind, [1.0] * lanes)
        name = f"llvm.fma.v{lanes}f32"
        fma = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind] * 3), name)
        chains = [cgutils.alloca_once_value(builder, ir.Constant(kind, [float(i)] * lanes)) for i in range(_CHAINS)]
        with cgutils.for_range(builder, arguments[1]):
            for chain in chains:
                builder.store(builder.call(fma, (builder.load(chain), factor, one)), chain)
        total = ir.Constant(ir.FloatType(), 0.0)
        for chain in chains:
            value = builder.load(chain)
            for lane in range(lanes):
                total = builder.fadd(total, builder.extract_element(value, ir.Constant(ir.IntType(32), lane)))
        return total

    return nb.float32(nb.float32, nb.int64), generate


@nb.njit(nogil=True)
def _chains(factor: np.float32, count: int) -> float:
    return _multiply_adds(factor, nb.int64(count))  # type: ignore[call-arg]


@nb.njit(nogil=True, fastmath=True)
def _triad(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    for i in range(a.size):
        a[i] = b[i] + np.float32(3.0) * c[i]
