"""Working memory that is used again: fresh pages cost as much as a stage's arithmetic, since the system clears them.

Blocks are lent to one call at a time and come back when its lease is no longer referred to, so neither two threads
nor a backward that is still to come can share one by accident. What callers are given is never lent.
"""

import threading
from typing import Any

import numpy as np
import numpy.typing as npt

_LARGEST = 1 << 28  # bytes of a block worth keeping
_KEPT = 1 << 29  # bytes kept at most between calls
_ALIGNMENT = 64  # a cache line

_lock = threading.Lock()
_idle: list[npt.NDArray[np.uint8]] = []


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
        with _lock:
            _idle.extend(getattr(self, "_blocks", ()))  # torch.compile makes objects that were never initialised
            while sum(block.nbytes for block in _idle) > _KEPT:
                _idle.pop(0)


def _take(size: int) -> npt.NDArray[np.uint8]:
    """The smallest idle block that fits and is not mostly waste, or a new one."""
    with _lock:
        fitting = [i for i, block in enumerate(_idle) if size + _ALIGNMENT <= block.nbytes <= 2 * size + 4096]
        if fitting:
            return _idle.pop(min(fitting, key=lambda i: _idle[i].nbytes))
    return np.empty(size + _ALIGNMENT, np.uint8)


def forget_idle() -> None:
    """Let go of the blocks that no call holds; the next call takes fresh ones, as the first one did."""
    with _lock:
        _idle.clear()
