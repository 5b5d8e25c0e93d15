"""Where each record can be seen: boxes of pixels, exact on pinhole pictures, tight and conservative on panoramas.

Source: docs/rendering.md, section 5. A record gives back its covariance as a sum of squares: with the dual axes
p = (b ^ n) / w - alpha n and q = (n ^ a) / w - beta n, where w = (a ^ b).n,

    C' = S' n n' + p p' + q q'

so h' C' h never cancels. A box is int16: first and last column, first and last row, both ends included. None where
the last row is before the first; on a panorama a box whose last column is before its first goes on at the left.
"""

import math

import numpy as np

from pansplat.render.cpu import records as layout
from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.forms import cross, dot
from pansplat.render.cpu.memory import Lease
from pansplat.render.cpu.observe import CULLED, LANES, PIECE
from pansplat.render.cpu.threads import share
from pansplat.render.panorama import Picture

LARGEST_SIDE = 32767  # pixels; boxes are int16
_MARGIN = 0.01  # pixels added around each box, far more than rounding
_SLACK = 1e-5  # added to kappa
_LOG_CUT = math.log2(255)

# Rows of a block of records.
DIRECTION, P, Q, ALONG, KAPPA = 0, 3, 6, 9, 10
EDGES = 11
ROWS = 15


@inlined
def read_cones(records, start, count, rotation, rows):
    """Read directions, dual axes and S' into rows, turned into a picture's axes; kappa is -1 where not drawn."""
    for i in range(count):
        g = start + i
        for axis in range(3):
            head, rest = records[g, layout.DIRECTION + axis], records[g, layout.REST + axis]
            rows[DIRECTION + axis, i] = np.float64(head) + np.float64(rest)
            rows[P + axis, i] = records[g, layout.FIRST + axis]
            rows[Q + axis, i] = records[g, layout.SECOND + axis]
        rows[ALONG, i] = records[g, layout.ALONG]
        rows[KAPPA, i] = records[g, layout.LEVEL]
        rows[EDGES, i] = records[g, layout.FRONT_A]
        rows[EDGES + 1, i] = records[g, layout.FRONT_B]
    right = rotation[0, 0], rotation[1, 0], rotation[2, 0]
    down = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    ahead = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    unit = math.sqrt(layout.UNIT)
    for i in range(LANES):
        n = rows[DIRECTION, i], rows[DIRECTION + 1, i], rows[DIRECTION + 2, i]
        a = rows[P, i], rows[P + 1, i], rows[P + 2, i]
        b = rows[Q, i], rows[Q + 1, i], rows[Q + 2, i]
        p, q = dual_axes(n, a, b, rows[EDGES, i], rows[EDGES + 1, i])
        rows[DIRECTION, i], rows[DIRECTION + 1, i], rows[DIRECTION + 2, i] = (
            dot(*right, *n),
            dot(*down, *n),
            dot(*ahead, *n),
        )
        rows[P, i], rows[P + 1, i] = unit * dot(*right, *p), unit * dot(*down, *p)
        rows[P + 2, i], rows[Q, i] = unit * dot(*ahead, *p), unit * dot(*right, *q)
        rows[Q + 1, i], rows[Q + 2, i] = unit * dot(*down, *q), unit * dot(*ahead, *q)
        rows[ALONG, i] *= layout.UNIT
        level = rows[KAPPA, i]
        rows[KAPPA, i] = (level + _LOG_CUT) / layout.UNIT + _SLACK if level > CULLED else -1.0


@inlined
def dual_axes(n, a, b, front_a, front_b):
    """The axes p and q of a record with these forms, in its own units: C' / UNIT = along n n' + p p' + q q'."""
    inverse = 1 / dot(*cross(*a, *b), *n)
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
    root = math.sqrt(max(kappa * across - kappa * kappa * (along * across + both * both), 0.0))
    return n_x * n_z - kappa * (along * n_x * n_z + p_x * p_z + q_x * q_z), root


@inlined
def _beside(n, p, q, along, kappa, slope_x, slope_y, slope_z):
    """Whether a cone lies wholly on the far side of a plane through the eye with this normal."""
    h = slope_x, slope_y, slope_z
    distance, first, second = dot(*n, *h), dot(*p, *h), dot(*q, *h)
    reach = kappa * (along * distance * distance + first * first + second * second)
    return (distance * distance > reach) & (distance < 0)


@kernel
def _pinhole(piece, records, rotation, height, width, focal, boxes):
    rows = np.ones((ROWS, LANES))
    side, end = width / (2 * focal), height / (2 * focal)
    for start in range(piece * PIECE, min((piece + 1) * PIECE, records.shape[0]), LANES):
        count = min(LANES, records.shape[0] - start)
        read_cones(records, start, count, rotation, rows)
        for i in range(LANES):
            n, p, q, along, kappa = _cone(rows, i)
            d_zz = n[2] * n[2] - kappa * (along * n[2] * n[2] + p[2] * p[2] + q[2] * q[2])
            middle_x, root_x = _pinhole_edges(n[0], n[2], p[0], p[2], q[0], q[2], along, kappa)
            middle_y, root_y = _pinhole_edges(n[1], n[2], p[1], p[2], q[1], q[2], along, kappa)
            crosses = d_zz <= 0  # the plane through the eye: no bound
            scale = 0.0 if crosses else focal / d_zz
            extra = 1e9 if crosses else 0.0
            unseen = (kappa < 0) | ((d_zz > 0) & (n[2] < 0))
            # Those that cross the plane through the eye have no box, but most of them lie beside the view.
            unseen |= _beside(n, p, q, along, kappa, 1.0, 0.0, side)
            unseen |= _beside(n, p, q, along, kappa, -1.0, 0.0, side)
            unseen |= _beside(n, p, q, along, kappa, 0.0, 1.0, end)
            unseen |= _beside(n, p, q, along, kappa, 0.0, -1.0, end)
            rows[EDGES, i] = (middle_x - root_x) * scale + 0.5 * width - extra
            rows[EDGES + 1, i] = (middle_x + root_x) * scale + 0.5 * width + extra
            rows[EDGES + 2, i] = (middle_y - root_y) * scale + 0.5 * height - extra
            rows[EDGES + 3, i] = -1e9 if unseen else (middle_y + root_y) * scale + 0.5 * height + extra
        round_boxes(rows, EDGES, start, count, height, width, boxes)


@inlined
def round_boxes(rows, edges, start, count, height, width, boxes):
    """Write the pixels whose centres lie between left, right, top and bottom, four rows of pixels."""
    for i in range(LANES):
        x0 = max(math.ceil(rows[edges, i] - 0.5 - _MARGIN), 0.0)
        x1 = min(math.floor(rows[edges + 1, i] - 0.5 + _MARGIN), width - 1.0)
        y0 = max(math.ceil(rows[edges + 2, i] - 0.5 - _MARGIN), 0.0)
        y1 = min(math.floor(rows[edges + 3, i] - 0.5 + _MARGIN), height - 1.0)
        seen = (x0 <= x1) & (y0 <= y1)
        rows[edges, i], rows[edges + 1, i] = x0 if seen else 0.0, x1 if seen else 0.0
        rows[edges + 2, i], rows[edges + 3, i] = y0 if seen else 1.0, y1 if seen else 0.0
    write_boxes(rows, edges, start, count, boxes)


@inlined
def write_boxes(rows, edges, start, count, boxes):
    """Write four rows of whole numbers as boxes, two numbers a word."""
    for i in range(LANES):
        rows[edges, i] += 65536 * rows[edges + 1, i]
        rows[edges + 2, i] += 65536 * rows[edges + 3, i]
    for i in range(count):
        boxes[start + i, 0] = np.int32(rows[edges, i])
        boxes[start + i, 1] = np.int32(rows[edges + 2, i])


@inlined
def _arctan2(y, x):
    """atan2 within 1e-8 radians (a fit at Chebyshev nodes), with one division."""
    steep = abs(y) > abs(x)
    s = (x if steep else y) / (y if steep else x)
    z = s * s
    p = -0.00238699729962 * z + 0.0135077713532
    p = p * z - 0.0358715388503
    p = p * z + 0.0625016943222
    p = p * z - 0.0865688042332
    p = p * z + 0.110337641132
    p = p * z - 0.142785687479
    p = p * z + 0.199997393298
    p = p * z - 0.333333317331
    r = s + s * z * p
    half = -math.pi if y < 0 else math.pi
    return 0.5 * half - r if steep else r + (half if x < 0 else 0.0)


@inlined
def _highest_latitude(sine, cosine, low, high, sides2):
    """Bound on the latitude over a box in the tangent plane at latitude asin(sine).

    Args:
        low, high: how far the box reaches towards growing latitude.
        sides2: square of how far it reaches aside.
    """
    first, second = sine + low * cosine, sine + high * cosine  # sines, but for the lengths
    first2 = 1 + low * low + (0.0 if first > 0 else sides2)
    second2 = 1 + high * high + (0.0 if second > 0 else sides2)
    later = second * abs(second) * first2 > first * abs(first) * second2
    height, length2 = (second, second2) if later else (first, first2)
    flat = math.sqrt(max(length2 - height * height, 0.0))
    over_pole = (sine > 0) & (low * sine <= cosine) & (cosine <= high * sine)
    return _arctan2(1.0 if over_pole else height, 0.0 if over_pole else flat)


@kernel
def _panorama(piece, records, rotation, height, width, boxes):
    rows = np.ones((ROWS, LANES))
    for start in range(piece * PIECE, min((piece + 1) * PIECE, records.shape[0]), LANES):
        count = min(LANES, records.shape[0] - start)
        read_cones(records, start, count, rotation, rows)
        _panorama_edges(rows, height, width)
        for i in range(LANES):
            x0 = math.ceil(rows[EDGES, i] - 0.5 - _MARGIN)
            x1 = math.floor(rows[EDGES + 1, i] - 0.5 + _MARGIN)
            y0 = max(math.ceil(rows[EDGES + 2, i] - 0.5 - _MARGIN), 0.0)
            y1 = min(math.floor(rows[EDGES + 3, i] - 0.5 + _MARGIN), height - 1.0)
            around = x1 - x0 >= width - 1
            seen = (x0 <= x1) & (y0 <= y1)
            x0, x1 = x0 - width * math.floor(x0 / width), x1 - width * math.floor(x1 / width)
            rows[EDGES, i] = x0 if seen & ~around else 0.0
            rows[EDGES + 1, i] = (width - 1.0 if around else x1) if seen else 0.0
            rows[EDGES + 2, i], rows[EDGES + 3, i] = y0 if seen else 1.0, y1 if seen else 0.0
        write_boxes(rows, EDGES, start, count, boxes)


@inlined
def _panorama_edges(rows, height, width):
    for i in range(LANES):
        n, p, q, along, kappa = _cone(rows, i)
        flat = math.sqrt(n[0] * n[0] + n[2] * n[2])
        on_axis = flat < 1e-12
        inverse = 0.0 if on_axis else 1 / flat
        ahead_x, ahead_z = n[0] * inverse, 1.0 if on_axis else n[2] * inverse
        p_ahead, q_ahead = p[0] * ahead_x + p[2] * ahead_z, q[0] * ahead_x + q[2] * ahead_z
        p_east, q_east = p[0] * ahead_z - p[2] * ahead_x, q[0] * ahead_z - q[2] * ahead_x
        p_south, q_south = p[1] * flat - n[1] * p_ahead, q[1] * flat - n[1] * q_ahead
        p_n, q_n = dot(*p, *n), dot(*q, *n)
        east = kappa * (p_east * p_east + q_east * q_east)

        # Longitude: tangents of the shadow on the horizontal plane.
        d_ff = flat * flat - kappa * (along * flat * flat + p_ahead * p_ahead + q_ahead * q_ahead)
        middle = -kappa * (p_east * p_ahead + q_east * q_ahead)
        root = math.sqrt(max(middle * middle + east * d_ff, 0.0))
        low, high = middle - root, middle + root
        left = _arctan2(ahead_x * d_ff + ahead_z * low, ahead_z * d_ff - ahead_x * low)
        right = _arctan2(ahead_x * d_ff + ahead_z * high, ahead_z * d_ff - ahead_x * high)
        right += 2 * math.pi if right < left - 1e-6 else 0.0

        # Latitude: a box around the ellipse in the plane that touches the sphere at the mean's direction.
        d_nn = 1 - kappa * (along + p_n * p_n + q_n * q_n)
        inverse = 1 / d_nn if d_nn > 0 else 1.0
        middle = -kappa * (p_east * p_n + q_east * q_n)
        sides = (abs(middle) + math.sqrt(max(middle * middle + east * d_nn, 0.0))) * inverse
        south = kappa * (p_south * p_south + q_south * q_south)
        middle = -kappa * (p_south * p_n + q_south * q_n)
        root = math.sqrt(max(middle * middle + south * d_nn, 0.0))
        low, high = (middle - root) * inverse, (middle + root) * inverse
        bottom = _highest_latitude(n[1], flat, low, high, sides * sides)
        top = -_highest_latitude(-n[1], flat, -high, -low, sides * sides)
        per_column, per_row = width / (2 * math.pi), height / math.pi
        everywhere = 1e9 if d_nn <= 0 else 0.0
        around = 1e9 if d_ff <= 0 else everywhere
        rows[EDGES, i] = left * per_column + 0.5 * width - around
        rows[EDGES + 1, i] = right * per_column + 0.5 * width + around
        rows[EDGES + 2, i] = top * per_row + 0.5 * height - everywhere
        rows[EDGES + 3, i] = -1e9 if kappa < 0 else bottom * per_row + 0.5 * height + everywhere


def find_boxes(records: np.ndarray, picture: Picture, lease: Lease, threads: int) -> np.ndarray:
    """The box of each record of the exact kernel on a picture, (n, 4) int16."""
    words = lease.array((len(records), 2), np.int32)
    rotation = np.ascontiguousarray(picture.rotation.numpy())
    height, width = picture.size

    def work(piece: int) -> None:
        if picture.is_panorama:
            _panorama(piece, records, rotation, height, width, words)
        else:
            _pinhole(piece, records, rotation, height, width, picture.focal, words)

    share(work, -(-len(records) // PIECE), threads)
    return words.view(np.int16)
