"""Floor plans: a rectangle split into rooms, doors between them, windows to the outside."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

Rectangle = tuple[float, float, float, float]
"""x0, z0, x1, z1, metres."""

INNER, OUTER = 0.12, 0.25  # metres; thickness of walls
_SMALLEST = 2.2  # metres; side of a room


@dataclass(frozen=True)
class Hole:
    """A door or window: from `start` to `end` along its wall, from `low` to `top` above the floor, metres."""

    start: float
    end: float
    low: float
    top: float


@dataclass
class Wall:
    """An upright wall: on the plane x = at (axis 0) or z = at (axis 2), from `start` to `end` along it."""

    axis: int
    at: float
    start: float
    end: float
    outer: bool
    holes: list[Hole] = field(default_factory=list)


@dataclass(frozen=True)
class Plan:
    """Rooms that fill a rectangle, and the walls between and round them."""

    whole: Rectangle
    rooms: tuple[Rectangle, ...]
    walls: tuple[Wall, ...]


def draw_plan(rng: np.random.Generator) -> Plan:
    """A plan of one to four rooms with a door in each inner wall and windows in the outer ones."""
    wide, deep = rng.uniform(3.2, 9.0), rng.uniform(3.0, 8.0)
    whole = (-wide / 2, -deep / 2, wide / 2, deep / 2)
    rooms, walls = [whole], []
    for _ in range(rng.integers(0, 4)):
        rooms.sort(key=_longest)
        x0, z0, x1, z1 = room = rooms[-1]
        if _longest(room) < 2 * _SMALLEST + 0.2:
            break
        rooms.pop()
        if x1 - x0 > z1 - z0:
            at = rng.uniform(x0 + _SMALLEST, x1 - _SMALLEST)
            rooms += [(x0, z0, at, z1), (at, z0, x1, z1)]
            walls.append(Wall(0, at, z0, z1, False))
        else:
            at = rng.uniform(z0 + _SMALLEST, z1 - _SMALLEST)
            rooms += [(x0, z0, x1, at), (x0, at, x1, z1)]
            walls.append(Wall(2, at, x0, x1, False))
    x0, z0, x1, z1 = whole
    walls += [Wall(0, x0, z0, z1, True), Wall(0, x1, z0, z1, True)]
    walls += [Wall(2, z0, x0, x1, True), Wall(2, z1, x0, x1, True)]
    for wall in walls:
        _open(wall, walls, rng)
    return Plan(whole, tuple(rooms), tuple(walls))


def sides(room: Rectangle) -> list[tuple[int, float, float, float, int]]:
    """The four sides of a room: axis, place, start, end, and +1 where the wall is in the axis' direction."""
    x0, z0, x1, z1 = room
    return [(0, x0, z0, z1, -1), (0, x1, z0, z1, 1), (2, z0, x0, x1, -1), (2, z1, x0, x1, 1)]


def holes_of_side(plan: Plan, side: tuple[int, float, float, float, int]) -> list[Hole]:
    """Doors and windows in one side of a room."""
    axis, at, start, end, _ = side
    return [
        hole
        for wall in plan.walls
        if wall.axis == axis and abs(wall.at - at) < 1e-9
        for hole in wall.holes
        if hole.end > start and hole.start < end
    ]


def _longest(room: Rectangle) -> float:
    return max(room[2] - room[0], room[3] - room[1])


def _open(wall: Wall, walls: list[Wall], rng: np.random.Generator) -> None:
    """Holes between the places where other walls meet this one."""
    meets = [
        other.at
        for other in walls
        if other.axis != wall.axis
        and wall.start < other.at < wall.end
        and min(abs(other.start - wall.at), abs(other.end - wall.at)) < 1e-9
    ]
    stops = [wall.start, *sorted(meets), wall.end]
    for start, end in itertools.pairwise(stops):
        free = end - start - 0.4
        if wall.outer:
            if free > 0.7 and rng.random() < 0.55:
                width = rng.uniform(0.6, min(2.4, free))
                low = 0.0 if rng.random() < 0.2 else rng.uniform(0.7, 1.1)
                left = start + 0.2 + rng.uniform(0, free - width)
                wall.holes.append(Hole(left, left + width, low, rng.uniform(1.9, 2.2)))
        elif free > 0.8 and (not wall.holes or rng.random() < 0.6):
            width = rng.uniform(0.8, min(2.6 if rng.random() < 0.4 else 1.1, free))
            left = start + 0.2 + rng.uniform(0, free - width)
            wall.holes.append(Hole(left, left + width, 0.0, rng.uniform(2.0, 2.2)))
