"""Compositing of tiles, front to back: the Triton kernel and its launch.

Source: docs/rendering.md, section 4.
"""

# ruff: noqa: RUF005  # Triton does not unpack into a tuple

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.rendering.cuda.layout import TILE, Layout
from pansplat.rendering.cuda.lists import TileLists
from pansplat.rendering.cuda.pixels import TilePixels
from pansplat.rendering.cuda.response import (
    PIXELS,
    SATURATED,
    STEP,
    fall_off,
    form_values,
    limit,
    load_numbers,
    load_rows,
    place_pixels,
)
from pansplat.rendering.reference import tile_grid


# fmt: off
@triton.jit(do_not_specialize=["first_tile", "columns", "tiles", "height", "width"])
@no_type_check
def raster_kernel(
    records, entries, starts, busiest, centres, offsets, sums, stops, first_tile, columns, tiles, height, width,
    TINY: tl.constexpr, AXES: tl.constexpr, CHANNELS: tl.constexpr, RECORD: tl.constexpr, PEAK: tl.constexpr,
):
    """One program a tile: sums of weight x (channels, distance, 1), and the entry at which it stopped."""
    local = tl.load(busiest + tl.program_id(0)).to(tl.int64)
    tile = first_tile + local
    pixel = tl.arange(0, PIXELS)
    centre = load_numbers(centres + tile * 2 * AXES, 2 * AXES)
    offset = load_rows(offsets + tile * AXES * PIXELS, PIXELS, pixel, AXES)
    through = tl.full([PIXELS], 1, records.dtype.element_ty)
    totals = ()
    for _ in tl.static_range(CHANNELS + 2):
        totals = totals + (tl.zeros([PIXELS], records.dtype.element_ty),)
    entry = tl.load(starts + local)
    end = tl.load(starts + local + 1)
    while (entry < end) & (tl.max(through, axis=0) > SATURATED):
        step_end = tl.minimum(entry + STEP, end)
        for at in range(entry, step_end):
            record = load_numbers(records + tl.load(entries + at).to(tl.int64) * RECORD, RECORD)
            forms = form_values(record, centre, offset, AXES)[1]
            weight = limit(record[PEAK] * fall_off(forms, record[PEAK - 1], TINY, AXES)[0])
            weight, through = weight * through, through - weight * through
            added = ()
            for c in tl.static_range(CHANNELS + 1):
                added = added + (totals[c] + weight * record[PEAK + 1 + c],)
            totals = added + (totals[CHANNELS + 1] + weight,)
        entry = step_end
    tl.store(stops + local, entry)
    place, plane, inside = place_pixels(tile, pixel, columns, tiles, height, width, CHANNELS + 2)
    for c in tl.static_range(CHANNELS + 2):
        tl.store(sums + place + c * plane, totals[c], mask=inside)
# fmt: on


def raster(
    records: Float[Tensor, "n record"],
    lists: TileLists,
    pixels: TilePixels,
    sums: Float[Tensor, "picture sums height width"],
    layout: Layout,
) -> Int[Tensor, "tile"]:
    """Draw the tiles of `lists` into `sums`, and tell at which entry each tile stopped.

    Args:
        records: see `layout`.
        lists: of some rows of tiles.
        pixels: of all pictures.
        sums: of all pictures; the tiles' pixels are overwritten.
        layout: of the records.
    """
    tiles = len(lists.starts) - 1
    stops = torch.empty(tiles, dtype=torch.int32, device=records.device)
    raster_kernel[(tiles,)](
        records, lists.entries, lists.starts, busiest_first(lists), pixels.centres, pixels.offsets, sums, stops,
        *place(lists, sums), **sizes(records, layout), num_warps=num_warps(layout, 2),
    )  # fmt: skip
    return stops


def busiest_first(lists: TileLists) -> Int[Tensor, "tile"]:
    """The tiles by falling number of entries: the longest must not start last."""
    return torch.argsort(lists.starts.diff(), descending=True, stable=True).int()


def place(lists: TileLists, sums: Float[Tensor, "picture sums height width"]) -> tuple[int, int, int, int, int]:
    """Number of the lists' first tile, columns of tiles, tiles a picture, height, width."""
    height, width = sums.shape[2:]
    rows, columns = tile_grid(height, width, TILE)
    return lists.rows[0] * columns, columns, rows * columns, height, width


def sizes(records: Float[Tensor, "n record"], layout: Layout) -> dict[str, int | float]:
    """What the kernels are compiled for; TINY is the least value of L that counts as such."""
    tiny = torch.finfo(records.dtype).eps ** 0.5
    return dict(TINY=tiny, AXES=layout.axes, CHANNELS=layout.channels, RECORD=layout.record, PEAK=layout.peak)


def num_warps(layout: Layout, usual: int) -> int:
    """Warps a tile: with more channels fewer pixels a thread, so that all sums stay in registers."""
    return usual if layout.channels <= 4 else 4 if layout.channels <= 12 else 8
