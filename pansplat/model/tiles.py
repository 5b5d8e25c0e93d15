"""Lattice points, panorama tiles, and windows of maps around the tiles.

A tile is one cell of an N x N grid over the panorama. On the map of each level it is a window of whole pixels, which is
expanded by a margin. Outside the map, columns wrap and rows continue over the pole, half a turn away. The official code
has zeros outside the rows, repeats the last column at the seam when it resizes, and has too narrow margins
(docs/paper.md, P6, P7, T5).

Source: PanSplat, sections 3.3 and 3.4.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Integer
from torch import Tensor
from torch.nn import functional

from pansplat.geometry.equirect import pad_equirect, uv_from_directions
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size, official_fibonacci_uv
from pansplat.networks.layers import Compat

_MIN_COS_LATITUDE = 0.01  # limits the width of a pixel in longitude at the poles


@functools.lru_cache(maxsize=16)
@torch.inference_mode(False)  # calls with gradients also use the cached tensor
def make_lattice_uv(height: int, *, exact: bool = True) -> Float[Tensor, "n 2"]:
    """Normalised panorama coordinates of a level's lattice points, float64.

    A Fibonacci lattice covers the sphere evenly and starts at the bottom pole. The result is cached: do not change it
    in place.

    Args:
        height: rows of the level's map.
        exact: compute in float64; otherwise as the official code does, in float32.

    Source: PanSplat, section 3.3.
    """
    count = lattice_size(2 * height)
    return uv_from_directions(fibonacci_directions(count)) if exact else official_fibonacci_uv(count)


def move_points(uv: Float[Tensor, "n 2"], raw_offsets: Float[Tensor, "n 2"], height: int) -> Float[Tensor, "n 2"]:
    """Move points by at most half a map pixel in each direction; they may cross the seam or a pole.

    A pixel has one arc length at all latitudes, so it is wider in longitude near the poles.
    """
    width = 2 * height * torch.sin(uv[:, 1] * math.pi).clamp_min(_MIN_COS_LATITUDE)
    pixel = torch.stack((1 / width, torch.full_like(width, 1 / height)), dim=-1)
    return uv.to(raw_offsets) + (torch.sigmoid(raw_offsets) - 0.5) * pixel.to(raw_offsets)


@dataclass(frozen=True)
class Window:
    """A rectangle of map pixels, which may extend outside the map."""

    top: int
    left: int
    height: int
    width: int

    def expand(self, margin: int) -> Window:
        """The window with a margin on all four sides."""
        return Window(self.top - margin, self.left - margin, self.height + 2 * margin, self.width + 2 * margin)


@dataclass(frozen=True)
class Tile:
    """One cell of a `grid` x `grid` division of the panorama."""

    row: int
    column: int
    grid: int

    def window(self, height: int) -> Window:
        """The tile's pixels on a map of `height` x `2 height`, without margin."""
        rows, columns = height // self.grid, 2 * height // self.grid
        return Window(self.row * rows, self.column * columns, rows, columns)

    def contains(self, uv: Float[Tensor, "n 2"]) -> Bool[Tensor, "n"]:
        """Whether each point is in this tile; every point is in exactly one tile of the grid."""
        cell = (uv * self.grid).floor().clamp(0, self.grid - 1)
        return (cell[:, 0] == self.column) & (cell[:, 1] == self.row)


@dataclass(frozen=True)
class Margins:
    """Margins around a tile, in map pixels: of the input of a level's convolutions, and of their output.

    Each convolution reduces the margin by one pixel. For three convolutions, 7 and 4 are the smallest margins that the
    next level, twice as fine, can also have. In the official code the output has the margin of the input, but zero
    padding changes its outer pixels.
    """

    input: int
    output: int

    @staticmethod
    def of(layers: int, compat: Compat, *, chained: bool) -> Margins:
        """Margins for a number of convolutions; `chained`: a finer level reads the output."""
        if compat == "official":
            return Margins(layers, layers)
        output = layers + 1 if chained else 1
        return Margins(output + layers, output)


def make_tiles(grid: int) -> list[Tile]:
    """All tiles of a grid, in row-major order."""
    return [Tile(row, column, grid) for row in range(grid) for column in range(grid)]


def crop_window(
    source: Float[Tensor, "channel h w"], height: int, window: Window, compat: Compat
) -> Float[Tensor, "channel rows columns"]:
    """Crop a window of a map resized to `height` x `2 height`, bilinearly and without antialiasing.

    Only the window is resized, so the memory does not depend on the size of the panorama.
    """
    exact = compat == "fixed"
    rows = torch.arange(window.top, window.top + window.height)
    columns = torch.arange(window.left, window.left + window.width)
    if not exact:
        columns = columns.remainder(2 * height)
    before_y, after_y, weight_y = _find_neighbours(rows, source.shape[1], height, exact)
    before_x, after_x, weight_x = _find_neighbours(columns, source.shape[2], 2 * height, exact)
    if exact:
        edges = (before_y[0], before_x[0], source.shape[1] - 1 - after_y[-1], source.shape[2] - 1 - after_x[-1])
        margin = max(0, -min(int(edge) for edge in edges))
        source = pad_equirect(source, margin, "sphere")
        before_y, after_y, before_x, after_x = (i + margin for i in (before_y, after_y, before_x, after_x))
    resized = _interpolate(source, before_y, after_y, weight_y, dim=1)
    resized = _interpolate(resized, before_x, after_x, weight_x, dim=2)
    if exact:
        return resized
    inside = (rows >= 0) & (rows < height)
    return resized if bool(inside.all()) else resized * inside.to(resized)[:, None]


def sample_window(
    window_map: Float[Tensor, "channel rows columns"], window: Window, height: int, uv: Float[Tensor, "n 2"]
) -> Float[Tensor, "n channel"]:
    """Sample a map bilinearly at points inside a window.

    Args:
        window_map: the part of the map inside `window`.
        height: rows of the whole map.
    """
    x = uv[:, 0] * (2 * height) - 0.5 - window.left
    y = uv[:, 1] * height - 0.5 - window.top
    x, y = x.clamp(0, window.width - 1), y.clamp(0, window.height - 1)
    left, top = x.floor().clamp(max=window.width - 2), y.floor().clamp(max=window.height - 2)
    across, down = x - left, y - top
    corner = (top * window.width + left).long()
    corners = torch.stack((corner, corner + 1, corner + window.width, corner + window.width + 1), dim=-1)
    weights = torch.stack(
        ((1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down), dim=-1
    ).to(window_map)
    pixels = window_map.permute(1, 2, 0).reshape(window.height * window.width, -1)
    # embedding_bag sums weighted rows in one pass; on a CPU this is 7 times faster than a sum of four gathered copies.
    return functional.embedding_bag(corners.to(pixels.device), pixels, mode="sum", per_sample_weights=weights)


def sample_panorama(
    source: Float[Tensor, "channel h w"], uv: Float[Tensor, "n 2"], compat: Compat
) -> Float[Tensor, "n channel"]:
    """Sample a whole map bilinearly; "official" repeats the last column at the seam (docs/paper.md, T7)."""
    height = source.shape[-2]
    window = Window(0, 0, height, 2 * height)
    if compat == "fixed":
        window = window.expand(1)
    return sample_window(crop_window(source, height, window, compat), window, height, uv)


def _find_neighbours(
    index: Integer[Tensor, "n"], source_size: int, size: int, exact: bool
) -> tuple[Integer[Tensor, "n"], Integer[Tensor, "n"], Float[Tensor, "n"]]:
    """Find the two source pixels around each target pixel's centre, and the weight of the second."""
    position = (index.double() + 0.5) * (source_size / size) - 0.5
    if not exact:
        position = position.clamp(0, source_size - 1)
    before = position.floor()
    weight = position - before
    after = torch.where(weight > 0, before + 1, before)
    return before.long(), after.long(), weight


def _interpolate(
    source: Float[Tensor, "channel h w"],
    before: Integer[Tensor, "n"],
    after: Integer[Tensor, "n"],
    weight: Float[Tensor, "n"],
    dim: int,
) -> Float[Tensor, "channel rows columns"]:
    """Interpolate source pixels along one axis; return a slice if all weights are 0 and the pixels are adjacent."""
    if bool((weight == 0).all()):
        first, last = int(before[0]), int(before[-1])
        if last - first + 1 == len(before) and bool((before.diff() == 1).all()):
            return source.narrow(dim, first, len(before))
        return source.index_select(dim, before.to(source.device))
    shape = [1, 1, 1]
    shape[dim] = -1
    first, second = (source.index_select(dim, i.to(source.device)) for i in (before, after))
    return torch.lerp(first, second, weight.to(source).reshape(shape))
