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

from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.columns import read_columns
from pansplat.rendering.cpu.forms import LEAST_RATIO, dot, whitened, whitening
from pansplat.rendering.cpu.groups import AHEAD, load_four, quarters, write_fours, write_ones, write_threes
from pansplat.rendering.cpu.harmonics import add_slopes, colour_gradients, constant_colour_gradients, fill_basis
from pansplat.rendering.cpu.observe import (
    LANES,
    MEAN,
    OPACITY,
    PIECE,
    RADIUS,
    SHAPE,
    WORLD,
    Camera,
    Fields,
    Observed,
    columns_of_pose,
    direction_of,
    read_block,
    shape_in,
)
from pansplat.rendering.cpu.runtime import inline_kernel, kernel, parallel_for
from pansplat.rendering.cpu.shape_backward import (
    ALL_ROWS,
    GIVEN_RADIUS,
    N_GRAD,
    OUT_SHAPE,
    TOTAL,
    axes_backward,
    covariances_backward,
    totals_of_shape,
)
from pansplat.rendering.cpu.simd import LANES as WIDTH
from pansplat.rendering.cpu.simd import element, fill, load, prefetch, store
from pansplat.rendering.cpu.wide import align_stack, either, fill_wide, get, keep, widened

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


@inline_kernel
def _sum_slots(grad_records, grad_values, totals, offsets, start, count, sums, value_sums, colour_grads, rows):
    """Sum the slots of each Gaussian of a block, in their order; zeros where it has none.

    Args:
        grad_records, grad_values: flat.
        sums: (LANES FIELDS), flat.
        value_sums: (LANES 4 and 4 more), flat; used for three channels.
    """
    channels, none = colour_grads.shape[1], fill(np.float32(0))
    for i in range(count):
        first, end = element(offsets, start + i), element(offsets, start + i + 1)
        low, high, values, radius = none, none, none, np.float32(0)
        prefetch(grad_records, layout.RECORD_SIZE * (first + AHEAD // 4))
        prefetch(grad_values, 4 * (first + AHEAD // 4))
        if channels == 3:  # most; one loop, whose end the processor mistakes once
            for slot in range(first, end):
                if totals is None:
                    low = low + load(grad_records, layout.RECORD_SIZE * slot)
                    high = high + load(grad_records, layout.RECORD_SIZE * slot + WIDTH)
                values = values + load_four(grad_values, 4 * slot)
            store(value_sums, 4 * i, values)
        else:
            colour_grads[i] = 0
            for slot in range(first, end):
                if totals is None:
                    low = low + load(grad_records, layout.RECORD_SIZE * slot)
                    high = high + load(grad_records, layout.RECORD_SIZE * slot + WIDTH)
                for c in range(channels):
                    colour_grads[i, c] += element(grad_values, (channels + 1) * slot + c)
                radius += element(grad_values, (channels + 1) * slot + channels)
            rows[GIVEN_RADIUS, i] = radius
        store(sums, layout.RECORD_SIZE * i, low)
        store(sums, layout.RECORD_SIZE * i + WIDTH, high)
    if channels == 3:
        for i in range(0, LANES, WIDTH):
            keep(rows, GIVEN_RADIUS, i, widened(quarters(value_sums, 4 * i)[3]))


@inline_kernel
def _read_gradients(sums, totals, start, count, singles, rows):
    """Turn the sums of a block's slots into rows of `singles`, or the classic kernel's totals into rows."""
    if totals is not None:
        for i in range(count):
            singles[layout.LOG2_PEAK, i] = totals[start + i, 9]
            for j in range(9):
                rows[TOTAL + j, i] = totals[start + i, j]
        return
    read_columns(sums, 0, count, singles.reshape(-1), LANES)


@inline_kernel
def _clear_undrawn(scene_drawn, start, count, pose, rows, singles, drawn):
    """Give Gaussians that are not drawn any finite place and shape: their gradients are 0 and must stay so."""
    missing = LANES - count
    for i in range(count):
        drawn[i] = element(scene_drawn, start + i) != 0
        missing += element(scene_drawn, start + i) == 0
    if missing == 0:
        return
    for i in range(LANES):
        if i < count and drawn[i]:
            continue
        drawn[i] = False
        rows[MEAN, i], rows[MEAN + 1, i], rows[MEAN + 2, i] = pose[0, 3], pose[1, 3], pose[2, 3]
        rows[MEAN, i] += 1 + abs(pose[0, 3])
        rows[OPACITY, i], rows[GIVEN_RADIUS, i] = 1.0, 0.0
        for j in range(9):
            rows[SHAPE + j, i] = 1.0 if j % 4 == 0 else 0.0
            rows[TOTAL + j, i] = 0.0
        for j in range(layout.RECORD_SIZE):
            singles[j, i] = 0.0


@inline_kernel
def _to_world(pose, vector):
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz), _ = pose
    x, y, z = vector
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


@inline_kernel
def _given(singles, field, i, factor):
    """The gradients of three fields of eight records."""
    return (
        factor * widened(load(singles, field * LANES + i)),
        factor * widened(load(singles, (field + 1) * LANES + i)),
        factor * widened(load(singles, (field + 2) * LANES + i)),
    )


@inline_kernel
def _add_to_pose(sums, n, a, b, g_n, g_a, g_b):
    """The pose's rotation A makes n_camera = A'n, so its gradient is the sum of n g_n' A, and so on; A comes last."""
    for axis in range(3):
        for other in range(3):
            found = n[axis] * g_n[other] + a[axis] * g_a[other] + b[axis] * g_b[other]
            keep(sums, 4 * axis + other, 0, get(sums, 4 * axis + other, 0) + found)


@inline_kernel
def _forms_backward(pose, spread, compensate, u, v, n, shape, singles, i, sums):
    """From the gradients of eight records to that of n, what `quadratic` makes that of C from, and that of ln det B."""
    unit, inverse_unit = math.sqrt(layout.HALF_LOG2_E), 1 / math.sqrt(layout.HALF_LOG2_E)
    (first, mix, second), alpha, beta, along, det_filtered, _ = whitening(shape, spread)
    a, b = whitened(u, v, first, mix, second)
    g_n = _to_world(pose, _given(singles, layout.DIRECTION, i, 1.0))
    g_a = _to_world(pose, _given(singles, layout.ROW_A, i, unit))
    g_b = _to_world(pose, _given(singles, layout.ROW_B, i, unit))
    if sums.shape[0] > 0:
        _add_to_pose(sums, n, a, b, g_n, g_a, g_b)
    g_alpha = inverse_unit * widened(load(singles, layout.L_ALONG_A * LANES + i))
    g_beta = inverse_unit * widened(load(singles, layout.L_ALONG_B * LANES + i))
    g_along = (1 / layout.HALF_LOG2_E) * widened(load(singles, layout.RADIAL_VARIANCE * LANES + i))
    half, by_det = fill_wide(0.0), fill_wide(0.0)
    if compensate:
        counts = shape[6] > LEAST_RATIO * det_filtered
        half = either(counts, (0.5 / math.log(2)) * widened(load(singles, layout.LOG2_PEAK * LANES + i)), half)
        by_det = either(counts, half / shape[6], by_det)
    g_aa = -0.5 * (dot(*g_a, *a) + alpha * g_alpha) - half
    g_ab = -0.5 * (dot(*g_a, *b) + dot(*g_b, *a) + beta * g_alpha + alpha * g_beta)
    g_bb = -0.5 * (dot(*g_b, *b) + beta * g_beta) - half
    length = math.sqrt(det_filtered)
    ahead, back = shape[5] + spread, 2 * (along + spread) * g_along
    by_a = 2 * alpha * g_aa + beta * g_ab - dot(*g_a, *n) + ahead * g_alpha - back * alpha
    by_b = second * (alpha * g_ab + 2 * beta * g_bb - dot(*g_b, *n) + ahead * g_beta - back * beta)
    by_p, by_q = second * length * g_alpha, first * length * g_beta
    by_u, by_v = by_a * first - by_b * mix - by_p, by_b - by_p * mix - by_q  # p = b ^ n, q = n ^ a
    g_n = g_n[0] + by_u * u[0] + by_v * v[0], g_n[1] + by_u * u[1] + by_v * v[1], g_n[2] + by_u * u[2] + by_v * v[2]
    halves = 0.5 * g_aa, 0.5 * g_ab, 0.5 * g_bb, 0.5 * g_alpha, 0.5 * g_beta
    return g_n, ((first, mix, second), (alpha, beta), g_along, halves), by_det


@inline_kernel
def _add_totals(rows, i, u, v, n, shape, g_n, sums):
    """Add what the classic kernel's pictures passed back to the gradient of n, and to the sums for the pose."""
    t_n = get(rows, TOTAL, i), get(rows, TOTAL + 1, i), get(rows, TOTAL + 2, i)
    xx, xy, xz, yy, yz, zz = totals_of_shape(rows, i)
    columns = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
    for other in range(3):
        on_u, on_v, on_n = dot(*u, *columns[other]), dot(*v, *columns[other]), dot(*n, *columns[other])
        by_u = 2 * (shape[0] * on_u + shape[1] * on_v + shape[3] * on_n)
        by_v = 2 * (shape[1] * on_u + shape[2] * on_v + shape[4] * on_n)
        by_n = 2 * (shape[3] * on_u + shape[4] * on_v + shape[5] * on_n) + t_n[other]
        if sums.shape[0] > 0:
            for axis in range(3):
                found = u[axis] * by_u + v[axis] * by_v + n[axis] * by_n
                keep(sums, 4 * axis + other, 0, get(sums, 4 * axis + other, 0) + found)
    return g_n[0] + t_n[0], g_n[1] + t_n[1], g_n[2] + t_n[2]


@inline_kernel
def _shapes_backward(covariances, totals, pose, spread, compensate, near, rows, singles, sums, i):
    """From the gradients of eight Gaussians' records to those of shapes, opacities, directions and distances."""
    n, radius, inverse, state = direction_of(rows, i, pose, near)
    u, v, shape, _ = shape_in(covariances, rows, i, n, inverse, state)
    g_n, parts, g_det = _forms_backward(pose, spread, compensate, u, v, n, shape, singles, i, sums)
    if totals is not None:
        g_n = _add_totals(rows, i, u, v, n, shape, g_n, sums)
    if covariances is not None:
        g_n, g_radius = covariances_backward(rows, i, totals, u, v, n, shape, inverse, g_n, parts, g_det)
    else:
        g_n, g_radius = axes_backward(rows, i, totals, u, n, inverse, g_n, parts, g_det)
    keep(rows, GIVEN_RADIUS, i, get(rows, GIVEN_RADIUS, i) + g_radius)
    level = (1 / math.log(2)) * widened(load(singles, layout.LOG2_PEAK * LANES + i))
    keep(rows, OPACITY, i, level / get(rows, OPACITY, i))
    keep(rows, RADIUS, i, radius)
    for axis in range(3):
        keep(rows, N_GRAD + axis, i, g_n[axis])
        keep(rows, WORLD + axis, i, n[axis])


@inline_kernel
def _means_backward(rows, sums):
    """Gradient of the mean from those of direction and distance."""
    for i in range(0, LANES, WIDTH):
        n = get(rows, WORLD, i), get(rows, WORLD + 1, i), get(rows, WORLD + 2, i)
        g = get(rows, N_GRAD, i), get(rows, N_GRAD + 1, i), get(rows, N_GRAD + 2, i)
        inverse = 1 / get(rows, RADIUS, i)
        outward = get(rows, GIVEN_RADIUS, i) - dot(*g, *n) * inverse
        for axis in range(3):
            grad = g[axis] * inverse + outward * n[axis]
            keep(rows, N_GRAD + axis, i, grad)
            if sums.shape[0] > 0:
                keep(sums, 4 * axis + 3, 0, get(sums, 4 * axis + 3, 0) - grad)


@kernel
def _chain(
    piece, means, quats, scales, covariances, opacities, harmonics, pose, spread, compensate, near, bends,
    scene_drawn, values, grad_records, grad_values, totals, offsets,
    grad_means, grad_quats, grad_scales, grad_covariances, grad_opacities, grad_harmonics, pose_sums,
):  # fmt: skip
    align_stack()
    rows, sums, camera = (
        np.ones((ALL_ROWS, LANES)),
        np.zeros((_POSE if pose_sums.shape[0] > 0 else 0, WIDTH)),
        columns_of_pose(pose),
    )
    slot_sums, value_sums = np.zeros(LANES * layout.RECORD_SIZE, np.float32), np.zeros(4 * LANES + 4, np.float32)
    singles, drawn = np.zeros((layout.RECORD_SIZE, LANES), np.float32), np.zeros(LANES, np.bool_)
    basis, slopes = np.zeros((25, LANES), np.float32), np.zeros((25, LANES), np.float32)
    colour_grads = np.zeros((LANES, harmonics.shape[2]), np.float32)
    for start in range(piece * PIECE, min((piece + 1) * PIECE, means.shape[0]), LANES):
        count = min(LANES, means.shape[0] - start)
        read_block(means, quats, scales, covariances, opacities, start, count, rows)
        _sum_slots(grad_records, grad_values, totals, offsets, start, count, slot_sums, value_sums, colour_grads, rows)
        _read_gradients(slot_sums, totals, start, count, singles, rows)
        _clear_undrawn(scene_drawn, start, count, pose, rows, singles, drawn)
        for i in range(0, LANES, WIDTH):
            _shapes_backward(covariances, totals, camera, spread, compensate, near, rows, singles.reshape(-1), sums, i)
        if bends is None:
            constant_colour_gradients(harmonics, start, count, values, value_sums, colour_grads, grad_harmonics)
        if bends is not None:
            if harmonics.shape[2] == 3:
                for i in range(count):
                    for c in range(3):
                        colour_grads[i, c] = element(value_sums, 4 * i + c)
            fill_basis(rows, WORLD, harmonics.shape[1], bends, basis)
            colour_gradients(harmonics, start, drawn, basis, values, colour_grads, grad_harmonics, slopes)
            add_slopes(rows, WORLD, harmonics.shape[1], bends, slopes, N_GRAD)
        _means_backward(rows, sums)
        _write(rows, start, count, grad_means, grad_quats, grad_scales, grad_covariances, grad_opacities)
    for j in range(sums.shape[0]):
        total = 0.0
        for i in range(WIDTH):
            total += sums[j, i]
        pose_sums[piece, j] = total


@inline_kernel
def _write(rows, start, count, grad_means, grad_quats, grad_scales, grad_covariances, grad_opacities):
    if grad_means.shape[0] > 0:
        write_threes(rows, N_GRAD, start, count, grad_means.reshape(-1))
    if grad_opacities.shape[0] > 0:
        write_ones(rows, OPACITY, start, count, grad_opacities)
    if grad_quats.shape[0] > 0:
        write_fours(rows, OUT_SHAPE, start, count, grad_quats.reshape(-1))
    if grad_scales.shape[0] > 0:
        write_threes(rows, OUT_SHAPE + 4, start, count, grad_scales.reshape(-1))
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
        wanted: arrays to fill; those without rows are left alone, and no `pose` is found where it has none.
        threads: to work on; the result does not depend on it.
    """
    pieces = -(-len(fields.means) // PIECE)
    sums = np.zeros((pieces if len(wanted.pose) > 0 else 0, _POSE))

    def work(piece: int) -> None:
        _chain(
            piece, *fields.given, *camera, fields.bends, observed.drawn, observed.values,
            grad_records.reshape(-1), grad_values.reshape(-1), totals if len(totals) > 0 else None, offsets,
            *wanted[:6], sums,
        )  # fmt: skip

    parallel_for(work, pieces, threads)
    if len(wanted.pose) == 0:
        return wanted
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
