"""Where each record can be seen: boxes of pixels, exact on pinhole pictures, tight and conservative on panoramas.

Source: docs/rendering.md, section 5. A record gives back its covariance as a sum of squares: with the dual axes
p = (b ^ n) / w - alpha n and q = (n ^ a) / w - beta n, where w = (a ^ b).n,

    C' = S' n n' + p p' + q q'

so h' C' h never cancels. A box is int16: first and last column, first and last row, both ends included. None where
the last row is before the first; on a panorama a box whose last column is before its first goes on at the left.
"""

import math

import numpy as np

from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.columns import read_columns
from pansplat.rendering.cpu.compiling import inlined, kernel
from pansplat.rendering.cpu.forms import cross, dot
from pansplat.rendering.cpu.memory import Lease
from pansplat.rendering.cpu.observe import CULLED, LANES, PIECE
from pansplat.rendering.cpu.threads import share
from pansplat.rendering.panorama import Picture

LARGEST_SIDE = 32767  # pixels; boxes are int16
_SLACK = np.float32(1e-5)  # added to kappa
_LOG_CUT = np.float32(math.log2(255))

# float32 is enough, for a margin covers its rounding. Bare numbers would make it float64.
_ZERO, _ONE, _HALF, _PI = np.float32(0), np.float32(1), np.float32(0.5), np.float32(math.pi)
_UNIT, _ROOT_UNIT = np.float32(layout.UNIT), np.float32(math.sqrt(layout.UNIT))
_NARROWEST = np.float32(1e-12)  # of the direction's horizontal part
_TURN_BACK = np.float32(1e-6)
_NOWHERE = np.float32(-1e9)  # where the last row of what is not seen lies
_CULLED = np.float32(CULLED)
_EVERYWHERE = np.float32(1e9)

# Rows of a block of records: as they are in memory, then what is found from them.
ALONG, KAPPA = layout.ALONG, layout.LEVEL
DIRECTION, P, Q = layout.FIELDS, layout.FIELDS + 3, layout.FIELDS + 6
EDGES = layout.FIELDS + 9
ROWS = layout.FIELDS + 13


@inlined
def margin(height, width):
    """Pixels added around each box, far more than rounding."""
    return np.float32(0.01 + 1e-6 * max(height, width))


@inlined
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
    first, second = layout.FIRST, layout.SECOND
    for i in range(LANES):
        n = rows[0, i], rows[1, i], rows[2, i]
        a = rows[first, i], rows[first + 1, i], rows[first + 2, i]
        b = rows[second, i], rows[second + 1, i], rows[second + 2, i]
        p, q = dual_axes(n, a, b, rows[layout.FRONT_A, i], rows[layout.FRONT_B, i])
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


@inlined
def dual_axes(n, a, b, front_a, front_b):
    """The axes p and q of a record with these forms, in its own units: C' / UNIT = along n n' + p p' + q q'."""
    inverse = _ONE / dot(*cross(*a, *b), *n)
    first, second = cross(*b, *n), cross(*n, *a)
    p = first[0] * inverse - front_a * n[0], first[1] * inverse - front_a * n[1], first[2] * inverse - front_a * n[2]
    q = second[0] * inverse - front_b * n[0], second[1] * inverse - front_b * n[1], second[2] * inverse - front_b * n[2]
    return p, q


@inlined
def _cone(rows, i):
    n = rows[DIRECTION, i], rows[DIRECTION + 1, i], rows[DIRECTION + 2, i]
    p = rows[P, i], rows[P + 1, i], rows[P + 2, i]
    q = rows[Q, i], rows[Q + 1, i], rows[Q + 2, i]
    return n, p, q, rows[ALONG, i], rows[KAPPA, i]


@inlined
def _pinhole_edges(n_x, n_z, p_x, p_z, q_x, q_z, along, kappa):
    """The tangents of a cone's outermost planes through one axis, as middle, root and what divides both."""
    p_across, q_across = p_x * n_z - p_z * n_x, q_x * n_z - q_z * n_x
    across = p_across * p_across + q_across * q_across
    both = p_x * q_z - p_z * q_x
    root = math.sqrt(max(kappa * across - kappa * kappa * (along * across + both * both), _ZERO))
    return n_x * n_z - kappa * (along * n_x * n_z + p_x * p_z + q_x * q_z), root


@inlined
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
    num = len(records) // layout.FIELDS
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


@inlined
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


@inlined
def write_boxes(rows, edges, start, count, boxes):
    """Write four rows of whole numbers as boxes, two numbers a word."""
    for i in range(count):
        boxes[start + i, 0] = np.int32(rows[edges, i]) | np.int32(rows[edges + 1, i]) << np.int32(16)
        boxes[start + i, 1] = np.int32(rows[edges + 2, i]) | np.int32(rows[edges + 3, i]) << np.int32(16)


@inlined
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


@inlined
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
    num = len(records) // layout.FIELDS
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


@inlined
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


def find_boxes(records: np.ndarray, picture: Picture, lease: Lease, threads: int) -> np.ndarray:
    """The box of each record of the exact kernel on a picture, (n, 4) int16."""
    words = lease.array((len(records), 2), np.int32)
    rotation = np.ascontiguousarray(picture.rotation.numpy().astype(np.float32))
    height, width, numbers = *picture.size, records.reshape(-1)

    def work(piece: int) -> None:
        if picture.is_panorama:
            _panorama(piece, numbers, rotation, height, width, words)
        else:
            _pinhole(piece, numbers, rotation, height, width, picture.focal, words)

    share(work, -(-len(records) // PIECE), threads)
    return words.view(np.int16)
