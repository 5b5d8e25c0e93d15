"""Gradients of the compositing: rows of sums for each Gaussian in each tile, then their sums over tiles.

Source: docs/rendering.md, section 4. Tiles are walked front to back: what lies behind an entry is the total less what
has been passed, so nothing is divided by a transmittance. No atomics: every entry writes its own row, rows of one
Gaussian lie together and are summed in a fixed order, so that gradients repeat bit for bit.
"""

# ruff: noqa: RUF005  # Triton does not unpack into a tuple

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.rendering.cuda.layout import Layout
from pansplat.rendering.cuda.lists import Instances, TileLists
from pansplat.rendering.cuda.pixels import TilePixels
from pansplat.rendering.cuda.raster import busiest_first, num_warps, place, sizes
from pansplat.rendering.cuda.response import (
    LARGEST_ALPHA,
    PIXELS,
    fall_off,
    form_values,
    limit,
    load_numbers,
    load_rows,
    place_pixels,
)

_MANY = 32
"""Tiles beyond which one instance's rows are summed by a program of its own."""


# fmt: off
@triton.jit(do_not_specialize=["first_tile", "columns", "tiles", "height", "width"])
@no_type_check
def backward_kernel(
    records, entries, slots, starts, stops, busiest, centres, offsets, sums, grad_sums, rows,
    first_tile, columns, tiles, height, width,
    TINY: tl.constexpr, AXES: tl.constexpr, CHANNELS: tl.constexpr, RECORD: tl.constexpr, PEAK: tl.constexpr,
    GRADIENT: tl.constexpr, FIELDS: tl.constexpr,
):
    """One program a tile: writes the row of gradients of each of its entries."""
    local = tl.load(busiest + tl.program_id(0)).to(tl.int64)
    tile = first_tile + local
    pixel = tl.arange(0, PIXELS)
    centre = load_numbers(centres + tile * 2 * AXES, 2 * AXES)
    offset = load_rows(offsets + tile * AXES * PIXELS, PIXELS, pixel, AXES)
    at_pixel, plane, inside = place_pixels(tile, pixel, columns, tiles, height, width, CHANNELS + 2)
    grad = ()
    behind = tl.zeros([PIXELS], records.dtype.element_ty)  # slope x all that is still behind
    for c in tl.static_range(CHANNELS + 2):
        slope = tl.load(grad_sums + at_pixel + c * plane, mask=inside, other=0.0)
        behind += slope * tl.load(sums + at_pixel + c * plane, mask=inside, other=0.0)
        grad = grad + (slope,)
    through = tl.full([PIXELS], 1, records.dtype.element_ty)
    field = tl.arange(0, FIELDS)
    for at in range(tl.load(starts + local), tl.load(stops + local)):
        record = load_numbers(records + tl.load(entries + at).to(tl.int64) * RECORD, RECORD)
        delta, forms = form_values(record, centre, offset, AXES)
        falloff, spread, ahead, divisor = fall_off(forms, record[PEAK - 1], TINY, AXES)
        raw = record[PEAK] * falloff
        alpha = limit(raw)
        weight = alpha * through
        by_weight = grad[CHANNELS + 1]
        for c in tl.static_range(CHANNELS + 1):
            by_weight += grad[c] * record[PEAK + 1 + c]
        behind -= weight * by_weight
        by_alpha = through * by_weight - behind / (1 - alpha)
        through = through - weight
        by_peak = tl.where((alpha > 0) & (raw <= LARGEST_ALPHA), by_alpha * falloff, 0.0)
        by_q = -0.5 * record[PEAK] * by_peak
        if AXES == 3:
            by_spread = by_q / divisor  # of q = Q / D before D is seen to depend on Q
            by_divisor = -by_spread * (spread / divisor)
            bounded = tl.maximum(ahead, TINY)
            by_ahead = tl.where(ahead >= TINY, 2 * bounded * by_divisor, 0.0)
            by_spread += record[PEAK - 1] * by_divisor
            by_form = (2 * by_spread * forms[0], 2 * by_spread * forms[1], by_ahead)
            sums_of = moments(by_form, delta, AXES) + (tl.sum(by_divisor * spread, axis=0),)
        else:
            sums_of = moments((2 * by_q * forms[0], 2 * by_q * forms[1]), delta, AXES)
        sums_of = sums_of + (tl.sum(by_peak, axis=0),)
        for c in tl.static_range(CHANNELS + 1):
            sums_of = sums_of + (tl.sum(weight * grad[c], axis=0),)
        row = tl.zeros([FIELDS], records.dtype.element_ty)
        for k in tl.static_range(GRADIENT):
            row = tl.where(field == k, sums_of[k], row)
        tl.store(rows + tl.load(slots + at).to(tl.int64) * GRADIENT + field, row, mask=field < GRADIENT)
# fmt: on


@triton.jit
@no_type_check
def moments(slopes, delta, AXES: tl.constexpr):
    """Sums over pixels of slope x (pixel - point), form by form, then of the slopes."""
    found = ()
    for f in tl.static_range(AXES):
        for k in tl.static_range(AXES):
            found = found + (tl.sum(slopes[f] * delta[k], axis=0),)
    for f in tl.static_range(AXES):
        found = found + (tl.sum(slopes[f], axis=0),)
    return found


@triton.jit(do_not_specialize=["num"])
@no_type_check
def reduce_kernel(
    rows,
    ends,
    which,
    totals,
    num,
    GRADIENT: tl.constexpr,
    FIELDS: tl.constexpr,
    GROUP: tl.constexpr,
    AT_ONCE: tl.constexpr,
):
    """Adds to each instance's total the rows of its tiles."""
    group = tl.program_id(0) * GROUP + tl.arange(0, GROUP)
    instance = tl.load(which + group, mask=group < num, other=0).to(tl.int64)
    first = tl.load(ends + instance - 1, mask=(group < num) & (instance > 0), other=0)
    count = tl.load(ends + instance, mask=group < num, other=0) - first
    field = tl.arange(0, FIELDS)[None, None, :]
    step = tl.arange(0, AT_ONCE)[None, :, None]
    total = tl.zeros([GROUP, FIELDS], totals.dtype.element_ty)
    for low in range(0, tl.max(count, axis=0), AT_ONCE):
        row = (first[:, None, None] + low + step) * GRADIENT + field
        there = (low + step < count[:, None, None]) & (field < GRADIENT)
        total += tl.sum(tl.load(rows + row, mask=there, other=0.0), axis=1)
    field = tl.arange(0, FIELDS)[None, :]
    place = totals + instance[:, None] * GRADIENT + field
    there = (group < num)[:, None] & (field < GRADIENT)
    tl.store(place, tl.load(place, mask=there, other=0.0) + total, mask=there)


def raster_backward(
    records: Float[Tensor, "n record"],
    lists: TileLists,
    stops: Int[Tensor, "tile"],
    pixels: TilePixels,
    sums: Float[Tensor, "picture sums height width"],
    grad_sums: Float[Tensor, "picture sums height width"],
    layout: Layout,
    totals: Float[Tensor, "m gradient"],
) -> None:
    """Add to each instance's total the gradients from the tiles of `lists`.

    Args:
        records: see `layout`.
        lists: of some rows of tiles.
        stops: at which entry forward stopped, for each tile.
        pixels: of all pictures.
        sums: what forward drew.
        grad_sums: slopes of the loss by `sums`.
        layout: of the records.
        totals: of all instances.
    """
    tiles, num = len(lists.starts) - 1, layout.gradient
    fields = triton.next_power_of_2(num)
    rows = records.new_zeros(len(lists.entries), num)  # tiles that stopped early leave theirs at 0
    backward_kernel[(tiles,)](
        records, lists.entries, lists.slots, lists.starts, stops, busiest_first(lists), pixels.centres, pixels.offsets,
        sums, grad_sums, rows, *place(lists, sums), **sizes(records, layout), GRADIENT=num, FIELDS=fields,
        num_warps=num_warps(layout, 1),
    )  # fmt: skip
    counts = lists.ends.diff(prepend=lists.ends.new_zeros(1))
    few = torch.nonzero((counts > 0) & (counts <= _MANY))[:, 0].int()
    many = torch.nonzero(counts > _MANY)[:, 0].int()
    for which, group, at_once in ((few, 16, 1), (many, 1, 16)):
        if len(which):
            grid = (triton.cdiv(len(which), group),)
            reduce_kernel[grid](
                rows, lists.ends, which, totals, len(which),
                GRADIENT=num, FIELDS=fields, GROUP=group, AT_ONCE=at_once, num_warps=2,
            )  # fmt: skip


def by_record(totals: Float[Tensor, "m gradient"], instances: Instances, num: int) -> Float[Tensor, "n gradient"]:
    """Each record's gradient: the sum over the pictures it is seen on, which name it once each."""
    gradient = totals.new_zeros(num, totals.shape[1])
    for records, total in zip(
        instances.records.long().split(instances.pictures), totals.split(instances.pictures), strict=True
    ):
        gradient[records] = gradient[records] + total
    return gradient
