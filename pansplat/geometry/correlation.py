"""Correlation of each pixel's features with another panorama's features at every depth candidate.

On the CPU compiled kernels loop over pixels and never materialise the warped features. Consecutive candidates of a
pixel mostly fall between the same four pixels of the other panorama: their four dot products are computed once, and
each candidate only interpolates them. On other devices a few candidates at a time are warped and multiplied.

Source: PanSplat, section 3.2; docs/official.md, section 6.
"""

import inspect
import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba as nb
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.geometry.warp import Sampling, warp_panorama, warp_positions

_CHUNK = 1 << 22
"""Largest number of elements of the warped features, or of the positions, in memory at a time."""

_MAX_BANDS = 8
"""Bands of rows; each has its own gradient sums of the other panorama."""


def _kernel(function: Callable[..., Any]) -> Any:
    # The tests wrap every function to check its annotations; numba needs the unwrapped function.
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc"}}
    return nb.njit(cache=True, **options)(inspect.unwrap(function))


@_kernel
def _find_corners(x0, y0, height, width, wraps, rows, columns):
    """Rows and columns of the four pixels around a position, in row-major order."""
    for k in range(4):
        row, column = y0 + k // 2, x0 + k % 2
        if wraps:
            if row < 0:
                row, column = -1 - row, column + width // 2
            elif row >= height:
                row, column = 2 * height - 1 - row, column + width // 2
            column %= width
        rows[k], columns[k] = min(row, height - 1), min(column, width - 1)


@_kernel
def _correlate_band(reference, other, x, y, wraps, out, first, last):
    """Rows `first` to `last` of out (d, h, w), from reference and other (h, w, c) and positions x and y (d, h, w)."""
    count, height, width = x.shape
    channels = reference.shape[2]
    rows, columns = np.zeros(4, np.int64), np.zeros(4, np.int64)
    for i in range(first, last):
        for j in range(width):
            cell_x, cell_y = -9, -9
            pixel = reference[i, j]
            d0 = d1 = d2 = d3 = pixel[0] * 0
            for k in range(count):
                px, py = x[k, i, j], y[k, i, j]
                if not (px >= -1 and px <= width and py >= -1 and py <= height):
                    out[k, i, j] = np.nan  # the position is NaN
                    continue
                x0, y0 = int(np.floor(px)), int(np.floor(py))
                if x0 != cell_x or y0 != cell_y:
                    cell_x, cell_y = x0, y0
                    _find_corners(x0, y0, height, width, wraps, rows, columns)
                    a, b = other[rows[0], columns[0]], other[rows[1], columns[1]]
                    c, d = other[rows[2], columns[2]], other[rows[3], columns[3]]
                    d0 = d1 = d2 = d3 = pixel[0] * 0
                    for n in range(channels):
                        value = pixel[n]
                        d0 += value * a[n]
                        d1 += value * b[n]
                        d2 += value * c[n]
                        d3 += value * d[n]
                fx, fy = px - x0, py - y0
                out[k, i, j] = (1 - fy) * ((1 - fx) * d0 + fx * d1) + fy * ((1 - fx) * d2 + fx * d3)


@_kernel
def _accumulate_gradients(weights, pixel, other, rows, columns, grad_reference, grad_other):
    """Add the gradients of one reference pixel and of the four pixels around its candidates."""
    for k in range(4):
        weight, row, column = weights[k], rows[k], columns[k]
        features, grad_features = other[row, column], grad_other[row, column]
        for n in range(pixel.shape[0]):
            grad_reference[n] += weight * features[n]
            grad_features[n] += weight * pixel[n]
        weights[k] = 0


@_kernel
def _backward_band(gradient, reference, other, x, y, wraps, grad_reference, grad_other, first, last):
    """Add gradients to rows `first` to `last` of grad_reference (h, w, c), and to any rows of grad_other (h, w, c)."""
    count, height, width = x.shape
    rows, columns = np.zeros(4, np.int64), np.zeros(4, np.int64)
    weights = np.zeros(4, reference.dtype)
    for i in range(first, last):
        for j in range(width):
            cell_x, cell_y = -9, -9
            for k in range(count):
                px, py = x[k, i, j], y[k, i, j]
                if not (px >= -1 and px <= width and py >= -1 and py <= height):
                    continue
                x0, y0 = int(np.floor(px)), int(np.floor(py))
                if x0 != cell_x or y0 != cell_y:
                    if cell_x != -9:
                        _accumulate_gradients(
                            weights, reference[i, j], other, rows, columns, grad_reference[i, j], grad_other
                        )
                    cell_x, cell_y = x0, y0
                    _find_corners(x0, y0, height, width, wraps, rows, columns)
                fx, fy, g = px - x0, py - y0, gradient[k, i, j]
                weights[0] += g * (1 - fy) * (1 - fx)
                weights[1] += g * (1 - fy) * fx
                weights[2] += g * fy * (1 - fx)
                weights[3] += g * fy * fx
            if cell_x != -9:
                _accumulate_gradients(weights, reference[i, j], other, rows, columns, grad_reference[i, j], grad_other)


def _to_channels_last(maps: Tensor) -> np.ndarray:
    return maps.detach().movedim(1, -1).contiguous().numpy()


def _split_rows(height: int) -> list[tuple[int, int]]:
    """First and last row of each band: one band per torch thread, of at least eight rows."""
    count = max(1, min(torch.get_num_threads(), _MAX_BANDS, height // 8))
    edges = [height * band // count for band in range(count + 1)]
    return list(itertools.pairwise(edges))


def _run_bands(work: Callable[[int, int], None], pairs: int, bands: int) -> None:
    """Call `work` for every pair and band, with one thread per band."""
    with ThreadPoolExecutor(bands) as pool:
        for done in [pool.submit(work, pair, band) for pair in range(pairs) for band in range(bands)]:
            done.result()


def correlate(
    reference: Float[Tensor, "pair channel height width"],
    other: Float[Tensor, "pair channel height width"],
    inverse_depth: Float[Tensor, "pair candidate height width"],
    pose: Float[Tensor, "pair 4 4"],
    sampling: Sampling = "sphere",
) -> Float[Tensor, "pair candidate height width"]:
    """Dot products of each pixel's features with the other panorama's at each depth candidate, over sqrt(channel).

    The warped features of all candidates are never in memory at once, in the forward and in the backward pass.
    Half-precision features are multiplied in float32. Gradients flow to both features.

    Args:
        reference: features of the pixels.
        other: features of the same size, which are sampled.
        inverse_depth: candidates of each pixel, 1 / metres.
        pose: from the reference camera's axes to the other's.
        sampling: see `pansplat.geometry.warp`.
    """
    dtype = torch.promote_types(reference.dtype, torch.float32)
    # Scaled before the product, so that no partial sum overflows.
    scaled = reference.to(dtype) / math.sqrt(reference.shape[1])
    candidates = inverse_depth.detach().to(dtype)
    return _Correlation.apply(scaled, other.to(dtype), candidates, pose.detach(), sampling)


def _uses_kernels(features: Tensor) -> bool:
    return features.device.type == "cpu"


class _Correlation(torch.autograd.Function):
    """Correlates a chunk of candidates at a time; the backward pass computes their samples again."""

    @staticmethod
    def forward(ctx, reference, other, inverse_depth, pose, sampling):
        ctx.save_for_backward(reference, other, inverse_depth, pose)
        ctx.sampling = sampling
        correlate_chunk = _correlate_by_kernel if _uses_kernels(reference) else _correlate_by_warp
        chunks = _chunks(inverse_depth, reference)
        return torch.cat([correlate_chunk(reference, other, chunk, pose, sampling) for chunk in chunks], dim=1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):  # pyright: ignore[reportIncompatibleMethodOverride]
        reference, other, inverse_depth, pose = ctx.saved_tensors
        backward_chunk = _backward_by_kernel if _uses_kernels(reference) else _backward_by_warp
        grad_reference, grad_other = torch.zeros_like(reference), torch.zeros_like(other)
        chunks = _chunks(inverse_depth, reference)
        for chunk, part in zip(chunks, gradient.split([c.shape[1] for c in chunks], dim=1), strict=True):
            parts = backward_chunk(part, reference, other, chunk, pose, ctx.sampling)
            grad_reference += parts[0]
            grad_other += parts[1]
        return grad_reference, grad_other, None, None, None


def _correlate_by_warp(reference: Tensor, other: Tensor, chunk: Tensor, pose: Tensor, sampling: Sampling) -> Tensor:
    return torch.einsum("nchw,ncdhw->ndhw", reference, warp_panorama(other, chunk, pose, sampling))


def _backward_by_warp(
    part: Tensor, reference: Tensor, other: Tensor, chunk: Tensor, pose: Tensor, sampling: Sampling
) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        leaf = other.detach().requires_grad_()
        warped = warp_panorama(leaf, chunk, pose, sampling)
    grad_reference = torch.einsum("ndhw,ncdhw->nchw", part, warped.detach())
    return grad_reference, torch.autograd.grad(warped, leaf, part[:, None] * reference[:, :, None])[0]


def _correlate_by_kernel(reference: Tensor, other: Tensor, chunk: Tensor, pose: Tensor, sampling: Sampling) -> Tensor:
    out = torch.empty_like(chunk, memory_format=torch.contiguous_format)
    reference_maps, other_maps, wraps = _to_channels_last(reference), _to_channels_last(other), sampling == "sphere"
    x, y = (positions.contiguous().numpy() for positions in warp_positions(chunk, pose, sampling))
    result, bands = out.numpy(), _split_rows(reference.shape[2])

    def work(pair: int, band: int) -> None:
        _correlate_band(reference_maps[pair], other_maps[pair], x[pair], y[pair], wraps, result[pair], *bands[band])

    _run_bands(work, len(chunk), len(bands))
    return out


def _backward_by_kernel(
    part: Tensor, reference: Tensor, other: Tensor, chunk: Tensor, pose: Tensor, sampling: Sampling
) -> tuple[Tensor, Tensor]:
    reference_maps, other_maps, wraps = _to_channels_last(reference), _to_channels_last(other), sampling == "sphere"
    x, y = (positions.contiguous().numpy() for positions in warp_positions(chunk, pose, sampling))
    upstream, bands = part.contiguous().numpy(), _split_rows(reference.shape[2])
    grad_reference, grad_other = np.zeros_like(reference_maps), np.zeros_like(other_maps)
    for pair in range(len(chunk)):
        sums = np.zeros((len(bands), *other_maps.shape[1:]), other_maps.dtype)

        def work(_: int, band: int, pair: int = pair, sums: np.ndarray = sums) -> None:
            both = (grad_reference[pair], sums[band])
            _backward_band(
                upstream[pair], reference_maps[pair], other_maps[pair], x[pair], y[pair], wraps, *both, *bands[band]
            )

        _run_bands(work, 1, len(bands))
        sums.sum(axis=0, out=grad_other[pair])
    return torch.from_numpy(grad_reference).movedim(-1, 1), torch.from_numpy(grad_other).movedim(-1, 1)


def _chunks(inverse_depth: Tensor, reference: Tensor) -> tuple[Tensor, ...]:
    """The candidates in chunks of at most `_CHUNK` elements: warped features, or positions for the kernels."""
    elements = inverse_depth[:, :1].numel() if _uses_kernels(reference) else reference.numel()
    return inverse_depth.split(max(1, _CHUNK // max(1, elements)), dim=1)
