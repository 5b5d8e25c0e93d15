"""Projection of Gaussians in one kernel.

Source: docs/rendering.md, sections 1 to 3; `pansplat.rendering.projection.project_gaussians` is its reference. The
kernel moves a third of a kilobyte for each Gaussian; the same arithmetic in torch operations moves 7 kB. Geometry is
float64 for Gaussians of any type.
"""
# ruff: noqa: RUF005  # Triton does not unpack into a tuple

import math
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from pansplat.constants import MIN_COMPENSATION
from pansplat.rendering.projection import ProjectedGaussians

# --- vectors and symmetric matrices (xx, xy, xz, yy, yz, zz) as tuples of blocks; a camera is cam2world, row by row ---


@triton.jit
@no_type_check
def load_numbers(pointer, NUM: tl.constexpr):
    """Load NUM adjacent scalars as a tuple."""
    numbers = ()
    for k in tl.static_range(NUM):
        numbers = numbers + (tl.load(pointer + k),)
    return numbers


@triton.jit
@no_type_check
def load_fields(pointer, index, mask, NUM: tl.constexpr):
    """Load NUM numbers of each row in `index`, as a tuple of float64 blocks."""
    fields = ()
    for k in tl.static_range(NUM):
        fields = fields + (tl.load(pointer + index * NUM + k, mask=mask, other=0.0).to(tl.float64),)
    return fields


@triton.jit
@no_type_check
def store_fields(pointer, index, mask, fields, NUM: tl.constexpr):
    """Store NUM numbers of each row in `index`, in the table's type."""
    for k in tl.static_range(NUM):
        tl.store(pointer + index * NUM + k, fields[k], mask=mask)


@triton.jit
@no_type_check
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
@no_type_check
def rotate_to_camera(camera, vector):
    """Rotate a vector from world to camera axes."""
    return (
        camera[0] * vector[0] + camera[4] * vector[1] + camera[8] * vector[2],
        camera[1] * vector[0] + camera[5] * vector[1] + camera[9] * vector[2],
        camera[2] * vector[0] + camera[6] * vector[1] + camera[10] * vector[2],
    )


@triton.jit
@no_type_check
def rotate_to_world(camera, vector):
    """Rotate a vector from camera to world axes."""
    return (
        camera[0] * vector[0] + camera[1] * vector[1] + camera[2] * vector[2],
        camera[4] * vector[0] + camera[5] * vector[1] + camera[6] * vector[2],
        camera[8] * vector[0] + camera[9] * vector[1] + camera[10] * vector[2],
    )


@triton.jit
@no_type_check
def symmetric_part(m):
    """The symmetric part of a matrix, which is given row by row."""
    return m[0], 0.5 * (m[1] + m[3]), 0.5 * (m[2] + m[6]), m[4], 0.5 * (m[5] + m[7]), m[8]


@triton.jit
@no_type_check
def bilinear(c, a, b):
    """a' C b of a symmetric matrix."""
    return (
        a[0] * (c[0] * b[0] + c[1] * b[1] + c[2] * b[2])
        + a[1] * (c[1] * b[0] + c[3] * b[1] + c[4] * b[2])
        + a[2] * (c[2] * b[0] + c[4] * b[1] + c[5] * b[2])
    )


@triton.jit
@no_type_check
def multiply(c, b):
    """C b of a symmetric matrix."""
    return (
        c[0] * b[0] + c[1] * b[1] + c[2] * b[2],
        c[1] * b[0] + c[3] * b[1] + c[4] * b[2],
        c[2] * b[0] + c[4] * b[1] + c[5] * b[2],
    )


@triton.jit
@no_type_check
def tangent_frame(direction):
    """Two unit vectors that form a frame with a unit direction (Duff et al., as in the reference)."""
    x, y, z = direction[0], direction[1], direction[2]
    sign = tl.where(z < 0, -1.0, 1.0).to(tl.float64)
    a = -1 / (sign + z)
    return (1 + sign * x * x * a, sign * x * y * a, -sign * x), (x * y * a, sign + y * y * a, -y)


# --- shape before the filter, divided by the distance (section 1) ---


@triton.jit
@no_type_check
def rotation_axes(quats, index, mask):
    """Columns of the rotation matrix of a quaternion of any length; the zero quaternion is the identity."""
    quat = load_fields(quats, index, mask, 4)
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
def shape_from_axes(quats, scales, camera, radius, direction, index, mask):
    """Compute C in camera axes, and det B, tr B, g, M, det C, by sums of squares, without cancellation."""
    axes = rotation_axes(quats, index, mask)
    scale = load_fields(scales, index, mask, 3)
    size = (scale[0] / radius, scale[1] / radius, scale[2] / radius)
    zero = radius * 0
    c = (zero, zero, zero, zero, zero, zero)
    det_across, trace, radial_variance, mixed = zero, zero, zero, zero
    for k in tl.static_range(3):
        axis = rotate_to_camera(camera, axes[k])
        square = size[k] * size[k]
        cosine = dot(direction, axis)
        minor = size[(k + 1) % 3] * size[(k + 2) % 3]
        det_across += minor * minor * (cosine * cosine)
        mixed += minor * minor * (1 - cosine * cosine)
        radial_variance += square * (cosine * cosine)
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
    return c, (det_across, trace, radial_variance, mixed, product * product)


@triton.jit
@no_type_check
def rotate_to_frame(c, u, v, n):
    """Transform a symmetric matrix to a frame: entries uu, uv, un, vv, vn, nn."""
    return (
        bilinear(c, u, u),
        bilinear(c, u, v),
        bilinear(c, u, n),
        bilinear(c, v, v),
        bilinear(c, v, n),
        bilinear(c, n, n),
    )


# --- spherical harmonics ---


def _norm(rational: float) -> tl.constexpr:
    return tl.constexpr(math.sqrt(rational / math.pi))


_FLAT: tl.constexpr = _norm(0.25)
_LINEAR: tl.constexpr = _norm(0.75)
_SQUARE: tl.constexpr = _norm(3.75)
_SQUARE_M0: tl.constexpr = _norm(0.3125)
_CUBE_M0: tl.constexpr = _norm(0.4375)
_CUBE_M1: tl.constexpr = _norm(0.65625)
_CUBE_M2: tl.constexpr = _norm(26.25)
_CUBE_M3: tl.constexpr = _norm(1.09375)
_FOURTH_M0: tl.constexpr = _norm(0.03515625)
_FOURTH_M1: tl.constexpr = _norm(1.40625)
_FOURTH_M2: tl.constexpr = _norm(2.8125)
_FOURTH_M3: tl.constexpr = _norm(9.84375)
_FOURTH_M4: tl.constexpr = _norm(19.6875)


@triton.jit
@no_type_check
def harmonics_basis(x, y, z, DEGREE: tl.constexpr):
    """Harmonics of degree 0 to DEGREE at unit directions, (DEGREE + 1)^2 blocks in a tuple."""
    xx, yy, zz = x * x, y * y, z * z
    basis = (x * 0 + _FLAT,)
    if DEGREE >= 1:
        basis = basis + (-y * _LINEAR, z * _LINEAR, -x * _LINEAR)
    if DEGREE >= 2:
        basis = basis + (
            x * y * _SQUARE,
            -y * z * _SQUARE,
            (2 * zz - xx - yy) * _SQUARE_M0,
            -x * z * _SQUARE,
            (xx - yy) * (0.5 * _SQUARE),
        )
    if DEGREE >= 3:
        basis = basis + (
            -y * (3 * xx - yy) * _CUBE_M3,
            x * y * z * _CUBE_M2,
            -y * (4 * zz - xx - yy) * _CUBE_M1,
            z * (2 * zz - 3 * xx - 3 * yy) * _CUBE_M0,
            -x * (4 * zz - xx - yy) * _CUBE_M1,
            z * (xx - yy) * (0.5 * _CUBE_M2),
            -x * (xx - 3 * yy) * _CUBE_M3,
        )
    if DEGREE >= 4:
        basis = basis + (
            x * y * (xx - yy) * _FOURTH_M4,
            -y * z * (3 * xx - yy) * _FOURTH_M3,
            x * y * (7 * zz - 1) * _FOURTH_M2,
            -y * z * (7 * zz - 3) * _FOURTH_M1,
            (zz * (35 * zz - 30) + 3) * _FOURTH_M0,
            -x * z * (7 * zz - 3) * _FOURTH_M1,
            (xx - yy) * (7 * zz - 1) * (0.5 * _FOURTH_M2),
            -x * z * (xx - 3 * yy) * _FOURTH_M3,
            (xx * (xx - 3 * yy) - yy * (3 * xx - yy)) * (0.25 * _FOURTH_M4),
        )
    return basis


# --- the kernel ---


_BLOCK_SIZE = 128
"""Gaussians of one program: one for each thread, which needs 90 to 120 registers in float64."""

MIN_RATIO: tl.constexpr = tl.constexpr(MIN_COMPENSATION)


@triton.jit
@no_type_check
def compute_ray_rows(c, right, down, direction, e2, det):
    """Compute rows a, b, l of section 3 from C before the filter and det B' after it."""
    uu, uv, vv = bilinear(c, right, right) + e2, bilinear(c, right, down), bilinear(c, down, down) + e2
    un, vn = bilinear(c, right, direction), bilinear(c, down, direction)
    first, second, slant = 1 / tl.sqrt(uu), tl.sqrt(uu / det), uv / uu
    p_u, p_v = (uv * vn - vv * un) / det, (uv * un - uu * vn) / det
    rows = ()
    for k in tl.static_range(3):
        rows = rows + (right[k] * first,)
    for k in tl.static_range(3):
        rows = rows + ((down[k] - slant * right[k]) * second,)
    for k in tl.static_range(3):
        rows = rows + (direction[k] + p_u * right[k] + p_v * down[k],)
    return rows


# fmt: off
@triton.jit(do_not_specialize=["num"])
@no_type_check
def project_kernel(
    means, opacities, harmonics, quats, scales, camera,
    directions, radii, covariances, peaks, values, rows, radial_variances, num,
    DEGREE: tl.constexpr, CHANNELS: tl.constexpr, EXACT: tl.constexpr, BLOCK: tl.constexpr,
):
    """Write the fields of `ProjectedGaussians`. `camera` is cam2world, row by row, then e^2."""
    index = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    mask = index < num
    pose = load_numbers(camera, 17)
    e2 = pose[16]
    mean = load_fields(means, index, mask, 3)
    offset = (mean[0] - pose[3], mean[1] - pose[7], mean[2] - pose[11])
    radius = tl.where(mask, tl.sqrt(dot(offset, offset)), 1.0)
    world = (offset[0] / radius, offset[1] / radius, offset[2] / radius)
    direction = rotate_to_camera(pose, world)
    x, y, z = direction[0], direction[1], direction[2]
    right, down = tangent_frame(direction)
    c, minors = shape_from_axes(quats, scales, pose, radius, direction, index, mask)
    det = minors[0] + e2 * minors[1] + e2 * e2
    peak = tl.load(opacities + index, mask=mask, other=0.0).to(tl.float64)
    if EXACT:
        peak = peak * tl.sqrt(tl.maximum(minors[0] / det, MIN_RATIO))
        tl.store(radial_variances + index, (e2 * e2 * minors[2] + e2 * minors[3] + minors[4]) / det, mask=mask)
        store_fields(rows, index, mask, compute_ray_rows(c, right, down, direction, e2, det), 9)
    tl.store(peaks + index, peak, mask=mask)
    xx, xy, xz = c[0] + e2 * (1 - x * x), c[1] - e2 * x * y, c[2] - e2 * x * z
    yy, yz, zz = c[3] + e2 * (1 - y * y), c[4] - e2 * y * z, c[5] + e2 * (1 - z * z)
    store_fields(covariances, index, mask, (xx, xy, xz, xy, yy, yz, xz, yz, zz), 9)
    store_fields(directions, index, mask, direction, 3)
    tl.store(radii + index, radius, mask=mask)
    dtype = values.dtype.element_ty
    basis = harmonics_basis(world[0].to(dtype), world[1].to(dtype), world[2].to(dtype), DEGREE)
    TERMS: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    for channel in tl.static_range(CHANNELS):
        colour = radius.to(dtype) * 0 + 0.5
        for k in tl.static_range(TERMS):
            place = (index * TERMS + k) * CHANNELS + channel
            colour += basis[k] * tl.load(harmonics + place, mask=mask, other=0.0)
        tl.store(values + index * (CHANNELS + 1) + channel, tl.maximum(colour, 0.0), mask=mask)
    tl.store(values + index * (CHANNELS + 1) + CHANNELS, radius, mask=mask)
# fmt: on


def project_forward(
    cam2world: Float[Tensor, "4 4"],
    fields: tuple[Tensor, ...],
    filter_variance: float,
    *,
    exact: bool,
) -> ProjectedGaussians:
    """Project Gaussians; see `pansplat.rendering.projection.project_gaussians`.

    Args:
        fields: means, opacities, harmonics, quats, scales; all contiguous.
    """
    means, opacities, harmonics, quats, scales = fields
    count, terms, channels = harmonics.shape
    camera = torch.nn.functional.pad(cam2world.reshape(-1), (0, 1), value=filter_variance)
    double: Any = dict(dtype=torch.float64, device=means.device)
    out = ProjectedGaussians(
        direction=torch.empty(count, 3, **double),
        radius=torch.empty(count, **double),
        covariance=torch.empty(count, 3, 3, **double),
        peak=torch.empty_like(opacities),
        values=means.new_empty(count, channels + 1),
        rows=means.new_empty(count, 3 if exact else 0, 3),
        radial_variance=torch.zeros_like(opacities),
    )
    if count:
        project_kernel[(triton.cdiv(count, _BLOCK_SIZE),)](
            means, opacities, harmonics, quats, scales, camera, out.direction, out.radius,
            out.covariance, out.peak, out.values, out.rows, out.radial_variance, count,
            DEGREE=round(terms**0.5) - 1, CHANNELS=channels, EXACT=exact, BLOCK=_BLOCK_SIZE, num_warps=4,
        )  # fmt: skip
    return out
