"""All that kernels use of numba beyond its documented interface, in one place.

It exists in numba 0.60 to 0.68, the versions that pyproject.toml allows; tests/system/test_numba_api.py names what a
later version lacks.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core import types as types
from numba.core.cgutils import get_or_insert_function as get_or_insert_function
from numba.core.event import Listener, register
from numba.core.typing.templates import ConcreteTemplate as ConcreteTemplate
from numba.core.typing.templates import infer_global as infer_global
from numba.core.typing.templates import signature as signature


def set_source_stamp(compiled: Any, stamp: str) -> None:
    """Make numba use a cached kernel only if its stamp is this one; by default it is the date of the kernel's file."""
    compiled._cache._cache_file._source_stamp = stamp


def find_cache_folder(compiled: Any) -> Path | None:
    """The folder in which numba keeps a cached kernel; None if it is not cached."""
    folder = compiled._cache.cache_path
    return None if folder is None else Path(folder)


def share_literal_versions(compiled: Any) -> None:
    """Compile one version of a function for all values of a literal argument: LLVM propagates constants anyway."""
    resolve = compiled.get_call_template
    compiled.get_call_template = lambda args, kws: resolve(
        tuple(types.unliteral(kind) for kind in args), {name: types.unliteral(kind) for name, kind in kws.items()}
    )


class _Notifier(Listener):
    """Calls a function with what is compiled."""

    def __init__(self, notify: Callable[[Any], None]) -> None:
        self._notify = notify

    def on_start(self, event: Any) -> None:
        self._notify(event.data["dispatcher"])

    def on_end(self, event: Any) -> None:
        pass


def notify_of_compilation(notify: Callable[[Any], None]) -> None:
    """From now on, call `notify` with each function whose compilation begins."""
    register("numba:compile", _Notifier(notify))


def processor_features(context: Any) -> list[str]:
    """LLVM's names of the features of the processor for which a typing context compiles."""
    return context.codegen().magic_tuple()[2].split(",")
