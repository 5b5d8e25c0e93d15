"""The machine's peaks, and the least arithmetic and memory traffic of an image.

Peaks are measured with small kernels: independent chains of fused multiply-adds in registers, and the triad
a = b + s c over arrays far larger than the caches (12 bytes an element are counted, as in STREAM; writing also reads
the cache line, so that 16 move).

The work of an image follows from the scene alone and bounds that of any tiled renderer from below: pixel centres inside
each Gaussian's exact box (docs/rendering.md, section 5), hidden pixels included; and the traffic of reading the scene
once, writing a record of 80 bytes per Gaussian, reading it once per tile of 32 x 32 pixels, and writing the image.
"""

import contextlib
import importlib.metadata
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import llvmlite.ir as ir
import numba as nb
import numpy as np
import torch
from jaxtyping import Float
from llvmlite import binding
from numba.core import cgutils
from numba.extending import intrinsic
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.projection import equirect_boxes, kappa, project_gaussians
from pansplat.rendering.rasterize import RasterOptions

FORWARD_OPERATIONS = 46
"""Floating-point operations per pair of a pixel and a Gaussian, of the exact kernel in two components: 2 differences,
6 for A and B, 3 for Q, 4 for L, 4 for q, 1 for log2 of alpha, 13 for 2^x, 2 for the cuts, 3 for weight and
transmittance, 8 for four sums."""

BACKWARD_OPERATIONS = 103
"""Likewise: 38 to recompute alpha and weight, 12 for the gradient of alpha, 20 for A, B, L and q, 25 for their sums, 8
for those of the values."""

_PACKAGES = ("pansplat", "torch", "numpy", "numba", "triton")

_CHAINS = 12  # more than latency x units of common processors, few enough for 16 registers
_STEPS = 1 << 22
_ELEMENTS = 1 << 24  # 64 MB per array
_ROUNDS = 20  # the best round counts: other processes may use the machine

_RECORD_BYTES = 80  # 16 numbers of a record, 4 values
_INTERSECTION_BYTES = 8  # an entry of a tile's list
_TILE_SIZE = 32  # pixels
_CHUNK_SIZE = 1 << 17  # Gaussians whose boxes are computed together


def describe_machine(threads: int) -> dict[str, object]:
    """The machine and its measured peaks; takes about a second.

    Args:
        threads: the largest number that the benchmark uses.

    Returns:
        cpu, cores, threads, system, python, versions, gpu (None if there is none), and for one and for all threads
        fma_gflops (single-precision multiply-adds, two operations each) and bandwidth_gb_s (triad, 10^9 bytes).
    """
    counts = sorted({1, threads})
    return {
        "cpu": _read_processor_name(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": threads,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": _read_package_versions(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "fma_gflops": {str(count): round(measure_fma_peak(count), 1) for count in counts},
        "bandwidth_gb_s": {str(count): round(measure_bandwidth(count), 1) for count in counts},
    }


def _read_processor_name() -> str:
    """The processor's name, with its widest vector extension on Linux."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    facts: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        facts.setdefault(name.strip(), value.strip())
    flags = facts.get("flags", facts.get("Features", "")).split()
    widest = next((flag for flag in ("avx512f", "avx2", "avx", "asimd") if flag in flags), "")
    model = facts.get("model name") or platform.processor() or platform.machine()
    return f"{model} ({widest})" if widest else model


def _read_package_versions() -> dict[str, str]:
    """Versions of the installed packages that render."""
    versions = {}
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def measure_fma_peak(threads: int) -> float:
    """Single-precision multiply-adds of all threads together, 10^9 operations a second (a multiply-add is two)."""
    flops = 2.0 * _vector_lanes() * _CHAINS * _STEPS
    _multiply_add_chains(np.float32(0.5), 1)
    return _best_rate(lambda _: _multiply_add_chains(np.float32(0.5), _STEPS), threads, flops)


def measure_bandwidth(threads: int) -> float:
    """Memory traffic of the triad on all threads together, 10^9 bytes a second."""
    size = _ELEMENTS // threads
    arrays = [tuple(np.full(size, value, np.float32) for value in (0.0, 1.0, 2.0)) for _ in range(threads)]
    _triad(*(array[:16] for array in arrays[0]))
    return _best_rate(lambda number: _triad(*arrays[number]), threads, 12.0 * size)


def _best_rate(work: Callable[[int], object], threads: int, amount: float) -> float:
    """10^9 units of work a second in the fastest of several rounds; `amount` is the work of one thread."""
    best = 0.0
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(_ROUNDS):
            began = time.perf_counter()
            list(pool.map(work, range(threads)))
            best = max(best, threads * amount / (time.perf_counter() - began) / 1e9)
    return best


def _vector_lanes() -> int:
    """Single-precision numbers in one of this processor's vectors."""
    features = binding.get_host_cpu_features()
    if features.get("avx512f"):
        return 16
    return 8 if features.get("avx") else 4


@intrinsic
def _multiply_adds(typing: Any, factor: Any, count: Any) -> Any:
    """The sum of chains of v = v x factor + 1 in registers, each `count` steps long."""
    del typing, factor, count
    lanes = _vector_lanes()

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
def _multiply_add_chains(factor: np.float32, count: int) -> float:
    return _multiply_adds(factor, nb.int64(count))  # type: ignore[call-arg]


@nb.njit(nogil=True, fastmath=True)
def _triad(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    for i in range(a.size):
        a[i] = b[i] + np.float32(3.0) * c[i]


@dataclass(frozen=True)
class Work:
    """The least work of one panorama: pixel centres in the boxes of all Gaussians, and bytes of a forward pass."""

    pairs: int
    bytes: int


@torch.no_grad()
def count_panorama_work(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], height: int, options: RasterOptions
) -> Work:
    """The least work of rendering a panorama; counted for the exact kernel, independently of `options.kernel`."""
    size = (height, 2 * height)
    (plane,) = image_planes("equirect", size, vertical_fov_degrees=90.0, face_size=None, device=torch.device("cpu"))
    pairs = intersections = 0
    for index in torch.arange(len(gaussians)).split(_CHUNK_SIZE):
        part = gaussians.select(index)
        seen = project_gaussians(
            part,
            None,
            cam2world.double(),
            filter_variance=options.filter_variance(plane.pixel_angle),
            compensate=options.compensate,
            exact=False,
        )
        boxes = equirect_boxes(seen.direction, seen.covariance, kappa(seen.peak), size)
        inside, tiles = _count_pixels_and_tiles(boxes[seen.radius >= options.near], size)
        pairs, intersections = pairs + inside, intersections + tiles
    numbers = 11 + gaussians.harmonics[:1].numel()
    image = 4 * 5 * height * 2 * height
    records = len(gaussians) * (4 * numbers + _RECORD_BYTES)
    return Work(pairs, records + intersections * (_RECORD_BYTES + _INTERSECTION_BYTES) + image)


def _count_pixels_and_tiles(boxes: Float[Tensor, "n 4"], size: tuple[int, int]) -> tuple[int, int]:
    """Pixel centres in all boxes (left, right, top, bottom; columns wrap), and tiles that contain one."""
    height, width = size
    left, top = torch.ceil(boxes[:, 0] - 0.5), torch.ceil(boxes[:, 2] - 0.5).clamp_min(0)
    right, bottom = torch.floor(boxes[:, 1] - 0.5), torch.floor(boxes[:, 3] - 0.5).clamp_max(height - 1)
    visible = (left <= right) & (top <= bottom)
    columns, rows = (right - left + 1).clamp_max(width), bottom - top + 1
    across = (torch.floor(right / _TILE_SIZE) - torch.floor(left / _TILE_SIZE) + 1).clamp_max(-(-width // _TILE_SIZE))
    down = torch.floor(bottom / _TILE_SIZE) - torch.floor(top / _TILE_SIZE) + 1
    return int((columns * rows)[visible].sum()), int((across * down)[visible].sum())
