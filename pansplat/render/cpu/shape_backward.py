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
def _axis_backward(rows, i, e, scale2, cosine, det_share, n):
    """Gradient of a unit axis e of the Gaussian, and e'G e."""
    xx, xy, xz = rows[C_GRAD, i], rows[C_GRAD + 1, i], rows[C_GRAD + 2, i]
    yy, yz, zz = rows[C_GRAD + 3, i], rows[C_GRAD + 4, i], rows[C_GRAD + 5, i]
    x = xx * e[0] + xy * e[1] + xz * e[2]
    y = xy * e[0] + yy * e[1] + yz * e[2]
    z = xz * e[0] + yz * e[1] + zz * e[2]
    turn = 2 * det_share * cosine
    grad = 2 * scale2 * x + turn * n[0], 2 * scale2 * y + turn * n[1], 2 * scale2 * z + turn * n[2]
    return grad, dot(*e, x, y, z)


@inlined
def axes_backward(rows):
    """Gradients of quaternion, scales and distance from those of C and ln det B = ln sum_k w_k (n.e_k)^2."""
    for i in range(LANES):
        n = rows[WORLD, i], rows[WORLD + 1, i], rows[WORLD + 2, i]
        r = rotation(rows[SHAPE, i], rows[SHAPE + 1, i], rows[SHAPE + 2, i], rows[SHAPE + 3, i])
        inverse = 1 / rows[RADIUS, i]
        s0, s1, s2 = rows[SHAPE + 4, i] * inverse, rows[SHAPE + 5, i] * inverse, rows[SHAPE + 6, i] * inverse
        e0, e1, e2 = (r[0], r[3], r[6]), (r[1], r[4], r[7]), (r[2], r[5], r[8])
        n0, n1, n2 = dot(*n, *e0), dot(*n, *e1), dot(*n, *e2)
        a0, a1, a2 = s0 * s0, s1 * s1, s2 * s2
        g = rows[DET_GRAD, i]
        g0, own0 = _axis_backward(rows, i, e0, a0, n0, g * a1 * a2, n)
        g1, own1 = _axis_backward(rows, i, e1, a1, n1, g * a2 * a0, n)
        g2, own2 = _axis_backward(rows, i, e2, a2, n2, g * a0 * a1, n)
        t0, t1, t2 = 2 * g * a1 * a2 * n0, 2 * g * a2 * a0 * n1, 2 * g * a0 * a1 * n2
        for axis in range(3):
            rows[N_GRAD + axis, i] += t0 * e0[axis] + t1 * e1[axis] + t2 * e2[axis]
        d0 = 2 * s0 * (own0 + g * (a2 * n1 * n1 + a1 * n2 * n2))
        d1 = 2 * s1 * (own1 + g * (a2 * n0 * n0 + a0 * n2 * n2))
        d2 = 2 * s2 * (own2 + g * (a1 * n0 * n0 + a0 * n1 * n1))
        rows[GIVEN_RADIUS, i] -= (d0 * s0 + d1 * s1 + d2 * s2) * inverse
        rows[OUT_SHAPE + 4, i], rows[OUT_SHAPE + 5, i] = d0 * inverse, d1 * inverse
        rows[OUT_SHAPE + 6, i] = d2 * inverse
        w, x, y, z, over_norm = r[9], r[10], r[11], r[12], r[13]
        skew_x, skew_y, skew_z = g1[2] - g2[1], g2[0] - g0[2], g0[1] - g1[0]
        sum_x, sum_y, sum_z = g1[2] + g2[1], g2[0] + g0[2], g0[1] + g1[0]
        q_w = 2 * (x * skew_x + y * skew_y + z * skew_z)
        q_x = 2 * (w * skew_x - 2 * x * (g1[1] + g2[2]) + y * sum_z + z * sum_y)
        q_y = 2 * (w * skew_y - 2 * y * (g0[0] + g2[2]) + x * sum_z + z * sum_x)
        q_z = 2 * (w * skew_z - 2 * z * (g0[0] + g1[1]) + x * sum_y + y * sum_x)
        outward = w * q_w + x * q_x + y * q_y + z * q_z
        rows[OUT_SHAPE, i], rows[OUT_SHAPE + 1, i] = (q_w - outward * w) * over_norm, (q_x - outward * x) * over_norm
        rows[OUT_SHAPE + 2, i] = (q_y - outward * y) * over_norm
        rows[OUT_SHAPE + 3, i] = (q_z - outward * z) * over_norm
