"""What was measured on: processor, versions, and the peaks reached in the same run."""

import contextlib
import importlib.metadata
import os
import platform
from pathlib import Path

import torch

_PACKAGES = ("pansplat", "torch", "numpy", "numba", "triton", "gsplat")


def describe_machine(threads: int) -> dict[str, object]:
    """The machine as the report names it; measures the peaks, which takes about a second.

    Args:
        threads: that the rows with most threads use.

    Returns:
        cpu, cores, threads, system, python, versions, gpu (null where there is none), and for one and for all threads
        fma_gflops (single-precision multiply-adds, two operations each) and bandwidth_gb_s (triad, 10^9 bytes).
    """
    from pansplat.bench.roofline import bandwidth, fma_peak

    counts = sorted({1, threads})
    return {
        "cpu": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": threads,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": _versions(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "fma_gflops": {str(count): round(fma_peak(count), 1) for count in counts},
        "bandwidth_gb_s": {str(count): round(bandwidth(count), 1) for count in counts},
    }


def _processor() -> str:
    """The processor's name, as Linux tells it, with the vector extension that counts."""
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


def _versions() -> dict[str, str]:
    """Of the packages that draw, those that are installed."""
    versions = {}
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions
