"""Time and memory of a call, on a machine that others may be using at the same moment."""

import ctypes
import re
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import torch

Result = TypeVar("Result")

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Took(NamedTuple):
    """Seconds of a call.

    Attributes:
        wall: on the clock.
        cpu: of all threads of the process together; what others do on the machine touches it far less.
    """

    wall: float
    cpu: float


def seconds(call: Callable[[], Result], device: torch.device) -> tuple[Took, Result]:
    """How long a call takes, its work on the device included, and what it returns."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    began, began_cpu = time.perf_counter(), time.process_time()
    result = call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return Took(time.perf_counter() - began, time.process_time() - began_cpu), result


def peak_memory(call: Callable[[], Result], device: torch.device) -> tuple[float | None, Result]:
    """The memory a call takes at its largest over what was taken before it, 10^6 bytes, and what it returns.

    On the CPU it is the kernel's own high-water mark of the process's resident memory, reset before the call, after
    freed memory has been handed back; on CUDA the allocator's. None where the system tells neither (not Linux).
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        result = call()
        return (torch.cuda.max_memory_allocated(device) - before) / 1e6, result
    if not reset_resident_peak():
        return None, call()
    resident = _status("VmRSS")
    result = call()
    return max(0, resident_peak() - resident) / 1e6, result


def reset_resident_peak() -> bool:
    """Hand back freed memory and begin a new high-water mark; False where the system has none (not Linux)."""
    _give_back()
    try:
        _RESET.write_text("5")
    except OSError:
        return False
    return True


def resident_peak() -> int:
    """The process's largest resident memory since the last reset, bytes."""
    return _status("VmHWM")


def resident() -> int:
    """The process's memory that is resident now, bytes."""
    return _status("VmRSS")


def _status(field: str) -> int:
    """Bytes that the kernel tells of this process."""
    found = re.search(rf"{field}:\s+(\d+) kB", _STATUS.read_text())
    assert found is not None
    return 1024 * int(found[1])


def _give_back() -> None:
    """Hand memory that was freed back to the system, where the C library can (glibc)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def median(times: Sequence[float]) -> float:
    """The middle time."""
    return statistics.median(times)


def spread(times: Sequence[float]) -> float:
    """The range between the quartiles; the whole range of fewer than four, 0 of one."""
    if len(times) < 4:
        return max(times) - min(times)
    low, _, high = statistics.quantiles(times, n=4, method="inclusive")
    return high - low
