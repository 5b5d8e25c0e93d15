"""`objective.image_difference` on the CPU: the value and its gradient in one pass over the image, compiled.

The same in torch operations reads and writes the image 40 times, and each operation waits for all threads.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pansplat.rendering.cpu.runtime import inline_kernel_no_refcount, kernel, parallel_for, pooled_empty, thread_count

_ROWS_PER_ITEM = 16  # rows of an image that a thread processes together
_CHANNELS = 3


class Difference(torch.autograd.Function):
    """`image_difference` of a float32 error in main memory, differentiable once in the error."""

    @staticmethod
    def forward(ctx: Any, error: Tensor, pixels: Tensor, right: Tensor, below: Tensor) -> Tensor:
        """The difference; the arguments are those of `image_difference`."""
        arrays = [tensor.detach().contiguous().numpy() for tensor in (error, pixels, right, below)]
        height = error.shape[1]
        gradient, totals = pooled_empty(tuple(error.shape), np.float32), np.empty(height)
        work = partial(_compare_rows, *arrays, gradient, totals)
        parallel_for(work, -(-height // _ROWS_PER_ITEM), thread_count())
        ctx.gradient = torch.from_numpy(gradient)
        return torch.tensor(totals.sum(), dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        factor = float(grad_outputs[0])
        return ctx.gradient if factor == 1 else ctx.gradient * factor, None, None, None


@kernel
def _compare_rows(error, pixels, right, below, gradient, totals, item):
    """Write the gradient and the sums of some rows; a difference counts in the row of its first pixel."""
    height, width = pixels.shape
    terms = np.empty(width, np.float32)
    for y in range(item * _ROWS_PER_ITEM, min((item + 1) * _ROWS_PER_ITEM, height)):
        above, under = max(y - 1, 0), min(y + 1, height - 1)  # a pole's row minus itself is 0
        for x in range(width):
            terms[x] = 0
        for channel in range(len(error)):
            rows = error[channel, y], error[channel, above], error[channel, under]
            weights, written = (pixels[y], right[y], below[y], below[above]), gradient[channel, y]
            _compare_pixel(rows, weights, width - 1, 0, 1, written, terms)
            for x in range(1, width - 1):
                _compare_pixel(rows, weights, x - 1, x, x + 1, written, terms)
            _compare_pixel(rows, weights, width - 2, width - 1, 0, written, terms)
        total = 0.0
        for x in range(width):
            total += terms[x]
        totals[y] = total / _CHANNELS


@inline_kernel_no_refcount
def _compare_pixel(rows, weights, before, x, after, gradient, terms):
    """Write the gradient of pixel x of a row, and add its terms; `before` and `after` are its neighbours."""
    row, upper, lower = rows
    pixels, right, below, below_upper = weights
    here, half = row[x], np.float32(0.5)
    left, across, up, down = here - row[before], row[after] - here, here - upper[x], lower[x] - here
    terms[x] += pixels[x] * abs(here) + half * (right[x] * abs(across) + below[x] * abs(down))
    slope = right[before] * _sign(left) - right[x] * _sign(across)
    slope += below_upper[x] * _sign(up) - below[x] * _sign(down)
    gradient[x] = (pixels[x] * _sign(here) + half * slope) * np.float32(1 / _CHANNELS)


@inline_kernel_no_refcount
def _sign(value):
    return np.float32(value > 0) - np.float32(value < 0)
