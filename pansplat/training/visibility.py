"""Which Gaussians a part of a picture can show: to draw a part with what it needs, and no more in memory.

Source: docs/rendering.md, section 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.backend import Options
from pansplat.rendering.panorama import Picture
from pansplat.rendering.reference import in_picture, project
from pansplat.rendering.splats import Observed, observe

_CHUNK = 1 << 16  # Gaussians at a time: their geometry is float64


@dataclass(frozen=True)
class Region:
    """Rows of a picture.

    Attributes:
        picture: as the rasteriser draws it.
        first, end: the rows, `end` left out.
    """

    picture: Picture
    first: int
    end: int


@torch.no_grad()
def visible(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], regions: Sequence[Region], options: Options
) -> list[Bool[Tensor, "n"]]:
    """For each region, the Gaussians that may reach a pixel in it; the others have no part in its colours.

    Args:
        cam2world: of the camera that has all the regions' pictures.
        regions: of pictures of one size and kind.
        options: as the pictures are drawn.
    """
    pose = cam2world.double().to(gaussians.means.device)
    found: list[list[Tensor]] = [[] for _ in regions]
    for start in range(0, len(gaussians), _CHUNK):
        observed = observe(
            _piece(gaussians, slice(start, start + _CHUNK)),
            None,
            pose,
            spread=options.spread(regions[0].picture.pixel_angle),
            compensate=options.lowpass == "angular",
            exact=False,
        )
        for region, masks in zip(regions, found, strict=True):
            masks.append(_in_region(observed, region, options))
    return [torch.cat(masks) if masks else torch.zeros(0, dtype=torch.bool) for masks in found]


def _piece(gaussians: Gaussians, rows: slice) -> Gaussians:
    """Some of the Gaussians, as views of their memory and without colours, which do not matter here."""
    g = gaussians
    own = (field[rows] for field in (g.means, g.scales, g.quats, g.opacities))
    return Gaussians(*own, g.harmonics[rows, :1] * 0, g.levels[rows], g.views[rows])


def _in_region(observed: Observed, region: Region, options: Options) -> Bool[Tensor, "n"]:
    picture, rows = region.picture, (region.first, region.end)
    if options.kernel == "ewa":  # has no box behind the camera
        ahead = observed.direction @ picture.rotation[:, 2] > 0
        seen = torch.zeros_like(ahead)
        boxes = project(Observed(*(part[ahead] for part in observed)), picture, options)[1]
        seen[ahead] = in_picture(boxes, picture, rows)
        return seen
    return in_picture(project(observed, picture, options)[1], picture, rows)
