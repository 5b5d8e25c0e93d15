"""The reference rasteriser: pure torch, float32 or float64, differentiable, in bounded memory.

Source: docs/rendering.md. Every faster renderer is compared with this one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.gaussians import Gaussians
from pansplat.geometry.pose import orthonormal_error
from pansplat.render.bounds import equirect_boxes, ewa_boxes, kappa, pinhole_boxes
from pansplat.render.composite import TilePixels, composite
from pansplat.render.panorama import Layout, Picture, pictures, stitch_faces
from pansplat.render.splats import (
    ALPHA_CUT,
    Observed,
    Splats,
    ewa_splats,
    near_enough,
    observe,
    ray_splats,
    sound,
)
from pansplat.render.threads import one_thread
from pansplat.render.tiles import TILE, list_tiles, tile_grid

Kernel = Literal["ray", "ewa"]
Order = Literal["radial", "z"]
Lowpass = Literal["angular", "3dgs"]
Backend = Literal["auto", "torch"]

_SPREAD = {"angular": 0.1, "3dgs": 0.3}  # variance added by the filters, pixels^2
_RIGID = 1e-4
_EWA_NEAR = 0.2  # of `near`: where the classic renderer culls by depth


@dataclass(frozen=True)
class Info:
    """How many Gaussians took part in a picture.

    Attributes:
        total: given.
        dropped: left out because a number was not finite or absurdly large.
        near: left out because they are nearer than `near`.
        visible: could reach the alpha cut somewhere in the picture (the sum over faces for a cubemap).
        entries: pairs of a Gaussian and a tile.
    """

    total: int
    dropped: int
    near: int
    visible: int
    entries: int


@dataclass(frozen=True, eq=False)
class Rendering:
    """One picture.

    Attributes:
        color: RGB over the background; not limited at 1.
        alpha: opacity in [0, 1].
        depth: mean radial distance of what is seen, metres; 0 where alpha is 0.
        info: counts, where a rasteriser made it.
    """

    color: Float[Tensor, "3 height width"]
    alpha: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]
    info: Info | None = None


@one_thread()
def rasterize(
    gaussians: Gaussians,
    cam2world: Float[Tensor, "4 4"],
    *,
    size: tuple[int, int],
    layout: Layout = "equirect",
    vertical_fov_degrees: float = 90.0,
    kernel: Kernel = "ray",
    order: Order = "radial",
    lowpass: Lowpass = "angular",
    background: Sequence[float] | Float[Tensor, "3"] = (0.0, 0.0, 0.0),
    near: float = 0.05,
    strict: bool = False,
    face_size: int | None = None,
    backend: Backend = "auto",
) -> Rendering:
    """Draw Gaussians as one camera sees them.

    Source: docs/rendering.md; PanSplat, section 3.4.

    Args:
        gaussians: float32 or float64 (halves are drawn in float32); differentiable in everything but labels.
        cam2world: rigid pose, metres; differentiable.
        size: height and width of the picture, pixels.
        layout: "equirect" traces one ray a pixel; "cubemap" stitches a panorama from six faces; "pinhole".
        vertical_fov_degrees: of the pinhole picture.
        kernel: "ray" is exact; "ewa" is the classic approximation, for pinhole pictures and cube faces.
        order: sort by distance, or by each picture's depth as the classic renderer does.
        lowpass: "angular" conserves energy; "3dgs" widens by 0.3 pixel^2.
        background: RGB behind the scene.
        near: Gaussians whose mean is nearer are left out, metres.
        strict: refuse Gaussians that are not finite rather than leave them out.
        face_size: of the cubemap's faces, pixels; by default as fine as the panorama's equator.
        backend: "torch" is this reference; "auto" takes the fastest there is.

    Returns:
        The picture, in the Gaussians' type.

    Raises:
        InputError: an argument is out of range, the pose is not rigid, "ewa" is asked for on "equirect", or
            `strict` and a Gaussian is not finite.
    """
    _check(size, layout, vertical_fov_degrees, kernel, order, lowpass, near, face_size, backend)
    device = gaussians.means.device
    pose = torch.as_tensor(cam2world, device=device).double()
    error = orthonormal_error(pose.detach()) if pose.shape == (4, 4) else math.inf
    if error > _RIGID:
        raise InputError(
            f"`cam2world` must be a rigid 4x4 camera-to-world matrix, got shape {tuple(pose.shape)} with an "
            f"error of {error:.2g}; normalise its rotation, and check that it is no projection or mirror"
        )
    if gaussians.means.dtype not in (torch.float32, torch.float64):
        gaussians = gaussians.to(dtype=torch.float32)
    planes = pictures(layout, size, vertical_fov_degrees=vertical_fov_degrees, face_size=face_size, device=device)
    drawable, dropped, close = _drawable(gaussians, pose.detach(), near, strict)
    pixel_angle = planes[0].pixel_angle
    widens = lowpass == "angular" or kernel == "ray"
    observed = observe(
        drawable,
        pose,
        spread=_SPREAD[lowpass] * pixel_angle**2 if widens else 0.0,
        compensate=lowpass == "angular",
        exact=kernel == "ray",
    )
    dilation = 0.0 if widens else _SPREAD[lowpass]
    drawn = [_draw(observed, plane, kernel, order, dilation, _EWA_NEAR * near) for plane in planes]
    sums = torch.stack([picture for picture, _, _ in drawn])
    sums = stitch_faces(sums, size) if layout == "cubemap" else sums[0]
    info = Info(len(gaussians), dropped, close, sum(d[1] for d in drawn), sum(d[2] for d in drawn))
    return _finish(sums, torch.as_tensor(background, dtype=sums.dtype, device=device), info)


def _check(
    size: tuple[int, int],
    layout: str,
    vertical_fov_degrees: float,
    kernel: str,
    order: str,
    lowpass: str,
    near: float,
    face_size: int | None,
    backend: str,
) -> None:
    choices = {"layout": Layout, "kernel": Kernel, "order": Order, "lowpass": Lowpass, "backend": Backend}
    for (name, allowed), value in zip(choices.items(), (layout, kernel, order, lowpass, backend), strict=True):
        if value not in get_args(allowed):
            raise InputError(f"`{name}` must be one of {', '.join(get_args(allowed))}, got {value!r}")
    if len(size) != 2 or min(size) < 1:
        raise InputError(f"`size` must be (height, width), both at least 1 pixel, got {size}")
    if face_size is not None and face_size < 1:
        raise InputError(f"`face_size` must be at least 1 pixel, got {face_size}")
    if not 0 < vertical_fov_degrees < 180:
        raise InputError(f"`vertical_fov_degrees` must lie between 0 and 180, got {vertical_fov_degrees}")
    if not 0 < near < math.inf:
        raise InputError(f"`near` must be a positive distance in metres, got {near}")
    if kernel == "ewa" and layout == "equirect":
        raise InputError(
            "kernel 'ewa' approximates a pinhole projection and is not defined on layout 'equirect'; "
            "use layout='cubemap', or kernel='ray'"
        )


@torch.no_grad()
def _near_and_sound(gaussians: Gaussians, pose: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Which Gaussians are nearer than `near`, and which hold only usable numbers."""
    radius = torch.linalg.vector_norm(gaussians.means.double() - pose[:3, 3], dim=1)
    close = radius < near
    return close, sound(gaussians) & (close | near_enough(gaussians, radius))


def _drawable(gaussians: Gaussians, pose: Tensor, near: float, strict: bool) -> tuple[Gaussians, int, int]:
    """The Gaussians worth observing, and how many were dropped and how many were too near.

    Selecting before any arithmetic is what keeps the others' gradients exactly zero.
    """
    close, usable = _near_and_sound(gaussians, pose, near)
    dropped = len(gaussians) - int(usable.sum())
    if strict and dropped:
        first = int(torch.nonzero(~usable)[0, 0])
        raise InputError(
            f"`gaussians` must hold only finite numbers, got {dropped} of {len(gaussians)} that do not (the "
            f"first is number {first}); remove them, or render with strict=False to leave them out"
        )
    close &= usable
    keep = usable & ~close & (gaussians.opacities.detach() >= ALPHA_CUT * (1 - 1e-6))
    chosen = gaussians if bool(keep.all()) else gaussians.select(keep)
    return chosen, dropped, int(close.sum())


def _draw(
    observed: Observed, picture: Picture, kernel: Kernel, order: Order, dilation: float, z_near: float
) -> tuple[Float[Tensor, "5 height width"], int, int]:
    """Sums of weight * (RGB, distance, 1) over one picture, the number of Gaussians and of entries drawn."""
    z = (observed.direction.detach() @ picture.rotation[:, 2]) * observed.radius.detach()
    if kernel == "ewa":
        observed = Observed(*(field[z > z_near] for field in observed))
        z = z[z > z_near]
    key = observed.radius.detach() if order == "radial" or picture.is_panorama else z
    splats, boxes = _project(observed, picture, kernel, dilation)
    seen = torch.nonzero(_in_picture(boxes, picture))[:, 0]
    if len(seen) < len(boxes):
        splats, boxes, key = Splats(*(field[seen] for field in splats)), boxes[seen], key[seen]
    pixels = _tile_pixels(picture, kernel, observed.peak.dtype)
    rows, columns = tile_grid(*picture.size)
    order_in_depth = torch.argsort(key, stable=True)
    bands, entries = [], 0
    for lists in list_tiles(boxes, order_in_depth, picture.size, wraps=picture.is_panorama):
        bands.append(composite(splats, lists, pixels, exact=kernel == "ray"))
        entries += len(lists.entries)
    sums = torch.cat(bands).reshape(rows, columns, TILE, TILE, 5)
    sums = sums.permute(4, 0, 2, 1, 3).reshape(5, rows * TILE, columns * TILE)
    return sums[:, : picture.size[0], : picture.size[1]], len(seen), entries


def _in_picture(boxes: Float[Tensor, "n 4"], picture: Picture) -> Bool[Tensor, "n"]:
    """Which boxes reach into the picture."""
    left, right, top, bottom = boxes.unbind(1)
    inside = (left <= right) & (bottom > 0) & (top < picture.size[0])
    return inside if picture.is_panorama else inside & (right > 0) & (left < picture.size[1])


def _project(
    observed: Observed, picture: Picture, kernel: Kernel, dilation: float
) -> tuple[Splats, Float[Tensor, "n 4"]]:
    """The Gaussians on a picture, and the boxes they can be seen in."""
    if kernel == "ewa":
        splats, variances = ewa_splats(observed, picture.rotation, picture.size, picture.focal, dilation)
        return splats, ewa_boxes(splats.point.detach(), variances, kappa(observed.peak.detach()))
    level, direction = kappa(observed.peak.detach()), observed.direction.detach()
    covariance = observed.covariance.detach()
    if picture.is_panorama:
        return ray_splats(observed), equirect_boxes(direction, covariance, level, picture.size)
    turned = picture.rotation.T @ covariance @ picture.rotation
    boxes = pinhole_boxes(direction @ picture.rotation, turned, level, picture.size, picture.focal)
    return ray_splats(observed), boxes


def _tile_pixels(picture: Picture, kernel: Kernel, dtype: torch.dtype) -> TilePixels:
    """The picture's pixels by tile; tiles that stick out repeat the last row and column."""
    points = picture.directions() if kernel == "ray" else picture.coordinates()
    rows, columns = tile_grid(*picture.size)
    y = torch.arange(rows * TILE, device=points.device).clamp_max(picture.size[0] - 1)
    x = torch.arange(columns * TILE, device=points.device).clamp_max(picture.size[1] - 1)
    points = torch.nn.functional.pad(points[y][:, x], (0, 3 - points.shape[-1]))
    points = points.reshape(rows, TILE, columns, TILE, 3).transpose(1, 2).reshape(-1, TILE * TILE, 3)
    centres = points.mean(dim=1)
    offsets = (points - centres[:, None]).to(dtype)
    homogeneous = torch.cat((offsets, torch.ones_like(offsets[..., :1])), dim=2)
    return TilePixels(centres, homogeneous.transpose(1, 2).contiguous())


def _finish(sums: Float[Tensor, "5 height width"], background: Float[Tensor, "3"], info: Info) -> Rendering:
    """Composite over the background, and turn the sum of distances into their mean."""
    alpha = sums[4].clamp_max(1)
    color = sums[:3] + (1 - alpha) * background[:, None, None]
    seen = sums[4] > 0
    depth = torch.where(seen, sums[3] / torch.where(seen, sums[4], torch.ones_like(sums[4])), 0)
    return Rendering(color, alpha, depth, info)
