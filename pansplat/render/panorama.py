"""The pictures a camera can take: pinhole, direct panorama, cube faces; and the stitching of faces.

Source: docs/rendering.md, section 6; PanSplat, section 3.4.
"""

import functools
import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.geometry.cubemap import face_rotations
from pansplat.geometry.equirect import pixel_directions

Layout = Literal["equirect", "cubemap", "pinhole"]


@dataclass(frozen=True, eq=False)
class Picture:
    """One image plane of a camera.

    Attributes:
        size: height and width, pixels.
        rotation: the picture's camera axes in the camera's, float64.
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
        """Angle of a pixel in the picture's middle, radians."""
        return math.pi / self.size[0] if self.is_panorama else 1 / self.focal

    def directions(self) -> Float[Tensor, "height width 3"]:
        """Unit directions of the pixel centres in the camera's axes, float64."""
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


def pictures(
    layout: Layout,
    size: tuple[int, int],
    *,
    vertical_fov_degrees: float,
    face_size: int | None,
    device: torch.device,
) -> list[Picture]:
    """The pictures that make up a layout: one, or the six cube faces."""
    upright = torch.eye(3, dtype=torch.float64, device=device)
    if layout == "equirect":
        return [Picture(size, upright, 0.0)]
    if layout == "pinhole":
        return [Picture(size, upright, 0.5 * size[0] / math.tan(math.radians(vertical_fov_degrees) / 2))]
    face = face_size or max(1, round(2 * size[0] / math.pi))
    return [Picture((face, face), rotation.to(device), 0.5 * face) for rotation in face_rotations()]


def stitch_faces(
    faces: Float[Tensor, "face channel n n"], size: tuple[int, int]
) -> Float[Tensor, "channel height width"]:
    """A panorama of six cube faces, sampled bilinearly, each continued by its neighbours' touching pixels."""
    num = faces.shape[-1]
    border, taps, weights = _stitching(num, size)
    channels = faces.shape[1]
    flat = faces.permute(1, 0, 2, 3).reshape(channels, -1)
    # Three pixels meet at a corner of the cube; everywhere else the three are one.
    padded = flat[:, border.to(faces.device)].mean(dim=-1)
    gathered = padded[:, taps.to(faces.device)]
    return (gathered * weights.to(faces)).sum(dim=1).reshape(channels, *size)


@functools.lru_cache(maxsize=4)
def _stitching(
    num: int, size: tuple[int, int]
) -> tuple[Int[Tensor, "padded 3"], Int[Tensor, "4 pixel"], Float[Tensor, "4 pixel"]]:
    """Pixels that each padded face pixel averages; the padded pixels and weights of each panorama pixel."""
    rotations = face_rotations()
    directions = pixel_directions(*size, dtype=torch.float64).reshape(-1, 3)
    face = face_of(directions)
    local = (directions[:, None, :] @ rotations[face])[:, 0, :]
    # Padded coordinates: pixel k of the face is at index k + 1.
    x, y = ((local[:, axis] / local[:, 2] + 1) * (0.5 * num) + 0.5 for axis in (0, 1))
    left, top = (t.floor().clamp(0, num) for t in (x, y))
    right_part, low_part = x - left, y - top
    corner = ((face * (num + 2) + top.long()) * (num + 2) + left.long())[None]
    taps = torch.cat((corner, corner + 1, corner + num + 2, corner + num + 3))
    weights = torch.stack(
        (
            (1 - right_part) * (1 - low_part),
            right_part * (1 - low_part),
            (1 - right_part) * low_part,
            right_part * low_part,
        )
    )
    return _border(num), taps, weights


def face_of(directions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
    """Index of the cube face that each direction meets; ties go to the first in the order of `FACES`."""
    return torch.argmax(directions @ face_rotations()[:, :, 2].to(directions).T, dim=-1)


def _border(num: int) -> Int[Tensor, "padded 3"]:
    """The three face pixels (flat indices) whose mean stands at each pixel of the six padded faces."""
    rotations = face_rotations()
    index = torch.arange(-1, num + 1, dtype=torch.float64)
    y, x = torch.meshgrid(index, index, indexing="ij")
    inside = torch.stack((x.clamp(0, num - 1), y.clamp(0, num - 1)), dim=-1)
    beyond_x, beyond_y = x != inside[..., 0], y != inside[..., 1]
    own = torch.stack([_flat_index(torch.full_like(x, face), inside, num) for face in range(6)])
    both = []
    for beyond, axis, at in ((beyond_x, 0, x), (beyond_y, 1, y)):
        # Step from the touching pixel to just over the edge, and ask which pixel of which face is there.
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


def _pixel_at(directions: Float[Tensor, "*batch 3"], num: int) -> Int[Tensor, "*batch"]:
    """Flat index of the face pixel that holds each direction."""
    face = face_of(directions)
    local = (directions[..., None, :] @ face_rotations()[face])[..., 0, :]
    pixel = ((local[..., :2] / local[..., 2:] + 1) * (0.5 * num)).floor().clamp(0, num - 1)
    return _flat_index(face, pixel, num)


def _flat_index(face: Tensor, pixel: Float[Tensor, "*batch 2"], num: int) -> Int[Tensor, "*batch"]:
    return ((face * num + pixel[..., 1]) * num + pixel[..., 0]).long()
