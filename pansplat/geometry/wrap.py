"""What lies beyond a panorama's borders: padding and resizing of maps that know the sphere.

`sphere` is the truth: columns wrap, and a row beyond a pole is the pole's own row half a turn away.
`wrapped_columns` (zeros beyond the poles) and `zeros` are what the original networks were trained with.

Source: PanSplat, section 3.1; the original's "panorama convolution" pads rows by zeros, then columns circularly.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

Border = Literal["sphere", "wrapped_columns", "zeros"]


def pad(maps: Float[Tensor, "*batch height width"], margin: int, border: Border) -> Float[Tensor, "*batch h w"]:
    """Maps with `margin` more rows and columns on each side.

    Raises:
        ValueError: the margin is larger than the map, or the width is odd and the border is the sphere's.
    """
    if margin == 0:
        return maps
    if border == "zeros":
        return functional.pad(maps, (margin,) * 4)
    height, width = maps.shape[-2:]
    over_poles = border == "sphere"
    if margin > width or (over_poles and margin > height):
        raise ValueError(f"a margin of {margin} needs a map at least as large, got {height}x{width}")
    if over_poles and width % 2:
        raise ValueError(f"a map needs an even width to go on over the poles, got {width}")
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
            within[..., :margin, :] = _beyond_pole(maps[..., :margin, :])
            within[..., -margin:, :] = _beyond_pole(maps[..., -margin:, :])
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
            result[..., :margin, :] += _beyond_pole(within[..., :margin, :])
            result[..., -margin:, :] += _beyond_pole(within[..., -margin:, :])
        return result, None, None


def _beyond_pole(rows: Tensor) -> Tensor:
    """The rows next to a pole, as they follow one another beyond it; its own inverse."""
    return rows.flip(-2).roll(rows.shape[-1] // 2, -1)


def resize(
    maps: Float[Tensor, "batch channel height width"], size: tuple[int, int]
) -> Float[Tensor, "batch channel h w"]:
    """Maps bilinearly resized to `size` (height, width) on the sphere, pixel centres at half-integers.

    Not filtered before it is made smaller: a sample is a mean of four pixels, whatever the factor.
    """
    height, width = maps.shape[-2:]
    if size == (height, width):
        return maps
    if size[0] * width != size[1] * height:
        raise ValueError(f"`size` must keep the shape of {height}x{width}, got {size[0]}x{size[1]}")
    # The smallest margin that becomes a whole number of pixels, and can be cut off again.
    divisor = math.gcd(height, size[0])
    margin, cut = height // divisor, size[0] // divisor
    padded = pad(maps, margin, "sphere")
    resized = functional.interpolate(
        padded, (size[0] + 2 * cut, size[1] + 2 * cut), mode="bilinear", align_corners=False
    )
    return resized[..., cut:-cut, cut:-cut]
