"""Gradients of what one camera sees of each Gaussian: the geometry in one kernel, the colours by torch.

Source: docs/rendering.md, sections 1 to 3. Everything is differentiated as a function of n and C, whose six numbers
in the tangent frame u, v, n are called uu, uv, un, vv, vn, nn here. A picture does not depend on how u and v turn
about n, so they are taken to move without turning. That is right for gradients of pictures (not for those of a single
form), and for the pose along rigid motions.
"""

# ruff: noqa: RUF005  # Triton does not unpack into a tuple

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.harmonics import evaluate_harmonics
from pansplat.rendering.cuda.body import from_axes, from_covariance, in_frame, own_axes
from pansplat.rendering.cuda.response import load_numbers
from pansplat.rendering.cuda.vectors import (
    dot,
    load_fields,
    products,
    store_fields,
    symmetric,
    tangents,
    times,
    turn,
    unturn,
)
from pansplat.rendering.projection import ProjectedGaussians

_BLOCK = 64
"""Gaussians a program; its gradients of the pose are summed in it, and over programs by torch."""

_CHUNK = 1 << 18
"""Gaussians at once where torch holds the graph of their colours, up to 2 kB each."""


@triton.jit
@no_type_check
def forms_backward(by_forms, frame, six, spread, det):
    """From slopes by a, b, l: those by uu, uv, un, vv, vn, by det B', and by the turns of n towards u and v."""
    u, v, n = frame[0], frame[1], frame[2]
    uu, uv, un, vv, vn = six[0] + spread, six[1], six[2], six[3] + spread, six[4]
    by_a, by_b = (by_forms[0], by_forms[1], by_forms[2]), (by_forms[3], by_forms[4], by_forms[5])
    by_l = (by_forms[6], by_forms[7], by_forms[8])
    first, second, slant = 1 / tl.sqrt(uu), tl.sqrt(uu / det), uv / uu
    p_u, p_v = (uv * vn - vv * un) / det, (uv * un - uu * vn) / det
    by_slant = -second * dot(by_b, u)
    by_second = dot(by_b, v) - slant * dot(by_b, u)
    by_p_u, by_p_v = dot(by_l, u), dot(by_l, v)
    by_uu = -0.5 * first * dot(by_a, u) / uu - by_slant * slant / uu + 0.5 * by_second * second / uu - by_p_v * vn / det
    by_uv = by_slant / uu + (by_p_u * vn + by_p_v * un) / det
    by_un, by_vn = (by_p_v * uv - by_p_u * vv) / det, (by_p_u * uv - by_p_v * uu) / det
    by_vv = -by_p_u * un / det
    by_det = -0.5 * by_second * second / det - (by_p_u * p_u + by_p_v * p_v) / det
    # A turn of n takes u and v along: du = -(u . dn) n.
    by_u_along = first * dot(by_a, n) - slant * second * dot(by_b, n) + p_u * dot(by_l, n)
    by_v_along = second * dot(by_b, n) + p_v * dot(by_l, n)
    return (by_uu, by_uv, by_un, by_vv, by_vn), by_det, dot(by_l, u) - by_u_along, dot(by_l, v) - by_v_along


@triton.jit
@no_type_check
def minors_backward(by_minors, six, BY_AXES: tl.constexpr):
    """From slopes by det B, tr B, g, M and det C: those by uu, uv, un, vv, vn, nn."""
    uu, uv, un, vv, vn, nn = six[0], six[1], six[2], six[3], six[4], six[5]
    by_across, by_trace, by_along = by_minors[0], by_minors[1], by_minors[2]
    by_mixed, by_det = by_minors[3], by_minors[4]
    across, mixed = uu * vv - uv * uv, nn * (uu + vv) - un * un - vn * vn
    if not BY_AXES:  # given covariances, what rounding made negative counted as zero
        det = uu * (vv * nn - vn * vn) - uv * (uv * nn - vn * un) + un * (uv * vn - vv * un)
        by_across, by_trace = tl.where(across >= 0, by_across, 0.0), tl.where(uu + vv >= 0, by_trace, 0.0)
        by_along, by_mixed = tl.where(nn >= 0, by_along, 0.0), tl.where(mixed >= 0, by_mixed, 0.0)
        by_det = tl.where(det >= 0, by_det, 0.0)
    return (
        by_across * vv + by_trace + by_mixed * nn + by_det * (vv * nn - vn * vn),
        -2 * by_across * uv + 2 * by_det * (un * vn - uv * nn),
        -2 * by_mixed * un + 2 * by_det * (uv * vn - vv * un),
        by_across * uu + by_trace + by_mixed * nn + by_det * (uu * nn - un * un),
        -2 * by_mixed * vn + 2 * by_det * (uv * un - uu * vn),
        by_along + by_mixed * (uu + vv) + by_det * across,
    )


@triton.jit
@no_type_check
def quats_backward(by_axes, quats, at, there):
    """From slopes by the columns of the rotation."""
    quat = load_fields(quats, at, there, 4)
    norm = tl.sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    safe = tl.where(norm > 0, norm, 1.0)
    w, x, y, z = quat[0] / safe, quat[1] / safe, quat[2] / safe, quat[3] / safe
    one, two, three = by_axes[0], by_axes[1], by_axes[2]  # columns
    by_w = 2 * (z * (one[1] - two[0]) + y * (three[0] - one[2]) + x * (two[2] - three[1]))
    by_x = 2 * (y * (two[0] + one[1]) + z * (three[0] + one[2]) + w * (two[2] - three[1]) - 2 * x * (two[1] + three[2]))
    by_y = 2 * (x * (two[0] + one[1]) + z * (three[1] + two[2]) + w * (three[0] - one[2]) - 2 * y * (one[0] + three[2]))
    by_z = 2 * (x * (three[0] + one[2]) + y * (three[1] + two[2]) + w * (one[1] - two[0]) - 2 * z * (one[0] + two[1]))
    radial = by_w * w + by_x * x + by_y * y + by_z * z
    scale = tl.where(norm > 0, 1 / safe, 0.0)
    return (
        (by_w - radial * w) * scale,
        (by_x - radial * x) * scale,
        (by_y - radial * y) * scale,
        (by_z - radial * z) * scale,
    )


@triton.jit
@no_type_check
def frame_backward(six, body, frame, spread, opacity, by_peak, by_forms, by_along, SIZES: tl.constexpr):
    """Slopes by C's six numbers, by the turns of n towards u and v, and by the opacity.

    Args:
        six: C in the tangent frame, before the filter.
        body: det B, tr B, g, M, det C.
        frame: u, v, n.
        spread: e^2.
        opacity: before the filter.
        by_peak, by_forms, by_along: slopes; the latter two only of the exact kernel.
        SIZES: the kernel's BY_AXES, COMPENSATE, EXACT.
    """
    det = body[0] + spread * body[1] + spread * spread
    zero = det * 0
    g, by_det, turn_u, turn_v = (zero, zero, zero, zero, zero), zero, zero, zero
    by_minors = (zero, zero, zero, zero, zero)
    if SIZES[2]:
        g, by_det, turn_u, turn_v = forms_backward(by_forms, frame, six, spread, det)
        along = (spread * spread * body[2] + spread * body[3] + body[4]) / det
        by_minors = (zero, zero, spread * spread * by_along / det, spread * by_along / det, by_along / det)
        by_det -= by_along * along / det
    if SIZES[1]:
        ratio = body[0] / det
        root = tl.sqrt(tl.maximum(ratio, 1e-12))
        by_ratio = tl.where(ratio >= 1e-12, 0.5 * by_peak * opacity / root, 0.0)
        by_minors = (by_ratio / det, zero, by_minors[2], by_minors[3], by_minors[4])
        by_det -= by_ratio * ratio / det
        by_peak = by_peak * root
    by_minors = (by_minors[0] + by_det, spread * by_det, by_minors[2], by_minors[3], by_minors[4])
    m = minors_backward(by_minors, six, SIZES[0])
    uu, uv, un, vv, vn, nn = g[0] + m[0], g[1] + m[1], g[2] + m[2], g[3] + m[3], g[4] + m[4], m[5]
    turn_u += 2 * (nn - uu) * six[2] + un * (six[0] - six[5]) + vn * six[1] - uv * six[4]
    turn_v += 2 * (nn - vv) * six[4] + vn * (six[3] - six[5]) + un * six[1] - uv * six[2]
    return (uu, uv, un, vv, vn, nn), turn_u, turn_v, by_peak


@triton.jit
@no_type_check
def matrix_of(six, frame):
    """The symmetric matrix S in camera axes whose sum of products with C is sum of six x (uu, uv, un, vv, vn, nn)."""
    u, v, n = frame[0], frame[1], frame[2]
    # Halves: what pairs of different vectors get stands on both sides of the diagonal.
    rows = ()
    for i in tl.static_range(3):
        rows = rows + (
            (
                six[0] * u[i] + 0.5 * (six[1] * v[i] + six[2] * n[i]),
                six[3] * v[i] + 0.5 * (six[1] * u[i] + six[4] * n[i]),
                six[5] * n[i] + 0.5 * (six[2] * u[i] + six[4] * v[i]),
            ),
        )
    return (
        rows[0][0] * u[0] + rows[0][1] * v[0] + rows[0][2] * n[0],
        rows[0][0] * u[1] + rows[0][1] * v[1] + rows[0][2] * n[1],
        rows[0][0] * u[2] + rows[0][1] * v[2] + rows[0][2] * n[2],
        rows[1][0] * u[1] + rows[1][1] * v[1] + rows[1][2] * n[1],
        rows[1][0] * u[2] + rows[1][1] * v[2] + rows[1][2] * n[2],
        rows[2][0] * u[2] + rows[2][1] * v[2] + rows[2][2] * n[2],
    )


@triton.jit
@no_type_check
def axes_backward(by_c, quats, scales, by_quats, by_scales, pose, radius, at, there):
    """Writes the slopes by quaternions and scales."""
    axes = own_axes(quats, at, there)
    scale = load_fields(scales, at, there, 3)
    by_axes, by_scale = (), ()
    for k in tl.static_range(3):
        axis = turn(pose, axes[k])
        slope = times(by_c, axis)
        factor = 2 * scale[k] / (radius * radius)
        by_scale = by_scale + (factor * dot(axis, slope),)
        slope = unturn(pose, slope)
        factor = factor * scale[k]
        by_axes = by_axes + ((factor * slope[0], factor * slope[1], factor * slope[2]),)
    store_fields(by_quats, at, there, quats_backward(by_axes, quats, at, there), 4)
    store_fields(by_scales, at, there, by_scale, 3)


@triton.jit
@no_type_check
def covariances_backward(by_c, by_covariances, pose, radius, at, there):
    """Writes the slopes by covariances."""
    x, y, z = (pose[0], pose[1], pose[2]), (pose[4], pose[5], pose[6]), (pose[8], pose[9], pose[10])
    square = radius * radius
    xx, yy, zz = products(by_c, x, x) / square, products(by_c, y, y) / square, products(by_c, z, z) / square
    xy, xz, yz = products(by_c, x, y) / square, products(by_c, x, z) / square, products(by_c, y, z) / square
    store_fields(by_covariances, at, there, (xx, xy, xz, xy, yy, yz, xz, yz, zz), 9)


@triton.jit
@no_type_check
def pose_backward(out, pose, world, c, by_n, by_c, by_offset, there):
    """Writes a program's slopes by the pose: n = A' w and C = A' (world C) A, the offset is mean - t."""
    rows = ((c[0], c[1], c[2]), (c[1], c[3], c[4]), (c[2], c[4], c[5]))
    columns = ((by_c[0], by_c[1], by_c[2]), (by_c[1], by_c[3], by_c[4]), (by_c[2], by_c[4], by_c[5]))
    for i in tl.static_range(3):
        for j in tl.static_range(3):
            slope = world[i] * by_n[j]
            for k in tl.static_range(3):
                slope += 2 * pose[4 * i + k] * dot(rows[k], columns[j])
            tl.store(out + 4 * i + j, tl.sum(tl.where(there, slope, 0.0), axis=0))
        tl.store(out + 4 * i + 3, -tl.sum(tl.where(there, by_offset[i], 0.0), axis=0))


# fmt: off
@triton.jit(do_not_specialize=["num"])
@no_type_check
def observe_backward_kernel(
    means, opacities, first_shape, second_shape, camera,
    by_worlds, by_directions, by_radii, by_covariances, by_peaks, by_forms, by_alongs,
    by_means, by_opacities, by_first_shape, by_second_shape, by_camera, num,
    BY_AXES: tl.constexpr, COMPENSATE: tl.constexpr, EXACT: tl.constexpr, BLOCK: tl.constexpr,
):
    """Writes the gradients of the geometry. `by_worlds` are slopes by the direction in world axes, of the colours."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = at < num
    pose = load_numbers(camera, 17)
    spread = pose[16]
    mean = load_fields(means, at, there, 3)
    offset = (mean[0] - pose[3], mean[1] - pose[7], mean[2] - pose[11])
    radius = tl.where(there, tl.sqrt(dot(offset, offset)), 1.0)
    world = (offset[0] / radius, offset[1] / radius, offset[2] / radius)
    n = turn(pose, world)
    u, v = tangents(n)
    if BY_AXES:
        c, body = from_axes(first_shape, second_shape, pose, radius, n, at, there)
    else:
        c, body = from_covariance(first_shape, pose, radius, u, v, n, at, there)
    six = in_frame(c, u, v, n)
    by_shape, turn_u, turn_v, by_opacity = frame_backward(
        six, body, (u, v, n), spread, load_fields(opacities, at, there, 1)[0], load_fields(by_peaks, at, there, 1)[0],
        load_fields(by_forms, at, there, 9 if EXACT else 0), load_fields(by_alongs, at, there, 1)[0],
        (BY_AXES, COMPENSATE, EXACT),
    )  # fmt: skip
    tl.store(by_opacities + at, by_opacity, mask=there)
    by_n = load_fields(by_directions, at, there, 3)
    by_filtered = load_fields(by_covariances, at, there, 9)
    direct = symmetric(by_filtered)
    widened = times(direct, n)
    shaped = matrix_of(by_shape, (u, v, n))
    by_c = ()
    for k in tl.static_range(6):
        by_c = by_c + (direct[k] + shaped[k],)
    by_camera_n = ()
    for k in tl.static_range(3):
        by_camera_n = by_camera_n + (by_n[k] + turn_u * u[k] + turn_v * v[k] - 2 * spread * widened[k],)
    if BY_AXES:
        axes_backward(by_c, first_shape, second_shape, by_first_shape, by_second_shape, pose, radius, at, there)
    else:
        covariances_backward(by_c, by_first_shape, pose, radius, at, there)
    contracted = c[0] * by_c[0] + c[3] * by_c[3] + c[5] * by_c[5]
    contracted += 2 * (c[1] * by_c[1] + c[2] * by_c[2] + c[4] * by_c[4])
    by_radius = load_fields(by_radii, at, there, 1)[0] - 2 * contracted / radius
    by_colour, turned = load_fields(by_worlds, at, there, 3), unturn(pose, by_camera_n)
    by_world = (by_colour[0] + turned[0], by_colour[1] + turned[1], by_colour[2] + turned[2])
    outward = dot(by_world, world)
    by_offset = ()
    for k in tl.static_range(3):
        by_offset = by_offset + ((by_world[k] - outward * world[k]) / radius + by_radius * world[k],)
    store_fields(by_means, at, there, by_offset, 3)
    pose_backward(by_camera + tl.program_id(0) * 12, pose, world, c, by_camera_n, by_c, by_offset, there)
# fmt: on


def observe_backward(
    cam2world: Float[Tensor, "4 4"],
    fields: list[Tensor],
    slopes: ProjectedGaussians,
    *,
    filter_variance: float,
    compensate: bool,
    exact: bool,
) -> tuple[Tensor, ...]:
    """Gradients of the pose, then of the fields.

    Args:
        cam2world: float64.
        fields: means, opacities, harmonics, then quats and scales or covariances.
        slopes: of the loss by what is seen.
        filter_variance: see `pansplat.rendering.projection.project_gaussians`, as for the rest.
    """
    means, opacities, harmonics, *shape = fields
    count = len(means)
    by_camera = cam2world.new_zeros(4, 4)
    by_field = [torch.empty_like(field) for field in fields]
    if not count:
        return by_camera, *by_field
    by_harmonics, by_worlds = _colours_backward(means, harmonics, cam2world, slopes.values[:, :-1])
    by_field[2] = by_harmonics
    programs = triton.cdiv(count, _BLOCK)
    parts = cam2world.new_empty(programs, 3, 4)
    observe_backward_kernel[(programs,)](
        means, opacities, shape[0], shape[-1],
        torch.nn.functional.pad(cam2world.reshape(-1), (0, 1), value=filter_variance),
        by_worlds, slopes.direction.contiguous(), slopes.radius + slopes.values[:, -1].double(),
        slopes.covariance.contiguous(), slopes.peak.contiguous(), slopes.rows.contiguous(), slopes.along.contiguous(),
        by_field[0], by_field[1], by_field[3], by_field[-1], parts, count,
        BY_AXES=len(shape) == 2, COMPENSATE=compensate, EXACT=exact, BLOCK=_BLOCK, num_warps=2,
    )  # fmt: skip
    by_camera[:3] = parts.sum(dim=0)
    return by_camera, *by_field


def _colours_backward(
    means: Float[Tensor, "n 3"],
    harmonics: Float[Tensor, "n k channel"],
    cam2world: Float[Tensor, "4 4"],
    slopes: Float[Tensor, "n channel"],
) -> tuple[Float[Tensor, "n k channel"], Float[Tensor, "n 3"]]:
    """Slopes by the harmonics, and by the directions in world axes."""
    by_harmonics, by_worlds = torch.empty_like(harmonics), torch.empty_like(means)
    for low in range(0, len(means), _CHUNK):
        chunk = slice(low, low + _CHUNK)
        world = torch.nn.functional.normalize(means[chunk].double() - cam2world[:3, 3], dim=1).to(means.dtype)
        leaves = harmonics[chunk].detach().requires_grad_(), world.requires_grad_()
        with torch.enable_grad():
            colours = evaluate_harmonics(*leaves)
        by_harmonics[chunk], by_worlds[chunk] = torch.autograd.grad(
            colours, leaves, slopes[chunk], materialize_grads=True
        )
    return by_harmonics, by_worlds
