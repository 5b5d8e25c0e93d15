"""What a tile needs before it is drawn: its pixels, and its Gaussians' forms relative to its middle.

A ray's length is free. So a tile takes its pixels and Gaussians where their rays meet the plane that touches the sphere
in its middle, and forms have two components. Where some are too far from the middle for that, they have three.

Forms are kept by columns (`FORMS` x `CHUNK`), for a chunk of Gaussians that fits the first cache: the set-up then works
on eight Gaussians at once, and drawing spreads one number over eight pixels.
"""

import math

import numpy as np

from pansplat.rendering.cpu.columns import columns_of
from pansplat.rendering.cpu.compiling import borrowing
from pansplat.rendering.cpu.forms import dot, tangent_frame
from pansplat.rendering.cpu.records import FIELDS, TILE
from pansplat.rendering.cpu.simd import (
    LANES,
    copy_four,
    element,
    fill,
    maximum,
    minimum,
    multiply_add,
    prefetch,
    put,
    some,
    store,
)
from pansplat.rendering.cpu.tables import FLAT, PANORAMA

BLOCK_WIDTH = 4
BLOCK_HEIGHT = LANES // BLOCK_WIDTH
ACROSS = TILE // BLOCK_WIDTH
DOWN = TILE // BLOCK_HEIGHT
BLOCKS = ACROSS * DOWN
PIXELS = TILE * TILE
CHUNK = 256  # Gaussians
WORDS = CHUNK // 64
ROWS = ACROSS + 1  # where the rows' edges begin, among a word's
EDGES = ROWS + DOWN + 1
_SHARE = CHUNK // BLOCKS  # Gaussians of the next chunk that are asked for at each block

# Rows of the forms.
A, B, L = 0, 2, 4  # a, b, l: two components each
MIDDLE = 6  # the Gaussian's point: two components
ALONG_ROW, LEVEL_ROW = 8, 9
THIRD = 10  # third components of a, b, l and the point; only written and read where a tile or a Gaussian is wide
FORMS = 14

CUT = math.log2(1 / 255)  # least power: log2 of alpha
NOTHING = -1000.0  # a power far below
MOST = 0.99
CLOSED = 1e-7
"""A pixel takes nothing more once its transmittance is at or below this."""
_MARGIN = 0.1
NARROW = 0.5  # least cosine of the angle from a tile's middle at which forms have two components
FEW = 4  # values, handled together: RGB and the distance
PLACE = 15  # numbers that place a tile: see `place_tile`


@borrowing
def point_of(kind, columns, rows, rotation, x, y):  # type: ignore[no-untyped-def]
    """The point of pixel (x, y) that Gaussians are measured against: a unit direction, or the pixel's centre."""
    if kind == PANORAMA:
        cosine = rows[y, 1]
        return cosine * columns[x, 0], rows[y, 0], cosine * columns[x, 1]
    right, down = columns[x, 0], rows[y, 0]
    if kind == FLAT:
        return right, down, 0.0
    scale = 1 / math.sqrt(right * right + down * down + 1)
    right, down = right * scale, down * scale
    return (
        rotation[0, 0] * right + rotation[0, 1] * down + rotation[0, 2] * scale,
        rotation[1, 0] * right + rotation[1, 1] * down + rotation[1, 2] * scale,
        rotation[2, 0] * right + rotation[2, 1] * down + rotation[2, 2] * scale,
    )


@borrowing
def place_tile(kind, columns, rows, rotation, left, top, centre, place):  # type: ignore[no-untyped-def]
    """Find a tile's middle and axes.

    Args:
        kind, columns, rows, rotation: of the picture's Plane.
        left, top: pixel of the tile's corner.
        centre: (3) float64, written: the middle.
        place: (PLACE), written: the middle, rounded, and the rest; two axes across, and the middle once more or, for
            the classic kernel, zeros.

    Returns:
        Whether some of its pixels are too far from the middle for two components.
    """
    least = 1.0  # cosine of a pixel's angle from the middle; those in the corners are the farthest
    for corner in range(-1, 4):
        x, y = left + TILE // 2, top + TILE // 2
        if corner >= 0:
            x, y = left + corner % 2 * (TILE - 1), top + corner // 2 * (TILE - 1)
        x, y = min(x, len(columns) - 1), min(y, len(rows) - 1)
        d_x, d_y, d_z = point_of(kind, columns, rows, rotation, x, y)
        if corner < 0:
            centre[0], centre[1], centre[2] = d_x, d_y, d_z
        elif kind != FLAT:
            least = min(least, dot(centre[0], centre[1], centre[2], d_x, d_y, d_z))
    axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    if kind != FLAT:
        axes = tangent_frame(centre[0], centre[1], centre[2])
    for axis in range(3):
        place[axis] = np.float32(centre[axis])
        place[3 + axis] = np.float32(centre[axis] - np.float64(place[axis]))
        place[12 + axis] = np.float32(0 if kind == FLAT else centre[axis])
    for axis in range(6):
        place[6 + axis] = np.float32(axes[axis])
    return least < NARROW


@borrowing
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


@borrowing
def open_pixels(columns, rows, left, top, through):  # type: ignore[no-untyped-def]
    """Transmittances before anything is drawn: pixels off the picture start out closed."""
    width, height = len(columns), len(rows)
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        through[pixel] = np.float32(1 if x < width and y < height else 0)


@borrowing
def ask_ahead(records, values, entries, block, first):  # type: ignore[no-untyped-def]
    """Ask for a block's share of the chunk that begins at entry `first`: memory works while blocks are drawn."""
    num_values, end = values.shape[1], len(entries) // 2 - 1
    for e in range(first + block * _SHARE, first + (block + 1) * _SHARE):
        index = np.int64(element(entries, 2 * max(min(e, end), 0)))
        prefetch(records, FIELDS * index)
        prefetch(values, num_values * index)


@borrowing
def eight_records(records, entries, e, last):  # type: ignore[no-untyped-def]
    """The sixteen columns of the records of eight entries from `e` on, in two groups; past `last` it is repeated."""
    r0 = FIELDS * np.int64(element(entries, 2 * e))
    r1 = FIELDS * np.int64(element(entries, 2 * min(e + 1, last)))
    r2 = FIELDS * np.int64(element(entries, 2 * min(e + 2, last)))
    r3 = FIELDS * np.int64(element(entries, 2 * min(e + 3, last)))
    r4 = FIELDS * np.int64(element(entries, 2 * min(e + 4, last)))
    r5 = FIELDS * np.int64(element(entries, 2 * min(e + 5, last)))
    r6 = FIELDS * np.int64(element(entries, 2 * min(e + 6, last)))
    r7 = FIELDS * np.int64(element(entries, 2 * min(e + 7, last)))
    return (
        columns_of(records, r0, r1, r2, r3, r4, r5, r6, r7),
        columns_of(records, r0 + 8, r1 + 8, r2 + 8, r3 + 8, r4 + 8, r5 + 8, r6 + 8, r7 + 8),
    )


@borrowing
def gather(  # type: ignore[no-untyped-def]
    records, values, entries, first, count, place, exact, wide, forms, colours
):
    """Fill in the forms and values of `count` Gaussians of a tile, beginning with entry `first`.

    Args:
        records, entries: flat.
        values: (n, value).
        place: the tile's.
        exact: float32 1, or 0 for the classic kernel, whose L is 1.
        wide: whether the tile needs three components.
        forms: (FORMS CHUNK), written; past `count` the last Gaussian is repeated.
        colours: (CHUNK value), written.

    Returns:
        Whether the forms are in three components: some point may be too far from the tile's middle for two.
    """
    num_values = values.shape[1]
    while _find_forms(records, entries, first, count, place, exact, wide, forms):
        wide = True
    if num_values == FEW:
        for s in range(count):
            copy_four(colours, FEW * s, values, FEW * np.int64(element(entries, 2 * (first + s))))
    else:
        for s in range(count):
            row = num_values * np.int64(element(entries, 2 * (first + s)))
            for channel in range(num_values):
                put(colours, num_values * s + channel, element(values, row + channel))
    return wide


@borrowing
def _find_forms(records, entries, first, count, place, exact, wide, forms):  # type: ignore[no-untyped-def]
    """Fill in forms; whether they have to be found once more, in three components."""
    last = first + count - 1
    on, one = fill(exact), fill(np.float32(1))
    least, most = one, fill(np.float32(0))
    for at in range(0, count, LANES):
        (n_x, n_y, n_z, rest_x, rest_y, rest_z, a_x, a_y), rest = eight_records(records, entries, first + at, last)
        a_z, b_x, b_y, b_z, front_a, front_b, along, level = rest
        m_x = (n_x - fill(place[0])) + (rest_x - fill(place[3]))
        m_y = (n_y - fill(place[1])) + (rest_y - fill(place[4]))
        m_z = (n_z - fill(place[2])) + (rest_z - fill(place[5]))
        m_x, m_y, m_z = _along_axes(place, m_x, m_y, m_z)
        a_x, a_y, a_z = _along_axes(place, a_x, a_y, a_z)
        b_x, b_y, b_z = _along_axes(place, b_x, b_y, b_z)
        l_x = on * multiply_add(front_a, a_x, multiply_add(front_b, b_x, m_x))
        l_y = on * multiply_add(front_a, a_y, multiply_add(front_b, b_y, m_y))
        ahead = one + m_z
        if wide:
            store(forms, THIRD * CHUNK + at, a_z)
            store(forms, (THIRD + 1) * CHUNK + at, b_z)
            store(forms, (THIRD + 2) * CHUNK + at, on * multiply_add(front_a, a_z, multiply_add(front_b, b_z, ahead)))
            store(forms, (THIRD + 3) * CHUNK + at, m_z)
            ahead = one
        # Below 1 no pixel behind a Gaussian's horizon, where L < 0, can see it: its power is level - 1 / along at most.
        reach = along * (level + fill(np.float32(_MARGIN - CUT)))
        least, inverse = minimum(least, ahead), one / ahead
        most = maximum(most, reach)
        store(forms, A * CHUNK + at, ahead * a_x)
        store(forms, (A + 1) * CHUNK + at, ahead * a_y)
        store(forms, B * CHUNK + at, ahead * b_x)
        store(forms, (B + 1) * CHUNK + at, ahead * b_y)
        store(forms, L * CHUNK + at, ahead * l_x)
        store(forms, (L + 1) * CHUNK + at, ahead * l_y)
        store(forms, MIDDLE * CHUNK + at, inverse * m_x)
        store(forms, (MIDDLE + 1) * CHUNK + at, inverse * m_y)
        store(forms, ALONG_ROW * CHUNK + at, along)
        store(forms, LEVEL_ROW * CHUNK + at, level)
    return not wide and (some(fill(np.float32(NARROW)) > least) or some(most > one))


@borrowing
def _along_axes(place, x, y, z):  # type: ignore[no-untyped-def]
    """Vectors' components along a tile's axes, and towards its middle."""
    return (
        multiply_add(fill(place[6]), x, multiply_add(fill(place[7]), y, fill(place[8]) * z)),
        multiply_add(fill(place[9]), x, multiply_add(fill(place[10]), y, fill(place[11]) * z)),
        multiply_add(fill(place[12]), x, multiply_add(fill(place[13]), y, fill(place[14]) * z)),
    )


@borrowing
def list_blocks(entries, first, count, touched):  # type: ignore[no-untyped-def]
    """Which Gaussians of the chunk touch which columns and rows of blocks, as bits: a block's are in both.

    Args:
        entries: flat.
        first: entry that bit 0 stands for.
        touched: (WORDS EDGES) of uint64, written: words of ACROSS columns and one to spare, then of the rows.
    """
    touched[:] = 0
    for at in range(count):
        box = element(entries, 2 * (first + at) + 1)
        bit, word = np.uint64(1) << np.uint64(at & 63), (at >> 6) * EDGES
        _toggle(touched, word + (box & 255) // BLOCK_WIDTH, bit)
        _toggle(touched, word + ((box >> 8) & 255) // BLOCK_WIDTH + 1, bit)
        _toggle(touched, word + ROWS + ((box >> 16) & 255) // BLOCK_HEIGHT, bit)
        _toggle(touched, word + ROWS + ((box >> 24) & 255) // BLOCK_HEIGHT + 1, bit)
    # A bit was turned where its box begins, and behind its end: run along the blocks, it is set in between.
    for word in range(0, (count + 63) // 64 * EDGES, EDGES):
        for edge in range(word + 1, word + ACROSS):
            _toggle(touched, edge, element(touched, edge - 1))
        for edge in range(word + ROWS + 1, word + ROWS + DOWN):
            _toggle(touched, edge, element(touched, edge - 1))


@borrowing
def _toggle(words, at, bits):  # type: ignore[no-untyped-def]
    put(words, at, element(words, at) ^ bits)
