"""The floor plan of a tour: rooms with straight walls, doors, where all are drawn, and how sure their lengths are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from pansplat.tours.doors import Door, find_doors
from pansplat.tours.floor import FloorOutline, choose_camera_height
from pansplat.tours.graph import TourGraph
from pansplat.tours.linked_rooms import DrawnPlace, place_rooms
from pansplat.tours.rooms import Room, find_rooms
from pansplat.tours.surfaces import Surfaces
from pansplat.tours.walls import LEAST_WALL, Sight, find_sight

_SHAPE_ERROR = 0.2  # error of an area by its shape, as a fraction; 13 of 19 generated rooms of two panoramas have less
# Largest distance of places from their wall, in heights of the cameras over the floor; least number of them by one
# panorama.
_NEAR_WALL, _LEAST_SEEN = 0.2, 8


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

    def draw(self, node: int, places: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where the plan shows places around a panorama, to the right and forward of the level axes."""
        return self.drawn[node].move(places) if node in self.drawn else places

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
    doors = find_doors(rooms, sights, unit)
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
