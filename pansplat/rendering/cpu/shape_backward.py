"""From gradients of a Gaussian's covariance, before the filter, to those of what it was made from.

Source: docs/rendering.md, sections 1 and 2, differentiated by hand; everything is over the distance, as there.
"""

from pansplat.rendering.cpu.forms import cross, dot, whitened
from pansplat.rendering.cpu.observe import ROWS, SHAPE, axes_of
from pansplat.rendering.cpu.runtime import inline_kernel
from pansplat.rendering.cpu.wide import get, keep

# Rows of a block, after those of observe.py.
GIVEN_RADIUS = ROWS  # gradient of the distance
N_GRAD = ROWS + 1  # of n, world axes; then of the mean
OUT_SHAPE = ROWS + 4  # of a quaternion and three scales, or a covariance's six numbers: xx xy xz yy yz zz
TOTAL = ROWS + 11  # what the classic kernel passes back: gradients of n and C
ALL_ROWS = ROWS + 20


@inline_kernel
def quadratic(u, v, n, parts):
    """The gradient of C (xx xy xz yy yz zz) in the axes that u, v and n are given in, from what the forms' leave.

    Its rows are combinations of a, b, n, l; it is symmetric once its transpose is added.
    """
    (first, mix, second), (alpha, beta), g_along, (aa, ab, bb, by_alpha, by_beta) = parts
    a, b = whitened(u, v, first, mix, second)
    c = (
        aa * a[0] + ab * b[0] - by_alpha * n[0],
        aa * a[1] + ab * b[1] - by_alpha * n[1],
        aa * a[2] + ab * b[2] - by_alpha * n[2],
    )
    d = bb * b[0] - by_beta * n[0], bb * b[1] - by_beta * n[1], bb * b[2] - by_beta * n[2]
    front = (
        n[0] + alpha * a[0] + beta * b[0],
        n[1] + alpha * a[1] + beta * b[1],
        n[2] + alpha * a[2] + beta * b[2],
    )
    bent = g_along * front[0], g_along * front[1], g_along * front[2]
    return (
        bent[0] * front[0] + 2 * (a[0] * c[0] + b[0] * d[0]),
        bent[0] * front[1] + a[0] * c[1] + a[1] * c[0] + b[0] * d[1] + b[1] * d[0],
        bent[0] * front[2] + a[0] * c[2] + a[2] * c[0] + b[0] * d[2] + b[2] * d[0],
        bent[1] * front[1] + 2 * (a[1] * c[1] + b[1] * d[1]),
        bent[1] * front[2] + a[1] * c[2] + a[2] * c[1] + b[1] * d[2] + b[2] * d[1],
        bent[2] * front[2] + 2 * (a[2] * c[2] + b[2] * d[2]),
    )


@inline_kernel
def totals_of_shape(rows, i):
    """What the classic kernel passes back to C, world axes."""
    return (
        get(rows, TOTAL + 3, i), get(rows, TOTAL + 4, i), get(rows, TOTAL + 5, i),
        get(rows, TOTAL + 6, i), get(rows, TOTAL + 7, i), get(rows, TOTAL + 8, i),
    )  # fmt: skip


@inline_kernel
def covariances_backward(rows, i, totals, u, v, n, shape, inverse, g_n, parts, g):
    """Write the gradients of eight covariances; return those of n and the distance.

    Args:
        totals: None, or what the classic kernel passes back, kept in rows.
        inverse: one over the distance.
        g_n, parts, g: gradients of n, C (see `quadratic`) and ln det B.
    """
    xx, xy, xz, yy, yz, zz = quadratic(u, v, n, parts)
    if totals is not None:
        t = totals_of_shape(rows, i)
        xx, xy, xz, yy, yz, zz = xx + t[0], xy + t[1], xz + t[2], yy + t[3], yz + t[4], zz + t[5]
    uu, uv, vv, un, vn = shape[0], shape[1], shape[2], shape[3], shape[4]
    # det B = uu vv - uv^2; the frame turns with n.
    xx = xx + g * (vv * u[0] * u[0] + uu * v[0] * v[0] - 2 * uv * u[0] * v[0])
    yy = yy + g * (vv * u[1] * u[1] + uu * v[1] * v[1] - 2 * uv * u[1] * v[1])
    zz = zz + g * (vv * u[2] * u[2] + uu * v[2] * v[2] - 2 * uv * u[2] * v[2])
    xy = xy + g * (vv * u[0] * u[1] + uu * v[0] * v[1] - uv * (u[0] * v[1] + u[1] * v[0]))
    xz = xz + g * (vv * u[0] * u[2] + uu * v[0] * v[2] - uv * (u[0] * v[2] + u[2] * v[0]))
    yz = yz + g * (vv * u[1] * u[2] + uu * v[1] * v[2] - uv * (u[1] * v[2] + u[2] * v[1]))
    by_u, by_v = 2 * g * (uv * vn - vv * un), 2 * g * (uv * un - uu * vn)
    g_n = g_n[0] + by_u * u[0] + by_v * v[0], g_n[1] + by_u * u[1] + by_v * v[1], g_n[2] + by_u * u[2] + by_v * v[2]
    whole = xx * get(rows, SHAPE, i) + yy * get(rows, SHAPE + 4, i) + zz * get(rows, SHAPE + 8, i)
    whole = whole + xy * (get(rows, SHAPE + 1, i) + get(rows, SHAPE + 3, i))
    whole = whole + xz * (get(rows, SHAPE + 2, i) + get(rows, SHAPE + 6, i))
    whole = whole + yz * (get(rows, SHAPE + 5, i) + get(rows, SHAPE + 7, i))
    squared = inverse * inverse
    found = xx, xy, xz, yy, yz, zz
    for j in range(6):
        keep(rows, OUT_SHAPE + j, i, found[j] * squared)
    return g_n, -2 * whole * squared * inverse


@inline_kernel
def axes_backward(rows, i, totals, u, n, inverse, g_n, parts, g):
    """Write the gradients of eight quaternions and scales; return those of n and the distance.

    ln det B = ln sum_k w_k (n.e_k)^2. Turning the axes about one of them does nothing if the other two scales are the
    same, and no rounding hides it: with G the gradient of C in the own axes and a_k the squared scales, the torque
    about axis 0 is 2 (a_1 - a_2) (G_12 - g a_0 n_1 n_2), and so on round.

    Args:
        totals: None, or what the classic kernel passes back, kept in rows.
        inverse: one over the distance.
        g_n, parts, g: gradients of n, C (see `quadratic`) and ln det B.
    """
    e0, e1, e2, inverse2 = axes_of(rows, i)
    s0, s1 = get(rows, SHAPE + 4, i) * inverse, get(rows, SHAPE + 5, i) * inverse
    s2 = get(rows, SHAPE + 6, i) * inverse
    u0, u1, u2 = dot(*u, *e0), dot(*u, *e1), dot(*u, *e2)
    n0, n1, n2 = dot(*n, *e0), dot(*n, *e1), dot(*n, *e2)
    g00, g01, g02, g11, g12, g22 = quadratic((u0, u1, u2), cross(n0, n1, n2, u0, u1, u2), (n0, n1, n2), parts)
    if totals is not None:
        t = totals_of_shape(rows, i)
        by_0, by_1, by_2 = _times(t, e0), _times(t, e1), _times(t, e2)
        g00, g11, g22 = g00 + dot(*e0, *by_0), g11 + dot(*e1, *by_1), g22 + dot(*e2, *by_2)
        g01, g02, g12 = g01 + dot(*e0, *by_1), g02 + dot(*e2, *by_0), g12 + dot(*e1, *by_2)
    a0, a1, a2 = s0 * s0, s1 * s1, s2 * s2
    gn0, gn1, gn2 = g * n0, g * n1, g * n2
    t0, t1, t2 = 2 * a1 * a2 * gn0, 2 * a2 * a0 * gn1, 2 * a0 * a1 * gn2
    g_n = (
        g_n[0] + t0 * e0[0] + t1 * e1[0] + t2 * e2[0],
        g_n[1] + t0 * e0[1] + t1 * e1[1] + t2 * e2[1],
        g_n[2] + t0 * e0[2] + t1 * e1[2] + t2 * e2[2],
    )
    q0, q1, q2 = gn0 * n0, gn1 * n1, gn2 * n2
    d0 = 2 * s0 * (g00 + a2 * q1 + a1 * q2)
    d1 = 2 * s1 * (g11 + a2 * q0 + a0 * q2)
    d2 = 2 * s2 * (g22 + a1 * q0 + a0 * q1)
    keep(rows, OUT_SHAPE + 4, i, d0 * inverse)
    keep(rows, OUT_SHAPE + 5, i, d1 * inverse)
    keep(rows, OUT_SHAPE + 6, i, d2 * inverse)
    # A unit quaternion q that turns with the torque changes by q (0, torque) / 2.
    twice = 4 * inverse2
    x = twice * (a1 - a2) * (g12 - a0 * gn1 * n2)
    y = twice * (a2 - a0) * (g02 - a1 * gn2 * n0)
    z = twice * (a0 - a1) * (g01 - a2 * gn0 * n1)
    q = get(rows, SHAPE, i), get(rows, SHAPE + 1, i), get(rows, SHAPE + 2, i), get(rows, SHAPE + 3, i)
    keep(rows, OUT_SHAPE, i, -(q[1] * x + q[2] * y + q[3] * z))
    keep(rows, OUT_SHAPE + 1, i, q[0] * x + q[2] * z - q[3] * y)
    keep(rows, OUT_SHAPE + 2, i, q[0] * y + q[3] * x - q[1] * z)
    keep(rows, OUT_SHAPE + 3, i, q[0] * z + q[1] * y - q[2] * x)
    return g_n, -(d0 * s0 + d1 * s1 + d2 * s2) * inverse


@inline_kernel
def _times(matrix, e):
    """A symmetric matrix times a vector."""
    xx, xy, xz, yy, yz, zz = matrix
    return dot(xx, xy, xz, *e), dot(xy, yy, yz, *e), dot(xz, yz, zz, *e)
