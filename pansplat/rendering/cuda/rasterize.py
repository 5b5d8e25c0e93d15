"""Compositing of tiles and its gradients: the Triton kernels and their launches.

Source: docs/rendering.md, sections 3 and 4. An image plane's points have `axes` coordinates: three for the exact kernel
(directions), two for EWA (pixels). Both have as many footprint rows.

A record holds the numbers of one footprint that a tile reads:

    point               axes            the footprint's point, rounded to the records' type
    residual            axes            of that rounding, so that differences to a tile's centre keep their digits
    rows                axes x axes     a, b and, if exact, l
    radial variance     1 if exact
    peak                1
    values              channels + 1    colours, then the distance

A gradient record holds sums over the pixels of one tile:

    rows                axes x axes     gradient of each row's value, times (pixel - point)
    row values          axes            gradient of each row's value
    radial variance     1 if exact
    peak                1
    values              channels + 1

Sizes are fixed, not tuned. Tiles of 16 x 16 pixels match the extent of the lattice's Gaussians (a few pixels), and 256
pixels divide evenly among one, two or four warps. Every warp reads a record by uniform loads, which cost four times an
arithmetic instruction; with four or eight pixels for each thread, arithmetic hides them. A tile is tested for
saturation once in 32 records, because the test synchronises all threads. docs/triton.md describes the backward.
"""
# ruff: noqa: RUF005  # Triton does not unpack into a tuple

from dataclasses import dataclass
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.constants import ALPHA_CUT, ALPHA_CUT_ROUNDING, MAX_ALPHA, TRANSMITTANCE_CUT
from pansplat.rendering.cuda.projection import load_numbers
from pansplat.rendering.cuda.tiling import TILE_SIZE, Instances, TileIntersections, TilePixels
from pansplat.rendering.projection import Footprints
from pansplat.rendering.reference import tile_grid


@dataclass(frozen=True)
class RecordLayout:
    """Sizes of records and gradient records.

    Attributes:
        exact: the exact kernel, or EWA.
        channels: colours, without the distance.
    """

    exact: bool
    channels: int

    @property
    def axes(self) -> int:
        """Coordinates of a point, and rows of a footprint."""
        return 3 if self.exact else 2

    @property
    def peak_column(self) -> int:
        """Column of the peak in a record: before the values."""
        return (2 + self.axes) * self.axes + int(self.exact)

    @property
    def record_size(self) -> int:
        """Numbers in a record."""
        return self.peak_column + 1 + self.channels + 1

    @property
    def gradient_size(self) -> int:
        """Numbers in a gradient record."""
        return self.axes * (self.axes + 1) + int(self.exact) + 1 + self.channels + 1


def pack_records(footprints: Footprints, layout: RecordLayout) -> Float[Tensor, "n record"]:
    """Pack footprints into records, in the type of their rows."""
    dtype = footprints.rows.dtype
    point = footprints.point[:, : layout.axes].double()
    rounded = point.to(dtype)
    rows = footprints.rows[:, : layout.axes, : layout.axes].flatten(1)
    radial_variance = [footprints.radial_variance[:, None]] if layout.exact else []
    residual = (point - rounded.double()).to(dtype)
    parts = (rounded, residual, rows, *radial_variance, footprints.peak[:, None], footprints.values)
    return torch.cat(parts, dim=1).contiguous()


def unpack_gradients(
    gradient: Float[Tensor, "n gradient"], rows: Float[Tensor, "n 3 3"], layout: RecordLayout
) -> Footprints:
    """Compute the gradients of footprints from their rows and from gradient records summed over tiles."""
    axes, channels = layout.axes, layout.channels
    row_sums, value_sums, rest = gradient.split((axes * axes, axes, gradient.shape[1] - axes * (axes + 1)), dim=1)
    grad_rows = torch.zeros_like(rows)
    grad_rows[:, :axes, :axes] = row_sums.view(-1, axes, axes)
    grad_point = -(value_sums.double()[:, :, None] * rows[:, :axes].double()).sum(dim=1)
    radial_variance = rest[:, 0] if layout.exact else torch.zeros_like(rest[:, 0])
    return Footprints(grad_point, grad_rows, radial_variance, rest[:, -channels - 2], rest[:, -channels - 1 :])


_SIDE: tl.constexpr = tl.constexpr(TILE_SIZE)
_PIXELS: tl.constexpr = tl.constexpr(TILE_SIZE * TILE_SIZE)
_STEP: tl.constexpr = tl.constexpr(32)
"""Records between two tests of the transmittance."""

_SATURATED: tl.constexpr = tl.constexpr(TRANSMITTANCE_CUT["triton"])
"""Largest transmittance in a tile at which compositing stops."""

_MAX_ALPHA: tl.constexpr = tl.constexpr(MAX_ALPHA)
_ALPHA_CUT: tl.constexpr = tl.constexpr(ALPHA_CUT * (1 - ALPHA_CUT_ROUNDING))
_MINUS_HALF_LOG2_E: tl.constexpr = tl.constexpr(-0.72134752044448170368)


@triton.jit
@no_type_check
def load_rows(pointer, stride, index, NUM: tl.constexpr):
    """Load NUM blocks at `index`, `stride` numbers apart, as a tuple."""
    rows = ()
    for k in tl.static_range(NUM):
        rows = rows + (tl.load(pointer + k * stride + index),)
    return rows


@triton.jit
@no_type_check
def evaluate_rows(record, centre, offsets, AXES: tl.constexpr):
    """Compute the pixels relative to a footprint's point, and the values of its rows there.

    Args:
        centre: the tile's centre, and the residual of its rounding.
        offsets: pixels relative to the centre.
    """
    delta = ()
    for k in tl.static_range(AXES):
        # Both differences are exact or tiny, so rounding loses no digits of the pixel.
        point = (record[k] - centre[k]) + (record[AXES + k] - centre[AXES + k])
        delta = delta + (offsets[k] - point,)
    rows = ()
    for f in tl.static_range(AXES):
        value = record[(2 + f) * AXES] * delta[0]
        for k in tl.static_range(1, AXES):
            value += record[(2 + f) * AXES + k] * delta[k]
        rows = rows + (value,)
    return delta, rows


@triton.jit
@no_type_check
def evaluate_response(rows, radial_variance, TINY: tl.constexpr, AXES: tl.constexpr):
    """Evaluate exp(-q / 2) at pixels (0 where L <= 0); for the exact kernel also Q, L, and the divisor of Q in q."""
    square = rows[0] * rows[0] + rows[1] * rows[1]
    if AXES == 3:
        ahead = 1 + rows[2]
        # The bound has an effect only near the plane L = 0; it keeps gradients finite there.
        bounded = tl.maximum(ahead, TINY)
        divisor = bounded * bounded + radial_variance * square
        falloff = tl.where(ahead > 0, tl.exp2((square / divisor) * _MINUS_HALF_LOG2_E), 0.0)
        return falloff, square, ahead, divisor
    else:
        return tl.exp2(square * _MINUS_HALF_LOG2_E), square, square, square


@triton.jit
@no_type_check
def clamp_alpha(raw):
    """Limit alpha to 0.99, and set it to 0 below 1/255."""
    return tl.where(raw >= _ALPHA_CUT, tl.minimum(raw, _MAX_ALPHA), 0.0)


@triton.jit
@no_type_check
def locate_pixels(tile, pixel, columns, tiles, height, width, SUMS: tl.constexpr):
    """Locate a tile's pixels: offsets in the first channel of its image plane, the channels' stride, and a mask.

    Args:
        tile: 64-bit, counted over image planes.
        tiles: in an image plane.
    """
    in_plane = tile % tiles
    y = in_plane // columns * _SIDE + pixel // _SIDE
    x = in_plane % columns * _SIDE + pixel % _SIDE
    stride = height.to(tl.int64) * width
    return tile // tiles * SUMS * stride + y.to(tl.int64) * width + x, stride, (y < height) & (x < width)


# fmt: off
@triton.jit(do_not_specialize=["first_tile", "columns", "tiles", "height", "width"])
@no_type_check
def rasterize_kernel(
    records, record_ids, starts, tile_order, centres, offsets, sums, stops, first_tile, columns, tiles, height, width,
    TINY: tl.constexpr, AXES: tl.constexpr, CHANNELS: tl.constexpr, RECORD: tl.constexpr, PEAK: tl.constexpr,
):
    """Write the sums of weight x (channels, distance, 1), and the position of the stop; one program for each tile."""
    local = tl.load(tile_order + tl.program_id(0)).to(tl.int64)
    tile = first_tile + local
    pixel = tl.arange(0, _PIXELS)
    centre = load_numbers(centres + tile * 2 * AXES, 2 * AXES)
    offset = load_rows(offsets + tile * AXES * _PIXELS, _PIXELS, pixel, AXES)
    transmittance = tl.full([_PIXELS], 1, records.dtype.element_ty)
    totals = ()
    for _ in tl.static_range(CHANNELS + 2):
        totals = totals + (tl.zeros([_PIXELS], records.dtype.element_ty),)
    position = tl.load(starts + local)
    end = tl.load(starts + local + 1)
    while (position < end) & (tl.max(transmittance, axis=0) > _SATURATED):
        step_end = tl.minimum(position + _STEP, end)
        for at in range(position, step_end):
            record = load_numbers(records + tl.load(record_ids + at).to(tl.int64) * RECORD, RECORD)
            rows = evaluate_rows(record, centre, offset, AXES)[1]
            weight = clamp_alpha(record[PEAK] * evaluate_response(rows, record[PEAK - 1], TINY, AXES)[0])
            weight, transmittance = weight * transmittance, transmittance - weight * transmittance
            added = ()
            for c in tl.static_range(CHANNELS + 1):
                added = added + (totals[c] + weight * record[PEAK + 1 + c],)
            totals = added + (totals[CHANNELS + 1] + weight,)
        position = step_end
    tl.store(stops + local, position)
    first_channel, stride, inside = locate_pixels(tile, pixel, columns, tiles, height, width, CHANNELS + 2)
    for c in tl.static_range(CHANNELS + 2):
        tl.store(sums + first_channel + c * stride, totals[c], mask=inside)
# fmt: on


def rasterize(
    records: Float[Tensor, "n record"],
    intersections: TileIntersections,
    pixels: TilePixels,
    sums: Float[Tensor, "plane sums height width"],
    layout: RecordLayout,
) -> Int[Tensor, "tile"]:
    """Composite the tiles of `intersections` into `sums`.

    Args:
        intersections: intersections of one band of tile rows.
        pixels: pixels of all planes.
        sums: sums of all planes; the tiles' pixels are overwritten.

    Returns:
        For each tile, the position in `record_ids` at which it stopped.
    """
    tiles = len(intersections.starts) - 1
    stops = torch.empty(tiles, dtype=torch.int32, device=records.device)
    rasterize_kernel[(tiles,)](
        records, intersections.record_ids, intersections.starts, sort_tiles_by_load(intersections), pixels.centres,
        pixels.offsets, sums, stops,
        *launch_geometry(intersections, sums), **launch_constants(records, layout), num_warps=num_warps(layout, 2),
    )  # fmt: skip
    return stops


def sort_tiles_by_load(intersections: TileIntersections) -> Int[Tensor, "tile"]:
    """Sort the tiles by descending number of intersections, so that the slowest start first."""
    return torch.argsort(intersections.starts.diff(), descending=True, stable=True).int()


def launch_geometry(
    intersections: TileIntersections, sums: Float[Tensor, "plane sums height width"]
) -> tuple[int, int, int, int, int]:
    """The band's first tile, columns of tiles, tiles in an image plane, height, width."""
    height, width = sums.shape[2:]
    rows, columns = tile_grid(height, width, TILE_SIZE)
    return intersections.rows[0] * columns, columns, rows * columns, height, width


def launch_constants(records: Float[Tensor, "n record"], layout: RecordLayout) -> dict[str, int | float]:
    """Compile-time constants of the kernels; TINY is the lower bound of L."""
    tiny = torch.finfo(records.dtype).eps ** 0.5
    record = dict(RECORD=layout.record_size, PEAK=layout.peak_column)
    return dict(TINY=tiny, AXES=layout.axes, CHANNELS=layout.channels, **record)


def num_warps(layout: RecordLayout, default: int) -> int:
    """Warps for each tile: with more channels a thread has fewer pixels, so that all sums stay in registers."""
    return default if layout.channels <= 4 else 4 if layout.channels <= 12 else 8


_MANY_TILES = 32
"""An instance with more tiles has its own program in the sum over tiles."""


# fmt: off
@triton.jit(do_not_specialize=["first_tile", "columns", "tiles", "height", "width"])
@no_type_check
def rasterize_backward_kernel(
    records, record_ids, slots, starts, stops, tile_order, centres, offsets, sums, grad_sums, gradients,
    first_tile, columns, tiles, height, width,
    TINY: tl.constexpr, AXES: tl.constexpr, CHANNELS: tl.constexpr, RECORD: tl.constexpr, PEAK: tl.constexpr,
    GRADIENT: tl.constexpr, FIELDS: tl.constexpr,
):
    """Write the gradient record of each intersection of a tile; one program for each tile."""
    local = tl.load(tile_order + tl.program_id(0)).to(tl.int64)
    tile = first_tile + local
    pixel = tl.arange(0, _PIXELS)
    centre = load_numbers(centres + tile * 2 * AXES, 2 * AXES)
    offset = load_rows(offsets + tile * AXES * _PIXELS, _PIXELS, pixel, AXES)
    first_channel, stride, inside = locate_pixels(tile, pixel, columns, tiles, height, width, CHANNELS + 2)
    grad = ()
    behind = tl.zeros([_PIXELS], records.dtype.element_ty)  # gradient x (the sums behind the record)
    for c in tl.static_range(CHANNELS + 2):
        grad_plane = tl.load(grad_sums + first_channel + c * stride, mask=inside, other=0.0)
        behind += grad_plane * tl.load(sums + first_channel + c * stride, mask=inside, other=0.0)
        grad = grad + (grad_plane,)
    transmittance = tl.full([_PIXELS], 1, records.dtype.element_ty)
    field = tl.arange(0, FIELDS)
    for at in range(tl.load(starts + local), tl.load(stops + local)):
        record = load_numbers(records + tl.load(record_ids + at).to(tl.int64) * RECORD, RECORD)
        delta, rows = evaluate_rows(record, centre, offset, AXES)
        falloff, square, ahead, divisor = evaluate_response(rows, record[PEAK - 1], TINY, AXES)
        raw = record[PEAK] * falloff
        alpha = clamp_alpha(raw)
        weight = alpha * transmittance
        grad_weight = grad[CHANNELS + 1]
        for c in tl.static_range(CHANNELS + 1):
            grad_weight += grad[c] * record[PEAK + 1 + c]
        behind -= weight * grad_weight
        grad_alpha = transmittance * grad_weight - behind / (1 - alpha)
        transmittance = transmittance - weight
        grad_peak = tl.where((alpha > 0) & (raw <= _MAX_ALPHA), grad_alpha * falloff, 0.0)
        grad_q = -0.5 * record[PEAK] * grad_peak
        if AXES == 3:
            grad_square = grad_q / divisor  # gradient of q = Q / divisor, for a fixed divisor
            grad_divisor = -grad_square * (square / divisor)
            bounded = tl.maximum(ahead, TINY)
            grad_ahead = tl.where(ahead >= TINY, 2 * bounded * grad_divisor, 0.0)
            grad_square += record[PEAK - 1] * grad_divisor
            grad_rows = (2 * grad_square * rows[0], 2 * grad_square * rows[1], grad_ahead)
            numbers = sum_row_gradients(grad_rows, delta, AXES) + (tl.sum(grad_divisor * square, axis=0),)
        else:
            numbers = sum_row_gradients((2 * grad_q * rows[0], 2 * grad_q * rows[1]), delta, AXES)
        numbers = numbers + (tl.sum(grad_peak, axis=0),)
        for c in tl.static_range(CHANNELS + 1):
            numbers = numbers + (tl.sum(weight * grad[c], axis=0),)
        line = tl.zeros([FIELDS], records.dtype.element_ty)
        for k in tl.static_range(GRADIENT):
            line = tl.where(field == k, numbers[k], line)
        tl.store(gradients + tl.load(slots + at).to(tl.int64) * GRADIENT + field, line, mask=field < GRADIENT)
# fmt: on


@triton.jit
@no_type_check
def sum_row_gradients(grad_rows, delta, AXES: tl.constexpr):
    """Sum gradient x (pixel - point) over pixels, row by row, then the gradients alone."""
    sums = ()
    for f in tl.static_range(AXES):
        for k in tl.static_range(AXES):
            sums = sums + (tl.sum(grad_rows[f] * delta[k], axis=0),)
    for f in tl.static_range(AXES):
        sums = sums + (tl.sum(grad_rows[f], axis=0),)
    return sums


# fmt: off
@triton.jit(do_not_specialize=["num"])
@no_type_check
def sum_gradients_kernel(
    gradients, ends, instances, totals, num,
    GRADIENT: tl.constexpr, FIELDS: tl.constexpr, GROUP: tl.constexpr, AT_ONCE: tl.constexpr,
):
    """Add the gradient records of an instance's tiles to its total."""
    group = tl.program_id(0) * GROUP + tl.arange(0, GROUP)
    instance = tl.load(instances + group, mask=group < num, other=0).to(tl.int64)
    first = tl.load(ends + instance - 1, mask=(group < num) & (instance > 0), other=0)
    count = tl.load(ends + instance, mask=group < num, other=0) - first
    field = tl.arange(0, FIELDS)[None, None, :]
    step = tl.arange(0, AT_ONCE)[None, :, None]
    total = tl.zeros([GROUP, FIELDS], totals.dtype.element_ty)
    for low in range(0, tl.max(count, axis=0), AT_ONCE):
        row = (first[:, None, None] + low + step) * GRADIENT + field
        mask = (low + step < count[:, None, None]) & (field < GRADIENT)
        total += tl.sum(tl.load(gradients + row, mask=mask, other=0.0), axis=1)
    field = tl.arange(0, FIELDS)[None, :]
    place = totals + instance[:, None] * GRADIENT + field
    mask = (group < num)[:, None] & (field < GRADIENT)
    tl.store(place, tl.load(place, mask=mask, other=0.0) + total, mask=mask)
# fmt: on


def rasterize_backward(
    records: Float[Tensor, "n record"],
    intersections: TileIntersections,
    stops: Int[Tensor, "tile"],
    pixels: TilePixels,
    sums: Float[Tensor, "plane sums height width"],
    grad_sums: Float[Tensor, "plane sums height width"],
    layout: RecordLayout,
    totals: Float[Tensor, "m gradient"],
) -> None:
    """Add the gradients from the tiles of `intersections` to each instance's total.

    Args:
        intersections: intersections of one band of tile rows.
        stops: stop of each tile, see `rasterize`.
        pixels: pixels of all planes.
        sums: result of forward, all planes.
        totals: totals of all instances.
    """
    tiles, num = len(intersections.starts) - 1, layout.gradient_size
    fields = triton.next_power_of_2(num)
    gradients = records.new_zeros(len(intersections.record_ids), num)  # 0 where forward stopped early
    rasterize_backward_kernel[(tiles,)](
        records, intersections.record_ids, intersections.slots, intersections.starts, stops,
        sort_tiles_by_load(intersections), pixels.centres, pixels.offsets, sums, grad_sums, gradients,
        *launch_geometry(intersections, sums), **launch_constants(records, layout), GRADIENT=num, FIELDS=fields,
        num_warps=num_warps(layout, 1),
    )  # fmt: skip
    counts = intersections.ends.diff(prepend=intersections.ends.new_zeros(1))
    few = torch.nonzero((counts > 0) & (counts <= _MANY_TILES))[:, 0].int()
    many = torch.nonzero(counts > _MANY_TILES)[:, 0].int()
    for selected, group, at_once in ((few, 16, 1), (many, 1, 16)):
        if len(selected):
            grid = (triton.cdiv(len(selected), group),)
            sum_gradients_kernel[grid](
                gradients, intersections.ends, selected, totals, len(selected),
                GRADIENT=num, FIELDS=fields, GROUP=group, AT_ONCE=at_once, num_warps=2,
            )  # fmt: skip


def sum_by_record(totals: Float[Tensor, "m gradient"], instances: Instances, num: int) -> Float[Tensor, "n gradient"]:
    """Sum the gradients of each record over image planes; a record has at most one instance on a plane."""
    gradient = totals.new_zeros(num, totals.shape[1])
    for records, total in zip(
        instances.records.long().split(instances.planes), totals.split(instances.planes), strict=True
    ):
        gradient[records] = gradient[records] + total
    return gradient
