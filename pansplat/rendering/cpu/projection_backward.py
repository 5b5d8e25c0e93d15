"""Gradients of stage one: from those of records and values to those of the Gaussians and of the camera's pose.

Source: docs/rendering.md, sections 1 to 3, differentiated by hand. Rotating the rows a and b together about n does not
change an image, so their derivatives may differ by such a rotation; these are the symmetric ones. With p the axis dual
to a, q the axis dual to b, a change dn of the direction across n and a change dC of the covariance,

    X_aa = a'dC a + 2 alpha a.dn     X_ab = a'dC b + beta a.dn + alpha b.dn     X_bb = b'dC b + 2 beta b.dn
    da = -(X_aa a + X_ab b) / 2 - (a.dn) n
    dalpha = -(alpha X_aa + beta X_ab) / 2 + (g + e^2) a.dn - p.dn - a'dC n
    dS' = l'dC l - 2 (S' + e^2) (l - n).dn
    d ln det B' = X_aa + X_bb

and likewise for b; alpha and beta are the components of l along a and b. No term is divided by a footprint's width, so
the gradients of needles and discs are as accurate as the forward.
"""

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from pansplat.constants import MIN_COMPENSATION
from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.harmonics import accumulate_direction_gradients, backpropagate_colors, evaluate_basis
from pansplat.rendering.cpu.projection import (
    DIRECTION_ROW,
    GAUSSIAN_BLOCK,
    GAUSSIANS_PER_ITEM,
    MEAN_ROW,
    NUM_ROWS,
    OPACITY_ROW,
    RADIUS_ROW,
    SHAPE_ROW,
    Camera,
    GaussianArrays,
    ProjectedGaussians,
    compute_direction,
    compute_tangent_covariance,
    compute_whitening,
    cross,
    dot,
    from_axes,
    load_axes,
    load_block,
    load_vector,
    pose_columns,
    store_vector,
    whitened_axes,
)
from pansplat.rendering.cpu.simd import (
    LANES,
    broadcast,
    load,
    load_four,
    load_row,
    load_scalar,
    prefetch,
    records_to_soa,
    select,
    store,
    store_row,
    to_f64,
)
from pansplat.system.kernels import inline_kernel, kernel, parallel_for

_SLOTS_AHEAD = 32  # slots between the prefetch of a gradient and its use
_POSE_SIZE = 12  # entries of a pose: its rotation and its centre, by rows

# Rows of a block, after those of projection.py. All are gradients.
_RADIUS_GRAD_ROW = NUM_ROWS
_MEAN_GRAD_ROW = NUM_ROWS + 1  # gradient of n in world axes, then of the mean
_SHAPE_GRAD_ROW = NUM_ROWS + 4  # gradients of a quaternion and of three scales
_NUM_ROWS = NUM_ROWS + 11


class GaussianGradients(NamedTuple):
    """Gradients of `GaussianArrays`, float32; an array that is not needed has no rows. `pose` is (3, 4) float64."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray
    pose: np.ndarray


def backpropagate_projection(
    gaussians: GaussianArrays,
    camera: Camera,
    projected: ProjectedGaussians,
    grad_records: np.ndarray,
    grad_values: np.ndarray,
    offsets: np.ndarray,
    gradients: GaussianGradients,
    threads: int,
) -> GaussianGradients:
    """Write the gradients of the Gaussians and return them with that of the pose.

    Args:
        grad_records: (slot, RECORD_SIZE), of the camera's records.
        grad_values: (slot, 4).
        offsets: (n + 1), where each Gaussian's slots begin.
        gradients: arrays to write; arrays without rows are skipped.
    """
    num_items = -(-len(gaussians.means) // GAUSSIANS_PER_ITEM)
    pose_sums = np.zeros((num_items if len(gradients.pose) > 0 else 0, _POSE_SIZE))
    work = partial(
        _backpropagate_projection, *gaussians, *camera, gaussians.view_dependent, projected.kept,
        projected.values, grad_records.reshape(-1), grad_values.reshape(-1), offsets, *gradients[:5], pose_sums,
    )  # fmt: skip
    parallel_for(work, num_items, threads)
    if len(gradients.pose) == 0:
        return gradients
    pose = pose_sums.sum(axis=0).reshape(3, 4)
    pose[:, :3] = pose[:, :3] @ camera.pose[:3, :3]
    return gradients._replace(pose=pose)


def accumulate_slots(offsets: np.ndarray, slots: np.ndarray, totals: np.ndarray, threads: int) -> None:
    """Add each Gaussian's slots, in their order, to its row of `totals`."""
    parallel_for(partial(_accumulate_slots, offsets, slots, totals), -(-len(totals) // GAUSSIANS_PER_ITEM), threads)


@kernel
def _accumulate_slots(offsets, slots, totals, item):
    for g in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, totals.shape[0])):
        for slot in range(offsets[g], offsets[g + 1]):
            for j in range(totals.shape[1]):
                totals[g, j] += slots[slot, j]


@kernel
def _backpropagate_projection(
    means, quats, scales, opacities, harmonics, pose, filter_variance, near,
    view_dependent, scene_kept, values, grad_records, grad_values, offsets,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_harmonics, pose_sums, item,
):  # fmt: skip
    rows, camera = np.ones((_NUM_ROWS, GAUSSIAN_BLOCK)), pose_columns(pose)
    grad_pose = np.zeros((_POSE_SIZE if pose_sums.shape[0] > 0 else 0, LANES))
    record_sums = np.zeros(GAUSSIAN_BLOCK * layout.RECORD_SIZE, np.float32)
    value_sums = np.zeros(4 * GAUSSIAN_BLOCK + 4, np.float32)
    soa, kept = np.zeros((layout.RECORD_SIZE, GAUSSIAN_BLOCK), np.float32), np.zeros(GAUSSIAN_BLOCK, np.bool_)
    basis, grad_basis = np.zeros((25, GAUSSIAN_BLOCK), np.float32), np.zeros((25, GAUSSIAN_BLOCK), np.float32)
    for start in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, means.shape[0]), GAUSSIAN_BLOCK):
        count = min(GAUSSIAN_BLOCK, means.shape[0] - start)
        load_block(means, quats, scales, opacities, start, count, rows)
        _sum_slots(grad_records, grad_values, offsets, start, count, record_sums, value_sums, rows)
        records_to_soa(record_sums, 0, count, soa.reshape(-1), GAUSSIAN_BLOCK)
        _clear_culled(scene_kept, start, count, pose, rows, soa, kept)
        for i in range(0, GAUSSIAN_BLOCK, LANES):
            _backpropagate_records(camera, filter_variance, rows, soa.reshape(-1), grad_pose, i)
        evaluate_basis(rows, DIRECTION_ROW, harmonics.shape[1], view_dependent, basis)
        backpropagate_colors(harmonics, start, kept, basis, values, value_sums, grad_harmonics, grad_basis)
        accumulate_direction_gradients(
            rows, DIRECTION_ROW, harmonics.shape[1], view_dependent, grad_basis, _MEAN_GRAD_ROW
        )
        _backpropagate_means(rows, grad_pose)
        _write_gradients(rows, start, count, grad_means, grad_quats, grad_scales, grad_opacities)
    for j in range(grad_pose.shape[0]):
        total = 0.0
        for i in range(LANES):
            total += grad_pose[j, i]
        pose_sums[item, j] = total


# --- loading the gradients of a block ---


@inline_kernel
def _sum_slots(grad_records, grad_values, offsets, start, count, record_sums, value_sums, rows):
    """Sum the slots of each Gaussian of a block, in their order; 0 if it has none.

    Args:
        grad_records, grad_values: flat.
        record_sums: (RECORD_SIZE GAUSSIAN_BLOCK), written.
        value_sums: (4 GAUSSIAN_BLOCK + 4), written.
    """
    zero = broadcast(np.float32(0))
    for i in range(count):
        first, end = load_scalar(offsets, start + i), load_scalar(offsets, start + i + 1)
        low, high, values = zero, zero, zero
        prefetch(grad_records, layout.RECORD_SIZE * (first + _SLOTS_AHEAD))
        prefetch(grad_values, 4 * (first + _SLOTS_AHEAD))
        for slot in range(first, end):  # one loop, so that its end is mispredicted once
            low = low + load(grad_records, layout.RECORD_SIZE * slot)
            high = high + load(grad_records, layout.RECORD_SIZE * slot + LANES)
            values = values + load_four(grad_values, 4 * slot)
        store(value_sums, 4 * i, values)
        store(record_sums, layout.RECORD_SIZE * i, low)
        store(record_sums, layout.RECORD_SIZE * i + LANES, high)
    for i in range(GAUSSIAN_BLOCK):
        rows[_RADIUS_GRAD_ROW, i] = value_sums[4 * i + 3]


@inline_kernel
def _clear_culled(scene_kept, start, count, pose, rows, soa, kept):
    """Replace the numbers of culled Gaussians by finite ones, so that their gradients are 0 and not NaN."""
    missing = GAUSSIAN_BLOCK - count
    for i in range(count):
        kept[i] = load_scalar(scene_kept, start + i) != 0
        missing += load_scalar(scene_kept, start + i) == 0
    if missing == 0:
        return
    for i in range(GAUSSIAN_BLOCK):
        if i < count and kept[i]:
            continue
        kept[i] = False
        rows[MEAN_ROW, i], rows[MEAN_ROW + 1, i], rows[MEAN_ROW + 2, i] = pose[0, 3], pose[1, 3], pose[2, 3]
        rows[MEAN_ROW, i] += 1 + abs(pose[0, 3])
        rows[OPACITY_ROW, i], rows[_RADIUS_GRAD_ROW, i] = 1.0, 0.0
        for j in range(7):
            rows[SHAPE_ROW + j, i] = 1.0 if j % 4 == 0 else 0.0
        for j in range(layout.RECORD_SIZE):
            soa[j, i] = 0.0


# --- gradients of records, eight Gaussians at a time ---


@inline_kernel
def _backpropagate_records(pose, filter_variance, rows, soa, grad_pose, i):
    """Write the gradients of shapes, opacities, directions and distances, given those of records."""
    n, radius, inverse = compute_direction(rows, i, pose)
    u, v, cov, _ = compute_tangent_covariance(rows, i, n, inverse)
    g_n, parts, g_det = _backpropagate_footprint_rows(pose, filter_variance, u, v, n, cov, soa, i, grad_pose)
    g_n, g_radius = _backpropagate_axes(rows, i, u, n, inverse, g_n, parts, g_det)
    store_row(rows, _RADIUS_GRAD_ROW, i, load_row(rows, _RADIUS_GRAD_ROW, i) + g_radius)
    g_log_peak = (1 / math.log(2)) * _load_field(soa, layout.LOG2_PEAK, i)
    store_row(rows, OPACITY_ROW, i, g_log_peak / load_row(rows, OPACITY_ROW, i))
    store_row(rows, RADIUS_ROW, i, radius)
    store_vector(rows, _MEAN_GRAD_ROW, i, g_n)
    store_vector(rows, DIRECTION_ROW, i, n)


@inline_kernel
def _backpropagate_footprint_rows(pose, filter_variance, u, v, n, cov, soa, i, grad_pose):
    """The gradient of n, the parts of that of C for `_covariance_gradient`, and that of det B."""
    unit, inverse_unit = math.sqrt(layout.HALF_LOG2_E), 1 / math.sqrt(layout.HALF_LOG2_E)
    factors, alpha, beta, radial_variance, det_filtered, _ = compute_whitening(cov, filter_variance)
    a_scale, mix, b_scale = factors
    a, b = whitened_axes(u, v, factors)
    g_n = from_axes(pose, _load_fields(soa, layout.DIRECTION, i, 1.0))
    g_a = from_axes(pose, _load_fields(soa, layout.ROW_A, i, unit))
    g_b = from_axes(pose, _load_fields(soa, layout.ROW_B, i, unit))
    if grad_pose.shape[0] > 0:
        _add_to_pose(grad_pose, n, a, b, g_n, g_a, g_b)
    g_alpha = inverse_unit * _load_field(soa, layout.L_ALONG_A, i)
    g_beta = inverse_unit * _load_field(soa, layout.L_ALONG_B, i)
    g_radial = (1 / layout.HALF_LOG2_E) * _load_field(soa, layout.RADIAL_VARIANCE, i)
    # The gradients of ln (det B / det B') and of det B.
    is_compensated, zero = cov[6] > MIN_COMPENSATION * det_filtered, broadcast(0.0)
    g_ln_ratio = select(is_compensated, (0.5 / math.log(2)) * _load_field(soa, layout.LOG2_PEAK, i), zero)
    g_det = select(is_compensated, g_ln_ratio / cov[6], zero)
    g_aa = -0.5 * (dot(*g_a, *a) + alpha * g_alpha) - g_ln_ratio
    g_ab = -0.5 * (dot(*g_a, *b) + dot(*g_b, *a) + beta * g_alpha + alpha * g_beta)
    g_bb = -0.5 * (dot(*g_b, *b) + beta * g_beta) - g_ln_ratio
    length = math.sqrt(det_filtered)
    ahead, back = cov[5] + filter_variance, 2 * (radial_variance + filter_variance) * g_radial
    by_a = 2 * alpha * g_aa + beta * g_ab - dot(*g_a, *n) + ahead * g_alpha - back * alpha
    by_b = b_scale * (alpha * g_ab + 2 * beta * g_bb - dot(*g_b, *n) + ahead * g_beta - back * beta)
    by_p, by_q = b_scale * length * g_alpha, a_scale * length * g_beta
    by_u, by_v = by_a * a_scale - by_b * mix - by_p, by_b - by_p * mix - by_q  # p = b ^ n, q = n ^ a
    g_n = _add_tangent(g_n, by_u, u, by_v, v)
    halves = 0.5 * g_aa, 0.5 * g_ab, 0.5 * g_bb, 0.5 * g_alpha, 0.5 * g_beta
    return g_n, (factors, (alpha, beta), g_radial, halves), g_det


@inline_kernel
def _load_field(soa, field, i):
    """The gradient of one field of the records."""
    return to_f64(load(soa, field * GAUSSIAN_BLOCK + i))


@inline_kernel
def _load_fields(soa, field, i, factor):
    """The gradient of three fields."""
    return (
        factor * _load_field(soa, field, i),
        factor * _load_field(soa, field + 1, i),
        factor * _load_field(soa, field + 2, i),
    )


@inline_kernel
def _add_tangent(g_n, by_u, u, by_v, v):
    """g_n + by_u u + by_v v"""
    return g_n[0] + by_u * u[0] + by_v * v[0], g_n[1] + by_u * u[1] + by_v * v[1], g_n[2] + by_u * u[2] + by_v * v[2]


@inline_kernel
def _add_to_pose(grad_pose, n, a, b, g_n, g_a, g_b):
    """Add to the rotation's gradient, without its last factor A: n_camera = A'n gives n g_n' A, likewise a and b."""
    for axis in range(3):
        for other in range(3):
            term = n[axis] * g_n[other] + a[axis] * g_a[other] + b[axis] * g_b[other]
            store_row(grad_pose, 4 * axis + other, 0, load_row(grad_pose, 4 * axis + other, 0) + term)


@inline_kernel
def _covariance_gradient(u, v, n, parts):
    """The gradient of C (xx xy xz yy yz zz) in the axes of u, v and n."""
    factors, (alpha, beta), g_radial, (aa, ab, bb, by_alpha, by_beta) = parts
    a, b = whitened_axes(u, v, factors)
    c = (
        aa * a[0] + ab * b[0] - by_alpha * n[0],
        aa * a[1] + ab * b[1] - by_alpha * n[1],
        aa * a[2] + ab * b[2] - by_alpha * n[2],
    )
    d = bb * b[0] - by_beta * n[0], bb * b[1] - by_beta * n[1], bb * b[2] - by_beta * n[2]
    l = (  # noqa: E741
        n[0] + alpha * a[0] + beta * b[0],
        n[1] + alpha * a[1] + beta * b[1],
        n[2] + alpha * a[2] + beta * b[2],
    )
    weighted = g_radial * l[0], g_radial * l[1], g_radial * l[2]
    return (
        weighted[0] * l[0] + 2 * (a[0] * c[0] + b[0] * d[0]),
        weighted[0] * l[1] + a[0] * c[1] + a[1] * c[0] + b[0] * d[1] + b[1] * d[0],
        weighted[0] * l[2] + a[0] * c[2] + a[2] * c[0] + b[0] * d[2] + b[2] * d[0],
        weighted[1] * l[1] + 2 * (a[1] * c[1] + b[1] * d[1]),
        weighted[1] * l[2] + a[1] * c[2] + a[2] * c[1] + b[1] * d[2] + b[2] * d[1],
        weighted[2] * l[2] + 2 * (a[2] * c[2] + b[2] * d[2]),
    )


@inline_kernel
def _backpropagate_axes(rows, i, u, n, inverse, g_n, parts, g):
    """Write the gradients of quaternions and scales; return those of n and the distance.

    det B = sum_k w_k (n.e_k)^2. A rotation about one axis has no effect if the other two scales are equal, and the
    gradient is exactly 0 then: with G the gradient of C in the Gaussian's own axes and a_k the squared scales, the
    torque about axis 0 is 2 (a_1 - a_2) (G_12 - g a_0 n_1 n_2), and cyclically.

    Args:
        inverse: one over the distance.
        g_n, parts, g: gradients of n, C (see `_covariance_gradient`) and det B.
    """
    e0, e1, e2, inverse2 = load_axes(rows, i)
    s0, s1, s2 = load_vector(rows, SHAPE_ROW + 4, i)
    s0, s1, s2 = s0 * inverse, s1 * inverse, s2 * inverse
    u0, u1, u2 = dot(*u, *e0), dot(*u, *e1), dot(*u, *e2)
    n0, n1, n2 = dot(*n, *e0), dot(*n, *e1), dot(*n, *e2)
    v = cross(n0, n1, n2, u0, u1, u2)
    g00, g01, g02, g11, g12, g22 = _covariance_gradient((u0, u1, u2), v, (n0, n1, n2), parts)
    a0, a1, a2 = s0 * s0, s1 * s1, s2 * s2
    gn0, gn1, gn2 = g * n0, g * n1, g * n2
    t0, t1, t2 = 2 * a1 * a2 * gn0, 2 * a2 * a0 * gn1, 2 * a0 * a1 * gn2
    g_n = (
        g_n[0] + t0 * e0[0] + t1 * e1[0] + t2 * e2[0],
        g_n[1] + t0 * e0[1] + t1 * e1[1] + t2 * e2[1],
        g_n[2] + t0 * e0[2] + t1 * e1[2] + t2 * e2[2],
    )
    q0, q1, q2 = gn0 * n0, gn1 * n1, gn2 * n2
    d0 = 2 * s0 * (g00 + a2 * q1 + a1 * q2)
    d1 = 2 * s1 * (g11 + a2 * q0 + a0 * q2)
    d2 = 2 * s2 * (g22 + a1 * q0 + a0 * q1)
    store_row(rows, _SHAPE_GRAD_ROW + 4, i, d0 * inverse)
    store_row(rows, _SHAPE_GRAD_ROW + 5, i, d1 * inverse)
    store_row(rows, _SHAPE_GRAD_ROW + 6, i, d2 * inverse)
    # A rotation by the torque changes a unit quaternion q by q (0, torque) / 2.
    twice = 4 * inverse2
    x = twice * (a1 - a2) * (g12 - a0 * gn1 * n2)
    y = twice * (a2 - a0) * (g02 - a1 * gn2 * n0)
    z = twice * (a0 - a1) * (g01 - a2 * gn0 * n1)
    q = (load_row(rows, SHAPE_ROW, i), *load_vector(rows, SHAPE_ROW + 1, i))
    store_row(rows, _SHAPE_GRAD_ROW, i, -(q[1] * x + q[2] * y + q[3] * z))
    store_row(rows, _SHAPE_GRAD_ROW + 1, i, q[0] * x + q[2] * z - q[3] * y)
    store_row(rows, _SHAPE_GRAD_ROW + 2, i, q[0] * y + q[3] * x - q[1] * z)
    store_row(rows, _SHAPE_GRAD_ROW + 3, i, q[0] * z + q[1] * y - q[2] * x)
    return g_n, -(d0 * s0 + d1 * s1 + d2 * s2) * inverse


# --- gradients of a block's means, and writing the gradients ---


@inline_kernel
def _backpropagate_means(rows, grad_pose):
    """Compute the gradients of means from those of directions and distances."""
    for i in range(0, GAUSSIAN_BLOCK, LANES):
        n, g = load_vector(rows, DIRECTION_ROW, i), load_vector(rows, _MEAN_GRAD_ROW, i)
        inverse = 1 / load_row(rows, RADIUS_ROW, i)
        outward = load_row(rows, _RADIUS_GRAD_ROW, i) - dot(*g, *n) * inverse
        for axis in range(3):
            grad = g[axis] * inverse + outward * n[axis]
            store_row(rows, _MEAN_GRAD_ROW + axis, i, grad)
            if grad_pose.shape[0] > 0:
                store_row(grad_pose, 4 * axis + 3, 0, load_row(grad_pose, 4 * axis + 3, 0) - grad)


@inline_kernel
def _write_gradients(rows, start, count, grad_means, grad_quats, grad_scales, grad_opacities):
    if grad_means.shape[0] > 0:
        _copy_rows(rows, _MEAN_GRAD_ROW, start, count, grad_means)
    if grad_opacities.shape[0] > 0:
        _copy_rows(rows, OPACITY_ROW, start, count, grad_opacities.reshape(-1, 1))
    if grad_quats.shape[0] > 0:
        _copy_rows(rows, _SHAPE_GRAD_ROW, start, count, grad_quats)
    if grad_scales.shape[0] > 0:
        _copy_rows(rows, _SHAPE_GRAD_ROW + 4, start, count, grad_scales)


@inline_kernel
def _copy_rows(rows, row, start, count, columns):
    """Copy rows of a block to the columns of an array, rounded to float32."""
    for i in range(count):
        for j in range(columns.shape[1]):
            columns[start + i, j] = np.float32(rows[row + j, i])
