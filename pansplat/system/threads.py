"""Threads: sections of torch and numpy code on one thread, and pools of threads."""

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, TypeVar

import torch
from threadpoolctl import threadpool_limits

_T = TypeVar("_T")
_lock = threading.Lock()
_num_running = 0  # sections that are running now
_num_threads = 1  # torch's threads outside of all sections
_blas: threadpool_limits | None = None  # the limit of threads for matrix products during sections


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run operations of torch, and matrix products of numpy, on the calling thread only; then restore the numbers.

    Operations on a few thousand numbers do not benefit from a second core, and on a busy machine they wait for it:
    three jobs on two cores ran 40 times slower. One thread also fixes the order of summation.
    """
    global _num_running, _num_threads, _blas
    with _lock:
        if _num_running == 0:
            _num_threads = torch.get_num_threads()
            _blas = threadpool_limits(1, "blas")
        _num_running += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            _num_running -= 1
            if _num_running == 0 and _blas is not None:
                _blas.restore_original_limits()
            torch.set_num_threads(_num_threads)


class _ContextPool(ThreadPoolExecutor):
    """A pool whose work runs in the context of the thread that submits it, which collects its notes."""

    def submit(self, function: Callable[..., _T], /, *args: Any, **kwargs: Any) -> Future[_T]:
        return super().submit(copy_context().run, function, *args, **kwargs)


def worker_threads() -> ThreadPoolExecutor:
    """A pool for work that releases Python's lock, with a thread for each processor, four at most."""
    return _ContextPool(max(1, min(4, os.cpu_count() or 1)))
