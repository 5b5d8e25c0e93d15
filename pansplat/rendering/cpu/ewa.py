"""The classic kernel: records of a pinhole picture from the Gaussians' shapes, and the gradients back.

Source: docs/rendering.md, section 3, `ewa`. In the tangent frame F = (u, v, n) the covariance is F S F', so
V = (J F) S' (J F)': two by two from three by three, in float64, nothing whitened in between.
"""

import math

import numpy as np

from pansplat.constants import ALPHA_CUT, EWA_CLAMP, KAPPA_MARGIN, MIN_EWA_VARIANCE
from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.forms import dot
from pansplat.rendering.cpu.observe import (
    CULLED,
    LANES,
    PIECE,
    ROWS,
    Camera,
    Fields,
    Observed,
    find_shapes,
    frame_and_shape,
    read_block,
)
from pansplat.rendering.cpu.runtime import Workspace, inline_kernel, kernel, parallel_for
from pansplat.rendering.cpu.tiling import round_boxes
from pansplat.rendering.image_planes import ImagePlane

TOTALS = 10  # numbers that a picture passes back: gradients of n (world axes), of C (xx xy xz yy yz zz), of the level
_NARROWEST = MIN_EWA_VARIANCE
_LIMIT = 0.5 * EWA_CLAMP  # of the picture's side over the focal length: 1.3 half sides
_LOG_CUT = math.log2(1 / ALPHA_CUT)
_SLACK = KAPPA_MARGIN

# Rows of a block, after those of observe.py.
LEVEL = ROWS + 1
EDGES = ROWS + 2
POINT = ROWS + 6  # and the two forms: x, y, a_x, b_x, b_y
GIVEN = ROWS + 11  # gradients of these, and of the level
OUT = ROWS + 17  # what is passed back
ALL_ROWS = OUT + TOTALS


@inline_kernel
def _turn(turn, vector):
    """A vector from the world's axes to the picture's."""
    x, y, z = vector
    return (
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
        turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z,
    )


@inline_kernel
def _turn_back(turn, vector):
    """A vector from the picture's axes to the world's."""
    x, y, z = vector
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@inline_kernel
def _jacobian(n, height, width, focal):
    """Tangents, clamped tangents and scale of J at a direction with n_z > 0."""
    inverse = 1 / n[2]
    tan_x, tan_y = n[0] * inverse, n[1] * inverse
    limit_x, limit_y = _LIMIT * width / focal, _LIMIT * height / focal
    return (
        tan_x,
        tan_y,
        min(max(tan_x, -limit_x), limit_x),
        min(max(tan_y, -limit_y), limit_y),
        focal * inverse,
    )


@inline_kernel
def _image(jacobian, vector):
    """J times a vector."""
    _, _, clamped_x, clamped_y, scale = jacobian
    return scale * (vector[0] - clamped_x * vector[2]), scale * (vector[1] - clamped_y * vector[2])


@inline_kernel
def _weighted(shape, spread, on_u, on_v, on_n):
    """A row of J F times S', the filtered shape."""
    uu, uv, vv, un, vn, nn = shape[0] + spread, shape[1], shape[2] + spread, shape[3], shape[4], shape[5]
    return (
        uu * on_u + uv * on_v + un * on_n,
        uv * on_u + vv * on_v + vn * on_n,
        un * on_u + vn * on_v + nn * on_n,
    )


@inline_kernel
def _projected(rows, i, turn, height, width, focal, spread):
    """The frame on the picture's axes, J, its rows times F and times F S', and V before it is dilated."""
    u, v, n, shape = frame_and_shape(rows, i)
    u, v, n = _turn(turn, u), _turn(turn, v), _turn(turn, n)
    jacobian = _jacobian(n, height, width, focal)
    on_u, on_v, on_n = _image(jacobian, u), _image(jacobian, v), _image(jacobian, n)
    x_row, y_row = (on_u[0], on_v[0], on_n[0]), (on_u[1], on_v[1], on_n[1])
    x_weighted, y_weighted = _weighted(shape, spread, *x_row), _weighted(shape, spread, *y_row)
    spread_out = dot(*x_row, *x_weighted), dot(*x_row, *y_weighted), dot(*y_row, *y_weighted)
    return (u, v, n), jacobian, on_n, x_weighted, y_weighted, spread_out


@inline_kernel
def _in_front(records, radii, turn, start, count, z_near, rows):
    """Note the levels, `CULLED` for Gaussians behind; return how many may be seen."""
    seen = 0
    for i in range(LANES):
        rows[LEVEL, i] = CULLED
    for i in range(count):
        g = start + i
        # `turn` is from the camera's axes here.
        z = (np.float64(records[g, 0]) + np.float64(records[g, 3])) * turn[0, 2]
        z += (np.float64(records[g, 1]) + np.float64(records[g, 4])) * turn[1, 2]
        z += (np.float64(records[g, 2]) + np.float64(records[g, 5])) * turn[2, 2]
        front = (z * radii[g] > z_near) & (records[g, layout.LOG2_PEAK] > CULLED)
        rows[LEVEL, i] = records[g, layout.LOG2_PEAK] if front else CULLED
        seen += front
    return seen


@kernel
def _project(
    piece, means, quats, scales, covariances, opacities, _harmonics, pose, spread, _compensate, near,
    records, radii, rotation, turn, height, width, focal, dilation, z_near, projected, words, boxes,
):  # fmt: skip
    rows = np.ones((ALL_ROWS, LANES))
    unit = math.sqrt(layout.HALF_LOG2_E)
    for start in range(piece * PIECE, min((piece + 1) * PIECE, records.shape[0]), LANES):
        count = min(LANES, records.shape[0] - start)
        if _in_front(records, radii, rotation, start, count, z_near, rows) == 0:
            for i in range(count):
                words[start + i, 0], words[start + i, 1] = 0, 1
            continue
        read_block(means, quats, scales, covariances, opacities, start, count, rows)
        find_shapes(covariances, pose, near, rows)
        for i in range(LANES):
            _, jacobian, _, _, _, v = _projected(rows, i, turn, height, width, focal, spread)
            kappa = (rows[LEVEL, i] + _LOG_CUT) / layout.HALF_LOG2_E + _SLACK
            v_xx, v_yy = v[0] + dilation, v[2] + dilation
            first, m = 1 / math.sqrt(v_xx), -v[1] / v_xx
            second = 1 / math.sqrt(max(v_yy + m * v[1], _NARROWEST))
            x, y = focal * jacobian[0] + 0.5 * width, focal * jacobian[1] + 0.5 * height
            rows[POINT, i], rows[POINT + 1, i] = x, y
            rows[POINT + 2, i], rows[POINT + 3, i], rows[POINT + 4, i] = unit * first, unit * m * second, unit * second
            reach_x, reach_y = math.sqrt(max(kappa, 0.0) * v_xx), math.sqrt(max(kappa, 0.0) * v_yy)
            rows[EDGES, i], rows[EDGES + 1, i] = x - reach_x, x + reach_x
            rows[EDGES + 2, i], rows[EDGES + 3, i] = y - reach_y, y + reach_y if kappa >= 0 else -1e9
        round_boxes(rows, EDGES, start, count, height, width, words)
        _write_projected(rows, start, count, boxes, projected)


@inline_kernel
def _write_projected(rows, start, count, boxes, projected):
    for i in range(count):
        g = start + i
        if boxes[g, 3] < boxes[g, 2]:
            continue
        for j in range(layout.RECORD_SIZE):
            projected[g, j] = 0
        for axis in range(2):
            head = np.float32(rows[POINT + axis, i])
            projected[g, layout.DIRECTION + axis] = head
            projected[g, layout.DIRECTION_RESIDUAL + axis] = np.float32(rows[POINT + axis, i] - np.float64(head))
        projected[g, layout.ROW_A] = np.float32(rows[POINT + 2, i])
        projected[g, layout.ROW_B] = np.float32(rows[POINT + 3, i])
        projected[g, layout.ROW_B + 1] = np.float32(rows[POINT + 4, i])
        projected[g, layout.LOG2_PEAK] = np.float32(rows[LEVEL, i])


def project(
    fields: Fields,
    camera: Camera,
    observed: Observed,
    picture: ImagePlane,
    dilation: float,
    z_near: float,
    workspace: Workspace,
    threads: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Records of a pinhole picture, where there is a box, and the boxes.

    Args:
        fields, camera: what was observed, and by whom.
        observed: by the camera.
        picture: pinhole.
        dilation: variance added on both axes, pixels^2.
        z_near: Gaussians with a smaller depth in the picture are left out, metres.
        workspace: for the arrays returned.
        threads: to work on.
    """
    num = len(observed.records)
    projected, words = workspace.array((num, layout.RECORD_SIZE), np.float32), workspace.array((num, 2), np.int32)
    rotation, turn = _axes(camera, picture)

    def work(piece: int) -> None:
        _project(
            piece, *fields.given, *camera, observed.records, observed.radii, rotation, turn, *picture.size,
            picture.focal, dilation, z_near, projected, words, words.view(np.int16),
        )  # fmt: skip

    parallel_for(work, -(-num // PIECE), threads)
    return projected, words.view(np.int16)


def _axes(camera: Camera, picture: ImagePlane) -> tuple[np.ndarray, np.ndarray]:
    """The picture's axes in the camera's and in the world's."""
    rotation = np.ascontiguousarray(picture.rotation.numpy())
    return rotation, np.ascontiguousarray(camera.pose[:3, :3] @ rotation)


@inline_kernel
def _read_given(grads, offsets, start, count, rows):
    """Sum each Gaussian's slots; return how many Gaussians of the block have any."""
    some = 0
    unit = math.sqrt(layout.HALF_LOG2_E)
    for i in range(LANES):
        for j in range(6):
            rows[GIVEN + j, i] = 0.0
    for i in range(count):
        g = start + i
        some += offsets[g + 1] > offsets[g]
        for slot in range(offsets[g], offsets[g + 1]):
            rows[GIVEN, i] += grads[slot, layout.DIRECTION]
            rows[GIVEN + 1, i] += grads[slot, layout.DIRECTION + 1]
            rows[GIVEN + 2, i] += unit * grads[slot, layout.ROW_A]
            rows[GIVEN + 3, i] += unit * grads[slot, layout.ROW_B]
            rows[GIVEN + 4, i] += unit * grads[slot, layout.ROW_B + 1]
            rows[GIVEN + 5, i] += grads[slot, layout.LOG2_PEAK]
    return some


@inline_kernel
def _splats_backward(rows, turn, height, width, focal, spread, dilation):
    """Gradients of n and C, world axes, from those of point and forms."""
    for i in range(LANES):
        frame, jacobian, n_image, x_weighted, y_weighted, v = _projected(rows, i, turn, height, width, focal, spread)
        tan_x, tan_y, clamped_x, clamped_y, scale = jacobian
        v_xx, m = v[0] + dilation, -v[1] / (v[0] + dilation)
        first, across = 1 / math.sqrt(v_xx), v[2] + dilation + m * v[1]
        second = 1 / math.sqrt(max(across, _NARROWEST))
        g_first, g_bx, g_by = rows[GIVEN + 2, i], rows[GIVEN + 3, i], rows[GIVEN + 4, i]
        g_m = g_bx * second
        h_yy = -0.5 * second * second * second * (g_by + g_bx * m) if across >= _NARROWEST else 0.0
        h_xx = -0.5 * g_first * first * first * first + m * m * h_yy - g_m * m / v_xx
        h_xy = m * h_yy - 0.5 * g_m / v_xx
        # V = J C' J': to J by 2 H (J C'), to C by J' H J, to n by the filter's - e^2 n n'.
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
        g_tan_x = focal * rows[GIVEN, i] - (2 * scale * x_ahead if tan_x == clamped_x else 0.0)
        g_tan_y = focal * rows[GIVEN + 1, i] - (2 * scale * y_ahead if tan_y == clamped_y else 0.0)
        inverse = 1 / n[2]
        by_depth = -(g_tan_x * tan_x + g_tan_y * tan_y + g_scale * scale) * inverse
        g_n = _turn_back(turn, (g_tan_x * inverse, g_tan_y * inverse, by_depth))
        j_x = _turn_back(turn, (scale, 0.0, -scale * clamped_x))
        j_y = _turn_back(turn, (0.0, scale, -scale * clamped_y))
        n_x = -2 * spread * (h_xx * n_image[0] + h_xy * n_image[1])
        n_y = -2 * spread * (h_xy * n_image[0] + h_yy * n_image[1])
        at = OUT + 3
        for axis in range(3):
            rows[OUT + axis, i] = g_n[axis] + n_x * j_x[axis] + n_y * j_y[axis]
            for other in range(axis, 3):
                rows[at, i] = (
                    h_xx * j_x[axis] * j_x[other]
                    + h_yy * j_y[axis] * j_y[other]
                    + h_xy * (j_x[axis] * j_y[other] + j_y[axis] * j_x[other])
                )
                at += 1
        rows[OUT + 9, i] = rows[GIVEN + 5, i]


@kernel
def _project_backward(
    piece, means, quats, scales, covariances, opacities, _harmonics, pose, spread, _compensate, near,
    turn, height, width, focal, dilation, grads, offsets, totals,
):  # fmt: skip
    rows = np.ones((ALL_ROWS, LANES))
    for start in range(piece * PIECE, min((piece + 1) * PIECE, means.shape[0]), LANES):
        count = min(LANES, means.shape[0] - start)
        if _read_given(grads, offsets, start, count, rows) == 0:
            continue
        read_block(means, quats, scales, covariances, opacities, start, count, rows)
        find_shapes(covariances, pose, near, rows)
        _splats_backward(rows, turn, height, width, focal, spread, dilation)
        for i in range(count):
            if offsets[start + i + 1] > offsets[start + i]:
                for j in range(TOTALS):
                    totals[start + i, j] += rows[OUT + j, i]


def project_backward(
    fields: Fields,
    camera: Camera,
    picture: ImagePlane,
    dilation: float,
    grads: np.ndarray,
    offsets: np.ndarray,
    totals: np.ndarray,
    threads: int,
) -> None:
    """Add to the gradients of directions, shapes and levels what a picture's records pass back.

    Args:
        fields, camera, picture, dilation: of the forward.
        grads: (slot, FIELDS), of the picture's records.
        offsets: (n + 1), where each Gaussian's slots begin.
        totals: (n, TOTALS) float64, added to.
        threads: to work on; the result does not depend on it.
    """
    _, turn = _axes(camera, picture)

    def work(piece: int) -> None:
        _project_backward(
            piece, *fields.given, *camera, turn, *picture.size, picture.focal, dilation, grads, offsets, totals
        )

    parallel_for(work, -(-len(fields.means) // PIECE), threads)
