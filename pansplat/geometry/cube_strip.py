"""Six cube faces side by side, front right back left up down, as the monocular network sees them.

Unlike the faces that pansplat.rendering draws, these are sampled corner to corner: the first and the last pixel of
a row lie on the cube's edges. The network was trained so.

Source: OFFICIAL.md, sections 2.4 and 5; Jiang et al., UniFuse, https://arxiv.org/abs/2102.03550.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from pansplat.geometry.cubemap import face_rotations, official_faces
from pansplat.geometry.equirect import pixel_directions, sample_equirect, uv_from_directions


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
    """The strip of six faces that a panorama shows, sampled bilinearly."""
    uv = uv_from_directions(strip_directions(face_size)).to(image.device)
    return sample_equirect(image, uv)


def strip_lookup(height: int) -> Float[Tensor, "height width 3"]:
    """For each pixel of a panorama, where to look in six faces: x, y in [-1, 1], number of the face; float64.

    x and y of -1 and 1 are the centres of a face's outermost pixels. A pixel that belongs to the face beside
    by a rounding of rows is held to the edge.
    """
    width = 2 * height
    face = official_faces(height)
    rays = pixel_directions(height, width, dtype=torch.float64)
    local = torch.einsum("hwi,hwij->hwj", rays, face_rotations()[face])
    place = (local[..., :2] / local[..., 2:]).clamp(-1, 1)
    return torch.cat((place, face[..., None].double()), dim=-1)


def equirect_from_strip(
    strip: Float[Tensor, "batch channel n strip"], lookup: Float[Tensor, "height width 3"]
) -> Float[Tensor, "batch channel height width"]:
    """The panorama that a strip's faces show, sampled bilinearly inside each face where `lookup` says."""
    size = strip.shape[-2]
    x, y, face = lookup.to(strip.device, torch.float64).unbind(-1)
    # Inside its face a position stays half a pixel from the edge at least, so that no sample mixes two faces.
    column = face * size + (x + 1) / 2 * (size - 1) + 0.5
    row = (y + 1) / 2 * (size - 1) + 0.5
    grid = torch.stack((2 * column / (6 * size) - 1, 2 * row / size - 1), dim=-1)
    grid = grid.to(strip.dtype).expand(len(strip), *grid.shape)
    return functional.grid_sample(strip, grid, mode="bilinear", padding_mode="border", align_corners=False)
