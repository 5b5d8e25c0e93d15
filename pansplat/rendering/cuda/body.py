"""A Gaussian's shape as a camera sees it, before the filter and divided by its distance: device code.

Source: docs/rendering.md, section 1.
"""

from typing import no_type_check

import triton
import triton.language as tl

from pansplat.rendering.cuda.vectors import dot, load_fields, products, symmetric, turn


@triton.jit
@no_type_check
def own_axes(quats, at, there):
    """Columns of the rotation of quaternions of any length; the zero quaternion is the identity."""
    quat = load_fields(quats, at, there, 4)
    norm = tl.sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    safe = tl.where(norm > 0, norm, 1.0)
    w = tl.where(norm > 0, quat[0] / safe, 1.0)
    x, y, z = quat[1] / safe, quat[2] / safe, quat[3] / safe
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@triton.jit
@no_type_check
def from_axes(quats, scales, camera, radius, direction, at, there):
    """C in camera axes; det B, tr B, g, M and det C of section 1: sums of squares only, so nothing cancels."""
    axes = own_axes(quats, at, there)
    scale = load_fields(scales, at, there, 3)
    size = (scale[0] / radius, scale[1] / radius, scale[2] / radius)
    zero = radius * 0
    c = (zero, zero, zero, zero, zero, zero)
    det_across, trace, along, mixed = zero, zero, zero, zero
    for k in tl.static_range(3):
        axis = turn(camera, axes[k])
        square = size[k] * size[k]
        cosine = dot(direction, axis)
        minor = size[(k + 1) % 3] * size[(k + 2) % 3]
        det_across += minor * minor * (cosine * cosine)
        mixed += minor * minor * (1 - cosine * cosine)
        along += square * (cosine * cosine)
        trace += square * (1 - cosine * cosine)
        c = (
            c[0] + square * axis[0] * axis[0],
            c[1] + square * axis[0] * axis[1],
            c[2] + square * axis[0] * axis[2],
            c[3] + square * axis[1] * axis[1],
            c[4] + square * axis[1] * axis[2],
            c[5] + square * axis[2] * axis[2],
        )
    product = size[0] * size[1] * size[2]
    return c, (det_across, trace, along, mixed, product * product)


@triton.jit
@no_type_check
def in_frame(c, u, v, n):
    """Numbers uu, uv, un, vv, vn, nn of a symmetric matrix in a frame."""
    return (
        products(c, u, u),
        products(c, u, v),
        products(c, u, n),
        products(c, v, v),
        products(c, v, n),
        products(c, n, n),
    )


@triton.jit
@no_type_check
def from_covariance(covariances, camera, radius, right, down, direction, at, there):
    """The same from world covariances; what rounding made negative counts as zero."""
    world = symmetric(load_fields(covariances, at, there, 9))
    # Row j of cam2world' is column j of cam2world.
    x, y, z = (camera[0], camera[4], camera[8]), (camera[1], camera[5], camera[9]), (camera[2], camera[6], camera[10])
    square = radius * radius
    c = (
        products(world, x, x) / square,
        products(world, x, y) / square,
        products(world, x, z) / square,
        products(world, y, y) / square,
        products(world, y, z) / square,
        products(world, z, z) / square,
    )
    uu, uv, un, vv, vn, nn = in_frame(c, right, down, direction)
    det = uu * (vv * nn - vn * vn) - uv * (uv * nn - vn * un) + un * (uv * vn - vv * un)
    return c, (
        tl.maximum(uu * vv - uv * uv, 0.0),
        tl.maximum(uu + vv, 0.0),
        tl.maximum(nn, 0.0),
        tl.maximum(nn * (uu + vv) - un * un - vn * vn, 0.0),
        tl.maximum(det, 0.0),
    )
