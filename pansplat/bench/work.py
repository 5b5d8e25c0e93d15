"""How much a picture asks of the machine: arithmetic by pairs of a pixel and a Gaussian, traffic by records.

A lower bound of what any tiled renderer does, from the scene alone: pairs are the pixel centres inside each
Gaussian's exact box (docs/rendering.md, section 5), whether or not something nearer hides them; traffic is the scene
read once, a record of 80 bytes written once a Gaussian and read once a tile of 32 x 32 pixels, and the picture.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.projection import equirect_boxes, kappa, project_gaussians
from pansplat.rendering.rasterize import RasterOptions

FORWARD_OPERATIONS = 46
"""Floating-point operations a pair, of the exact kernel in two components: 2 differences, 6 for A and B, 3 for Q, 4 for
L, 4 for q, 1 for the level, 13 for 2^x, 2 for the cuts, 3 for weight and transmittance, 8 for four sums."""

BACKWARD_OPERATIONS = 103
"""Likewise: 38 to find alpha and weight again, 12 for the slope, 20 for A, B, L and q, 25 for their sums, 8 for those
of the values."""

_RECORD = 80  # bytes: 16 numbers of a record, 4 values
_ENTRY = 8  # bytes of a tile's list
_TILE = 32  # pixels
_CHUNK = 1 << 17


@dataclass(frozen=True)
class Work:
    """What one panorama by the exact kernel asks for.

    Attributes:
        pairs: pixel centres inside the boxes of Gaussians, summed over the Gaussians.
        bytes: traffic of a forward pass.
    """

    pairs: int
    bytes: int


@torch.no_grad()
def panorama_work(gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], height: int, options: RasterOptions) -> Work:
    """The work of drawing a panorama, by the exact kernel whatever the options' kernel is."""
    size = (height, 2 * height)
    (picture,) = image_planes("equirect", size, vertical_fov_degrees=90.0, face_size=None, device=torch.device("cpu"))
    pairs = entries = 0
    for index in torch.arange(len(gaussians)).split(_CHUNK):
        part = gaussians.select(index)
        seen = project_gaussians(
            part,
            None,
            cam2world.double(),
            filter_variance=options.filter_variance(picture.pixel_angle),
            compensate=options.lowpass == "angular",
            exact=False,
        )
        boxes = equirect_boxes(seen.direction, seen.covariance, kappa(seen.peak), size)
        inside, tiles = _counts(boxes[seen.radius >= options.near], size)
        pairs, entries = pairs + inside, entries + tiles
    numbers = 11 + gaussians.harmonics[:1].numel()
    values = 4 * 5 * height * 2 * height
    return Work(pairs, len(gaussians) * (4 * numbers + _RECORD) + entries * (_RECORD + _ENTRY) + values)


def _counts(boxes: Float[Tensor, "n 4"], size: tuple[int, int]) -> tuple[int, int]:
    """Pixel centres in all boxes (left, right, top, bottom; columns wrap), and tiles that hold one."""
    height, width = size
    left, top = torch.ceil(boxes[:, 0] - 0.5), torch.ceil(boxes[:, 2] - 0.5).clamp_min(0)
    right, bottom = torch.floor(boxes[:, 1] - 0.5), torch.floor(boxes[:, 3] - 0.5).clamp_max(height - 1)
    seen = (left <= right) & (top <= bottom)
    columns, rows = (right - left + 1).clamp_max(width), bottom - top + 1
    across = (torch.floor(right / _TILE) - torch.floor(left / _TILE) + 1).clamp_max(-(-width // _TILE))
    down = torch.floor(bottom / _TILE) - torch.floor(top / _TILE) + 1
    return int((columns * rows)[seen].sum()), int((across * down)[seen].sum())
