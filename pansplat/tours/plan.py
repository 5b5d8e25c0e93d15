"""The floor plan of a tour: rooms with straight walls, doors, where all are drawn, and how sure their lengths are."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from pansplat.tours.floor import FloorOutline, choose_camera_height
from pansplat.tours.graph import TourGraph
from pansplat.tours.linked_rooms import DrawnPlace, place_rooms
from pansplat.tours.rooms import Room, find_rooms
from pansplat.tours.surfaces import RAY_ANGLES, RAYS, Outline, Surfaces, meet_outline
from pansplat.tours.walls import LEAST_WALL, Sight, find_sight, measure_reach

_SHAPE_ERROR = 0.2  # error of an area by its shape, as a fraction; 13 of 19 generated rooms of two panoramas have less
# Doors, and the accuracy of walls. Lengths are fractions of the height of the cameras over the floor, see `walls`.
_BEYOND = 0.25  # least length of the floor that is seen behind an opening
_DOOR_WIDTHS = 0.33, 1.7  # least and largest width of an opening
_SAME_DOOR = 0.4  # largest distance of the middles of an opening as seen from two sides
_NEAR_WALL, _LEAST_SEEN = 0.2, 8  # largest distance of places from their wall; least number of them by one panorama


@dataclass(frozen=True, eq=False)
class Door:
    """An opening of a room down to the floor: a door, or a window of a room's height.

    Attributes:
        ends: on the wall of the room, metres.
        rooms: the room, and the one on the other side if the opening is seen from there, too.
    """

    ends: Float[np.ndarray, "2 2"]
    rooms: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Plan:
    """The floor plan of a tour: rooms with straight walls, and doors.

    Attributes:
        tour: the panoramas, their edges and links.
        rooms: of all storeys.
        doors: of all rooms; one between two rooms once.
        camera_height: of the cameras over the floor, metres, the median.
        scale_error: standard deviation of these heights as a fraction; None if fewer than three are known.
        wall_error: standard deviation of a wall as one panorama shows it, metres; None if no wall is shown by two.
        num_heights, num_walls: that these figures are from.
    """

    tour: TourGraph
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    camera_height: float
    scale_error: float | None
    wall_error: float | None
    num_heights: int
    num_walls: int

    @cached_property
    def drawn(self) -> dict[int, DrawnPlace]:
        """Where panoramas are that links join with others (`place_rooms`)."""
        outlines = {node: room.outline for room in self.rooms for node in room.panoramas}
        return place_rooms(self.tour, outlines, self.camera_height) if outlines else {}

    @cached_property
    def turns(self) -> list[float]:
        """For each world the angle, anticlockwise, by which it is turned so that its longest wall is horizontal."""
        worlds, turns = self.tour.worlds, []
        for world in range(max(worlds) + 1):
            outlines = [room.outline for room in self.rooms if worlds[room.panoramas[0]] == world]
            sides = [np.roll(outline, -1, axis=0) - outline for outline in outlines]
            walls = np.concatenate([*sides, np.eye(2)[:1] * 1e-9])
            x, y = walls[np.linalg.norm(walls, axis=1).argmax()]
            turns.append(-math.remainder(math.atan2(y, x), math.pi))
        return turns

    def area_error(self, room: Room) -> float:
        """Standard deviation of a room's area, square metres, by those of the scale, of its walls and of its shape."""
        edges = np.linalg.norm(np.roll(room.outline, -1, axis=0) - room.outline, axis=1)
        walls = (self.wall_error or 0.0) * float(np.linalg.norm(edges))
        area = room.shape.area
        return math.hypot(walls, 2 * (self.scale_error or 0.0) * area, _SHAPE_ERROR * area)


def make_plan(
    surfaces: Sequence[Surfaces],
    tour: TourGraph,
    heights: Sequence[float | None],
    ceilings: Sequence[float | None],
    floors: Sequence[FloorOutline | None],
) -> Plan:
    """The floor plan of a tour.

    Args:
        surfaces: that each panorama shows.
        tour: the graph.
        heights, ceilings: distances of floors and ceilings below and above the cameras (`find_floor`, `find_ceiling`).
        floors: their outlines (`find_floor_outline`).
    """
    known = np.array([height for height in heights if height is not None])
    unit, seen = choose_camera_height(heights, tour.far), zip(surfaces, heights, ceilings, floors, strict=True)
    found = [find_sight(own, height or unit, ceiling, floor) for own, height, ceiling, floor in seen]
    sights = {node: sight for node, sight in enumerate(found) if sight is not None}
    rooms = find_rooms(tour, sights, surfaces, floors, unit)
    wall_error, num_walls = _measure_walls(rooms, sights, tour.worlds, unit)
    scale_error = float(1.4826 * np.median(np.abs(known - unit)) / unit) if len(known) > 2 else None
    doors = _find_doors(rooms, sights, unit)
    return Plan(tour, tuple(rooms), doors, unit, scale_error, wall_error, len(known), num_walls)


def _measure_walls(
    rooms: Sequence[Room], sights: Mapping[int, Sight], worlds: Sequence[int], unit: float
) -> tuple[float | None, int]:
    """Standard deviation of a wall by the panoramas that show it from inside a closed room, and the number of walls."""
    variances = []
    for room in [room for room in rooms if room.is_closed]:
        near_room = [sight for node, sight in sights.items() if worlds[node] == worlds[room.panoramas[0]]]
        for start, end in zip(room.outline, np.roll(room.outline, -1, axis=0), strict=True):
            length = float(np.linalg.norm(end - start))
            if length < 2 * LEAST_WALL * unit:
                continue
            along = (end - start) / length
            inward = np.array((-along[1], along[0]))  # corners are anticlockwise
            offsets = []
            for sight in near_room:
                if (sight.center - start) @ inward < _NEAR_WALL * unit:
                    continue
                places = sight.shown - start
                offset, position = places @ inward, places @ along / length
                near = (np.abs(offset) < _NEAR_WALL * unit) & (position > 0.1) & (position < 0.9)
                if near.sum() >= _LEAST_SEEN:
                    offsets.append(float(np.median(offset[near])))
            if len(offsets) > 1:
                variances.append(float(np.var(offsets, ddof=1)))
    return (math.sqrt(float(np.mean(variances))), len(variances)) if variances else (None, 0)


def _find_doors(rooms: Sequence[Room], sights: Mapping[int, Sight], unit: float) -> tuple[Door, ...]:
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
