"""The EWA kernel: records and boxes of a pinhole image plane, and their backward.

Source: docs/rendering.md, section 3, `ewa`. With the tangent frame F = (u, v, n) the projected covariance is
V = (J F) C' (J F)'. It is computed in float64 from the covariances; from the records, needles would lose 5% of their
gradients.
"""

import math
from functools import partial

import numpy as np

from pansplat.constants import ALPHA_CUT, EWA_CLAMP, KAPPA_MARGIN, MIN_EWA_VARIANCE
from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.projection import (
    CULLED,
    GAUSSIAN_BLOCK,
    GAUSSIANS_PER_ITEM,
    NUM_ROWS,
    Camera,
    GaussianArrays,
    ProjectedGaussians,
    dot,
    from_axes,
    load_block,
    load_tangent_covariance,
    matrix_columns,
    store_tangent_covariances,
    to_axes,
)
from pansplat.rendering.cpu.runtime import Workspace, inline_kernel, kernel, parallel_for
from pansplat.rendering.cpu.tiling import round_boxes
from pansplat.rendering.image_planes import ImagePlane

EWA_GRAD_SIZE = 10  # gradients of n and C (xx xy xz yy yz zz), world axes, and of log2_peak
_CLAMP = 0.5 * EWA_CLAMP  # of the image plane's side over the focal length
_LOG2_CUT = math.log2(1 / ALPHA_CUT)

# Rows of a block, after those of projection.py.
_LOG2_PEAK_ROW = NUM_ROWS + 1
_EDGES_ROW = NUM_ROWS + 2  # left, right, top, bottom
_POINT_ROW = NUM_ROWS + 6  # x, y; then a_x, b_x, b_y
_RECORD_GRAD_ROW = NUM_ROWS + 11  # gradients of these five and of log2_peak
_EWA_GRAD_ROW = NUM_ROWS + 17
_NUM_ROWS = _EWA_GRAD_ROW + EWA_GRAD_SIZE


def project_ewa(
    gaussians: GaussianArrays,
    camera: Camera,
    projected: ProjectedGaussians,
    plane: ImagePlane,
    dilation: float,
    z_near: float,
    workspace: Workspace,
    threads: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The records of an image plane, written only if the box is not empty, and the boxes.

    Args:
        gaussians, camera, projected: the scene, the camera, and the scene's projection.
        plane: a pinhole image.
        dilation: variance added on both axes, pixels^2.
        z_near: Gaussians at a smaller depth are culled, metres.
        workspace: memory for the returned arrays.
        threads: number of threads.
    """
    num = len(projected.records)
    records, words = workspace.array((num, layout.RECORD_SIZE), np.float32), workspace.array((num, 2), np.int32)
    rotation, axes = _plane_axes(camera, plane)
    work = partial(
        _project_ewa, *gaussians.kernel_arguments, *camera, projected.records, projected.radii, rotation, axes,
        *plane.size, plane.focal, dilation, z_near, records, words, words.view(np.int16),
    )  # fmt: skip
    parallel_for(work, -(-num // GAUSSIANS_PER_ITEM), threads)
    return records, words.view(np.int16)


def backpropagate_ewa(
    gaussians: GaussianArrays,
    camera: Camera,
    plane: ImagePlane,
    dilation: float,
    grad_records: np.ndarray,
    offsets: np.ndarray,
    ewa_grads: np.ndarray,
    threads: int,
) -> None:
    """Add the gradients of directions, covariances and peaks, given those of an image plane's records.

    Args:
        gaussians, camera, plane, dilation: of the forward.
        grad_records: (slot, RECORD_SIZE).
        offsets: (n + 1), where each Gaussian's slots begin.
        ewa_grads: (n, EWA_GRAD_SIZE) float64, added to.
        threads: number of threads; the result does not depend on it.
    """
    _, axes = _plane_axes(camera, plane)
    work = partial(
        _backpropagate_ewa, *gaussians.kernel_arguments, *camera, axes, *plane.size, plane.focal, dilation,
        grad_records, offsets, ewa_grads,
    )  # fmt: skip
    parallel_for(work, -(-len(gaussians.means) // GAUSSIANS_PER_ITEM), threads)


def _plane_axes(camera: Camera, plane: ImagePlane) -> tuple[np.ndarray, np.ndarray]:
    """The image plane's axes in the camera's and in the world's, as columns."""
    rotation = np.ascontiguousarray(plane.rotation.numpy())
    return rotation, np.ascontiguousarray(camera.pose[:3, :3] @ rotation)


# --- both passes ---


@inline_kernel
def _jacobian(n, height, width, focal):
    """Tangents, clamped tangents and scale of J at a direction with n_z > 0."""
    inverse = 1 / n[2]
    tan_x, tan_y = n[0] * inverse, n[1] * inverse
    limit_x, limit_y = _CLAMP * width / focal, _CLAMP * height / focal
    clamped_x, clamped_y = min(max(tan_x, -limit_x), limit_x), min(max(tan_y, -limit_y), limit_y)
    return tan_x, tan_y, clamped_x, clamped_y, focal * inverse


@inline_kernel
def _apply_jacobian(jacobian, vector):
    _, _, clamped_x, clamped_y, scale = jacobian
    return scale * (vector[0] - clamped_x * vector[2]), scale * (vector[1] - clamped_y * vector[2])


@inline_kernel
def _times_covariance(cov, filter_variance, on_u, on_v, on_n):
    """A row (on_u, on_v, on_n) of J F times the filtered covariance."""
    uu, uv, vv, un, vn, nn = cov[0] + filter_variance, cov[1], cov[2] + filter_variance, cov[3], cov[4], cov[5]
    return (
        uu * on_u + uv * on_v + un * on_n,
        uv * on_u + vv * on_v + vn * on_n,
        un * on_u + vn * on_v + nn * on_n,
    )


@inline_kernel
def _project_covariance(rows, i, axes, height, width, focal, filter_variance):
    """The frame in the image plane's axes, J, J n, the rows of J F times the covariance, and V before dilation."""
    u, v, n, cov = load_tangent_covariance(rows, i)
    u, v, n = to_axes(axes, u), to_axes(axes, v), to_axes(axes, n)
    jacobian = _jacobian(n, height, width, focal)
    on_u, on_v, on_n = _apply_jacobian(jacobian, u), _apply_jacobian(jacobian, v), _apply_jacobian(jacobian, n)
    x_row, y_row = (on_u[0], on_v[0], on_n[0]), (on_u[1], on_v[1], on_n[1])
    x_weighted = _times_covariance(cov, filter_variance, *x_row)
    y_weighted = _times_covariance(cov, filter_variance, *y_row)
    variance = dot(*x_row, *x_weighted), dot(*x_row, *y_weighted), dot(*y_row, *y_weighted)
    return (u, v, n), jacobian, on_n, x_weighted, y_weighted, variance


# --- forward ---


@kernel
def _project_ewa(
    means, quats, scales, covariances, opacities, _harmonics, pose, filter_variance, _compensate, near,
    camera_records, radii, rotation, axes, height, width, focal, dilation, z_near, records, words, boxes, item,
):  # fmt: skip
    rows, axes = np.ones((_NUM_ROWS, GAUSSIAN_BLOCK)), matrix_columns(axes)
    unit = math.sqrt(layout.HALF_LOG2_E)
    num = camera_records.shape[0]
    for start in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, num), GAUSSIAN_BLOCK):
        count = min(GAUSSIAN_BLOCK, num - start)
        if _load_peaks(camera_records, radii, rotation, start, count, z_near, rows) == 0:
            for i in range(count):
                words[start + i, 0], words[start + i, 1] = 0, 1
            continue
        load_block(means, quats, scales, covariances, opacities, start, count, rows)
        store_tangent_covariances(covariances, pose, near, rows)
        for i in range(GAUSSIAN_BLOCK):
            _, jacobian, _, _, _, v = _project_covariance(rows, i, axes, height, width, focal, filter_variance)
            kappa = (rows[_LOG2_PEAK_ROW, i] + _LOG2_CUT) / layout.HALF_LOG2_E + KAPPA_MARGIN
            v_xx, v_yy = v[0] + dilation, v[2] + dilation
            a_x, m = 1 / math.sqrt(v_xx), -v[1] / v_xx
            b_y = 1 / math.sqrt(max(v_yy + m * v[1], MIN_EWA_VARIANCE))
            x, y = focal * jacobian[0] + 0.5 * width, focal * jacobian[1] + 0.5 * height
            rows[_POINT_ROW, i], rows[_POINT_ROW + 1, i] = x, y
            rows[_POINT_ROW + 2, i] = unit * a_x
            rows[_POINT_ROW + 3, i], rows[_POINT_ROW + 4, i] = unit * m * b_y, unit * b_y
            reach_x, reach_y = math.sqrt(max(kappa, 0.0) * v_xx), math.sqrt(max(kappa, 0.0) * v_yy)
            rows[_EDGES_ROW, i], rows[_EDGES_ROW + 1, i] = x - reach_x, x + reach_x
            rows[_EDGES_ROW + 2, i], rows[_EDGES_ROW + 3, i] = y - reach_y, y + reach_y if kappa >= 0 else -1e9
        round_boxes(rows, _EDGES_ROW, start, count, height, width, words)
        _write_records(rows, start, count, boxes, records)


@inline_kernel
def _load_peaks(camera_records, radii, rotation, start, count, z_near, rows):
    """Load log2_peak, `CULLED` for Gaussians behind the near plane; return the number of the others."""
    num_kept = 0
    for i in range(GAUSSIAN_BLOCK):
        rows[_LOG2_PEAK_ROW, i] = CULLED
    for i in range(count):
        g = start + i
        z = (np.float64(camera_records[g, 0]) + np.float64(camera_records[g, 3])) * rotation[0, 2]
        z += (np.float64(camera_records[g, 1]) + np.float64(camera_records[g, 4])) * rotation[1, 2]
        z += (np.float64(camera_records[g, 2]) + np.float64(camera_records[g, 5])) * rotation[2, 2]
        kept = (z * radii[g] > z_near) & (camera_records[g, layout.LOG2_PEAK] > CULLED)
        rows[_LOG2_PEAK_ROW, i] = camera_records[g, layout.LOG2_PEAK] if kept else CULLED
        num_kept += kept
    return num_kept


@inline_kernel
def _write_records(rows, start, count, boxes, records):
    for i in range(count):
        g = start + i
        if boxes[g, 3] < boxes[g, 2]:
            continue
        for j in range(layout.RECORD_SIZE):
            records[g, j] = 0
        for axis in range(2):
            head = np.float32(rows[_POINT_ROW + axis, i])
            records[g, layout.DIRECTION + axis] = head
            residual = np.float32(rows[_POINT_ROW + axis, i] - np.float64(head))
            records[g, layout.DIRECTION_RESIDUAL + axis] = residual
        records[g, layout.ROW_A] = np.float32(rows[_POINT_ROW + 2, i])
        records[g, layout.ROW_B] = np.float32(rows[_POINT_ROW + 3, i])
        records[g, layout.ROW_B + 1] = np.float32(rows[_POINT_ROW + 4, i])
        records[g, layout.LOG2_PEAK] = np.float32(rows[_LOG2_PEAK_ROW, i])


# --- backward ---


@kernel
def _backpropagate_ewa(
    means, quats, scales, covariances, opacities, _harmonics, pose, filter_variance, _compensate, near,
    axes, height, width, focal, dilation, grad_records, offsets, ewa_grads, item,
):  # fmt: skip
    rows, axes = np.ones((_NUM_ROWS, GAUSSIAN_BLOCK)), matrix_columns(axes)
    for start in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, means.shape[0]), GAUSSIAN_BLOCK):
        count = min(GAUSSIAN_BLOCK, means.shape[0] - start)
        if _sum_slots(grad_records, offsets, start, count, rows) == 0:
            continue
        load_block(means, quats, scales, covariances, opacities, start, count, rows)
        store_tangent_covariances(covariances, pose, near, rows)
        _backpropagate_records(rows, axes, height, width, focal, filter_variance, dilation)
        for i in range(count):
            if offsets[start + i + 1] > offsets[start + i]:
                for j in range(EWA_GRAD_SIZE):
                    ewa_grads[start + i, j] += rows[_EWA_GRAD_ROW + j, i]


@inline_kernel
def _sum_slots(grad_records, offsets, start, count, rows):
    """Sum each Gaussian's slots, in their order; return the number of Gaussians with a slot."""
    num_with_slots = 0
    unit = math.sqrt(layout.HALF_LOG2_E)
    for i in range(GAUSSIAN_BLOCK):
        for j in range(6):
            rows[_RECORD_GRAD_ROW + j, i] = 0.0
    for i in range(count):
        g = start + i
        num_with_slots += offsets[g + 1] > offsets[g]
        for slot in range(offsets[g], offsets[g + 1]):
            rows[_RECORD_GRAD_ROW, i] += grad_records[slot, layout.DIRECTION]
            rows[_RECORD_GRAD_ROW + 1, i] += grad_records[slot, layout.DIRECTION + 1]
            rows[_RECORD_GRAD_ROW + 2, i] += unit * grad_records[slot, layout.ROW_A]
            rows[_RECORD_GRAD_ROW + 3, i] += unit * grad_records[slot, layout.ROW_B]
            rows[_RECORD_GRAD_ROW + 4, i] += unit * grad_records[slot, layout.ROW_B + 1]
            rows[_RECORD_GRAD_ROW + 5, i] += grad_records[slot, layout.LOG2_PEAK]
    return num_with_slots


@inline_kernel
def _backpropagate_records(rows, axes, height, width, focal, filter_variance, dilation):
    """Write the gradients of n, C (world axes) and log2_peak, given those of the point, a, b and log2_peak."""
    for i in range(GAUSSIAN_BLOCK):
        frame, jacobian, n_image, x_weighted, y_weighted, v = _project_covariance(
            rows, i, axes, height, width, focal, filter_variance
        )
        tan_x, tan_y, clamped_x, clamped_y, scale = jacobian
        v_xx, m = v[0] + dilation, -v[1] / (v[0] + dilation)
        a_x, across = 1 / math.sqrt(v_xx), v[2] + dilation + m * v[1]
        b_y = 1 / math.sqrt(max(across, MIN_EWA_VARIANCE))
        g_ax, g_bx, g_by = rows[_RECORD_GRAD_ROW + 2, i], rows[_RECORD_GRAD_ROW + 3, i], rows[_RECORD_GRAD_ROW + 4, i]
        g_m = g_bx * b_y
        h_yy = -0.5 * b_y * b_y * b_y * (g_by + g_bx * m) if across >= MIN_EWA_VARIANCE else 0.0
        h_xx = -0.5 * g_ax * a_x * a_x * a_x + m * m * h_yy - g_m * m / v_xx
        h_xy = m * h_yy - 0.5 * g_m / v_xx
        # V = J C' J': the gradient of J is 2 H (J C'), that of C is J' H J. n also has that of - e^2 n n'.
        x_mixed = (
            h_xx * x_weighted[0] + h_xy * y_weighted[0],
            h_xx * x_weighted[1] + h_xy * y_weighted[1],
            h_xx * x_weighted[2] + h_xy * y_weighted[2],
        )
        y_mixed = (
            h_xy * x_weighted[0] + h_yy * y_weighted[0],
            h_xy * x_weighted[1] + h_yy * y_weighted[1],
            h_xy * x_weighted[2] + h_yy * y_weighted[2],
        )
        u, v_axis, n = frame
        x_ahead, y_ahead = dot(*x_mixed, u[2], v_axis[2], n[2]), dot(*y_mixed, u[2], v_axis[2], n[2])
        x_side, y_side = dot(*x_mixed, u[0], v_axis[0], n[0]), dot(*y_mixed, u[1], v_axis[1], n[1])
        g_scale = 2 * (x_side - clamped_x * x_ahead + y_side - clamped_y * y_ahead)
        g_tan_x = focal * rows[_RECORD_GRAD_ROW, i] - (2 * scale * x_ahead if tan_x == clamped_x else 0.0)
        g_tan_y = focal * rows[_RECORD_GRAD_ROW + 1, i] - (2 * scale * y_ahead if tan_y == clamped_y else 0.0)
        inverse = 1 / n[2]
        g_z = -(g_tan_x * tan_x + g_tan_y * tan_y + g_scale * scale) * inverse
        g_n = from_axes(axes, (g_tan_x * inverse, g_tan_y * inverse, g_z))
        j_x = from_axes(axes, (scale, 0.0, -scale * clamped_x))
        j_y = from_axes(axes, (0.0, scale, -scale * clamped_y))
        n_x = -2 * filter_variance * (h_xx * n_image[0] + h_xy * n_image[1])
        n_y = -2 * filter_variance * (h_xy * n_image[0] + h_yy * n_image[1])
        at = _EWA_GRAD_ROW + 3
        for axis in range(3):
            rows[_EWA_GRAD_ROW + axis, i] = g_n[axis] + n_x * j_x[axis] + n_y * j_y[axis]
            for other in range(axis, 3):
                rows[at, i] = (
                    h_xx * j_x[axis] * j_x[other]
                    + h_yy * j_y[axis] * j_y[other]
                    + h_xy * (j_x[axis] * j_y[other] + j_y[axis] * j_x[other])
                )
                at += 1
        rows[_EWA_GRAD_ROW + 9, i] = rows[_RECORD_GRAD_ROW + 5, i]
