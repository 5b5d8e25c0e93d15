"""An OpenGL context without a window: EGL, or OSMesa where EGL is missing."""

from __future__ import annotations

from typing import Literal

import moderngl


def create_context(backend: Literal["auto", "egl", "osmesa"] = "auto") -> moderngl.Context:
    """A standalone context of at least OpenGL 3.3.

    Raises:
        InputError: no OpenGL is installed; the message names the Debian packages.
    """
    return moderngl.create_context(standalone=True, backend="egl", require=330)
