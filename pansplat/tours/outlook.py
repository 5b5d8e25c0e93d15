"""What there is to see at a panorama: how far, and which marks furniture hides."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from pansplat.tours.surfaces import Surfaces

BINS = 24  # number of parts of the horizon; the first one begins at the yaw -pi
_ROWS = 12  # number of rows of a clearance, from above to below
_NEAREST = 0.1  # quantile of the distances of surfaces in one direction
_ELEVATION = math.sin(math.radians(20))  # largest sine of the elevation of surfaces that an outlook shows
_WINDOW = 3  # number of bins of a view, 45 degrees
_CLOSE, _OPEN = 1.0, 1.5  # metres: mean distance of a view into a wall; of one with room in front
_CONE = math.cos(math.radians(2))  # least cosine of directions around that of a mark
_IN_FRONT, _HIDING = 0.8, 0.5  # surfaces within this fraction of its distance hide a mark; their least share


def measure_outlook(surfaces: Surfaces) -> Float[np.ndarray, "bin"]:
    """Median distances of what a camera sees around the horizon; 0 where it sees nothing."""
    offsets, distances = surfaces.opaque, surfaces.distances
    is_ahead = np.abs(offsets[:, 1]) < _ELEVATION * distances
    bins = find_bins(np.arctan2(offsets[:, 0], offsets[:, 2]))
    found = [distances[is_ahead & (bins == number)] for number in range(BINS)]
    return np.array([np.median(own) if len(own) else 0.0 for own in found])


def measure_clearance(surfaces: Surfaces) -> Float[np.ndarray, "row bin"]:
    """Distances of the nearest surfaces around a camera, from above to below; 0 where it sees nothing."""
    distances, cells = surfaces.distances, _find_cells(surfaces.opaque)
    order = np.lexsort((distances, cells))
    first, last = (np.searchsorted(cells[order], np.arange(_ROWS * BINS), side) for side in ("left", "right"))
    nearest = np.append(distances[order], 0.0)[first + (_NEAREST * (last - first)).astype(int)]
    return np.where(last > first, nearest, 0.0).reshape(_ROWS, BINS)


def find_clearance(clearance: Float[np.ndarray, "row bin"], offset: Float[np.ndarray, "3"]) -> float:
    """The distance of the nearest surface in the direction of a place, relative to the camera; infinite if unknown."""
    return float(clearance.ravel()[_find_cells(offset[None])[0]]) or math.inf


def _find_cells(offsets: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """The directions of places (right, down, forward), as numbers of clearances."""
    right, down, forward = offsets.T
    rows = (np.arctan2(np.hypot(right, forward), -down) / math.pi * _ROWS).astype(int).clip(0, _ROWS - 1)
    return rows * BINS + find_bins(np.arctan2(right, forward))


def find_bins(yaws: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """The bins of an outlook in some directions."""
    return ((yaws / (2 * math.pi) + 0.5) * BINS).astype(int) % BINS


def find_widest(outlook: Float[np.ndarray, "bin"]) -> float:
    """The yaw in which a camera sees furthest, over 45 degrees, radians."""
    return ((int(_average_views(outlook).argmax()) + 0.5) / BINS - 0.5) * 2 * math.pi


def find_turns(outlook: Float[np.ndarray, "bin"]) -> Float[np.ndarray, "bin"]:
    """What a camera that arrives in a direction turns by, radians to the right: from a close wall to the nearest
    open view, else 0."""
    views, turns = _average_views(outlook), np.zeros(BINS)
    is_open = views >= min(_OPEN, views.max())
    for number in np.flatnonzero((views > 0) & (views < _CLOSE) & ~is_open):
        steps = (np.flatnonzero(is_open) - number + BINS // 2) % BINS - BINS // 2
        turns[number] = steps[np.abs(steps).argmin()] / BINS * 2 * math.pi
    return turns


def _average_views(outlook: Float[np.ndarray, "bin"]) -> Float[np.ndarray, "bin"]:
    """The mean distance in the view around each direction; 0 where nothing is seen, as in the sky."""
    around = np.stack([np.roll(outlook, shift) for shift in range(-(_WINDOW // 2), _WINDOW // 2 + 1)])
    return around.sum(axis=0) / np.maximum((around > 0).sum(axis=0), 1)


def find_hidden(surfaces: Surfaces, marks: Float[np.ndarray, "mark 3"]) -> list[int]:
    """The marks that most surfaces in their directions are in front of.

    Args:
        surfaces: around a camera.
        marks: relative to the camera, in the same axes.
    """
    places, distances, found = surfaces.opaque, surfaces.distances, []
    for number, mark in enumerate(marks):
        length = float(np.linalg.norm(mark))
        ahead = distances[places @ mark > _CONE * distances * length]
        if len(ahead) > 0 and float(np.mean(ahead < _IN_FRONT * length)) > _HIDING:
            found.append(number)
    return found
