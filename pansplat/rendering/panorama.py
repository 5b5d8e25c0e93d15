"""The pictures a camera can take: pinhole, direct panorama, cube faces.

Source: docs/rendering.md, section 6; PanSplat, section 3.4.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
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
