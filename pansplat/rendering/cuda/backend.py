"""The Triton backend: a differentiable call of all stages, in bounded memory.

Source: docs/rendering.md; docs/triton.md describes the stages. Without a GPU it runs under Triton's interpreter, which
is a thousand times slower than the other backends and for tests only.
"""

import contextlib
import os
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import reference
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.projection import (
    Footprints,
    ProjectedGaussians,
    compute_footprints,
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
    if options.kernel != "ray":
        raise InputError(f"backend 'triton' has kernel 'ray' only, got {options.kernel!r}; use backend='torch'")
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
        )
        instances = _sort_instances(projected, planes, options)
        return _Composite.apply(*ray_footprints(projected), instances, planes, torch.is_grad_enabled())


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
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], *, filter_variance: float
) -> ProjectedGaussians:
    """Project Gaussians; see `pansplat.rendering.projection.project_gaussians`."""
    fields = (gaussians.means, gaussians.opacities, gaussians.harmonics, gaussians.quats, gaussians.scales)
    return ProjectedGaussians(*_Project.apply(cam2world, filter_variance, *fields))


class _Project(torch.autograd.Function):
    """Projection: one kernel forward, one backward."""

    @staticmethod
    def forward(ctx: Any, cam2world: Tensor, filter_variance: float, *fields: Tensor) -> tuple[Tensor, ...]:
        from pansplat.rendering.cuda.projection import project_forward

        fields = tuple(field.contiguous() for field in fields)
        ctx.save_for_backward(cam2world, *fields)
        ctx.filter_variance = filter_variance
        return tuple(project_forward(cam2world, fields, filter_variance))

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        from pansplat.rendering.cuda.projection_backward import backpropagate_projection

        cam2world, *fields = ctx.saved_tensors
        grads = ProjectedGaussians(*grad_outputs)
        grad_pose, *grad_fields = backpropagate_projection(cam2world, fields, grads, ctx.filter_variance)
        return grad_pose, None, *grad_fields


@torch.no_grad()
def _sort_instances(projected: ProjectedGaussians, planes: list[ImagePlane], options: RasterOptions) -> "Instances":
    """The visible records of each image plane, front to back."""
    from pansplat.rendering.cuda.tiling import sort_instances

    boxes = [compute_footprints(projected, plane, options)[1] for plane in planes]
    return sort_instances(boxes, projected.radius, planes[0].size, wraps=planes[0].is_panorama)


class _Composite(torch.autograd.Function):
    """Sums of weight x (values, 1) along the rays of all image planes; backward uses what forward has made."""

    @staticmethod
    def forward(
        ctx: Any,
        point: Tensor,
        rows: Tensor,
        radial_variance: Tensor,
        peak: Tensor,
        values: Tensor,
        instances: "Instances",
        planes: list[ImagePlane],
        grad_enabled: bool,
    ) -> Tensor:
        from pansplat.rendering.cuda.rasterize import pack_records, rasterize
        from pansplat.rendering.cuda.tiling import intersect_tiles, tile_pixels

        records = pack_records(Footprints(point, rows, radial_variance, peak, values))
        pixels = tile_pixels(planes, rows.dtype)
        sums = records.new_empty(len(planes), values.shape[1] + 1, *planes[0].size)
        kept = []
        for band in intersect_tiles(instances):
            stops = rasterize(records, band, pixels, sums)
            if grad_enabled and any(ctx.needs_input_grad):  # needs_input_grad itself ignores no_grad
                kept.append((band, stops))
        ctx.save_for_backward(records, rows, sums)
        ctx.saved = instances, pixels, kept
        return sums

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        from pansplat.rendering.cuda.rasterize import gradient_size, rasterize_backward, sum_by_record, unpack_gradients

        if torch.is_grad_enabled():  # the caller chose create_graph=True
            raise RuntimeError("second derivatives of a rendering are not available; drop create_graph=True")
        records, rows, sums = ctx.saved_tensors
        instances, pixels, kept = ctx.saved
        totals = records.new_zeros(len(instances.records), gradient_size(records))
        for band, stops in kept:
            rasterize_backward(records, band, stops, pixels, sums, grad_outputs[0].contiguous(), totals)
        return *unpack_gradients(sum_by_record(totals, instances, len(records)), rows), None, None, None
