"""Colour maps of matplotlib: for images of one number a pixel, and for the labels of Gaussians."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float, Int, UInt8

SIZE = 256  # number of colours of a map


@functools.cache
def get_table(name: str) -> UInt8[np.ndarray, "256 3"]:
    """The colours of one of matplotlib's maps, from low to high."""
    from matplotlib import colormaps

    return (colormaps[name]((np.arange(SIZE) + 0.5) / SIZE)[:, :3] * 255 + 0.5).astype(np.uint8)


def map_values(values: Float[np.ndarray, "*shape"], largest: float, name: str) -> UInt8[np.ndarray, "*shape 3"]:
    """The colours of numbers from 0 to `largest`; others have the colour of the nearest end."""
    index = np.clip(values * (SIZE / largest), 0, SIZE - 1).astype(np.int64)
    return get_table(name)[index]


def color_by_label(labels: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    """A colour for each level or view, RGB in [0, 1]; ten different ones."""
    return get_table("tab10")[(labels % 10 * SIZE + SIZE // 2) // 10].astype(np.float32) / 255
