"""The image planes of a camera (pinhole image, direct panorama, cube faces), and stitching of cube faces.

Source: PanSplat, section 3.4; docs/rendering.md, section 6; docs/official.md, section 10.2 and P9 for the official
stitching.
"""

import functools
import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.geometry.cubemap import FACES, face_of, face_rotations, official_faces
from pansplat.geometry.equirect import pixel_directions

Layout = Literal["equirect", "cubemap", "pinhole"]
Stitching = Literal["seamless", "official"]

_UP, _DOWN = FACES.index("up"), FACES.index("down")


@dataclass(frozen=True, eq=False)
class ImagePlane:
    """One image plane of a camera.

    Attributes:
        size: height and width, pixels.
        rotation: the plane's axes in camera axes, float64.
        focal: pixels; 0 for a direct panorama.
    """

    size: tuple[int, int]
    rotation: Float[Tensor, "3 3"]
    focal: float

    @property
    def is_panorama(self) -> bool:
        """Whether every direction has a pixel and columns wrap."""
        return self.focal == 0

    @property
    def pixel_angle(self) -> float:
        """Angle of a pixel in the middle of the image, radians."""
        return math.pi / self.size[0] if self.is_panorama else 1 / self.focal

    def directions(self) -> Float[Tensor, "height width 3"]:
        """Unit directions of the pixel centres in camera axes, float64."""
        height, width = self.size
        device = self.rotation.device
        if self.is_panorama:
            return pixel_directions(height, width, dtype=torch.float64, device=device)
        x, y = self.coordinates().unbind(-1)
        x, y = (x - 0.5 * width) / self.focal, (y - 0.5 * height) / self.focal
        rays = torch.stack((x, y, torch.ones_like(x)), dim=-1)
        return torch.nn.functional.normalize(rays, dim=-1) @ self.rotation.T

    def coordinates(self) -> Float[Tensor, "height width 2"]:
        """Pixel centres x, y in pixels, float64."""
        height, width = self.size
        y = torch.arange(height, dtype=torch.float64, device=self.rotation.device) + 0.5
        x = torch.arange(width, dtype=torch.float64, device=self.rotation.device) + 0.5
        return torch.stack((x.expand(height, width), y[:, None].expand(height, width)), dim=-1)


def image_planes(
    layout: Layout,
    size: tuple[int, int],
    *,
    vertical_fov_degrees: float = 90.0,
    face_size: int | None = None,
    device: torch.device | None = None,
) -> list[ImagePlane]:
    """The image planes of a layout: one, or the six cube faces.

    Args:
        size: height and width of the whole image, pixels.
        vertical_fov_degrees: of a pinhole image.
        face_size: of cube faces, pixels; by default as fine as the panorama's equator.
    """
    upright = torch.eye(3, dtype=torch.float64, device=device)
    if layout == "equirect":
        return [ImagePlane(size, upright, 0.0)]
    if layout == "pinhole":
        return [ImagePlane(size, upright, 0.5 * size[0] / math.tan(math.radians(vertical_fov_degrees) / 2))]
    face = face_size or max(1, round(2 * size[0] / math.pi))
    return [ImagePlane((face, face), rotation.to(upright.device), 0.5 * face) for rotation in face_rotations()]


# --- stitching: a panorama sampled bilinearly from six faces, each padded with pixels of its neighbours ---


class _Lookup(NamedTuple):
    """Sampling positions of the panorama's pixels in the padded faces.

    Attributes:
        border: the three face pixels whose mean is the value of each padded pixel; 6 n n stands for zero.
        corner: the upper left of the four padded pixels around each panorama pixel.
        right, low: bilinear weights of the right and lower neighbours, 0 to 1.
    """

    border: Int[Tensor, "padded 3"]
    corner: Int[Tensor, "pixel"]
    right: Float[Tensor, "pixel"]
    low: Float[Tensor, "pixel"]


def stitch_faces(
    faces: Float[Tensor, "face channel n n"], size: tuple[int, int], *, stitching: Stitching = "seamless"
) -> Float[Tensor, "channel height width"]:
    """A panorama of six cube faces. It is linear in every face, so faces may be stitched one by one and added.

    Args:
        faces: in the order of `FACES`.
        size: height and width of the panorama, pixels.
        stitching: "seamless" pads each face with its true neighbours; "official" reproduces the official code's wrong
            padding left and right of up and down, and its outline of these faces.

    Raises:
        ValueError: "official" with a size that is not 2:1 with a height that is a multiple of 4.
    """
    num, channels = faces.shape[-1], faces.shape[1]
    lookup = _Lookup(*(table.to(faces.device) for table in _lookup(num, size, stitching)))
    flat = faces.permute(1, 0, 2, 3).reshape(channels, -1)
    flat = torch.cat((flat, flat.new_zeros(channels, 1)), dim=1)
    # At the corners of the cube three pixels meet; everywhere else the three are the same pixel.
    padded = flat[:, lookup.border].mean(dim=-1)
    right, low = lookup.right.to(faces), lookup.low.to(faces)
    panorama = (1 - low) * _interpolate_row(padded, lookup.corner, right)
    panorama = panorama + low * _interpolate_row(padded, lookup.corner + (num + 2), right)
    return panorama.reshape(channels, *size)


def _interpolate_row(
    padded: Float[Tensor, "channel padded"], left: Tensor, right_weight: Tensor
) -> Float[Tensor, "channel pixel"]:
    return (1 - right_weight) * padded[:, left] + right_weight * padded[:, left + 1]


@functools.lru_cache(maxsize=2)
@torch.inference_mode(False)  # the cached tensors must also serve calls that need gradients
def _lookup(num: int, size: tuple[int, int], stitching: Stitching) -> _Lookup:
    rotations = face_rotations()
    directions = pixel_directions(*size, dtype=torch.float64).reshape(-1, 3)
    border = _border(num)
    if stitching == "official":
        if size[1] != 2 * size[0]:
            raise ValueError(f"`size` must be 2:1 for stitching 'official', got {size}")
        face = official_faces(size[0]).reshape(-1)
        border = _official_border(border, num)
    else:
        face = face_of(directions)
    local = (directions[:, None, :] @ rotations[face])[:, 0, :]
    # Padded coordinates: pixel k of the face is at index k + 1. A direction of another face is clamped to the edge.
    place = (local[:, :2] / local[:, 2:]).clamp(-1, 1)
    x, y = ((place + 1) * (0.5 * num) + 0.5).unbind(1)
    left, top = (t.floor().clamp(0, num) for t in (x, y))
    corner = (face * (num + 2) + top.long()) * (num + 2) + left.long()
    return _Lookup(border, corner.int(), x - left, y - top)


def _border(num: int) -> Int[Tensor, "padded 3"]:
    """The three face pixels (flat indices) whose mean is the value of each pixel of the six padded faces."""
    rotations = face_rotations()
    index = torch.arange(-1, num + 1, dtype=torch.float64)
    y, x = torch.meshgrid(index, index, indexing="ij")
    inside = torch.stack((x.clamp(0, num - 1), y.clamp(0, num - 1)), dim=-1)
    beyond_x, beyond_y = x != inside[..., 0], y != inside[..., 1]
    own = torch.stack([_flat_index(torch.full_like(x, face), inside, num) for face in range(6)])
    both = []
    for beyond, axis, at in ((beyond_x, 0, x), (beyond_y, 1, y)):
        # A point just over the edge from the nearest pixel of this face, and the pixel of the face it lies on.
        edge = (inside + 0.5) * (2 / num) - 1
        edge[..., axis] = torch.where(beyond, torch.where(at < 0, -1.0, 1.0), edge[..., axis])
        over = torch.cat((edge, torch.ones_like(x)[..., None]), dim=-1)
        over[..., 2] = torch.where(beyond, 1 - 1e-6, 1.0)
        world = over @ rotations.transpose(1, 2)[:, None]
        both.append(_pixel_at(world, num))
    first = torch.where(beyond_x, both[0], torch.where(beyond_y, both[1], own))
    second = torch.where(beyond_y, both[1], torch.where(beyond_x, both[0], own))
    third = torch.where(beyond_x & beyond_y, own, first)
    return torch.stack((first, second, third), dim=-1).reshape(-1, 3)


def _official_border(border: Int[Tensor, "padded 3"], num: int) -> Int[Tensor, "padded 3"]:
    """The official code's padding: left and right of up and down it is not the neighbour's pixels.

    These columns are shifted down by one row, with zero in the first; down's repeat its own outermost columns. Beyond
    the corners of a side face it takes the corner of up or down. (No pixel of the fixtures shows a corner.)
    """
    faces = border.reshape(6, num + 2, num + 2, 3).clone()
    nothing = 6 * num * num
    for face in range(4):
        for row, neighbour in ((0, _UP), (-1, _DOWN)):
            for column in (0, -1):
                corner = faces[face, row, column]
                faces[face, row, column] = corner[corner // (num * num) == neighbour][0]
    for face in (_UP, _DOWN):
        for column, own in ((0, 1), (-1, -2)):
            beside = faces[face, 1:-1, column if face == _UP else own].clone()
            faces[face, :2, column] = nothing
            faces[face, 2:, column] = beside
    return faces.reshape(-1, 3)


def _pixel_at(directions: Float[Tensor, "*batch 3"], num: int) -> Int[Tensor, "*batch"]:
    """Flat index of the face pixel that contains each direction."""
    face = face_of(directions)
    local = (directions[..., None, :] @ face_rotations()[face])[..., 0, :]
    pixel = ((local[..., :2] / local[..., 2:] + 1) * (0.5 * num)).floor().clamp(0, num - 1)
    return _flat_index(face, pixel, num)


def _flat_index(face: Tensor, pixel: Float[Tensor, "*batch 2"], num: int) -> Int[Tensor, "*batch"]:
    return ((face * num + pixel[..., 1]) * num + pixel[..., 0]).long()
