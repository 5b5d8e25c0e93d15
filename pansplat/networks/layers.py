"""Shared layers of the networks: convolution, resizing and attention on panorama maps; input checks.

`compat="official"` computes what the official code computes, its defects included. `compat="fixed"` has pixel centres
at half-integers and continues every map across the seam and the poles.

Source: PanSplat, section 3.1; docs/official.md, sections 4, 6 and 7.
"""

from collections.abc import Callable
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor, nn
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.geometry.equirect import Border, pad_equirect, resize_equirect
from pansplat.geometry.pose import orthonormal_error
from pansplat.prediction_options import Precision

Compat = Literal["official", "fixed"]

Size = Annotated[int, Meta(ge=1, le=4096)]
"""A number of channels, candidates or rows in the settings of a network; larger ones take gigabytes."""
Factor = Annotated[float, Meta(ge=1e-6, le=4096)]
"""A number in the settings of a network."""

Images = Float[Tensor, "batch view 3 height width"]
"""Panoramas, RGB in [0, 1]."""
Poses = Float[Tensor, "batch view 4 4"]
"""Rigid cam2world, OpenCV axes, metres."""
PerView = Float[Tensor, "batch view"]
"""A number for each view, such as a bound of its depth, metres."""
ViewMaps = Float[Tensor, "batch view channel height width"]
"""Maps of all views."""
Volume = Float[Tensor, "batch view candidate height width"]
"""A number for each depth candidate of each pixel."""
Maps = Float[Tensor, "image channel height width"]
"""Maps of independent images: those of all views of all batch items."""


def autocast_convolutions(precision: Precision, device: torch.device) -> torch.autocast:
    """Autocast context in which "bfloat16" rounds inputs and outputs of convolutions and linear layers.

    Their sums, and those of normalisations, are in float32. Attention has a precision of its own, see `attend`.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16")


def to_channels_last(maps: Maps) -> Maps:
    """The maps in channels-last memory layout, in which a CPU convolves faster."""
    return maps.contiguous(memory_format=torch.channels_last)


def choose_border(compat: Compat) -> Border:
    """The border of PanSplat's convolutions."""
    return "sphere" if compat == "fixed" else "wrapped_columns"


def require_views(count: int, compat: Compat) -> None:
    """Raise an InputError for fewer than two views, or more than two with `compat="official"`."""
    if count < 2:
        raise InputError(f"a prediction needs two or more views, got {count}; add a panorama of the same place")
    if count > 2 and compat == "official":
        raise InputError(
            f'compat="official" needs exactly two views, as the official code does, got {count}; use compat="fixed"'
        )


def require_size(height: int, width: int, multiple: int) -> None:
    """Raise an InputError unless `multiple` divides height and width."""
    if height % multiple or width % multiple:
        raise InputError(
            f"the network needs a height and a width that {multiple} divides, got {height}x{width}; "
            "choose another height"
        )


def require_rigid(cam2world: Float[Tensor, "batch view 4 4"]) -> None:
    """Raise an InputError for a rotation that is not orthonormal within 1e-4, is a reflection, or is not finite."""
    for item, poses in enumerate(cam2world):
        for view, pose in enumerate(poses):
            error = orthonormal_error(pose)
            if not error <= 1e-4:
                raise InputError(
                    f"`cam2world` of item {item}, view {view} must be a rigid pose, got an error of {error:.2g}; "
                    "normalise the rotation and remove its scale"
                )


class PanoramaConv2d(nn.Conv2d):
    """Convolution of panorama maps that are padded by `border`; the output has the input's size over the stride."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int,
        *,
        border: Border,
        stride: int = 1,
        groups: int = 1,
        bias: bool = True,
    ) -> None:
        super().__init__(inputs, outputs, kernel, stride=stride, groups=groups, bias=bias)
        self.border: Border = border
        self.margin = kernel // 2

    def forward(self, input: Maps) -> Float[Tensor, "image c h w"]:
        return self.convolve(input, self.weight, self.bias)

    def convolve(
        self, maps: Maps, weight: Float[Tensor, "c d kernel kernel"], bias: Float[Tensor, "c"] | None
    ) -> Float[Tensor, "image c h w"]:
        """Convolve with the given weights and bias."""
        if self.border == "zeros":
            return functional.conv2d(maps, weight, bias, self.stride, self.margin, groups=self.groups)
        return functional.conv2d(
            pad_equirect(maps, self.margin, self.border), weight, bias, self.stride, groups=self.groups
        )


def convolve_and_normalize(
    conv: PanoramaConv2d, norm: nn.BatchNorm2d | nn.GroupNorm, maps: Maps
) -> Float[Tensor, "image c h w"]:
    """Convolution, then normalisation; of batches in eval mode, one convolution with scaled weights."""
    mean, variance = getattr(norm, "running_mean", None), getattr(norm, "running_var", None)
    if norm.training or mean is None or variance is None:
        return norm(conv(maps))
    scale = norm.weight / (variance + norm.eps).sqrt()
    offset = -mean if conv.bias is None else conv.bias - mean
    return conv.convolve(maps, conv.weight * scale[:, None, None, None], norm.bias + scale * offset)


class ConvNorm(nn.Module):
    """Convolution, normalisation and an activation.

    Args:
        groups: number of groups of the normalisation; 0 to normalise batches.
        activate: the activation; None for none.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int = 3,
        *,
        border: Border,
        stride: int = 1,
        bias: bool = False,
        groups: int = 0,
        activate: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.conv = PanoramaConv2d(inputs, outputs, kernel, stride=stride, bias=bias, border=border)
        self.norm = nn.GroupNorm(groups, outputs) if groups else nn.BatchNorm2d(outputs)
        self.activate = activate

    def forward(self, maps: Maps) -> Float[Tensor, "image c h w"]:
        normalized = convolve_and_normalize(self.conv, self.norm, maps)
        return normalized if self.activate is None else self.activate(normalized)


def make_head(inputs: int, inner: int, outputs: int, border: Border) -> nn.Sequential:
    """Two convolutions with a GELU between them."""
    first, second = (PanoramaConv2d(*channels, 3, border=border) for channels in ((inputs, inner), (inner, outputs)))
    return nn.Sequential(first, nn.GELU(), second)


class TwoConvs(nn.Module):
    """Two convolutions, each with normalisation of batches, and a ReLU after the first."""

    def __init__(
        self, inputs: int, outputs: int, *, border: Border = "sphere", kernel: int = 3, stride: int = 1
    ) -> None:
        super().__init__()
        self.conv1 = PanoramaConv2d(inputs, outputs, kernel, stride=stride, bias=False, border=border)
        self.norm1 = nn.BatchNorm2d(outputs)
        self.conv2 = PanoramaConv2d(outputs, outputs, 3, bias=False, border=border)
        self.norm2 = nn.BatchNorm2d(outputs)

    def convolve(self, maps: Maps) -> Float[Tensor, "image c h w"]:
        """The output of both convolutions, without an activation after the second."""
        inner = functional.relu(convolve_and_normalize(self.conv1, self.norm1, maps))
        return convolve_and_normalize(self.conv2, self.norm2, inner)


def upsample(maps: Maps, factor: int, compat: Compat) -> Float[Tensor, "image channel h w"]:
    """Upsample maps bilinearly; "official" aligns the centres of the corner pixels (`align_corners=True`)."""
    if compat == "official":
        return functional.interpolate(maps, scale_factor=factor, mode="bilinear", align_corners=True)
    height, width = maps.shape[-2:]
    return resize_equirect(maps, (height * factor, width * factor))


def resize(maps: Maps, size: tuple[int, int], compat: Compat) -> Float[Tensor, "image channel h w"]:
    """Resize maps bilinearly with pixel centres at half-integers; "official" repeats the border pixels."""
    if compat == "official":
        return functional.interpolate(maps, size, mode="bilinear", align_corners=False)
    return resize_equirect(maps, size)


def attend(
    queries: Float[Tensor, "batch head query channel"],
    keys: Float[Tensor, "batch head key channel"],
    values: Float[Tensor, "batch head key channel"],
    *,
    mask: Float[Tensor, "#batch #head query key"] | None = None,
    precision: Precision = "float32",
) -> Float[Tensor, "batch head query channel"]:
    """Scaled dot-product attention; `mask` is added to the logits.

    Precision "bfloat16" rounds inputs and output to bfloat16, as the official kernel does; on a CPU the sums are
    in float32.
    """
    inputs, dtype, device = (queries, keys, values), queries.dtype, queries.device.type
    with torch.autocast(device, enabled=False):
        if precision == "float32":
            exact = [tensor.to(torch.promote_types(tensor.dtype, torch.float32)) for tensor in inputs]
            return functional.scaled_dot_product_attention(*exact, attn_mask=mask)
        rounded = [None if tensor is None else tensor.to(torch.bfloat16) for tensor in (*inputs, mask)]
        if device == "cpu":
            rounded = [None if tensor is None else tensor.to(dtype) for tensor in rounded]
        attended = functional.scaled_dot_product_attention(*rounded[:3], attn_mask=rounded[3])
        return attended.to(torch.bfloat16).to(dtype)
