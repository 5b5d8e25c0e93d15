"""OpenGL contexts without a window: EGL; on Windows and macOS those of the system."""

from __future__ import annotations

import contextlib
import sys

import moderngl

from pansplat.errors import InputError


def create_context() -> moderngl.Context:
    """Return a standalone context of OpenGL 3.3 or later.

    It is one of EGL (GPU or software) where there is EGL; Windows has a hidden window, macOS none.
    """
    has_egl = sys.platform not in ("win32", "darwin")
    load_llvm_before_mesa()
    try:
        return moderngl.create_context(require=330, standalone=True, **({"backend": "egl"} if has_egl else {}))
    except Exception as error:  # the libraries raise OSError, ValueError, moderngl.Error or plain Exception
        packages = "on Debian or Ubuntu install `apt-get install libegl1 libgl1-mesa-dri libgl1`"
        advice = packages if has_egl else "install the driver of the graphics card"
        raise InputError(f"drawing needs OpenGL 3.3, and none could be started ({error}); {advice}") from error


def load_llvm_before_mesa() -> None:
    """Import Triton if it is installed; call this before the first OpenGL context is created.

    Torch may import Triton later. Triton and Mesa's software drivers contain different versions of LLVM. If Mesa's is
    loaded first, loading Triton's ends the process with a segmentation fault.
    """
    with contextlib.suppress(ImportError):
        import triton  # noqa: F401
