"""How the kernels are compiled: once a machine, kept on disk, and announced when it takes a while.

The first time a second process lends a hand (`beside.py`).
"""

import contextlib
import functools
import gc
import hashlib
import inspect
import re
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba as nb
from numba.core import event, types

from pansplat.rendering.cpu import beside

_PACKAGE = __name__.rpartition(".")[0]
_PATIENCE = 1.0  # seconds of compiling before the user is told
_NEWS = "pansplat: compiling the rasteriser for this processor, once (15 to 30 seconds)"
_OPTIONS = {
    "nogil": True,
    "error_model": "numpy",  # divide without asking whether by zero
    "boundscheck": False,
    "no_cfunc_wrapper": True,  # nobody calls them from C
    "fastmath": {"contract", "nsz"},  # sums keep their order: the same bits on any number of threads
}

_IMPORTED = re.compile(rf"^(?:from|import) {re.escape(_PACKAGE)}(?:\.(\w+)| import ([\w, ]+))", re.MULTILINE)
_FIRST = "observe", "_observe"  # the kernel that every picture needs first
_told = False
_gradients: bool | None = None  # whether those of the picture being drawn are wanted; None if none is drawn
_second: beside.Beside | None = None


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
    cache, path = compiled._cache, Path(inspect.getfile(function))
    cache._cache_file._source_stamp = _stamp(path)
    cache.load_overload = functools.partial(_load, (path.stem, function.__name__), cache.load_overload)
    return compiled


def _load(name: tuple[str, str], look: Callable[..., Any], signature: Any, context: Any) -> Any:
    """What is on disk of a kernel, waited for if the second process compiles it; its first kernel starts that one."""
    global _second
    found = look(signature, context)
    if found is None and _second is not None and name in _second.kernels:
        return _second.wait(lambda: look(signature, context))
    if found is None and name == _FIRST and _gradients is not None and _second is None and beside.possible():
        with contextlib.suppress(OSError):  # no process to be had
            mine = beside.ours(signature, gradients=_gradients)
            _second = beside.Beside(beside.theirs(gradients=_gradients), meanwhile=mine)
    return found


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
    return _inlined(function)


def borrowing(function: Callable[..., Any]) -> Any:
    """Likewise, without counting references to the arrays it is given, in inmost loops too: it must return none."""
    return _inlined(function, _nrt=False)


def _inlined(function: Callable[..., Any], **options: Any) -> Any:
    options = {"forceinline": True, "no_cpython_wrapper": True, **options, **_OPTIONS}
    compiled: Any = nb.njit(**options)(inspect.unwrap(function))
    # Numba would compile it once more for each number written in a call; LLVM puts that number in anyway.
    resolve = compiled.get_call_template
    compiled.get_call_template = lambda args, kws: resolve(
        tuple(types.unliteral(kind) for kind in args), {name: types.unliteral(kind) for name, kind in kws.items()}
    )
    return compiled


@contextlib.contextmanager
def announced(*, gradients: bool = False) -> Iterator[None]:
    """Tell on stderr, once, that kernels are being compiled, if it takes more than a second.

    Args:
        gradients: whether the exact kernel's backward will follow, and had better be compiled at once.
    """
    global _gradients
    listener, _gradients = _Listener(), gradients
    with event.install_listener("numba:compile", listener):
        try:
            yield
        finally:
            _gradients = None
            listener.stop()


class _Listener(event.Listener):
    """Starts the clock when the first of our kernels has to be compiled, and stops the collector of garbage.

    Compiling makes millions of objects and no garbage to speak of; looking for it takes a tenth of the time.
    """

    def __init__(self) -> None:
        self._timer: threading.Timer | None = None
        self._collects = False

    def on_start(self, event: event.Event) -> None:
        data: Any = event.data
        ours = data["dispatcher"].py_func.__module__.startswith(_PACKAGE)
        if ours and self._timer is None:
            self._timer = threading.Timer(_PATIENCE, _tell)
            self._timer.daemon = True
            self._timer.start()
            self._collects = gc.isenabled()
            gc.disable()

    def on_end(self, event: event.Event) -> None:
        """Kernels follow one another: the clock runs on until all are there."""

    def stop(self) -> None:
        """The clock stops, and garbage is collected again."""
        if self._timer is not None:
            self._timer.cancel()
        if self._collects:
            gc.enable()


def _tell() -> None:
    global _told
    if not _told:
        _told = True
        print(_NEWS, file=sys.stderr, flush=True)
