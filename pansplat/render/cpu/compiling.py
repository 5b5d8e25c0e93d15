"""How the kernels are compiled: once a machine, kept on disk, and announced when it takes a while."""

import contextlib
import hashlib
import inspect
import re
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba as nb
from numba.core import event

_PACKAGE = __name__.rpartition(".")[0]
_PATIENCE = 1.0  # seconds of compiling before the user is told
_NEWS = "pansplat: compiling the rasteriser for this processor, once (about half a minute)"
_OPTIONS = {
    "nogil": True,
    "error_model": "numpy",  # divide without asking whether by zero
    "boundscheck": False,
    "no_cfunc_wrapper": True,  # nobody calls them from C
    "fastmath": {"contract", "nsz"},  # sums keep their order: the same bits on any number of threads
}

_IMPORTED = re.compile(rf"^(?:from|import) {re.escape(_PACKAGE)}(?:\.(\w+)| import ([\w, ]+))", re.MULTILINE)
_told = False


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call, without the interpreter's lock, and keep the code on disk.

    Where nothing can be written, it is compiled once a process.
    """
    # The tests' check of annotations wraps every function; numba needs the bare one.
    function = inspect.unwrap(function)
    try:
        compiled: Any = nb.njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # no folder to keep it in
        return nb.njit(**_OPTIONS)(function)
    # Numba looks only at the file that a kernel stands in; what is compiled into it stands in others.
    compiled._cache._cache_file._source_stamp = _stamp(Path(inspect.getfile(function)))
    return compiled


def _stamp(module: Path) -> str:
    """A fingerprint of a module and of all those of this package that it uses, directly or not."""
    found, waiting = {}, [module]
    while waiting:
        path = waiting.pop()
        if path not in found and path.exists():
            found[path] = path.read_bytes()
            names = " ".join("".join(groups) for groups in _IMPORTED.findall(found[path].decode()))
            waiting += [Path(__file__).with_name(f"{name}.py") for name in re.findall(r"\w+", names)]
    texts = (found[path] for path in sorted(found, key=lambda path: path.name))
    return hashlib.sha256(b"\0".join(texts)).hexdigest()


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into each kernel that calls it."""
    return nb.njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)(inspect.unwrap(function))


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
        data: Any = event.data
        ours = data["dispatcher"].py_func.__module__.startswith(_PACKAGE)
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
