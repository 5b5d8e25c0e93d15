"""Real spherical harmonics and their slopes for a block of directions, and colours of coefficients in any channels.

Convention: order and signs of pansplat.gaussians.harmonics, whose polynomials these are.
"""

import math

import numpy as np

from pansplat.rendering.cpu.groups import apart, quarters, together
from pansplat.rendering.cpu.runtime import inline_kernel
from pansplat.rendering.cpu.simd import LANES, choose, element, fill, load, maximum, multiply_add, store
from pansplat.rendering.cpu.wide import get, rounded

_C0 = 0.5 / math.sqrt(math.pi)
_C1 = 0.5 * math.sqrt(3 / math.pi)
_C2 = 0.5 * math.sqrt(15 / math.pi)
_C2_ZONAL = 0.25 * math.sqrt(5 / math.pi)
_C3A, _C3B, _C3C = 0.25 * math.sqrt(10.5 / math.pi), 0.5 * math.sqrt(105 / math.pi), 0.25 * math.sqrt(17.5 / math.pi)
_C3_ZONAL = 0.25 * math.sqrt(7 / math.pi)
_C4A, _C4B = 0.75 * math.sqrt(2.5 / math.pi), 0.75 * math.sqrt(5 / math.pi)
_C4C, _C4D = 0.75 * math.sqrt(17.5 / math.pi), 0.75 * math.sqrt(35 / math.pi)
_C4_ZONAL = 0.1875 / math.sqrt(math.pi)


@inline_kernel
def fill_basis(rows, x_row, num, bends, basis):
    """Write the `num` harmonics of the directions in three rows from `x_row` on, a row each.

    Args:
        bends: None if `num` is 1; then the rest is not even compiled.
    """
    for i in range(basis.shape[1]):
        basis[0, i] = _C0
    if bends is not None:
        _fill_others(rows, x_row, num, basis)


@inline_kernel
def _fill_others(rows, x_row, num, basis):
    lanes = basis.shape[1]
    if num >= 4:
        for i in range(lanes):
            x, y, z = rows[x_row, i], rows[x_row + 1, i], rows[x_row + 2, i]
            basis[1, i], basis[2, i], basis[3, i] = -_C1 * y, _C1 * z, -_C1 * x
    if num >= 9:
        for i in range(lanes):
            x, y, z = rows[x_row, i], rows[x_row + 1, i], rows[x_row + 2, i]
            basis[4, i], basis[5, i], basis[7, i] = _C2 * x * y, -_C2 * y * z, -_C2 * x * z
            basis[6, i] = _C2_ZONAL * (2 * z * z - x * x - y * y)
            basis[8, i] = 0.5 * _C2 * (x * x - y * y)
    if num >= 16:
        for i in range(lanes):
            x, y, z = rows[x_row, i], rows[x_row + 1, i], rows[x_row + 2, i]
            xx, yy, zz = x * x, y * y, z * z
            basis[9, i], basis[15, i] = -_C3C * y * (3 * xx - yy), -_C3C * x * (xx - 3 * yy)
            basis[10, i], basis[14, i] = _C3B * x * y * z, 0.5 * _C3B * z * (xx - yy)
            basis[11, i], basis[13, i] = -_C3A * y * (4 * zz - xx - yy), -_C3A * x * (4 * zz - xx - yy)
            basis[12, i] = _C3_ZONAL * z * (2 * zz - 3 * xx - 3 * yy)
    if num >= 25:
        for i in range(lanes):
            x, y, z = rows[x_row, i], rows[x_row + 1, i], rows[x_row + 2, i]
            xx, yy, zz = x * x, y * y, z * z
            basis[16, i], basis[24, i] = (
                _C4D * x * y * (xx - yy),
                0.25 * _C4D * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
            )
            basis[17, i], basis[23, i] = -_C4C * y * z * (3 * xx - yy), -_C4C * x * z * (xx - 3 * yy)
            basis[18, i], basis[22, i] = _C4B * x * y * (7 * zz - 1), 0.5 * _C4B * (xx - yy) * (7 * zz - 1)
            basis[19, i], basis[21, i] = -_C4A * y * z * (7 * zz - 3), -_C4A * x * z * (7 * zz - 3)
            basis[20, i] = _C4_ZONAL * (zz * (35 * zz - 30) + 3)


@inline_kernel
def add_slopes(rows, x_row, num, bends, slopes, g_row):
    """Add to three rows from `g_row` on the gradient to the direction, given that to each harmonic in `slopes`.

    It holds along the sphere; what it says across means nothing, as in the torch reference.

    Args:
        bends: None if `num` is 1; then there is nothing to compile.
    """
    if bends is not None:
        _add_others(rows, x_row, num, slopes, g_row)


@inline_kernel
def _add_others(rows, x_row, num, slopes, g_row):
    lanes = slopes.shape[1]
    if num >= 4:
        for i in range(lanes):
            rows[g_row, i] -= _C1 * slopes[3, i]
            rows[g_row + 1, i] -= _C1 * slopes[1, i]
            rows[g_row + 2, i] += _C1 * slopes[2, i]
    if num >= 9:
        for i in range(lanes):
            x, y, z = rows[x_row, i], rows[x_row + 1, i], rows[x_row + 2, i]
            g4, g5, g6, g7, g8 = slopes[4, i], slopes[5, i], slopes[6, i], slopes[7, i], slopes[8, i]
            rows[g_row, i] += _C2 * (g4 * y - g7 * z + g8 * x) - 2 * _C2_ZONAL * g6 * x
            rows[g_row + 1, i] += _C2 * (g4 * x - g5 * z - g8 * y) - 2 * _C2_ZONAL * g6 * y
            rows[g_row + 2, i] += -_C2 * (g5 * y + g7 * x) + 4 * _C2_ZONAL * g6 * z
    if num >= 16:
        _add_cubic_slopes(rows, x_row, slopes, g_row)
    if num >= 25:
        _add_quartic_slopes(rows, x_row, slopes, g_row)


@inline_kernel
def _add_cubic_slopes(rows, x_row, slopes, g_row):
    for i in range(slopes.shape[1]):
        x, y, z = rows[x_row, i], rows[x_row + 1, i], rows[x_row + 2, i]
        xx, yy, zz = x * x, y * y, z * z
        g9, g15 = -_C3C * slopes[9, i], -_C3C * slopes[15, i]
        g10, g14 = _C3B * slopes[10, i], _C3B * slopes[14, i]
        g11, g13 = -_C3A * slopes[11, i], -_C3A * slopes[13, i]
        g12 = _C3_ZONAL * slopes[12, i]
        rows[g_row, i] += (
            6 * g9 * x * y + g10 * y * z - 2 * g11 * x * y - 6 * g12 * x * z
            + g13 * (4 * zz - 3 * xx - yy) + g14 * x * z + 3 * g15 * (xx - yy)
        )  # fmt: skip
        rows[g_row + 1, i] += (
            3 * g9 * (xx - yy) + g10 * x * z + g11 * (4 * zz - xx - 3 * yy) - 6 * g12 * y * z
            - 2 * g13 * x * y - g14 * y * z - 6 * g15 * x * y
        )  # fmt: skip
        rows[g_row + 2, i] += (
            g10 * x * y + 8 * g11 * y * z + g12 * (6 * zz - 3 * xx - 3 * yy) + 8 * g13 * x * z
            + 0.5 * g14 * (xx - yy)
        )  # fmt: skip


@inline_kernel
def _add_quartic_slopes(rows, x_row, slopes, g_row):
    for i in range(slopes.shape[1]):
        x, y, z = rows[x_row, i], rows[x_row + 1, i], rows[x_row + 2, i]
        xx, yy, zz = x * x, y * y, z * z
        g16, g24 = _C4D * slopes[16, i], _C4D * slopes[24, i]
        g17, g23 = -_C4C * slopes[17, i], -_C4C * slopes[23, i]
        g18, g22 = _C4B * slopes[18, i], _C4B * slopes[22, i]
        g19, g21 = -_C4A * slopes[19, i], -_C4A * slopes[21, i]
        g20 = _C4_ZONAL * slopes[20, i]
        low, high = 7 * zz - 1, 7 * zz - 3
        rows[g_row, i] += (
            g16 * y * (3 * xx - yy) + 6 * g17 * x * y * z + g18 * y * low + g21 * z * high + g22 * x * low
            + 3 * g23 * z * (xx - yy) + g24 * x * (xx - 3 * yy)
        )  # fmt: skip
        rows[g_row + 1, i] += (
            g16 * x * (xx - 3 * yy) + 3 * g17 * z * (xx - yy) + g18 * x * low + g19 * z * high - g22 * y * low
            - 6 * g23 * x * y * z - g24 * y * (3 * xx - yy)
        )  # fmt: skip
        rows[g_row + 2, i] += (
            g17 * y * (3 * xx - yy) + 14 * g18 * x * y * z + g19 * y * (21 * zz - 3) + g20 * z * (140 * zz - 60)
            + g21 * x * (21 * zz - 3) + 7 * g22 * z * (xx - yy) + g23 * x * (xx - 3 * yy)
        )  # fmt: skip


@inline_kernel
def colours(harmonics, start, count, basis, bends, rows, radius_row, values):
    """Write max(0, 0.5 + sum_k Y_k c_k) of `count` Gaussians from `start` on into values, and after it the radius.

    Args:
        bends: None if there is one harmonic.
        rows, radius_row: the radii are a row of float64.
    """
    num, channels, done = harmonics.shape[1], harmonics.shape[2], 0
    if bends is None:
        done = _three_constants(harmonics, start, count, rows, radius_row, values)
    if bends is not None:
        done = _three_colours(harmonics, start, count, basis, rows, radius_row, values)
    for i in range(done, count):
        g = start + i
        for c in range(channels):
            values[g, c] = 0.5
        for k in range(num):
            weight = basis[k, i]
            for c in range(channels):
                values[g, c] += weight * harmonics[g, k, c]
        for c in range(channels):
            values[g, c] = max(values[g, c], np.float32(0))
        values[g, channels] = rows[radius_row, i]


@inline_kernel
def _three_constants(harmonics, start, count, rows, radius_row, values):
    """If there are three channels: those Gaussians that make up whole vectors. Return how many are done."""
    if harmonics.shape[2] != 3:
        return 0
    weight, half, zero = fill(np.float32(_C0)), fill(np.float32(0.5)), fill(np.float32(0))
    flat, written, whole = harmonics.reshape(-1), values.reshape(-1), count // LANES * LANES
    for i in range(0, whole, LANES):
        first, place = 3 * (start + i), 4 * (start + i)
        red, green, blue = apart((load(flat, first), load(flat, first + LANES), load(flat, first + 2 * LANES)))
        red = maximum(multiply_add(weight, red, half), zero)
        green = maximum(multiply_add(weight, green, half), zero)
        blue = maximum(multiply_add(weight, blue, half), zero)
        v0, v1, v2, v3 = together((red, green, blue, rounded(get(rows, radius_row, i))))
        store(written, place, v0)
        store(written, place + LANES, v1)
        store(written, place + 2 * LANES, v2)
        store(written, place + 3 * LANES, v3)
    return whole


@inline_kernel
def _three_colours(harmonics, start, count, basis, rows, radius_row, values):
    """If there are three channels: all. Return how many are done."""
    if harmonics.shape[2] != 3:
        return 0
    for i in range(count):
        g = start + i
        red, green, blue = np.float32(0.5), np.float32(0.5), np.float32(0.5)
        for k in range(harmonics.shape[1]):
            weight = basis[k, i]
            red += weight * harmonics[g, k, 0]
            green += weight * harmonics[g, k, 1]
            blue += weight * harmonics[g, k, 2]
        zero = np.float32(0)
        values[g, 0], values[g, 1], values[g, 2] = max(red, zero), max(green, zero), max(blue, zero)
        values[g, 3] = rows[radius_row, i]
    return count


@inline_kernel
def colour_gradients(harmonics, start, drawn, basis, values, grads, grad_harmonics, slopes):
    """From gradients of colours, a row each, to those of coefficients (if asked for) and of each harmonic.

    Args:
        start: the block's first Gaussian.
        drawn: for each Gaussian of the block; the gradients of others are 0 whatever their coefficients hold.
        values: colours of the forward; where one is off, or exactly 0, it stays off.
        grads: gradients of the colours; overwritten.
        grad_harmonics: no rows if not asked for.
        slopes: gets the gradient of each harmonic, a row each.
    """
    num, channels, wanted = harmonics.shape[1], harmonics.shape[2], grad_harmonics.shape[0] > 0
    for i in range(len(drawn)):
        g = start + i
        if not drawn[i]:
            for k in range(num):
                slopes[k, i] = 0
                if wanted and g < harmonics.shape[0]:
                    for c in range(channels):
                        grad_harmonics[g, k, c] = 0
            continue
        for c in range(channels):
            grads[i, c] = grads[i, c] if values[g, c] > 0 else np.float32(0)
        for k in range(num):
            total, weight = np.float32(0), basis[k, i]
            for c in range(channels):
                total += harmonics[g, k, c] * grads[i, c]
                if wanted:
                    grad_harmonics[g, k, c] = weight * grads[i, c]
            slopes[k, i] = total


@inline_kernel
def constant_colour_gradients(harmonics, start, count, values, value_sums, colour_grads, grad_harmonics):
    """From gradients of colours to those of coefficients of the first harmonic alone, if asked for.

    Args:
        values: colours of the forward; where one is off, or exactly 0, it stays off.
        value_sums: gradients of three colours and a radius, flat; or
        colour_grads: gradients of the colours, a row each, if they are not three.
    """
    channels, whole, weight = harmonics.shape[2], 0, np.float32(_C0)
    if grad_harmonics.shape[0] == 0:
        return
    if channels == 3:
        whole, factor, none = count // LANES * LANES, fill(weight), fill(np.float32(0))
        flat, grads = values.reshape(-1), grad_harmonics.reshape(-1)
        for i in range(0, whole, LANES):
            red, green, blue, _ = quarters(value_sums, 4 * i)
            is_red, is_green, is_blue, _ = quarters(flat, 4 * (start + i))
            a, b, c = together(
                (
                    choose(is_red > none, factor * red, none),
                    choose(is_green > none, factor * green, none),
                    choose(is_blue > none, factor * blue, none),
                )
            )
            store(grads, 3 * (start + i), a)
            store(grads, 3 * (start + i) + LANES, b)
            store(grads, 3 * (start + i) + 2 * LANES, c)
        for i in range(whole, count):
            for c in range(3):
                colour_grads[i, c] = element(value_sums, 4 * i + c)
    for i in range(whole, count):
        for c in range(channels):
            grad = weight * colour_grads[i, c]
            grad_harmonics[start + i, 0, c] = grad if values[start + i, c] > 0 else np.float32(0)
