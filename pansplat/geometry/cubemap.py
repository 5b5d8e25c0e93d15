"""The six faces of a cubemap in the panorama camera's frame.

Source: PanSplat, section 3.4; face order and axes as in the original renderer (OFFICIAL.md 10.1).
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

FACES = ("front", "right", "back", "left", "up", "down")

# Columns of each matrix are the face's right, down and forward in the panorama camera's axes.
_RIGHT_DOWN_FORWARD = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
)


def face_rotations(*, dtype: torch.dtype = torch.float64) -> Float[Tensor, "face 3 3"]:
    """Rotation from each face's camera axes to the panorama's (columns: right, down, forward)."""
    return torch.tensor(_RIGHT_DOWN_FORWARD, dtype=dtype).transpose(-1, -2).contiguous()


def face_poses(cam2world: Float[Tensor, "4 4"]) -> Float[Tensor, "face 4 4"]:
    """Camera-to-world poses of the six 90-degree pinhole faces of a panorama camera."""
    poses = cam2world.expand(6, 4, 4).clone()
    poses[:, :3, :3] = cam2world[:3, :3] @ face_rotations(dtype=cam2world.dtype).to(cam2world.device)
    return poses


def face_of(directions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
    """Index of the cube face that each direction meets; ties go to the first in the order of `FACES`."""
    return torch.argmax(directions @ face_rotations()[:, :, 2].to(directions).T, dim=-1)


def official_faces(height: int) -> Int[Tensor, "height width"]:
    """The face that the original takes for each pixel of a 2:1 panorama; differs from `face_of` along up and down.

    Side faces take whole quarters of the columns; where they end towards up and down is rounded to whole rows, over
    angles that reach both edges of the face instead of the pixels' centres.

    Source: OFFICIAL.md, section 10.2.

    Raises:
        ValueError: the height is no multiple of 4, so that the back face does not split evenly over both ends.
    """
    if height < 4 or height % 4:
        raise ValueError(f"`height` must be a positive multiple of 4, got {height}")
    quarter = height // 2
    angles = torch.linspace(-math.pi, math.pi, quarter, dtype=torch.float64) / 4
    outline = height // 2 - torch.round(torch.arctan(torch.cos(angles)) * height / math.pi)
    # In the order of FACES, front first; rolled so that front comes to stand in the middle.
    middle = 2 * height * 3 // 8
    side = torch.arange(4).repeat_interleave(quarter).roll(middle)
    up = torch.arange(height)[:, None] < outline.repeat(4).roll(middle)
    return torch.where(up, 4, torch.where(up.flip(0), 5, side))
