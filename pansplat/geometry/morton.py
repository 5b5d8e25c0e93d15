"""Z-order curves: neighbours along the curve are neighbours in space.

Source: Morton, "A computer oriented geodetic data base and a new technique in file sequencing", 1966.
"""

import numpy as np
from jaxtyping import Int64, Integer

_SPREAD = (  # shifts and masks that move bit n of 21 to bit 3 n
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_codes(cells: Integer[np.ndarray, "n 3"]) -> Int64[np.ndarray, "n"]:
    """Positions of cells along a Z-order curve; coordinates are from 0 to 2^21 - 1."""
    codes = np.zeros(len(cells), np.int64)
    for axis in range(3):
        bits = cells[:, axis].astype(np.int64)
        for shift, mask in _SPREAD:
            bits = (bits | (bits << shift)) & mask
        codes |= bits << axis
    return codes
