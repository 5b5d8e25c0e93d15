"""A small pool of threads that share out numbered pieces of work."""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

import torch

_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}


def thread_count() -> int:
    """How many threads torch may use, which is how many we use."""
    return max(1, torch.get_num_threads())


def share(work: Callable[[int], object], count: int, threads: int) -> None:
    """Call `work` with 0 .. count - 1 on several threads, the calling one among them; each takes the next piece.

    Pieces must not depend on one another: who does which is not fixed. An exception, KeyboardInterrupt among
    them, is raised when all threads have stopped, so that nobody writes to a buffer that is no longer ours.
    """
    threads = min(threads, count)
    if threads <= 1:
        for piece in range(count):
            work(piece)
        return
    numbers = itertools.count()  # `next` is atomic
    stopped = False

    def work_off() -> None:
        while not stopped and (piece := next(numbers)) < count:
            work(piece)

    others: list[Future[None]] = []
    try:
        for _ in range(threads - 1):
            others.append(_pool(threads).submit(work_off))
        work_off()
    finally:
        stopped = True
        wait(others)
    for other in others:
        other.result()


def _pool(threads: int) -> ThreadPoolExecutor:
    """The pool for this many threads; a forked child makes its own, since threads do not survive a fork."""
    key = os.getpid(), threads
    pool = _pools.get(key)
    if pool is None:
        pool = _pools.setdefault(key, ThreadPoolExecutor(threads - 1, thread_name_prefix="pansplat"))
    return pool
