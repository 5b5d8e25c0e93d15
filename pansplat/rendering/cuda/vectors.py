"""Vectors and symmetric matrices as tuples of blocks: device code.

Convention: a symmetric matrix is xx, xy, xz, yy, yz, zz; a camera is cam2world, row by row.
"""
# ruff: noqa: RUF005  # Triton does not unpack into a tuple

from typing import no_type_check

import triton
import triton.language as tl


@triton.jit
@no_type_check
def load_fields(pointer, at, there, NUM: tl.constexpr):
    """NUM numbers of each of some rows, as float64 blocks in a tuple."""
    fields = ()
    for k in tl.static_range(NUM):
        fields = fields + (tl.load(pointer + at * NUM + k, mask=there, other=0.0).to(tl.float64),)
    return fields


@triton.jit
@no_type_check
def store_fields(pointer, at, there, fields, NUM: tl.constexpr):
    """The opposite, in the table's type."""
    for k in tl.static_range(NUM):
        tl.store(pointer + at * NUM + k, fields[k], mask=there)


@triton.jit
@no_type_check
def dot(a, b):
    """Of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
@no_type_check
def turn(camera, vector):
    """A world vector in a camera's axes."""
    return (
        camera[0] * vector[0] + camera[4] * vector[1] + camera[8] * vector[2],
        camera[1] * vector[0] + camera[5] * vector[1] + camera[9] * vector[2],
        camera[2] * vector[0] + camera[6] * vector[1] + camera[10] * vector[2],
    )


@triton.jit
@no_type_check
def unturn(camera, vector):
    """A vector of a camera's axes in the world's."""
    return (
        camera[0] * vector[0] + camera[1] * vector[1] + camera[2] * vector[2],
        camera[4] * vector[0] + camera[5] * vector[1] + camera[6] * vector[2],
        camera[8] * vector[0] + camera[9] * vector[1] + camera[10] * vector[2],
    )


@triton.jit
@no_type_check
def symmetric(m):
    """The symmetric part of a matrix given row by row."""
    return m[0], 0.5 * (m[1] + m[3]), 0.5 * (m[2] + m[6]), m[4], 0.5 * (m[5] + m[7]), m[8]


@triton.jit
@no_type_check
def products(c, a, b):
    """a' C b of a symmetric matrix."""
    return (
        a[0] * (c[0] * b[0] + c[1] * b[1] + c[2] * b[2])
        + a[1] * (c[1] * b[0] + c[3] * b[1] + c[4] * b[2])
        + a[2] * (c[2] * b[0] + c[4] * b[1] + c[5] * b[2])
    )


@triton.jit
@no_type_check
def times(c, b):
    """C b of a symmetric matrix."""
    return (
        c[0] * b[0] + c[1] * b[1] + c[2] * b[2],
        c[1] * b[0] + c[3] * b[1] + c[4] * b[2],
        c[2] * b[0] + c[4] * b[1] + c[5] * b[2],
    )


@triton.jit
@no_type_check
def tangents(direction):
    """Two unit vectors that make a frame with a unit direction; Duff et al., as in the reference."""
    x, y, z = direction[0], direction[1], direction[2]
    sign = tl.where(z < 0, -1.0, 1.0).to(tl.float64)
    a = -1 / (sign + z)
    return (1 + sign * x * x * a, sign * x * y * a, -sign * x), (x * y * a, sign + y * y * a, -y)
