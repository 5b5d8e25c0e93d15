"""What one camera sees of each Gaussian, in one kernel.

Source: docs/rendering.md, sections 1 to 3; `pansplat.rendering.projection.project_gaussians` is its reference. As torch
operations the same arithmetic moves 7 kB a Gaussian through memory, here a third of a kilobyte. Geometry is float64
whatever the Gaussians' type is.
"""
# ruff: noqa: RUF005  # Triton does not unpack into a tuple

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.cuda.body import from_axes, from_covariance
from pansplat.rendering.cuda.observe_backward import observe_backward
from pansplat.rendering.cuda.response import load_numbers
from pansplat.rendering.cuda.spherical import basis
from pansplat.rendering.cuda.vectors import dot, load_fields, products, store_fields, tangents, turn
from pansplat.rendering.projection import ProjectedGaussians

_BLOCK = 128
"""Gaussians a program: one a thread, which takes 90 to 120 registers in float64."""


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


# fmt: off
@triton.jit(do_not_specialize=["num"])
@no_type_check
def observe_kernel(
    means, opacities, harmonics, first_shape, second_shape, camera,
    directions, radii, covariances, peaks, values, forms, alongs, num,
    DEGREE: tl.constexpr, CHANNELS: tl.constexpr, BY_AXES: tl.constexpr, COMPENSATE: tl.constexpr, EXACT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Writes the fields of `ProjectedGaussians`. `camera` is cam2world, row by row, then e^2."""
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
    right, down = tangents(direction)
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
# fmt: on


def project_gaussians(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    cam2world: Float[Tensor, "4 4"],
    *,
    filter_variance: float,
    compensate: bool,
    exact: bool,
) -> ProjectedGaussians:
    """The Gaussians as the camera sees them; see `pansplat.rendering.projection.project_gaussians`."""
    shape = (gaussians.quats, gaussians.scales) if covariances is None else (covariances,)
    fields = (gaussians.means, gaussians.opacities, gaussians.harmonics, *shape)
    return ProjectedGaussians(*_Observe.apply(cam2world, filter_variance, compensate, exact, *fields))


class _Observe(torch.autograd.Function):
    """One kernel forward, one backward."""

    @staticmethod
    def forward(
        ctx: Any, cam2world: Tensor, filter_variance: float, compensate: bool, exact: bool, *fields: Tensor
    ) -> tuple[Tensor, ...]:
        fields = tuple(field.contiguous() for field in fields)
        means, opacities, harmonics, *shape = fields
        count, terms, channels = harmonics.shape
        camera = torch.nn.functional.pad(cam2world.reshape(-1), (0, 1), value=filter_variance)
        wide = dict(dtype=torch.float64, device=means.device)
        found = ProjectedGaussians(
            direction=torch.empty(count, 3, **wide),
            radius=torch.empty(count, **wide),
            covariance=torch.empty(count, 3, 3, **wide),
            peak=torch.empty_like(opacities),
            values=means.new_empty(count, channels + 1),
            rows=means.new_empty(count, 3 if exact else 0, 3),
            along=torch.zeros_like(opacities),
        )
        if count:
            observe_kernel[(triton.cdiv(count, _BLOCK),)](
                means, opacities, harmonics, shape[0], shape[-1], camera, found.direction, found.radius,
                found.covariance, found.peak, found.values, found.rows, found.along, count,
                DEGREE=round(terms**0.5) - 1, CHANNELS=channels, BY_AXES=len(shape) == 2, COMPENSATE=compensate,
                EXACT=exact, BLOCK=_BLOCK, num_warps=4,
            )  # fmt: skip
        ctx.save_for_backward(cam2world, *fields)
        ctx.options = dict(filter_variance=filter_variance, compensate=compensate, exact=exact)
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        cam2world, *fields = ctx.saved_tensors
        by_pose, *by_field = observe_backward(cam2world, fields, ProjectedGaussians(*grad_outputs), **ctx.options)
        return by_pose, None, None, None, *by_field
