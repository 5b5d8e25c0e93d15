"""Compositing of tiles on the CPU, forward."""

import numpy as np
import numpy.typing as npt

from pansplat.render.cpu.tables import Plane

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]


def raster_forward(
    records: Floats,
    values: Floats,
    entries: Integers,
    starts: Longs,
    plane: Plane,
    sums: Floats,
    *,
    first_row: int = 0,
    threads: int = 1,
) -> None:
    """Write the sums of weight x (values, 1) of a band of tile rows.

    Args:
        records, values, entries, starts: see `records`; `starts` covers whole rows of tiles.
        plane: the picture's pixels.
        sums: (channel + 2, height, width), written where the band lies.
        first_row: of tiles, the band's first.
        threads: to work on; the result does not depend on it.
    """
    raise NotImplementedError
