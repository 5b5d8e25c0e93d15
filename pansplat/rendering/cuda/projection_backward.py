"""Gradients of the projection: the geometry in one kernel, the colours by torch.

Source: docs/rendering.md, sections 1 to 3. Everything is differentiated as a function of n and C, whose entries in the
tangent frame u, v, n are called uu, uv, un, vv, vn, nn. An image does not depend on the rotation of u and v about n, so
that rotation is held fixed. This gives the gradients of images (not of a single row), and of the pose along rigid
motions.
"""
# ruff: noqa: RUF005  # Triton does not unpack into a tuple

import math
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.harmonics import harmonics_basis
from pansplat.rendering.cuda.projection import (
    MIN_RATIO,
    dot,
    load_fields,
    load_numbers,
    multiply,
    rotate_to_camera,
    rotate_to_frame,
    rotate_to_world,
    rotation_axes,
    shape_from_axes,
    store_fields,
    symmetric_part,
    tangent_frame,
)
from pansplat.rendering.projection import ProjectedGaussians

_BLOCK_SIZE = 64
"""Gaussians of one program. A program sums its gradients of the pose; torch sums over programs."""

_CHUNK_SIZE = 1 << 18
"""Gaussians whose colours torch differentiates together, up to 2 kB each."""


@triton.jit
@no_type_check
def backpropagate_rows(grad_rows, frame, c_uvn, e2, det):
    """Gradients of uu, uv, un, vv, vn, of det B', and of the rotations of n towards u and v, from those of a, b, l."""
    u, v, n = frame[0], frame[1], frame[2]
    uu, uv, un, vv, vn = c_uvn[0] + e2, c_uvn[1], c_uvn[2], c_uvn[3] + e2, c_uvn[4]
    grad_a, grad_b = (grad_rows[0], grad_rows[1], grad_rows[2]), (grad_rows[3], grad_rows[4], grad_rows[5])
    grad_l = (grad_rows[6], grad_rows[7], grad_rows[8])
    first, second, slant = 1 / tl.sqrt(uu), tl.sqrt(uu / det), uv / uu
    p_u, p_v = (uv * vn - vv * un) / det, (uv * un - uu * vn) / det
    grad_slant = -second * dot(grad_b, u)
    grad_second = dot(grad_b, v) - slant * dot(grad_b, u)
    grad_p_u, grad_p_v = dot(grad_l, u), dot(grad_l, v)
    grad_uu = -0.5 * first * dot(grad_a, u) / uu - grad_slant * slant / uu + 0.5 * grad_second * second / uu
    grad_uu = grad_uu - grad_p_v * vn / det
    grad_uv = grad_slant / uu + (grad_p_u * vn + grad_p_v * un) / det
    grad_un, grad_vn = (grad_p_v * uv - grad_p_u * vv) / det, (grad_p_u * uv - grad_p_v * uu) / det
    grad_vv = -grad_p_u * un / det
    grad_det = -0.5 * grad_second * second / det - (grad_p_u * p_u + grad_p_v * p_v) / det
    # u and v rotate with n: du = -(u . dn) n.
    grad_u = first * dot(grad_a, n) - slant * second * dot(grad_b, n) + p_u * dot(grad_l, n)
    grad_v = second * dot(grad_b, n) + p_v * dot(grad_l, n)
    turn_u, turn_v = dot(grad_l, u) - grad_u, dot(grad_l, v) - grad_v
    return (grad_uu, grad_uv, grad_un, grad_vv, grad_vn), grad_det, turn_u, turn_v


@triton.jit
@no_type_check
def backpropagate_minors(grad_minors, c_uvn):
    """Gradients of uu, uv, un, vv, vn, nn from those of det B, tr B, g, M and det C."""
    uu, uv, un, vv, vn, nn = c_uvn[0], c_uvn[1], c_uvn[2], c_uvn[3], c_uvn[4], c_uvn[5]
    grad_across, grad_trace, grad_radial_variance = grad_minors[0], grad_minors[1], grad_minors[2]
    grad_mixed, grad_det = grad_minors[3], grad_minors[4]
    across = uu * vv - uv * uv
    return (
        grad_across * vv + grad_trace + grad_mixed * nn + grad_det * (vv * nn - vn * vn),
        -2 * grad_across * uv + 2 * grad_det * (un * vn - uv * nn),
        -2 * grad_mixed * un + 2 * grad_det * (uv * vn - vv * un),
        grad_across * uu + grad_trace + grad_mixed * nn + grad_det * (uu * nn - un * un),
        -2 * grad_mixed * vn + 2 * grad_det * (uv * un - uu * vn),
        grad_radial_variance + grad_mixed * (uu + vv) + grad_det * across,
    )


@triton.jit
@no_type_check
def backpropagate_quats(grad_axes, quats, index, mask):
    """Gradients of quaternions from those of the columns of the rotation."""
    quat = load_fields(quats, index, mask, 4)
    norm = tl.sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    safe = tl.where(norm > 0, norm, 1.0)
    w, x, y, z = quat[0] / safe, quat[1] / safe, quat[2] / safe, quat[3] / safe
    one, two, three = grad_axes[0], grad_axes[1], grad_axes[2]  # columns of the gradient of the axes' matrix
    grad_w = 2 * (z * (one[1] - two[0]) + y * (three[0] - one[2]) + x * (two[2] - three[1]))
    xy, xz, yz = two[0] + one[1], three[0] + one[2], three[1] + two[2]
    grad_x = 2 * (y * xy + z * xz + w * (two[2] - three[1]) - 2 * x * (two[1] + three[2]))
    grad_y = 2 * (x * xy + z * yz + w * (three[0] - one[2]) - 2 * y * (one[0] + three[2]))
    grad_z = 2 * (x * xz + y * yz + w * (one[1] - two[0]) - 2 * z * (one[0] + two[1]))
    radial = grad_w * w + grad_x * x + grad_y * y + grad_z * z
    scale = tl.where(norm > 0, 1 / safe, 0.0)
    return (
        (grad_w - radial * w) * scale,
        (grad_x - radial * x) * scale,
        (grad_y - radial * y) * scale,
        (grad_z - radial * z) * scale,
    )


@triton.jit
@no_type_check
def backpropagate_shape(
    c_uvn, minors, frame, e2, opacity, grad_peak, grad_rows, grad_radial_variance, EXACT: tl.constexpr
):
    """Gradients of C's six entries, of the rotations of n towards u and v, and of the opacity.

    Args:
        c_uvn: C in the tangent frame, before the filter.
        minors: det B, tr B, g, M, det C.
        frame: u, v, n.
        opacity: before the filter.
        grad_rows, grad_radial_variance: only read for the exact kernel.
    """
    det = minors[0] + e2 * minors[1] + e2 * e2
    zero = det * 0
    g, grad_det, turn_u, turn_v = (zero, zero, zero, zero, zero), zero, zero, zero
    grad_minors = (zero, zero, zero, zero, zero)
    if EXACT:
        g, grad_det, turn_u, turn_v = backpropagate_rows(grad_rows, frame, c_uvn, e2, det)
        radial_variance = (e2 * e2 * minors[2] + e2 * minors[3] + minors[4]) / det
        grad_s = grad_radial_variance
        grad_det -= grad_s * radial_variance / det
        ratio = minors[0] / det
        root = tl.sqrt(tl.maximum(ratio, MIN_RATIO))
        grad_ratio = tl.where(ratio >= MIN_RATIO, 0.5 * grad_peak * opacity / root, 0.0)
        grad_minors = (grad_ratio / det, zero, e2 * e2 * grad_s / det, e2 * grad_s / det, grad_s / det)
        grad_det -= grad_ratio * ratio / det
        grad_peak = grad_peak * root
    grad_minors = (grad_minors[0] + grad_det, e2 * grad_det, grad_minors[2], grad_minors[3], grad_minors[4])
    m = backpropagate_minors(grad_minors, c_uvn)
    uu, uv, un, vv, vn, nn = g[0] + m[0], g[1] + m[1], g[2] + m[2], g[3] + m[3], g[4] + m[4], m[5]
    turn_u += 2 * (nn - uu) * c_uvn[2] + un * (c_uvn[0] - c_uvn[5]) + vn * c_uvn[1] - uv * c_uvn[4]
    turn_v += 2 * (nn - vv) * c_uvn[4] + vn * (c_uvn[3] - c_uvn[5]) + un * c_uvn[1] - uv * c_uvn[2]
    return (uu, uv, un, vv, vn, nn), turn_u, turn_v, grad_peak


@triton.jit
@no_type_check
def rotate_from_frame(grad_uvn, frame):
    """Compute the gradient of C in camera axes from the gradients of its entries uu, uv, un, vv, vn, nn."""
    u, v, n = frame[0], frame[1], frame[2]
    # Halves: an off-diagonal entry appears twice in the matrix.
    rows = ()
    for i in tl.static_range(3):
        rows = rows + (
            (
                grad_uvn[0] * u[i] + 0.5 * (grad_uvn[1] * v[i] + grad_uvn[2] * n[i]),
                grad_uvn[3] * v[i] + 0.5 * (grad_uvn[1] * u[i] + grad_uvn[4] * n[i]),
                grad_uvn[5] * n[i] + 0.5 * (grad_uvn[2] * u[i] + grad_uvn[4] * v[i]),
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
def backpropagate_axes(grad_c, quats, scales, grad_quats, grad_scales, pose, radius, index, mask):
    """Write the gradients of quaternions and scales."""
    axes = rotation_axes(quats, index, mask)
    scale = load_fields(scales, index, mask, 3)
    grad_axes, grad_scale = (), ()
    for k in tl.static_range(3):
        axis = rotate_to_camera(pose, axes[k])
        grad_axis = multiply(grad_c, axis)
        factor = 2 * scale[k] / (radius * radius)
        grad_scale = grad_scale + (factor * dot(axis, grad_axis),)
        grad_axis = rotate_to_world(pose, grad_axis)
        factor = factor * scale[k]
        grad_axes = grad_axes + ((factor * grad_axis[0], factor * grad_axis[1], factor * grad_axis[2]),)
    store_fields(grad_quats, index, mask, backpropagate_quats(grad_axes, quats, index, mask), 4)
    store_fields(grad_scales, index, mask, grad_scale, 3)


@triton.jit
@no_type_check
def backpropagate_pose(out, pose, world, c, grad_n, grad_c, grad_offset, mask):
    """Write a program's gradients of the pose: n = A' w and C = A' (world C) A, the offset is mean - t."""
    rows = ((c[0], c[1], c[2]), (c[1], c[3], c[4]), (c[2], c[4], c[5]))
    columns = ((grad_c[0], grad_c[1], grad_c[2]), (grad_c[1], grad_c[3], grad_c[4]), (grad_c[2], grad_c[4], grad_c[5]))
    for i in tl.static_range(3):
        for j in tl.static_range(3):
            grad = world[i] * grad_n[j]
            for k in tl.static_range(3):
                grad += 2 * pose[4 * i + k] * dot(rows[k], columns[j])
            tl.store(out + 4 * i + j, tl.sum(tl.where(mask, grad, 0.0), axis=0))
        tl.store(out + 4 * i + 3, -tl.sum(tl.where(mask, grad_offset[i], 0.0), axis=0))


# fmt: off
@triton.jit(do_not_specialize=["num"])
@no_type_check
def backpropagate_projection_kernel(
    means, opacities, quats, scales, camera,
    grad_world_directions, grad_directions, grad_radii, grad_covariances, grad_peaks, grad_rows, grad_radial_variances,
    grad_means, grad_opacities, grad_quats, grad_scales, grad_camera, num,
    EXACT: tl.constexpr, BLOCK: tl.constexpr,
):
    """Write the gradients of the geometry; `grad_world_directions` are those of the colours."""
    index = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    mask = index < num
    pose = load_numbers(camera, 17)
    e2 = pose[16]
    mean = load_fields(means, index, mask, 3)
    offset = (mean[0] - pose[3], mean[1] - pose[7], mean[2] - pose[11])
    radius = tl.where(mask, tl.sqrt(dot(offset, offset)), 1.0)
    world = (offset[0] / radius, offset[1] / radius, offset[2] / radius)
    n = rotate_to_camera(pose, world)
    u, v = tangent_frame(n)
    c, minors = shape_from_axes(quats, scales, pose, radius, n, index, mask)
    c_uvn = rotate_to_frame(c, u, v, n)
    grad_shape, turn_u, turn_v, grad_opacity = backpropagate_shape(
        c_uvn, minors, (u, v, n), e2,
        load_fields(opacities, index, mask, 1)[0], load_fields(grad_peaks, index, mask, 1)[0],
        load_fields(grad_rows, index, mask, 9 if EXACT else 0), load_fields(grad_radial_variances, index, mask, 1)[0],
        EXACT,
    )  # fmt: skip
    tl.store(grad_opacities + index, grad_opacity, mask=mask)
    grad_n = load_fields(grad_directions, index, mask, 3)
    grad_filtered = load_fields(grad_covariances, index, mask, 9)
    direct = symmetric_part(grad_filtered)
    widened = multiply(direct, n)
    shaped = rotate_from_frame(grad_shape, (u, v, n))
    grad_c = ()
    for k in tl.static_range(6):
        grad_c = grad_c + (direct[k] + shaped[k],)
    grad_camera_n = ()
    for k in tl.static_range(3):
        grad_camera_n = grad_camera_n + (grad_n[k] + turn_u * u[k] + turn_v * v[k] - 2 * e2 * widened[k],)
    backpropagate_axes(grad_c, quats, scales, grad_quats, grad_scales, pose, radius, index, mask)
    contracted = c[0] * grad_c[0] + c[3] * grad_c[3] + c[5] * grad_c[5]
    contracted += 2 * (c[1] * grad_c[1] + c[2] * grad_c[2] + c[4] * grad_c[4])
    grad_radius = load_fields(grad_radii, index, mask, 1)[0] - 2 * contracted / radius
    grad_colour, turned = load_fields(grad_world_directions, index, mask, 3), rotate_to_world(pose, grad_camera_n)
    grad_world = (grad_colour[0] + turned[0], grad_colour[1] + turned[1], grad_colour[2] + turned[2])
    outward = dot(grad_world, world)
    grad_offset = ()
    for k in tl.static_range(3):
        grad_offset = grad_offset + ((grad_world[k] - outward * world[k]) / radius + grad_radius * world[k],)
    store_fields(grad_means, index, mask, grad_offset, 3)
    backpropagate_pose(grad_camera + tl.program_id(0) * 12, pose, world, c, grad_camera_n, grad_c, grad_offset, mask)
# fmt: on


def backpropagate_projection(
    cam2world: Float[Tensor, "4 4"],
    fields: list[Tensor],
    grads: ProjectedGaussians,
    filter_variance: float,
    *,
    exact: bool,
) -> tuple[Tensor, ...]:
    """Compute the gradient of the pose, then those of the fields.

    Args:
        cam2world: float64.
        fields: means, opacities, harmonics, quats, scales.
        grads: gradients of the projected Gaussians.
        filter_variance, exact: see `pansplat.rendering.projection.project_gaussians`.
    """
    means, opacities, harmonics, quats, scales = fields
    count = len(means)
    grad_camera = cam2world.new_zeros(4, 4)
    grad_fields = [torch.empty_like(field) for field in fields]
    if not count:
        return grad_camera, *grad_fields
    grad_harmonics, grad_world_directions = _backpropagate_colours(means, harmonics, cam2world, grads.values[:, :-1])
    grad_fields[2] = grad_harmonics
    programs = triton.cdiv(count, _BLOCK_SIZE)
    parts = cam2world.new_empty(programs, 3, 4)
    backpropagate_projection_kernel[(programs,)](
        means, opacities, quats, scales,
        torch.nn.functional.pad(cam2world.reshape(-1), (0, 1), value=filter_variance),
        grad_world_directions, grads.direction.contiguous(), grads.radius + grads.values[:, -1].double(),
        grads.covariance.contiguous(), grads.peak.contiguous(), grads.rows.contiguous(),
        grads.radial_variance.contiguous(),
        grad_fields[0], grad_fields[1], grad_fields[3], grad_fields[4], parts, count,
        EXACT=exact, BLOCK=_BLOCK_SIZE, num_warps=2,
    )  # fmt: skip
    grad_camera[:3] = parts.sum(dim=0)
    return grad_camera, *grad_fields


def _backpropagate_colours(
    means: Float[Tensor, "n 3"],
    harmonics: Float[Tensor, "n k channel"],
    cam2world: Float[Tensor, "4 4"],
    grad_colours: Float[Tensor, "n channel"],
) -> tuple[Float[Tensor, "n k channel"], Float[Tensor, "n 3"]]:
    """Gradients of the harmonics, and of the directions in world axes."""
    grad_harmonics, grad_world_directions = torch.empty_like(harmonics), torch.empty_like(means)
    degree = math.isqrt(harmonics.shape[1]) - 1
    for low in range(0, len(means), _CHUNK_SIZE):
        chunk = slice(low, low + _CHUNK_SIZE)
        world = torch.nn.functional.normalize(means[chunk].double() - cam2world[:3, 3], dim=1).to(means.dtype)
        leaves = harmonics[chunk].detach().requires_grad_(), world.requires_grad_()
        with torch.enable_grad():
            # As `evaluate_harmonics`, whose matrix product is slow on CUDA.
            basis = harmonics_basis(leaves[1], degree)
            colours = torch.relu((basis[:, :, None] * leaves[0]).sum(dim=1) + 0.5)
        grad_harmonics[chunk], grad_world_directions[chunk] = torch.autograd.grad(
            colours, leaves, grad_colours[chunk], materialize_grads=True
        )
    return grad_harmonics, grad_world_directions
