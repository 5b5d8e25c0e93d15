"""Colour maps of matplotlib as tables of 256 colours, for images of one number a pixel."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float, UInt8

SIZE = 256


@functools.cache
def get_table(name: str) -> UInt8[np.ndarray, "256 3"]:
    """The colours of one of matplotlib's maps, from low to high."""
    from matplotlib import colormaps

    return (colormaps[name]((np.arange(SIZE) + 0.5) / SIZE)[:, :3] * 255 + 0.5).astype(np.uint8)


def map_values(values: Float[np.ndarray, "*shape"], largest: float, name: str) -> UInt8[np.ndarray, "*shape 3"]:
    """The colours of numbers from 0 to `largest`; others have the colour of the nearest end."""
    index = np.clip(values * (SIZE / largest), 0, SIZE - 1).astype(np.int64)
    return get_table(name)[index]
