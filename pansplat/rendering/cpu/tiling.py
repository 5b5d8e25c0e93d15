"""Stage two: bounding boxes on the image plane, their tile intersections, and the intersections sorted by distance.

Source: docs/rendering.md, section 5. A record yields its covariance as a sum of squares. With w = (a ^ b).n and the
dual axes p = (b ^ n) / w - l_along_a n and q = (n ^ a) / w - l_along_b n,

    C' = S' n n' + p p' + q q'

so h' C' h has no cancellation. Boxes are exact on pinhole images, and tight and conservative on panoramas.

A box is four int16: first and last column, first and last row, inclusive. It is empty if the last row is above the
first; on a panorama it wraps around if the last column is left of the first.
"""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from pansplat.constants import ALPHA_CUT, KAPPA_MARGIN
from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.projection import CULLED, GAUSSIAN_BLOCK, GAUSSIANS_PER_ITEM, cross, dot
from pansplat.rendering.cpu.records import BOX_BITS, TILE_SIZE
from pansplat.rendering.cpu.simd import load_scalar, prefetch, prefetch_for_write, records_to_soa, store_scalar
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.reference import split_rows
from pansplat.system.kernels import Workspace, inline_kernel, kernel, parallel_for

# --- bounding boxes ---

LARGEST_SIDE = 32767  # pixels of an image's longer side; boxes are int16
_KAPPA_MARGIN = np.float32(KAPPA_MARGIN)
_LOG2_ALPHA_CUT = np.float32(math.log2(ALPHA_CUT))

# float32 suffices, since a margin covers its rounding. Python floats would promote the arithmetic to float64.
_ZERO, _ONE, _HALF, _PI = np.float32(0), np.float32(1), np.float32(0.5), np.float32(math.pi)
_SCALE, _ROOT_SCALE = np.float32(layout.HALF_LOG2_E), np.float32(math.sqrt(layout.HALF_LOG2_E))
_MIN_HORIZONTAL = np.float32(1e-12)  # length of a unit direction's horizontal part
_WRAP_TOLERANCE = np.float32(1e-6)  # radians
_ABOVE_IMAGE = np.float32(-1e9)  # last row of an empty box
_CULLED = np.float32(CULLED)
_UNBOUNDED = np.float32(1e9)  # pixels; the edge of a footprint without one

# Rows of a block of Gaussians: the record's numbers, then those derived from them.
_RADIAL_VARIANCE, _KAPPA = layout.RADIAL_VARIANCE, layout.LOG2_PEAK  # overwritten in place
_N, _P, _Q = layout.RECORD_SIZE, layout.RECORD_SIZE + 3, layout.RECORD_SIZE + 6
_EDGES = layout.RECORD_SIZE + 9  # left, right, top, bottom, pixels
_NUM_ROWS = layout.RECORD_SIZE + 13


@inline_kernel
def _pixel_margin(height, width):
    """Pixels added around each box, far more than rounding."""
    return np.float32(0.01 + 1e-6 * max(height, width))


@inline_kernel
def _load_cones(records, start, count, rotation, rows):
    """Compute directions, dual axes, S' and kappa of a block in the image plane's axes; kappa is -1 if culled.

    Args:
        records: flat.
        rotation: float32, the image plane's axes in the records'.
    """
    records_to_soa(records, start, count, rows.reshape(-1), GAUSSIAN_BLOCK)
    right = rotation[0, 0], rotation[1, 0], rotation[2, 0]
    down = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    ahead = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    row_a, row_b = layout.ROW_A, layout.ROW_B
    for i in range(GAUSSIAN_BLOCK):
        n = rows[0, i], rows[1, i], rows[2, i]
        a = rows[row_a, i], rows[row_a + 1, i], rows[row_a + 2, i]
        b = rows[row_b, i], rows[row_b + 1, i], rows[row_b + 2, i]
        p, q = _dual_axes(n, a, b, rows[layout.L_ALONG_A, i], rows[layout.L_ALONG_B, i])
        rows[_N, i], rows[_N + 1, i], rows[_N + 2, i] = dot(*right, *n), dot(*down, *n), dot(*ahead, *n)
        rows[_P, i], rows[_P + 1, i] = _ROOT_SCALE * dot(*right, *p), _ROOT_SCALE * dot(*down, *p)
        rows[_P + 2, i], rows[_Q, i] = _ROOT_SCALE * dot(*ahead, *p), _ROOT_SCALE * dot(*right, *q)
        rows[_Q + 1, i], rows[_Q + 2, i] = _ROOT_SCALE * dot(*down, *q), _ROOT_SCALE * dot(*ahead, *q)
        rows[_RADIAL_VARIANCE, i] *= _SCALE
        log2_peak = rows[_KAPPA, i]
        rows[_KAPPA, i] = (log2_peak - _LOG2_ALPHA_CUT) / _SCALE + _KAPPA_MARGIN if log2_peak > _CULLED else -_ONE


@inline_kernel
def _dual_axes(n, a, b, l_along_a, l_along_b):
    """Axes p and q of a record, in its units: C' / HALF_LOG2_E = radial_variance n n' + p p' + q q'."""
    inverse = _ONE / dot(*cross(*a, *b), *n)
    bn, na = cross(*b, *n), cross(*n, *a)
    p = bn[0] * inverse - l_along_a * n[0], bn[1] * inverse - l_along_a * n[1], bn[2] * inverse - l_along_a * n[2]
    q = na[0] * inverse - l_along_b * n[0], na[1] * inverse - l_along_b * n[1], na[2] * inverse - l_along_b * n[2]
    return p, q


@inline_kernel
def _cone(rows, i):
    """n, p, q, S' and kappa of one Gaussian of a block."""
    n = rows[_N, i], rows[_N + 1, i], rows[_N + 2, i]
    p = rows[_P, i], rows[_P + 1, i], rows[_P + 2, i]
    q = rows[_Q, i], rows[_Q + 1, i], rows[_Q + 2, i]
    return n, p, q, rows[_RADIAL_VARIANCE, i], rows[_KAPPA, i]


@inline_kernel
def _pinhole_edges(n_x, n_z, p_x, p_z, q_x, q_z, radial_variance, kappa):
    """Tangents of a cone's bounding planes through one axis, times D_zz, as midpoint and half width."""
    p_across, q_across = p_x * n_z - p_z * n_x, q_x * n_z - q_z * n_x
    across = p_across * p_across + q_across * q_across
    minor = p_x * q_z - p_z * q_x
    root = math.sqrt(max(kappa * across - kappa * kappa * (radial_variance * across + minor * minor), _ZERO))
    return n_x * n_z - kappa * (radial_variance * n_x * n_z + p_x * p_z + q_x * q_z), root


@inline_kernel
def _is_outside(n, p, q, radial_variance, kappa, normal_x, normal_y, normal_z):
    """Whether a cone lies behind a plane through the camera centre with this normal."""
    h = normal_x, normal_y, normal_z
    distance, on_p, on_q = dot(*n, *h), dot(*p, *h), dot(*q, *h)
    reach = kappa * (radial_variance * distance * distance + on_p * on_p + on_q * on_q)
    return (distance * distance > reach) & (distance < _ZERO)


@kernel
def _bound_pinhole(records, rotation, height, width, focal, boxes, item):
    rows = np.ones((_NUM_ROWS, GAUSSIAN_BLOCK), np.float32)
    tan_x, tan_y = np.float32(width / (2 * focal)), np.float32(height / (2 * focal))  # tangents of half the field
    middle_x, middle_y, scale = np.float32(0.5 * width), np.float32(0.5 * height), np.float32(focal)
    num = len(records) // layout.RECORD_SIZE
    for start in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, num), GAUSSIAN_BLOCK):
        count = min(GAUSSIAN_BLOCK, num - start)
        _load_cones(records, start, count, rotation, rows)
        for i in range(GAUSSIAN_BLOCK):
            n, p, q, radial_variance, kappa = _cone(rows, i)
            d_zz = n[2] * n[2] - kappa * (radial_variance * n[2] * n[2] + p[2] * p[2] + q[2] * q[2])
            x, root_x = _pinhole_edges(n[0], n[2], p[0], p[2], q[0], q[2], radial_variance, kappa)
            y, root_y = _pinhole_edges(n[1], n[2], p[1], p[2], q[1], q[2], radial_variance, kappa)
            bounded = d_zz > _ZERO  # else the cone crosses the plane z = 0
            to_pixels = scale / d_zz
            invisible = (kappa < _ZERO) | (bounded & (n[2] < _ZERO))
            # A cone that crosses the plane z = 0 has no bounding box; most such cones are outside the field of view.
            invisible |= _is_outside(n, p, q, radial_variance, kappa, _ONE, _ZERO, tan_x)
            invisible |= _is_outside(n, p, q, radial_variance, kappa, -_ONE, _ZERO, tan_x)
            invisible |= _is_outside(n, p, q, radial_variance, kappa, _ZERO, _ONE, tan_y)
            invisible |= _is_outside(n, p, q, radial_variance, kappa, _ZERO, -_ONE, tan_y)
            rows[_EDGES, i] = (x - root_x) * to_pixels + middle_x if bounded else -_UNBOUNDED
            rows[_EDGES + 1, i] = (x + root_x) * to_pixels + middle_x if bounded else _UNBOUNDED
            rows[_EDGES + 2, i] = (y - root_y) * to_pixels + middle_y if bounded else -_UNBOUNDED
            bottom = (y + root_y) * to_pixels + middle_y if bounded else _UNBOUNDED
            rows[_EDGES + 3, i] = _ABOVE_IMAGE if invisible else bottom
        _round_boxes(rows, start, count, height, width, boxes)


@inline_kernel
def _round_boxes(rows, start, count, height, width, boxes):
    """Write the boxes of the pixels whose centres lie within the edges (n, 2), two numbers per int32."""
    margin = _pixel_margin(height, width)
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    for i in range(GAUSSIAN_BLOCK):
        x0 = max(np.ceil(rows[_EDGES, i] - _HALF - margin), _ZERO)
        x1 = min(np.floor(rows[_EDGES + 1, i] - _HALF + margin), last_x)
        y0 = max(np.ceil(rows[_EDGES + 2, i] - _HALF - margin), _ZERO)
        y1 = min(np.floor(rows[_EDGES + 3, i] - _HALF + margin), last_y)
        visible = (x0 <= x1) & (y0 <= y1)
        rows[_EDGES, i], rows[_EDGES + 1, i] = x0 if visible else _ZERO, x1 if visible else _ZERO
        rows[_EDGES + 2, i], rows[_EDGES + 3, i] = y0 if visible else _ONE, y1 if visible else _ZERO
    _write_boxes(rows, start, count, boxes)


@inline_kernel
def _write_boxes(rows, start, count, boxes):
    """Write the edges, which are whole numbers, as boxes (n, 2), two numbers per int32."""
    for i in range(count):
        boxes[start + i, 0] = np.int32(rows[_EDGES, i]) | np.int32(rows[_EDGES + 1, i]) << np.int32(16)
        boxes[start + i, 1] = np.int32(rows[_EDGES + 2, i]) | np.int32(rows[_EDGES + 3, i]) << np.int32(16)


@inline_kernel
def _arctan2(y, x):
    """atan2 within 3e-7 radians (a polynomial fit at Chebyshev nodes), with one division."""
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
def _max_latitude(sine, cosine, low, high, sides2):
    """Upper bound of the latitude over a box in the tangent plane at latitude asin(sine).

    Args:
        low, high: extent of the box towards growing latitude.
        sides2: squared extent of the box to the side.
    """
    first, second = sine + low * cosine, sine + high * cosine  # sines before normalisation
    horizontal_first, horizontal_second = cosine - low * sine, cosine - high * sine
    first2 = horizontal_first * horizontal_first + (_ZERO if first > _ZERO else sides2)
    second2 = horizontal_second * horizontal_second + (_ZERO if second > _ZERO else sides2)
    second_is_higher = second * abs(second) * first2 > first * abs(first) * second2
    holds_pole = (sine > _ZERO) & (low * sine <= cosine) & (cosine <= high * sine)
    return _arctan2(
        _ONE if holds_pole else (second if second_is_higher else first),
        _ZERO if holds_pole else math.sqrt(second2 if second_is_higher else first2),
    )


@kernel
def _bound_equirect(records, rotation, height, width, boxes, item):
    rows = np.ones((_NUM_ROWS, GAUSSIAN_BLOCK), np.float32)
    margin, period, last_y = _pixel_margin(height, width), np.float32(width), np.float32(height - 1)
    last_x, inverse_period = np.float32(width - 1), np.float32(1 / width)
    num = len(records) // layout.RECORD_SIZE
    for start in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, num), GAUSSIAN_BLOCK):
        count = min(GAUSSIAN_BLOCK, num - start)
        _load_cones(records, start, count, rotation, rows)
        _equirect_edges(rows, height, width)
        for i in range(GAUSSIAN_BLOCK):
            x0 = np.ceil(rows[_EDGES, i] - _HALF - margin)
            x1 = np.floor(rows[_EDGES + 1, i] - _HALF + margin)
            y0 = max(np.ceil(rows[_EDGES + 2, i] - _HALF - margin), _ZERO)
            y1 = min(np.floor(rows[_EDGES + 3, i] - _HALF + margin), last_y)
            full_width = x1 - x0 >= last_x
            visible = (x0 <= x1) & (y0 <= y1)
            # Add half a pixel, so that rounding cannot move column 0 below 0.
            x0 -= period * np.floor((x0 + _HALF) * inverse_period)
            x1 -= period * np.floor((x1 + _HALF) * inverse_period)
            rows[_EDGES, i] = _ZERO if full_width | ~visible else x0
            rows[_EDGES + 1, i] = (last_x if full_width else x1) if visible else _ZERO
            rows[_EDGES + 2, i], rows[_EDGES + 3, i] = y0 if visible else _ONE, y1 if visible else _ZERO
        _write_boxes(rows, start, count, boxes)


@inline_kernel
def _equirect_edges(rows, height, width):
    per_column, per_row = np.float32(width / (2 * math.pi)), np.float32(height / math.pi)
    middle_x, middle_y = np.float32(0.5 * width), np.float32(0.5 * height)
    for i in range(GAUSSIAN_BLOCK):
        n, p, q, radial_variance, kappa = _cone(rows, i)
        horizontal = math.sqrt(n[0] * n[0] + n[2] * n[2])
        on_axis = horizontal < _MIN_HORIZONTAL
        inverse = _ZERO if on_axis else _ONE / horizontal
        ahead_x, ahead_z = n[0] * inverse, _ONE if on_axis else n[2] * inverse
        p_ahead, q_ahead = p[0] * ahead_x + p[2] * ahead_z, q[0] * ahead_x + q[2] * ahead_z
        p_east, q_east = p[0] * ahead_z - p[2] * ahead_x, q[0] * ahead_z - q[2] * ahead_x
        p_south, q_south = p[1] * horizontal - n[1] * p_ahead, q[1] * horizontal - n[1] * q_ahead
        p_n, q_n = dot(*p, *n), dot(*q, *n)
        east = kappa * (p_east * p_east + q_east * q_east)

        # Longitude: tangents of the cone's projection on the horizontal plane.
        d_ff = horizontal * horizontal - kappa * (
            radial_variance * horizontal * horizontal + p_ahead * p_ahead + q_ahead * q_ahead
        )
        middle = -kappa * (p_east * p_ahead + q_east * q_ahead)
        root = math.sqrt(max(middle * middle + east * d_ff, _ZERO))
        low, high = middle - root, middle + root
        left = _arctan2(ahead_x * d_ff + ahead_z * low, ahead_z * d_ff - ahead_x * low)
        right = _arctan2(ahead_x * d_ff + ahead_z * high, ahead_z * d_ff - ahead_x * high)
        right += _PI + _PI if right < left - _WRAP_TOLERANCE else _ZERO

        # Latitude: a box around the ellipse in the plane tangent to the sphere at n.
        d_nn = _ONE - kappa * (radial_variance + p_n * p_n + q_n * q_n)
        bounded = d_nn > _ZERO
        inverse = _ONE / d_nn if bounded else _ONE
        middle = -kappa * (p_east * p_n + q_east * q_n)
        sides = (abs(middle) + math.sqrt(max(middle * middle + east * d_nn, _ZERO))) * inverse
        south = kappa * (p_south * p_south + q_south * q_south)
        middle = -kappa * (p_south * p_n + q_south * q_n)
        root = math.sqrt(max(middle * middle + south * d_nn, _ZERO))
        low, high = (middle - root) * inverse, (middle + root) * inverse
        bottom = _max_latitude(n[1], horizontal, low, high, sides * sides)
        top = -_max_latitude(-n[1], horizontal, -high, -low, sides * sides)
        has_longitudes = bounded & (d_ff > _ZERO)
        rows[_EDGES, i] = left * per_column + middle_x if has_longitudes else -_UNBOUNDED
        rows[_EDGES + 1, i] = right * per_column + middle_x if has_longitudes else _UNBOUNDED
        rows[_EDGES + 2, i] = top * per_row + middle_y if bounded else -_UNBOUNDED
        bottom = bottom * per_row + middle_y if bounded else _UNBOUNDED
        rows[_EDGES + 3, i] = _ABOVE_IMAGE if kappa < _ZERO else bottom


def find_bounding_boxes(records: np.ndarray, plane: ImagePlane, workspace: Workspace, threads: int) -> np.ndarray:
    """Bounding box of each record on an image plane, (n, 4) int16."""
    words = workspace.array((len(records), 2), np.int32)
    rotation = np.ascontiguousarray(plane.rotation.numpy().astype(np.float32))
    if plane.is_panorama:
        bound = partial(_bound_equirect, records.reshape(-1), rotation, *plane.size, words)
    else:
        bound = partial(_bound_pinhole, records.reshape(-1), rotation, *plane.size, plane.focal, words)
    parallel_for(bound, -(-len(records) // GAUSSIANS_PER_ITEM), threads)
    return words.view(np.int16)


# --- tile intersections ---
#
# A counting sort of tile intersections, in bands of tile rows to bound the memory. For the backward every intersection
# has a slot, and the slots of one Gaussian are contiguous: tiles write gradients without conflicts, and the slots of
# each Gaussian are summed in a fixed order.

MAX_INTERSECTIONS = 1 << 26  # intersections in a band, which take 512 MB
_TILE_SHIFT = TILE_SIZE.bit_length() - 1
_LAST_PIXEL = TILE_SIZE - 1
_PARTS_PER_THREAD = 4  # parts of a scene for each thread: some cores are slower than others
_BUFFER_SIZE = 512  # intersections buffered before a write: two small loops are twice as fast as one large loop
_WRITE_AHEAD = 16  # intersections of a tile between the prefetch of a cache line and the write
_INT16_MASK = np.int64(0xFFFF)  # a box as one word: x0, x1, y0, y1 from the lowest bits up
EMPTY_BOX = np.int64(1 << 32)  # the empty box as one word: first row 1, last row 0


class TileIntersections(NamedTuple):
    """Tile intersections of a band of tile rows.

    Attributes:
        first_row: first row of tiles of the band.
        intersections, starts: see records.py.
        slots: slot of each intersection, counted within the band; empty unless requested.
        offsets: (n + 1), first slot of each Gaussian; empty unless requested.
        workspace: memory of intersections, slots and offsets.
    """

    first_row: int
    intersections: np.ndarray
    starts: np.ndarray
    slots: np.ndarray
    offsets: np.ndarray
    workspace: Workspace


@inline_kernel
def _count_columns(word, columns):
    """Number of tile columns that a packed box reaches, around the panorama if it wraps."""
    first, last, _, _ = _tile_range(word)
    if (word >> 16 & _INT16_MASK) >= (word & _INT16_MASK):
        return last - first + 1
    return min(columns - first + last + 1, columns)


@inline_kernel
def _columns_in_tile(x0, x1, column, width):
    """First and last pixel column of a box within a tile, relative to the tile."""
    corner = column << _TILE_SHIFT
    end = min(np.int64(_LAST_PIXEL), width - 1 - corner)
    low, high = max(x0 - corner, 0), min(x1 - corner, end)
    if x1 >= x0:
        return low, high
    from_left, to_right = x1 >= corner, x0 <= corner + end
    if from_left == to_right:
        return np.int64(0), end
    return (np.int64(0), high) if from_left else (low, end)


@inline_kernel
def _tile_range(word):
    """Tiles of a packed box's first and last column and first and last row."""
    shift = np.int64(_TILE_SHIFT)
    return (
        (word & _INT16_MASK) >> shift,
        (word >> 16 & _INT16_MASK) >> shift,
        (word >> 32 & _INT16_MASK) >> shift,
        word >> 48 >> shift,
    )


@kernel
def _count_intersections(ends, words, rows, columns, counts, part):
    """Count the Gaussians of one part of the scene in each tile.

    Args:
        words: packed boxes.
        rows, columns: number of rows and columns of tiles.
        counts: (part, tile), written.
    """
    # Differences between neighbouring tiles are counted, so that a box of any size costs four updates.
    across, row = columns + 1, counts[part]
    steps = np.zeros((rows + 1) * across, np.int64)
    for g in range(ends[part], ends[part + 1]):
        word = load_scalar(words, g)
        first, last, top, bottom = _tile_range(word)
        upper, lower = top * across, (bottom + 1 if word != EMPTY_BOX else top) * across
        if (word >> 16 & _INT16_MASK) < (word & _INT16_MASK):  # the box wraps around
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
def _add(numbers, index, step):
    store_scalar(numbers, index, load_scalar(numbers, index) + step)


@inline_kernel
def _buffer_intersection(tile, gaussian, box, index, tiles, packed):
    store_scalar(tiles, index, tile)
    store_scalar(packed, index, gaussian | box << 32)


@inline_kernel
def _buffer_four(gaussian, word, low, columns, width, buffered, tiles, packed):
    """Buffer the intersections of a Gaussian with at most 2 x 2 tiles, without branches.

    Returns:
        The number of buffered intersections. Four are always written; the next Gaussian overwrites the surplus.
    """
    first, last, top, bottom = _tile_range(word)
    x0, x1, y0, y1 = word & _LAST_PIXEL, word >> 16 & _LAST_PIXEL, word >> 32 & _LAST_PIXEL, word >> 48 & _LAST_PIXEL
    two_columns, two_rows = np.int64(first != last), bottom - top
    end = min(np.int64(_LAST_PIXEL), width - 1 - (first << _TILE_SHIFT))
    left, right = x0 | (end if two_columns else x1) << BOX_BITS, x1 << BOX_BITS
    upper = (y0 | (np.int64(_LAST_PIXEL) if two_rows else y1) << BOX_BITS) << (2 * BOX_BITS)
    lower = y1 << (3 * BOX_BITS)
    above, below = (top - low) * columns, (bottom - low) * columns
    _buffer_intersection(above + first, gaussian, left | upper, buffered, tiles, packed)
    _buffer_intersection(above + last, gaussian, right | upper, buffered + 1, tiles, packed)
    buffered += 1 + two_columns
    _buffer_intersection(below + first, gaussian, left | lower, buffered, tiles, packed)
    buffered += two_rows
    _buffer_intersection(below + last, gaussian, right | lower, buffered, tiles, packed)
    return buffered + (two_columns & two_rows)


@inline_kernel
def _buffer_all(gaussian, word, low, high, columns, width, buffered, tiles, packed):
    """Buffer the intersections of a Gaussian with any tiles of a band; return the number of buffered ones."""
    first, _, top, bottom = _tile_range(word)
    x0, x1, y0, y1 = word & _INT16_MASK, word >> 16 & _INT16_MASK, word >> 32 & _INT16_MASK, word >> 48
    for i in range(max(top, low), min(bottom + 1, high) if word != EMPTY_BOX else low):
        corner = i << _TILE_SHIFT
        rows = max(y0 - corner, 0) << (2 * BOX_BITS) | min(y1 - corner, _LAST_PIXEL) << (3 * BOX_BITS)
        for k in range(first, first + _count_columns(word, columns)):
            column = k if k < columns else k - columns
            left, right = _columns_in_tile(x0, x1, column, width)
            tile, box = (i - low) * columns + column, left | right << BOX_BITS | rows
            _buffer_intersection(tile, gaussian, box, buffered, tiles, packed)
            buffered += 1
    return buffered


@kernel
def _write_intersections(
    ends, words, columns, low, high, width, all_positions, first_slots, intersections, slots, offsets, part
):
    """Write the intersections of one part of the scene with the tiles of a band.

    Args:
        words: packed boxes.
        low, high: rows of tiles.
        all_positions: (part, tile of the band), index of each part's first intersection.
        first_slots: first slot of each part.
        intersections: as 64-bit words.
        slots: slot of each intersection, written unless empty.
        offsets: end of each Gaussian's slots, written unless empty.
    """
    positions, slot, buffered = all_positions[part], first_slots[part], np.int64(0)
    capacity = _BUFFER_SIZE + len(positions) + 4
    tiles, packed = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    for g in range(ends[part], ends[part + 1]):
        word = load_scalar(words, g)
        first, last, top, bottom = _tile_range(word)
        small = (last - first <= 1) & (bottom - top <= 1) & ((word >> 16 & _INT16_MASK) >= (word & _INT16_MASK))
        if small & (top >= low) & (bottom < high) & (word != EMPTY_BOX):
            buffered = _buffer_four(g, word, low, columns, width, buffered, tiles, packed)
        else:
            buffered = _buffer_all(g, word, low, high, columns, width, buffered, tiles, packed)
        if len(offsets) > 0:
            store_scalar(offsets, g + 1, slot + buffered)
        if buffered >= _BUFFER_SIZE or g == ends[part + 1] - 1:
            for k in range(buffered):
                tile = load_scalar(tiles, k)
                position = load_scalar(positions, tile)
                store_scalar(positions, tile, position + 1)
                store_scalar(intersections, position, load_scalar(packed, k))
                prefetch_for_write(intersections, position + _WRITE_AHEAD)
                if len(slots) > 0:
                    store_scalar(slots, position, slots.dtype.type(slot + k))
                    prefetch_for_write(slots, position + _WRITE_AHEAD)
            slot, buffered = slot + buffered, np.int64(0)


def intersect_tiles(
    boxes: np.ndarray, size: tuple[int, int], *, slots: bool, threads: int, limit: int = MAX_INTERSECTIONS
) -> Iterator[TileIntersections]:
    """Tile intersections of all tiles, Gaussians in index order, in bands of tile rows.

    Args:
        boxes: (n, 4) int16.
        size: height and width, pixels.
        slots: whether to assign slots for the backward.
        limit: largest number of intersections in a band, unless a single row has more.
    """
    rows, columns = (-(-side // TILE_SIZE) for side in size)
    words = boxes.view(np.int64)[:, 0]
    parts = _PARTS_PER_THREAD * threads if threads > 1 else 1
    ends = np.linspace(0, len(words), parts + 1).astype(np.int64)
    all_counts = np.empty((parts, rows * columns), np.int64)
    parallel_for(partial(_count_intersections, ends, words, rows, columns, all_counts), parts, threads)
    per_row = all_counts.sum(axis=0).reshape(rows, columns).sum(axis=1)
    for low, high in split_rows(per_row.tolist(), limit):
        counts, workspace = all_counts[:, low * columns : high * columns], Workspace()
        starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts.sum(axis=0))))
        positions, per_part = starts[:-1] + np.cumsum(counts, axis=0) - counts, counts.sum(axis=1)
        num = int(starts[-1])
        intersections = workspace.array(num, np.int64)
        numbers = workspace.array(num if slots else 0, np.int32 if num < 2**31 else np.int64)
        offsets = workspace.array(len(words) + 1 if slots else 0, np.int64)
        offsets[:1] = 0
        outputs = positions, np.cumsum(per_part) - per_part, intersections, numbers, offsets
        parallel_for(partial(_write_intersections, ends, words, columns, low, high, size[1], *outputs), parts, threads)
        yield TileIntersections(low, intersections.view(np.int32).reshape(-1, 2), starts, numbers, offsets, workspace)


# --- sorting ---
#
# A tile's intersections are sorted within the L1 cache: a radix sort of their distances, as integers of the same order,
# each followed by its index in the tile.

_DIGIT_BITS = 11  # 2048 counters fit the L1 cache
_READ_AHEAD = 32  # intersections between the prefetch of a distance and its use
_ROUNDING_BITS = 12  # lowest bits of a distance, ignored: equal distances, computed in other steps, may differ in these
_SIGN_MASK = np.int64(0x7FFFFFFFFFFFFFFF)
_ITEMS_PER_THREAD = 8
_EMPTY_TILE_COST = 32  # cost of a tile without intersections, in intersections


@inline_kernel
def _read_keys(intersections, slots, keys, begin, count, words, tile_intersections, tile_slots):
    """Copy a tile's intersections and slots, and read its distances as integers of the same order; return the range."""
    low, high, end = _SIGN_MASK, -_SIGN_MASK, len(intersections) - 1
    for j in range(count):
        prefetch(keys, load_scalar(intersections, min(begin + j + _READ_AHEAD, end)) & np.int64(0xFFFFFFFF))
        intersection = load_scalar(intersections, begin + j)
        key = load_scalar(keys, intersection & np.int64(0xFFFFFFFF))
        key = (key if key >= 0 else (key ^ _SIGN_MASK) + 1) >> _ROUNDING_BITS  # -0.0 equals 0.0
        low, high = min(low, key), max(high, key)
        store_scalar(words, j, np.uint64(key))
        store_scalar(tile_intersections, j, intersection)
    if len(slots) > 0:
        for j in range(count):
            store_scalar(tile_slots, j, load_scalar(slots, begin + j))
    return np.uint64(low), np.uint64(high)


@inline_kernel
def _bit_length(number):
    bits = 0
    while number > 0:
        number >>= np.uint64(1)
        bits += 1
    return bits


@inline_kernel
def _radix_sort(words, spare, count, begin, end, counters):
    """Sort words by their bits from `begin` to `end`, stably; return the two arrays, the sorted one first."""
    mask = np.uint64((1 << _DIGIT_BITS) - 1)
    for shift in range(begin, end, _DIGIT_BITS):
        counters[:] = 0
        for j in range(count):
            digit = np.int64(load_scalar(words, j) >> np.uint64(shift) & mask)
            store_scalar(counters, digit, np.int32(load_scalar(counters, digit) + 1))
        total = np.int32(0)
        for digit in range(1 << _DIGIT_BITS):
            count_of_digit = load_scalar(counters, digit)
            store_scalar(counters, digit, total)
            total = np.int32(total + count_of_digit)
        for j in range(count):
            word = load_scalar(words, j)
            digit = np.int64(word >> np.uint64(shift) & mask)
            position = load_scalar(counters, digit)
            store_scalar(counters, digit, np.int32(position + 1))
            store_scalar(spare, np.int64(position), word)
        words, spare = spare, words
    return words, spare


@kernel
def _sort_tiles(intersections, slots, keys, starts, low, high):
    """Sort the intersections and slots of tiles `low` to `high` - 1.

    Args:
        intersections: as 64-bit words.
        keys: bits of the distances, int64.
    """
    max_count = 1
    for tile in range(low, high):
        max_count = max(max_count, starts[tile + 1] - starts[tile])
    words, spare = np.empty(max_count, np.uint64), np.empty(max_count, np.uint64)
    tile_intersections = np.empty(max_count, np.int64)
    tile_slots = np.empty(max_count if len(slots) > 0 else 0, slots.dtype)
    counters = np.empty(1 << _DIGIT_BITS, np.int32)
    for tile in range(low, high):
        begin, count = starts[tile], starts[tile + 1] - starts[tile]
        if count < 2:
            continue
        smallest, largest = _read_keys(intersections, slots, keys, begin, count, words, tile_intersections, tile_slots)
        key_bits, index_bits = _bit_length(largest - smallest), _bit_length(np.uint64(count - 1))
        cut = max(0, key_bits + index_bits - 64)
        end = key_bits - cut + index_bits
        for j in range(count):
            key = (load_scalar(words, j) - smallest) >> np.uint64(cut)
            store_scalar(words, j, key << np.uint64(index_bits) | np.uint64(j))
        words, spare = _radix_sort(words, spare, count, index_bits, end, counters)
        mask = (np.uint64(1) << np.uint64(index_bits)) - np.uint64(1)
        for j in range(count):
            index = np.int64(load_scalar(words, j) & mask)
            store_scalar(intersections, begin + j, load_scalar(tile_intersections, index))
            if len(slots) > 0:
                store_scalar(slots, begin + j, load_scalar(tile_slots, index))


def radix_argsort(keys: np.ndarray) -> np.ndarray:
    """The stable ascending order (n,) uint32 of float32 keys (n,) without NaN; -0 equals 0."""
    bits, order = np.ascontiguousarray(keys, np.float32).view(np.int32), np.empty(len(keys), np.uint32)
    _argsort_keys(bits, order)
    return order


@kernel
def _argsort_keys(bits, order):
    num = len(bits)
    words, spare = np.empty(num, np.uint64), np.empty(num, np.uint64)
    for i in range(num):
        key = np.int64(load_scalar(bits, i))
        key = (key if key >= 0 else (key ^ np.int64(0x7FFFFFFF)) + 1) + np.int64(1 << 31)
        store_scalar(words, i, np.uint64(key) << np.uint64(32) | np.uint64(i))
    words, spare = _radix_sort(words, spare, num, 32, 64, np.empty(1 << _DIGIT_BITS, np.int32))
    for i in range(num):
        store_scalar(order, i, np.uint32(load_scalar(words, i) & np.uint64(0xFFFFFFFF)))


def sort_front_to_back(tiles: TileIntersections, distances: np.ndarray, threads: int) -> None:
    """Sort each tile's intersections, with their slots, by distance; ties stay in the order of the Gaussians.

    Args:
        tiles: in the order of the Gaussians; sorted in place.
        distances: distance of each Gaussian, float64, which is compared to a part in 2^40, or a little less in a tile
            whose keys and indices together exceed 64 bits.
    """
    intersections, keys = tiles.intersections.reshape(-1).view(np.int64), distances.view(np.int64)
    parallel_for_tiles(_sort_tiles, (intersections, tiles.slots, keys, tiles.starts), tiles.starts, threads)


def parallel_for_tiles(tile_kernel: Any, arguments: tuple[Any, ...], starts: np.ndarray, threads: int) -> None:
    """Call a kernel with the arguments and a range of tiles, for work items of about equal numbers of intersections."""
    num_tiles = len(starts) - 1
    cost = starts - starts[0] + _EMPTY_TILE_COST * np.arange(num_tiles + 1)
    targets = np.linspace(0, cost[-1], min(num_tiles, _ITEMS_PER_THREAD * threads if threads > 1 else 1) + 1)
    cuts = [int(cut) for cut in np.unique(np.searchsorted(cost, targets))]
    parallel_for(lambda item: tile_kernel(*arguments, cuts[item], cuts[item + 1]), len(cuts) - 1, threads)
