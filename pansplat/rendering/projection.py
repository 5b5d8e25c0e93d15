"""Projection: selection of Gaussians, their projection to one camera, footprints and bounding boxes.

Source: docs/rendering.md, sections 1 to 3 and 5. Geometry is float64 for Gaussians of any type; the numbers that
compositing reads have the Gaussians' type.
"""

import functools
import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pansplat.constants import (
    ALPHA_CUT,
    EWA_CLAMP,
    EWA_DILATION,
    KAPPA_MARGIN,
    MAX_MAGNITUDE,
    MAX_SCALE_RATIO,
    MIN_COMPENSATION,
    MIN_EWA_VARIANCE,
    OPACITY_CUT,
)
from pansplat.gaussians.harmonics import evaluate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.rasterize import RasterOptions

_CHUNK_SIZE = 1 << 17  # Gaussians projected at a time
_UNBOUNDED = 1e9  # pixels, far outside any image


# --- selection: the Gaussians that are finite, far enough and opaque enough ---


def select_drawable(gaussians: Gaussians, pose: Float[Tensor, "4 4"], near: float) -> Gaussians:
    """Select Gaussians before any arithmetic, so that the gradients of all others are exactly zero."""
    keep = _are_drawable(gaussians, pose, near)
    return gaussians if bool(keep.all()) else gaussians.select(keep)


@torch.no_grad()
def _are_drawable(gaussians: Gaussians, pose: Float[Tensor, "4 4"], near: float) -> Bool[Tensor, "n"]:
    radius = torch.linalg.vector_norm(gaussians.means.double() - pose[:3, 3], dim=1)
    keep = (radius >= near) & (gaussians.opacities >= OPACITY_CUT)
    # Finite numbers only, small enough for their products, and not too large for the distance.
    for name in ("means", "scales", "quats", "opacities", "harmonics"):
        field = getattr(gaussians, name)
        keep &= (field.abs() < MAX_MAGNITUDE).reshape(len(keep), max(1, field[:1].numel())).all(dim=1)
    return keep & (gaussians.scales.double().abs().amax(dim=1) <= MAX_SCALE_RATIO * radius)


# --- projection: Gaussians in the axes of one camera ---


class ProjectedGaussians(NamedTuple):
    """Gaussians as one camera sees them; all lengths but `radius` are divided by their distance.

    Attributes:
        direction: unit direction from the camera to the mean, camera axes, float64.
        radius: distance of the mean, metres, float64.
        covariance: C' of docs/rendering.md, camera axes, float64.
        peak: opacity after the filter's compensation.
        values: colour (RGB) seen from the camera, then the distance; compositing averages both along a ray.
        rows: rows a, b, l of the exact kernel; none for `ewa`, which computes them for each image plane.
        radial_variance: S', the variance along the ray.
    """

    direction: Float[Tensor, "n 3"]
    radius: Float[Tensor, "n"]
    covariance: Float[Tensor, "n 3 3"]
    peak: Float[Tensor, "n"]
    values: Float[Tensor, "n value"]
    rows: Float[Tensor, "n f 3"]
    radial_variance: Float[Tensor, "n"]


def project_gaussians(
    gaussians: Gaussians,
    cam2world: Float[Tensor, "4 4"],
    *,
    filter_variance: float,
    exact: bool,
) -> ProjectedGaussians:
    """Project Gaussians in chunks; under autograd, backward recomputes each chunk to bound the memory.

    Args:
        gaussians: selected by `select_drawable`.
        cam2world: float64.
        filter_variance: e^2, added across the ray, radians^2.
        exact: compute the rows of the exact kernel, and lower the opacity so that the filter does not add energy.
    """
    fields = (gaussians.means, gaussians.opacities, gaussians.harmonics, gaussians.quats, gaussians.scales)
    project = functools.partial(_project_chunk, cam2world=cam2world, filter_variance=filter_variance, exact=exact)
    needs_grad = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (*fields, cam2world))
    parts = []
    for chunk in zip(*(field.split(_CHUNK_SIZE) for field in fields), strict=True):
        parts.append(checkpoint(project, *chunk, use_reentrant=False) if needs_grad else project(*chunk))
    return ProjectedGaussians(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _project_chunk(
    means: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    harmonics: Float[Tensor, "n k channel"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    *,
    cam2world: Float[Tensor, "4 4"],
    filter_variance: float,
    exact: bool,
) -> ProjectedGaussians:
    """Project one chunk of `project_gaussians`."""
    dtype = means.dtype
    offset = means.double() - cam2world[:3, 3]
    radius = torch.linalg.vector_norm(offset, dim=1)
    world_direction = offset / radius[:, None]
    direction = world_direction @ cam2world[:3, :3]
    colours = evaluate_harmonics(harmonics, world_direction.to(dtype))
    frame = torch.stack((*tangent_frame(direction), direction), dim=1)
    unfiltered = _find_shape(cam2world[:3, :3].T @ rotations_from_quats(quats.double()), scales, radius, frame)
    outer = direction[:, :, None] * direction[:, None, :]
    covariance = unfiltered.covariance + filter_variance * (
        torch.eye(3, dtype=torch.float64, device=means.device) - outer
    )
    peak = opacities.double()
    rows, radial_variance = covariance.new_zeros(len(means), 0, 3), torch.zeros_like(radius)
    if exact:
        det_filtered = unfiltered.det_across + filter_variance * unfiltered.trace_across + filter_variance**2
        peak = peak * torch.sqrt((unfiltered.det_across / det_filtered).clamp_min(MIN_COMPENSATION))
        radial_variance = (
            filter_variance**2 * unfiltered.radial_variance + filter_variance * unfiltered.mixed + unfiltered.det
        )
        radial_variance = radial_variance / det_filtered
        rows = _compute_ray_rows(frame, unfiltered.in_frame, filter_variance, det_filtered)
    values = torch.cat((colours, radius.to(dtype)[:, None]), dim=1)
    return ProjectedGaussians(
        direction, radius, covariance, peak.to(dtype), values, rows.to(dtype), radial_variance.to(dtype)
    )


class _Shape(NamedTuple):
    """A Gaussian's covariance before the filter, divided by its squared distance, and its minors (section 1).

    Attributes:
        covariance: C, camera axes.
        in_frame: C in the tangent frame u, v, n.
        det_across, trace_across: determinant and trace of B, the block across the ray.
        radial_variance: g, the variance along the ray.
        mixed: M = g tr B - |c|^2.
        det: det C.
    """

    covariance: Float[Tensor, "n 3 3"]
    in_frame: Float[Tensor, "n 3 3"]
    det_across: Float[Tensor, "n"]
    trace_across: Float[Tensor, "n"]
    radial_variance: Float[Tensor, "n"]
    mixed: Float[Tensor, "n"]
    det: Float[Tensor, "n"]


def _find_shape(
    rotation: Float[Tensor, "n 3 3"],
    scales: Float[Tensor, "n 3"],
    radius: Float[Tensor, "n"],
    frame: Float[Tensor, "n 3 3"],
) -> _Shape:
    """Compute the shape from a rotation to camera axes and scales, by sums of squares, without cancellation."""
    size = scales.double() / radius[:, None]
    axes = rotation * size[:, None, :]
    turned = frame @ axes
    cosine2 = (frame[:, 2:] @ rotation)[:, 0, :].square()
    minors2 = (size.roll(-1, 1) * size.roll(-2, 1)).square()
    return _Shape(
        covariance=axes @ axes.transpose(1, 2),
        in_frame=turned @ turned.transpose(1, 2),
        det_across=(minors2 * cosine2).sum(dim=1),
        trace_across=(size.square() * (1 - cosine2)).sum(dim=1),
        radial_variance=(size.square() * cosine2).sum(dim=1),
        mixed=(minors2 * (1 - cosine2)).sum(dim=1),
        det=size.square().prod(dim=1),
    )


def _compute_ray_rows(
    frame: Float[Tensor, "n 3 3"],
    in_frame: Float[Tensor, "n 3 3"],
    filter_variance: float,
    det_filtered: Float[Tensor, "n"],
) -> Float[Tensor, "n 3 3"]:
    """Compute rows a, b, l of section 3: whitened tangent axes, and the row along the ray."""
    right, down, direction = frame.unbind(1)
    b_uu, b_vv = in_frame[:, 0, 0] + filter_variance, in_frame[:, 1, 1] + filter_variance
    b_uv, c_u, c_v = in_frame[:, 0, 1], in_frame[:, 0, 2], in_frame[:, 1, 2]
    first = right / torch.sqrt(b_uu)[:, None]
    second = (down - (b_uv / b_uu)[:, None] * right) * torch.sqrt(b_uu / det_filtered)[:, None]
    p_u = (b_uv * c_v - b_vv * c_u) / det_filtered
    p_v = (b_uv * c_u - b_uu * c_v) / det_filtered
    front = direction + p_u[:, None] * right + p_v[:, None] * down
    return torch.stack((first, second, front), dim=1)


def tangent_frame(direction: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors that form a right-handed frame with each unit direction; smooth except at z = 0.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
    """
    x, y, z = direction.unbind(1)
    sign = torch.where(z < 0, -torch.ones_like(z), torch.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), dim=1)
    second = torch.stack((b, sign + y * y * a, -y), dim=1)
    return first, second


# --- footprints on one image plane ---


class Footprints(NamedTuple):
    """Projected Gaussians on one image plane: alpha at x is peak * exp(-q(x - point) / 2).

    With A, B, L = 0, 0, 1 plus the products of the rows with x - point, and Q = A^2 + B^2:
    q = Q / (L^2 + radial_variance Q).
    """

    point: Float[Tensor, "n 3"]
    rows: Float[Tensor, "n 3 3"]
    radial_variance: Float[Tensor, "n"]
    peak: Float[Tensor, "n"]
    values: Float[Tensor, "n value"]


def compute_footprints(
    projected: ProjectedGaussians, plane: ImagePlane, options: RasterOptions
) -> tuple[Footprints, Float[Tensor, "n 4"]]:
    """Compute footprints on an image plane, and their bounding boxes (left, right, top, bottom; pixels)."""
    if options.kernel == "ewa":
        footprints, variances = ewa_footprints(projected, plane.rotation, plane.size, plane.focal)
        return footprints, ewa_boxes(footprints.point.detach(), variances, kappa(projected.peak.detach()))
    kappas, direction = kappa(projected.peak.detach()), projected.direction.detach()
    covariance = projected.covariance.detach()
    if plane.is_panorama:
        return ray_footprints(projected), equirect_boxes(direction, covariance, kappas, plane.size)
    turned = plane.rotation.T @ covariance @ plane.rotation
    boxes = pinhole_boxes(direction @ plane.rotation, turned, kappas, plane.size, plane.focal)
    return ray_footprints(projected), boxes


def ray_footprints(projected: ProjectedGaussians) -> Footprints:
    """Footprints of the exact kernel, the same on every image plane: points are directions in camera axes."""
    return Footprints(projected.direction, projected.rows, projected.radial_variance, projected.peak, projected.values)


def ewa_footprints(
    projected: ProjectedGaussians, rotation: Float[Tensor, "3 3"], size: tuple[int, int], focal: float
) -> tuple[Footprints, Float[Tensor, "n 2"]]:
    """Compute EWA footprints on a pinhole image, with points in pixels, and their variances in x and y.

    Args:
        projected: all with a positive depth in the image plane's axes.
        rotation: the image plane's axes in camera axes.
        size: height and width, pixels.
        focal: pixels.
    """
    height, width = size
    dtype = projected.peak.dtype
    x, y, z = (projected.direction @ rotation).unbind(1)
    covariance = rotation.T @ projected.covariance @ rotation
    tan_x, tan_y = x / z, y / z
    limit = 0.5 * EWA_CLAMP
    clamped_x = tan_x.clamp(-limit * width / focal, limit * width / focal)
    clamped_y = tan_y.clamp(-limit * height / focal, limit * height / focal)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    rows = torch.stack((one, zero, -clamped_x, zero, one, -clamped_y), dim=1).reshape(-1, 2, 3)
    jacobian = rows * (focal / z)[:, None, None]
    v = jacobian @ covariance @ jacobian.transpose(1, 2)
    v_xx, v_xy, v_yy = v[:, 0, 0] + EWA_DILATION, v[:, 0, 1], v[:, 1, 1] + EWA_DILATION
    across = (v_yy - v_xy * v_xy / v_xx).clamp_min(MIN_EWA_VARIANCE)
    first = torch.stack((1 / torch.sqrt(v_xx), zero, zero), dim=1)
    second = torch.stack((-v_xy / v_xx, one, zero), dim=1) / torch.sqrt(across)[:, None]
    rows = torch.stack((first, second, torch.zeros_like(first)), dim=1).to(dtype)
    point = torch.stack((focal * tan_x + 0.5 * width, focal * tan_y + 0.5 * height, zero), dim=1)
    footprints = Footprints(point, rows, torch.zeros_like(projected.peak), projected.peak, projected.values)
    return footprints, torch.stack((v_xx, v_yy), dim=1).detach()


# --- bounding boxes: exact on pinhole images, tight and conservative on panoramas; float64, without gradient ---


def kappa(peak: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Largest q at which alpha reaches the cut, rounded up; negative where the peak is below the cut."""
    return 2 * torch.log(peak.double().clamp_min(1e-30) / ALPHA_CUT) + KAPPA_MARGIN


def is_in_image(
    boxes: Float[Tensor, "n 4"], plane: ImagePlane, rows: tuple[int, int] | None = None
) -> Bool[Tensor, "n"]:
    """Which boxes (left, right, top, bottom; pixels) intersect the image.

    Args:
        rows: only these rows of pixels: the first, and one past the last.
    """
    first, end = rows or (0, plane.size[0])
    left, right, top, bottom = boxes.unbind(1)
    inside = (left <= right) & (bottom > first) & (top < end)
    return inside if plane.is_panorama else inside & (right > 0) & (left < plane.size[1])


def pinhole_boxes(
    direction: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    kappas: Float[Tensor, "n"],
    size: tuple[int, int],
    focal: float,
) -> Float[Tensor, "n 4"]:
    """Boxes (left, right, top, bottom; pixels) of the exact kernel on a pinhole image; left > right where unseen.

    Args:
        direction, covariance: in the image plane's axes.
        kappas: see `kappa`.
        size: height and width, pixels.
        focal: pixels.
    """
    height, width = size
    n_z = direction[:, 2]
    d_zz = n_z.square() - kappas * covariance[:, 2, 2]
    crosses = d_zz <= 0  # the plane z = 0: no bound
    safe = torch.where(crosses, torch.ones_like(d_zz), d_zz)
    edges = []
    for axis, extent in ((0, width), (1, height)):
        n_x = direction[:, axis]
        c_xx, c_xz, c_zz = covariance[:, axis, axis], covariance[:, axis, 2], covariance[:, 2, 2]
        across = n_z.square() * c_xx + n_x.square() * c_zz - 2 * n_x * n_z * c_xz
        root = torch.sqrt((kappas * across + kappas.square() * (c_xz.square() - c_xx * c_zz)).clamp_min(0))
        middle = n_x * n_z - kappas * c_xz
        for sign in (-1, 1):
            edge = focal * (middle + sign * root) / safe + 0.5 * extent
            edges.append(torch.where(crosses, torch.full_like(edge, sign * _UNBOUNDED), edge))
    unseen = (kappas < 0) | (~crosses & (n_z < 0))
    # Gaussians that cross z = 0 have no bound, but most of them lie outside the view frustum.
    half_width, half_height = width / (2 * focal), height / (2 * focal)
    inward_normals = ((1, 0, half_width), (-1, 0, half_width), (0, 1, half_height), (0, -1, half_height))
    for normal in direction.new_tensor(inward_normals):
        distance = direction @ normal
        clear = distance.square() > kappas * (covariance @ normal @ normal)
        unseen |= clear & (distance < 0)
    return _mark_unseen(torch.stack(edges, dim=1), unseen)


def ewa_boxes(
    point: Float[Tensor, "n 3"], variances: Float[Tensor, "n 2"], kappas: Float[Tensor, "n"]
) -> Float[Tensor, "n 4"]:
    """Boxes of EWA footprints (left, right, top, bottom; pixels)."""
    reach = torch.sqrt(kappas.clamp_min(0)[:, None] * variances)
    low, high = point[:, :2] - reach, point[:, :2] + reach
    return _mark_unseen(torch.stack((low[:, 0], high[:, 0], low[:, 1], high[:, 1]), dim=1), kappas < 0)


def equirect_boxes(
    direction: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    kappas: Float[Tensor, "n"],
    size: tuple[int, int],
) -> Float[Tensor, "n 4"]:
    """Boxes of the exact kernel on a panorama, pixels; left may be negative and right beyond the width: boxes wrap."""
    height, width = size
    x, y, z = direction.unbind(1)
    kappas = kappas[:, None]
    flat = torch.hypot(x, z)
    on_axis = flat < 1e-12
    ahead_x = torch.where(on_axis, torch.zeros_like(x), x / flat.clamp_min(1e-12))
    ahead_z = torch.where(on_axis, torch.ones_like(z), z / flat.clamp_min(1e-12))
    zero = torch.zeros_like(x)
    ahead = torch.stack((ahead_x, zero, ahead_z), dim=1)
    east = torch.stack((ahead_z, zero, -ahead_x), dim=1)
    south = torch.stack((-y * ahead_x, flat, -y * ahead_z), dim=1)

    def form(p: Tensor, q: Tensor) -> Tensor:
        # Not a matrix product: CUDA's for many small matrices takes ten times as long.
        return ((p[:, :, None] * covariance).sum(dim=1) * q).sum(dim=1, keepdim=True) * kappas

    # Longitude relative to the mean's: tangents of the projection on the horizontal plane.
    d_ff = flat[:, None].square() - form(ahead, ahead)
    slopes = _cone_slopes(form(east, ahead), form(east, east), d_ff)
    longitude = torch.atan2(x, z)[:, None]
    columns = ((longitude + torch.atan(slopes)) / (2 * math.pi) + 0.5) * width
    around = torch.tensor((-_UNBOUNDED, _UNBOUNDED), dtype=columns.dtype, device=columns.device)
    columns = torch.where(d_ff <= 0, around, columns)

    # Latitude: a box around the ellipse in the plane that touches the sphere at the mean's direction.
    d_nn = 1 - form(direction, direction)
    sides = _cone_slopes(form(east, direction), form(east, east), d_nn).abs().amax(dim=1)
    ends = _cone_slopes(form(south, direction), form(south, south), d_nn)
    bottom = torch.asin(_max_sine(y, flat, ends, sides))
    top = -torch.asin(_max_sine(-y, flat, -ends.flip(1), sides))
    rows = (torch.stack((top, bottom), dim=1) / math.pi + 0.5) * height
    rows = torch.where(d_nn <= 0, around, rows)
    columns = torch.where(d_nn <= 0, around, columns)
    return _mark_unseen(torch.cat((columns, rows), dim=1), kappas[:, 0] < 0)


def _cone_slopes(mixed: Tensor, side: Tensor, ahead: Tensor) -> Float[Tensor, "n 2"]:
    """Lower and upper slope of a cone with dual entries -mixed, -side and ahead; 1 replaces ahead <= 0."""
    ahead = torch.where(ahead > 0, ahead, torch.ones_like(ahead))
    root = torch.sqrt((mixed.square() + side * ahead).clamp_min(0))
    return torch.cat((-mixed - root, -mixed + root), dim=1) / ahead


def _max_sine(
    sine: Float[Tensor, "n"], cosine: Float[Tensor, "n"], ends: Float[Tensor, "n 2"], sides: Float[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Upper bound of the sine of latitude over a box in the tangent plane at latitude asin(sine).

    Args:
        ends: smallest and largest offset towards growing latitude.
        sides: largest offset along the parallel.
    """
    height = sine[:, None] + ends * cosine[:, None]
    aside = torch.where(height > 0, torch.zeros_like(height), sides[:, None].square())
    highest = (height / torch.sqrt(1 + aside + ends.square())).amax(dim=1)
    over_pole = (sine > 0) & (ends[:, 0] * sine <= cosine) & (cosine <= ends[:, 1] * sine)
    return torch.where(over_pole, torch.ones_like(highest), highest).clamp(-1, 1)


def _mark_unseen(boxes: Float[Tensor, "n 4"], unseen: Tensor) -> Float[Tensor, "n 4"]:
    nowhere = torch.tensor((1.0, -1.0, 1.0, -1.0), dtype=boxes.dtype, device=boxes.device)
    return torch.where(unseen[:, None], nowhere, boxes)
