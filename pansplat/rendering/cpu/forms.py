"""The kernel's forms of Gaussians from their shapes; numbers here are vectors of eight float64 (see wide.py).

Source: docs/rendering.md, sections 1 to 3. Everything is float64 and divided by the distance. A shape is its
covariance in the tangent frame u, v, n together with the minors that float arithmetic cannot take from it:

    uu, uv, vv, un, vn, nn    C in the frame
    det_across                det B
    mixed                     M = nn (uu + vv) - un^2 - vn^2
    det                       det C
"""

import math

from pansplat.constants import MAX_SCALE_RATIO, MIN_COMPENSATION, MIN_EIGENVALUE_RATIO
from pansplat.rendering.cpu.runtime import inline_kernel
from pansplat.rendering.cpu.wide import either, fill_wide

LEAST_RATIO = MIN_COMPENSATION
_NEGATIVE = -MIN_EIGENVALUE_RATIO
LARGEST_RATIO = MAX_SCALE_RATIO


@inline_kernel
def dot(ax, ay, az, bx, by, bz):
    """a . b"""
    return ax * bx + ay * by + az * bz


@inline_kernel
def cross(ax, ay, az, bx, by, bz):
    """a ^ b"""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inline_kernel
def tangent_frame(x, y, z):
    """Two unit vectors u, v that make a right-handed frame with the unit direction.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
    """
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b, c = x * y * a, sign * x
    return 1 + c * x * a, sign * b, -c, b, sign + y * y * a, -y


@inline_kernel
def rotation(w, x, y, z):
    """Rows of the rotation matrix of a quaternion of any length, and one over its square; zero is the identity."""
    norm2 = w * w + x * x + y * y + z * z
    inverse = either(norm2 > 0, 1 / norm2, fill_wide(0.0))
    twice = 2 * inverse
    x2, y2, z2 = twice * x, twice * y, twice * z
    return (
        1 - (y * y2 + z * z2), x * y2 - w * z2, x * z2 + w * y2,
        x * y2 + w * z2, 1 - (x * x2 + z * z2), y * z2 - w * x2,
        x * z2 - w * y2, y * z2 + w * x2, 1 - (x * x2 + y * y2),
        inverse,
    )  # fmt: skip


@inline_kernel
def shape_of_axes(u, n, e0, e1, e2, s0, s1, s2):
    """A shape from unit axes e_k, right-handed, and squares of scales over distance.

    Sums of squares only, so nothing cancels.
    """
    u0, u1, u2 = dot(*u, *e0), dot(*u, *e1), dot(*u, *e2)
    n0, n1, n2 = dot(*n, *e0), dot(*n, *e1), dot(*n, *e2)
    v0, v1, v2 = cross(n0, n1, n2, u0, u1, u2)
    w0, w1, w2 = s1 * s2, s2 * s0, s0 * s1
    return (
        s0 * u0 * u0 + s1 * u1 * u1 + s2 * u2 * u2,
        s0 * u0 * v0 + s1 * u1 * v1 + s2 * u2 * v2,
        s0 * v0 * v0 + s1 * v1 * v1 + s2 * v2 * v2,
        s0 * u0 * n0 + s1 * u1 * n1 + s2 * u2 * n2,
        s0 * v0 * n0 + s1 * v1 * n1 + s2 * v2 * n2,
        s0 * n0 * n0 + s1 * n1 * n1 + s2 * n2 * n2,
        w0 * n0 * n0 + w1 * n1 * n1 + w2 * n2 * n2,
        w0 * (u0 * u0 + v0 * v0) + w1 * (u1 * u1 + v1 * v1) + w2 * (u2 * u2 + v2 * v2),
        s0 * w0,
    )


@inline_kernel
def shape_of_covariance(u, v, n, xx, xy, xz, yy, yz, zz):
    """A shape from a covariance over squared distance; minors that rounding made negative count as zero."""
    cu = xx * u[0] + xy * u[1] + xz * u[2], xy * u[0] + yy * u[1] + yz * u[2], xz * u[0] + yz * u[1] + zz * u[2]
    cv = xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2], xz * v[0] + yz * v[1] + zz * v[2]
    cn = xx * n[0] + xy * n[1] + xz * n[2], xy * n[0] + yy * n[1] + yz * n[2], xz * n[0] + yz * n[1] + zz * n[2]
    uu, uv, vv = dot(*u, *cu), dot(*u, *cv), dot(*v, *cv)
    un, vn, nn = dot(*u, *cn), dot(*v, *cn), max(dot(*n, *cn), 0.0)
    det = uu * (vv * nn - vn * vn) - uv * (uv * nn - vn * un) + un * (uv * vn - vv * un)
    mixed = nn * (uu + vv) - un * un - vn * vn
    return uu, uv, vv, un, vn, nn, max(uu * vv - uv * uv, 0.0), max(mixed, 0.0), max(det, 0.0)


@inline_kernel
def is_covariance(xx, xy, xz, yy, yz, zz):
    """Whether a symmetric matrix over squared distance has no eigenvalue below what rounding explains."""
    largest = max(max(xx, yy), zz)
    bound = (1 + _NEGATIVE) * largest
    bound = bound * bound
    xx, yy, zz = xx + _NEGATIVE * largest, yy + _NEGATIVE * largest, zz + _NEGATIVE * largest
    minor = xx * yy - xy * xy
    det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    small = (xy * xy <= bound) & (xz * xz <= bound) & (yz * yz <= bound) & (largest <= LARGEST_RATIO**2)
    return small & (largest >= 0) & (xx >= 0) & (minor >= 0) & (det >= 0)


@inline_kernel
def whitening(shape, spread):
    """How tangent axes are whitened, the front form's share of each, S', det B' and one over it."""
    _, uv, _, un, vn, nn, det_across, mixed, det = shape
    b_uu, trace = shape[0] + spread, shape[0] + shape[2]
    det_filtered = det_across + spread * trace + spread * spread
    inverse = 1 / det_filtered
    first, second = 1 / math.sqrt(b_uu), math.sqrt(b_uu * inverse)
    mix = uv * first * first
    along = (spread * spread * nn + spread * mixed + det) * inverse
    return (first, mix, second), -un * first, (mix * un - vn) * second, along, det_filtered, inverse


@inline_kernel
def whitened(u, v, first, mix, second):
    """The whitened axes a and b."""
    a = u[0] * first, u[1] * first, u[2] * first
    return a, ((v[0] - mix * u[0]) * second, (v[1] - mix * u[1]) * second, (v[2] - mix * u[2]) * second)
