"""OpenGL contexts without a window: EGL, or OSMesa where EGL is missing; on Windows and macOS those of the system."""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import sys
from typing import Any, Literal

import moderngl

from pansplat.errors import InputError

_EGL_PACKAGES = "libegl1 libgl1-mesa-dri libgl1"
_OSMESA_PACKAGE = "libosmesa6"

# Values of GL/osmesa.h, for OSMesaCreateContextAttribs.
_OSMESA_FORMAT, _OSMESA_DEPTH_BITS, _OSMESA_STENCIL_BITS = 0x22, 0x30, 0x31
_OSMESA_PROFILE, _OSMESA_CORE_PROFILE = 0x33, 0x34
_OSMESA_CONTEXT_MAJOR, _OSMESA_CONTEXT_MINOR = 0x36, 0x37
_GL_RGBA, _GL_UNSIGNED_BYTE = 0x1908, 0x1401


def create_context(backend: Literal["auto", "egl", "osmesa", "system"] = "auto") -> moderngl.Context:
    """Return a standalone context of OpenGL 3.3 or later.

    Args:
        backend: `auto` is `system` (a hidden window on Windows, none on macOS) where there is no EGL, and elsewhere EGL
            (GPU or software), then OSMesa (software only).
    """
    makers = {
        "egl": lambda: moderngl.create_context(require=330, standalone=True, backend="egl"),
        "osmesa": lambda: moderngl.create_context(require=330, context=_OsMesa()),
        "system": lambda: moderngl.create_context(require=330, standalone=True),
    }
    has_egl = sys.platform not in ("win32", "darwin")
    load_llvm_before_mesa()
    failures = []
    for name in (("egl", "osmesa") if has_egl else ("system",)) if backend == "auto" else (backend,):
        try:
            return makers[name]()
        except Exception as error:  # the libraries raise OSError, ValueError, moderngl.Error or plain Exception
            failures.append(f"{name}: {error}")
    advice = "install the driver of the graphics card"
    if has_egl:
        advice = f"on Debian or Ubuntu install `apt-get install {_EGL_PACKAGES}`, "
        advice += f"or for software rendering without EGL `{_OSMESA_PACKAGE}`"
    raise InputError(f"drawing needs OpenGL 3.3, and none could be started ({'; '.join(failures)}); {advice}")


def load_llvm_before_mesa() -> None:
    """Import Triton if it is installed; call this before the first OpenGL context is created.

    Torch may import Triton later. Triton and Mesa's software drivers contain different versions of LLVM. If Mesa's is
    loaded first, loading Triton's ends the process with a segmentation fault.
    """
    with contextlib.suppress(ImportError):
        import triton  # noqa: F401


class _OsMesa:
    """An OSMesa context with the interface that moderngl expects."""

    def __init__(self) -> None:
        library = _load_osmesa()
        attributes = (
            *(_OSMESA_FORMAT, _GL_RGBA, _OSMESA_DEPTH_BITS, 24, _OSMESA_STENCIL_BITS, 8),
            *(_OSMESA_PROFILE, _OSMESA_CORE_PROFILE, _OSMESA_CONTEXT_MAJOR, 3, _OSMESA_CONTEXT_MINOR, 3, 0),
        )
        self._library = library
        self._context = library.OSMesaCreateContextAttribs((ctypes.c_int * len(attributes))(*attributes), None)
        if not self._context:
            raise OSError("OSMesaCreateContextAttribs made no OpenGL 3.3 context")
        # OSMesa needs a default framebuffer; 1x1 suffices because the viewer draws into framebuffer objects.
        self._pixel = (ctypes.c_ubyte * 4)()
        self.__enter__()

    def load_opengl_function(self, name: str) -> int:
        """Return the address of a GL function, 0 if it does not exist."""
        return self._library.OSMesaGetProcAddress(name.encode()) or 0

    load = load_opengl_function

    def __enter__(self) -> None:
        if not self._library.OSMesaMakeCurrent(self._context, self._pixel, _GL_UNSIGNED_BYTE, 1, 1):
            raise OSError("OSMesaMakeCurrent failed")

    def __exit__(self, *_: object) -> None:
        """Keep the context current; there is no previous context to restore."""

    def release(self) -> None:
        """Destroy the context."""
        if self._context:
            self._library.OSMesaDestroyContext(self._context)
            self._context = None


def _load_osmesa() -> Any:
    names = (ctypes.util.find_library("OSMesa"), "libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
    for name in filter(None, names):
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        library.OSMesaCreateContextAttribs.restype = ctypes.c_void_p
        library.OSMesaCreateContextAttribs.argtypes = [ctypes.POINTER(ctypes.c_int), ctypes.c_void_p]
        library.OSMesaMakeCurrent.restype = ctypes.c_ubyte
        library.OSMesaMakeCurrent.argtypes = [ctypes.c_void_p, ctypes.c_void_p, *([ctypes.c_int] * 3)]
        library.OSMesaGetProcAddress.restype = ctypes.c_void_p
        library.OSMesaGetProcAddress.argtypes = [ctypes.c_char_p]
        library.OSMesaDestroyContext.argtypes = [ctypes.c_void_p]
        return library
    raise OSError("the library libOSMesa is not installed")
