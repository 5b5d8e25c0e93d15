"""Some kernels compiled by a second process while this one compiles the others, so that the first picture comes sooner.

Threads would not help: numba and LLVM compile under one lock. The second process leaves its code where numba keeps it,
and this one looks there when it needs it. Each kernel belongs to one process alone: numba keeps an index a kernel, and
of two that write it at once one loses. What the second process does not bring, for whatever reason, is compiled here.
"""

import atexit
import contextlib
import gc
import importlib
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from numba import boolean, float32, float64, int32, int64, none, uint8

from pansplat.rendering.cpu.threads import thread_count

_PACKAGE = __name__.rpartition(".")[0]
_PATH = "import sys; sys.path[:] = sys.argv[1:]; "  # before anything else is imported: the folder we are in is not ours
_SERVE = f"from {__name__} import serve; serve()"
_PAUSE = 0.05  # seconds between looks at the folder
_LONGEST = 120.0  # seconds to wait for a kernel

_Code = TypeVar("_Code")


class Task(NamedTuple):
    """A kernel to compile: its module in this package, its name, and the types of its arguments."""

    module: str
    name: str
    arguments: tuple[Any, ...]


def theirs(*, gradients: bool) -> list[Task]:
    """About half of what a first picture needs, for the second process, in the order it is needed.

    Kernels that share helpers stay together, for each process compiles the helpers it needs.

    Args:
        gradients: whether a backward will follow.
    """
    singles, longs, plane = float32[:, ::1], int64[::1], (int64, *(float64[:, ::1],) * 3)
    table, slots = int64[:, ::1], int32[::1]
    lists, picture, kept = (float32[::1], singles, int32[::1], longs), float32[:, :, ::1], (singles, longs, longs)
    found = [
        Task("bins", "_count", (int64, longs, longs, int64, int64, table)),
        Task("bins", "_list", (int64, longs, longs, *(int64,) * 4, table, longs, longs, slots, longs)),
        Task("sort", "_sort_tiles", (longs, slots, longs, longs, int64, int64)),
        Task("raster", "_draw_tiles", (*lists, *plane, picture, *kept, int64, int64, int64)),
    ]
    if gradients:
        rest = picture, *kept, picture, float32[::1], float32[::1], int64, int64, int64
        found.append(Task("raster_backward", "_walk_tiles", (*lists, slots, *plane, *rest)))
    return found


def ours(observe: Sequence[Any], *, gradients: bool) -> list[Task]:
    """What the first process compiles before it waits for the second.

    Args:
        observe: the types that `_observe` is called with, whose variants (shapes, colours) are those of `_chain`.
        gradients: whether the exact kernel's backward will follow.
    """
    if not gradients:
        return []
    singles, picture = float32[:, ::1], float32[:, :, ::1]
    camera, slots = (float64[:, ::1], float64, boolean, float64), (float32[::1], float32[::1], none, int64[::1])
    wanted = singles, singles, singles, picture, float32[::1], picture, float64[:, ::1]
    kinds = int64, *observe[1:7], *camera, observe[12], uint8[::1], singles, *slots, *wanted
    return [Task("observe_backward", "_chain", kinds)]


def compile_all(work: Sequence[Task]) -> None:
    """Compile kernels, but for those that cannot be: whoever needs these will be told."""
    for module, name, arguments in work:
        with contextlib.suppress(Exception):
            getattr(importlib.import_module(f"{_PACKAGE}.{module}"), name).compile(arguments)


class Beside:
    """A second process at work on some kernels; it ends when they are done, or when this one does.

    Args:
        work: for the second process.
        meanwhile: for this one, when it would have to wait.
    """

    def __init__(self, work: list[Task], meanwhile: Sequence[Task] = ()) -> None:
        self._meanwhile = meanwhile
        self.kernels = frozenset((task.module, task.name) for task in work)
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PATH + _SERVE, *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        atexit.register(self.stop)
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it is gone already
            pickle.dump(work, self._process.stdin)
            self._process.stdin.flush()  # and kept open: its end is ours

    def wait(self, look: Callable[[], _Code | None]) -> _Code | None:
        """What `look` finds before the process ends, or None; a process that takes absurdly long is ended."""
        work, self._meanwhile = self._meanwhile, ()
        compile_all(work)
        deadline = time.monotonic() + _LONGEST
        while self.running:
            if (found := look()) is not None:
                return found
            if time.monotonic() > deadline:
                self.stop()
            time.sleep(_PAUSE)
        return look()

    @property
    def running(self) -> bool:
        """Whether the process is at work; one that ended is cleared away."""
        return self._process.poll() is None

    def stop(self) -> None:
        """End the process."""
        if self.running:
            self._process.kill()
        self._process.wait()
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        atexit.unregister(self.stop)


def possible() -> bool:
    """Whether a second process can be started, and has a core to run on."""
    is_python = not getattr(sys, "frozen", False) and "python" in Path(sys.executable or "").name.lower()
    return is_python and thread_count() > 1


def serve() -> None:
    """What the second process does: compile what it is told on stdin, and end when that is closed."""
    work = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    gc.disable()
    compile_all(work)


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(0)
