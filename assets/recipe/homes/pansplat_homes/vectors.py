"""Vectors and colours as tuples of three numbers, for compiled code."""

from __future__ import annotations

from typing import Any

import numba as nb

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
INLINE = OPTIONS | {"forceinline": True}  # calls would copy the arrays of a scene, more than a kilobyte


@nb.njit(**INLINE)
def take(row, k):
    """Three numbers of a row, from column k on."""
    return row[k], row[k + 1], row[k + 2]


@nb.njit(**INLINE)
def unit(x):
    """A number clipped to [0, 1]."""
    return min(1.0, max(0.0, x))


@nb.njit(**INLINE)
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@nb.njit(**INLINE)
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@nb.njit(**INLINE)
def subtract(a, b):
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@nb.njit(**INLINE)
def multiply(a, b):
    """Products of the components."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@nb.njit(**INLINE)
def scale(a, t):
    """t a."""
    return a[0] * t, a[1] * t, a[2] * t


@nb.njit(**INLINE)
def advance(a, t, b):
    """a + t b."""
    return a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]


@nb.njit(**INLINE)
def mix(a, b, t):
    """a at t = 0, b at t = 1."""
    return a[0] * (1 - t) + b[0] * t, a[1] * (1 - t) + b[1] * t, a[2] * (1 - t) + b[2] * t
