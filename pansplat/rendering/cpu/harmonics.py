"""Real spherical harmonics of a block of directions, colours, and their gradients.

Convention: order and signs of pansplat.gaussians.harmonics, which has the same polynomials. `view_dependent` is None if
there is one harmonic; numba does not compile the code for several ones then.
"""

import math

import numpy as np

from pansplat.rendering.cpu.simd import load_scalar
from pansplat.system.kernels import inline_kernel

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
def evaluate_basis(rows, direction_row, num, view_dependent, basis):
    """Write the first `num` harmonics, a row each, of the directions in three of `rows`."""
    num_directions = basis.shape[1]
    for i in range(num_directions):
        basis[0, i] = _C0
    if view_dependent is None:
        return
    if num >= 4:
        for i in range(num_directions):
            x, y, z = rows[direction_row, i], rows[direction_row + 1, i], rows[direction_row + 2, i]
            basis[1, i], basis[2, i], basis[3, i] = -_C1 * y, _C1 * z, -_C1 * x
    if num >= 9:
        for i in range(num_directions):
            x, y, z = rows[direction_row, i], rows[direction_row + 1, i], rows[direction_row + 2, i]
            basis[4, i], basis[5, i], basis[7, i] = _C2 * x * y, -_C2 * y * z, -_C2 * x * z
            basis[6, i] = _C2_ZONAL * (2 * z * z - x * x - y * y)
            basis[8, i] = 0.5 * _C2 * (x * x - y * y)
    if num >= 16:
        for i in range(num_directions):
            x, y, z = rows[direction_row, i], rows[direction_row + 1, i], rows[direction_row + 2, i]
            xx, yy, zz = x * x, y * y, z * z
            basis[9, i], basis[15, i] = -_C3C * y * (3 * xx - yy), -_C3C * x * (xx - 3 * yy)
            basis[10, i], basis[14, i] = _C3B * x * y * z, 0.5 * _C3B * z * (xx - yy)
            basis[11, i], basis[13, i] = -_C3A * y * (4 * zz - xx - yy), -_C3A * x * (4 * zz - xx - yy)
            basis[12, i] = _C3_ZONAL * z * (2 * zz - 3 * xx - 3 * yy)
    if num >= 25:
        for i in range(num_directions):
            x, y, z = rows[direction_row, i], rows[direction_row + 1, i], rows[direction_row + 2, i]
            xx, yy, zz = x * x, y * y, z * z
            basis[16, i] = _C4D * x * y * (xx - yy)
            basis[24, i] = 0.25 * _C4D * (xx * (xx - 3 * yy) - yy * (3 * xx - yy))
            basis[17, i], basis[23, i] = -_C4C * y * z * (3 * xx - yy), -_C4C * x * z * (xx - 3 * yy)
            basis[18, i], basis[22, i] = _C4B * x * y * (7 * zz - 1), 0.5 * _C4B * (xx - yy) * (7 * zz - 1)
            basis[19, i], basis[21, i] = -_C4A * y * z * (7 * zz - 3), -_C4A * x * z * (7 * zz - 3)
            basis[20, i] = _C4_ZONAL * (zz * (35 * zz - 30) + 3)


@inline_kernel
def accumulate_direction_gradients(rows, direction_row, num, view_dependent, grad_basis, grad_row):
    """Add the gradients of the directions to three of `rows`, given those of the harmonics.

    Only their tangential components have a meaning, as in the torch reference.
    """
    if view_dependent is None:
        return
    num_directions = grad_basis.shape[1]
    if num >= 4:
        for i in range(num_directions):
            rows[grad_row, i] -= _C1 * grad_basis[3, i]
            rows[grad_row + 1, i] -= _C1 * grad_basis[1, i]
            rows[grad_row + 2, i] += _C1 * grad_basis[2, i]
    if num >= 9:
        for i in range(num_directions):
            x, y, z = rows[direction_row, i], rows[direction_row + 1, i], rows[direction_row + 2, i]
            g4, g5, g6 = grad_basis[4, i], grad_basis[5, i], grad_basis[6, i]
            g7, g8 = grad_basis[7, i], grad_basis[8, i]
            rows[grad_row, i] += _C2 * (g4 * y - g7 * z + g8 * x) - 2 * _C2_ZONAL * g6 * x
            rows[grad_row + 1, i] += _C2 * (g4 * x - g5 * z - g8 * y) - 2 * _C2_ZONAL * g6 * y
            rows[grad_row + 2, i] += -_C2 * (g5 * y + g7 * x) + 4 * _C2_ZONAL * g6 * z
    if num >= 16:
        for i in range(num_directions):
            x, y, z = rows[direction_row, i], rows[direction_row + 1, i], rows[direction_row + 2, i]
            xx, yy, zz = x * x, y * y, z * z
            g9, g15 = -_C3C * grad_basis[9, i], -_C3C * grad_basis[15, i]
            g10, g14 = _C3B * grad_basis[10, i], _C3B * grad_basis[14, i]
            g11, g13 = -_C3A * grad_basis[11, i], -_C3A * grad_basis[13, i]
            g12 = _C3_ZONAL * grad_basis[12, i]
            rows[grad_row, i] += (
                6 * g9 * x * y + g10 * y * z - 2 * g11 * x * y - 6 * g12 * x * z
                + g13 * (4 * zz - 3 * xx - yy) + g14 * x * z + 3 * g15 * (xx - yy)
            )  # fmt: skip
            rows[grad_row + 1, i] += (
                3 * g9 * (xx - yy) + g10 * x * z + g11 * (4 * zz - xx - 3 * yy) - 6 * g12 * y * z
                - 2 * g13 * x * y - g14 * y * z - 6 * g15 * x * y
            )  # fmt: skip
            rows[grad_row + 2, i] += (
                g10 * x * y + 8 * g11 * y * z + g12 * (6 * zz - 3 * xx - 3 * yy) + 8 * g13 * x * z
                + 0.5 * g14 * (xx - yy)
            )  # fmt: skip
    if num >= 25:
        for i in range(num_directions):
            x, y, z = rows[direction_row, i], rows[direction_row + 1, i], rows[direction_row + 2, i]
            xx, yy, zz = x * x, y * y, z * z
            g16, g24 = _C4D * grad_basis[16, i], _C4D * grad_basis[24, i]
            g17, g23 = -_C4C * grad_basis[17, i], -_C4C * grad_basis[23, i]
            g18, g22 = _C4B * grad_basis[18, i], _C4B * grad_basis[22, i]
            g19, g21 = -_C4A * grad_basis[19, i], -_C4A * grad_basis[21, i]
            g20 = _C4_ZONAL * grad_basis[20, i]
            low, high = 7 * zz - 1, 7 * zz - 3
            rows[grad_row, i] += (
                g16 * y * (3 * xx - yy) + 6 * g17 * x * y * z + g18 * y * low + g21 * z * high + g22 * x * low
                + 3 * g23 * z * (xx - yy) + g24 * x * (xx - 3 * yy)
            )  # fmt: skip
            rows[grad_row + 1, i] += (
                g16 * x * (xx - 3 * yy) + 3 * g17 * z * (xx - yy) + g18 * x * low + g19 * z * high - g22 * y * low
                - 6 * g23 * x * y * z - g24 * y * (3 * xx - yy)
            )  # fmt: skip
            rows[grad_row + 2, i] += (
                g17 * y * (3 * xx - yy) + 14 * g18 * x * y * z + g19 * y * (21 * zz - 3) + g20 * z * (140 * zz - 60)
                + g21 * x * (21 * zz - 3) + 7 * g22 * z * (xx - yy) + g23 * x * (xx - 3 * yy)
            )  # fmt: skip


@inline_kernel
def evaluate_colors(harmonics, start, count, basis, rows, radius_row, values):
    """Write the colour max(0, 0.5 + sum_k Y_k c_k) and the radius of `count` Gaussians from `start` on into values."""
    zero = np.float32(0)
    for i in range(count):
        g = start + i
        red, green, blue = np.float32(0.5), np.float32(0.5), np.float32(0.5)
        for k in range(harmonics.shape[1]):
            weight = basis[k, i]
            red += weight * harmonics[g, k, 0]
            green += weight * harmonics[g, k, 1]
            blue += weight * harmonics[g, k, 2]
        values[g, 0], values[g, 1], values[g, 2] = max(red, zero), max(green, zero), max(blue, zero)
        values[g, 3] = rows[radius_row, i]


@inline_kernel
def backpropagate_colors(harmonics, start, kept, basis, values, grad_values, grad_harmonics, grad_basis):
    """Write the gradients of coefficients and harmonics, given those of a block's colours.

    Args:
        start: the block's first Gaussian.
        kept: false for culled Gaussians, whose gradients are 0, whether or not their coefficients are finite.
        values: colours of the forward; a channel at 0 has no gradient.
        grad_values: gradients of colours and radius, flat.
        grad_harmonics: no rows if not needed.
        grad_basis: written, a row per harmonic.
    """
    num, needed, grad_color = harmonics.shape[1], grad_harmonics.shape[0] > 0, np.empty(3, np.float32)
    for i in range(len(kept)):
        g = start + i
        if not kept[i]:
            for k in range(num):
                grad_basis[k, i] = 0
                if needed and g < harmonics.shape[0]:
                    for c in range(3):
                        grad_harmonics[g, k, c] = 0
            continue
        for c in range(3):
            grad_color[c] = load_scalar(grad_values, 4 * i + c) if values[g, c] > 0 else np.float32(0)
        for k in range(num):
            total, weight = np.float32(0), basis[k, i]
            for c in range(3):
                total += harmonics[g, k, c] * grad_color[c]
                if needed:
                    grad_harmonics[g, k, c] = weight * grad_color[c]
            grad_basis[k, i] = total
