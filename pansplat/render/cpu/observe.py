"""Stage one: the record and the values of each Gaussian that a camera sees.

Source: docs/rendering.md, sections 1 to 3; records.py for the layout. Arithmetic is float64, in rows of 64
Gaussians that the compiler turns into vectors; a piece of work is some thousands of Gaussians.
"""

import math
from typing import NamedTuple

import numpy as np

from pansplat.render.cpu import records as layout
from pansplat.render.cpu.columns import write_columns
from pansplat.render.cpu.compiling import inlined, kernel
from pansplat.render.cpu.forms import (
    LARGEST_RATIO,
    LEAST_RATIO,
    dot,
    is_covariance,
    ray_forms,
    rotation,
    shape_of_axes,
    shape_of_covariance,
    tangent_frame,
)
from pansplat.render.cpu.harmonics import colours, fill_basis
from pansplat.render.cpu.memory import Lease
from pansplat.render.cpu.threads import share

LANES = 64
PIECE = 8192
CULLED = -128.0  # the level of a Gaussian that is not drawn
DROPPED, NEAR = 0, 1  # columns of the tally

_LARGEST = 1e30
_LARGEST_BITS = np.uint32(2 * int(np.float32(_LARGEST).view(np.uint32)))  # without the sign
_FAINTEST = (1 - 1e-6) / 255

# Rows of a block: what is read, what is found, what is written.
MEAN, SHAPE, OPACITY = 0, 3, 12  # SHAPE is a quaternion and three scales, or a covariance
WORLD, RADIUS, SOUND = 13, 16, 17
FRAME, BODY = 18, 24
OUT, PEAK, LOG = 33, 47, 48
ROWS = 49


class Fields(NamedTuple):
    """A scene as arrays; what is not given has no rows.

    Attributes:
        means: (n, 3), metres.
        quats: (n, 4), wxyz, of any length.
        scales: (n, 3), metres.
        covariances: (n, 3, 3), square metres; or the two before.
        opacities: (n,).
        harmonics: (n, k, channel).
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray

    @property
    def given(self) -> tuple[np.ndarray | None, ...]:
        """The arrays as kernels take them, None for what is not given: what is not needed is not compiled."""
        by_covariance = len(self.covariances) > 0
        shape = (None, None, self.covariances) if by_covariance else (self.quats, self.scales, None)
        return self.means, *shape, self.opacities, self.harmonics

    @property
    def bends(self) -> bool | None:
        """True if colours depend on the direction, else None."""
        return True if self.harmonics.shape[1] > 1 else None


class Camera(NamedTuple):
    """The observing camera and what depends on the picture's size.

    Attributes:
        pose: cam2world, (4, 4) float64.
        spread: e^2, the variance that the filter adds across the ray, radians^2; above 0.
        compensate: whether the opacity is lowered by as much as the filter widened the Gaussian.
        near: metres.
    """

    pose: np.ndarray
    spread: float
    compensate: bool
    near: float


@inlined
def read_block(means, quats, scales, covariances, opacities, start, count, rows):
    """Copy the fields of `count` Gaussians from `start` on into rows."""
    for i in range(count):
        g = start + i
        rows[MEAN, i], rows[MEAN + 1, i], rows[MEAN + 2, i] = means[g, 0], means[g, 1], means[g, 2]
        rows[OPACITY, i] = opacities[g]
    # Two questions: numba leaves out what depends on a None, but not the other branch.
    if covariances is not None:
        for i in range(count):
            g = start + i
            for axis in range(3):
                for other in range(3):
                    rows[SHAPE + 3 * axis + other, i] = covariances[g, axis, other]
    if quats is not None:
        for i in range(count):
            g = start + i
            for axis in range(4):
                rows[SHAPE + axis, i] = quats[g, axis]
            for axis in range(3):
                rows[SHAPE + 4 + axis, i] = scales[g, axis]


@inlined
def find_directions(pose, near, rows):
    """Find distance and direction, and which distances are far enough: SOUND is 1, or 0, or -1 where too near."""
    tx, ty, tz = pose[0, 3], pose[1, 3], pose[2, 3]
    for i in range(LANES):
        mx, my, mz = rows[MEAN, i], rows[MEAN + 1, i], rows[MEAN + 2, i]
        x, y, z = mx - tx, my - ty, mz - tz
        radius = math.sqrt(x * x + y * y + z * z)
        inverse = 1 / radius
        good = (abs(mx) < _LARGEST) & (abs(my) < _LARGEST) & (abs(mz) < _LARGEST) & (abs(rows[OPACITY, i]) < _LARGEST)
        rows[SOUND, i] = (-1.0 if radius < near else 1.0) if good else 0.0
        rows[RADIUS, i] = radius
        rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i] = x * inverse, y * inverse, z * inverse


@inlined
def find_shapes(covariances, rows):
    """Find the shapes in the tangent frame of each direction, and which of them are sound."""
    if covariances is not None:
        _shapes_of_covariances(rows)
    else:
        _shapes_of_axes(rows)


@inlined
def _shapes_of_axes(rows):
    for i in range(LANES):
        w, x, y, z = rows[SHAPE, i], rows[SHAPE + 1, i], rows[SHAPE + 2, i], rows[SHAPE + 3, i]
        s0, s1, s2 = rows[SHAPE + 4, i], rows[SHAPE + 5, i], rows[SHAPE + 6, i]
        largest = max(max(abs(s0), abs(s1)), abs(s2))
        turned = max(max(abs(w), abs(x)), max(abs(y), abs(z)))
        # Comparisons are false for NaN wherever it stands among the operands of `max`, so each is asked.
        good = (s0 == s0) & (s1 == s1) & (s2 == s2) & (w == w) & (x == x) & (y == y) & (z == z)
        good &= (largest < _LARGEST) & (turned < _LARGEST)
        state = rows[SOUND, i]
        fits = (largest <= LARGEST_RATIO * rows[RADIUS, i]) | (state < 0)
        rows[SOUND, i] = state if good & fits else 0.0
        inverse = 1 / rows[RADIUS, i]
        r = rotation(w, x, y, z)
        n = rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i]
        frame = tangent_frame(n[0], n[1], n[2])
        u, v = (frame[0], frame[1], frame[2]), (frame[3], frame[4], frame[5])
        e0, e1, e2 = (r[0], r[3], r[6]), (r[1], r[4], r[7]), (r[2], r[5], r[8])
        shape = shape_of_axes(u, v, n, e0, e1, e2, s0 * inverse, s1 * inverse, s2 * inverse)
        _keep(rows, i, u, v, shape)


@inlined
def _shapes_of_covariances(rows):
    for i in range(LANES):
        inverse = 1 / (rows[RADIUS, i] * rows[RADIUS, i])
        xx, yy, zz = rows[SHAPE, i], rows[SHAPE + 4, i], rows[SHAPE + 8, i]
        xy, yx, xz, zx = rows[SHAPE + 1, i], rows[SHAPE + 3, i], rows[SHAPE + 2, i], rows[SHAPE + 6, i]
        yz, zy = rows[SHAPE + 5, i], rows[SHAPE + 7, i]
        good = (abs(xx) < _LARGEST) & (abs(yy) < _LARGEST) & (abs(zz) < _LARGEST) & (abs(xy) < _LARGEST)
        good &= (abs(xz) < _LARGEST) & (abs(yz) < _LARGEST) & (abs(yx) < _LARGEST) & (abs(zx) < _LARGEST)
        good &= abs(zy) < _LARGEST
        xx, yy, zz = xx * inverse, yy * inverse, zz * inverse
        xy, xz, yz = 0.5 * (xy + yx) * inverse, 0.5 * (xz + zx) * inverse, 0.5 * (yz + zy) * inverse
        state = rows[SOUND, i]
        fits = is_covariance(xx, xy, xz, yy, yz, zz) | (state < 0)
        rows[SOUND, i] = state if good & fits else 0.0
        n = rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i]
        frame = tangent_frame(n[0], n[1], n[2])
        u, v = (frame[0], frame[1], frame[2]), (frame[3], frame[4], frame[5])
        _keep(rows, i, u, v, shape_of_covariance(u, v, n, xx, xy, xz, yy, yz, zz))


@inlined
def _keep(rows, i, u, v, shape):
    rows[FRAME, i], rows[FRAME + 1, i], rows[FRAME + 2, i] = u
    rows[FRAME + 3, i], rows[FRAME + 4, i], rows[FRAME + 5, i] = v
    rows[BODY, i], rows[BODY + 1, i], rows[BODY + 2, i] = shape[0], shape[1], shape[2]
    rows[BODY + 3, i], rows[BODY + 4, i], rows[BODY + 5, i] = shape[3], shape[4], shape[5]
    rows[BODY + 6, i], rows[BODY + 7, i], rows[BODY + 8, i] = shape[6], shape[7], shape[8]


@inlined
def frame_and_shape(rows, i):
    """The tangent frame and the shape that `find_shapes` kept."""
    u = rows[FRAME, i], rows[FRAME + 1, i], rows[FRAME + 2, i]
    v = rows[FRAME + 3, i], rows[FRAME + 4, i], rows[FRAME + 5, i]
    n = rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i]
    shape = (
        rows[BODY, i], rows[BODY + 1, i], rows[BODY + 2, i], rows[BODY + 3, i], rows[BODY + 4, i],
        rows[BODY + 5, i], rows[BODY + 6, i], rows[BODY + 7, i], rows[BODY + 8, i],
    )  # fmt: skip
    return u, v, n, shape


@inlined
def _find_records(pose, spread, compensate, rows):
    """Find what a record holds, in its order but for the level, and the peak."""
    right, down, ahead = (
        (pose[0, 0], pose[1, 0], pose[2, 0]),
        (pose[0, 1], pose[1, 1], pose[2, 1]),
        (pose[0, 2], pose[1, 2], pose[2, 2]),
    )
    unit, inverse_unit = math.sqrt(layout.UNIT), 1 / math.sqrt(layout.UNIT)
    for i in range(LANES):
        u, v, n, shape = frame_and_shape(rows, i)
        a, b, front_a, front_b, along, det_filtered = ray_forms(u, v, shape, spread)
        rows[OUT, i], rows[OUT + 1, i], rows[OUT + 2, i] = dot(*right, *n), dot(*down, *n), dot(*ahead, *n)
        rows[OUT + 3, i], rows[OUT + 4, i] = unit * dot(*right, *a), unit * dot(*down, *a)
        rows[OUT + 5, i], rows[OUT + 6, i] = unit * dot(*ahead, *a), unit * dot(*right, *b)
        rows[OUT + 7, i], rows[OUT + 8, i] = unit * dot(*down, *b), unit * dot(*ahead, *b)
        rows[OUT + 9, i], rows[OUT + 10, i] = inverse_unit * front_a, inverse_unit * front_b
        rows[OUT + 11, i] = along / layout.UNIT
        ratio = max(shape[6] / det_filtered, LEAST_RATIO) if compensate else 1.0
        peak = rows[OPACITY, i] * math.sqrt(ratio)
        drawn = (rows[SOUND, i] > 0) & (rows[OPACITY, i] >= _FAINTEST)
        rows[PEAK, i] = peak if drawn else 1.0


@inlined
def find_logs(rows, bits, source, target):
    """Write log2 of a row of positive numbers into another; absolute error below 1e-12.

    Args:
        bits: the rows as integers.
    """
    for i in range(LANES):
        exponent = (bits[source, i] - 0x3FE6A09E667F3BCD) >> 52  # mantissa in [sqrt 1/2, sqrt 2)
        bits[target, i] = bits[source, i] - (exponent << 52)
        bits[target + 1, i] = exponent
    for i in range(LANES):
        s = (rows[target, i] - 1) / (rows[target, i] + 1)
        t = s * s
        series = 1 + t * (1 / 3 + t * (1 / 5 + t * (1 / 7 + t * (1 / 9 + t * (1 / 11 + t * (1 / 13 + t / 15))))))
        rows[target, i] = bits[target + 1, i] + (2 / math.log(2)) * s * series


@inlined
def _check_harmonics(harmonic_bits, size, start, count, rows):
    """Clear SOUND of Gaussians with a coefficient that is not finite or absurdly large; each has `size` of them."""
    largest = np.uint32(0)
    block = harmonic_bits[start * size : (start + count) * size]
    for j in range(block.shape[0]):
        bits = np.uint32(block[j] << np.uint32(1))  # without the sign
        largest = bits if bits > largest else largest
    if largest < _LARGEST_BITS:
        return
    for j in range(block.shape[0]):
        if np.uint32(block[j] << np.uint32(1)) >= _LARGEST_BITS:
            rows[SOUND, j // size] = 0.0


@inlined
def _round(rows, singles):
    """Round a block's records to float32, a field a row, and the directions' rest likewise."""
    for axis in range(3):
        for i in range(LANES):
            head = np.float32(rows[OUT + axis, i])
            singles[layout.DIRECTION + axis, i] = head
            singles[layout.REST + axis, i] = np.float32(rows[OUT + axis, i] - np.float64(head))
    for j in range(9):
        for i in range(LANES):
            singles[layout.FIRST + j, i] = np.float32(rows[OUT + 3 + j, i])
    for i in range(LANES):
        is_drawn = (rows[SOUND, i] > 0) & (rows[OPACITY, i] >= _FAINTEST)
        singles[layout.LEVEL, i] = np.float32(rows[LOG, i] if is_drawn else CULLED)
        singles[layout.FIELDS, i] = np.float32(rows[RADIUS, i])


@inlined
def _write_block(rows, singles, start, count, records, values, radii, drawn, tally):
    radius_column = values.shape[1] - 1
    write_columns(singles.reshape(-1), LANES, start, count, records)
    for i in range(count):
        values[start + i, radius_column] = singles[layout.FIELDS, i]
    dropped, near = 0, 0
    for i in range(count):
        radii[start + i] = rows[RADIUS, i]
        drawn[start + i] = singles[layout.LEVEL, i] > CULLED
        dropped += rows[SOUND, i] == 0
        near += rows[SOUND, i] < 0
    tally[DROPPED] += dropped
    tally[NEAR] += near


@kernel
def _observe(
    piece, means, quats, scales, covariances, opacities, harmonics, harmonic_bits,
    pose, spread, compensate, near, bends, records, values, radii, drawn, tallies,
):  # fmt: skip
    rows = np.ones((ROWS + 1, LANES))
    bits = rows.view(np.int64)
    basis, singles = np.empty((25, LANES), np.float32), np.empty((layout.FIELDS + 1, LANES), np.float32)
    for start in range(piece * PIECE, min((piece + 1) * PIECE, means.shape[0]), LANES):
        count = min(LANES, means.shape[0] - start)
        read_block(means, quats, scales, covariances, opacities, start, count, rows)
        find_directions(pose, near, rows)
        find_shapes(covariances, rows)
        _check_harmonics(harmonic_bits, harmonics.shape[1] * harmonics.shape[2], start, count, rows)
        _find_records(pose, spread, compensate, rows)
        find_logs(rows, bits, PEAK, LOG)
        fill_basis(rows, WORLD, harmonics.shape[1], bends, basis)
        _round(rows, singles)
        _write_block(rows, singles, start, count, records, values, radii, drawn, tallies[piece])
        colours(harmonics, start, count, basis, values)


class Observed(NamedTuple):
    """What the camera sees of each Gaussian, in their order.

    Attributes:
        records, values: see records.py; the level is `CULLED` where a Gaussian is not drawn.
        radii: (n,) float64, metres.
        drawn: (n,) uint8, 0 for Gaussians that are left out whatever the picture.
        dropped: how many hold an unusable number.
        near: how many are too near.
    """

    records: np.ndarray
    values: np.ndarray
    radii: np.ndarray
    drawn: np.ndarray
    dropped: int
    near: int


def observe(fields: Fields, camera: Camera, lease: Lease, threads: int) -> Observed:
    """The Gaussians as the camera sees them, in leased arrays."""
    num, channels = len(fields.means), fields.harmonics.shape[2]
    records, radii = lease.array((num, layout.FIELDS), np.float32), lease.array(num, np.float64)
    values, drawn = lease.array((num, channels + 1), np.float32), lease.array(num, np.uint8)
    pieces = -(-num // PIECE)
    tallies = np.zeros((pieces, 2), np.int64)
    harmonic_bits = fields.harmonics.reshape(-1).view(np.uint32)

    def work(piece: int) -> None:
        _observe(
            piece,
            *fields.given,
            harmonic_bits,
            *camera,
            fields.bends,
            records.reshape(-1),
            values,
            radii,
            drawn,
            tallies,
        )

    share(work, pieces, threads)
    dropped, near = (int(count) for count in tallies.sum(axis=0))
    return Observed(records, values, radii, drawn, dropped, near)
