"""What one camera sees of each Gaussian, in one kernel.

Source: docs/rendering.md, sections 1 to 3; `pansplat.render.splats.observe` is its reference, and its backward. As
torch operations the same arithmetic moves 7 kB a Gaussian through memory, here a third of a kilobyte. Geometry is
float64 whatever the Gaussians' type is.
"""
# ruff: noqa: RUF005  # Triton does not unpack into a tuple

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.gaussians import Gaussians
from pansplat.render.cuda.response import load_numbers
from pansplat.render.cuda.spherical import basis
from pansplat.render.splats import Observed, observe_chunk

_BLOCK = 128
"""Gaussians a program: one a thread, which takes 90 to 120 registers in float64."""

_CHUNK = 1 << 17
"""Gaussians at once in backward, where the graph holds some 10 kB of each."""


@triton.jit
@no_type_check
def load_fields(pointer, at, there, NUM: tl.constexpr):
    """NUM numbers of each of some rows, as float64 blocks in a tuple."""
    fields = ()
    for k in tl.static_range(NUM):
        fields = fields + (tl.load(pointer + at * NUM + k, mask=there, other=0.0).to(tl.float64),)
    return fields


@triton.jit
@no_type_check
def store_fields(pointer, at, there, fields, NUM: tl.constexpr):
    """The opposite, in the table's type."""
    for k in tl.static_range(NUM):
        tl.store(pointer + at * NUM + k, fields[k], mask=there)


@triton.jit
@no_type_check
def dot(a, b):
    """Of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
@no_type_check
def turn(camera, vector):
    """A world vector in the axes of a camera (cam2world, row by row)."""
    return (
        camera[0] * vector[0] + camera[4] * vector[1] + camera[8] * vector[2],
        camera[1] * vector[0] + camera[5] * vector[1] + camera[9] * vector[2],
        camera[2] * vector[0] + camera[6] * vector[1] + camera[10] * vector[2],
    )


@triton.jit
@no_type_check
def products(c, a, b):
    """a' C b of a symmetric matrix, given as xx, xy, xz, yy, yz, zz."""
    return (
        a[0] * (c[0] * b[0] + c[1] * b[1] + c[2] * b[2])
        + a[1] * (c[1] * b[0] + c[3] * b[1] + c[4] * b[2])
        + a[2] * (c[2] * b[0] + c[4] * b[1] + c[5] * b[2])
    )


@triton.jit
@no_type_check
def own_axes(quats, at, there):
    """Columns of the rotation of quaternions of any length; the zero quaternion is the identity."""
    quat = load_fields(quats, at, there, 4)
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
def from_axes(quats, scales, camera, radius, direction, at, there):
    """C in camera axes; det B, tr B, g, M and det C of section 1: sums of squares only, so nothing cancels."""
    axes = own_axes(quats, at, there)
    scale = load_fields(scales, at, there, 3)
    size = (scale[0] / radius, scale[1] / radius, scale[2] / radius)
    zero = radius * 0
    c = (zero, zero, zero, zero, zero, zero)
    det_across, trace, along, mixed = zero, zero, zero, zero
    for k in tl.static_range(3):
        axis = turn(camera, axes[k])
        square = size[k] * size[k]
        cosine = dot(direction, axis)
        minor = size[(k + 1) % 3] * size[(k + 2) % 3]
        det_across += minor * minor * (cosine * cosine)
        mixed += minor * minor * (1 - cosine * cosine)
        along += square * (cosine * cosine)
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
    return c, (det_across, trace, along, mixed, product * product)


@triton.jit
@no_type_check
def from_covariance(covariances, camera, radius, right, down, direction, at, there):
    """The same from world covariances; what rounding made negative counts as zero."""
    s = load_fields(covariances, at, there, 9)
    world = (s[0], 0.5 * (s[1] + s[3]), 0.5 * (s[2] + s[6]), s[4], 0.5 * (s[5] + s[7]), s[8])
    # Row j of cam2world' is column j of cam2world.
    x, y, z = (camera[0], camera[4], camera[8]), (camera[1], camera[5], camera[9]), (camera[2], camera[6], camera[10])
    square = radius * radius
    c = (
        products(world, x, x) / square,
        products(world, x, y) / square,
        products(world, x, z) / square,
        products(world, y, y) / square,
        products(world, y, z) / square,
        products(world, z, z) / square,
    )
    uu, uv, un = products(c, right, right), products(c, right, down), products(c, right, direction)
    vv, vn, nn = products(c, down, down), products(c, down, direction), products(c, direction, direction)
    det = uu * (vv * nn - vn * vn) - uv * (uv * nn - vn * un) + un * (uv * vn - vv * un)
    return c, (
        tl.maximum(uu * vv - uv * uv, 0.0),
        tl.maximum(uu + vv, 0.0),
        tl.maximum(nn, 0.0),
        tl.maximum(nn * (uu + vv) - un * un - vn * vn, 0.0),
        tl.maximum(det, 0.0),
    )


@triton.jit
@no_type_check
def ray_forms(c, right, down, direction, spread, det):
    """Rows a, b, l of section 3, given C before the filter and det B' after it."""
    uu, uv, vv = products(c, right, right) + spread, products(c, right, down), products(c, down, down) + spread
    un, vn = products(c, right, direction), products(c, down, direction)
    first, second, slant = 1 / tl.sqrt(uu), tl.sqrt(uu / det), uv / uu
    p_u, p_v = (uv * vn - vv * un) / det, (uv * un - uu * vn) / det
    forms = ()
    for k in tl.static_range(3):
        forms = forms + (right[k] * first,)
    for k in tl.static_range(3):
        forms = forms + ((down[k] - slant * right[k]) * second,)
    for k in tl.static_range(3):
        forms = forms + (direction[k] + p_u * right[k] + p_v * down[k],)
    return forms


@triton.jit(do_not_specialize=["num"])
@no_type_check
def observe_kernel(
    means,
    opacities,
    harmonics,
    first_shape,
    second_shape,
    camera,
    directions,
    radii,
    covariances,
    peaks,
    values,
    forms,
    alongs,
    num,
    DEGREE: tl.constexpr,
    CHANNELS: tl.constexpr,
    BY_AXES: tl.constexpr,
    COMPENSATE: tl.constexpr,
    EXACT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Writes the fields of `Observed`. `camera` is cam2world, row by row, then e^2."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = at < num
    pose = load_numbers(camera, 17)
    spread = pose[16]
    mean = load_fields(means, at, there, 3)
    offset = (mean[0] - pose[3], mean[1] - pose[7], mean[2] - pose[11])
    radius = tl.where(there, tl.sqrt(dot(offset, offset)), 1.0)
    world = (offset[0] / radius, offset[1] / radius, offset[2] / radius)
    direction = turn(pose, world)
    x, y, z = direction[0], direction[1], direction[2]
    # The tangent frame of Duff et al., as in the reference.
    sign = tl.where(z < 0, -1.0, 1.0).to(tl.float64)
    a = -1 / (sign + z)
    right = (1 + sign * x * x * a, sign * x * y * a, -sign * x)
    down = (x * y * a, sign + y * y * a, -y)
    if BY_AXES:
        c, body = from_axes(first_shape, second_shape, pose, radius, direction, at, there)
    else:
        c, body = from_covariance(first_shape, pose, radius, right, down, direction, at, there)
    det = body[0] + spread * body[1] + spread * spread
    peak = tl.load(opacities + at, mask=there, other=0.0).to(tl.float64)
    if COMPENSATE:
        peak = peak * tl.sqrt(tl.maximum(body[0] / det, 1e-12))
    tl.store(peaks + at, peak, mask=there)
    if EXACT:
        tl.store(alongs + at, (spread * spread * body[2] + spread * body[3] + body[4]) / det, mask=there)
        store_fields(forms, at, there, ray_forms(c, right, down, direction, spread, det), 9)
    xx, xy, xz = c[0] + spread * (1 - x * x), c[1] - spread * x * y, c[2] - spread * x * z
    yy, yz, zz = c[3] + spread * (1 - y * y), c[4] - spread * y * z, c[5] + spread * (1 - z * z)
    store_fields(covariances, at, there, (xx, xy, xz, xy, yy, yz, xz, yz, zz), 9)
    store_fields(directions, at, there, direction, 3)
    tl.store(radii + at, radius, mask=there)
    kind = values.dtype.element_ty
    shape = basis(world[0].to(kind), world[1].to(kind), world[2].to(kind), DEGREE)
    TERMS: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    for channel in tl.static_range(CHANNELS):
        colour = radius.to(kind) * 0 + 0.5
        for k in tl.static_range(TERMS):
            place = (at * TERMS + k) * CHANNELS + channel
            colour += shape[k] * tl.load(harmonics + place, mask=there, other=0.0)
        tl.store(values + at * (CHANNELS + 1) + channel, tl.maximum(colour, 0.0), mask=there)
    tl.store(values + at * (CHANNELS + 1) + CHANNELS, radius, mask=there)


def observe(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    cam2world: Float[Tensor, "4 4"],
    *,
    spread: float,
    compensate: bool,
    exact: bool,
) -> Observed:
    """The Gaussians as the camera sees them; see `pansplat.render.splats.observe`."""
    shape = (gaussians.quats, gaussians.scales) if covariances is None else (covariances,)
    fields = (gaussians.means, gaussians.opacities, gaussians.harmonics, *shape)
    return Observed(*_Observe.apply(cam2world, spread, compensate, exact, *fields))


class _Observe(torch.autograd.Function):
    """One kernel forward; backward is the reference's own, chunk by chunk."""

    @staticmethod
    def forward(
        ctx: Any, cam2world: Tensor, spread: float, compensate: bool, exact: bool, *fields: Tensor
    ) -> tuple[Tensor, ...]:
        fields = tuple(field.contiguous() for field in fields)
        means, opacities, harmonics, *shape = fields
        count, terms, channels = harmonics.shape
        camera = torch.nn.functional.pad(cam2world.reshape(-1), (0, 1), value=spread)
        wide = dict(dtype=torch.float64, device=means.device)
        found = Observed(
            direction=torch.empty(count, 3, **wide),
            radius=torch.empty(count, **wide),
            covariance=torch.empty(count, 3, 3, **wide),
            peak=torch.empty_like(opacities),
            values=means.new_empty(count, channels + 1),
            forms=means.new_empty(count, 3 if exact else 0, 3),
            along=torch.zeros_like(opacities),
        )
        if count:
            observe_kernel[(triton.cdiv(count, _BLOCK),)](
                means, opacities, harmonics, shape[0], shape[-1], camera, found.direction, found.radius,
                found.covariance, found.peak, found.values, found.forms, found.along, count,
                DEGREE=round(terms**0.5) - 1, CHANNELS=channels, BY_AXES=len(shape) == 2, COMPENSATE=compensate,
                EXACT=exact, BLOCK=_BLOCK, num_warps=4,
            )  # fmt: skip
        ctx.save_for_backward(cam2world, *fields)
        ctx.options = dict(spread=spread, compensate=compensate, exact=exact)
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        pose, *fields = (tensor.detach() for tensor in ctx.saved_tensors)
        pose.requires_grad_()
        by_pose, by_field = torch.zeros_like(pose), [torch.empty_like(field) for field in fields]
        for low in range(0, len(fields[0]), _CHUNK):
            chunk = slice(low, low + _CHUNK)
            leaves = [field[chunk].requires_grad_() for field in fields]
            with torch.enable_grad():
                found = observe_chunk(*leaves, cam2world=pose, **ctx.options)
            outputs = [
                (value, grad[chunk]) for value, grad in zip(found, grad_outputs, strict=True) if value.requires_grad
            ]
            gradients = torch.autograd.grad(
                [value for value, _ in outputs], (pose, *leaves), [grad for _, grad in outputs], materialize_grads=True
            )
            by_pose += gradients[0]
            for whole, part in zip(by_field, gradients[1:], strict=True):
                whole[chunk] = part
        return by_pose, None, None, None, *by_field
