"""Equirectangular panoramas: pixel coordinates, directions, sampling, padding and resizing on the sphere.

Convention (docs/conventions.md): camera axes are OpenCV's (x right, y down, z forward). Normalised coordinates
(u, v) lie in [0, 1], u to the right, v down, with pixel centres at half-integers. The image centre looks along +z, the
right quarter along +x; v = 0 is straight up (-y).

A panorama continues beyond its borders: columns wrap, and a row beyond a pole is the row at the same distance from that
pole, half a turn away. This is the border `sphere`. The published networks were trained with `wrapped_columns` (zeros
beyond the poles) and `zeros`.

Source: PanSplat, section 3.1.
"""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

Border = Literal["sphere", "wrapped_columns", "zeros"]


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
    v = (torch.arange(height, dtype=torch.float64, device=device) + 0.5) / height
    u = (torch.arange(width, dtype=torch.float64, device=device) + 0.5) / width
    uv = torch.stack((u.expand(height, width), v[:, None].expand(height, width)), dim=-1)
    return directions_from_uv(uv).to(dtype)


def row_weights(height: int, *, dtype: torch.dtype = torch.float64) -> Float[Tensor, "height"]:
    """Relative solid angle of a pixel in each row: the cosine of its latitude."""
    v = (torch.arange(height, dtype=dtype) + 0.5) / height
    return torch.sin(v * math.pi)


def sample_equirect(
    image: Float[Tensor, "channel height width"], uv: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "channel *batch"]:
    """Bilinear samples of a panorama at normalised coordinates, across its borders as well."""
    height, width = image.shape[-2:]
    padded = pad_equirect(image, 1)
    x = (uv[..., 0] - torch.floor(uv[..., 0])) * width + 1
    y = uv[..., 1].clamp(0, 1) * height + 1
    grid = torch.stack((2 * x / (width + 2) - 1, 2 * y / (height + 2) - 1), dim=-1).to(image.dtype)
    samples = functional.grid_sample(
        padded[None], grid.reshape(1, 1, -1, 2), mode="bilinear", padding_mode="border", align_corners=False
    )
    return samples.reshape(image.shape[0], *uv.shape[:-1])


def rotate_equirect(
    image: Float[Tensor, "channel height width"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "channel height width"]:
    """The panorama of a camera at the same position rotated by `rotation` (new camera axes in the old ones)."""
    directions = pixel_directions(*image.shape[-2:], dtype=torch.float64, device=image.device)
    return sample_equirect(image, uv_from_directions(directions @ rotation.to(directions).T))


def pad_equirect(
    maps: Float[Tensor, "*batch height width"], margin: int, border: Border = "sphere"
) -> Float[Tensor, "*batch h w"]:
    """Maps with `margin` more rows and columns on each side.

    Raises:
        ValueError: the margin is larger than the map, or the width is odd with the border `sphere`.
    """
    if margin == 0:
        return maps
    if border == "zeros":
        return functional.pad(maps, (margin,) * 4)
    height, width = maps.shape[-2:]
    over_poles = border == "sphere"
    if margin > width or (over_poles and margin > height):
        raise ValueError(f"`maps` must be at least as large as the margin of {margin}, got {height}x{width}")
    if over_poles and width % 2:
        raise ValueError(f"`maps` must have an even width to continue over the poles, got {width}")
    return _Padded.apply(maps, margin, over_poles)


class _Padded(torch.autograd.Function):
    """Copies each map once, forward and backward."""

    @staticmethod
    def forward(ctx, maps, margin, over_poles):
        ctx.margin, ctx.over_poles = margin, over_poles
        height, width = maps.shape[-2:]
        shape = (*maps.shape[:-2], height + 2 * margin, width + 2 * margin)
        last = maps.dim() == 4 and maps.is_contiguous(memory_format=torch.channels_last)
        layout = torch.channels_last if last else torch.contiguous_format
        padded = torch.empty(shape, dtype=maps.dtype, device=maps.device, memory_format=layout)
        within = padded[..., margin : margin + width]
        within[..., margin:-margin, :] = maps
        if over_poles:
            within[..., :margin, :] = _continue_over_pole(maps[..., :margin, :])
            within[..., -margin:, :] = _continue_over_pole(maps[..., -margin:, :])
        else:
            within[..., :margin, :] = 0
            within[..., -margin:, :] = 0
        padded[..., :margin] = within[..., -margin:]
        padded[..., -margin:] = within[..., :margin]
        return padded

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):  # pyright: ignore[reportIncompatibleMethodOverride]
        margin = ctx.margin
        within = gradient[..., margin:-margin].clone()
        within[..., -margin:] += gradient[..., :margin]
        within[..., :margin] += gradient[..., -margin:]
        result = within[..., margin:-margin, :]
        if ctx.over_poles:
            result[..., :margin, :] += _continue_over_pole(within[..., :margin, :])
            result[..., -margin:, :] += _continue_over_pole(within[..., -margin:, :])
        return result, None, None


def _continue_over_pole(rows: Tensor) -> Tensor:
    """The rows next to a pole in their order beyond it; its own inverse."""
    return rows.flip(-2).roll(rows.shape[-1] // 2, -1)


def resize_equirect(
    maps: Float[Tensor, "batch channel height width"], size: tuple[int, int]
) -> Float[Tensor, "batch channel h w"]:
    """Maps resized bilinearly to `size` (height, width) on the sphere, pixel centres at half-integers.

    There is no low-pass filter: a sample is a mean of four pixels at any factor.
    """
    height, width = maps.shape[-2:]
    if size == (height, width):
        return maps
    if size[0] * width != size[1] * height:
        raise ValueError(f"`size` must keep the aspect ratio of {height}x{width}, got {size[0]}x{size[1]}")
    # The smallest margin that corresponds to a whole number of pixels after resizing.
    divisor = math.gcd(height, size[0])
    margin, cut = height // divisor, size[0] // divisor
    padded = pad_equirect(maps, margin)
    resized = functional.interpolate(
        padded, (size[0] + 2 * cut, size[1] + 2 * cut), mode="bilinear", align_corners=False
    )
    return resized[..., cut:-cut, cut:-cut]


def fit_panoramas(
    images: Float[Tensor, "view 3 height width"],
    masks: Bool[Tensor, "view height width"] | None,
    multiple: int,
) -> tuple[Float[Tensor, "view 3 h w"], Bool[Tensor, "view h w"] | None]:
    """Panoramas and masks at the next height that is a multiple of `multiple`; unchanged if theirs is one.

    The levels and windows of a predictor halve the height several times. The size changes by less than a twelfth of it,
    so bilinear samples without wrap-around are exact to a twentieth of a pixel at the seam.
    """
    height = -(-images.shape[-2] // multiple) * multiple
    if height == images.shape[-2]:
        return images, masks
    images = functional.interpolate(images, (height, 2 * height), mode="bilinear", align_corners=False)
    if masks is not None:
        larger = functional.interpolate(masks[:, None].float(), (height, 2 * height), mode="nearest-exact")
        masks = larger[:, 0] > 0
    return images, masks
