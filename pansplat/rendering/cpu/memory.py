"""Working memory that is used again: fresh pages cost as much as a stage's arithmetic, since the system clears them.

Blocks are lent to one call at a time and come back when its lease is no longer referred to, so neither two threads
nor a backward that is still to come can share one by accident. What callers are given comes back when they let it go.
"""

import threading
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

_LARGEST = 1 << 28  # bytes of a block worth keeping
_KEPT = 1 << 29  # bytes kept at most between calls
_ALIGNMENT = 64  # a cache line

_lock = threading.Lock()
_idle: list[npt.NDArray[np.uint8]] = []
_returned: deque[npt.NDArray[np.uint8]] = deque()  # not yet among the idle: a lease may end while the lock is held


class Lease:
    """Arrays on loan for as long as this object lives."""

    def __init__(self) -> None:
        self._blocks: list[npt.NDArray[np.uint8]] = []

    def array(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """An uninitialised array that starts on a cache line."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        block = _take(size) if size <= _LARGEST else np.empty(size + _ALIGNMENT, np.uint8)
        if size <= _LARGEST:
            self._blocks.append(block)
        start = -block.ctypes.data % _ALIGNMENT
        return block[start : start + size].view(dtype).reshape(shape)

    def __del__(self) -> None:
        _returned.extend(getattr(self, "_blocks", ()))  # torch.compile makes objects that were never initialised
        if _lock.acquire(blocking=False):
            try:
                _settle()
            finally:
                _lock.release()


class _Given:
    """What numpy takes for an array, with a lease of its own."""

    def __init__(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._lease = Lease()
        self._array = self._lease.array(shape, dtype)
        self.__array_interface__ = self._array.__array_interface__


def array_to_give(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """An uninitialised array on a cache line, on loan for as long as anybody, torch too, refers to it or a part."""
    return np.asarray(_Given(shape, dtype))


def _settle() -> None:
    """Count what came back among the idle, and let go of the oldest beyond the limit; the lock is held."""
    while _returned:
        _idle.append(_returned.popleft())
    while sum(block.nbytes for block in _idle) > _KEPT:
        _idle.pop(0)


def _take(size: int) -> npt.NDArray[np.uint8]:
    """The smallest idle block that fits and is not mostly waste, or a new one."""
    with _lock:
        _settle()
        fitting = [i for i, block in enumerate(_idle) if size + _ALIGNMENT <= block.nbytes <= 2 * size + 4096]
        if fitting:
            return _idle.pop(min(fitting, key=lambda i: _idle[i].nbytes))
    return np.empty(size + _ALIGNMENT, np.uint8)


def forget_idle() -> None:
    """Let go of the blocks that no call holds; the next call takes fresh ones, as the first one did."""
    with _lock:
        _settle()
        _idle.clear()
