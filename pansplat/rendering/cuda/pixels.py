"""The pixels of pictures by tile of 16 x 16, relative to the tile's centre.

Source: docs/rendering.md, section 3: float32 keeps a pixel's digits only relative to something near.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.rendering.cuda.layout import TILE
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.reference import tile_grid


@dataclass(frozen=True, eq=False)
class TilePixels:
    """Pixels of several pictures of one size, picture after picture, tiles row by row.

    Attributes:
        centres: of the tiles, rounded to the kernels' type, and what rounding left.
        offsets: pixel minus centre.
    """

    centres: Float[Tensor, "tile both axis"]
    offsets: Float[Tensor, "tile axis pixel"]


def tile_pixels(pictures: list[ImagePlane], *, exact: bool, dtype: torch.dtype) -> TilePixels:
    """The pixels of pictures; tiles that stick out repeat the last row and column.

    Args:
        pictures: all of one size.
        exact: whether points are directions, in the camera's axes, or x, y in pixels.
        dtype: the kernels' type.
    """
    tables = [_picture_pixels(picture, exact, dtype) for picture in pictures]
    return TilePixels(*(torch.cat(table) for table in zip(*tables, strict=True)))


def _picture_pixels(
    picture: ImagePlane, exact: bool, dtype: torch.dtype
) -> tuple[Float[Tensor, "tile both axis"], Float[Tensor, "tile axis pixel"]]:
    points = picture.directions() if exact else picture.coordinates()
    rows, columns = tile_grid(*picture.size, TILE)
    y = torch.arange(rows * TILE, device=points.device).clamp_max(picture.size[0] - 1)
    x = torch.arange(columns * TILE, device=points.device).clamp_max(picture.size[1] - 1)
    points = points[y][:, x].reshape(rows, TILE, columns, TILE, -1).permute(0, 2, 4, 1, 3)
    points = points.reshape(rows * columns, -1, TILE * TILE)
    centres = points.mean(dim=2)
    rounded = centres.to(dtype)
    both = torch.stack((rounded, (centres - rounded.double()).to(dtype)), dim=1)
    return both, (points - centres[:, :, None]).to(dtype)
