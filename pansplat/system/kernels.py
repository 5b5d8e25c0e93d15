"""Compilation by numba, worker threads, and reused working memory for kernels on the processor.

Numba caches compiled code on disk, so each kernel is compiled once per machine.
"""

import contextlib
import inspect
import itertools
import math
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt
import torch

from pansplat.system.numba_api import (
    find_cache_folder,
    notify_of_compilation,
    set_source_stamp,
    share_literal_versions,
)
from pansplat.system.source_hash import hash_sources

# Modules that are a part of all kernels, besides those of the package of a kernel.
_INLINED = __name__, "pansplat.system.numba_api", "pansplat.constants"

# --- compilation ---

_OPTIONS = {
    "nogil": True,
    "error_model": "numpy",  # no check for division by zero
    "boundscheck": False,
    "no_cfunc_wrapper": True,  # the kernels are not called from C
    "fastmath": {"contract", "nsz"},  # no reassociation: results do not depend on the number of threads
}
_MESSAGE = "pansplat: compiling kernels for this processor, once; this takes up to 30 seconds"
_message_shown = False


def _announce(compiled: Any) -> None:
    """Print a message on stderr, once per process, before the first kernel of a cache folder is compiled."""
    global _message_shown
    is_ours = compiled.py_func.__module__.startswith("pansplat.")
    folder = find_cache_folder(compiled) if is_ours and not _message_shown else None
    if folder is not None and not any(folder.glob("*.nbi")):
        _message_shown = True
        print(_MESSAGE, file=sys.stderr, flush=True)


notify_of_compilation(_announce)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call, to run without the interpreter lock, and cache the code on disk."""
    return cached_njit(**_OPTIONS)(function)


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: `numba.njit`, with a cache on disk that a change of the sources of inlined functions invalidates.

    Without a writable cache directory the function is compiled once per process.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        function = inspect.unwrap(function)  # the tests' annotation checks wrap every function
        try:
            compiled = nb.njit(cache=True, **options)(function)
        except RuntimeError:  # no writable cache directory
            return nb.njit(**options)(function)
        # Numba only checks the kernel's own file for changes; functions from other files are inlined into it.
        set_source_stamp(compiled, hash_sources(function.__module__, (*_INLINED, _find_package(function.__module__))))
        return compiled

    return decorate


def _find_package(module: str) -> str:
    return module.rpartition(".")[0]


def inline_kernel(function: Callable[..., Any]) -> Any:
    """Inline a function into each kernel that calls it."""
    return _inline(function)


def inline_kernel_no_refcount(function: Callable[..., Any]) -> Any:
    """Like `inline_kernel`, without reference counts on array arguments; the function must not return an array."""
    return _inline(function, _nrt=False)


def _inline(function: Callable[..., Any], **options: Any) -> Any:
    options |= {"forceinline": True, "no_cpython_wrapper": True}
    compiled: Any = nb.njit(**options, **_OPTIONS)(inspect.unwrap(function))
    share_literal_versions(compiled)
    return compiled


@nb.njit(fastmath=True, inline="always")
def fast_atan2(y, x):
    """atan2 within 2e-6 radians, by a polynomial that vectorises.

    Source: C. Hastings, Approximations for Digital Computers, 1955.
    """
    ax, ay = abs(x), abs(y)
    small, large = min(ax, ay), max(ax, ay)
    a = small / max(large, np.float32(1e-30))
    s = a * a
    p = np.float32(-0.01172120) * s + np.float32(0.05265332)
    p = p * s - np.float32(0.11643287)
    p = p * s + np.float32(0.19354346)
    p = p * s - np.float32(0.33262347)
    r = (p * s + np.float32(0.99997726)) * a
    r = np.float32(math.pi / 2) - r if ay > ax else r
    r = np.float32(math.pi) - r if x < 0 else r
    return -r if y < 0 else r


# --- worker threads ---

_SLICE_LENGTH = 1 << 15  # numbers of a slice: 128 KiB of float32, half of a core's cache
_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}
_calling_thread = threading.local()


@contextlib.contextmanager
def checking_each_item(check: Callable[[], None]) -> Iterator[None]:
    """Within the block, `parallel_for` of this thread calls `check` before each item; an exception ends the work."""
    _calling_thread.check = check
    try:
        yield
    finally:
        _calling_thread.check = None


def thread_count() -> int:
    """Number of threads of torch's operations, at least 1."""
    return max(1, torch.get_num_threads())


def parallel_for(work: Callable[[int], object], count: int, threads: int) -> None:
    """Call `work` with each item, 0 to count - 1, on several threads, one of which is the calling thread.

    Items must be independent, because any thread may process any item. An exception, KeyboardInterrupt included, is
    raised after all threads have stopped, so that no thread writes to a buffer that the caller has released.
    """
    threads = min(threads, count)
    check = getattr(_calling_thread, "check", None)
    if threads <= 1:
        for item in range(count):
            if check is not None:
                check()
            work(item)
        return
    items = itertools.count()  # `next` is atomic
    stopped = False

    def run(check: Callable[[], None] | None = None) -> None:
        while not stopped and (item := next(items)) < count:
            if check is not None:
                check()
            work(item)

    futures: list[Future[None]] = []
    try:
        for _ in range(threads - 1):
            futures.append(_pool(threads).submit(run))
        run(check)
    finally:
        stopped = True
        # The pool may still be busy with the work of another calling thread: do not wait for what has not begun.
        futures = [future for future in futures if not future.cancel()]
        wait(futures)
    for future in futures:
        future.result()


def parallel_for_slices(work: Callable[[slice], object], length: int, report: Callable[[float], None]) -> None:
    """Call `work` with slices of `length` numbers that fit the cache, on all threads.

    Args:
        work: as for `parallel_for`; numpy's loops run without the interpreter lock.
        length: the length of the arrays.
        report: called with the fraction done, by any thread; an exception ends the work.
    """
    count, done = -(-length // _SLICE_LENGTH), itertools.count(1)

    def run(item: int) -> None:
        work(slice(item * _SLICE_LENGTH, min((item + 1) * _SLICE_LENGTH, length)))
        report(next(done) / count)

    parallel_for(run, count, thread_count())


def _pool(threads: int) -> ThreadPoolExecutor:
    """The pool for this number of threads; a forked process makes its own, since threads do not survive a fork."""
    key = os.getpid(), threads
    pool = _pools.get(key)
    if pool is None:
        pool = _pools.setdefault(key, ThreadPoolExecutor(threads - 1, thread_name_prefix="pansplat"))
    return pool


# --- working memory ---
#
# Buffers are reused, because new pages cost as much time as a stage's arithmetic: the system clears them.

_MAX_BUFFER = 1 << 28  # bytes of a buffer that is kept for reuse
_MAX_IDLE = 1 << 29  # bytes of all idle buffers
_ALIGNMENT = 64  # bytes: a cache line

_lock = threading.Lock()
_idle: list[npt.NDArray[np.uint8]] = []
_returned: deque[npt.NDArray[np.uint8]] = (
    deque()
)  # buffers that are not yet in `_idle`: a workspace may end while a thread holds the lock


class Workspace:
    """Arrays that are valid while this object exists; other workspaces reuse their memory afterwards."""

    def __init__(self) -> None:
        self._buffers: list[npt.NDArray[np.uint8]] = []

    def array(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """An uninitialised array, aligned to a cache line."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        buffer = _take_buffer(size) if size <= _MAX_BUFFER else np.empty(size + _ALIGNMENT, np.uint8)
        if size <= _MAX_BUFFER:
            self._buffers.append(buffer)
        start = -buffer.ctypes.data % _ALIGNMENT
        return buffer[start : start + size].view(dtype).reshape(shape)

    def __del__(self) -> None:
        _returned.extend(getattr(self, "_buffers", ()))  # torch.compile makes objects without calling __init__
        if _lock.acquire(blocking=False):
            try:
                _collect_returned()
            finally:
                _lock.release()


class _PooledArray:
    """An array interface that holds its own workspace."""

    def __init__(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._workspace = Workspace()
        self._array = self._workspace.array(shape, dtype)
        self.__array_interface__ = self._array.__array_interface__


def pooled_empty(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """An uninitialised array whose memory is reused after the last reference to it or to a view (torch's too)."""
    return np.asarray(_PooledArray(shape, dtype))


def _collect_returned() -> None:
    """Move returned buffers to the idle ones and free the oldest beyond the limit; the caller holds the lock."""
    while _returned:
        _idle.append(_returned.popleft())
    while sum(buffer.nbytes for buffer in _idle) > _MAX_IDLE:
        _idle.pop(0)


def _take_buffer(size: int) -> npt.NDArray[np.uint8]:
    """The smallest idle buffer that fits without wasting more than half, or a new one."""
    with _lock:
        _collect_returned()
        fitting = [i for i, buffer in enumerate(_idle) if size + _ALIGNMENT <= buffer.nbytes <= 2 * size + 4096]
        if fitting:
            return _idle.pop(min(fitting, key=lambda i: _idle[i].nbytes))
    return np.empty(size + size // 8 + _ALIGNMENT, np.uint8)  # the next image may need a little more


def release_idle_memory() -> None:
    """Free the memory that no workspace holds."""
    with _lock:
        _collect_returned()
        _idle.clear()
