"""Stage one: the record and the values of each Gaussian that a camera sees.

Source: docs/rendering.md, sections 1 to 3; records.py for the layout. Arithmetic is float64, eight
Gaussians at a time (wide.py) of blocks of 64; a piece of work is some thousands of Gaussians.
"""

import math
from typing import NamedTuple

import numpy as np

from pansplat.constants import MAX_MAGNITUDE, OPACITY_CUT
from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.columns import write_columns
from pansplat.rendering.cpu.forms import (
    LARGEST_RATIO,
    LEAST_RATIO,
    dot,
    is_covariance,
    rotation,
    shape_of_axes,
    shape_of_covariance,
    tangent_frame,
    whitened,
    whitening,
)
from pansplat.rendering.cpu.groups import AHEAD, any_reaches, read_fours, read_ones, read_threes
from pansplat.rendering.cpu.harmonics import colours, fill_basis
from pansplat.rendering.cpu.runtime import Workspace, inline_kernel, kernel, parallel_for
from pansplat.rendering.cpu.simd import LANES as WIDTH
from pansplat.rendering.cpu.simd import element, fill, how_many, prefetch, put, store
from pansplat.rendering.cpu.wide import (
    align_stack,
    bits_of,
    either,
    fill_wide,
    get,
    keep,
    mantissa_and_exponent,
    rounded,
    store_mask,
    widened,
)

LANES = 64
PIECE = 8192
CULLED = -128.0  # the level of a Gaussian that is not drawn
DROPPED, NEAR = 0, 1  # columns of the tally

_LARGEST = MAX_MAGNITUDE
_LARGEST_BITS = np.uint32(2 * int(np.float32(_LARGEST).view(np.uint32)))  # without the sign
_FAINTEST = OPACITY_CUT

# Rows of a block: what is read, what is found, what is written.
MEAN, SHAPE, OPACITY = 0, 3, 12  # SHAPE is a quaternion and three scales, or a covariance
WORLD, RADIUS, SOUND = 13, 16, 17  # SOUND is 1, or 0 where a number is unusable
FRAME, BODY = 18, 24
ROWS = 33


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


@inline_kernel
def read_block(means, quats, scales, covariances, opacities, start, count, rows):
    """Copy the fields of `count` Gaussians from `start` on into rows; return whether one may be unusable."""
    sizes = fill(np.float32(0))
    sizes = read_threes(means.reshape(-1), start, count, rows, MEAN, sizes)
    sizes = read_ones(opacities, start, count, rows, OPACITY, sizes)
    # Two questions: numba leaves out what depends on a None, but not the other branch.
    if covariances is not None:
        for i in range(count):
            for j in range(9):
                rows[SHAPE + j, i] = element(covariances, 9 * (start + i) + j)
    if quats is not None:
        sizes = read_fours(quats.reshape(-1), start, count, rows, SHAPE, sizes)
        sizes = read_threes(scales.reshape(-1), start, count, rows, SHAPE + 4, sizes)
    return covariances is not None or count % WIDTH > 0 or any_reaches(sizes, _LARGEST_BITS)


@inline_kernel
def columns_of_pose(pose):
    """The camera's axes and its centre, as numbers; the array would be read again for every eight Gaussians."""
    return (
        (pose[0, 0], pose[1, 0], pose[2, 0]),
        (pose[0, 1], pose[1, 1], pose[2, 1]),
        (pose[0, 2], pose[1, 2], pose[2, 2]),
        (pose[0, 3], pose[1, 3], pose[2, 3]),
    )


@inline_kernel
def direction_of(rows, i, pose, near):
    """Direction and distance of eight Gaussians, one over it, and a state: 1, or -1 if too near."""
    mx, my, mz = get(rows, MEAN, i), get(rows, MEAN + 1, i), get(rows, MEAN + 2, i)
    x, y, z = mx - pose[3][0], my - pose[3][1], mz - pose[3][2]
    radius = math.sqrt(x * x + y * y + z * z)
    inverse = 1 / radius
    state = either(radius < near, fill_wide(-1.0), fill_wide(1.0))
    return (x * inverse, y * inverse, z * inverse), radius, inverse, state


@inline_kernel
def shape_in(covariances, rows, i, n, inverse, state):
    """Tangent axes and shapes of eight Gaussians, and their state, which an unusable shape makes 0.

    Args:
        covariances: None, or what the shapes come from in place of quaternions and scales.
        n: directions.
        inverse: one over the distance.
        state: of `direction_of`.
    """
    frame = tangent_frame(n[0], n[1], n[2])
    u, v = (frame[0], frame[1], frame[2]), (frame[3], frame[4], frame[5])
    if covariances is not None:
        shape, state = _shape_of_covariances(rows, i, u, v, n, inverse * inverse, state)
    else:
        shape, state = _shape_of_axes(rows, i, u, n, inverse, state)
    return u, v, shape, state


@inline_kernel
def axes_of(rows, i):
    """The rotation of eight Gaussians by columns, and one over the squared length of their quaternions."""
    r = rotation(get(rows, SHAPE, i), get(rows, SHAPE + 1, i), get(rows, SHAPE + 2, i), get(rows, SHAPE + 3, i))
    return (r[0], r[3], r[6]), (r[1], r[4], r[7]), (r[2], r[5], r[8]), r[9]


@inline_kernel
def _shape_of_axes(rows, i, u, n, inverse, state):
    s0, s1, s2 = get(rows, SHAPE + 4, i), get(rows, SHAPE + 5, i), get(rows, SHAPE + 6, i)
    e0, e1, e2, _ = axes_of(rows, i)
    a0, a1, a2 = s0 * inverse, s1 * inverse, s2 * inverse
    a0, a1, a2 = a0 * a0, a1 * a1, a2 * a2
    fits = max(max(a0, a1), a2) <= LARGEST_RATIO * LARGEST_RATIO
    state = either(fits, state, either(state < 0, state, fill_wide(0.0)))
    return shape_of_axes(u, n, e0, e1, e2, a0, a1, a2), state


@inline_kernel
def _shape_of_covariances(rows, i, u, v, n, inverse, state):
    xx, yy, zz = get(rows, SHAPE, i), get(rows, SHAPE + 4, i), get(rows, SHAPE + 8, i)
    xy, yx, xz = get(rows, SHAPE + 1, i), get(rows, SHAPE + 3, i), get(rows, SHAPE + 2, i)
    zx, yz, zy = get(rows, SHAPE + 6, i), get(rows, SHAPE + 5, i), get(rows, SHAPE + 7, i)
    xx, yy, zz = xx * inverse, yy * inverse, zz * inverse
    xy, xz, yz = 0.5 * (xy + yx) * inverse, 0.5 * (xz + zx) * inverse, 0.5 * (yz + zy) * inverse
    fits = is_covariance(xx, xy, xz, yy, yz, zz)
    state = either(fits, state, either(state < 0, state, fill_wide(0.0)))
    return shape_of_covariance(u, v, n, xx, xy, xz, yy, yz, zz), state


@inline_kernel
def find_shapes(covariances, pose, near, rows):
    """Find distance, direction, tangent frame and shape of a block, a row each, for `frame_and_shape`."""
    camera = columns_of_pose(pose)
    for i in range(0, LANES, WIDTH):
        n, radius, inverse, state = direction_of(rows, i, camera, near)
        u, v, shape, _ = shape_in(covariances, rows, i, n, inverse, state)
        keep(rows, RADIUS, i, radius)
        for axis in range(3):
            keep(rows, WORLD + axis, i, n[axis])
            keep(rows, FRAME + axis, i, u[axis])
            keep(rows, FRAME + 3 + axis, i, v[axis])
        for j in range(9):
            keep(rows, BODY + j, i, shape[j])


@inline_kernel
def frame_and_shape(rows, i):
    """The tangent frame and the shape that `find_shapes` kept, of one Gaussian."""
    u = rows[FRAME, i], rows[FRAME + 1, i], rows[FRAME + 2, i]
    v = rows[FRAME + 3, i], rows[FRAME + 4, i], rows[FRAME + 5, i]
    n = rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i]
    shape = (
        rows[BODY, i], rows[BODY + 1, i], rows[BODY + 2, i], rows[BODY + 3, i], rows[BODY + 4, i],
        rows[BODY + 5, i], rows[BODY + 6, i], rows[BODY + 7, i], rows[BODY + 8, i],
    )  # fmt: skip
    return u, v, n, shape


@inline_kernel
def log2(value):
    """Log2 of numbers above 0, within 1e-9."""
    mantissa, exponent = mantissa_and_exponent(value)
    s = (mantissa - 1) / (mantissa + 1)
    t = s * s
    series = 1 + t * (1 / 3 + t * (1 / 5 + t * (1 / 7 + t * (1 / 9))))
    return exponent + (2 / math.log(2)) * s * series


@inline_kernel
def _keep_direction(singles, axis, value):
    """Keep a coordinate of the direction, rounded, and what that leaves."""
    head = rounded(value)
    store(singles, (layout.DIRECTION + axis) * WIDTH, head)
    store(singles, (layout.DIRECTION_RESIDUAL + axis) * WIDTH, rounded(value - widened(head)))


@inline_kernel
def _find_records(covariances, pose, spread, compensate, near, rows, i, singles):
    """Write what eight Gaussians' records hold, a field a row of `singles`; return states, and which are drawn."""
    right, down, ahead, _ = pose
    unit, inverse_unit = math.sqrt(layout.HALF_LOG2_E), 1 / math.sqrt(layout.HALF_LOG2_E)
    n, radius, inverse, state = direction_of(rows, i, pose, near)
    keep(rows, RADIUS, i, radius)
    u, v, shape, state = shape_in(covariances, rows, i, n, inverse, state)
    state = state * get(rows, SOUND, i)
    (first, mix, second), front_a, front_b, along, _, inverse_det = whitening(shape, spread)
    a, b = whitened(u, v, first, mix, second)
    for axis in range(3):
        keep(rows, WORLD + axis, i, n[axis])
    _keep_direction(singles, 0, dot(*right, *n))
    _keep_direction(singles, 1, dot(*down, *n))
    _keep_direction(singles, 2, dot(*ahead, *n))
    a_row, b_row = layout.ROW_A * WIDTH, layout.ROW_B * WIDTH
    store(singles, a_row, rounded(unit * dot(*right, *a)))
    store(singles, a_row + WIDTH, rounded(unit * dot(*down, *a)))
    store(singles, a_row + 2 * WIDTH, rounded(unit * dot(*ahead, *a)))
    store(singles, b_row, rounded(unit * dot(*right, *b)))
    store(singles, b_row + WIDTH, rounded(unit * dot(*down, *b)))
    store(singles, b_row + 2 * WIDTH, rounded(unit * dot(*ahead, *b)))
    store(singles, layout.L_ALONG_A * WIDTH, rounded(inverse_unit * front_a))
    store(singles, layout.L_ALONG_B * WIDTH, rounded(inverse_unit * front_b))
    store(singles, layout.RADIAL_VARIANCE * WIDTH, rounded((1 / layout.HALF_LOG2_E) * along))
    opacity = get(rows, OPACITY, i)
    peak2 = opacity * opacity
    if compensate:
        peak2 = peak2 * max(shape[6] * inverse_det, LEAST_RATIO)
    drawn = (state > 0) & (opacity >= _FAINTEST)
    level = either(drawn, 0.5 * log2(either(drawn, peak2, fill_wide(1.0))), fill_wide(CULLED))
    store(singles, layout.LOG2_PEAK * WIDTH, rounded(level))
    return state, drawn


@inline_kernel
def _check_numbers(rows, first, end, count):
    """Clear SOUND of Gaussians with a number that is not finite or absurdly large among the rows."""
    for row in range(first, end):
        for i in range(count):
            if not abs(rows[row, i]) < _LARGEST:
                rows[SOUND, i] = 0.0


@inline_kernel
def _check_harmonics(harmonic_bits, size, start, count, rows):
    """Set SOUND, and clear it for Gaussians with such a coefficient; each has `size` of them."""
    for i in range(LANES):
        rows[SOUND, i] = 1.0
    largest = np.uint32(0)
    for j in range(0, size * count, 2 * WIDTH):
        prefetch(harmonic_bits, size * (start + AHEAD) + j)
    block = harmonic_bits[start * size : (start + count) * size]
    for j in range(block.shape[0]):
        bits = np.uint32(block[j] << np.uint32(1))  # without the sign
        largest = bits if bits > largest else largest
    if largest < _LARGEST_BITS:
        return
    for j in range(block.shape[0]):
        if np.uint32(block[j] << np.uint32(1)) >= _LARGEST_BITS:
            rows[SOUND, j // size] = 0.0


@kernel
def _observe(
    piece, means, quats, scales, covariances, opacities, harmonics, harmonic_bits,
    pose, spread, compensate, near, bends, records, values, radii, drawn, tallies,
):  # fmt: skip
    align_stack()
    rows, seen = np.ones((ROWS, LANES)), np.empty(LANES, np.uint8)
    basis, singles = np.empty((25, LANES), np.float32), np.empty(layout.RECORD_SIZE * WIDTH, np.float32)
    dropped, too_near, camera = 0, 0, columns_of_pose(pose)
    for start in range(piece * PIECE, min((piece + 1) * PIECE, means.shape[0]), LANES):
        count = min(LANES, means.shape[0] - start)
        suspect = read_block(means, quats, scales, covariances, opacities, start, count, rows)
        _check_harmonics(harmonic_bits, harmonics.shape[1] * harmonics.shape[2], start, count, rows)
        if suspect:
            _check_numbers(rows, MEAN, OPACITY + 1, count)
        for i in range(0, count, WIDTH):
            state, is_drawn = _find_records(covariances, camera, spread, compensate, near, rows, i, singles)
            there = min(WIDTH, count - i)
            inside = np.uint64((1 << there) - 1)
            dropped += how_many(bits_of(state == 0.0) & inside)
            too_near += how_many(bits_of(state < 0.0) & inside)
            store_mask(seen, i, is_drawn)
            write_columns(singles, WIDTH, start + i, there, records)
        for i in range(count):
            put(radii, start + i, rows[RADIUS, i])
        for i in range(count):
            put(drawn, start + i, seen[i])
        fill_basis(rows, WORLD, harmonics.shape[1], bends, basis)
        colours(harmonics, start, count, basis, bends, rows, RADIUS, values)
    tallies[piece, DROPPED], tallies[piece, NEAR] = dropped, too_near


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


def observe(fields: Fields, camera: Camera, workspace: Workspace, threads: int) -> Observed:
    """The Gaussians as the camera sees them, in leased arrays."""
    num, channels = len(fields.means), fields.harmonics.shape[2]
    records, radii = workspace.array((num, layout.RECORD_SIZE), np.float32), workspace.array(num, np.float64)
    values, drawn = workspace.array((num, channels + 1), np.float32), workspace.array(num, np.uint8)
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

    parallel_for(work, pieces, threads)
    dropped, near = (int(count) for count in tallies.sum(axis=0))
    return Observed(records, values, radii, drawn, dropped, near)
