"""The doors of rooms: openings through which panoramas show the floor beyond."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pansplat.tours.rooms import Room
from pansplat.tours.surfaces import RAY_ANGLES, RAYS, Outline, meet_outline
from pansplat.tours.walls import Sight, measure_reach

# Lengths are fractions of the height of the cameras over the floor, see `walls`.
_BEYOND = 0.25  # least length of the floor that is seen behind an opening
_DOOR_WIDTHS = 0.33, 1.7  # least and largest width of an opening
_SAME_DOOR = 0.4  # largest distance of the middles of an opening as seen from two sides


@dataclass(frozen=True, eq=False)
class Door:
    """An opening of a room down to the floor: a door, or a window of a room's height.

    Attributes:
        ends: on the wall of the room, metres.
        rooms: the room, and the one on the other side if the opening is seen from there, too.
    """

    ends: Float[np.ndarray, "2 2"]
    rooms: tuple[int, ...]


def find_doors(rooms: Sequence[Room], sights: Mapping[int, Sight], unit: float) -> tuple[Door, ...]:
    """The openings through which panoramas show what is beyond the walls of their rooms, down to the floor."""
    found: list[tuple[int, np.ndarray, int]] = []  # room, ends, rays
    for number, room in enumerate(rooms):
        for sight in [sights[node] for node in room.panoramas if room.is_closed and node in sights]:
            found += [(number, ends, rays) for ends, rays in _find_openings(sight, room.outline, unit)]
    found.sort(key=lambda opening: -opening[2])
    doors: list[Door] = []
    for number, ends, _ in found:
        middle = ends.mean(axis=0)
        near = [
            k
            for k, door in enumerate(doors)
            if np.linalg.norm(door.ends.mean(axis=0) - middle) < _SAME_DOOR * unit
            and rooms[door.rooms[0]].storey == rooms[number].storey
        ]
        if not near:
            doors.append(Door(ends, (number,)))
        elif number not in doors[near[0]].rooms:
            doors[near[0]] = Door(doors[near[0]].ends, (*doors[near[0]].rooms, number))
    return tuple(doors)


def _find_openings(sight: Sight, outline: Outline, unit: float) -> list[tuple[np.ndarray, int]]:
    """Ends on one wall of each opening that a panorama shows, and the number of its rays."""
    reach = measure_reach(sight.low)
    distance, wall = meet_outline(sight.center, outline)
    with np.errstate(invalid="ignore"):
        is_open: Bool[np.ndarray, "ray"] = (reach > distance + _BEYOND * unit) & (wall >= 0)
    labels = np.where(is_open, wall, -1)
    start = int(np.argmin(is_open)) if not is_open.all() else 0  # a ray that is not open, so that no run is cut
    order = np.roll(np.arange(RAYS), -start)
    openings = []
    for label, run in itertools.groupby(order.tolist(), key=lambda ray: labels[ray]):
        rays = list(run)
        if label < 0 or len(rays) < 3:
            continue
        half = math.pi / RAYS
        corners = outline[label], outline[(label + 1) % len(outline)]
        angles = RAY_ANGLES[[rays[0], rays[-1]]] + (-half, half)
        ends = np.array([_meet_line(sight.center, angle, *corners) for angle in angles])
        width = float(np.linalg.norm(ends[1] - ends[0]))
        if _DOOR_WIDTHS[0] * unit < width < _DOOR_WIDTHS[1] * unit:
            openings.append((ends, len(rays)))
    return openings


def _meet_line(center: np.ndarray, angle: float, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Where a ray meets the line of a wall, within its ends."""
    direction = np.array((math.sin(angle), math.cos(angle)))
    system = np.stack((end - start, -direction), axis=1)
    if abs(np.linalg.det(system)) < 1e-12:
        return start
    return start + float(np.clip(np.linalg.solve(system, center - start)[0], 0, 1)) * (end - start)
