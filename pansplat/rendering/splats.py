"""What one camera sees of each Gaussian: direction, filtered covariance, opacity, colour, the kernel's forms.

Source: docs/rendering.md, sections 1 to 3. Geometry is float64 whatever the Gaussians' type is; what the
picture's inner loop reads is in the Gaussians' own type.
"""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pansplat.constants import (
    EWA_CLAMP,
    MAX_MAGNITUDE,
    MAX_SCALE_RATIO,
    MIN_COMPENSATION,
    MIN_EIGENVALUE_RATIO,
    MIN_EWA_VARIANCE,
)
from pansplat.gaussians.harmonics import evaluate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats

_CHUNK = 1 << 17


class Observed(NamedTuple):
    """Gaussians as a camera sees them, everything but `radius` divided by their distance.

    Attributes:
        direction: unit direction from the camera to the mean, camera axes, float64.
        radius: distance of the mean, metres, float64.
        covariance: C' of docs/rendering.md, camera axes, float64.
        peak: opacity after the filter's compensation.
        values: channels (RGB) seen from the camera, and the distance: what is averaged along a ray.
        forms: rows a, b, l of the exact kernel; no rows for `ewa`, which finds them per picture.
        along: S', the variance along the ray.
    """

    direction: Float[Tensor, "n 3"]
    radius: Float[Tensor, "n"]
    covariance: Float[Tensor, "n 3 3"]
    peak: Float[Tensor, "n"]
    values: Float[Tensor, "n value"]
    forms: Float[Tensor, "n f 3"]
    along: Float[Tensor, "n"]


class Splats(NamedTuple):
    """Gaussians ready to be drawn on one picture: alpha at x is peak * exp(-q(x - point) / 2).

    With A, B, L = 0, 0, 1 plus the forms' products with x - point, q = Q / (L^2 + along Q), Q = A^2 + B^2.
    """

    point: Float[Tensor, "n 3"]
    forms: Float[Tensor, "n 3 3"]
    along: Float[Tensor, "n"]
    peak: Float[Tensor, "n"]
    values: Float[Tensor, "n value"]


def sound(gaussians: Gaussians, covariances: Float[Tensor, "n 3 3"] | None = None) -> Bool[Tensor, "n"]:
    """Which Gaussians hold only usable numbers: finite, and not so large that products overflow."""
    shape = (gaussians.scales, gaussians.quats) if covariances is None else (covariances,)
    keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for field in (gaussians.means, *shape, gaussians.opacities, gaussians.harmonics):
        keep &= (field.detach().abs() < MAX_MAGNITUDE).reshape(len(keep), max(1, field[:1].numel())).all(dim=1)
    return keep


def near_enough(
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


def observe(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    cam2world: Float[Tensor, "4 4"],
    *,
    spread: float,
    compensate: bool,
    exact: bool,
) -> Observed:
    """The Gaussians as the camera sees them.

    Works in chunks; under autograd each chunk is computed again in backward, so that memory stays bounded.

    Args:
        gaussians: all drawable (see `sound`).
        covariances: in place of the Gaussians' scales and quats, square metres.
        cam2world: float64.
        spread: e^2, the variance that the filter adds across the ray, radians^2.
        compensate: whether the opacity is lowered by as much as the filter widened the Gaussian.
        exact: whether to find the exact kernel's forms.
    """
    shape = (gaussians.quats, gaussians.scales) if covariances is None else (covariances,)
    fields = (gaussians.means, gaussians.opacities, gaussians.harmonics, *shape)
    work = functools.partial(_observe_chunk, cam2world=cam2world, spread=spread, compensate=compensate, exact=exact)
    needs_grad = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (*fields, cam2world))
    parts = []
    for chunk in zip(*(field.split(_CHUNK) for field in fields), strict=True):
        parts.append(checkpoint(work, *chunk, use_reentrant=False) if needs_grad else work(*chunk))
    return Observed(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _observe_chunk(
    means: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    harmonics: Float[Tensor, "n k channel"],
    *shape: Tensor,
    cam2world: Float[Tensor, "4 4"],
    spread: float,
    compensate: bool,
    exact: bool,
) -> Observed:
    """What `observe` finds, of Gaussians few enough to be observed at once.

    Args:
        means, opacities, harmonics: of the Gaussians.
        shape: their quats and scales, or their covariances.
        cam2world, spread, compensate, exact: see `observe`.
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
    covariance = body.covariance + spread * (torch.eye(3, dtype=torch.float64, device=means.device) - outer)
    det_filtered = body.det_across + spread * body.trace_across + spread**2
    peak = opacities.double()
    if compensate:
        # The bound keeps the square root's slope finite; below it nothing reaches the alpha cut.
        peak = peak * torch.sqrt((body.det_across / det_filtered).clamp_min(MIN_COMPENSATION))
    forms, along = covariance.new_zeros(len(means), 0, 3), torch.zeros_like(radius)
    if exact:
        along = (spread**2 * body.along + spread * body.mixed + body.det) / det_filtered
        forms = _ray_forms(frame, body.in_frame, spread, det_filtered)
    values = torch.cat((colours, radius.to(dtype)[:, None]), dim=1)
    return Observed(direction, radius, covariance, peak.to(dtype), values, forms.to(dtype), along.to(dtype))


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


def _ray_forms(
    frame: Float[Tensor, "n 3 3"], in_frame: Float[Tensor, "n 3 3"], spread: float, det_filtered: Float[Tensor, "n"]
) -> Float[Tensor, "n 3 3"]:
    """Rows a, b, l of section 3: whitened tangent axes, and the front form."""
    right, down, direction = frame.unbind(1)
    b_uu, b_vv = in_frame[:, 0, 0] + spread, in_frame[:, 1, 1] + spread
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


def ray_splats(observed: Observed) -> Splats:
    """What the exact kernel draws, on any picture: points are directions in camera axes."""
    return Splats(observed.direction, observed.forms, observed.along, observed.peak, observed.values)


def ewa_splats(
    observed: Observed, rotation: Float[Tensor, "3 3"], size: tuple[int, int], focal: float, dilation: float
) -> tuple[Splats, Float[Tensor, "n 2"]]:
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
    forms = torch.stack((first, second, torch.zeros_like(first)), dim=1).to(dtype)
    point = torch.stack((focal * tan_x + 0.5 * width, focal * tan_y + 0.5 * height, zero), dim=1)
    splats = Splats(point, forms, torch.zeros_like(observed.peak), observed.peak, observed.values)
    return splats, torch.stack((v_xx, v_yy), dim=1).detach()
