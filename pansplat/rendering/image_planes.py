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

_UP, _DOWN = FACES.index("up"), FACES.index("down")


@dataclass(frozen=True, eq=False)
class ImagePlane:
    """One image plane of a camera.

    Attributes:
        size: height and width, pixels.
        rotation: columns are the plane's axes in camera axes, float64.
        focal: pixels; 0 for a direct panorama.
        eye_offset: radius of the viewing circle of a direct panorama, metres; negative for the left eye. 0 is one eye
            for all columns.
    """

    size: tuple[int, int]
    rotation: Float[Tensor, "3 3"]
    focal: float
    eye_offset: float = 0.0

    @property
    def is_panorama(self) -> bool:
        """Whether the plane is a direct panorama: every direction has a pixel, and columns wrap."""
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

    def column_eyes(self) -> Float[Tensor, "width 3"]:
        """The eye of each column of a panorama in camera axes, float64, metres: to the right of the column's rays.

        Source: docs/rendering.md, section 9.
        """
        width = self.size[1]
        columns = torch.arange(width, dtype=torch.float64, device=self.rotation.device) + 0.5
        longitude = (2 * columns / width - 1) * math.pi
        return self.eye_offset * torch.stack((longitude.cos(), torch.zeros_like(longitude), -longitude.sin()), dim=1)

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
    eye_offset: float = 0.0,
    device: torch.device | None = None,
) -> list[ImagePlane]:
    """Create the image planes of a layout: one plane, or the six cube faces.

    Args:
        size: height and width of the whole image, pixels.
        vertical_fov_degrees: vertical field of view of a pinhole image.
        face_size: side of cube faces, pixels; by default with the panorama's resolution at the equator.
        eye_offset: eye offset of layout "equirect", see `ImagePlane`.
    """
    upright = torch.eye(3, dtype=torch.float64, device=device)
    if layout == "equirect":
        return [ImagePlane(size, upright, 0.0, eye_offset)]
    if layout == "pinhole":
        return [ImagePlane(size, upright, 0.5 * size[0] / math.tan(math.radians(vertical_fov_degrees) / 2))]
    face = face_size or max(1, round(2 * size[0] / math.pi))
    return [ImagePlane((face, face), rotation.to(upright.device), 0.5 * face) for rotation in face_rotations()]


# --- stitching: sample a panorama bilinearly from six faces, each padded with pixels of its neighbours ---


class _Lookup(NamedTuple):
    """Sampling positions of the panorama's pixels in the padded faces.

    Attributes:
        border: the three face pixels whose mean is the value of each padded pixel; the index 6 n n means zero.
        corner: the upper left of the four padded pixels around each panorama pixel.
        right, lower: bilinear weights of the right and lower neighbours, 0 to 1.
    """

    border: Int[Tensor, "padded 3"]
    corner: Int[Tensor, "pixel"]
    right: Float[Tensor, "pixel"]
    lower: Float[Tensor, "pixel"]


def stitch_faces(
    faces: Float[Tensor, "face channel n n"], size: tuple[int, int], *, official: bool = False
) -> Float[Tensor, "channel height width"]:
    """Stitch a panorama from six cube faces. It is linear in every face, so panoramas of single faces can be added.

    Args:
        faces: in the order of `FACES`.
        size: height and width of the panorama, pixels.
        official: with the official code's wrong padding at the left and right edges of the up and down faces, and its
            outline of these faces. Otherwise each face is padded with its true neighbours.

    Raises:
        ValueError: `official`, and the size is not 2:1 or its height is not a multiple of 4.
    """
    num, channels = faces.shape[-1], faces.shape[1]
    lookup = _Lookup(*(table.to(faces.device) for table in _compute_lookup(num, size, official)))
    flat = faces.permute(1, 0, 2, 3).reshape(channels, -1)
    flat = torch.cat((flat, flat.new_zeros(channels, 1)), dim=1)
    # At the corners of the cube three pixels meet; elsewhere all three indices are of the same pixel.
    padded = flat[:, lookup.border].mean(dim=-1)
    right, lower = lookup.right.to(faces), lookup.lower.to(faces)
    panorama = (1 - lower) * _interpolate_row(padded, lookup.corner, right)
    panorama = panorama + lower * _interpolate_row(padded, lookup.corner + (num + 2), right)
    return panorama.reshape(channels, *size)


def _interpolate_row(
    padded: Float[Tensor, "channel padded"], left: Tensor, right_weight: Tensor
) -> Float[Tensor, "channel pixel"]:
    return (1 - right_weight) * padded[:, left] + right_weight * padded[:, left + 1]


@functools.lru_cache(maxsize=2)
@torch.inference_mode(False)  # the cached tensors are also used in calls that need gradients
def _compute_lookup(num: int, size: tuple[int, int], official: bool) -> _Lookup:
    rotations = face_rotations()
    directions = pixel_directions(*size, dtype=torch.float64).reshape(-1, 3)
    border = _find_border_pixels(num)
    if official:
        if size[1] != 2 * size[0]:
            raise ValueError(f"`size` must be 2:1 for the official stitching, got {size}")
        face = official_faces(size[0]).reshape(-1)
        border = _apply_official_padding(border, num)
    else:
        face = face_of(directions)
    local = (directions[:, None, :] @ rotations[face])[:, 0, :]
    # Padded coordinates: pixel k of the face has index k + 1. A direction of another face is clamped to the edge.
    position = (local[:, :2] / local[:, 2:]).clamp(-1, 1)
    x, y = ((position + 1) * (0.5 * num) + 0.5).unbind(1)
    left, top = (t.floor().clamp(0, num) for t in (x, y))
    corner = (face * (num + 2) + top.long()) * (num + 2) + left.long()
    return _Lookup(border, corner.int(), x - left, y - top)


def _find_border_pixels(num: int) -> Int[Tensor, "padded 3"]:
    """Find the three face pixels (flat indices) whose mean is the value of each pixel of the six padded faces."""
    rotations = face_rotations()
    index = torch.arange(-1, num + 1, dtype=torch.float64)
    y, x = torch.meshgrid(index, index, indexing="ij")
    inside = torch.stack((x.clamp(0, num - 1), y.clamp(0, num - 1)), dim=-1)
    beyond_x, beyond_y = x != inside[..., 0], y != inside[..., 1]
    own = torch.stack([_flat_index(torch.full_like(x, face), inside, num) for face in range(6)])
    both = []
    for beyond, axis, position in ((beyond_x, 0, x), (beyond_y, 1, y)):
        # The point just beyond the edge nearest to the padded pixel, and the pixel of the other face that contains it.
        edge = (inside + 0.5) * (2 / num) - 1
        edge[..., axis] = torch.where(beyond, torch.where(position < 0, -1.0, 1.0), edge[..., axis])
        rays = torch.cat((edge, torch.ones_like(x)[..., None]), dim=-1)
        rays[..., 2] = torch.where(beyond, 1 - 1e-6, 1.0)
        both.append(_find_pixels(rays @ rotations.transpose(1, 2)[:, None], num))
    first = torch.where(beyond_x, both[0], torch.where(beyond_y, both[1], own))
    second = torch.where(beyond_y, both[1], torch.where(beyond_x, both[0], own))
    third = torch.where(beyond_x & beyond_y, own, first)
    return torch.stack((first, second, third), dim=-1).reshape(-1, 3)


def _apply_official_padding(border: Int[Tensor, "padded 3"], num: int) -> Int[Tensor, "padded 3"]:
    """Replace the left and right padding of the up and down faces by that of the official code.

    Its columns are shifted down by one row, with zero in the first row; those of the down face repeat the face's own
    outermost columns. A corner of a side face is the corner of up or down. (No pixel of the fixtures shows a corner.)
    """
    faces = border.reshape(6, num + 2, num + 2, 3).clone()
    zero = 6 * num * num
    for face in range(4):
        for row, neighbour in ((0, _UP), (-1, _DOWN)):
            for column in (0, -1):
                corner = faces[face, row, column]
                faces[face, row, column] = corner[corner // (num * num) == neighbour][0]
    for face in (_UP, _DOWN):
        for column, own in ((0, 1), (-1, -2)):
            shifted = faces[face, 1:-1, column if face == _UP else own].clone()
            faces[face, :2, column] = zero
            faces[face, 2:, column] = shifted
    return faces.reshape(-1, 3)


def _find_pixels(directions: Float[Tensor, "*batch 3"], num: int) -> Int[Tensor, "*batch"]:
    """Find the flat index of the face pixel that contains each direction."""
    face = face_of(directions)
    local = (directions[..., None, :] @ face_rotations()[face])[..., 0, :]
    pixel = ((local[..., :2] / local[..., 2:] + 1) * (0.5 * num)).floor().clamp(0, num - 1)
    return _flat_index(face, pixel, num)


def _flat_index(face: Tensor, pixel: Float[Tensor, "*batch 2"], num: int) -> Int[Tensor, "*batch"]:
    return ((face * num + pixel[..., 1]) * num + pixel[..., 0]).long()
