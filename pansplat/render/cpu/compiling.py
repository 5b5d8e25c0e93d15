"""How the kernels are compiled: once a machine, kept on disk, and announced when it takes a while."""

import contextlib
import inspect
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numba as nb
from numba.core import event

_PATIENCE = 1.0  # seconds of compiling before the user is told
_NEWS = "pansplat: compiling the rasteriser for this processor, once (about 15 seconds)"
_OPTIONS = {
    "nogil": True,
    "error_model": "numpy",  # divide without asking whether by zero
    "boundscheck": False,
    "fastmath": {"contract", "nsz"},  # sums keep their order: the same bits on any number of threads
}

_told = False


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call, without the interpreter's lock, and keep the code on disk."""
    # The tests' check of annotations wraps every function; numba needs the bare one.
    return nb.njit(cache=True, **_OPTIONS)(inspect.unwrap(function))


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into each kernel that calls it."""
    return nb.njit(forceinline=True, **_OPTIONS)(inspect.unwrap(function))


@contextlib.contextmanager
def announced() -> Iterator[None]:
    """Tell on stderr, once, that kernels are being compiled, if it takes more than a second."""
    listener = _Listener()
    with event.install_listener("numba:compile", listener):
        try:
            yield
        finally:
            listener.stop()


class _Listener(event.Listener):
    """Starts the clock when the first of our kernels has to be compiled."""

    def __init__(self) -> None:
        self._timer: threading.Timer | None = None

    def on_start(self, event: event.Event) -> None:
        ours = event.data["dispatcher"].py_func.__module__.startswith(__package__)
        if ours and self._timer is None:
            self._timer = threading.Timer(_PATIENCE, _tell)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: event.Event) -> None:
        """Kernels follow one another: the clock runs on until all are there."""

    def stop(self) -> None:
        """The clock stops."""
        if self._timer is not None:
            self._timer.cancel()


def _tell() -> None:
    global _told
    if not _told:
        _told = True
        print(_NEWS, file=sys.stderr, flush=True)
