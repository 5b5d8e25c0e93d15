"""Cubemaps in the panorama camera's frame: face poses, and strips of six faces as the monocular network reads them.

The faces of pansplat.rendering have pixel centres at half-integers. The faces of a strip are sampled corner to corner:
the first and the last pixel of a row lie on the cube's edges, as in the training of the monocular network.

Source: PanSplat, section 3.4; face order and axes of the official renderer (docs/official.md, section 10.1); strips:
docs/official.md, sections 2.3 and 5; Jiang et al., UniFuse, https://arxiv.org/abs/2102.03550.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from pansplat.geometry.equirect import pixel_directions, sample_equirect, uv_from_directions

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
    """Index of the cube face that each direction intersects; at an edge the first in the order of `FACES`."""
    return torch.argmax(directions @ face_rotations()[:, :, 2].to(directions).T, dim=-1)


def official_faces(height: int) -> Int[Tensor, "height width"]:
    """The official face of each pixel of a 2:1 panorama; differs from `face_of` along the up and down faces.

    The side faces are whole quarters of the columns. Their borders to up and down are rounded to whole rows, for angles
    from edge to edge of a face instead of its pixel centres.

    Source: docs/official.md, section 10.2.

    Raises:
        ValueError: the height is not a multiple of 4; the back face would not split evenly over both ends.
    """
    if height < 4 or height % 4:
        raise ValueError(f"`height` must be a positive multiple of 4, got {height}")
    quarter = height // 2
    angles = torch.linspace(-math.pi, math.pi, quarter, dtype=torch.float64) / 4
    outline = height // 2 - torch.round(torch.arctan(torch.cos(angles)) * height / math.pi)
    # In the order of FACES, rolled so that front is in the middle.
    middle = 2 * height * 3 // 8
    side = torch.arange(4).repeat_interleave(quarter).roll(middle)
    up = torch.arange(height)[:, None] < outline.repeat(4).roll(middle)
    return torch.where(up, 4, torch.where(up.flip(0), 5, side))


def strip_directions(face_size: int) -> Float[Tensor, "face_size strip 3"]:
    """Directions (not of unit length) of the pixels of a strip, in the panorama camera's axes; float64."""
    across = torch.linspace(-0.5, 0.5, face_size, dtype=torch.float64)
    y, x = torch.meshgrid(across, across, indexing="ij")
    local = torch.stack((x, y, torch.full_like(x, 0.5)), dim=-1)
    faces = torch.einsum("fij,hwj->hfwi", face_rotations(), local)
    return faces.reshape(face_size, 6 * face_size, 3)


def strip_from_equirect(
    image: Float[Tensor, "channel height width"], face_size: int
) -> Float[Tensor, "channel face_size strip"]:
    """The strip of six faces of a panorama, sampled bilinearly."""
    return sample_equirect(image, uv_from_directions(strip_directions(face_size)).to(image.device))


def strip_lookup(height: int) -> Float[Tensor, "height width 3"]:
    """For each pixel of a panorama, its position in the six faces: x, y in [-1, 1], index of the face; float64.

    -1 and 1 are the centres of a face's outermost pixels. Positions outside the face, which occur because
    `official_faces` rounds to whole rows, are clamped to its edge.
    """
    width = 2 * height
    face = official_faces(height)
    rays = pixel_directions(height, width, dtype=torch.float64)
    local = torch.einsum("hwi,hwij->hwj", rays, face_rotations()[face])
    position = (local[..., :2] / local[..., 2:]).clamp(-1, 1)
    return torch.cat((position, face[..., None].double()), dim=-1)


def equirect_from_strip(
    strip: Float[Tensor, "batch channel n strip"], lookup: Float[Tensor, "height width 3"]
) -> Float[Tensor, "batch channel height width"]:
    """The panorama of a strip's faces, sampled bilinearly inside each face at the positions in `lookup`."""
    size = strip.shape[-2]
    x, y, face = lookup.to(strip.device, torch.float64).unbind(-1)
    # Positions are at least half a pixel from the edge of their face, so that no sample mixes two faces.
    column = face * size + (x + 1) / 2 * (size - 1) + 0.5
    row = (y + 1) / 2 * (size - 1) + 0.5
    grid = torch.stack((2 * column / (6 * size) - 1, 2 * row / size - 1), dim=-1)
    grid = grid.to(strip.dtype).expand(len(strip), *grid.shape)
    return functional.grid_sample(strip, grid, mode="bilinear", padding_mode="border", align_corners=False)
