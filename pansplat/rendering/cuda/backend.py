"""The Triton backend: a differentiable call of all stages, in bounded memory.

Source: docs/rendering.md; docs/triton.md describes the stages. Without a GPU it runs under Triton's interpreter, which
is a thousand times slower than the other backends and for tests only.
"""

import contextlib
import os
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pansplat.constants import EWA_NEAR_FACTOR
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import reference
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.projection import (
    Footprints,
    ProjectedGaussians,
    compute_footprints,
    is_in_image,
    ray_footprints,
    select_drawable,
)
from pansplat.rendering.rasterize import RasterOptions
from pansplat.system.devices import find_triton_problem

if TYPE_CHECKING:
    from pansplat.rendering.cuda.tiling import Instances


def rasterize_planes(
    gaussians: Gaussians,
    pose: Float[Tensor, "4 4"],
    planes: list[ImagePlane],
    options: RasterOptions,
) -> Float[Tensor, "plane sums height width"]:
    """Rasterise with Triton kernels; see `pansplat.rendering.rasterize.RasterBackend`."""
    device = gaussians.means.device
    _check_device(device)
    if planes[0].eye_offset:  # stereo is too rare for kernels of its own
        return reference.rasterize_planes(gaussians, pose, planes, options)
    # Triton launches on torch's current device, not on that of its arguments.
    with torch.cuda.device(device) if device.type == "cuda" else contextlib.nullcontext():
        projected = project_gaussians(
            select_drawable(gaussians, pose, options.near),
            pose,
            filter_variance=options.filter_variance(planes[0].pixel_angle),
            exact=options.kernel == "ray",
        )
        footprints, instances = _compute_instances(projected, planes, options)
        return _composite(footprints, instances, planes, exact=options.kernel == "ray")


def _check_device(device: torch.device) -> None:
    """Raise an error if Triton cannot run on the device; kernels are imported later, where they are launched."""
    problem = find_triton_problem()
    if problem is not None:
        raise InputError(f"backend 'triton' {problem}; install it (on Linux), or use backend='auto'")
    if device.type != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        raise InputError(
            f"backend 'triton' needs Gaussians on a CUDA device, got them on '{device}'; move them there "
            "(gaussians.to(device='cuda')), or use backend='auto'"
        )


def project_gaussians(
    gaussians: Gaussians,
    cam2world: Float[Tensor, "4 4"],
    *,
    filter_variance: float,
    exact: bool,
) -> ProjectedGaussians:
    """Project Gaussians; see `pansplat.rendering.projection.project_gaussians`."""
    fields = (gaussians.means, gaussians.opacities, gaussians.harmonics, gaussians.quats, gaussians.scales)
    return ProjectedGaussians(*_Project.apply(cam2world, filter_variance, exact, *fields))


class _Project(torch.autograd.Function):
    """Projection: one kernel forward, one backward."""

    @staticmethod
    def forward(
        ctx: Any, cam2world: Tensor, filter_variance: float, exact: bool, *fields: Tensor
    ) -> tuple[Tensor, ...]:
        from pansplat.rendering.cuda.projection import project_forward

        fields = tuple(field.contiguous() for field in fields)
        ctx.save_for_backward(cam2world, *fields)
        ctx.options = filter_variance, exact
        return tuple(project_forward(cam2world, fields, filter_variance, exact=exact))

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        from pansplat.rendering.cuda.projection_backward import backpropagate_projection

        cam2world, *fields = ctx.saved_tensors
        filter_variance, exact = ctx.options
        grad_pose, *grad_fields = backpropagate_projection(
            cam2world, fields, ProjectedGaussians(*grad_outputs), filter_variance, exact=exact
        )
        return grad_pose, None, None, *grad_fields


def _compute_instances(
    projected: ProjectedGaussians, planes: list[ImagePlane], options: RasterOptions
) -> tuple[Footprints, "Instances"]:
    """Compute footprints and their instances; all planes share the footprints of the exact kernel."""
    from pansplat.rendering.cuda.tiling import sort_instances

    fixed = ProjectedGaussians(*(field.detach() for field in projected))
    boxes, keys, bases, parts, total = [], [], [], [], 0
    for plane in planes:
        key = fixed.radius
        if options.kernel == "ewa":
            key = (fixed.direction * plane.rotation[:, 2]).sum(dim=1) * fixed.radius
            ahead = torch.nonzero(key > EWA_NEAR_FACTOR * options.near)[:, 0]
            box = _compute_boxes(ProjectedGaussians(*(field[ahead] for field in fixed)), plane, options)
            visible = is_in_image(box, plane)
            seen, box = ahead[visible], box[visible]
            part = ProjectedGaussians(*(_SelectRows.apply(field, seen) for field in projected))
            parts.append(checkpoint(compute_footprints, part, plane, options, use_reentrant=False)[0])
            bases.append(total)
            total, key = total + len(seen), key[seen]
        else:
            box = _compute_boxes(fixed, plane, options)
            bases.append(0)
        boxes.append(box)
        keys.append(key)
    footprints = ray_footprints(projected)
    if parts:
        footprints = Footprints(*(torch.cat(field) for field in zip(*parts, strict=True)))
    return footprints, sort_instances(boxes, keys, bases, planes[0].size, wraps=planes[0].is_panorama)


@torch.no_grad()
def _compute_boxes(projected: ProjectedGaussians, plane: ImagePlane, options: RasterOptions) -> Float[Tensor, "n 4"]:
    return compute_footprints(projected, plane, options)[1]


class _SelectRows(torch.autograd.Function):
    """Select rows of a tensor, each at most once, so that backward needs neither a sort nor atomics."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Int[Tensor, "m"]) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = table.shape
        return table[rows]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        return grad_outputs[0].new_zeros(ctx.shape).index_copy_(0, rows, grad_outputs[0]), None


def _composite(
    footprints: Footprints, instances: "Instances", planes: list[ImagePlane], *, exact: bool
) -> Float[Tensor, "plane sums height width"]:
    """Sum weight x (values, 1) along the rays of all image planes.

    Differentiable once in all of `footprints`.
    """
    from pansplat.rendering.cuda.rasterize import RecordLayout
    from pansplat.rendering.cuda.tiling import tile_pixels

    layout = RecordLayout(exact, footprints.values.shape[1] - 1)
    pixels = tile_pixels(planes, exact=exact, dtype=footprints.rows.dtype)
    setup = instances, pixels, layout, planes[0].size
    return _Composite.apply(*footprints, setup, torch.is_grad_enabled())  # type: ignore[no-any-return]


class _Composite(torch.autograd.Function):
    """Compositing; backward uses the records, the intersections and the sums of forward."""

    @staticmethod
    def forward(
        ctx: Any,
        point: Tensor,
        rows: Tensor,
        radial_variance: Tensor,
        peak: Tensor,
        values: Tensor,
        setup: tuple[Any, ...],
        grad_enabled: bool,
    ) -> Tensor:
        from pansplat.rendering.cuda.rasterize import pack_records, rasterize
        from pansplat.rendering.cuda.tiling import intersect_tiles

        instances, pixels, layout, size = setup
        records = pack_records(Footprints(point, rows, radial_variance, peak, values), layout)
        sums = records.new_empty(len(instances.planes), layout.channels + 2, *size)
        kept = []
        for band in intersect_tiles(instances):
            stops = rasterize(records, band, pixels, sums, layout)
            if grad_enabled and any(ctx.needs_input_grad):  # needs_input_grad itself ignores no_grad
                kept.append((band, stops))
        ctx.save_for_backward(records, rows, sums)
        ctx.setup, ctx.kept = setup, kept
        return sums

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        from pansplat.rendering.cuda.rasterize import rasterize_backward, sum_by_record, unpack_gradients

        if torch.is_grad_enabled():  # the caller chose create_graph=True
            raise RuntimeError("second derivatives of a rendering are not available; drop create_graph=True")
        records, rows, sums = ctx.saved_tensors
        instances, pixels, layout, _ = ctx.setup
        totals = records.new_zeros(len(instances.records), layout.gradient_size)
        for band, stops in ctx.kept:
            rasterize_backward(records, band, stops, pixels, sums, grad_outputs[0].contiguous(), layout, totals)
        return *unpack_gradients(sum_by_record(totals, instances, len(records)), rows, layout), None, None
