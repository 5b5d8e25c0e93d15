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

from pansplat.gaussians.gaussians import Gaussians
from pansplat.gaussians.harmonics import evaluate
from pansplat.geometry.pose import rotations_from_quats

ALPHA_CUT = 1 / 255
_LARGEST = 1e30
_LARGEST_RATIO = 1e12  # of scale to distance; beyond it the products of section 2 could overflow
_CHUNK = 1 << 17


class Observed(NamedTuple):
    """Gaussians as a camera sees them, everything but `radius` divided by their distance.

    Attributes:
        direction: unit direction from the camera to the mean, camera axes, float64.
        radius: distance of the mean, metres, float64.
        covariance: C' of docs/rendering.md, camera axes, float64.
        peak: opacity after the filter's compensation.
        values: RGB seen from the camera, and the distance: what is averaged along a ray.
        forms: rows a, b, l of the exact kernel; no rows for `ewa`, which finds them per picture.
        along: S', the variance along the ray.
    """

    direction: Float[Tensor, "n 3"]
    radius: Float[Tensor, "n"]
    covariance: Float[Tensor, "n 3 3"]
    peak: Float[Tensor, "n"]
    values: Float[Tensor, "n 4"]
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
    values: Float[Tensor, "n 4"]


def sound(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Which Gaussians hold only usable numbers: finite, and not so large that products overflow."""
    fields = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.harmonics)
    keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for field in fields:
        keep &= (field.detach().abs() < _LARGEST).reshape(len(keep), max(1, field[:1].numel())).all(dim=1)
    return keep


def near_enough(gaussians: Gaussians, radius: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Which Gaussians are not absurdly large for their distance."""
    return gaussians.scales.detach().double().abs().amax(dim=1) <= _LARGEST_RATIO * radius


def observe(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], *, spread: float, compensate: bool, exact: bool
) -> Observed:
    """The Gaussians as the camera sees them.

    Works in chunks; under autograd each chunk is computed again in backward, so that memory stays bounded.

    Args:
        gaussians: all drawable (see `sound`).
        cam2world: float64.
        spread: e^2, the variance that the filter adds across the ray, radians^2.
        compensate: whether the opacity is lowered by as much as the filter widened the Gaussian.
        exact: whether to find the exact kernel's forms.
    """
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.harmonics)
    work = functools.partial(_observe_chunk, cam2world=cam2world, spread=spread, compensate=compensate, exact=exact)
    parts = []
    for chunk in zip(*(field.split(_CHUNK) for field in fields), strict=True):
        parts.append(checkpoint(work, *chunk, use_reentrant=False) if torch.is_grad_enabled() else work(*chunk))
    return Observed(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _observe_chunk(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    harmonics: Float[Tensor, "n k 3"],
    *,
    cam2world: Float[Tensor, "4 4"],
    spread: float,
    compensate: bool,
    exact: bool,
) -> Observed:
    dtype = means.dtype
    offset = means.double() - cam2world[:3, 3]
    radius = torch.linalg.vector_norm(offset, dim=1)
    world_direction = offset / radius[:, None]
    direction = world_direction @ cam2world[:3, :3]
    colours = evaluate(harmonics, world_direction.to(dtype))
    own = cam2world[:3, :3].T @ rotations_from_quats(quats.double())  # columns: the Gaussian's axes, camera frame
    size = scales.double() / radius[:, None]
    axes = own * size[:, None, :]
    covariance = axes @ axes.transpose(1, 2)
    outer = direction[:, :, None] * direction[:, None, :]
    covariance = covariance + spread * (torch.eye(3, dtype=torch.float64, device=means.device) - outer)

    # Sums of squares only: no cancellation however flat or long the Gaussian is.
    cosine2 = (direction[:, None, :] @ own)[:, 0, :].square()
    minors2 = (size[:, (1, 2, 0)] * size[:, (2, 0, 1)]).square()
    det_across = (minors2 * cosine2).sum(dim=1)
    trace_across = (size.square() * (1 - cosine2)).sum(dim=1)
    det_filtered = det_across + spread * trace_across + spread**2
    peak = opacities.double()
    if compensate:
        # The bound keeps the square root's slope finite; below it nothing reaches the alpha cut.
        peak = peak * torch.sqrt((det_across / det_filtered).clamp_min(1e-12))
    forms, along = covariance.new_zeros(len(means), 0, 3), torch.zeros_like(radius)
    if exact:
        variance_along = (size.square() * cosine2).sum(dim=1)
        mixed = (minors2 * (1 - cosine2)).sum(dim=1)
        along = (spread**2 * variance_along + spread * mixed + size.square().prod(dim=1)) / det_filtered
        forms = _ray_forms(direction, axes, spread, det_filtered)
    values = torch.cat((colours, radius.to(dtype)[:, None]), dim=1)
    return Observed(direction, radius, covariance, peak.to(dtype), values, forms.to(dtype), along.to(dtype))


def _ray_forms(
    direction: Float[Tensor, "n 3"],
    axes: Float[Tensor, "n 3 3"],
    spread: float,
    det_filtered: Float[Tensor, "n"],
) -> Float[Tensor, "n 3 3"]:
    """Rows a, b, l of section 3: whitened tangent axes, and the front form."""
    right, down = tangent_frame(direction)
    u, v, w = ((axis[:, None, :] @ axes)[:, 0, :] for axis in (right, down, direction))
    b_uu = u.square().sum(dim=1) + spread
    b_vv = v.square().sum(dim=1) + spread
    b_uv, c_u, c_v = (u * v).sum(dim=1), (u * w).sum(dim=1), (v * w).sum(dim=1)
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
    clamped_x = tan_x.clamp(-0.65 * width / focal, 0.65 * width / focal)
    clamped_y = tan_y.clamp(-0.65 * height / focal, 0.65 * height / focal)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    rows = torch.stack((one, zero, -clamped_x, zero, one, -clamped_y), dim=1).reshape(-1, 2, 3)
    jacobian = rows * (focal / z)[:, None, None]
    v = jacobian @ covariance @ jacobian.transpose(1, 2)
    v_xx, v_xy, v_yy = v[:, 0, 0] + dilation, v[:, 0, 1], v[:, 1, 1] + dilation
    # Rounding can leave a needle's determinant at or below zero.
    across = (v_yy - v_xy * v_xy / v_xx).clamp_min(1e-12)
    first = torch.stack((1 / torch.sqrt(v_xx), zero, zero), dim=1)
    second = torch.stack((-v_xy / v_xx, one, zero), dim=1) / torch.sqrt(across)[:, None]
    forms = torch.stack((first, second, torch.zeros_like(first)), dim=1).to(dtype)
    point = torch.stack((focal * tan_x + 0.5 * width, focal * tan_y + 0.5 * height, zero), dim=1)
    splats = Splats(point, forms, torch.zeros_like(observed.peak), observed.peak, observed.values)
    return splats, torch.stack((v_xx, v_yy), dim=1).detach()
