"""Spherical plane sweep: where the points on concentric spheres about one camera appear in another camera's panorama.

A candidate is an inverse depth; a pixel's ray meets its sphere in a point, which the other camera sees somewhere. The
warp samples the other panorama there; the correlation compares the sample with the pixel itself.

Two ways of sampling: `sphere` is right (half-integer pixel centres, columns wrap, rows go on over the poles);
`corners` is the original's (rays through half-integer centres, samples as if the corner pixels' centres lay on the
border, zeros outside), which shifts even the identity by up to half a pixel.

No gradient flows to poses and candidates.

Source: PanSplat, section 3.2; OFFICIAL.md, section 6.
"""

import math
from collections.abc import Iterator
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from pansplat.geometry import correlation_kernel as kernel
from pansplat.geometry import wrap
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import invert_pose

Sampling = Literal["sphere", "corners"]
Backend = Literal["auto", "torch", "kernel"]

_CHUNK = 1 << 22
"""Numbers in the warped features, or in the positions, that exist at a time."""


def relative_pose(
    reference: Float[Tensor, "*batch 4 4"], other: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 4 4"]:
    """From reference camera axes to the other's, of two cam2world poses; float64, as distances cancel."""
    return invert_pose(other.double()) @ reference.double()


def sweep_positions(
    inverse_depth: Float[Tensor, "pair candidate height width"], pose: Float[Tensor, "pair 4 4"], sampling: Sampling
) -> tuple[Float[Tensor, "pair candidate height width"], Float[Tensor, "pair candidate height width"]]:
    """Column and row in the other panorama of each pixel at each inverse depth; 0 is the first pixel's centre.

    Args:
        inverse_depth: 1 / metres, >= 0; 0 is a point at infinity (not with `corners`).
        pose: from reference camera axes to the other's, rigid, metres.

    A point in the other camera's centre has no direction; it is given the place of some pixel, never NaN.
    """
    height, width = inverse_depth.shape[-2:]
    rays = pixel_directions(height, width, dtype=inverse_depth.dtype, device=inverse_depth.device)
    pose = pose.to(inverse_depth)
    turned = torch.einsum("nij,hwj->inhw", pose[:, :3, :3], rays)[:, :, None]
    translation = pose[:, :3, 3].T[:, :, None, None, None]
    if sampling == "corners":
        return _corner_positions(turned / inverse_depth + translation)
    points = turned + translation * inverse_depth
    return _sphere_positions(points, rays)


def _sphere_positions(points: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """By the angle from each pixel's own ray to the point: exact where the camera has not moved."""
    height, width = rays.shape[:2]
    x, y, z = points
    ray_x, ray_y, ray_z = rays.unbind(-1)
    # Unlike a hypotenuse, these round the same way whether or not they are vectorised.
    flat, ray_flat = (x * x + z * z).sqrt(), (ray_x * ray_x + ray_z * ray_z).sqrt()
    east = torch.atan2(x * ray_z - z * ray_x, z * ray_z + x * ray_x)
    down = torch.atan2(y * ray_flat - flat * ray_y, flat * ray_flat + y * ray_y)
    columns = torch.arange(width, dtype=x.dtype, device=x.device) + east * (width / (2 * math.pi))
    rows = torch.arange(height, dtype=x.dtype, device=x.device)[:, None] + down * (height / math.pi)
    return columns.remainder(width), rows.clamp(-0.5, height - 0.5)


def _corner_positions(points: Tensor) -> tuple[Tensor, Tensor]:
    """The original's; a sine that rounds above one is cut, where the original has NaN."""
    height, width = points.shape[-2:]
    x, y, z = points
    y = y / (x * x + y * y + z * z).sqrt().clamp(min=1e-3)
    u = torch.atan2(x, z) / (2 * math.pi) + 0.5
    v = torch.asin(y.clamp(-1, 1)) / math.pi + 0.5
    return u * (width - 1), v * (height - 1)


def sample(
    maps: Float[Tensor, "pair channel height width"],
    columns: Float[Tensor, "pair candidate h w"],
    rows: Float[Tensor, "pair candidate h w"],
    sampling: Sampling,
) -> Float[Tensor, "pair channel candidate h w"]:
    """Bilinear samples of maps at columns and rows as `sweep_positions` gives them."""
    if sampling == "sphere":
        maps, columns, rows = wrap.pad(maps, 1, "sphere"), columns + 1, rows + 1
    height, width = maps.shape[-2:]
    grid = torch.stack((2 * columns / (width - 1) - 1, 2 * rows / (height - 1) - 1), dim=-1)
    samples = functional.grid_sample(maps, grid.flatten(1, 2), padding_mode="zeros", align_corners=True)
    return samples.unflatten(2, columns.shape[1:3])


def warp_panorama(
    maps: Float[Tensor, "pair channel height width"],
    inverse_depth: Float[Tensor, "pair candidate height width"],
    pose: Float[Tensor, "pair 4 4"],
    sampling: Sampling = "sphere",
) -> Float[Tensor, "pair channel candidate height width"]:
    """The other panorama as the reference camera would see it, if its pixels had the given inverse depths.

    Args:
        maps: the other panorama.
        inverse_depth: of the reference pixels, 1 / metres.
        pose: from reference camera axes to the other's.
    """
    with torch.no_grad():
        columns, rows = sweep_positions(inverse_depth, pose, sampling)
    return sample(maps, columns, rows, sampling)


def correlate(
    reference: Float[Tensor, "pair channel height width"],
    other: Float[Tensor, "pair channel height width"],
    inverse_depth: Float[Tensor, "pair candidate height width"],
    pose: Float[Tensor, "pair 4 4"],
    sampling: Sampling = "sphere",
    backend: Backend = "auto",
) -> Float[Tensor, "pair candidate height width"]:
    """Dot products of each pixel's features with the other panorama's, for each candidate, over sqrt(channel).

    The warped features of all candidates never exist at once, neither forward nor backward. Half-precision features
    are multiplied in float32. Gradient flows to both features.

    Args:
        reference: features at the pixels.
        other: features that are sampled, of the same size.
        inverse_depth: candidates of each pixel, 1 / metres.
        pose: from reference camera axes to the other's.
        sampling: see above.
        backend: "kernel" runs on the CPU only, "torch" anywhere; "auto" takes the faster.
    """
    if backend == "auto":
        backend = "kernel" if reference.device.type == "cpu" else "torch"
    method = _ByKernel if backend == "kernel" else _ByWarping
    dtype = torch.promote_types(reference.dtype, torch.float32)
    # Scaled before the product, so that no sum grows larger than the result.
    scaled = reference.to(dtype) / math.sqrt(reference.shape[1])
    return method.apply(scaled, other.to(dtype), inverse_depth.detach().to(dtype), pose.detach(), sampling)


class _ByWarping(torch.autograd.Function):
    """Warps a few candidates at a time, and again in the backward pass."""

    @staticmethod
    def forward(ctx, reference, other, inverse_depth, pose, sampling):
        ctx.save_for_backward(reference, other, inverse_depth, pose)
        ctx.sampling = sampling
        parts = [
            torch.einsum("nchw,ncdhw->ndhw", reference, warp_panorama(other, chunk, pose, sampling))
            for chunk in _chunks(inverse_depth, reference.numel())
        ]
        return torch.cat(parts, dim=1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):  # pyright: ignore[reportIncompatibleMethodOverride]
        reference, other, inverse_depth, pose = ctx.saved_tensors
        to_reference, to_other = torch.zeros_like(reference), torch.zeros_like(other)
        chunks = _chunks(inverse_depth, reference.numel())
        for chunk, part in zip(chunks, gradient.split([c.shape[1] for c in chunks], dim=1), strict=True):
            with torch.enable_grad():
                leaf = other.detach().requires_grad_()
                warped = warp_panorama(leaf, chunk, pose, ctx.sampling)
            to_reference += torch.einsum("ndhw,ncdhw->nchw", part, warped.detach())
            to_other += torch.autograd.grad(warped, leaf, part[:, None] * reference[:, :, None])[0]
        return to_reference, to_other, None, None, None


class _ByKernel(torch.autograd.Function):
    """Loops over pixels in compiled code; warps nothing."""

    @staticmethod
    def forward(ctx, reference, other, inverse_depth, pose, sampling):
        ctx.save_for_backward(reference, other, inverse_depth, pose)
        ctx.sampling = sampling
        parts = [
            kernel.correlate_positions(reference, other, *place, wraps=sampling == "sphere")
            for _, place in _placed(inverse_depth, pose, sampling)
        ]
        return torch.cat(parts, dim=1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):  # pyright: ignore[reportIncompatibleMethodOverride]
        reference, other, inverse_depth, pose = ctx.saved_tensors
        to_reference, to_other = torch.zeros_like(reference), torch.zeros_like(other)
        for candidates, place in _placed(inverse_depth, pose, ctx.sampling):
            steps = kernel.correlate_positions_backward(
                gradient[:, candidates], reference, other, *place, wraps=ctx.sampling == "sphere"
            )
            to_reference += steps[0]
            to_other += steps[1]
        return to_reference, to_other, None, None, None


def _placed(inverse_depth: Tensor, pose: Tensor, sampling: Sampling) -> Iterator[tuple[slice, tuple[Tensor, Tensor]]]:
    """Groups of candidates with their positions in the other panorama."""
    start = 0
    for chunk in _chunks(inverse_depth, inverse_depth[:, :1].numel()):
        yield slice(start, start + chunk.shape[1]), sweep_positions(chunk, pose, sampling)
        start += chunk.shape[1]


def _chunks(inverse_depth: Tensor, numbers: int) -> tuple[Tensor, ...]:
    """The candidates in groups within the limit, when one takes so many numbers."""
    return inverse_depth.split(max(1, _CHUNK // max(1, numbers)), dim=1)
