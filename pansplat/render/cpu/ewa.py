"""The classic kernel: records of a pinhole picture from the camera's records, and the gradients back.

Source: docs/rendering.md, section 3, `ewa`. A record knows its covariance, C' = S' n n' + p p' + q q' (boxes.py), so
V = S' (J n)(J n)' + (J p)(J p)' + (J q)(J q)'; nothing else of the Gaussian is read again.
"""

import math

import numpy as np

from pansplat.render.cpu import records as layout
from pansplat.render.cpu.boxes import ALONG, DIRECTION, EDGES, KAPPA, P, Q, read_cones, round_boxes
from pansplat.render.cpu.boxes import ROWS as CONE_ROWS
from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.forms import cross, dot
from pansplat.render.cpu.memory import Lease
from pansplat.render.cpu.observe import LANES, PIECE, Observed
from pansplat.render.cpu.threads import share
from pansplat.render.panorama import Picture

_NARROWEST = 1e-12  # pixel^2: rounding can leave a needle's determinant at or below zero
_LIMIT = 0.65  # of the picture's side over the focal length: 1.3 half sides

# Rows of a block, after those of boxes.py.
POINT = CONE_ROWS  # and the two forms: x, y, a_x, b_x, b_y
RADIUS = CONE_ROWS + 5
RECORD = CONE_ROWS + 6  # the camera's record: n, a, b, front_a, front_b, along
GIVEN = CONE_ROWS + 18  # gradients of point x, y, a_x, b_x, b_y
OUT = CONE_ROWS + 23  # gradients of the camera's record, as RECORD
ALL_ROWS = CONE_ROWS + 35


@inlined
def _projected(rows, i, height, width, focal, dilation):
    """J's entries, the axes on the picture, and V; n_z must be positive."""
    inverse = 1 / rows[DIRECTION + 2, i]
    tan_x, tan_y = rows[DIRECTION, i] * inverse, rows[DIRECTION + 1, i] * inverse
    limit_x, limit_y = _LIMIT * width / focal, _LIMIT * height / focal
    clamped_x, clamped_y = min(max(tan_x, -limit_x), limit_x), min(max(tan_y, -limit_y), limit_y)
    scale = focal * inverse
    n_x = scale * (rows[DIRECTION, i] - clamped_x * rows[DIRECTION + 2, i])
    n_y = scale * (rows[DIRECTION + 1, i] - clamped_y * rows[DIRECTION + 2, i])
    p_x, p_y = scale * (rows[P, i] - clamped_x * rows[P + 2, i]), scale * (rows[P + 1, i] - clamped_y * rows[P + 2, i])
    q_x, q_y = scale * (rows[Q, i] - clamped_x * rows[Q + 2, i]), scale * (rows[Q + 1, i] - clamped_y * rows[Q + 2, i])
    along = rows[ALONG, i]
    v_xx = along * n_x * n_x + p_x * p_x + q_x * q_x + dilation
    v_xy = along * n_x * n_y + p_x * p_y + q_x * q_y
    v_yy = along * n_y * n_y + p_y * p_y + q_y * q_y + dilation
    return (tan_x, tan_y, clamped_x, clamped_y, scale), (n_x, n_y), (p_x, p_y), (q_x, q_y), (v_xx, v_xy, v_yy)


@kernel
def _project(piece, records, radii, rotation, height, width, focal, dilation, z_near, projected, words, boxes):
    rows = np.ones((ALL_ROWS, LANES))
    for start in range(piece * PIECE, min((piece + 1) * PIECE, records.shape[0]), LANES):
        count = min(LANES, records.shape[0] - start)
        read_cones(records, start, count, rotation, rows)
        for i in range(count):
            rows[RADIUS, i] = radii[start + i]
        unit = math.sqrt(layout.UNIT)
        for i in range(LANES):
            kappa = rows[KAPPA, i]
            seen = (kappa >= 0) & (rows[DIRECTION + 2, i] * rows[RADIUS, i] > z_near)
            jacobian, _, _, _, v = _projected(rows, i, height, width, focal, dilation)
            first, m = 1 / math.sqrt(v[0]), -v[1] / v[0]
            second = 1 / math.sqrt(max(v[2] + m * v[1], _NARROWEST))
            x, y = focal * jacobian[0] + 0.5 * width, focal * jacobian[1] + 0.5 * height
            rows[POINT, i], rows[POINT + 1, i] = x, y
            rows[POINT + 2, i], rows[POINT + 3, i], rows[POINT + 4, i] = unit * first, unit * m * second, unit * second
            reach_x, reach_y = math.sqrt(max(kappa, 0.0) * v[0]), math.sqrt(max(kappa, 0.0) * v[2])
            rows[EDGES, i], rows[EDGES + 1, i] = x - reach_x, x + reach_x
            rows[EDGES + 2, i], rows[EDGES + 3, i] = y - reach_y, y + reach_y if seen else -1e9
        round_boxes(rows, EDGES, start, count, height, width, words)
        _write_projected(records, rows, start, count, boxes, projected)


@inlined
def _write_projected(records, rows, start, count, boxes, projected):
    for i in range(count):
        g = start + i
        if boxes[g, 3] < boxes[g, 2]:
            continue
        for j in range(layout.FIELDS):
            projected[g, j] = 0
        for axis in range(2):
            head = np.float32(rows[POINT + axis, i])
            projected[g, layout.DIRECTION + axis] = head
            projected[g, layout.REST + axis] = np.float32(rows[POINT + axis, i] - np.float64(head))
        projected[g, layout.FIRST] = np.float32(rows[POINT + 2, i])
        projected[g, layout.SECOND] = np.float32(rows[POINT + 3, i])
        projected[g, layout.SECOND + 1] = np.float32(rows[POINT + 4, i])
        projected[g, layout.LEVEL] = records[g, layout.LEVEL]


def project(
    observed: Observed, picture: Picture, dilation: float, z_near: float, lease: Lease, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Records of a pinhole picture, where there is a box, and the boxes.

    Args:
        observed: by the camera.
        picture: pinhole.
        dilation: variance added on both axes, pixels^2.
        z_near: Gaussians with a smaller depth in the picture are left out, metres.
        lease: for the arrays returned.
        threads: to work on.
    """
    num = len(observed.records)
    projected, words = lease.array((num, layout.FIELDS), np.float32), lease.array((num, 2), np.int32)
    boxes = words.view(np.int16)
    rotation = np.ascontiguousarray(picture.rotation.numpy())

    def work(piece: int) -> None:
        _project(
            piece, observed.records, observed.radii, rotation, *picture.size, picture.focal, dilation, z_near,
            projected, words, boxes,
        )  # fmt: skip

    share(work, -(-num // PIECE), threads)
    return projected, boxes


@inlined
def _read_given(records, grads, offsets, start, count, rows):
    """Read the camera's records and the sums of the picture's gradients; zeros where a Gaussian has no slot."""
    for i in range(LANES):
        for j in range(5):
            rows[GIVEN + j, i] = 0.0
    for i in range(count):
        g = start + i
        for axis in range(3):
            head, rest = records[g, layout.DIRECTION + axis], records[g, layout.REST + axis]
            rows[RECORD + axis, i] = np.float64(head) + np.float64(rest)
        for j in range(9):
            rows[RECORD + 3 + j, i] = records[g, layout.FIRST + j]
        for slot in range(offsets[g], offsets[g + 1]):
            rows[GIVEN, i] += grads[slot, layout.DIRECTION]
            rows[GIVEN + 1, i] += grads[slot, layout.DIRECTION + 1]
            rows[GIVEN + 2, i] += grads[slot, layout.FIRST]
            rows[GIVEN + 3, i] += grads[slot, layout.SECOND]
            rows[GIVEN + 4, i] += grads[slot, layout.SECOND + 1]
        if offsets[g + 1] == offsets[g]:  # it may lie behind: any place in front will do
            rows[DIRECTION, i], rows[DIRECTION + 1, i], rows[DIRECTION + 2, i] = 0.0, 0.0, 1.0
            rows[P, i], rows[P + 1, i], rows[P + 2, i] = 1.0, 0.0, 0.0
            rows[Q, i], rows[Q + 1, i], rows[Q + 2, i] = 0.0, 1.0, 0.0


@inlined
def _push(gradient_x, gradient_y, jacobian, axis):
    """Gradients of an axis (the picture's axes) and of J's clamped tangents and scale, from that of its image."""
    clamped_x, clamped_y, scale = jacobian[2], jacobian[3], jacobian[4]
    back = (
        scale * gradient_x,
        scale * gradient_y,
        -scale * (clamped_x * gradient_x + clamped_y * gradient_y),
    )
    by_scale = gradient_x * (axis[0] - clamped_x * axis[2]) + gradient_y * (axis[1] - clamped_y * axis[2])
    return back, -scale * axis[2] * gradient_x, -scale * axis[2] * gradient_y, by_scale


@inlined
def _splat_backward(rows, i, height, width, focal, dilation):
    """Gradients of n, p, q, in the picture's axes, and of S'."""
    jacobian, n_image, p_image, q_image, v = _projected(rows, i, height, width, focal, dilation)
    unit = math.sqrt(layout.UNIT)
    m, first = -v[1] / v[0], 1 / math.sqrt(v[0])
    across = v[2] + m * v[1]
    second = 1 / math.sqrt(max(across, _NARROWEST))
    g_first, g_bx, g_by = unit * rows[GIVEN + 2, i], unit * rows[GIVEN + 3, i], unit * rows[GIVEN + 4, i]
    g_m = g_bx * second
    k = -0.5 * second * second * second * (g_by + g_bx * m) if across >= _NARROWEST else 0.0
    h_xx = -0.5 * g_first * first * first * first + m * m * k - g_m * m / v[0]
    h_xy = m * k - 0.5 * g_m / v[0]
    n = rows[DIRECTION, i], rows[DIRECTION + 1, i], rows[DIRECTION + 2, i]
    p = rows[P, i], rows[P + 1, i], rows[P + 2, i]
    q = rows[Q, i], rows[Q + 1, i], rows[Q + 2, i]
    n_x, n_y = h_xx * n_image[0] + h_xy * n_image[1], h_xy * n_image[0] + k * n_image[1]
    p_x, p_y = h_xx * p_image[0] + h_xy * p_image[1], h_xy * p_image[0] + k * p_image[1]
    q_x, q_y = h_xx * q_image[0] + h_xy * q_image[1], h_xy * q_image[0] + k * q_image[1]
    along = rows[ALONG, i]
    g_n, n_tan_x, n_tan_y, n_scale = _push(2 * along * n_x, 2 * along * n_y, jacobian, n)
    g_p, p_tan_x, p_tan_y, p_scale = _push(2 * p_x, 2 * p_y, jacobian, p)
    g_q, q_tan_x, q_tan_y, q_scale = _push(2 * q_x, 2 * q_y, jacobian, q)
    tan_x, tan_y = jacobian[0], jacobian[1]
    free_x, free_y = tan_x == jacobian[2], tan_y == jacobian[3]
    g_tan_x = focal * rows[GIVEN, i] + (n_tan_x + p_tan_x + q_tan_x if free_x else 0.0)
    g_tan_y = focal * rows[GIVEN + 1, i] + (n_tan_y + p_tan_y + q_tan_y if free_y else 0.0)
    inverse = 1 / n[2]
    by_depth = -(g_tan_x * tan_x + g_tan_y * tan_y + (n_scale + p_scale + q_scale) * jacobian[4]) * inverse
    g_n = g_n[0] + g_tan_x * inverse, g_n[1] + g_tan_y * inverse, g_n[2] + by_depth
    return g_n, g_p, g_q, n_image[0] * n_x + n_image[1] * n_y


@inlined
def _turned(rotation, vector):
    """A vector from the picture's axes to the camera's."""
    x, y, z = vector
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@inlined
def _dual_backward(n, a, b, front_a, front_b, g_p, g_q):
    """Gradients of n, a, b and both fronts from those of the dual axes p and q."""
    inverse = 1 / dot(*cross(*a, *b), *n)
    by_n, by_a, by_b = cross(*a, *b), cross(*b, *n), cross(*n, *a)
    # p + front_a n = by_a / w and q + front_b n = by_b / w, with w = a.by_a
    whole = -(dot(*g_p, *by_a) + dot(*g_q, *by_b)) * inverse * inverse
    n_first, n_second = cross(*g_p, *b), cross(*a, *g_q)
    a_second, b_first = cross(*g_q, *n), cross(*n, *g_p)
    g_n = (
        (n_first[0] + n_second[0]) * inverse + whole * by_n[0] - front_a * g_p[0] - front_b * g_q[0],
        (n_first[1] + n_second[1]) * inverse + whole * by_n[1] - front_a * g_p[1] - front_b * g_q[1],
        (n_first[2] + n_second[2]) * inverse + whole * by_n[2] - front_a * g_p[2] - front_b * g_q[2],
    )
    g_a = (
        a_second[0] * inverse + whole * by_a[0],
        a_second[1] * inverse + whole * by_a[1],
        a_second[2] * inverse + whole * by_a[2],
    )
    g_b = (
        b_first[0] * inverse + whole * by_b[0],
        b_first[1] * inverse + whole * by_b[1],
        b_first[2] * inverse + whole * by_b[2],
    )
    return g_n, g_a, g_b, -dot(*g_p, *n), -dot(*g_q, *n)


@kernel
def _project_backward(piece, records, rotation, height, width, focal, dilation, grads, offsets, totals):
    rows = np.ones((ALL_ROWS, LANES))
    unit = math.sqrt(layout.UNIT)
    for start in range(piece * PIECE, min((piece + 1) * PIECE, records.shape[0]), LANES):
        count = min(LANES, records.shape[0] - start)
        read_cones(records, start, count, rotation, rows)
        _read_given(records, grads, offsets, start, count, rows)
        for i in range(LANES):
            g_n, g_p, g_q, g_along = _splat_backward(rows, i, height, width, focal, dilation)
            n = rows[RECORD, i], rows[RECORD + 1, i], rows[RECORD + 2, i]
            a = rows[RECORD + 3, i], rows[RECORD + 4, i], rows[RECORD + 5, i]
            b = rows[RECORD + 6, i], rows[RECORD + 7, i], rows[RECORD + 8, i]
            g_p, g_q = (unit * g_p[0], unit * g_p[1], unit * g_p[2]), (unit * g_q[0], unit * g_q[1], unit * g_q[2])
            more, g_a, g_b, g_front_a, g_front_b = _dual_backward(
                n, a, b, rows[RECORD + 9, i], rows[RECORD + 10, i], _turned(rotation, g_p), _turned(rotation, g_q)
            )
            g_n = _turned(rotation, g_n)
            rows[OUT, i], rows[OUT + 1, i], rows[OUT + 2, i] = g_n[0] + more[0], g_n[1] + more[1], g_n[2] + more[2]
            rows[OUT + 3, i], rows[OUT + 4, i], rows[OUT + 5, i] = g_a
            rows[OUT + 6, i], rows[OUT + 7, i], rows[OUT + 8, i] = g_b
            rows[OUT + 9, i], rows[OUT + 10, i] = g_front_a, g_front_b
            rows[OUT + 11, i] = layout.UNIT * g_along
        _add_totals(rows, start, count, grads, offsets, totals)


@inlined
def _add_totals(rows, start, count, grads, offsets, totals):
    for i in range(count):
        g = start + i
        if offsets[g + 1] == offsets[g]:
            continue
        for axis in range(3):
            totals[g, layout.DIRECTION + axis] += np.float32(rows[OUT + axis, i])
        for j in range(9):
            totals[g, layout.FIRST + j] += np.float32(rows[OUT + 3 + j, i])
        for slot in range(offsets[g], offsets[g + 1]):
            totals[g, layout.LEVEL] += grads[slot, layout.LEVEL]


def project_backward(
    observed: Observed,
    picture: Picture,
    dilation: float,
    grads: np.ndarray,
    offsets: np.ndarray,
    totals: np.ndarray,
    threads: int,
) -> None:
    """Add to the gradients of the camera's records what a picture's records pass back.

    Args:
        observed, picture, dilation: of the forward.
        grads: (slot, FIELDS), of the picture's records.
        offsets: (n + 1), where each Gaussian's slots begin.
        totals: (n, FIELDS), added to.
        threads: to work on; the result does not depend on it.
    """
    rotation = np.ascontiguousarray(picture.rotation.numpy())

    def work(piece: int) -> None:
        _project_backward(
            piece, observed.records, rotation, *picture.size, picture.focal, dilation, grads, offsets, totals
        )

    share(work, -(-len(observed.records) // PIECE), threads)
