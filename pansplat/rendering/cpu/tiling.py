"""Where each record can be seen: boxes of pixels, exact on pinhole pictures, tight and conservative on panoramas.

Source: docs/rendering.md, section 5. A record gives back its covariance as a sum of squares: with the dual axes
p = (b ^ n) / w - alpha n and q = (n ^ a) / w - beta n, where w = (a ^ b).n,

    C' = S' n n' + p p' + q q'

so h' C' h never cancels. A box is int16: first and last column, first and last row, both ends included. None where
the last row is before the first; on a panorama a box whose last column is before its first goes on at the left.
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from pansplat.constants import ALPHA_CUT, KAPPA_MARGIN
from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.columns import read_columns
from pansplat.rendering.cpu.forms import cross, dot
from pansplat.rendering.cpu.observe import CULLED, LANES, PIECE
from pansplat.rendering.cpu.records import BOX_BITS, TILE_SIZE
from pansplat.rendering.cpu.runtime import Workspace, inline_kernel, kernel, parallel_for
from pansplat.rendering.cpu.simd import element, prefetch, prefetch_to_write, put
from pansplat.rendering.panorama import Picture

LARGEST_SIDE = 32767  # pixels; boxes are int16
_SLACK = np.float32(KAPPA_MARGIN)
_LOG_CUT = np.float32(math.log2(1 / ALPHA_CUT))

# float32 is enough, for a margin covers its rounding. Bare numbers would make it float64.
_ZERO, _ONE, _HALF, _PI = np.float32(0), np.float32(1), np.float32(0.5), np.float32(math.pi)
_UNIT, _ROOT_UNIT = np.float32(layout.HALF_LOG2_E), np.float32(math.sqrt(layout.HALF_LOG2_E))
_NARROWEST = np.float32(1e-12)  # of the direction's horizontal part
_TURN_BACK = np.float32(1e-6)
_NOWHERE = np.float32(-1e9)  # where the last row of what is not seen lies
_CULLED = np.float32(CULLED)
_EVERYWHERE = np.float32(1e9)

# Rows of a block of records: as they are in memory, then what is found from them.
ALONG, KAPPA = layout.RADIAL_VARIANCE, layout.LOG2_PEAK
DIRECTION, P, Q = layout.RECORD_SIZE, layout.RECORD_SIZE + 3, layout.RECORD_SIZE + 6
EDGES = layout.RECORD_SIZE + 9
ROWS = layout.RECORD_SIZE + 13


@inline_kernel
def margin(height, width):
    """Pixels added around each box, far more than rounding."""
    return np.float32(0.01 + 1e-6 * max(height, width))


@inline_kernel
def read_cones(records, start, count, rotation, rows):
    """Read directions, dual axes and S' into rows, turned into a picture's axes; kappa is -1 where not drawn.

    Args:
        records: flat.
        rotation: float32, the picture's axes in the records'.
    """
    read_columns(records, start, count, rows.reshape(-1), LANES)
    right = rotation[0, 0], rotation[1, 0], rotation[2, 0]
    down = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    ahead = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    first, second = layout.ROW_A, layout.ROW_B
    for i in range(LANES):
        n = rows[0, i], rows[1, i], rows[2, i]
        a = rows[first, i], rows[first + 1, i], rows[first + 2, i]
        b = rows[second, i], rows[second + 1, i], rows[second + 2, i]
        p, q = dual_axes(n, a, b, rows[layout.L_ALONG_A, i], rows[layout.L_ALONG_B, i])
        rows[DIRECTION, i], rows[DIRECTION + 1, i], rows[DIRECTION + 2, i] = (
            dot(*right, *n),
            dot(*down, *n),
            dot(*ahead, *n),
        )
        rows[P, i], rows[P + 1, i] = _ROOT_UNIT * dot(*right, *p), _ROOT_UNIT * dot(*down, *p)
        rows[P + 2, i], rows[Q, i] = _ROOT_UNIT * dot(*ahead, *p), _ROOT_UNIT * dot(*right, *q)
        rows[Q + 1, i], rows[Q + 2, i] = _ROOT_UNIT * dot(*down, *q), _ROOT_UNIT * dot(*ahead, *q)
        rows[ALONG, i] *= _UNIT
        level = rows[KAPPA, i]
        rows[KAPPA, i] = (level + _LOG_CUT) / _UNIT + _SLACK if level > _CULLED else -_ONE


@inline_kernel
def dual_axes(n, a, b, front_a, front_b):
    """The axes p and q of a record with these forms, in its own units: C' / UNIT = along n n' + p p' + q q'."""
    inverse = _ONE / dot(*cross(*a, *b), *n)
    first, second = cross(*b, *n), cross(*n, *a)
    p = first[0] * inverse - front_a * n[0], first[1] * inverse - front_a * n[1], first[2] * inverse - front_a * n[2]
    q = second[0] * inverse - front_b * n[0], second[1] * inverse - front_b * n[1], second[2] * inverse - front_b * n[2]
    return p, q


@inline_kernel
def _cone(rows, i):
    n = rows[DIRECTION, i], rows[DIRECTION + 1, i], rows[DIRECTION + 2, i]
    p = rows[P, i], rows[P + 1, i], rows[P + 2, i]
    q = rows[Q, i], rows[Q + 1, i], rows[Q + 2, i]
    return n, p, q, rows[ALONG, i], rows[KAPPA, i]


@inline_kernel
def _pinhole_edges(n_x, n_z, p_x, p_z, q_x, q_z, along, kappa):
    """The tangents of a cone's outermost planes through one axis, as middle, root and what divides both."""
    p_across, q_across = p_x * n_z - p_z * n_x, q_x * n_z - q_z * n_x
    across = p_across * p_across + q_across * q_across
    both = p_x * q_z - p_z * q_x
    root = math.sqrt(max(kappa * across - kappa * kappa * (along * across + both * both), _ZERO))
    return n_x * n_z - kappa * (along * n_x * n_z + p_x * p_z + q_x * q_z), root


@inline_kernel
def _beside(n, p, q, along, kappa, slope_x, slope_y, slope_z):
    """Whether a cone lies wholly on the far side of a plane through the eye with this normal."""
    h = slope_x, slope_y, slope_z
    distance, first, second = dot(*n, *h), dot(*p, *h), dot(*q, *h)
    reach = kappa * (along * distance * distance + first * first + second * second)
    return (distance * distance > reach) & (distance < _ZERO)


@kernel
def _pinhole(piece, records, rotation, height, width, focal, boxes):
    rows = np.ones((ROWS, LANES), np.float32)
    side, end = np.float32(width / (2 * focal)), np.float32(height / (2 * focal))
    middle_x, middle_y, scale = np.float32(0.5 * width), np.float32(0.5 * height), np.float32(focal)
    num = len(records) // layout.RECORD_SIZE
    for start in range(piece * PIECE, min((piece + 1) * PIECE, num), LANES):
        count = min(LANES, num - start)
        read_cones(records, start, count, rotation, rows)
        for i in range(LANES):
            n, p, q, along, kappa = _cone(rows, i)
            d_zz = n[2] * n[2] - kappa * (along * n[2] * n[2] + p[2] * p[2] + q[2] * q[2])
            x, root_x = _pinhole_edges(n[0], n[2], p[0], p[2], q[0], q[2], along, kappa)
            y, root_y = _pinhole_edges(n[1], n[2], p[1], p[2], q[1], q[2], along, kappa)
            bounded = d_zz > _ZERO  # else the cone crosses the plane through the eye
            times = scale / d_zz
            unseen = (kappa < _ZERO) | (bounded & (n[2] < _ZERO))
            # Those that cross the plane through the eye have no box, but most of them lie beside the view.
            unseen |= _beside(n, p, q, along, kappa, _ONE, _ZERO, side)
            unseen |= _beside(n, p, q, along, kappa, -_ONE, _ZERO, side)
            unseen |= _beside(n, p, q, along, kappa, _ZERO, _ONE, end)
            unseen |= _beside(n, p, q, along, kappa, _ZERO, -_ONE, end)
            rows[EDGES, i] = (x - root_x) * times + middle_x if bounded else -_EVERYWHERE
            rows[EDGES + 1, i] = (x + root_x) * times + middle_x if bounded else _EVERYWHERE
            rows[EDGES + 2, i] = (y - root_y) * times + middle_y if bounded else -_EVERYWHERE
            last = (y + root_y) * times + middle_y if bounded else _EVERYWHERE
            rows[EDGES + 3, i] = _NOWHERE if unseen else last
        round_boxes(rows, EDGES, start, count, height, width, boxes)


@inline_kernel
def round_boxes(rows, edges, start, count, height, width, boxes):
    """Write the pixels whose centres lie between left, right, top and bottom, four rows of pixels."""
    around = margin(height, width)
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    for i in range(LANES):
        x0 = max(np.ceil(rows[edges, i] - _HALF - around), _ZERO)
        x1 = min(np.floor(rows[edges + 1, i] - _HALF + around), last_x)
        y0 = max(np.ceil(rows[edges + 2, i] - _HALF - around), _ZERO)
        y1 = min(np.floor(rows[edges + 3, i] - _HALF + around), last_y)
        seen = (x0 <= x1) & (y0 <= y1)
        rows[edges, i], rows[edges + 1, i] = x0 if seen else _ZERO, x1 if seen else _ZERO
        rows[edges + 2, i], rows[edges + 3, i] = y0 if seen else _ONE, y1 if seen else _ZERO
    write_boxes(rows, edges, start, count, boxes)


@inline_kernel
def write_boxes(rows, edges, start, count, boxes):
    """Write four rows of whole numbers as boxes, two numbers a word."""
    for i in range(count):
        boxes[start + i, 0] = np.int32(rows[edges, i]) | np.int32(rows[edges + 1, i]) << np.int32(16)
        boxes[start + i, 1] = np.int32(rows[edges + 2, i]) | np.int32(rows[edges + 3, i]) << np.int32(16)


@inline_kernel
def _arctan2(y, x):
    """atan2 within 3e-7 radians (a fit at Chebyshev nodes), with one division."""
    steep = abs(y) > abs(x)
    s = (x if steep else y) / (y if steep else x)
    z = s * s
    p = np.float32(-0.00238699729962) * z + np.float32(0.0135077713532)
    p = p * z - np.float32(0.0358715388503)
    p = p * z + np.float32(0.0625016943222)
    p = p * z - np.float32(0.0865688042332)
    p = p * z + np.float32(0.110337641132)
    p = p * z - np.float32(0.142785687479)
    p = p * z + np.float32(0.199997393298)
    p = p * z - np.float32(0.333333317331)
    r = s + s * z * p
    half = -_PI if y < _ZERO else _PI
    return _HALF * half - r if steep else r + (half if x < _ZERO else _ZERO)


@inline_kernel
def _highest_latitude(sine, cosine, low, high, sides2):
    """Bound on the latitude over a box in the tangent plane at latitude asin(sine).

    Args:
        low, high: how far the box reaches towards growing latitude.
        sides2: square of how far it reaches aside.
    """
    first, second = sine + low * cosine, sine + high * cosine  # sines, but for the lengths
    flat_first, flat_second = cosine - low * sine, cosine - high * sine
    first2 = flat_first * flat_first + (_ZERO if first > _ZERO else sides2)
    second2 = flat_second * flat_second + (_ZERO if second > _ZERO else sides2)
    later = second * abs(second) * first2 > first * abs(first) * second2
    over_pole = (sine > _ZERO) & (low * sine <= cosine) & (cosine <= high * sine)
    return _arctan2(
        _ONE if over_pole else (second if later else first),
        _ZERO if over_pole else math.sqrt(second2 if later else first2),
    )


@kernel
def _panorama(piece, records, rotation, height, width, boxes):
    rows = np.ones((ROWS, LANES), np.float32)
    around, side, last_y = margin(height, width), np.float32(width), np.float32(height - 1)
    last_x, per_side = np.float32(width - 1), np.float32(1 / width)
    num = len(records) // layout.RECORD_SIZE
    for start in range(piece * PIECE, min((piece + 1) * PIECE, num), LANES):
        count = min(LANES, num - start)
        read_cones(records, start, count, rotation, rows)
        _panorama_edges(rows, height, width)
        for i in range(LANES):
            x0 = np.ceil(rows[EDGES, i] - _HALF - around)
            x1 = np.floor(rows[EDGES + 1, i] - _HALF + around)
            y0 = max(np.ceil(rows[EDGES + 2, i] - _HALF - around), _ZERO)
            y1 = min(np.floor(rows[EDGES + 3, i] - _HALF + around), last_y)
            whole = x1 - x0 >= last_x
            seen = (x0 <= x1) & (y0 <= y1)
            # Half a pixel, so that rounding cannot bring a column of 0 below.
            x0 -= side * np.floor((x0 + _HALF) * per_side)
            x1 -= side * np.floor((x1 + _HALF) * per_side)
            rows[EDGES, i] = _ZERO if whole | ~seen else x0
            rows[EDGES + 1, i] = (last_x if whole else x1) if seen else _ZERO
            rows[EDGES + 2, i], rows[EDGES + 3, i] = y0 if seen else _ONE, y1 if seen else _ZERO
        write_boxes(rows, EDGES, start, count, boxes)


@inline_kernel
def _panorama_edges(rows, height, width):
    per_column, per_row = np.float32(width / (2 * math.pi)), np.float32(height / math.pi)
    middle_x, middle_y = np.float32(0.5 * width), np.float32(0.5 * height)
    for i in range(LANES):
        n, p, q, along, kappa = _cone(rows, i)
        flat = math.sqrt(n[0] * n[0] + n[2] * n[2])
        on_axis = flat < _NARROWEST
        inverse = _ZERO if on_axis else _ONE / flat
        ahead_x, ahead_z = n[0] * inverse, _ONE if on_axis else n[2] * inverse
        p_ahead, q_ahead = p[0] * ahead_x + p[2] * ahead_z, q[0] * ahead_x + q[2] * ahead_z
        p_east, q_east = p[0] * ahead_z - p[2] * ahead_x, q[0] * ahead_z - q[2] * ahead_x
        p_south, q_south = p[1] * flat - n[1] * p_ahead, q[1] * flat - n[1] * q_ahead
        p_n, q_n = dot(*p, *n), dot(*q, *n)
        east = kappa * (p_east * p_east + q_east * q_east)

        # Longitude: tangents of the shadow on the horizontal plane.
        d_ff = flat * flat - kappa * (along * flat * flat + p_ahead * p_ahead + q_ahead * q_ahead)
        middle = -kappa * (p_east * p_ahead + q_east * q_ahead)
        root = math.sqrt(max(middle * middle + east * d_ff, _ZERO))
        low, high = middle - root, middle + root
        left = _arctan2(ahead_x * d_ff + ahead_z * low, ahead_z * d_ff - ahead_x * low)
        right = _arctan2(ahead_x * d_ff + ahead_z * high, ahead_z * d_ff - ahead_x * high)
        right += _PI + _PI if right < left - _TURN_BACK else _ZERO

        # Latitude: a box around the ellipse in the plane that touches the sphere at the mean's direction.
        d_nn = _ONE - kappa * (along + p_n * p_n + q_n * q_n)
        bounded = d_nn > _ZERO
        inverse = _ONE / d_nn if bounded else _ONE
        middle = -kappa * (p_east * p_n + q_east * q_n)
        sides = (abs(middle) + math.sqrt(max(middle * middle + east * d_nn, _ZERO))) * inverse
        south = kappa * (p_south * p_south + q_south * q_south)
        middle = -kappa * (p_south * p_n + q_south * q_n)
        root = math.sqrt(max(middle * middle + south * d_nn, _ZERO))
        low, high = (middle - root) * inverse, (middle + root) * inverse
        bottom = _highest_latitude(n[1], flat, low, high, sides * sides)
        top = -_highest_latitude(-n[1], flat, -high, -low, sides * sides)
        aside = bounded & (d_ff > _ZERO)
        rows[EDGES, i] = left * per_column + middle_x if aside else -_EVERYWHERE
        rows[EDGES + 1, i] = right * per_column + middle_x if aside else _EVERYWHERE
        rows[EDGES + 2, i] = top * per_row + middle_y if bounded else -_EVERYWHERE
        last = bottom * per_row + middle_y if bounded else _EVERYWHERE
        rows[EDGES + 3, i] = _NOWHERE if kappa < _ZERO else last


def find_bounding_boxes(records: np.ndarray, picture: Picture, workspace: Workspace, threads: int) -> np.ndarray:
    """The box of each record of the exact kernel on a picture, (n, 4) int16."""
    words = workspace.array((len(records), 2), np.int32)
    rotation = np.ascontiguousarray(picture.rotation.numpy().astype(np.float32))
    height, width, numbers = *picture.size, records.reshape(-1)

    def work(piece: int) -> None:
        if picture.is_panorama:
            _panorama(piece, numbers, rotation, height, width, words)
        else:
            _pinhole(piece, numbers, rotation, height, width, picture.focal, words)

    parallel_for(work, -(-len(records) // PIECE), threads)
    return words.view(np.int16)


MAX_INTERSECTIONS = 1 << 26  # pairs listed at a time: 512 MB
_SHIFT = TILE_SIZE.bit_length() - 1
_LAST = TILE_SIZE - 1
_PARTS = 4  # of the scene a thread: some processors are slower than others
_HELD = 512  # pairs noted before they are entered: two small loops take half as long as one large
_WRITE_AHEAD = 16  # intersections of a tile, between asking for their place and writing it
_SIDE = np.int64(0xFFFF)  # a box as one word: x0, x1, y0, y1 from the lowest bits up
EMPTY_BOX = np.int64(1 << 32)  # a box as one word, the empty one of boxes.py: first row 1, last row 0


class TileIntersections(NamedTuple):
    """The Gaussians that touch each tile of some rows of tiles.

    Attributes:
        first_row: of tiles.
        intersections, starts: see records.py.
        slots: of each entry, counted within these lists; empty unless asked for.
        offsets: (n + 1), where each Gaussian's slots begin; empty unless asked for.
        workspace: of the intersections, slots and offsets.
    """

    first_row: int
    intersections: np.ndarray
    starts: np.ndarray
    slots: np.ndarray
    offsets: np.ndarray
    workspace: Workspace


@inline_kernel
def _across(word, columns):
    """How many columns of tiles a packed box touches, going on at the left if it wraps."""
    first, last, _, _ = _tiles_of(word)
    if (word >> 16 & _SIDE) >= (word & _SIDE):
        return last - first + 1
    return min(columns - first + last + 1, columns)


@inline_kernel
def _columns_in_tile(x0, x1, column, width):
    """First and last pixel column of a box within a tile, counted from the tile's corner."""
    corner = column << _SHIFT
    end = min(np.int64(_LAST), width - 1 - corner)
    low, high = max(x0 - corner, 0), min(x1 - corner, end)
    if x1 >= x0:
        return low, high
    from_left, to_right = x1 >= corner, x0 <= corner + end
    if from_left == to_right:
        return np.int64(0), end
    return (np.int64(0), high) if from_left else (low, end)


@inline_kernel
def _tiles_of(word):
    """First and last column and row of the tiles that a packed box touches, wherever it wraps."""
    shift = np.int64(_SHIFT)
    return (word & _SIDE) >> shift, (word >> 16 & _SIDE) >> shift, (word >> 32 & _SIDE) >> shift, word >> 48 >> shift


@kernel
def _count(part, ends, words, rows, columns, counts):
    """Count the Gaussians of one part of the scene in each tile.

    Args:
        rows, columns: of tiles.
        counts: (part, tile), written.
    """
    # As steps up and down between neighbouring tiles: the places of a box are apart, whatever its size.
    across, row = columns + 1, counts[part]
    steps = np.zeros((rows + 1) * across, np.int64)
    for g in range(ends[part], ends[part + 1]):
        word = element(words, g)
        first, last, top, bottom = _tiles_of(word)
        upper, lower = top * across, (bottom + 1 if word != EMPTY_BOX else top) * across
        if (word >> 16 & _SIDE) < (word & _SIDE):  # goes on at the left
            if last < first:
                _add(steps, upper, 1)
                _add(steps, lower, -1)
            else:
                first, last = np.int64(0), columns - 1
        _add(steps, upper + first, 1)
        _add(steps, upper + last + 1, -1)
        _add(steps, lower + first, -1)
        _add(steps, lower + last + 1, 1)
    for i in range(rows):
        total = np.int64(0)
        for k in range(columns):
            total += steps[i * across + k]
            row[i * columns + k] = total + (row[(i - 1) * columns + k] if i > 0 else 0)


@inline_kernel
def _add(numbers, at, step):
    """Add to one element."""
    put(numbers, at, element(numbers, at) + step)


@inline_kernel
def _note(tile, number, box, at, tiles, pairs):
    """Write down a pair of a Gaussian and a tile."""
    put(tiles, at, tile)
    put(pairs, at, number | box << 32)


@inline_kernel
def _note_corners(number, word, low, columns, width, held, tiles, pairs):
    """Note a Gaussian that touches at most two columns and two rows of tiles, with no branch to be mistaken.

    Returns:
        How many pairs are held then; each is written over by the next unless it counts.
    """
    first, last, top, bottom = _tiles_of(word)
    x0, x1, y0, y1 = word & _LAST, word >> 16 & _LAST, word >> 32 & _LAST, word >> 48 & _LAST
    aside, down = np.int64(first != last), bottom - top
    end = min(np.int64(_LAST), width - 1 - (first << _SHIFT))
    left, right = x0 | (end if aside else x1) << BOX_BITS, x1 << BOX_BITS
    upper, lower = (y0 | (np.int64(_LAST) if down else y1) << BOX_BITS) << (2 * BOX_BITS), y1 << (3 * BOX_BITS)
    above, below = (top - low) * columns, (bottom - low) * columns
    _note(above + first, number, left | upper, held, tiles, pairs)
    _note(above + last, number, right | upper, held + 1, tiles, pairs)
    held += 1 + aside
    _note(below + first, number, left | lower, held, tiles, pairs)
    held += down
    _note(below + last, number, right | lower, held, tiles, pairs)
    return held + (aside & down)


@inline_kernel
def _note_all(number, word, low, high, columns, width, held, tiles, pairs):
    """Note a Gaussian that touches any tiles of a band; how many pairs are held then."""
    first, _, top, bottom = _tiles_of(word)
    x0, x1, y0, y1 = word & _SIDE, word >> 16 & _SIDE, word >> 32 & _SIDE, word >> 48
    for i in range(max(top, low), min(bottom + 1, high) if word != EMPTY_BOX else low):
        corner = i << _SHIFT
        rows = max(y0 - corner, 0) << (2 * BOX_BITS) | min(y1 - corner, _LAST) << (3 * BOX_BITS)
        for k in range(first, first + _across(word, columns)):
            column = k if k < columns else k - columns
            left, right = _columns_in_tile(x0, x1, column, width)
            _note((i - low) * columns + column, number, left | right << BOX_BITS | rows, held, tiles, pairs)
            held += 1
    return held


@kernel
def _list(part, ends, words, columns, low, high, width, all_places, first_slots, intersections, slots, offsets):
    """Enter one part of the Gaussians in the lists of the tiles of a band.

    Args:
        low, high: rows of tiles.
        all_places: (part, tile of the band), where each part's intersections begin.
        first_slots: of each part.
        intersections: words of 64 bits.
        slots: if there are any, each entry's is written.
        offsets: likewise, where each Gaussian's slots end.
    """
    places, slot, held = all_places[part], first_slots[part], np.int64(0)
    room = _HELD + len(places) + 4
    tiles, pairs = np.empty(room, np.int64), np.empty(room, np.int64)
    for g in range(ends[part], ends[part + 1]):
        word = element(words, g)
        first, last, top, bottom = _tiles_of(word)
        small = (last - first <= 1) & (bottom - top <= 1) & ((word >> 16 & _SIDE) >= (word & _SIDE))
        if small & (top >= low) & (bottom < high) & (word != EMPTY_BOX):
            held = _note_corners(g, word, low, columns, width, held, tiles, pairs)
        else:
            held = _note_all(g, word, low, high, columns, width, held, tiles, pairs)
        if len(offsets) > 0:
            put(offsets, g + 1, slot + held)
        if held >= _HELD or g == ends[part + 1] - 1:
            for k in range(held):
                tile = element(tiles, k)
                place = element(places, tile)
                put(places, tile, place + 1)
                put(intersections, place, element(pairs, k))
                prefetch_to_write(intersections, place + _WRITE_AHEAD)
                if len(slots) > 0:
                    put(slots, place, slots.dtype.type(slot + k))
                    prefetch_to_write(slots, place + _WRITE_AHEAD)
            slot, held = slot + held, np.int64(0)


def intersect_tiles(
    boxes: np.ndarray, size: tuple[int, int], *, slots: bool, threads: int, limit: int = MAX_INTERSECTIONS
) -> Iterator[TileIntersections]:
    """Lists for all tiles, in bands of tile rows with at most `limit` pairs (a single row may hold more).

    Args:
        boxes: (n, 4) int16, see boxes.py.
        size: height and width, pixels.
        slots: whether to number the pairs for the backward.
        threads: to work on; the lists do not depend on it.
        limit: number of pairs.
    """
    rows, columns = (-(-side // TILE_SIZE) for side in size)
    words = boxes.view(np.int64)[:, 0]
    parts = _PARTS * threads if threads > 1 else 1
    ends = np.linspace(0, len(words), parts + 1).astype(np.int64)
    all_counts = np.empty((parts, rows * columns), np.int64)
    parallel_for(lambda part: _count(part, ends, words, rows, columns, all_counts), parts, threads)
    per_row = all_counts.sum(axis=0).reshape(rows, columns).sum(axis=1)
    for low, high in _bands(per_row.tolist(), limit):
        counts, workspace = all_counts[:, low * columns : high * columns], Workspace()
        starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts.sum(axis=0))))
        places, per_part = starts[:-1] + np.cumsum(counts, axis=0) - counts, counts.sum(axis=1)
        count = int(starts[-1])
        intersections = workspace.array(count, np.int64)
        numbers = workspace.array(count if slots else 0, np.int32 if count < 2**31 else np.int64)
        offsets = workspace.array(len(words) + 1 if slots else 0, np.int64)
        offsets[:1] = 0
        lists = places, np.cumsum(per_part) - per_part, intersections, numbers, offsets
        parallel_for(_bound(_list, ends, words, columns, low, high, size[1], *lists), parts, threads)
        yield TileIntersections(low, intersections.view(np.int32).reshape(-1, 2), starts, numbers, offsets, workspace)


def _bands(per_row: list[int], limit: int) -> Iterator[tuple[int, int]]:
    """Split rows into runs whose pairs sum to at most `limit`, one row at least."""
    low, total = 0, 0
    for row, count in enumerate(per_row):
        if row > low and total + count > limit:
            yield low, row
            low, total = row, 0
        total += count
    yield low, len(per_row)


def _bound(work: Callable[..., None], *arguments: object) -> Callable[[int], None]:
    """A kernel with all its arguments but the first."""
    return lambda part: work(part, *arguments)


_DIGIT = 11  # bits sorted by at a time, at most: 2048 counters stay in the first cache
_MORE = 3  # bits of a digit beyond half of those that number a tile's intersections: few are left out of order
_PIECES = 8  # of work a thread
_PATIENCE = 4  # places an entry is moved by insertion, on average, before it is given up
_READ_AHEAD = 32  # intersections, between asking for a distance and reading it
_ROUNDING = 12  # lowest bits of a distance: equal ones, found by other steps, may differ in the last few, so cut them
_FLIP = np.int64(0x7FFFFFFFFFFFFFFF)


@kernel
def _measure(piece, records, radii, towards, depths):
    """Write the depths along an axis of a piece's Gaussians."""
    for g in range(piece * PIECE, min((piece + 1) * PIECE, len(radii))):
        x = np.float64(records[g, 0]) + np.float64(records[g, 3])
        y = np.float64(records[g, 1]) + np.float64(records[g, 4])
        z = np.float64(records[g, 2]) + np.float64(records[g, 5])
        depths[g] = radii[g] * (x * towards[0] + y * towards[1] + z * towards[2])


def compute_depths(
    records: np.ndarray, radii: np.ndarray, towards: np.ndarray, workspace: Workspace, threads: int
) -> np.ndarray:
    """How far Gaussians lie along an axis, (n,) float64, metres.

    Args:
        records: of the Gaussians.
        radii: float64, metres.
        towards: the axis in the records' axes.
        workspace: for the depths.
        threads: to work on.
    """
    depths = workspace.array(len(radii), np.float64)
    parallel_for(lambda piece: _measure(piece, records, radii, towards, depths), -(-len(radii) // PIECE), threads)
    return depths


@inline_kernel
def _read_keys(intersections, slots, keys, begin, count, words, own_entries, own_slots):
    """Copy a tile's intersections and slots, and fetch its distances as integers; return the range."""
    low, high, end = _FLIP, -_FLIP, len(intersections) - 1
    for j in range(count):
        prefetch(keys, element(intersections, min(begin + j + _READ_AHEAD, end)) & np.int64(0xFFFFFFFF))
        entry = element(intersections, begin + j)
        key = element(keys, entry & np.int64(0xFFFFFFFF))
        key = (key if key >= 0 else (key ^ _FLIP) + 1) >> _ROUNDING  # -0.0 is 0.0
        low, high = min(low, key), max(high, key)
        put(words, j, np.uint64(key))
        put(own_entries, j, entry)
    if len(slots) > 0:
        for j in range(count):
            put(own_slots, j, element(slots, begin + j))
    return np.uint64(low), np.uint64(high)


@inline_kernel
def _bit_length(number):
    bits = 0
    while number > 0:
        number >>= np.uint64(1)
        bits += 1
    return bits


@inline_kernel
def _pack(words, count, least, cut, place_bits, low, high, bits, low_counters, high_counters):
    """Put each key's place below it, and count two digits of `bits` bits, from bits `low` and `high` on."""
    for digit in range(1 << bits):
        put(low_counters, digit, np.int32(0))
        put(high_counters, digit, np.int32(0))
    mask = (np.uint64(1) << np.uint64(bits)) - np.uint64(1)
    for j in range(count):
        word = (element(words, j) - least) >> cut << np.uint64(place_bits) | np.uint64(j)
        put(words, j, word)
        first, second = np.int64(word >> np.uint64(low) & mask), np.int64(word >> np.uint64(high) & mask)
        put(low_counters, first, np.int32(element(low_counters, first) + 1))
        put(high_counters, second, np.int32(element(high_counters, second) + 1))


@inline_kernel
def _deal(words, count, shift, bits, counters, dealt):
    """Move words to where a digit puts them, keeping the order of equal ones; the counters are lost."""
    mask, total = (np.uint64(1) << np.uint64(bits)) - np.uint64(1), np.int64(0)
    for digit in range(1 << bits):
        held = element(counters, digit)
        put(counters, digit, np.int32(total))
        total += np.int64(held)
    for j in range(count):
        word = element(words, j)
        digit = np.int64(word >> np.uint64(shift) & mask)
        place = element(counters, digit)
        put(counters, digit, np.int32(place + 1))
        put(dealt, np.int64(place), word)


@inline_kernel
def _insert(words, count):
    """Sort words that are nearly in order; whether they were near enough."""
    moves = np.int64(0)
    for j in range(1, count):
        word, at = element(words, j), j
        while at > 0 and element(words, at - 1) > word:
            put(words, at, element(words, at - 1))
            at -= 1
        put(words, at, word)
        moves += j - at
        if moves > _PATIENCE * count:
            return False
    return True


@inline_kernel
def _sort_by_all_digits(words, spare, count, end, counters):
    """Sort words of `end` bits, however they are spread; the two arrays, sorted first."""
    for shift in range(0, end, _DIGIT):
        counters[:] = 0
        for j in range(count):
            digit = np.int64(element(words, j) >> np.uint64(shift) & np.uint64((1 << _DIGIT) - 1))
            put(counters, digit, np.int32(element(counters, digit) + 1))
        _deal(words, count, shift, _DIGIT, counters, spare)
        words, spare = spare, words
    return words, spare


@kernel
def _sort_tiles(intersections, slots, keys, starts, low, high):
    """Sort the intersections and slots of some tiles.

    Args:
        intersections: flat words of 64 bits.
        keys: the distances' bits, as int64.
    """
    most = 1
    for tile in range(low, high):
        most = max(most, starts[tile + 1] - starts[tile])
    words, dealt, own_entries = np.empty(most, np.uint64), np.empty(most, np.uint64), np.empty(most, np.int64)
    own_slots = np.empty(most if len(slots) > 0 else 0, slots.dtype)
    low_counters, high_counters = np.empty(1 << _DIGIT, np.int32), np.empty(1 << _DIGIT, np.int32)
    for tile in range(low, high):
        begin, count = starts[tile], starts[tile + 1] - starts[tile]
        if count < 2:
            continue
        least, largest = _read_keys(intersections, slots, keys, begin, count, words, own_entries, own_slots)
        key_bits, place_bits = _bit_length(largest - least), _bit_length(np.uint64(count - 1))
        cut = max(0, key_bits + place_bits - 64)
        end = key_bits - cut + place_bits
        bits = min(place_bits // 2 + _MORE, _DIGIT, end // 2)
        upper, lower = end - bits, end - 2 * bits
        _pack(words, count, least, np.uint64(cut), place_bits, lower, upper, bits, low_counters, high_counters)
        _deal(words, count, lower, bits, low_counters, dealt)
        _deal(dealt, count, upper, bits, high_counters, words)
        if not _insert(words, count):
            words, dealt = _sort_by_all_digits(words, dealt, count, end, low_counters)
        mask = (np.uint64(1) << np.uint64(place_bits)) - np.uint64(1)
        for j in range(count):
            place = np.int64(element(words, j) & mask)
            put(intersections, begin + j, element(own_entries, place))
            if len(slots) > 0:
                put(slots, begin + j, element(own_slots, place))


def sort_front_to_back(lists: TileIntersections, distances: np.ndarray, threads: int) -> None:
    """Sort each tile's intersections, with their slots, nearest first.

    Args:
        lists: of tiles, in the order of the Gaussians' numbers; sorted in place.
        distances: of the Gaussians, float64, cut to a part in 2^40; to a little less in a tile of such a range that
            keys and places together exceed 64 bits.
        threads: to work on; the order does not depend on it.
    """
    pieces = split_tiles(lists.starts, threads)
    intersections, keys = lists.intersections.reshape(-1).view(np.int64), distances.view(np.int64)

    def work(piece: int) -> None:
        _sort_tiles(intersections, lists.slots, keys, lists.starts, pieces[piece], pieces[piece + 1])

    parallel_for(work, len(pieces) - 1, threads)


def split_tiles(starts: np.ndarray, threads: int) -> list[int]:
    """Where to cut a band of tiles into pieces of about the same number of intersections."""
    tiles = len(starts) - 1
    # Empty tiles are not free: count each as some intersections.
    cost = starts - starts[0] + 32 * np.arange(tiles + 1)
    wanted = np.linspace(0, cost[-1], min(tiles, _PIECES * threads if threads > 1 else 1) + 1)
    return [int(cut) for cut in np.unique(np.searchsorted(cost, wanted))]
