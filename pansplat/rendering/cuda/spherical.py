"""Real spherical harmonics as device code; `pansplat.gaussians.harmonics` has the order, signs and source."""
# ruff: noqa: RUF005  # Triton does not unpack into a tuple

import math
from typing import no_type_check

import triton
import triton.language as tl


def _norm(rational: float) -> tl.constexpr:
    return tl.constexpr(math.sqrt(rational / math.pi))


_FLAT: tl.constexpr = _norm(0.25)
_LINEAR: tl.constexpr = _norm(0.75)
_SQUARE: tl.constexpr = _norm(3.75)
_SQUARE_M0: tl.constexpr = _norm(0.3125)
_CUBE_M0: tl.constexpr = _norm(0.4375)
_CUBE_M1: tl.constexpr = _norm(0.65625)
_CUBE_M2: tl.constexpr = _norm(26.25)
_CUBE_M3: tl.constexpr = _norm(1.09375)
_FOURTH_M0: tl.constexpr = _norm(0.03515625)
_FOURTH_M1: tl.constexpr = _norm(1.40625)
_FOURTH_M2: tl.constexpr = _norm(2.8125)
_FOURTH_M3: tl.constexpr = _norm(9.84375)
_FOURTH_M4: tl.constexpr = _norm(19.6875)


@triton.jit
@no_type_check
def basis(x, y, z, DEGREE: tl.constexpr):
    """Harmonics of degree 0 to DEGREE at unit directions, (DEGREE + 1)^2 blocks in a tuple."""
    xx, yy, zz = x * x, y * y, z * z
    found = (x * 0 + _FLAT,)
    if DEGREE >= 1:
        found = found + (-y * _LINEAR, z * _LINEAR, -x * _LINEAR)
    if DEGREE >= 2:
        found = found + (
            x * y * _SQUARE,
            -y * z * _SQUARE,
            (2 * zz - xx - yy) * _SQUARE_M0,
            -x * z * _SQUARE,
            (xx - yy) * (0.5 * _SQUARE),
        )
    if DEGREE >= 3:
        found = found + (
            -y * (3 * xx - yy) * _CUBE_M3,
            x * y * z * _CUBE_M2,
            -y * (4 * zz - xx - yy) * _CUBE_M1,
            z * (2 * zz - 3 * xx - 3 * yy) * _CUBE_M0,
            -x * (4 * zz - xx - yy) * _CUBE_M1,
            z * (xx - yy) * (0.5 * _CUBE_M2),
            -x * (xx - 3 * yy) * _CUBE_M3,
        )
    if DEGREE >= 4:
        found = found + (
            x * y * (xx - yy) * _FOURTH_M4,
            -y * z * (3 * xx - yy) * _FOURTH_M3,
            x * y * (7 * zz - 1) * _FOURTH_M2,
            -y * z * (7 * zz - 3) * _FOURTH_M1,
            (zz * (35 * zz - 30) + 3) * _FOURTH_M0,
            -x * z * (7 * zz - 3) * _FOURTH_M1,
            (xx - yy) * (7 * zz - 1) * (0.5 * _FOURTH_M2),
            -x * z * (xx - 3 * yy) * _FOURTH_M3,
            (xx * (xx - 3 * yy) - yy * (3 * xx - yy)) * (0.25 * _FOURTH_M4),
        )
    return found
