"""Equirectangular panoramas: pixel coordinates, unit directions, sampling that knows the sphere.

Convention (docs/conventions.md): camera axes are OpenCV's (x right, y down, z forward). Normalised coordinates
(u, v) in [0, 1], u right, v down, pixel centres at half-integers. The image centre looks along +z, the right
quarter along +x; v = 0 is straight up (-y).

Source: PanSplat, section 3.1; the original code's conventions (half-pixel centres).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def directions_from_uv(uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Unit directions in the camera frame of normalised panorama coordinates."""
    longitude = (2 * uv[..., 0] - 1) * math.pi
    latitude = (uv[..., 1] - 0.5) * math.pi  # positive below the horizon, as y is down
    cos_latitude = torch.cos(latitude)
    return torch.stack(
        (cos_latitude * torch.sin(longitude), torch.sin(latitude), cos_latitude * torch.cos(longitude)), dim=-1
    )


def uv_from_directions(directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
    """Normalised panorama coordinates of directions of any length; u in [0, 1], v in [0, 1].

    The latitude is atan2(y, hypot(x, z)): unlike asin(y / |p|) it is exact at the poles and never NaN. The zero
    vector maps to the image centre.
    """
    x, y, z = directions.unbind(-1)
    u = torch.atan2(x, z) / (2 * math.pi) + 0.5
    v = torch.atan2(y, torch.hypot(x, z)) / math.pi + 0.5
    return torch.stack((u, v), dim=-1)


def pixel_directions(
    height: int, width: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Float[Tensor, "height width 3"]:
    """Unit directions of all pixel centres of a panorama."""
    v = (torch.arange(height, dtype=torch.float64) + 0.5) / height
    u = (torch.arange(width, dtype=torch.float64) + 0.5) / width
    uv = torch.stack((u.expand(height, width), v[:, None].expand(height, width)), dim=-1)
    return directions_from_uv(uv).to(device=device, dtype=dtype)


def row_weights(height: int, *, dtype: torch.dtype = torch.float64) -> Float[Tensor, "height"]:
    """Relative solid angle of a pixel in each row: the cosine of its latitude."""
    v = (torch.arange(height, dtype=dtype) + 0.5) / height
    return torch.sin(v * math.pi)


def pad_equirect(image: Float[Tensor, "*batch height width"], margin: int) -> Float[Tensor, "*batch h w"]:
    """Pad a panorama by its true neighbours: columns wrap, rows continue over the pole half a turn away."""
    width = image.shape[-1]
    if width % 2:
        raise ValueError(f"`image` must have an even width to continue over the poles, got {width}")
    above, below = (rows.flip(-2).roll(width // 2, -1) for rows in (image[..., :margin, :], image[..., -margin:, :]))
    rows = torch.cat((above, image, below), dim=-2)
    return torch.cat((rows[..., -margin:], rows, rows[..., :margin]), dim=-1)


def sample_equirect(
    image: Float[Tensor, "channel height width"], uv: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "channel *batch"]:
    """Bilinear samples of a panorama at normalised coordinates; wraps in longitude, continues over the poles."""
    height, width = image.shape[-2:]
    padded = pad_equirect(image, 1)
    x = (uv[..., 0] - torch.floor(uv[..., 0])) * width + 1
    y = uv[..., 1].clamp(0, 1) * height + 1
    grid = torch.stack((2 * x / (width + 2) - 1, 2 * y / (height + 2) - 1), dim=-1).to(image.dtype)
    samples = torch.nn.functional.grid_sample(
        padded[None], grid.reshape(1, 1, -1, 2), mode="bilinear", padding_mode="border", align_corners=False
    )
    return samples.reshape(image.shape[0], *uv.shape[:-1])


def rotate_equirect(
    image: Float[Tensor, "channel height width"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "channel height width"]:
    """The panorama seen by a camera at the same place turned by `rotation` (new camera axes in old ones)."""
    directions = pixel_directions(*image.shape[-2:], dtype=torch.float64, device=image.device)
    return sample_equirect(image, uv_from_directions(directions @ rotation.to(directions).T))
