"""What a tile needs before it is drawn: its pixels, and its Gaussians' forms relative to its middle.

Forms are kept by columns (`FORMS` x `CHUNK`), for a chunk of Gaussians that fits the first cache: the set-up then works
on eight Gaussians at once, and drawing spreads one number over eight pixels.
"""

import math

import numpy as np

from pansplat.render.cpu.columns import columns_of
from pansplat.render.cpu.compiling import inlined
from pansplat.render.cpu.records import FIELDS, TILE
from pansplat.render.cpu.simd import LANES, element, fill, multiply_add, prefetch, put, store
from pansplat.render.cpu.tables import FLAT, PANORAMA

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
_AHEAD = 16  # Gaussians, between asking for a record and reading it

# Rows of the forms.
A_X, B_X, L_X = 0, 3, 6  # a, b, l: x, y, z each
MIDDLE = 9  # the Gaussian's point relative to the tile's middle: x, y, z
ALONG_ROW, LEVEL_ROW = 12, 13
FRONTS = 14  # front_a, front_b
FORMS = 16

CUT = math.log2(1 / 255)  # least power: log2 of alpha
NOTHING = -1000.0  # a power far below
MOST = 0.99
CLOSED = 1e-7
"""A pixel takes nothing more once its transmittance is at or below this."""


@inlined
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


@inlined
def place_tile(kind, columns, rows, rotation, left, top, offsets, middle, through):  # type: ignore[no-untyped-def]
    """Fill in the tile's pixels, block by block, and its middle; pixels off the picture start out closed.

    Args:
        kind, columns, rows, rotation: of the picture's Plane.
        left, top: pixel of the tile's corner.
        offsets: (3 PIXELS), written: x, y, z from the middle.
        middle: (6), written: the middle, rounded, and the rest.
        through: (PIXELS), written: transmittances before anything is drawn.
    """
    width, height = len(columns), len(rows)
    centre_x, centre_y = min(left + TILE // 2, width - 1), min(top + TILE // 2, height - 1)
    k = point_of(kind, columns, rows, rotation, centre_x, centre_y)
    for axis in range(3):
        middle[axis] = np.float32(k[axis])
        middle[3 + axis] = np.float32(k[axis] - np.float64(middle[axis]))
    for pixel in range(PIXELS):
        block, lane = pixel // LANES, pixel % LANES
        x = left + (block % ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        y = top + (block // ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        through[pixel] = np.float32(1 if x < width and y < height else 0)
        point = point_of(kind, columns, rows, rotation, min(x, width - 1), min(y, height - 1))
        offsets[pixel] = np.float32(point[0] - k[0])
        offsets[PIXELS + pixel] = np.float32(point[1] - k[1])
        offsets[2 * PIXELS + pixel] = np.float32(point[2] - k[2])


@inlined
def ask_ahead(records, values, entries, block, first):  # type: ignore[no-untyped-def]
    """Ask for a block's share of the chunk that begins at entry `first`: memory works while blocks are drawn."""
    num_values, end = values.shape[1], len(entries) // 2 - 1
    for e in range(first + block * _SHARE, first + (block + 1) * _SHARE):
        index = np.int64(element(entries, 2 * max(min(e, end), 0)))
        prefetch(records, FIELDS * index)
        prefetch(values, num_values * index)


@inlined
def gather(  # type: ignore[no-untyped-def]
    records, values, entries, first, count, middle, exact, forms, colours
):
    """Fill in the forms and values of `count` Gaussians of a tile, beginning with entry `first`.

    Args:
        records, entries: flat.
        values: (n, value).
        middle: the tile's.
        exact: float32 1, or 0 for the classic kernel, whose L is 1.
        forms: (FORMS CHUNK), written; past `count` the last Gaussian is repeated.
        colours: (CHUNK value), written.
    """
    last, end = first + count - 1, len(entries) // 2 - 1
    num_values = values.shape[1]
    for at in range(0, count, LANES):
        e = first + at
        for ahead in range(e + _AHEAD, e + _AHEAD + LANES):
            index = np.int64(element(entries, 2 * min(ahead, end)))
            prefetch(records, FIELDS * index)
            prefetch(values, num_values * index)
        r0 = FIELDS * np.int64(element(entries, 2 * e))
        r1 = FIELDS * np.int64(element(entries, 2 * min(e + 1, last)))
        r2 = FIELDS * np.int64(element(entries, 2 * min(e + 2, last)))
        r3 = FIELDS * np.int64(element(entries, 2 * min(e + 3, last)))
        r4 = FIELDS * np.int64(element(entries, 2 * min(e + 4, last)))
        r5 = FIELDS * np.int64(element(entries, 2 * min(e + 5, last)))
        r6 = FIELDS * np.int64(element(entries, 2 * min(e + 6, last)))
        r7 = FIELDS * np.int64(element(entries, 2 * min(e + 7, last)))
        n_x, n_y, n_z, rest_x, rest_y, rest_z, a_x, a_y = columns_of(records, r0, r1, r2, r3, r4, r5, r6, r7)
        a_z, b_x, b_y, b_z, front_a, front_b, along, level = columns_of(
            records, r0 + 8, r1 + 8, r2 + 8, r3 + 8, r4 + 8, r5 + 8, r6 + 8, r7 + 8
        )
        on = fill(exact)
        l_x = on * multiply_add(front_a, a_x, multiply_add(front_b, b_x, n_x))
        l_y = on * multiply_add(front_a, a_y, multiply_add(front_b, b_y, n_y))
        l_z = on * multiply_add(front_a, a_z, multiply_add(front_b, b_z, n_z))
        m_x = (n_x - fill(middle[0])) + (rest_x - fill(middle[3]))
        m_y = (n_y - fill(middle[1])) + (rest_y - fill(middle[4]))
        m_z = (n_z - fill(middle[2])) + (rest_z - fill(middle[5]))
        _store_vector(forms, A_X, at, a_x, a_y, a_z)
        _store_vector(forms, B_X, at, b_x, b_y, b_z)
        _store_vector(forms, L_X, at, l_x, l_y, l_z)
        _store_vector(forms, MIDDLE, at, m_x, m_y, m_z)
        store(forms, ALONG_ROW * CHUNK + at, along)
        store(forms, LEVEL_ROW * CHUNK + at, level)
        store(forms, FRONTS * CHUNK + at, front_a)
        store(forms, (FRONTS + 1) * CHUNK + at, front_b)
        for place in range(at, min(at + LANES, count)):
            row = num_values * np.int64(element(entries, 2 * (first + place)))
            for channel in range(num_values):
                put(colours, num_values * place + channel, element(values, row + channel))


@inlined
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


@inlined
def _toggle(words, at, bits):  # type: ignore[no-untyped-def]
    put(words, at, element(words, at) ^ bits)


@inlined
def _store_vector(forms, row, at, x, y, z):  # type: ignore[no-untyped-def]
    store(forms, row * CHUNK + at, x)
    store(forms, (row + 1) * CHUNK + at, y)
    store(forms, (row + 2) * CHUNK + at, z)
