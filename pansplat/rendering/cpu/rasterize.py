"""What a tile needs before it is drawn: its pixels, and its Gaussians' forms relative to its middle.

A ray's length is free. So a tile takes its pixels and Gaussians where their rays meet the plane that touches the sphere
in its middle, and forms have two components. Where some are too far from the middle for that, they have three.

Forms are kept by columns (`FORMS` x `CHUNK_SIZE`), for a chunk of Gaussians that fits the first cache: the set-up then
works on eight Gaussians at once, and drawing spreads one number over eight pixels.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pansplat.constants import ALPHA_CUT, MAX_ALPHA, TRANSMITTANCE_CUT
from pansplat.rendering.cpu.projection import dot, tangent_frame
from pansplat.rendering.cpu.records import EQUIRECT_RAYS, PIXEL_CENTRES, RECORD_SIZE, TILE_SIZE, PixelTables
from pansplat.rendering.cpu.runtime import Workspace, inline_kernel_no_refcount, kernel, parallel_for
from pansplat.rendering.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
    copy_four,
    exp2,
    join_halves,
    list_set_bits,
    load,
    load_broadcast,
    load_scalar,
    load_transposed,
    multiply_add,
    popcount,
    prefetch,
    select,
    store,
    store_scalar,
)
from pansplat.rendering.cpu.tiling import split_tiles

# Compositing of tiles on the CPU, forward.
#
# Source: docs/rendering.md, section 4. A tile is drawn in chunks of Gaussians. Each chunk is first listed by blocks of
# 4x2 pixels, one vector each; then each block takes its list front to back, with the transmittance and the sums in
# registers. That leaves no branch inside that the processor could mistake.


BLOCK_WIDTH = 4
BLOCK_HEIGHT = LANES // BLOCK_WIDTH
ACROSS = TILE_SIZE // BLOCK_WIDTH
DOWN = TILE_SIZE // BLOCK_HEIGHT
BLOCKS = ACROSS * DOWN
PIXELS = TILE_SIZE * TILE_SIZE
CHUNK_SIZE = 256  # Gaussians
WORDS = CHUNK_SIZE // 64
ROWS = ACROSS + 1  # where the rows' edges begin, among a word's
EDGES = ROWS + DOWN + 1
_SHARE = CHUNK_SIZE // BLOCKS  # Gaussians of the next chunk that are asked for at each block

# Rows of the forms.
A, B, L = 0, 2, 4  # a, b, l: two components each
MIDDLE = 6  # the Gaussian's point: two components
ALONG_ROW, LEVEL_ROW = 8, 9
THIRD = 10  # third components of a, b, l and the point; only written and read where a tile or a Gaussian is wide
FORMS = 14

CUT = math.log2(ALPHA_CUT)  # least power: log2 of alpha
NOTHING = -1000.0  # a power far below
MOST = MAX_ALPHA
CLOSED = TRANSMITTANCE_CUT["numba"]
"""A pixel takes nothing more once its transmittance is at or below this."""
_MARGIN = 0.1
MIN_PLANAR_COSINE = 0.5  # least cosine of the angle from a tile's middle at which forms have two components
FEW = 4  # values, handled together: RGB and the distance
PLACE = 15  # numbers that place a tile: see `place_tile`


@inline_kernel_no_refcount
def point_of(kind, columns, rows, rotation, x, y):  # type: ignore[no-untyped-def]
    """The point of pixel (x, y) that Gaussians are measured against: a unit direction, or the pixel's centre."""
    if kind == EQUIRECT_RAYS:
        cosine = rows[y, 1]
        return cosine * columns[x, 0], rows[y, 0], cosine * columns[x, 1]
    right, down = columns[x, 0], rows[y, 0]
    if kind == PIXEL_CENTRES:
        return right, down, 0.0
    scale = 1 / math.sqrt(right * right + down * down + 1)
    right, down = right * scale, down * scale
    return (
        rotation[0, 0] * right + rotation[0, 1] * down + rotation[0, 2] * scale,
        rotation[1, 0] * right + rotation[1, 1] * down + rotation[1, 2] * scale,
        rotation[2, 0] * right + rotation[2, 1] * down + rotation[2, 2] * scale,
    )


@inline_kernel_no_refcount
def place_tile(kind, columns, rows, rotation, left, top, centre, place):  # type: ignore[no-untyped-def]
    """Find a tile's middle and axes.

    Args:
        kind, columns, rows, rotation: of the picture's PixelTables.
        left, top: pixel of the tile's corner.
        centre: (3) float64, written: the middle.
        place: (PLACE), written: the middle, rounded, and the rest; two axes across, and the middle once more or, for
            the classic kernel, zeros.

    Returns:
        Whether some of its pixels are too far from the middle for two components.
    """
    least = 1.0  # cosine of a pixel's angle from the middle; those in the corners are the farthest
    for corner in range(-1, 4):
        x, y = left + TILE_SIZE // 2, top + TILE_SIZE // 2
        if corner >= 0:
            x, y = left + corner % 2 * (TILE_SIZE - 1), top + corner // 2 * (TILE_SIZE - 1)
        x, y = min(x, len(columns) - 1), min(y, len(rows) - 1)
        d_x, d_y, d_z = point_of(kind, columns, rows, rotation, x, y)
        if corner < 0:
            centre[0], centre[1], centre[2] = d_x, d_y, d_z
        elif kind != PIXEL_CENTRES:
            least = min(least, dot(centre[0], centre[1], centre[2], d_x, d_y, d_z))
    axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    if kind != PIXEL_CENTRES:
        axes = tangent_frame(centre[0], centre[1], centre[2])
    for axis in range(3):
        place[axis] = np.float32(centre[axis])
        place[3 + axis] = np.float32(centre[axis] - np.float64(place[axis]))
        place[12 + axis] = np.float32(0 if kind == PIXEL_CENTRES else centre[axis])
    for axis in range(6):
        place[6 + axis] = np.float32(axes[axis])
    return least < MIN_PLANAR_COSINE


@inline_kernel_no_refcount
def place_pixels(  # type: ignore[no-untyped-def]
    kind, columns, rows, rotation, left, top, centre, place, wide, offsets
):
    """Fill in a tile's pixels as the forms take them, block by block.

    Args:
        kind, columns, rows, rotation, left, top, centre, place: as in `place_tile`.
        wide: whether in three components, offsets from the middle along the axes; else where the pixels' rays meet the
            plane that touches the sphere in the middle.
        offsets: (3 PIXELS), written.
    """
    width, height = len(columns), len(rows)
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        d_x, d_y, d_z = point_of(kind, columns, rows, rotation, min(x, width - 1), min(y, height - 1))
        d_x, d_y, d_z = d_x - centre[0], d_y - centre[1], d_z - centre[2]
        ahead = place[12] * d_x + place[13] * d_y + place[14] * d_z
        scale = 1.0 if wide else 1 / (1 + ahead)
        offsets[pixel] = np.float32((place[6] * d_x + place[7] * d_y + place[8] * d_z) * scale)
        offsets[PIXELS + pixel] = np.float32((place[9] * d_x + place[10] * d_y + place[11] * d_z) * scale)
        offsets[2 * PIXELS + pixel] = np.float32(ahead)


@inline_kernel_no_refcount
def open_pixels(columns, rows, left, top, through):  # type: ignore[no-untyped-def]
    """Transmittances before anything is drawn: pixels off the picture start out closed."""
    width, height = len(columns), len(rows)
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        through[pixel] = np.float32(1 if x < width and y < height else 0)


@inline_kernel_no_refcount
def ask_ahead(records, values, intersections, block, first):  # type: ignore[no-untyped-def]
    """Ask for a block's share of the chunk that begins at entry `first`: memory works while blocks are drawn."""
    num_values, end = values.shape[1], len(intersections) // 2 - 1
    for e in range(first + block * _SHARE, first + (block + 1) * _SHARE):
        index = np.int64(load_scalar(intersections, 2 * max(min(e, end), 0)))
        prefetch(records, RECORD_SIZE * index)
        prefetch(values, num_values * index)


@inline_kernel_no_refcount
def eight_records(records, intersections, e, last):  # type: ignore[no-untyped-def]
    """The sixteen columns of eight records, in two groups; past `last` the last is repeated."""
    r0 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * e))
    r1 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 1, last)))
    r2 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 2, last)))
    r3 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 3, last)))
    r4 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 4, last)))
    r5 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 5, last)))
    r6 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 6, last)))
    r7 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 7, last)))
    return (
        load_transposed(records, r0, r1, r2, r3, r4, r5, r6, r7),
        load_transposed(records, r0 + 8, r1 + 8, r2 + 8, r3 + 8, r4 + 8, r5 + 8, r6 + 8, r7 + 8),
    )


@inline_kernel_no_refcount
def gather(  # type: ignore[no-untyped-def]
    records, values, intersections, first, count, place, exact, wide, forms, colours
):
    """Fill in the forms and values of `count` Gaussians of a tile, beginning with entry `first`.

    Args:
        records, intersections: flat.
        values: (n, value).
        place: the tile's.
        exact: float32 1, or 0 for the classic kernel, whose L is 1.
        wide: whether the tile needs three components.
        forms: (FORMS CHUNK_SIZE), written; past `count` the last Gaussian is repeated.
        colours: (CHUNK_SIZE value), written.

    Returns:
        Whether the forms are in three components: some point may be too far from the tile's middle for two.
    """
    num_values = values.shape[1]
    while _find_forms(records, intersections, first, count, place, exact, wide, forms):
        wide = True
    if num_values == FEW:
        for s in range(count):
            copy_four(colours, FEW * s, values, FEW * np.int64(load_scalar(intersections, 2 * (first + s))))
    else:
        for s in range(count):
            row = num_values * np.int64(load_scalar(intersections, 2 * (first + s)))
            for channel in range(num_values):
                store_scalar(colours, num_values * s + channel, load_scalar(values, row + channel))
    return wide


@inline_kernel_no_refcount
def _find_forms(records, intersections, first, count, place, exact, wide, forms):  # type: ignore[no-untyped-def]
    """Fill in forms; whether they have to be found once more, in three components."""
    last = first + count - 1
    on, one = broadcast(exact), broadcast(np.float32(1))
    least, most = one, broadcast(np.float32(0))
    for at in range(0, count, LANES):
        (n_x, n_y, n_z, rest_x, rest_y, rest_z, a_x, a_y), rest = eight_records(
            records, intersections, first + at, last
        )
        a_z, b_x, b_y, b_z, front_a, front_b, along, level = rest
        m_x = (n_x - broadcast(place[0])) + (rest_x - broadcast(place[3]))
        m_y = (n_y - broadcast(place[1])) + (rest_y - broadcast(place[4]))
        m_z = (n_z - broadcast(place[2])) + (rest_z - broadcast(place[5]))
        m_x, m_y, m_z = _along_axes(place, m_x, m_y, m_z)
        a_x, a_y, a_z = _along_axes(place, a_x, a_y, a_z)
        b_x, b_y, b_z = _along_axes(place, b_x, b_y, b_z)
        l_x = on * multiply_add(front_a, a_x, multiply_add(front_b, b_x, m_x))
        l_y = on * multiply_add(front_a, a_y, multiply_add(front_b, b_y, m_y))
        ahead = one + m_z
        if wide:
            store(forms, THIRD * CHUNK_SIZE + at, a_z)
            store(forms, (THIRD + 1) * CHUNK_SIZE + at, b_z)
            store(
                forms, (THIRD + 2) * CHUNK_SIZE + at, on * multiply_add(front_a, a_z, multiply_add(front_b, b_z, ahead))
            )
            store(forms, (THIRD + 3) * CHUNK_SIZE + at, m_z)
            ahead = one
        # Below 1 no pixel behind a Gaussian's horizon, where L < 0, can see it: its power is level - 1 / along at most.
        reach = along * (level + broadcast(np.float32(_MARGIN - CUT)))
        least, inverse = min(least, ahead), one / ahead
        most = max(most, reach)
        store(forms, A * CHUNK_SIZE + at, ahead * a_x)
        store(forms, (A + 1) * CHUNK_SIZE + at, ahead * a_y)
        store(forms, B * CHUNK_SIZE + at, ahead * b_x)
        store(forms, (B + 1) * CHUNK_SIZE + at, ahead * b_y)
        store(forms, L * CHUNK_SIZE + at, ahead * l_x)
        store(forms, (L + 1) * CHUNK_SIZE + at, ahead * l_y)
        store(forms, MIDDLE * CHUNK_SIZE + at, inverse * m_x)
        store(forms, (MIDDLE + 1) * CHUNK_SIZE + at, inverse * m_y)
        store(forms, ALONG_ROW * CHUNK_SIZE + at, along)
        store(forms, LEVEL_ROW * CHUNK_SIZE + at, level)
    return not wide and (any_lane(broadcast(np.float32(MIN_PLANAR_COSINE)) > least) or any_lane(most > one))


@inline_kernel_no_refcount
def _along_axes(place, x, y, z):  # type: ignore[no-untyped-def]
    """Vectors' components along a tile's axes, and towards its middle."""
    return (
        multiply_add(broadcast(place[6]), x, multiply_add(broadcast(place[7]), y, broadcast(place[8]) * z)),
        multiply_add(broadcast(place[9]), x, multiply_add(broadcast(place[10]), y, broadcast(place[11]) * z)),
        multiply_add(broadcast(place[12]), x, multiply_add(broadcast(place[13]), y, broadcast(place[14]) * z)),
    )


@inline_kernel_no_refcount
def list_blocks(intersections, first, count, touched):  # type: ignore[no-untyped-def]
    """Which Gaussians of the chunk touch which columns and rows of blocks, as bits: a block's are in both.

    Args:
        intersections: flat.
        first: entry that bit 0 stands for.
        touched: (WORDS EDGES) of uint64, written: words of ACROSS columns and one to spare, then of the rows.
    """
    touched[:] = 0
    for at in range(count):
        box = load_scalar(intersections, 2 * (first + at) + 1)
        bit, word = np.uint64(1) << np.uint64(at & 63), (at >> 6) * EDGES
        _toggle(touched, word + (box & 255) // BLOCK_WIDTH, bit)
        _toggle(touched, word + ((box >> 8) & 255) // BLOCK_WIDTH + 1, bit)
        _toggle(touched, word + ROWS + ((box >> 16) & 255) // BLOCK_HEIGHT, bit)
        _toggle(touched, word + ROWS + ((box >> 24) & 255) // BLOCK_HEIGHT + 1, bit)
    # A bit was turned where its box begins, and behind its end: run along the blocks, it is set in between.
    for word in range(0, (count + 63) // 64 * EDGES, EDGES):
        for edge in range(word + 1, word + ACROSS):
            _toggle(touched, edge, load_scalar(touched, edge - 1))
        for edge in range(word + ROWS + 1, word + ROWS + DOWN):
            _toggle(touched, edge, load_scalar(touched, edge - 1))


@inline_kernel_no_refcount
def _toggle(words, at, bits):  # type: ignore[no-untyped-def]
    store_scalar(words, at, load_scalar(words, at) ^ bits)


Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

HALF = CHUNK_SIZE + 64  # room for the powers of a block, and for what `list_bits` writes over


class SavedForBackward(NamedTuple):
    """What the forward leaves for the backward: how much passed before each chunk of a tile.

    Attributes:
        through: (row, PIXELS) float32, transmittances before each chunk drawn.
        rows: (tile + 1), where each tile's rows begin.
        drawn: (tile), how many chunks were drawn before the tile closed.
    """

    through: Floats
    rows: Longs
    drawn: Longs


def allocate_saved(starts: Longs, workspace: Workspace) -> SavedForBackward:
    """Room for what the backward of these tile lists needs."""
    chunks = -(-np.diff(starts) // CHUNK_SIZE)
    rows = np.concatenate((np.zeros(1, np.int64), np.cumsum(chunks)))
    return SavedForBackward(workspace.array((int(rows[-1]), PIXELS), np.float32), rows, np.zeros(len(chunks), np.int64))


def rasterize_forward(
    records: Floats,
    values: Floats,
    intersections: Integers,
    starts: Longs,
    plane: PixelTables,
    sums: Floats,
    *,
    first_row: int = 0,
    kept: SavedForBackward | None = None,
    threads: int = 1,
) -> None:
    """Write the sums of weight x (values, 1) of a band of tile rows.

    Args:
        records, values, intersections, starts: see `records`; `starts` covers whole rows of tiles.
        plane: the picture's pixels.
        sums: (channel + 2, height, width), written where the band lies.
        first_row: of tiles, the band's first.
        kept: filled in if given, for the backward.
        threads: to work on; the result does not depend on it.
    """
    pieces = split_tiles(starts, threads)
    flat = records.reshape(-1), values, intersections.reshape(-1), starts
    table = plane.kind, plane.columns, plane.rows, plane.rotation
    room = kept or SavedForBackward(np.empty((0, PIXELS), np.float32), starts, starts)

    def draw(piece: int) -> None:
        _draw_tiles(*flat, *table, sums, *room, first_row, pieces[piece], pieces[piece + 1])

    parallel_for(draw, len(pieces) - 1, threads)


@kernel
def _draw_tiles(  # type: ignore[no-untyped-def]
    records, values, intersections, starts, kind, columns, rows, rotation, sums, kept, kept_rows, drawn_chunks,
    first_row, low, high,
):  # fmt: skip
    tiles_across = (len(columns) + TILE_SIZE - 1) // TILE_SIZE
    num_values = values.shape[1]
    offsets, centre, place = np.empty(3 * PIXELS, np.float32), np.empty(3), np.empty(PLACE, np.float32)
    through, added = np.empty(PIXELS, np.float32), np.empty(num_values * PIXELS, np.float32)
    forms, colours = np.empty(FORMS * CHUNK_SIZE, np.float32), np.empty(num_values * CHUNK_SIZE, np.float32)
    touched = np.empty(WORDS * EDGES, np.uint64)
    powers, places = np.empty(2 * HALF * LANES, np.float32), np.empty(2 * HALF, np.uint8)
    exact = np.float32(0 if kind == PIXEL_CENTRES else 1)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE_SIZE, (first_row + tile // tiles_across) * TILE_SIZE
        tile_is_wide, placed = place_tile(kind, columns, rows, rotation, left, top, centre, place), -1
        open_pixels(columns, rows, left, top, through)
        added[:] = 0
        chunks = 0
        for first in range(starts[tile], starts[tile + 1], CHUNK_SIZE):
            count = min(CHUNK_SIZE, starts[tile + 1] - first)
            if len(kept) > 0:
                _keep(through, kept, kept_rows[tile] + chunks)
            chunks += 1
            wide = gather(records, values, intersections, first, count, place, exact, tile_is_wide, forms, colours)
            if placed != wide:
                place_pixels(kind, columns, rows, rotation, left, top, centre, place, wide, offsets)
                placed = np.int64(wide)
            list_blocks(intersections, first, count, touched)
            is_open = False
            # The next block's powers are found before a block is drawn, so that their latencies hide each other.
            drawn, reached, following, half = -1, 0, 0, 0
            for block in range(BLOCKS + 1):
                if block < BLOCKS:
                    ask_ahead(records, values, intersections, block, first + CHUNK_SIZE)
                    if not any_lane(load(through, block * LANES) > broadcast(np.float32(CLOSED))):
                        continue
                    following = find_powers(block, touched, wide, forms, offsets, powers, places, half)
                if drawn >= 0 and num_values == FEW:
                    is_open |= _draw_block(drawn, reached, powers, places, HALF - half, colours, through, added)
                elif drawn >= 0:
                    is_open |= _weigh_block(drawn, reached, powers, HALF - half, through)
                    _add_block(drawn, reached, powers, places, HALF - half, colours, num_values, added)
                drawn, reached, half = block, following, HALF - half
            if not is_open:
                break
        if len(kept) > 0:
            drawn_chunks[tile] = chunks
        _write_tile(through, added, sums, left, top, num_values)


@inline_kernel_no_refcount
def _keep(through, kept, row):  # type: ignore[no-untyped-def]
    for pixel in range(PIXELS):
        kept[row, pixel] = through[pixel]


@inline_kernel_no_refcount
def find_powers(block, touched, wide, forms, offsets, powers, places, start):  # type: ignore[no-untyped-def]
    """Log2 of the peak times the response at a block's pixels, for the Gaussians of the chunk that reach it.

    Returns:
        How many of `powers` (LANES each) and `places` (in the chunk) were written, front to back; one more that is
        nothing follows. Boxes have corners: some of them no pixel sees. Leaving those out would make each wait for the
        one before.
    """
    pixel = block * LANES
    x, y, z = load(offsets, pixel), load(offsets, PIXELS + pixel), load(offsets, 2 * PIXELS + pixel)
    total = _list_places(block, touched, places, start)
    zero = broadcast(np.float32(0))
    for at in range(start, start + total):
        s = np.int64(load_scalar(places, at))
        a, b, front = forms_at(wide, forms, s, x, y, z)
        if wide:
            front = select(front > zero, front, broadcast(np.float32(np.nan)))
        q = multiply_add(a, a, b * b)
        below = multiply_add(max(zero, front), front, load_broadcast(forms, ALONG_ROW * CHUNK_SIZE + s) * q)
        store(powers, at * LANES, load_broadcast(forms, LEVEL_ROW * CHUNK_SIZE + s) - q / below)
    store(powers, (start + total) * LANES, broadcast(np.float32(NOTHING)))
    return total


@inline_kernel_no_refcount
def _list_places(block, touched, places, start):  # type: ignore[no-untyped-def]
    """Write down which Gaussians of the chunk reach a block, and one more; how many do."""
    at, column, row = start, block % ACROSS, ROWS + block // ACROSS
    for word in range(WORDS):
        bits = load_scalar(touched, word * EDGES + column) & load_scalar(touched, word * EDGES + row)
        list_set_bits(places, at, bits, word * 64)
        at += popcount(bits)
    store_scalar(places, at, np.uint8(0))
    return at - start


@inline_kernel_no_refcount
def forms_at(wide, forms, s, x, y, z):  # type: ignore[no-untyped-def]
    """A, B, L of Gaussian `s` of the chunk at a block's pixels, up to a factor a pixel, which powers do not see.

    The offsets from the Gaussian come first: small numbers, so that nothing large cancels in the sums.
    """
    x, y = x - load_broadcast(forms, MIDDLE * CHUNK_SIZE + s), y - load_broadcast(forms, (MIDDLE + 1) * CHUNK_SIZE + s)
    a = load_broadcast(forms, A * CHUNK_SIZE + s) * x
    b = load_broadcast(forms, B * CHUNK_SIZE + s) * x
    front = multiply_add(load_broadcast(forms, L * CHUNK_SIZE + s), x, broadcast(np.float32(1)))
    a = multiply_add(load_broadcast(forms, (A + 1) * CHUNK_SIZE + s), y, a)
    b = multiply_add(load_broadcast(forms, (B + 1) * CHUNK_SIZE + s), y, b)
    front = multiply_add(load_broadcast(forms, (L + 1) * CHUNK_SIZE + s), y, front)
    if wide:
        z = z - load_broadcast(forms, (THIRD + 3) * CHUNK_SIZE + s)
        a = multiply_add(load_broadcast(forms, THIRD * CHUNK_SIZE + s), z, a)
        b = multiply_add(load_broadcast(forms, (THIRD + 1) * CHUNK_SIZE + s), z, b)
        front = multiply_add(load_broadcast(forms, (THIRD + 2) * CHUNK_SIZE + s), z, front)
    return a, b, front


@inline_kernel_no_refcount
def opacity(power):  # type: ignore[no-untyped-def]
    """Alpha of a power: 0 below the cut, at most MOST."""
    alpha = min(exp2(power), broadcast(np.float32(MOST)))
    return select(broadcast(np.float32(CUT)) <= power, alpha, broadcast(np.float32(0)))


@inline_kernel_no_refcount
def _draw_block(block, reached, powers, places, start, colours, through, added):  # type: ignore[no-untyped-def]
    """Draw what reaches a block, four values a Gaussian; whether it stays open."""
    pixel = block * LANES
    passes = load(through, pixel)
    sum0, sum1 = load(added, pixel), load(added, PIXELS + pixel)
    sum2, sum3 = load(added, 2 * PIXELS + pixel), load(added, 3 * PIXELS + pixel)
    for at in range(start, start + reached, 2):  # a half-full last turn adds nothing
        colour, other = FEW * np.int64(load_scalar(places, at)), FEW * np.int64(load_scalar(places, at + 1))
        alpha, beta = opacity(load(powers, at * LANES)), opacity(load(powers, at * LANES + LANES))
        weight = alpha * passes
        passes = multiply_add(-alpha, passes, passes)
        sum0 = multiply_add(weight, load_broadcast(colours, colour), sum0)
        sum1 = multiply_add(weight, load_broadcast(colours, colour + 1), sum1)
        sum2 = multiply_add(weight, load_broadcast(colours, colour + 2), sum2)
        sum3 = multiply_add(weight, load_broadcast(colours, colour + 3), sum3)
        weight = beta * passes
        passes = multiply_add(-beta, passes, passes)
        sum0 = multiply_add(weight, load_broadcast(colours, other), sum0)
        sum1 = multiply_add(weight, load_broadcast(colours, other + 1), sum1)
        sum2 = multiply_add(weight, load_broadcast(colours, other + 2), sum2)
        sum3 = multiply_add(weight, load_broadcast(colours, other + 3), sum3)
    store(through, pixel, passes)
    store(added, pixel, sum0)
    store(added, PIXELS + pixel, sum1)
    store(added, 2 * PIXELS + pixel, sum2)
    store(added, 3 * PIXELS + pixel, sum3)
    return any_lane(passes > broadcast(np.float32(CLOSED)))


@inline_kernel_no_refcount
def _weigh_block(block, reached, powers, start, through):  # type: ignore[no-untyped-def]
    """Turn powers into weights; whether the block stays open."""
    passes = load(through, block * LANES)
    for at in range(start, start + reached):
        alpha = opacity(load(powers, at * LANES))
        store(powers, at * LANES, alpha * passes)
        passes = multiply_add(-alpha, passes, passes)
    store(through, block * LANES, passes)
    return any_lane(passes > broadcast(np.float32(CLOSED)))


@inline_kernel_no_refcount
def _add_block(block, reached, weights, places, start, colours, num_values, added):  # type: ignore[no-untyped-def]
    """Add a block's weighted values to the sums, any number of them."""
    for channel in range(num_values):
        pixel = channel * PIXELS + block * LANES
        total = load(added, pixel)
        for at in range(start, start + reached):
            colour = num_values * np.int64(load_scalar(places, at)) + channel
            total = multiply_add(load(weights, at * LANES), load_broadcast(colours, colour), total)
        store(added, pixel, total)


@inline_kernel_no_refcount
def _write_tile(through, added, sums, left, top, num_values):  # type: ignore[no-untyped-def]
    """Copy a tile's sums into the picture; the weights of a ray and what passes sum to 1."""
    width, height = sums.shape[2], sums.shape[1]
    if left + TILE_SIZE > width or top + TILE_SIZE > height:
        _write_part(through, added, sums, left, top, num_values)
        return
    picture, one = sums.reshape(-1), broadcast(np.float32(1))
    for block in range(0, BLOCKS, 2):
        pixel = block * LANES
        at = (top + block // ACROSS * BLOCK_HEIGHT) * width + left + block % ACROSS * BLOCK_WIDTH
        for channel in range(num_values):
            plane, place = channel * PIXELS + pixel, channel * height * width + at
            upper, lower = join_halves(load(added, plane), load(added, plane + LANES))
            store(picture, place, upper)
            store(picture, place + width, lower)
        place = num_values * height * width + at
        upper, lower = join_halves(one - load(through, pixel), one - load(through, pixel + LANES))
        store(picture, place, upper)
        store(picture, place + width, lower)


@inline_kernel_no_refcount
def _write_part(through, added, sums, left, top, num_values):  # type: ignore[no-untyped-def]
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        if x < sums.shape[2] and y < sums.shape[1]:
            for channel in range(num_values):
                sums[channel, y, x] = added[channel * PIXELS + pixel]
            sums[num_values, y, x] = np.float32(1) - through[pixel]
