"""Stage one: Gaussians projected to records and values, once per camera.

Source: docs/rendering.md, sections 1 to 3; records.py for the layout. Arithmetic is float64, on vectors of eight
Gaussians. A block is `GAUSSIAN_BLOCK` Gaussians here, a work item `GAUSSIANS_PER_ITEM`. Lengths are divided by the
distance.

A covariance in the tangent frame (u, v, n) is a tuple, `cov`, of its entries and minors. The minors are computed
separately, because the entries would cancel:

    uu, uv, vv, un, vn, nn    C in the frame
    det_across                det B
    mixed                     M = nn (uu + vv) - un^2 - vn^2
    det                       det C
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from pansplat.constants import EXPOSURE_WAY, MAX_MAGNITUDE, MAX_SCALE_RATIO, MIN_COMPENSATION, OPACITY_CUT
from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.harmonics import evaluate_basis, evaluate_colors
from pansplat.rendering.cpu.simd import (
    LANES,
    broadcast,
    load_row,
    mantissa_and_exponent,
    select,
    soa_to_records,
    store,
    store_mask,
    store_row,
    store_scalar,
    to_f32,
    to_f64,
)
from pansplat.system.kernels import Workspace, inline_kernel, kernel, parallel_for

GAUSSIAN_BLOCK = 64
GAUSSIANS_PER_ITEM = 8192
CULLED = -128.0  # log2_peak that marks a Gaussian as culled

# Rows of a block: inputs and results.
MEAN_ROW, SHAPE_ROW, OPACITY_ROW = 0, 3, 10  # the shape is a quaternion and three scales
DIRECTION_ROW, RADIUS_ROW, VALID_ROW = 11, 14, 15  # world axes; metres; 1, or 0 if a number is unusable
NUM_ROWS = 16


class GaussianArrays(NamedTuple):
    """Gaussians as arrays.

    Attributes:
        means: (n, 3), metres.
        quats: (n, 4), wxyz, of any length.
        scales: (n, 3), metres.
        opacities: (n,).
        harmonics: (n, k, 3).
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray

    @classmethod
    def from_tensors(cls, tensors: Sequence[Any]) -> "GaussianArrays":
        """The arrays of float32 tensors."""
        return cls(*(tensor.detach().numpy() for tensor in tensors))

    @property
    def view_dependent(self) -> bool | None:
        """True if colours depend on the direction, else None: numba does not compile code that depends on a None."""
        return True if self.harmonics.shape[1] > 1 else None


class Camera(NamedTuple):
    """A camera, and the settings that depend on the image size.

    Attributes:
        pose: cam2world, (4, 4) float64.
        filter_variance: e^2, added across the ray, radians^2; above 0.
        near: metres.
    """

    pose: np.ndarray
    filter_variance: float
    near: float


class ProjectedGaussians(NamedTuple):
    """The Gaussians as one camera sees them.

    Attributes:
        records, values: see records.py; `log2_peak` is `CULLED` if a Gaussian is culled.
        radii: (n,) float64, metres.
        kept: (n,) uint8, 0 for culled Gaussians.
    """

    records: np.ndarray
    values: np.ndarray
    radii: np.ndarray
    kept: np.ndarray


def project_gaussians(
    gaussians: GaussianArrays,
    camera: Camera,
    workspace: Workspace,
    threads: int,
    shift: Sequence[float] = (0.0, 0.0, 0.0),
) -> ProjectedGaussians:
    """Project all Gaussians; the arrays belong to the workspace.

    Args:
        shift: movement of the camera during the exposure, metres, axes of the means: Gaussians blur along it.
    """
    num = len(gaussians.means)
    records, radii = workspace.array((num, layout.RECORD_SIZE), np.float32), workspace.array(num, np.float64)
    values, kept = workspace.array((num, 4), np.float32), workspace.array(num, np.uint8)
    coefficients = gaussians.harmonics.reshape(num, 3 * gaussians.harmonics.shape[1])
    work = partial(
        _project_gaussians, *gaussians, coefficients, *camera, np.array(shift) / EXPOSURE_WAY,
        gaussians.view_dependent, records.reshape(-1), values, radii, kept,
    )  # fmt: skip
    parallel_for(work, -(-num // GAUSSIANS_PER_ITEM), threads)
    return ProjectedGaussians(records, values, radii, kept)


@kernel
def _project_gaussians(
    means, quats, scales, opacities, harmonics, coefficients,
    pose, filter_variance, near, shift, view_dependent, records, values, radii, kept, item,
):  # fmt: skip
    rows, block_kept = np.ones((NUM_ROWS, GAUSSIAN_BLOCK)), np.empty(GAUSSIAN_BLOCK, np.uint8)
    basis, soa = np.empty((25, GAUSSIAN_BLOCK), np.float32), np.empty(layout.RECORD_SIZE * LANES, np.float32)
    camera, motion = pose_columns(pose), (shift[0], shift[1], shift[2])
    for start in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, means.shape[0]), GAUSSIAN_BLOCK):
        count = min(GAUSSIAN_BLOCK, means.shape[0] - start)
        load_block(means, quats, scales, opacities, start, count, rows)
        _mark_usable(coefficients, start, count, rows)
        for i in range(0, count, LANES):
            store_mask(block_kept, i, _compute_records(camera, motion, filter_variance, near, rows, i, soa))
            soa_to_records(soa, LANES, start + i, min(LANES, count - i), records)
        for i in range(count):
            store_scalar(radii, start + i, rows[RADIUS_ROW, i])
        for i in range(count):
            store_scalar(kept, start + i, block_kept[i])
        evaluate_basis(rows, DIRECTION_ROW, harmonics.shape[1], view_dependent, basis)
        evaluate_colors(harmonics, start, count, basis, rows, RADIUS_ROW, values)


@inline_kernel
def _compute_records(pose, shift, filter_variance, near, rows, i, soa):
    """Write the records of eight Gaussians, a row of `soa` per field; return which are kept."""
    unit, inverse_unit = math.sqrt(layout.HALF_LOG2_E), 1 / math.sqrt(layout.HALF_LOG2_E)
    n, radius, inverse = compute_direction(rows, i, pose)
    store_row(rows, RADIUS_ROW, i, radius)
    u, v, cov, usable = compute_tangent_covariance(rows, i, n, inverse)
    moved = _add_motion(cov, dot(*u, *shift) * inverse, dot(*v, *shift) * inverse)
    factors, l_along_a, l_along_b, radial_variance, _, inverse_det = compute_whitening(moved, filter_variance)
    a, b = whitened_axes(u, v, factors)
    store_vector(rows, DIRECTION_ROW, i, n)
    x, y, z = to_axes(pose, n)
    _store_fields(soa, layout.DIRECTION, 1.0, (x, y, z))
    residual = x - to_f64(to_f32(x)), y - to_f64(to_f32(y)), z - to_f64(to_f32(z))
    _store_fields(soa, layout.DIRECTION_RESIDUAL, 1.0, residual)
    _store_fields(soa, layout.ROW_A, unit, to_axes(pose, a))
    _store_fields(soa, layout.ROW_B, unit, to_axes(pose, b))
    store(soa, layout.L_ALONG_A * LANES, to_f32(inverse_unit * l_along_a))
    store(soa, layout.L_ALONG_B * LANES, to_f32(inverse_unit * l_along_b))
    store(soa, layout.RADIAL_VARIANCE * LANES, to_f32((1 / layout.HALF_LOG2_E) * radial_variance))
    opacity = load_row(rows, OPACITY_ROW, i)
    squared_peak = opacity * opacity * max(cov[6] * inverse_det, MIN_COMPENSATION)
    kept = usable & (radius >= near) & (load_row(rows, VALID_ROW, i) > 0) & (opacity >= OPACITY_CUT)
    log2_peak = select(kept, 0.5 * _log2(select(kept, squared_peak, broadcast(1.0))), broadcast(CULLED))
    store(soa, layout.LOG2_PEAK * LANES, to_f32(log2_peak))
    return kept


@inline_kernel
def _store_fields(soa, field, factor, vector):
    """Store three fields, rounded to float32."""
    store(soa, field * LANES, to_f32(factor * vector[0]))
    store(soa, (field + 1) * LANES, to_f32(factor * vector[1]))
    store(soa, (field + 2) * LANES, to_f32(factor * vector[2]))


@inline_kernel
def _log2(value):
    """Log2 of numbers above 0, within 1e-9."""
    mantissa, exponent = mantissa_and_exponent(value)
    s = (mantissa - 1) / (mantissa + 1)
    t = s * s
    series = 1 + t * (1 / 3 + t * (1 / 5 + t * (1 / 7 + t * (1 / 9))))
    return exponent + (2 / math.log(2)) * s * series


# --- loading a block ---


@inline_kernel
def load_block(means, quats, scales, opacities, start, count, rows):
    """Load the fields of `count` Gaussians from `start` on into rows."""
    for i in range(count):
        for axis in range(3):
            rows[MEAN_ROW + axis, i] = means[start + i, axis]
            rows[SHAPE_ROW + 4 + axis, i] = scales[start + i, axis]
        for axis in range(4):
            rows[SHAPE_ROW + axis, i] = quats[start + i, axis]
        rows[OPACITY_ROW, i] = opacities[start + i]


@inline_kernel
def _mark_usable(coefficients, start, count, rows):
    """Mark the Gaussians of a block as valid if all their numbers are finite and small enough.

    Args:
        coefficients: (n, numbers), the harmonics.
    """
    for i in range(GAUSSIAN_BLOCK):
        rows[VALID_ROW, i] = 1.0
    for row in range(MEAN_ROW, OPACITY_ROW + 1):
        for i in range(count):
            rows[VALID_ROW, i] *= abs(rows[row, i]) < MAX_MAGNITUDE
    for i in range(count):
        usable = True
        for j in range(coefficients.shape[1]):
            usable &= abs(coefficients[start + i, j]) < MAX_MAGNITUDE
        rows[VALID_ROW, i] *= usable


# --- direction, frame and covariance of eight Gaussians ---


@inline_kernel
def load_vector(rows, row, i):
    """Eight 3-vectors, from three rows."""
    return load_row(rows, row, i), load_row(rows, row + 1, i), load_row(rows, row + 2, i)


@inline_kernel
def store_vector(rows, row, i, vector):
    """Write eight 3-vectors to three rows."""
    store_row(rows, row, i, vector[0])
    store_row(rows, row + 1, i, vector[1])
    store_row(rows, row + 2, i, vector[2])


@inline_kernel
def matrix_columns(matrix):
    """Three columns of a matrix as numbers; an array would be read again for each vector of Gaussians."""
    return (
        (matrix[0, 0], matrix[1, 0], matrix[2, 0]),
        (matrix[0, 1], matrix[1, 1], matrix[2, 1]),
        (matrix[0, 2], matrix[1, 2], matrix[2, 2]),
    )


@inline_kernel
def pose_columns(pose):
    """The camera's axes and its centre."""
    return (*matrix_columns(pose), (pose[0, 3], pose[1, 3], pose[2, 3]))


@inline_kernel
def compute_direction(rows, i, pose):
    """Direction, distance, and one over the distance."""
    mx, my, mz = load_vector(rows, MEAN_ROW, i)
    x, y, z = mx - pose[3][0], my - pose[3][1], mz - pose[3][2]
    radius = math.sqrt(x * x + y * y + z * z)
    inverse = 1 / radius
    return (x * inverse, y * inverse, z * inverse), radius, inverse


@inline_kernel
def compute_tangent_covariance(rows, i, n, inverse):
    """Tangent axes u and v, the covariance, and whether the shape is usable.

    Args:
        n: directions.
        inverse: one over the distance.
    """
    frame = tangent_frame(n[0], n[1], n[2])
    u, v = (frame[0], frame[1], frame[2]), (frame[3], frame[4], frame[5])
    cov, usable = _covariance_of_axes(rows, i, u, n, inverse)
    return u, v, cov, usable


@inline_kernel
def load_axes(rows, i):
    """The columns of the rotation of eight Gaussians, and one over the squared length of their quaternions."""
    r = _rotation(load_row(rows, SHAPE_ROW, i), *load_vector(rows, SHAPE_ROW + 1, i))
    return (r[0], r[3], r[6]), (r[1], r[4], r[7]), (r[2], r[5], r[8]), r[9]


@inline_kernel
def _rotation(w, x, y, z):
    """Rotation matrix, by rows, of a quaternion of any length, and one over its square; zero gives the identity."""
    norm2 = w * w + x * x + y * y + z * z
    inverse = select(norm2 > 0, 1 / norm2, broadcast(0.0))
    twice = 2 * inverse
    x2, y2, z2 = twice * x, twice * y, twice * z
    return (
        1 - (y * y2 + z * z2), x * y2 - w * z2, x * z2 + w * y2,
        x * y2 + w * z2, 1 - (x * x2 + z * z2), y * z2 - w * x2,
        x * z2 - w * y2, y * z2 + w * x2, 1 - (x * x2 + y * y2),
        inverse,
    )  # fmt: skip


@inline_kernel
def _covariance_of_axes(rows, i, u, n, inverse):
    """The covariance of rotations and scales, as sums of squares, without cancellation."""
    s0, s1, s2 = load_vector(rows, SHAPE_ROW + 4, i)
    e0, e1, e2, _ = load_axes(rows, i)
    s0, s1, s2 = s0 * inverse, s1 * inverse, s2 * inverse
    s0, s1, s2 = s0 * s0, s1 * s1, s2 * s2
    u0, u1, u2 = dot(*u, *e0), dot(*u, *e1), dot(*u, *e2)
    n0, n1, n2 = dot(*n, *e0), dot(*n, *e1), dot(*n, *e2)
    v0, v1, v2 = cross(n0, n1, n2, u0, u1, u2)
    w0, w1, w2 = s1 * s2, s2 * s0, s0 * s1
    return (
        s0 * u0 * u0 + s1 * u1 * u1 + s2 * u2 * u2,
        s0 * u0 * v0 + s1 * u1 * v1 + s2 * u2 * v2,
        s0 * v0 * v0 + s1 * v1 * v1 + s2 * v2 * v2,
        s0 * u0 * n0 + s1 * u1 * n1 + s2 * u2 * n2,
        s0 * v0 * n0 + s1 * v1 * n1 + s2 * v2 * n2,
        s0 * n0 * n0 + s1 * n1 * n1 + s2 * n2 * n2,
        w0 * n0 * n0 + w1 * n1 * n1 + w2 * n2 * n2,
        w0 * (u0 * u0 + v0 * v0) + w1 * (u1 * u1 + v1 * v1) + w2 * (u2 * u2 + v2 * v2),
        s0 * w0,
    ), max(max(s0, s1), s2) <= MAX_SCALE_RATIO * MAX_SCALE_RATIO


@inline_kernel
def _add_motion(cov, x, y):
    """The covariance of Gaussians that move across the ray, by x along u and y along v."""
    uu, uv, vv, un, vn, nn, det_across, mixed, det = cov
    xx, xy, yy = x * x, x * y, y * y
    across = vv * xx - 2 * uv * xy + uu * yy
    along = (vv * nn - vn * vn) * xx + 2 * (un * vn - uv * nn) * xy + (uu * nn - un * un) * yy
    return uu + xx, uv + xy, vv + yy, un, vn, nn, det_across + across, mixed + nn * (xx + yy), det + along


@inline_kernel
def compute_whitening(cov, filter_variance):
    """The factors of `whitened_axes`, the components of l along a and b, S', det B' and one over it."""
    _, uv, _, un, vn, nn, det_across, mixed, det = cov
    b_uu, trace = cov[0] + filter_variance, cov[0] + cov[2]
    det_filtered = det_across + filter_variance * trace + filter_variance * filter_variance
    inverse = 1 / det_filtered
    a_scale, b_scale = 1 / math.sqrt(b_uu), math.sqrt(b_uu * inverse)
    mix = uv * a_scale * a_scale
    radial_variance = (filter_variance * filter_variance * nn + filter_variance * mixed + det) * inverse
    return (a_scale, mix, b_scale), -un * a_scale, (mix * un - vn) * b_scale, radial_variance, det_filtered, inverse


@inline_kernel
def whitened_axes(u, v, factors):
    """The footprint rows a and b."""
    a_scale, mix, b_scale = factors
    a = u[0] * a_scale, u[1] * a_scale, u[2] * a_scale
    return a, ((v[0] - mix * u[0]) * b_scale, (v[1] - mix * u[1]) * b_scale, (v[2] - mix * u[2]) * b_scale)


# --- vector algebra, for float64 and f64x8 ---


@inline_kernel
def to_axes(axes, vector):
    """A vector along each of three axes."""
    return dot(*axes[0], *vector), dot(*axes[1], *vector), dot(*axes[2], *vector)


@inline_kernel
def from_axes(axes, vector):
    """The vector with these components along three axes."""
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = axes[0], axes[1], axes[2]
    x, y, z = vector
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


@inline_kernel
def dot(ax, ay, az, bx, by, bz):
    """a . b"""
    return ax * bx + ay * by + az * bz


@inline_kernel
def cross(ax, ay, az, bx, by, bz):
    """a ^ b"""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inline_kernel
def tangent_frame(x, y, z):
    """Two unit vectors u, v that make a right-handed frame with the unit direction.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
    """
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b, c = x * y * a, sign * x
    return 1 + c * x * a, sign * b, -c, b, sign + y * y * a, -y
