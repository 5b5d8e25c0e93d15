"""Where the links of a tour are in space: the way along a link, and its ring on the floor."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pansplat.tours.graph import TourGraph

_WAY_METRES = 0.7  # that the camera goes along a link, before the fade
_RING_METRES = (1.0, 3.0)  # distance of a link's ring
_MIN_LEVEL = 0.1  # level length of the direction of a link that is not vertical


def find_way_along_link(tour: TourGraph, start: int, end: int) -> Float[np.ndarray, "3"] | None:
    """The level way of 0.7 m, in world axes, along the link between nodes; None without one, or if it is vertical."""
    direction = _find_level_direction(tour, start, end)
    return None if direction is None else _WAY_METRES * direction


def find_link_ring(tour: TourGraph, start: int, end: int, height: float) -> Float[np.ndarray, "3"] | None:
    """From a camera to the ring of a link, in world axes; None without a link, or if it is vertical.

    It is where the link meets the floor, 1 to 3 m away.

    Args:
        tour: the graph.
        start, end: nodes.
        height: of the camera over the floor, metres.
    """
    along, direction = _find_level_direction(tour, start, end), tour.find_direction(start, end)
    if along is None or direction is None:
        return None
    down = tour.level_axes[:, 1]
    fall = float(direction @ down)
    distance = height * float(direction @ along) / fall if fall > 0 else _RING_METRES[1]
    return min(max(distance, _RING_METRES[0]), _RING_METRES[1]) * along + height * down


def _find_level_direction(tour: TourGraph, start: int, end: int) -> Float[np.ndarray, "3"] | None:
    """The level unit direction of a link; None without one, or if it is vertical."""
    direction = tour.find_direction(start, end)
    if direction is None:
        return None
    flat = direction - (direction @ tour.level_axes[:, 1]) * tour.level_axes[:, 1]
    length = float(np.linalg.norm(flat))
    return None if length < _MIN_LEVEL else flat / length
