"""What one Gaussian adds to the pixels of a tile: the device code that forward and backward share.

Source: docs/rendering.md, sections 3 and 4; `layout` has the fields of a record.

Sizes are fixed, not tuned. Tiles of 16 x 16 pixels match the extent of the lattice's Gaussians (a few pixels) and the
256 pixels divide evenly among one, two or four warps. Every warp reads a record by uniform loads, which cost four
times an arithmetic instruction: with four or eight pixels a thread they hide behind the arithmetic. Whether a tile is
saturated is asked once in 32 records, because the answer needs all its threads.
"""

# ruff: noqa: RUF005  # Triton does not unpack into a tuple

from typing import no_type_check

import triton
import triton.language as tl

from pansplat.constants import ALPHA_CUT, ALPHA_CUT_ROUNDING, MAX_ALPHA, TRANSMITTANCE_CUT
from pansplat.rendering.cuda.layout import TILE

SIDE: tl.constexpr = tl.constexpr(TILE)
PIXELS: tl.constexpr = tl.constexpr(TILE * TILE)
STEP: tl.constexpr = tl.constexpr(32)
"""Records between two looks at the transmittance."""

SATURATED: tl.constexpr = tl.constexpr(TRANSMITTANCE_CUT["triton"])
"""Transmittance of a tile's clearest pixel at which what lies behind is left out."""

LARGEST_ALPHA: tl.constexpr = tl.constexpr(MAX_ALPHA)
LEAST_ALPHA: tl.constexpr = tl.constexpr(ALPHA_CUT * (1 - ALPHA_CUT_ROUNDING))
_BITS: tl.constexpr = tl.constexpr(-0.72134752044448170368)  # exp(-q / 2) = 2^(q times this)


@triton.jit
@no_type_check
def load_numbers(pointer, NUM: tl.constexpr):
    """NUM scalars in a row, as a tuple."""
    numbers = ()
    for k in tl.static_range(NUM):
        numbers = numbers + (tl.load(pointer + k),)
    return numbers


@triton.jit
@no_type_check
def load_rows(pointer, stride, index, NUM: tl.constexpr):
    """NUM blocks at `index`, one row of `stride` numbers apart, as a tuple."""
    rows = ()
    for k in tl.static_range(NUM):
        rows = rows + (tl.load(pointer + k * stride + index),)
    return rows


@triton.jit
@no_type_check
def form_values(record, centre, offsets, AXES: tl.constexpr):
    """The pixels relative to a Gaussian's point, and its linear forms there.

    Args:
        record: see `layout`.
        centre: of the tile, and what rounding left of it.
        offsets: pixels relative to the centre.
    """
    delta = ()
    for k in tl.static_range(AXES):
        # Both differences are exact or tiny: no digits of the pixel are lost.
        point = (record[k] - centre[k]) + (record[AXES + k] - centre[AXES + k])
        delta = delta + (offsets[k] - point,)
    forms = ()
    for f in tl.static_range(AXES):
        value = record[(2 + f) * AXES] * delta[0]
        for k in tl.static_range(1, AXES):
            value += record[(2 + f) * AXES + k] * delta[k]
        forms = forms + (value,)
    return delta, forms


@triton.jit
@no_type_check
def fall_off(forms, along, TINY: tl.constexpr, AXES: tl.constexpr):
    """exp(-q / 2) at pixels (0 behind the eye); for the exact kernel also Q, L and the divisor in q = Q / divisor."""
    spread = forms[0] * forms[0] + forms[1] * forms[1]
    if AXES == 3:
        ahead = 1 + forms[2]
        # The bound only matters within a hair of the plane through the eye; it keeps slopes finite there.
        bounded = tl.maximum(ahead, TINY)
        divisor = bounded * bounded + along * spread
        falloff = tl.where(ahead > 0, tl.exp2((spread / divisor) * _BITS), 0.0)
        return falloff, spread, ahead, divisor
    else:
        return tl.exp2(spread * _BITS), spread, spread, spread


@triton.jit
@no_type_check
def limit(raw):
    """An opacity at most 0.99, and 0 below 1/255."""
    return tl.where(raw >= LEAST_ALPHA, tl.minimum(raw, LARGEST_ALPHA), 0.0)


@triton.jit
@no_type_check
def place_pixels(tile, pixel, columns, tiles, height, width, PLANES: tl.constexpr):
    """Where a tile's pixels are in the first of its picture's planes, a plane's size, which are in the picture.

    Args:
        tile: 64-bit, counted over pictures.
        tiles: a picture.
    """
    in_picture = tile % tiles
    y = in_picture // columns * SIDE + pixel // SIDE
    x = in_picture % columns * SIDE + pixel % SIDE
    plane = height.to(tl.int64) * width
    return tile // tiles * PLANES * plane + y.to(tl.int64) * width + x, plane, (y < height) & (x < width)
