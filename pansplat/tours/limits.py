"""How far a camera moves near a graph: the edge that it is at, and where surfaces and poor edges stop it."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from pansplat.tours.graph import Edge, TourGraph
from pansplat.tours.layout import REACH
from pansplat.tours.outlook import find_clearance

EDGE_HYSTERESIS = 0.25  # metres that another edge must be nearer than the current one
POOR_REACH = 0.5  # metres that a camera may walk from a panorama along a poor edge, at most a quarter of it
CLEARANCE = 0.25  # metres before a surface, at which a walk ends


def follow_edge(tour: TourGraph, position: Float[np.ndarray, "3"], current: Edge) -> Edge:
    """The edge of a camera that moves: `current`, unless another edge is nearer by `EDGE_HYSTERESIS`.

    It is an edge of the part of `current`, unless the camera is within reach of another part after a jump.
    """
    nearest, distance = tour.find_nearest_edge(position)
    part = tour.parts[current[0]]
    if tour.parts[nearest[0]] != part and distance > REACH:
        nearest, distance = tour.find_nearest_edge(position, part)
    return current if tour.measure_distances([current], position)[0] <= distance + EDGE_HYSTERESIS else nearest


def limit_step(tour: TourGraph, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Where the step of a walk ends: it stops before surfaces, and along a poor edge near either panorama."""
    edge, _ = tour.find_nearest_edge(end)
    if edge in tour.poor:
        end = _limit_along(tour, edge, start, end)
    most = min(_measure_free(tour, edge, start)[0], 0.0)
    free, away = _measure_free(tour, edge, end)
    slid = end - max(most - free, 0.0) * away
    is_step = np.linalg.norm(slid - start) <= np.linalg.norm(end - start) + 1e-9
    return slid if is_step and _measure_free(tour, edge, slid)[0] >= most - 1e-9 else start


def _measure_free(tour: TourGraph, edge: Edge, place: Float[np.ndarray, "3"]) -> tuple[float, Float[np.ndarray, "3"]]:
    """How far a camera near an edge may go on, metres, negative too near a surface; and the direction from the
    panorama that sees it free.

    Within `CLEARANCE` of a panorama or of a flown edge surfaces are ignored.
    """
    found = []
    for node in [node for node in edge if node in tour.clearances]:
        offset = place - tour.positions[node]
        distance = float(np.linalg.norm(offset))
        free = find_clearance(tour.clearances[node], tour.level_axes.T @ offset) - distance - CLEARANCE
        found.append((max(free, CLEARANCE - distance), offset / max(distance, 1e-9)))
    free, away = max(found, key=lambda item: item[0], default=(math.inf, np.zeros(3)))
    beside = -math.inf if edge in tour.poor else CLEARANCE - float(tour.measure_distances([edge], place)[0])
    return max(free, beside), away


def _limit_along(
    tour: TourGraph, edge: Edge, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Where a step near a poor edge ends."""
    first, last = tour.positions[list(edge)]
    length = max(float(np.linalg.norm(last - first)), 1e-9)
    along, reach = (last - first) / length, min(POOR_REACH, length / 4)

    def measure_depth(place: Float[np.ndarray, "3"]) -> float:
        walked = float((place - first) @ along)
        return min(walked, length - walked)

    if tour.find_nearest_edge(start)[0] != edge:
        return end if measure_depth(end) <= reach else start
    excess = max(measure_depth(end) - max(measure_depth(start), reach), 0.0)
    return end - math.copysign(excess, length / 2 - float((end - first) @ along)) * along
