"""The rings of a panorama: which are offered, and where those of links are in space; and links through walls."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Container, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pansplat.inputs.panorama_sets import Link
from pansplat.tours.graph import TourGraph
from pansplat.tours.outlook import find_bins

RING_RADIUS = 0.22  # radius of a ring on the floor, metres
RING_DISTANCE = 0.66  # distance of a panorama, metres, within which it has no ring
_NEAREST_METRES = 1.0  # least distance of a link's ring
_WALL_METRES = 3.0  # usual distance of a wall
_MIN_LEVEL = 0.1  # level part of the unit direction of a link, below which it is vertical


class Ring(NamedTuple):
    """A ring: a mark on the floor, which leads to a panorama.

    Attributes:
        node: the panorama.
        offset: from the camera at which it is offered to it, in world axes, where a link leads (`find_link_ring`); None
            below the camera of `node`.
    """

    node: int
    offset: Float[np.ndarray, "3"] | None = None


def choose_rings(
    tour: TourGraph,
    here: int,
    height: float,
    hidden: Container[int] = (),
    outlook: Float[np.ndarray, "bin"] | None = None,
    rooms: Sequence[Container[int]] = (),
) -> list[Ring]:
    """The rings that are offered at a panorama; its own is the last.

    They are those of its links, and those where its edges lead, the nearest first, unless surfaces hide them. Where all
    are hidden and there is no link, the nearest one stays. Without any ring: the panoramas whose links lead here;
    without these, the nearest panorama. Of another room only the first one.

    Args:
        tour: the graph.
        here: the panorama.
        height: of its camera over the floor, metres.
        hidden: the panoramas whose places on the floor surfaces hide from it.
        outlook: see `find_link_ring`.
        rooms: panoramas of each room.
    """
    order = np.argsort(np.linalg.norm(tour.positions - tour.positions[here], axis=1), kind="stable").tolist()
    others, near = [node for node in order if node != here], tour.neighbours(here)
    linked = [end for start, end in tour.links if start == here]
    flown = [node for node in others if node in near and node not in linked]
    seen = [node for node in flown if node not in hidden]
    rings = []
    for node in linked:
        is_apart = tour.parts[node] != tour.parts[here]
        offset = find_link_ring(tour, here, node, height, outlook) if is_apart or node in hidden else None
        if offset is not None or not is_apart:
            rings.append(Ring(node, offset))
    rings += [Ring(node) for node in (seen if seen or linked else flown[:1])]
    rings = rings or [Ring(start) for start, end in tour.links if end == here]
    rings = rings or [Ring(node) for node in others[:1]]

    def find_room(node: int) -> int:
        return next((number for number, nodes in enumerate(rooms) if node in nodes), -1 - node)

    found = {find_room(ring.node): ring for ring in reversed(rings)}
    return [
        ring for ring in rings if find_room(ring.node) == find_room(here) or found[find_room(ring.node)] is ring
    ] + [Ring(here)]


def link_parts(tour: TourGraph) -> TourGraph:
    """The tour with links through walls, where these are nearest, between parts that no link joins."""
    joined = {frozenset((tour.parts[a], tour.parts[b])) for a, b in tour.links}
    panoramas = list(tour.panoramas)
    for a, b in sorted(tour.walls, key=tour.length):
        parts = frozenset((tour.parts[a], tour.parts[b]))
        for start, end in ((a, b), (b, a)) if len(parts) > 1 and parts not in joined else ():
            x, y, z = tour.cam2world[start, :3, :3].numpy().T @ (tour.positions[end] - tour.positions[start])
            link = Link(panoramas[end].name, math.atan2(x, z), math.atan2(y, math.hypot(x, z)))
            panoramas[start] = dataclasses.replace(panoramas[start], links=(*panoramas[start].links, link))
        joined.add(parts)
    return dataclasses.replace(tour, panoramas=tuple(panoramas)) if tour.walls else tour


def find_link_ring(
    tour: TourGraph, start: int, end: int, height: float, outlook: Float[np.ndarray, "bin"] | None = None
) -> Float[np.ndarray, "3"] | None:
    """From a camera to the ring of a link, in world axes; None without a link, or if it is vertical.

    It is where the link meets the floor, 1 m away at the least, or the wall before that.

    Args:
        tour: the graph.
        start, end: nodes.
        height: of the camera over the floor, metres.
        outlook: of `measure_outlook` at the first node, in the level axes of the tour; zeros and None are unknown.
    """
    direction = tour.find_direction(start, end)
    if direction is None or (length := math.hypot(*direction[[0, 2]])) < _MIN_LEVEL:
        return None
    right, slope, forward = direction / length
    wall = _WALL_METRES if outlook is None else float(outlook[find_bins(np.arctan2(right, forward))]) or _WALL_METRES
    if slope * wall < height:
        return tour.level_axes @ (wall * right, wall * slope, wall * forward)
    distance = max(height / slope, _NEAREST_METRES)
    return tour.level_axes @ (distance * right, height, distance * forward)
