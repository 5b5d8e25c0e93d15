"""3x3 convolutions with a quarter of the multiplications, for prediction on a processor.

Blocks of 4x4 outputs are computed from 6x6 inputs: both sides are transformed by fixed small matrices, and between
them stands one product of matrices for each of 36 coefficients. Rounding is coarser: in float32 the largest error
over the output's standard deviation grows from 0.7e-5 to 4e-5 at 300 channels. Training, other number types, GPUs
and small maps take the ordinary convolution.

Source: Lavin and Gray, Fast algorithms for convolutional neural networks, https://arxiv.org/abs/1509.09308
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import numba as nb
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

_BLOCK = 4  # outputs along each side of a block
_COEFFICIENTS = 36
_CHUNK = 256  # blocks at a time: their coefficients stay in the cache
_LANES = 16  # channels are padded to a multiple of this, for aligned products
_LEAST_OUTPUTS, _LEAST_CHANNELS = 4096, 32  # below, the ordinary convolution is as fast

_WEIGHT_TRANSFORM = (
    (1 / 4, 0.0, 0.0),
    (-1 / 6, -1 / 6, -1 / 6),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 24, 1 / 12, 1 / 6),
    (1 / 24, -1 / 12, 1 / 6),
    (0.0, 0.0, 1.0),
)


class FastConv3x3(nn.Conv2d):
    """A 3x3 convolution that is computed in blocks where that is faster and no gradient is asked for.

    Attributes:
        method: "direct" never takes blocks, to compare with.
    """

    def __init__(self, inputs: int, outputs: int, *, padding: int) -> None:
        super().__init__(inputs, outputs, 3, padding=padding)
        self.method: Literal["fastest", "direct"] = "fastest"
        self._transformed: tuple[Tensor, int, Tensor] | None = None

    def forward(self, input: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch c h w"]:
        if not self._is_faster_in_blocks(input):
            return super().forward(input)
        assert self.bias is not None
        margin = int(self.padding[0])
        convolved = [convolve_blocks(maps, self._coefficients(), self.bias, margin) for maps in input.split(1)]
        return convolved[0] if len(convolved) == 1 else torch.cat(convolved)

    def _is_faster_in_blocks(self, input: Tensor) -> bool:
        needs_gradient = torch.is_grad_enabled() and (input.requires_grad or self.weight.requires_grad)
        plain = input.device.type == "cpu" and input.dtype == self.weight.dtype == torch.float32
        large = input.shape[-2] * input.shape[-1] >= _LEAST_OUTPUTS and min(self.weight.shape[:2]) >= _LEAST_CHANNELS
        wanted = self.method == "fastest" and not needs_gradient
        return wanted and plain and large and not torch.is_autocast_enabled("cpu")

    def _coefficients(self) -> Float[Tensor, "36 inputs outputs"]:
        """The transformed weights, kept until the weights change."""
        weight = self.weight.detach()  # holding it keeps its memory from being given to other weights
        kept = self._transformed
        if kept is None or kept[0].data_ptr() != weight.data_ptr() or kept[1] != weight._version:
            kept = self._transformed = (weight, weight._version, transform_weights(weight))
        return kept[2]


@torch.no_grad()
def transform_weights(weight: Float[Tensor, "output input 3 3"]) -> Float[Tensor, "36 inputs outputs"]:
    """Weights of each coefficient, channels padded with zeros."""
    transform = torch.tensor(_WEIGHT_TRANSFORM, dtype=torch.float64)
    outputs, inputs = weight.shape[:2]
    transformed = torch.zeros(_COEFFICIENTS, _padded(inputs), _padded(outputs))
    exact = torch.einsum("ai,ocij,bj->abco", transform, weight.double(), transform)
    transformed[:, :inputs, :outputs] = exact.flatten(0, 1)
    return transformed


@torch.no_grad()
def convolve_blocks(
    maps: Float[Tensor, "1 channel height width"],
    coefficients: Float[Tensor, "36 inputs outputs"],
    bias: Float[Tensor, "output"],
    margin: int = 0,
) -> Float[Tensor, "1 output h w"]:
    """The convolution of a map, with a margin of zeros, by transformed weights; in and out in channels-last order."""
    pixels = maps[0].permute(1, 2, 0).contiguous().numpy()
    height, width = pixels.shape[0] + 2 * margin - 2, pixels.shape[1] + 2 * margin - 2
    across = -(-width // _BLOCK)
    count = -(-height // _BLOCK) * across
    out = torch.empty(1, len(bias), height, width, memory_format=torch.channels_last)
    out_pixels, offsets = out[0].permute(1, 2, 0).numpy(), bias.numpy()
    threads = max(1, torch.get_num_threads())
    read = torch.zeros(_COEFFICIENTS, _CHUNK, coefficients.shape[1])
    products = torch.empty(_COEFFICIENTS, _CHUNK, coefficients.shape[2])
    with ThreadPoolExecutor(threads) as pool:

        def share(work: Callable[..., None], first: int, *arrays: Any) -> None:
            bounds = np.linspace(0, min(_CHUNK, count - first), threads + 1).astype(int)
            parts = [pool.submit(work, *arrays, across, first, *pair) for pair in itertools.pairwise(bounds)]
            for part in parts:
                part.result()

        for first in range(0, count, _CHUNK):
            share(_read_blocks, first, pixels, margin, read.numpy())
            torch.bmm(read, coefficients, out=products)
            share(_write_blocks, first, products.numpy(), offsets, out_pixels)
    return out


def _padded(channels: int) -> int:
    return -(-channels // _LANES) * _LANES


def _kernel(function: Callable[..., Any]) -> Any:
    # The tests' check of annotations wraps every function; numba needs the bare one.
    return nb.njit(cache=True, nogil=True, fastmath={"contract", "nsz", "reassoc"})(inspect.unwrap(function))


@_kernel
def _pixel(row, column, width, beyond):
    return row[column] if column >= 0 and column < width else beyond[0]


@_kernel
def _read_blocks(pixels, margin, read, across, first, start, end):
    """Coefficients (36, block, channel) of blocks first + start .. first + end of 6x6 pixels (height, width, channel).

    Beyond the map there are zeros.
    """
    height, width, channels = pixels.shape
    half = np.empty((6, 6, channels), np.float32)
    beyond = np.zeros((1, channels), np.float32)
    for block in range(start, end):
        top, left = 4 * ((first + block) // across) - margin, 4 * ((first + block) % across) - margin
        for i in range(6):
            inside = top + i >= 0 and top + i < height
            row = pixels[top + i] if inside else beyond
            last = width if inside else 0
            d0, d1 = _pixel(row, left, last, beyond), _pixel(row, left + 1, last, beyond)
            d2, d3 = _pixel(row, left + 2, last, beyond), _pixel(row, left + 3, last, beyond)
            d4, d5 = _pixel(row, left + 4, last, beyond), _pixel(row, left + 5, last, beyond)
            for c in range(channels):
                even, odd = d4[c] - 4 * d2[c], d3[c] - 4 * d1[c]
                half[i, 0, c] = 4 * d0[c] - 5 * d2[c] + d4[c]
                half[i, 1, c] = even + odd
                half[i, 2, c] = even - odd
                even, odd = d4[c] - d2[c], 2 * (d3[c] - d1[c])
                half[i, 3, c] = even + odd
                half[i, 4, c] = even - odd
                half[i, 5, c] = 4 * d1[c] - 5 * d3[c] + d5[c]
        for j in range(6):
            for c in range(channels):
                d0, d1, d2 = half[0, j, c], half[1, j, c], half[2, j, c]
                d3, d4, d5 = half[3, j, c], half[4, j, c], half[5, j, c]
                even, odd = d4 - 4 * d2, d3 - 4 * d1
                read[j, block, c] = 4 * d0 - 5 * d2 + d4
                read[6 + j, block, c] = even + odd
                read[12 + j, block, c] = even - odd
                even, odd = d4 - d2, 2 * (d3 - d1)
                read[18 + j, block, c] = even + odd
                read[24 + j, block, c] = even - odd
                read[30 + j, block, c] = 4 * d1 - 5 * d3 + d5


@_kernel
def _write_blocks(products, bias, pixels, across, first, start, end):
    """4x4 pixels of (height, width, channel) a block, from products (36, block, channel)."""
    height, width, channels = pixels.shape
    half = np.empty((4, 6, channels), np.float32)
    for block in range(start, end):
        top, left = 4 * ((first + block) // across), 4 * ((first + block) % across)
        for j in range(6):
            for c in range(channels):
                m1, m2 = products[6 + j, block, c], products[12 + j, block, c]
                m3, m4 = products[18 + j, block, c], products[24 + j, block, c]
                inner_sum, inner, outer_sum, outer = m1 + m2, m1 - m2, m3 + m4, m3 - m4
                half[0, j, c] = products[j, block, c] + inner_sum + outer_sum
                half[1, j, c] = inner + 2 * outer
                half[2, j, c] = inner_sum + 4 * outer_sum
                half[3, j, c] = inner + 8 * outer + products[30 + j, block, c]
        for i in range(min(4, height - top)):
            row, whole = pixels[top + i], left + 4 <= width
            for c in range(channels):
                inner_sum, inner = half[i, 1, c] + half[i, 2, c], half[i, 1, c] - half[i, 2, c]
                outer_sum, outer = half[i, 3, c] + half[i, 4, c], half[i, 3, c] - half[i, 4, c]
                row[left, c] = half[i, 0, c] + inner_sum + outer_sum + bias[c]
                if whole or left + 1 < width:
                    row[left + 1, c] = inner + 2 * outer + bias[c]
                if whole or left + 2 < width:
                    row[left + 2, c] = inner_sum + 4 * outer_sum + bias[c]
                if whole:
                    row[left + 3, c] = inner + 8 * outer + half[i, 5, c] + bias[c]
