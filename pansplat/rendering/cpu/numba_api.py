"""All that the CPU kernels use of numba beyond its documented interface, in one place.

It exists in numba 0.60 to 0.68; tests/rendering/cpu/test_numba_api.py names what a later version lacks. Without what is
found by `_find` the kernels give the same results, but are compiled in every process, in more versions, or not inlined.
The imports are required: simd.py defines its vectors with them.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numba
from numba.core import types as types
from numba.core.cgutils import alloca_once as alloca_once
from numba.core.cgutils import get_or_insert_function as get_or_insert_function
from numba.core.typing.templates import ConcreteTemplate as ConcreteTemplate
from numba.core.typing.templates import infer_global as infer_global
from numba.core.typing.templates import signature as signature

_OPTIONS = ("no_cfunc_wrapper", "no_cpython_wrapper", "forceinline", "_nrt")  # options of njit that only save time


def _find(owner: Any, path: str) -> Any:
    """An attribute by its dotted path; None if one of the names is missing."""
    for name in path.split("."):
        owner = getattr(owner, name, None)
    return owner


def known_options(options: dict[str, Any]) -> dict[str, Any]:
    """These options of `njit` without those that are not documented and that numba does not have."""
    target = _find(numba, "core.cpu.CPUTargetOptions")
    return {name: value for name, value in options.items() if name not in _OPTIONS or _find(target, name) is not None}


def set_source_stamp(compiled: Any, stamp: str) -> bool:
    """Make numba use a cached kernel only if its stamp is this one; by default it is the date of the kernel's file.

    Returns:
        False if this numba cannot: then the kernel must not be cached.
    """
    if _find(compiled, "_cache._cache_file._source_stamp") is None:
        return False
    compiled._cache._cache_file._source_stamp = stamp
    return True


def find_cache_folder(compiled: Any) -> str | None:
    """The folder in which numba keeps a cached kernel; None if this numba hides it."""
    return _find(compiled, "_cache.cache_path")


def share_literal_versions(compiled: Any) -> None:
    """Compile one version of a function for all values of a literal argument: LLVM propagates constants anyway."""
    resolve, unliteral = _find(compiled, "get_call_template"), _find(numba, "core.types.unliteral")
    if resolve is None or unliteral is None:
        return
    compiled.get_call_template = lambda args, kws: resolve(
        tuple(unliteral(kind) for kind in args), {name: unliteral(kind) for name, kind in kws.items()}
    )


@contextlib.contextmanager
def notify_of_compilation(notify: Callable[[str], None]) -> Iterator[None]:
    """Within the block, call `notify` with the name of a function's module when its compilation begins."""
    install, listener = _find(numba, "core.event.install_listener"), _find(numba, "core.event.Listener")
    if install is None or listener is None:
        yield
        return

    def on_start(_: Any, event: Any) -> None:
        function = _find(event, "data") and _find(event.data.get("dispatcher"), "py_func")
        notify(getattr(function, "__module__", ""))

    kind = type("_Listener", (listener,), {"on_start": on_start, "on_end": lambda self, event: None})
    with install("numba:compile", kind()):
        yield


def processor_features(context: Any) -> list[str]:
    """LLVM's names of the features of the processor for which a typing context compiles; none if numba hides them."""
    magic_tuple = _find(context.codegen(), "magic_tuple")
    return [] if magic_tuple is None else magic_tuple()[2].split(",")
