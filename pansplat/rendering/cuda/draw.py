"""The Triton backend: Gaussians to pictures on a CUDA device, differentiable, in bounded memory.

Source: docs/rendering.md; docs/triton.md has the stages. Without a GPU it runs under Triton's interpreter, which is
for tests: a thousand times slower than the other backends.
"""

import contextlib
import importlib.util
import os
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pansplat.constants import EWA_NEAR_FACTOR
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.projection import (
    Footprints,
    ProjectedGaussians,
    compute_footprints,
    is_in_image,
    ray_footprints,
    select_drawable,
)
from pansplat.rendering.rasterize import RasterInfo, RasterOptions, RasterSums

if TYPE_CHECKING:
    from pansplat.rendering.cuda.lists import Instances


def rasterize_planes(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    pose: Float[Tensor, "4 4"],
    pictures: list[ImagePlane],
    options: RasterOptions,
) -> RasterSums:
    """Draw by Triton kernels; see `pansplat.rendering.rasterize.RasterBackend`.

    Raises:
        InputError: Triton is not installed, or the Gaussians are not on a CUDA device; or as stated there.
    """
    _check(gaussians.means.device)
    # Only now: the kernels need Triton.
    from pansplat.rendering.cuda.composite import composite
    from pansplat.rendering.cuda.observe import project_gaussians

    with _on(gaussians.means.device):
        chosen = select_drawable(gaussians, covariances, pose.detach(), options)
        observed = project_gaussians(
            chosen.gaussians,
            chosen.covariances,
            pose,
            filter_variance=options.filter_variance(pictures[0].pixel_angle),
            compensate=options.lowpass == "angular",
            exact=options.kernel == "ray",
        )
        splats, instances = _splats(observed, pictures, options)
        sums, entries, size = composite(splats, instances, pictures, exact=options.kernel == "ray")
    visible = sum(instances.pictures)
    return RasterSums(
        sums, RasterInfo(chosen.total, chosen.dropped, chosen.near, visible, entries, backend="triton", bytes=size)
    )


def _check(device: torch.device) -> None:
    """That Triton can run there."""
    if importlib.util.find_spec("triton") is None:
        raise InputError(
            "backend 'triton' needs the package triton, which is not installed; install it (pip install triton, on "
            "Linux), or use backend='auto'"
        )
    if device.type != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        raise InputError(
            f"backend 'triton' needs Gaussians on a CUDA device, got them on '{device}'; move them there "
            "(gaussians.to(device='cuda')), or use backend='auto'"
        )


def _on(device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Where Triton launches: on torch's current device, not on that of its arguments."""
    return torch.cuda.device(device) if device.type == "cuda" else contextlib.nullcontext()


def _splats(
    observed: ProjectedGaussians, pictures: list[ImagePlane], options: RasterOptions
) -> tuple[Footprints, "Instances"]:
    """What is to be drawn, and where: one record a Gaussian for the exact kernel, one a picture for the classic."""
    from pansplat.rendering.cuda.lists import list_instances

    fixed = ProjectedGaussians(*(field.detach() for field in observed))
    boxes, keys, bases, parts, total = [], [], [], [], 0
    for picture in pictures:
        key, seen = fixed.radius, None
        z = (fixed.direction @ picture.rotation[:, 2]) * fixed.radius
        if options.order == "z" and not picture.is_panorama:
            key = z
        if options.kernel == "ewa":
            ahead = torch.nonzero(z > EWA_NEAR_FACTOR * options.near)[:, 0]
            box = _boxes(ProjectedGaussians(*(field[ahead] for field in fixed)), picture, options)
            touched = is_in_image(box, picture)
            seen, box = ahead[touched], box[touched]
            part = ProjectedGaussians(*(_Take.apply(field, seen) for field in observed))
            parts.append(checkpoint(project, part, picture, options, use_reentrant=False)[0])
            bases.append(total)
            total, key = total + len(seen), key[seen]
        else:
            box = _boxes(fixed, picture, options)
            bases.append(0)
        boxes.append(box)
        keys.append(key)
    splats = (
        Footprints(*(torch.cat(field) for field in zip(*parts, strict=True))) if parts else ray_footprints(observed)
    )
    return splats, list_instances(boxes, keys, bases, pictures[0].size, wraps=pictures[0].is_panorama)


@torch.no_grad()
def _boxes(observed: ProjectedGaussians, picture: ImagePlane, options: RasterOptions) -> Float[Tensor, "n 4"]:
    return compute_footprints(observed, picture, options)[1]


class _Take(torch.autograd.Function):
    """Rows of a tensor, each at most once: so its backward needs neither a sort nor atomics."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Int[Tensor, "m"]) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = table.shape
        return table[rows]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        return grad_outputs[0].new_zeros(ctx.shape).index_copy_(0, rows, grad_outputs[0]), None
