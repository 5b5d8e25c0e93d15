"""The reference backend: pure torch, float32 or float64, differentiable, in bounded memory.

Source: docs/rendering.md. Every faster backend is compared with this one.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.constants import EWA_NEAR_FACTOR
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.backend import Drawn, Info, Kernel, Options
from pansplat.rendering.bounds import equirect_boxes, ewa_boxes, kappa, pinhole_boxes
from pansplat.rendering.composite import TilePixels, composite
from pansplat.rendering.panorama import Picture
from pansplat.rendering.selection import select_drawable
from pansplat.rendering.splats import (
    Observed,
    Splats,
    ewa_splats,
    observe,
    ray_splats,
)
from pansplat.rendering.tiles import TILE, list_tiles, tile_grid
from pansplat.threads import one_thread


@one_thread()
def draw(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    pose: Float[Tensor, "4 4"],
    pictures: list[Picture],
    options: Options,
) -> Drawn:
    """Draw by torch operations; see `pansplat.rendering.backend.Draw`."""
    chosen = select_drawable(gaussians, covariances, pose.detach(), options)
    observed = observe(
        chosen.gaussians,
        chosen.covariances,
        pose,
        spread=options.spread(pictures[0].pixel_angle),
        compensate=options.lowpass == "angular",
        exact=options.kernel == "ray",
    )
    drawn = [_picture(observed, picture, options) for picture in pictures]
    sums = torch.stack([picture for picture, _, _ in drawn])
    visible, entries = sum(d[1] for d in drawn), sum(d[2] for d in drawn)
    return Drawn(sums, Info(chosen.total, chosen.dropped, chosen.near, visible, entries))


def _picture(
    observed: Observed, picture: Picture, options: Options
) -> tuple[Float[Tensor, "sums height width"], int, int]:
    """Sums of weight x (channels, distance, 1) over one picture, the number of Gaussians and of entries drawn."""
    z = (observed.direction.detach() @ picture.rotation[:, 2]) * observed.radius.detach()
    if options.kernel == "ewa":
        ahead = z > EWA_NEAR_FACTOR * options.near
        observed, z = Observed(*(field[ahead] for field in observed)), z[ahead]
    key = observed.radius.detach() if options.order == "radial" or picture.is_panorama else z
    splats, boxes = project(observed, picture, options)
    seen = torch.nonzero(in_picture(boxes, picture))[:, 0]
    if len(seen) < len(boxes):
        splats, boxes, key = Splats(*(field[seen] for field in splats)), boxes[seen], key[seen]
    pixels = _tile_pixels(picture, options.kernel, observed.peak.dtype)
    rows, columns = tile_grid(*picture.size)
    order_in_depth = torch.argsort(key, stable=True)
    bands, entries = [], 0
    for lists in list_tiles(boxes, order_in_depth, picture.size, wraps=picture.is_panorama):
        bands.append(composite(splats, lists, pixels, exact=options.kernel == "ray"))
        entries += len(lists.entries)
    sums = torch.cat(bands).reshape(rows, columns, TILE, TILE, -1)
    sums = sums.permute(4, 0, 2, 1, 3).reshape(-1, rows * TILE, columns * TILE)
    return sums[:, : picture.size[0], : picture.size[1]], len(seen), entries


def in_picture(boxes: Float[Tensor, "n 4"], picture: Picture, rows: tuple[int, int] | None = None) -> Bool[Tensor, "n"]:
    """Which boxes (left, right, top, bottom; pixels) reach into the picture.

    Args:
        rows: the first that count, and the first after them; by default all.
    """
    first, end = rows or (0, picture.size[0])
    left, right, top, bottom = boxes.unbind(1)
    inside = (left <= right) & (bottom > first) & (top < end)
    return inside if picture.is_panorama else inside & (right > 0) & (left < picture.size[1])


def project(observed: Observed, picture: Picture, options: Options) -> tuple[Splats, Float[Tensor, "n 4"]]:
    """The Gaussians on a picture, and the boxes they can be seen in."""
    if options.kernel == "ewa":
        splats, variances = ewa_splats(observed, picture.rotation, picture.size, picture.focal, options.dilation)
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
