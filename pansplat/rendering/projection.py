"""Projection: what one camera sees of each Gaussian, its footprint on an image plane, and its bounding box there.

Source: docs/rendering.md, sections 1 to 3 and 5. Geometry is float64 whatever the Gaussians' type is; what the
compositing reads is in the Gaussians' own type.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pansplat.constants import (
    ALPHA_CUT,
    EWA_CLAMP,
    KAPPA_MARGIN,
    MAX_MAGNITUDE,
    MAX_SCALE_RATIO,
    MIN_COMPENSATION,
    MIN_EIGENVALUE_RATIO,
    MIN_EWA_VARIANCE,
    OPACITY_CUT,
)
from pansplat.errors import InputError
from pansplat.gaussians.harmonics import evaluate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.rasterize import RasterOptions


@dataclass(frozen=True, eq=False)
class Selection:
    """The Gaussians worth observing, and what became of the others.

    Attributes:
        covariances: theirs, where they were given in place of scales and quats.
        total: number of Gaussians given.
        dropped: not finite.
        near: nearer than `near`.
    """

    gaussians: Gaussians
    covariances: Float[Tensor, "n 3 3"] | None
    total: int
    dropped: int
    near: int


def select_drawable(
    gaussians: Gaussians, covariances: Float[Tensor, "n 3 3"] | None, pose: Float[Tensor, "4 4"], options: RasterOptions
) -> Selection:
    """Select before any arithmetic, which is what keeps the others' gradients exactly zero.

    Args:
        pose: cam2world.

    Raises:
        InputError: `options.strict` and a Gaussian is not finite.
    """
    radius = _radius(gaussians, pose)
    close = radius < options.near
    usable = _usable(gaussians, covariances, radius, close)
    dropped = len(gaussians) - int(usable.sum())
    if options.strict and dropped:
        raise InputError(not_finite_message(gaussians, covariances, pose, options))
    close &= usable
    keep = usable & ~close & (gaussians.opacities.detach() >= OPACITY_CUT)
    total, near = len(gaussians), int(close.sum())
    if not bool(keep.all()):
        gaussians = gaussians.select(keep)
        covariances = None if covariances is None else covariances[keep]
    return Selection(gaussians, covariances, total, dropped, near)


def not_finite_message(
    gaussians: Gaussians, covariances: Float[Tensor, "n 3 3"] | None, pose: Float[Tensor, "4 4"], options: RasterOptions
) -> str:
    """What to tell about Gaussians that cannot be drawn, at least one."""
    radius = _radius(gaussians, pose)
    wrong = torch.nonzero(~_usable(gaussians, covariances, radius, radius < options.near))[:, 0]
    return (
        f"`gaussians` must hold only finite numbers, got {len(wrong)} of {len(gaussians)} that do not (the first is "
        f"number {int(wrong[0])}); remove them, or render with strict=False to leave them out"
    )


@torch.no_grad()
def _radius(gaussians: Gaussians, pose: Tensor) -> Float[Tensor, "n"]:
    return torch.linalg.vector_norm(gaussians.means.double() - pose[:3, 3], dim=1)


@torch.no_grad()
def _usable(gaussians: Gaussians, covariances: Tensor | None, radius: Tensor, close: Tensor) -> Bool[Tensor, "n"]:
    return is_finite(gaussians, covariances) & (close | has_valid_shape(gaussians, covariances, radius))


_CHUNK = 1 << 17


class ProjectedGaussians(NamedTuple):
    """Gaussians as a camera sees them, everything but `radius` divided by their distance.

    Attributes:
        direction: unit direction from the camera to the mean, camera axes, float64.
        radius: distance of the mean, metres, float64.
        covariance: C' of docs/rendering.md, camera axes, float64.
        peak: opacity after the filter's compensation.
        values: channels (RGB) seen from the camera, and the distance: what is averaged along a ray.
        rows: rows a, b, l of the exact kernel; no rows for `ewa`, which finds them per picture.
        along: S', the variance along the ray.
    """

    direction: Float[Tensor, "n 3"]
    radius: Float[Tensor, "n"]
    covariance: Float[Tensor, "n 3 3"]
    peak: Float[Tensor, "n"]
    values: Float[Tensor, "n value"]
    rows: Float[Tensor, "n f 3"]
    along: Float[Tensor, "n"]


class Footprints(NamedTuple):
    """Gaussians ready to be drawn on one picture: alpha at x is peak * exp(-q(x - point) / 2).

    With A, B, L = 0, 0, 1 plus the rows' products with x - point, q = Q / (L^2 + along Q), Q = A^2 + B^2.
    """

    point: Float[Tensor, "n 3"]
    rows: Float[Tensor, "n 3 3"]
    along: Float[Tensor, "n"]
    peak: Float[Tensor, "n"]
    values: Float[Tensor, "n value"]


def is_finite(gaussians: Gaussians, covariances: Float[Tensor, "n 3 3"] | None = None) -> Bool[Tensor, "n"]:
    """Which Gaussians hold only usable numbers: finite, and not so large that products overflow."""
    shape = (gaussians.scales, gaussians.quats) if covariances is None else (covariances,)
    keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for field in (gaussians.means, *shape, gaussians.opacities, gaussians.harmonics):
        keep &= (field.detach().abs() < MAX_MAGNITUDE).reshape(len(keep), max(1, field[:1].numel())).all(dim=1)
    return keep


def has_valid_shape(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    radius: Float[Tensor, "n"],
) -> Bool[Tensor, "n"]:
    """Which Gaussians are not absurdly large for their distance, and have a covariance that can be one."""
    if covariances is None:
        return gaussians.scales.detach().double().abs().amax(dim=1) <= MAX_SCALE_RATIO * radius
    relative = covariances.detach().double() / radius.square()[:, None, None]
    largest = relative.diagonal(dim1=1, dim2=2).amax(dim=1)
    # Rounding to float32 or less makes a disc's smallest variance slightly negative; more than that is no covariance.
    finite = torch.where(torch.isfinite(relative), relative, 0)
    smallest = torch.linalg.eigvalsh(0.5 * (finite + finite.transpose(1, 2)))[:, 0]
    return (largest <= MAX_SCALE_RATIO**2) & (smallest >= MIN_EIGENVALUE_RATIO * largest)


def project_gaussians(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    cam2world: Float[Tensor, "4 4"],
    *,
    filter_variance: float,
    compensate: bool,
    exact: bool,
) -> ProjectedGaussians:
    """The Gaussians as the camera sees them.

    Works in chunks; under autograd each chunk is computed again in backward, so that memory stays bounded.

    Args:
        gaussians: all drawable (see `is_finite`).
        covariances: in place of the Gaussians' scales and quats, square metres.
        cam2world: float64.
        filter_variance: e^2, the variance that the filter adds across the ray, radians^2.
        compensate: whether the opacity is lowered by as much as the filter widened the Gaussian.
        exact: whether to find the exact kernel's rows.
    """
    shape = (gaussians.quats, gaussians.scales) if covariances is None else (covariances,)
    fields = (gaussians.means, gaussians.opacities, gaussians.harmonics, *shape)
    work = functools.partial(
        _observe_chunk, cam2world=cam2world, filter_variance=filter_variance, compensate=compensate, exact=exact
    )
    needs_grad = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (*fields, cam2world))
    parts = []
    for chunk in zip(*(field.split(_CHUNK) for field in fields), strict=True):
        parts.append(checkpoint(work, *chunk, use_reentrant=False) if needs_grad else work(*chunk))
    return ProjectedGaussians(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _observe_chunk(
    means: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    harmonics: Float[Tensor, "n k channel"],
    *shape: Tensor,
    cam2world: Float[Tensor, "4 4"],
    filter_variance: float,
    compensate: bool,
    exact: bool,
) -> ProjectedGaussians:
    """What `observe` finds, of Gaussians few enough to be observed at once.

    Args:
        means, opacities, harmonics: of the Gaussians.
        shape: their quats and scales, or their covariances.
        cam2world, filter_variance, compensate, exact: see `observe`.
    """
    dtype = means.dtype
    offset = means.double() - cam2world[:3, 3]
    radius = torch.linalg.vector_norm(offset, dim=1)
    world_direction = offset / radius[:, None]
    direction = world_direction @ cam2world[:3, :3]
    colours = evaluate_harmonics(harmonics, world_direction.to(dtype))
    world2cam = cam2world[:3, :3].T
    frame = torch.stack((*tangent_frame(direction), direction), dim=1)
    if len(shape) == 2:
        body = _from_axes(world2cam @ rotations_from_quats(shape[0].double()), shape[1], radius, frame)
    else:
        body = _from_covariance(world2cam @ shape[0].double() @ world2cam.T, radius, frame)
    outer = direction[:, :, None] * direction[:, None, :]
    covariance = body.covariance + filter_variance * (torch.eye(3, dtype=torch.float64, device=means.device) - outer)
    det_filtered = body.det_across + filter_variance * body.trace_across + filter_variance**2
    peak = opacities.double()
    if compensate:
        # The bound keeps the square root's slope finite; below it nothing reaches the alpha cut.
        peak = peak * torch.sqrt((body.det_across / det_filtered).clamp_min(MIN_COMPENSATION))
    rows, along = covariance.new_zeros(len(means), 0, 3), torch.zeros_like(radius)
    if exact:
        along = (filter_variance**2 * body.along + filter_variance * body.mixed + body.det) / det_filtered
        rows = _ray_rows(frame, body.in_frame, filter_variance, det_filtered)
    values = torch.cat((colours, radius.to(dtype)[:, None]), dim=1)
    return ProjectedGaussians(direction, radius, covariance, peak.to(dtype), values, rows.to(dtype), along.to(dtype))


class _Body(NamedTuple):
    """A Gaussian's shape before the filter, divided by its distance; section 1's minors.

    Attributes:
        covariance: C, camera axes.
        in_frame: C in the tangent frame u, v, n.
        det_across, trace_across: of B, the block across the ray.
        along: g, the variance along the ray.
        mixed: M = g tr B - |c|^2.
        det: det C.
    """

    covariance: Float[Tensor, "n 3 3"]
    in_frame: Float[Tensor, "n 3 3"]
    det_across: Float[Tensor, "n"]
    trace_across: Float[Tensor, "n"]
    along: Float[Tensor, "n"]
    mixed: Float[Tensor, "n"]
    det: Float[Tensor, "n"]


def _from_axes(
    own: Float[Tensor, "n 3 3"], scales: Float[Tensor, "n 3"], radius: Float[Tensor, "n"], frame: Float[Tensor, "n 3 3"]
) -> _Body:
    """From the own axes (columns, camera frame) and scales: sums of squares only, so nothing cancels."""
    size = scales.double() / radius[:, None]
    axes = own * size[:, None, :]
    turned = frame @ axes
    cosine2 = (frame[:, 2:] @ own)[:, 0, :].square()
    minors2 = (size[:, (1, 2, 0)] * size[:, (2, 0, 1)]).square()
    return _Body(
        covariance=axes @ axes.transpose(1, 2),
        in_frame=turned @ turned.transpose(1, 2),
        det_across=(minors2 * cosine2).sum(dim=1),
        trace_across=(size.square() * (1 - cosine2)).sum(dim=1),
        along=(size.square() * cosine2).sum(dim=1),
        mixed=(minors2 * (1 - cosine2)).sum(dim=1),
        det=size.square().prod(dim=1),
    )


def _from_covariance(
    covariance: Float[Tensor, "n 3 3"], radius: Float[Tensor, "n"], frame: Float[Tensor, "n 3 3"]
) -> _Body:
    """From a covariance in camera axes; what rounding made negative counts as zero."""
    c = 0.5 * (covariance + covariance.transpose(1, 2)) / radius.square()[:, None, None]
    turned = frame @ c @ frame.transpose(1, 2)
    uu, vv, nn = turned.diagonal(dim1=1, dim2=2).unbind(1)
    uv, un, vn = turned[:, 0, 1], turned[:, 0, 2], turned[:, 1, 2]
    det = uu * (vv * nn - vn * vn) - uv * (uv * nn - vn * un) + un * (uv * vn - vv * un)
    return _Body(
        covariance=c,
        in_frame=turned,
        det_across=(uu * vv - uv * uv).clamp_min(0),
        trace_across=(uu + vv).clamp_min(0),
        along=nn.clamp_min(0),
        mixed=(nn * (uu + vv) - un * un - vn * vn).clamp_min(0),
        det=det.clamp_min(0),
    )


def _ray_rows(
    frame: Float[Tensor, "n 3 3"],
    in_frame: Float[Tensor, "n 3 3"],
    filter_variance: float,
    det_filtered: Float[Tensor, "n"],
) -> Float[Tensor, "n 3 3"]:
    """Rows a, b, l of section 3: whitened tangent axes, and the front form."""
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
    """Two unit vectors that make a right-handed frame with each unit direction; smooth except at z = 0.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
    """
    x, y, z = direction.unbind(1)
    sign = torch.where(z < 0, -torch.ones_like(z), torch.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), dim=1)
    second = torch.stack((b, sign + y * y * a, -y), dim=1)
    return first, second


def ray_footprints(observed: ProjectedGaussians) -> Footprints:
    """What the exact kernel draws, on any picture: points are directions in camera axes."""
    return Footprints(observed.direction, observed.rows, observed.along, observed.peak, observed.values)


def ewa_footprints(
    observed: ProjectedGaussians, rotation: Float[Tensor, "3 3"], size: tuple[int, int], focal: float, dilation: float
) -> tuple[Footprints, Float[Tensor, "n 2"]]:
    """What the classic kernel draws on a pinhole picture, points in pixels, and its variances in x and y.

    Args:
        observed: all with a positive depth in the picture's camera.
        rotation: the picture's camera axes in the observing camera's.
        size: height and width, pixels.
        focal: pixels.
        dilation: variance added on both axes, pixels^2.
    """
    height, width = size
    dtype = observed.peak.dtype
    x, y, z = (observed.direction @ rotation).unbind(1)
    covariance = rotation.T @ observed.covariance @ rotation
    tan_x, tan_y = x / z, y / z
    limit = 0.5 * EWA_CLAMP
    clamped_x = tan_x.clamp(-limit * width / focal, limit * width / focal)
    clamped_y = tan_y.clamp(-limit * height / focal, limit * height / focal)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    rows = torch.stack((one, zero, -clamped_x, zero, one, -clamped_y), dim=1).reshape(-1, 2, 3)
    jacobian = rows * (focal / z)[:, None, None]
    v = jacobian @ covariance @ jacobian.transpose(1, 2)
    v_xx, v_xy, v_yy = v[:, 0, 0] + dilation, v[:, 0, 1], v[:, 1, 1] + dilation
    across = (v_yy - v_xy * v_xy / v_xx).clamp_min(MIN_EWA_VARIANCE)
    first = torch.stack((1 / torch.sqrt(v_xx), zero, zero), dim=1)
    second = torch.stack((-v_xy / v_xx, one, zero), dim=1) / torch.sqrt(across)[:, None]
    rows = torch.stack((first, second, torch.zeros_like(first)), dim=1).to(dtype)
    point = torch.stack((focal * tan_x + 0.5 * width, focal * tan_y + 0.5 * height, zero), dim=1)
    splats = Footprints(point, rows, torch.zeros_like(observed.peak), observed.peak, observed.values)
    return splats, torch.stack((v_xx, v_yy), dim=1).detach()


_EVERYTHING = 1e9  # pixels, far outside any picture


def kappa(peak: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Largest q at which alpha still reaches the cut; negative where it never does. Rounded up a little."""
    return 2 * torch.log(peak.double().clamp_min(1e-30) / ALPHA_CUT) + KAPPA_MARGIN


def pinhole_boxes(
    direction: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    level: Float[Tensor, "n"],
    size: tuple[int, int],
    focal: float,
) -> Float[Tensor, "n 4"]:
    """Boxes (left, right, top, bottom; pixels) of the exact kernel on a pinhole picture.

    Left > right where a Gaussian is not seen.

    Args:
        direction, covariance: in the picture's camera axes.
        level: kappa.
        size: height and width, pixels.
        focal: pixels.
    """
    height, width = size
    n_z = direction[:, 2]
    d_zz = n_z.square() - level * covariance[:, 2, 2]
    crosses = d_zz <= 0  # the plane through the eye: no bound
    safe = torch.where(crosses, torch.ones_like(d_zz), d_zz)
    edges = []
    for axis, extent in ((0, width), (1, height)):
        n_x = direction[:, axis]
        c_xx, c_xz, c_zz = covariance[:, axis, axis], covariance[:, axis, 2], covariance[:, 2, 2]
        across = n_z.square() * c_xx + n_x.square() * c_zz - 2 * n_x * n_z * c_xz
        root = torch.sqrt((level * across + level.square() * (c_xz.square() - c_xx * c_zz)).clamp_min(0))
        middle = n_x * n_z - level * c_xz
        for sign in (-1, 1):
            edge = focal * (middle + sign * root) / safe + 0.5 * extent
            edges.append(torch.where(crosses, torch.full_like(edge, sign * _EVERYTHING), edge))
    unseen = (level < 0) | (~crosses & (n_z < 0))
    # Those that cross the plane through the eye have no box, but most of them lie beside the view.
    for normal in _inward(size, focal, direction):
        distance = direction @ normal
        clear = distance.square() > level * (covariance @ normal @ normal)
        unseen |= clear & (distance < 0)
    return _hide(torch.stack(edges, dim=1), unseen)


def _inward(size: tuple[int, int], focal: float, like: Tensor) -> Float[Tensor, "4 3"]:
    """Normals, into the view, of the planes through the eye and the picture's four sides."""
    across, down = size[1] / (2 * focal), size[0] / (2 * focal)
    normals = ((1, 0, across), (-1, 0, across), (0, 1, down), (0, -1, down))
    return torch.tensor(normals, dtype=like.dtype, device=like.device)


def ewa_boxes(
    point: Float[Tensor, "n 3"], variances: Float[Tensor, "n 2"], level: Float[Tensor, "n"]
) -> Float[Tensor, "n 4"]:
    """Boxes of the classic kernel (left, right, top, bottom; pixels)."""
    reach = torch.sqrt(level.clamp_min(0)[:, None] * variances)
    low, high = point[:, :2] - reach, point[:, :2] + reach
    return _hide(torch.stack((low[:, 0], high[:, 0], low[:, 1], high[:, 1]), dim=1), level < 0)


def equirect_boxes(
    direction: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    level: Float[Tensor, "n"],
    size: tuple[int, int],
) -> Float[Tensor, "n 4"]:
    """Boxes of the exact kernel on a panorama, pixels.

    Left may be negative and right beyond the width: they wrap.
    """
    height, width = size
    x, y, z = direction.unbind(1)
    level = level[:, None]
    flat = torch.hypot(x, z)
    on_axis = flat < 1e-12
    ahead_x = torch.where(on_axis, torch.zeros_like(x), x / flat.clamp_min(1e-12))
    ahead_z = torch.where(on_axis, torch.ones_like(z), z / flat.clamp_min(1e-12))
    zero = torch.zeros_like(x)
    ahead = torch.stack((ahead_x, zero, ahead_z), dim=1)
    east = torch.stack((ahead_z, zero, -ahead_x), dim=1)
    south = torch.stack((-y * ahead_x, flat, -y * ahead_z), dim=1)

    def form(p: Tensor, q: Tensor) -> Tensor:
        return ((p[:, None, :] @ covariance)[:, 0, :] * q).sum(dim=1, keepdim=True) * level

    # Longitude, from the mean's: tangents of the shadow on the horizontal plane.
    d_ff = flat[:, None].square() - form(ahead, ahead)
    slopes = _tangents(form(east, ahead), form(east, east), d_ff)
    longitude = torch.atan2(x, z)[:, None]
    columns = ((longitude + torch.atan(slopes)) / (2 * math.pi) + 0.5) * width
    around = torch.tensor((-_EVERYTHING, _EVERYTHING), dtype=columns.dtype, device=columns.device)
    columns = torch.where(d_ff <= 0, around, columns)

    # Latitude: a box around the ellipse in the plane that touches the sphere at the mean's direction.
    d_nn = 1 - form(direction, direction)
    sides = _tangents(form(east, direction), form(east, east), d_nn).abs().amax(dim=1)
    ends = _tangents(form(south, direction), form(south, south), d_nn)
    bottom = torch.asin(_highest_sine(y, flat, ends, sides))
    top = -torch.asin(_highest_sine(-y, flat, -ends.flip(1), sides))
    rows = (torch.stack((top, bottom), dim=1) / math.pi + 0.5) * height
    rows = torch.where(d_nn <= 0, around, rows)
    columns = torch.where(d_nn <= 0, around, columns)
    return _hide(torch.cat((columns, rows), dim=1), level[:, 0] < 0)


def _tangents(mixed: Tensor, side: Tensor, ahead: Tensor) -> Float[Tensor, "n 2"]:
    """Lower and upper slope of a cone with dual entries -mixed, -side, ahead > 0 (else 1 stands in)."""
    ahead = torch.where(ahead > 0, ahead, torch.ones_like(ahead))
    root = torch.sqrt((mixed.square() + side * ahead).clamp_min(0))
    return torch.cat((-mixed - root, -mixed + root), dim=1) / ahead


def _highest_sine(
    sine: Float[Tensor, "n"],
    cosine: Float[Tensor, "n"],
    ends: Float[Tensor, "n 2"],
    sides: Float[Tensor, "n"],
) -> Float[Tensor, "n"]:
    """Bound on the sine of latitude over a box in the tangent plane at latitude asin(sine).

    Args:
        ends: lowest and highest step towards growing latitude.
        sides: largest step aside.
    """
    height = sine[:, None] + ends * cosine[:, None]
    aside = torch.where(height > 0, torch.zeros_like(height), sides[:, None].square())
    highest = (height / torch.sqrt(1 + aside + ends.square())).amax(dim=1)
    over_pole = (sine > 0) & (ends[:, 0] * sine <= cosine) & (cosine <= ends[:, 1] * sine)
    return torch.where(over_pole, torch.ones_like(highest), highest).clamp(-1, 1)


def _hide(boxes: Float[Tensor, "n 4"], unseen: Tensor) -> Float[Tensor, "n 4"]:
    nowhere = torch.tensor((1.0, -1.0, 1.0, -1.0), dtype=boxes.dtype, device=boxes.device)
    return torch.where(unseen[:, None], nowhere, boxes)


def is_in_image(
    boxes: Float[Tensor, "n 4"], picture: ImagePlane, rows: tuple[int, int] | None = None
) -> Bool[Tensor, "n"]:
    """Which boxes (left, right, top, bottom; pixels) reach into the picture.

    Args:
        rows: the first that count, and the first after them; by default all.
    """
    first, end = rows or (0, picture.size[0])
    left, right, top, bottom = boxes.unbind(1)
    inside = (left <= right) & (bottom > first) & (top < end)
    return inside if picture.is_panorama else inside & (right > 0) & (left < picture.size[1])


def compute_footprints(
    observed: ProjectedGaussians, picture: ImagePlane, options: RasterOptions
) -> tuple[Footprints, Float[Tensor, "n 4"]]:
    """The Gaussians on a picture, and the boxes they can be seen in."""
    if options.kernel == "ewa":
        splats, variances = ewa_footprints(observed, picture.rotation, picture.size, picture.focal, options.dilation)
        return splats, ewa_boxes(splats.point.detach(), variances, kappa(observed.peak.detach()))
    level, direction = kappa(observed.peak.detach()), observed.direction.detach()
    covariance = observed.covariance.detach()
    if picture.is_panorama:
        return ray_footprints(observed), equirect_boxes(direction, covariance, level, picture.size)
    turned = picture.rotation.T @ covariance @ picture.rotation
    boxes = pinhole_boxes(direction @ picture.rotation, turned, level, picture.size, picture.focal)
    return ray_footprints(observed), boxes
