"""Time, memory and errors of one call, in this process or in a child process.

In a child process, memory of earlier cases does not count, and the number of threads is its own.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import json
import math
import os
import platform
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import safetensors.torch
import torch
from torch import Tensor

from pansplat.console import describes_out_of_memory

T = TypeVar("T")

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_PACKAGES = ("pansplat", "torch", "numpy", "numba")
_POLL_INTERVAL = 0.05  # seconds between two checks of a child process


class Timing(NamedTuple):
    """Seconds of a call: elapsed, and of all threads of the process, which other processes affect far less."""

    wall: float
    cpu: float


def time_call(call: Callable[[], T], device: torch.device) -> tuple[Timing, T]:
    """Time a call, its work on the device included, and return its result."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    began, began_cpu = time.perf_counter(), time.process_time()
    result = call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return Timing(time.perf_counter() - began, time.process_time() - began_cpu), result


@torch.inference_mode()
def time_workload() -> float:
    """Seconds of a fixed workload on torch's threads, so that times of different machines compare: median of 51.

    It is a convolution (1.2 GFLOP) and the exponentials of 4 million numbers, on the CPU, after half a second of the
    same: the first calls wait for memory and sleeping threads.
    """
    maps = torch.linspace(-1, 1, 32 * 256 * 512).reshape(1, 32, 256, 512)
    weights = torch.linspace(-0.1, 0.1, 16 * 32 * 9).reshape(16, 32, 3, 3)
    values = torch.empty_like(maps)

    def work() -> None:
        torch.nn.functional.conv2d(maps, weights, padding=1)
        torch.exp(maps, out=values)

    cpu = torch.device("cpu")
    end = time.perf_counter() + 0.5
    while time.perf_counter() < end:
        work()
    return statistics.median(time_call(work, cpu)[0].wall for _ in range(51))


def measure_peak_memory(call: Callable[[], T], device: torch.device) -> tuple[float | None, T]:
    """Largest additional memory during a call, 10^6 bytes, and the result of the call.

    On the CPU it is the kernel's high-water mark of the resident memory, reset before the call; on CUDA that of
    the allocator. None if the system has no such mark (not Linux).
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        result = call()
        return (torch.cuda.max_memory_allocated(device) - before) / 1e6, result
    if not reset_resident_peak():
        return None, call()
    before = read_resident_memory()
    result = call()
    return max(0, read_resident_peak() - before) / 1e6, result


def reset_resident_peak() -> bool:
    """Return freed memory to the system and restart the high-water mark; False if there is none (not Linux)."""
    if sys.platform == "win32":  # where the libraries of the process have no common handle
        return False
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only
    if trim is not None:
        trim(0)
    try:
        _RESET.write_text("5", encoding="utf-8")
    except OSError:
        return False
    return True


def read_resident_peak() -> int:
    """Largest resident memory of the process since the last reset, bytes."""
    return _read_status_bytes(_STATUS, "VmHWM")


def read_resident_memory() -> int:
    """Resident memory of the process, bytes."""
    return _read_status_bytes(_STATUS, "VmRSS")


def _read_status_bytes(status: Path, field: str) -> int:
    found = re.search(rf"{field}:\s+(\d+) kB", status.read_text(encoding="utf-8"))
    return 1024 * int(found[1]) if found else 0  # a process that has just ended has no such line


def quartile_range(times: Sequence[float]) -> float:
    """The range between the quartiles; the whole range of fewer than four times."""
    if len(times) < 4:
        return max(times) - min(times)
    low, _, high = statistics.quantiles(times, n=4, method="inclusive")
    return high - low


@contextlib.contextmanager
def restore_threads() -> Iterator[None]:
    """Restore torch's number of threads afterwards."""
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def compare_images(image: Tensor, reference: Tensor) -> dict[str, float]:
    """`max_error`, the largest absolute difference of the colours, and `psnr_db`, unclamped and for a peak of 1.

    Raises:
        ValueError: the shapes differ.
    """
    if image.shape != reference.shape:
        raise ValueError(f"`image` must have the reference's shape {tuple(reference.shape)}, got {tuple(image.shape)}")
    error = image.detach().double().cpu() - reference.double().cpu()
    mean_square = float(error.square().mean())
    psnr_db = -10 * math.log10(mean_square) if mean_square > 0 else math.inf
    return {"psnr_db": psnr_db, "max_error": float(error.abs().max())}


def relative_deviation(result: Mapping[str, Tensor], reference: Mapping[str, Tensor], *, together: bool) -> float:
    """|result - reference| / |reference|, Euclidean norms.

    Args:
        together: of all tensors as one vector; else the largest value among the tensors.

    Raises:
        ValueError: the names differ.
    """
    if result.keys() != reference.keys():
        raise ValueError(f"`result` must hold {sorted(reference)}, got {sorted(result)}")
    errors = {name: float((result[name].double() - reference[name].double()).norm()) for name in reference}
    norms = {name: float(reference[name].double().norm()) for name in reference}
    if together:
        return math.hypot(*errors.values()) / max(math.hypot(*norms.values()), 1e-300)
    return max(errors[name] / max(norms[name], 1e-300) for name in reference)


def describe_machine() -> dict[str, object]:
    """The processor with its widest vector extension, the GPU (or None), torch's number of threads, and versions."""
    facts: dict[str, str] = {}
    with contextlib.suppress(OSError):  # Linux only
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            facts.setdefault(name.strip(), value.strip())
    flags = facts.get("flags", facts.get("Features", "")).split()
    widest = next((f" ({flag})" for flag in ("avx512f", "avx2", "avx", "asimd") if flag in flags), "")
    return {
        "cpu": (facts.get("model name") or platform.processor() or platform.machine()) + widest,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
    }


class CaseFailedError(Exception):
    """A child process failed; the text is its last message."""


class OverLimitError(CaseFailedError):
    """A child process took more memory than allowed or available."""


def run_child(
    module: str, job: Mapping[str, object], *, threads: int, limit_gib: float | None = None
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Run `python -m module`, which calls `serve_job`, and return its numbers and tensors.

    Args:
        module: name of the module.
        job: JSON values that the child receives.
        threads: of torch and OpenMP in the child.
        limit_gib: the child is ended if its resident memory exceeds this, 2^30 bytes.

    Raises:
        OverLimitError: it exceeded the limit or the available memory.
        CaseFailedError: it failed otherwise.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "job.json").write_text(json.dumps({**job, "threads": threads}), "utf-8")
        with open(folder / "log", "wb") as log:
            child = subprocess.Popen(
                [sys.executable, "-m", module, name],
                env=os.environ | {"OMP_NUM_THREADS": str(threads)},
                stdout=log,
                stderr=log,
            )
        try:
            over_limit = _exceeds_limit(child, limit_gib)
        finally:
            child.kill()
            child.wait()
        if over_limit:
            raise OverLimitError(f"ended at {limit_gib:g} GiB")
        if child.returncode:
            raise _make_error(child.returncode, (folder / "log").read_text("utf-8", "replace"))
        numbers = json.loads((folder / "numbers.json").read_text("utf-8"))
        # `load_file` would map the file, and Windows cannot remove a mapped one.
        return numbers, safetensors.torch.load((folder / "tensors.safetensors").read_bytes())


def _exceeds_limit(child: subprocess.Popen[bytes], limit_gib: float | None) -> bool:
    """Wait for the end of a child; True at once if its resident memory exceeds the limit."""
    if limit_gib is None:
        child.wait()
        return False
    status = Path(f"/proc/{child.pid}/status")
    while child.poll() is None:
        time.sleep(_POLL_INTERVAL)
        with contextlib.suppress(OSError):  # it has just ended, or the system has no such file
            if _read_status_bytes(status, "VmRSS") > limit_gib * 2**30:
                return True
    return False


def _make_error(status: int, log: str) -> CaseFailedError:
    """The error of a child with this exit status and output."""
    message = (log.strip() or "no message").splitlines()[-1]
    if describes_out_of_memory(message):
        return OverLimitError(f"no memory left: {message[:120]}")
    if status < 0:
        return CaseFailedError(f"ended by {signal.Signals(-status).name}")
    return CaseFailedError(message[:160])


def serve_job(measure: Callable[[dict[str, Any]], tuple[Mapping[str, object], Mapping[str, Tensor]]]) -> None:
    """Main function of a child process: measure its job and write the result for `run_child`."""
    folder = Path(sys.argv[1])
    job = json.loads((folder / "job.json").read_text("utf-8"))
    torch.set_num_threads(job["threads"])
    numbers, tensors = measure(job)
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    safetensors.torch.save_file(contiguous, folder / "tensors.safetensors")
    (folder / "numbers.json").write_text(json.dumps(numbers), "utf-8")
