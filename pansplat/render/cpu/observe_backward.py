"""Stage six: from gradients of records and values to those of the Gaussians' fields and the camera's pose.

Source: docs/rendering.md, sections 1 to 3, differentiated by hand. The axes a and b may be turned about n together
without changing a picture, so their derivative is taken in the gauge where it is symmetric. With E = C + e^2,
p the axis dual to a and q that to b, a motion dn across n and a change dC of the covariance,

    X_aa = a'dC a + 2 alpha a.dn     X_ab = a'dC b + beta a.dn + alpha b.dn     X_bb = b'dC b + 2 beta b.dn
    da = -(X_aa a + X_ab b) / 2 - (a.dn) n
    dalpha = -(alpha X_aa + beta X_ab) / 2 + (g + e^2) a.dn - p.dn - a'dC n
    dS' = l'dC l - 2 (S' + e^2) (l - n).dn
    d ln det B' = X_aa + X_bb

and likewise for b. Nothing is divided by a width, so needles and discs are no worse than the forward.
"""

import math
from typing import NamedTuple

import numpy as np

from pansplat.render.cpu import records as layout
from pansplat.render.cpu.columns import read_columns
from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.forms import LEAST_RATIO, cross, dot, ray_forms
from pansplat.render.cpu.harmonics import add_slopes, colour_gradients, fill_basis
from pansplat.render.cpu.observe import (
    LANES,
    PIECE,
    RADIUS,
    SHAPE,
    WORLD,
    Camera,
    Fields,
    Observed,
    find_directions,
    find_shapes,
    frame_and_shape,
    read_block,
)
from pansplat.render.cpu.shape_backward import (
    ALL_ROWS,
    C_GRAD,
    DET_GRAD,
    GIVEN,
    GIVEN_RADIUS,
    N_GRAD,
    OUT_MEAN,
    OUT_SHAPE,
    axes_backward,
    covariances_backward,
)
from pansplat.render.cpu.simd import LANES as WIDTH
from pansplat.render.cpu.simd import element, fill, load, store
from pansplat.render.cpu.threads import share

_POSE = 12  # sums for the pose: its rotation by rows, its centre


class Gradients(NamedTuple):
    """Gradients of the fields, float32 like them; no rows where not asked for. `pose` is (3, 4) float64."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray
    pose: np.ndarray


@inlined
def _sum_slots(grad_records, grad_values, totals, offsets, start, count, sums, colour_grads, rows):
    """Sum the slots of each Gaussian of a block, in their order; zeros where it has none.

    Args:
        grad_records, grad_values: flat.
        sums: (LANES FIELDS), flat.
    """
    channels, none, zero = colour_grads.shape[1], fill(np.float32(0)), np.float32(0)
    for i in range(count):
        first, end = element(offsets, start + i), element(offsets, start + i + 1)
        low, high, radius = none, none, zero
        if channels == 3:  # most; one loop, whose end the processor mistakes once
            red, green, blue = zero, zero, zero
            for slot in range(first, end):
                if totals is None:
                    low = low + load(grad_records, layout.FIELDS * slot)
                    high = high + load(grad_records, layout.FIELDS * slot + WIDTH)
                red, green = red + element(grad_values, 4 * slot), green + element(grad_values, 4 * slot + 1)
                blue, radius = blue + element(grad_values, 4 * slot + 2), radius + element(grad_values, 4 * slot + 3)
            colour_grads[i, 0], colour_grads[i, 1], colour_grads[i, 2] = red, green, blue
        else:
            colour_grads[i] = 0
            for slot in range(first, end):
                if totals is None:
                    low = low + load(grad_records, layout.FIELDS * slot)
                    high = high + load(grad_records, layout.FIELDS * slot + WIDTH)
                for c in range(channels):
                    colour_grads[i, c] += element(grad_values, (channels + 1) * slot + c)
                radius += element(grad_values, (channels + 1) * slot + channels)
        rows[GIVEN_RADIUS, i] = radius
        store(sums, layout.FIELDS * i, low)
        store(sums, layout.FIELDS * i + WIDTH, high)


@inlined
def _read_gradients(sums, totals, start, count, singles, rows):
    """Turn the sums of a block's slots into rows, in the units of docs/rendering.md."""
    unit, inverse_unit = math.sqrt(layout.UNIT), 1 / math.sqrt(layout.UNIT)
    if totals is not None:
        for j in range(12):
            for i in range(LANES):
                rows[GIVEN + j, i] = 0.0
        for i in range(count):
            rows[GIVEN + 12, i] = totals[start + i, 9] / math.log(2)
        return
    read_columns(sums, 0, count, singles.reshape(-1), LANES)
    for j in range(3):
        for i in range(LANES):
            rows[GIVEN + j, i] = singles[layout.DIRECTION + j, i]
    for j in range(6):
        for i in range(LANES):
            rows[GIVEN + 3 + j, i] = unit * singles[layout.FIRST + j, i]
    for i in range(LANES):
        rows[GIVEN + 9, i] = inverse_unit * singles[layout.FRONT_A, i]
        rows[GIVEN + 10, i] = inverse_unit * singles[layout.FRONT_B, i]
        rows[GIVEN + 11, i] = singles[layout.ALONG, i] * (1 / layout.UNIT)
        rows[GIVEN + 12, i] = singles[layout.LEVEL, i] * (1 / math.log(2))


@inlined
def _to_world(pose, x, y, z):
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z,
    )


@inlined
def _forms_backward(pose, spread, compensate, rows, sums):
    """Gradients of n, C and ln det B from those of the record; adds to the sums for the pose, lane by lane.

    The pose's rotation A makes n_camera = A'n, so its gradient is the sum of n g_n' A, and so on; A comes last.
    """
    for i in range(LANES):
        u, v, n, shape = frame_and_shape(rows, i)
        a, b, alpha, beta, along, det_filtered = ray_forms(u, v, shape, spread)
        n_camera = rows[GIVEN, i], rows[GIVEN + 1, i], rows[GIVEN + 2, i]
        a_camera = rows[GIVEN + 3, i], rows[GIVEN + 4, i], rows[GIVEN + 5, i]
        b_camera = rows[GIVEN + 6, i], rows[GIVEN + 7, i], rows[GIVEN + 8, i]
        g_n, g_a, g_b = _to_world(pose, *n_camera), _to_world(pose, *a_camera), _to_world(pose, *b_camera)
        for axis in range(3):
            for other in range(3):
                sums[4 * axis + other, i] += n[axis] * g_n[other] + a[axis] * g_a[other] + b[axis] * g_b[other]
        g_alpha, g_beta, g_along, g_peak = (
            rows[GIVEN + 9, i],
            rows[GIVEN + 10, i],
            rows[GIVEN + 11, i],
            rows[GIVEN + 12, i],
        )
        counts = compensate & (shape[6] > LEAST_RATIO * det_filtered)
        half = 0.5 * g_peak if counts else 0.0
        g_aa = -0.5 * (dot(*g_a, *a) + alpha * g_alpha) - half
        g_ab = -0.5 * (dot(*g_a, *b) + dot(*g_b, *a) + beta * g_alpha + alpha * g_beta)
        g_bb = -0.5 * (dot(*g_b, *b) + beta * g_beta) - half
        length = math.sqrt(det_filtered)
        p, q = cross(*b, *n), cross(*n, *a)
        ahead, back = shape[5] + spread, 2 * (along + spread) * g_along
        by_a = 2 * alpha * g_aa + beta * g_ab - dot(*g_a, *n) + ahead * g_alpha - back * alpha
        by_b = alpha * g_ab + 2 * beta * g_bb - dot(*g_b, *n) + ahead * g_beta - back * beta
        by_p, by_q = -length * g_alpha, -length * g_beta
        rows[DET_GRAD, i] = half / shape[6] if counts else 0.0
        for axis in range(3):
            rows[N_GRAD + axis, i] = g_n[axis] + by_a * a[axis] + by_b * b[axis] + by_p * p[axis] + by_q * q[axis]
        # Rows of the gradient of C are combinations of a, b, n, l; symmetric once its transpose is added.
        row_a = (
            g_aa * a[0] + g_ab * b[0] - g_alpha * n[0],
            g_aa * a[1] + g_ab * b[1] - g_alpha * n[1],
            g_aa * a[2] + g_ab * b[2] - g_alpha * n[2],
        )
        row_b = (g_bb * b[0] - g_beta * n[0], g_bb * b[1] - g_beta * n[1], g_bb * b[2] - g_beta * n[2])
        front = (
            n[0] + alpha * a[0] + beta * b[0],
            n[1] + alpha * a[1] + beta * b[1],
            n[2] + alpha * a[2] + beta * b[2],
        )
        at = C_GRAD
        for axis in range(3):
            for other in range(axis, 3):
                rows[at, i] = g_along * front[axis] * front[other] + 0.5 * (
                    a[axis] * row_a[other] + a[other] * row_a[axis] + b[axis] * row_b[other] + b[other] * row_b[axis]
                )
                at += 1


@inlined
def _add_totals(totals, start, drawn, rows, sums):
    """Add what the classic kernel's pictures passed back to the gradients of n and C, and to the sums for the pose."""
    for i in range(LANES):
        if drawn[i]:
            for j in range(3):
                rows[N_GRAD + j, i] += totals[start + i, j]
                rows[OUT_MEAN + j, i] = totals[start + i, j]
            for j in range(6):
                rows[C_GRAD + j, i] += totals[start + i, 3 + j]
                rows[OUT_SHAPE + j, i] = totals[start + i, 3 + j]
        else:
            for j in range(9):
                rows[OUT_MEAN + j, i] = 0.0
    for i in range(LANES):
        u, v, n, shape = frame_and_shape(rows, i)
        xx, xy, xz = rows[OUT_SHAPE, i], rows[OUT_SHAPE + 1, i], rows[OUT_SHAPE + 2, i]
        yy, yz, zz = rows[OUT_SHAPE + 3, i], rows[OUT_SHAPE + 4, i], rows[OUT_SHAPE + 5, i]
        g_n = rows[OUT_MEAN, i], rows[OUT_MEAN + 1, i], rows[OUT_MEAN + 2, i]
        columns = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
        for other in range(3):
            on_u, on_v, on_n = dot(*u, *columns[other]), dot(*v, *columns[other]), dot(*n, *columns[other])
            by_u = 2 * (shape[0] * on_u + shape[1] * on_v + shape[3] * on_n)
            by_v = 2 * (shape[1] * on_u + shape[2] * on_v + shape[4] * on_n)
            by_n = 2 * (shape[3] * on_u + shape[4] * on_v + shape[5] * on_n) + g_n[other]
            for axis in range(3):
                sums[4 * axis + other, i] += u[axis] * by_u + v[axis] * by_v + n[axis] * by_n


@inlined
def _means_backward(rows, sums):
    """Gradient of the mean from those of direction and distance."""
    for i in range(LANES):
        n = rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i]
        g = rows[N_GRAD, i], rows[N_GRAD + 1, i], rows[N_GRAD + 2, i]
        inverse = 1 / rows[RADIUS, i]
        outward = rows[GIVEN_RADIUS, i] - dot(*g, *n) * inverse
        for axis in range(3):
            grad = g[axis] * inverse + outward * n[axis]
            rows[OUT_MEAN + axis, i] = grad
            sums[4 * axis + 3, i] -= grad


@inlined
def _clear_undrawn(scene_drawn, start, count, rows, drawn):
    """Give Gaussians that are not drawn any finite shape, since their gradients are 0 and must stay so."""
    for i in range(LANES):
        drawn[i] = i < count and scene_drawn[start + i] != 0
        if not drawn[i]:
            rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i], rows[RADIUS, i] = 0.0, 0.0, 1.0, 1.0
            for j in range(9):
                rows[SHAPE + j, i] = 1.0 if j % 4 == 0 else 0.0
            for j in range(14):
                rows[GIVEN + j, i] = 0.0


@kernel
def _chain(
    piece, means, quats, scales, covariances, opacities, harmonics, pose, spread, compensate, near, bends,
    scene_drawn, values, grad_records, grad_values, totals, offsets,
    grad_means, grad_quats, grad_scales, grad_covariances, grad_opacities, grad_harmonics, pose_sums,
):  # fmt: skip
    rows = np.ones((ALL_ROWS, LANES))
    sums, slot_sums = np.zeros((_POSE, LANES)), np.zeros(LANES * layout.FIELDS, np.float32)
    singles = np.zeros((layout.FIELDS, LANES), np.float32)
    basis, slopes = np.zeros((25, LANES), np.float32), np.zeros((25, LANES), np.float32)
    colour_grads, drawn = np.zeros((LANES, harmonics.shape[2]), np.float32), np.zeros(LANES, np.bool_)
    for start in range(piece * PIECE, min((piece + 1) * PIECE, means.shape[0]), LANES):
        count = min(LANES, means.shape[0] - start)
        read_block(means, quats, scales, covariances, opacities, start, count, rows)
        _sum_slots(grad_records, grad_values, totals, offsets, start, count, slot_sums, colour_grads, rows)
        _read_gradients(slot_sums, totals, start, count, singles, rows)
        find_directions(pose, near, rows)
        _clear_undrawn(scene_drawn, start, count, rows, drawn)
        find_shapes(covariances, rows)
        _forms_backward(pose, spread, compensate, rows, sums)
        if totals is not None:
            _add_totals(totals, start, drawn, rows, sums)
        if covariances is not None:
            covariances_backward(rows)
        else:
            axes_backward(rows)
        fill_basis(rows, WORLD, harmonics.shape[1], bends, basis)
        colour_gradients(harmonics, start, drawn, basis, values, colour_grads, grad_harmonics, slopes)
        add_slopes(rows, WORLD, harmonics.shape[1], bends, slopes, N_GRAD)
        _means_backward(rows, sums)
        _write_means(rows, opacities, drawn, start, count, grad_means, grad_opacities)
        _write_shapes(rows, start, count, grad_quats, grad_scales, grad_covariances)
    for j in range(_POSE):
        total = 0.0
        for i in range(LANES):
            total += sums[j, i]
        pose_sums[piece, j] = total


@inlined
def _write_means(rows, opacities, drawn, start, count, grad_means, grad_opacities):
    if grad_means.shape[0] > 0:
        for i in range(count):
            for axis in range(3):
                grad_means[start + i, axis] = rows[OUT_MEAN + axis, i]
    if grad_opacities.shape[0] > 0:
        for i in range(count):
            grad_opacities[start + i] = rows[GIVEN + 12, i] / opacities[start + i] if drawn[i] else 0.0


@inlined
def _write_shapes(rows, start, count, grad_quats, grad_scales, grad_covariances):
    if grad_quats.shape[0] > 0:
        for i in range(count):
            for j in range(4):
                grad_quats[start + i, j] = rows[OUT_SHAPE + j, i]
    if grad_scales.shape[0] > 0:
        for i in range(count):
            for j in range(3):
                grad_scales[start + i, j] = rows[OUT_SHAPE + 4 + j, i]
    if grad_covariances.shape[0] > 0:
        for i in range(count):
            for axis in range(3):
                for other in range(3):
                    j = axis + other + (1 if axis > 0 and other > 0 else 0)
                    grad_covariances[start + i, axis, other] = rows[OUT_SHAPE + j, i]


def chain(
    fields: Fields,
    camera: Camera,
    observed: Observed,
    grad_records: np.ndarray,
    grad_values: np.ndarray,
    totals: np.ndarray,
    offsets: np.ndarray,
    wanted: Gradients,
    threads: int,
) -> Gradients:
    """The fields' gradients.

    Args:
        fields, camera, observed: of the forward.
        grad_records: (slot, FIELDS), see records.py; gradients of the camera's records.
        grad_values: (slot, channel + 1).
        totals: of the classic kernel (see ewa.py), in place of `grad_records`; else no rows.
        offsets: (n + 1), where each Gaussian's slots begin.
        wanted: arrays to fill; those without rows are left alone.
        threads: to work on; the result does not depend on it.
    """
    pieces = -(-len(fields.means) // PIECE)
    sums = np.zeros((pieces, _POSE))

    def work(piece: int) -> None:
        _chain(
            piece, *fields.given, *camera, fields.bends, observed.drawn, observed.values,
            grad_records.reshape(-1), grad_values.reshape(-1), totals if len(totals) > 0 else None, offsets,
            *wanted[:6], sums,
        )  # fmt: skip

    share(work, pieces, threads)
    pose = sums.sum(axis=0).reshape(3, 4)
    pose[:, :3] = pose[:, :3] @ camera.pose[:3, :3]
    return wanted._replace(pose=pose)


@kernel
def add_slots(piece, offsets, slot_grads, totals):
    """Add each Gaussian's slots, in their order, to its totals."""
    for g in range(piece * PIECE, min((piece + 1) * PIECE, totals.shape[0])):
        for slot in range(offsets[g], offsets[g + 1]):
            for j in range(totals.shape[1]):
                totals[g, j] += slot_grads[slot, j]
