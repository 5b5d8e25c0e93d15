"""The correlation of a spherical sweep on the processor, pixel by pixel, without ever warping a map.

Neighbouring candidates of a pixel mostly fall among the same four pixels of the other panorama. Their four dot
products are then taken once, and each candidate only weighs them.
"""

import inspect
import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba as nb
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_MOST_BANDS = 8
"""Each has its own sum of gradients to the other panorama."""


def _kernel(function: Callable[..., Any]) -> Any:
    # The tests' check of annotations wraps every function; numba needs the bare one.
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc"}}
    return nb.njit(cache=True, **options)(inspect.unwrap(function))


@_kernel
def _corners(x0, y0, height, width, wraps, rows, columns):
    """Rows and columns of the four pixels about a position, in reading order."""
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
                    out[k, i, j] = np.nan  # a position that is none
                    continue
                x0, y0 = int(np.floor(px)), int(np.floor(py))
                if x0 != cell_x or y0 != cell_y:
                    cell_x, cell_y = x0, y0
                    _corners(x0, y0, height, width, wraps, rows, columns)
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
def _spread(weights, pixel, other, rows, columns, to_reference, to_other):
    """Add what one pixel and the four about its candidates get from each other."""
    for k in range(4):
        weight, row, column = weights[k], rows[k], columns[k]
        seen, gains = other[row, column], to_other[row, column]
        for n in range(pixel.shape[0]):
            to_reference[n] += weight * seen[n]
            gains[n] += weight * pixel[n]
        weights[k] = 0


@_kernel
def _backward_band(gradient, reference, other, x, y, wraps, to_reference, to_other, first, last):
    """Adds to to_reference (h, w, c), rows `first` to `last`, and anywhere in to_other (h, w, c)."""
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
                        _spread(weights, reference[i, j], other, rows, columns, to_reference[i, j], to_other)
                    cell_x, cell_y = x0, y0
                    _corners(x0, y0, height, width, wraps, rows, columns)
                fx, fy, g = px - x0, py - y0, gradient[k, i, j]
                weights[0] += g * (1 - fy) * (1 - fx)
                weights[1] += g * (1 - fy) * fx
                weights[2] += g * fy * (1 - fx)
                weights[3] += g * fy * fx
            if cell_x != -9:
                _spread(weights, reference[i, j], other, rows, columns, to_reference[i, j], to_other)


def correlate_positions(
    reference: Float[Tensor, "pair channel height width"],
    other: Float[Tensor, "pair channel height width"],
    columns: Float[Tensor, "pair candidate height width"],
    rows: Float[Tensor, "pair candidate height width"],
    *,
    wraps: bool,
) -> Float[Tensor, "pair candidate height width"]:
    """Dot products of each pixel's features with bilinear samples of the other panorama.

    Args:
        reference: all tensors on the CPU, of one type (float32 or float64).
        other: is sampled.
        columns: where, 0 being the first pixel's centre, at most one pixel beyond the border.
        rows: likewise.
        wraps: whether columns wrap and rows go on over the poles; otherwise the border's pixels repeat.
    """
    height = reference.shape[2]
    out = torch.empty_like(columns, memory_format=torch.contiguous_format)
    ours, theirs = _channels_last(reference), _channels_last(other)
    x, y, result = columns.contiguous().numpy(), rows.contiguous().numpy(), out.numpy()
    bands = _bands(height)

    def work(pair: int, band: int) -> None:
        _correlate_band(ours[pair], theirs[pair], x[pair], y[pair], wraps, result[pair], *bands[band])

    _share(work, reference.shape[0], len(bands))
    return out


def correlate_positions_backward(
    gradient: Float[Tensor, "pair candidate height width"],
    reference: Float[Tensor, "pair channel height width"],
    other: Float[Tensor, "pair channel height width"],
    columns: Float[Tensor, "pair candidate height width"],
    rows: Float[Tensor, "pair candidate height width"],
    *,
    wraps: bool,
) -> tuple[Float[Tensor, "pair channel height width"], Float[Tensor, "pair channel height width"]]:
    """Gradients of `correlate_positions` to both panoramas' features."""
    pairs, channels, height, width = reference.shape
    ours, theirs, upstream = _channels_last(reference), _channels_last(other), gradient.contiguous().numpy()
    x, y = columns.contiguous().numpy(), rows.contiguous().numpy()
    bands = _bands(height)
    to_reference = np.zeros((pairs, height, width, channels), ours.dtype)
    to_other = np.zeros_like(to_reference)
    for pair in range(pairs):
        sums = np.zeros((len(bands), height, width, channels), ours.dtype)

        def work(_: int, band: int, pair: int = pair, sums: np.ndarray = sums) -> None:
            both = (to_reference[pair], sums[band])
            _backward_band(upstream[pair], ours[pair], theirs[pair], x[pair], y[pair], wraps, *both, *bands[band])

        _share(work, 1, len(bands))
        sums.sum(axis=0, out=to_other[pair])
    return torch.from_numpy(to_reference).movedim(-1, 1), torch.from_numpy(to_other).movedim(-1, 1)


def _channels_last(maps: Tensor) -> np.ndarray:
    return maps.detach().movedim(1, -1).contiguous().numpy()


def _bands(height: int) -> list[tuple[int, int]]:
    """Rows shared out among as many threads as torch may use; a few rows are not worth a thread."""
    count = max(1, min(torch.get_num_threads(), _MOST_BANDS, height // 8))
    edges = [height * band // count for band in range(count + 1)]
    return list(itertools.pairwise(edges))


def _share(work: Callable[[int, int], None], pairs: int, bands: int) -> None:
    """Call `work` for every pair and band, each band on a thread of its own."""
    if bands == 1:
        for pair in range(pairs):
            work(pair, 0)
        return
    with ThreadPoolExecutor(bands) as pool:
        for done in [pool.submit(work, pair, band) for pair in range(pairs) for band in range(bands)]:
            done.result()
