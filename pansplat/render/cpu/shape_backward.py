"""From gradients of a Gaussian's covariance, before the filter, to those of what it was made from.

Source: docs/rendering.md, sections 1 and 2, differentiated by hand; everything is over the distance, as there.
"""

from pansplat.render.cpu.compiling import inlined
from pansplat.render.cpu.forms import dot, rotation
from pansplat.render.cpu.observe import LANES, RADIUS, ROWS, SHAPE, WORLD, frame_and_shape

# Rows of a block, after those of observe.py.
GIVEN = ROWS + 1  # gradients of the record: n, a, b (camera axes), alpha, beta, S', ln peak
GIVEN_RADIUS = GIVEN + 13
N_GRAD = GIVEN + 14  # of n, world axes
C_GRAD = GIVEN + 17  # of C: xx xy xz yy yz zz
DET_GRAD = GIVEN + 23  # of ln det B
OUT_MEAN = GIVEN + 24
OUT_SHAPE = GIVEN + 27  # a quaternion and three scales, or a covariance's six numbers
ALL_ROWS = GIVEN + 34


@inlined
def covariances_backward(rows):
    """Gradients of the covariance and the distance from those of C and ln det B."""
    for i in range(LANES):
        u, v, _, shape = frame_and_shape(rows, i)
        uu, uv, vv, un, vn = shape[0], shape[1], shape[2], shape[3], shape[4]
        g = rows[DET_GRAD, i]
        xx, xy, xz = rows[C_GRAD, i], rows[C_GRAD + 1, i], rows[C_GRAD + 2, i]
        yy, yz, zz = rows[C_GRAD + 3, i], rows[C_GRAD + 4, i], rows[C_GRAD + 5, i]
        # det B = uu vv - uv^2; the frame turns with n.
        xx += g * (vv * u[0] * u[0] + uu * v[0] * v[0] - 2 * uv * u[0] * v[0])
        yy += g * (vv * u[1] * u[1] + uu * v[1] * v[1] - 2 * uv * u[1] * v[1])
        zz += g * (vv * u[2] * u[2] + uu * v[2] * v[2] - 2 * uv * u[2] * v[2])
        xy += g * (vv * u[0] * u[1] + uu * v[0] * v[1] - uv * (u[0] * v[1] + u[1] * v[0]))
        xz += g * (vv * u[0] * u[2] + uu * v[0] * v[2] - uv * (u[0] * v[2] + u[2] * v[0]))
        yz += g * (vv * u[1] * u[2] + uu * v[1] * v[2] - uv * (u[1] * v[2] + u[2] * v[1]))
        by_u, by_v = 2 * g * (uv * vn - vv * un), 2 * g * (uv * un - uu * vn)
        for axis in range(3):
            rows[N_GRAD + axis, i] += by_u * u[axis] + by_v * v[axis]
        inverse = 1 / (rows[RADIUS, i] * rows[RADIUS, i])
        rows[OUT_SHAPE, i], rows[OUT_SHAPE + 1, i], rows[OUT_SHAPE + 2, i] = xx * inverse, xy * inverse, xz * inverse
        rows[OUT_SHAPE + 3, i], rows[OUT_SHAPE + 4, i], rows[OUT_SHAPE + 5, i] = (
            yy * inverse,
            yz * inverse,
            zz * inverse,
        )
        whole = xx * rows[SHAPE, i] + yy * rows[SHAPE + 4, i] + zz * rows[SHAPE + 8, i]
        whole += xy * (rows[SHAPE + 1, i] + rows[SHAPE + 3, i]) + xz * (rows[SHAPE + 2, i] + rows[SHAPE + 6, i])
        whole += yz * (rows[SHAPE + 5, i] + rows[SHAPE + 7, i])
        rows[GIVEN_RADIUS, i] -= 2 * whole * inverse / rows[RADIUS, i]


@inlined
def axes_backward(rows):
    """Gradients of quaternion, scales and distance from those of C and ln det B = ln sum_k w_k (n.e_k)^2.

    Turning the axes about one of them does nothing if the other two scales are the same, and no rounding hides it:
    with G the gradient of C in the own axes and a_k the squared scales, the torque about axis 0 is
    2 (a_1 - a_2) (G_12 - g a_0 n_1 n_2), and so on round.
    """
    for i in range(LANES):
        n = rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i]
        r = rotation(rows[SHAPE, i], rows[SHAPE + 1, i], rows[SHAPE + 2, i], rows[SHAPE + 3, i])
        inverse = 1 / rows[RADIUS, i]
        s0, s1, s2 = rows[SHAPE + 4, i] * inverse, rows[SHAPE + 5, i] * inverse, rows[SHAPE + 6, i] * inverse
        e0, e1, e2 = (r[0], r[3], r[6]), (r[1], r[4], r[7]), (r[2], r[5], r[8])
        n0, n1, n2 = dot(*n, *e0), dot(*n, *e1), dot(*n, *e2)
        a0, a1, a2, g = s0 * s0, s1 * s1, s2 * s2, rows[DET_GRAD, i]
        by_0, by_1, by_2 = _times(rows, i, e0), _times(rows, i, e1), _times(rows, i, e2)
        t0, t1, t2 = 2 * g * a1 * a2 * n0, 2 * g * a2 * a0 * n1, 2 * g * a0 * a1 * n2
        for axis in range(3):
            rows[N_GRAD + axis, i] += t0 * e0[axis] + t1 * e1[axis] + t2 * e2[axis]
        d0 = 2 * s0 * (dot(*e0, *by_0) + g * (a2 * n1 * n1 + a1 * n2 * n2))
        d1 = 2 * s1 * (dot(*e1, *by_1) + g * (a2 * n0 * n0 + a0 * n2 * n2))
        d2 = 2 * s2 * (dot(*e2, *by_2) + g * (a1 * n0 * n0 + a0 * n1 * n1))
        rows[GIVEN_RADIUS, i] -= (d0 * s0 + d1 * s1 + d2 * s2) * inverse
        rows[OUT_SHAPE + 4, i], rows[OUT_SHAPE + 5, i] = d0 * inverse, d1 * inverse
        rows[OUT_SHAPE + 6, i] = d2 * inverse
        # A quaternion q that turns with the torque changes by q (0, torque) / 2.
        twice = 4 * r[13]
        x = twice * (a1 - a2) * (dot(*e1, *by_2) - g * a0 * n1 * n2)
        y = twice * (a2 - a0) * (dot(*e2, *by_0) - g * a1 * n2 * n0)
        z = twice * (a0 - a1) * (dot(*e0, *by_1) - g * a2 * n0 * n1)
        rows[OUT_SHAPE, i] = -r[10] * x - r[11] * y - r[12] * z
        rows[OUT_SHAPE + 1, i] = r[9] * x + r[11] * z - r[12] * y
        rows[OUT_SHAPE + 2, i] = r[9] * y + r[12] * x - r[10] * z
        rows[OUT_SHAPE + 3, i] = r[9] * z + r[10] * y - r[11] * x


@inlined
def _times(rows, i, e):
    """The gradient of C times a vector."""
    xx, xy, xz = rows[C_GRAD, i], rows[C_GRAD + 1, i], rows[C_GRAD + 2, i]
    yy, yz, zz = rows[C_GRAD + 3, i], rows[C_GRAD + 4, i], rows[C_GRAD + 5, i]
    return dot(xx, xy, xz, *e), dot(xy, yy, yz, *e), dot(xz, yz, zz, *e)
