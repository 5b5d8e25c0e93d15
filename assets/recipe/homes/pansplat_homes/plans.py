"""Random floor plans: rooms of several kinds, the walls between them, and doors, openings and windows."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

Rectangle = tuple[float, float, float, float]
"""x0, z0, x1, z1, metres."""

INNER, OUTER = 0.12, 0.25  # thickness of walls, metres
OUTSIDE = -1  # in place of the index of a room


class RoomKind(IntEnum):
    """Kinds of rooms; an alcove is a part of another room."""

    LIVING = 0
    DINING = 1
    KITCHEN = 2
    BEDROOM = 3
    BATHROOM = 4
    HALL = 5
    CLOSET = 6
    UTILITY = 7
    ALCOVE = 8


class HoleKind(IntEnum):
    """Kinds of holes in walls."""

    DOOR = 0
    OPENING = 1
    WINDOW = 2
    PATIO_DOOR = 3
    ENTRANCE = 4


@dataclass(frozen=True)
class Hole:
    """A hole from `start` to `end` along its wall and from `low` to `top` above the floor, metres."""

    start: float
    end: float
    low: float
    top: float
    kind: HoleKind

    @property
    def width(self) -> float:
        """Metres."""
        return self.end - self.start

    @property
    def middle(self) -> float:
        """Coordinate along the wall."""
        return (self.start + self.end) / 2


@dataclass
class Wall:
    """A wall in the plane x = at (axis 0) or z = at (axis 2), from `start` to `end` along the other axis, metres.

    Attributes:
        rooms: the rooms at smaller and at larger coordinates, or `OUTSIDE`. Outer walls stand outside of their rooms'
            rectangles; inner walls are centred at the common side.
    """

    axis: int
    at: float
    start: float
    end: float
    rooms: tuple[int, int]
    holes: list[Hole] = field(default_factory=list)

    @property
    def is_outer(self) -> bool:
        """Whether one side is outdoors."""
        return OUTSIDE in self.rooms

    @property
    def length(self) -> float:
        """Metres."""
        return self.end - self.start

    def point(self, along: float, across: float = 0.0) -> tuple[float, float]:
        """World x and z at a coordinate along the wall and a signed distance from its plane."""
        return (self.at + across, along) if self.axis == 0 else (along, self.at + across)


@dataclass(frozen=True)
class Room:
    """A rectangular room; `parent` is the room that an alcove or closet belongs to, or -1."""

    corners: Rectangle
    kind: RoomKind
    parent: int = -1

    @property
    def width(self) -> float:
        """Extent along x, metres."""
        return self.corners[2] - self.corners[0]

    @property
    def depth(self) -> float:
        """Extent along z, metres."""
        return self.corners[3] - self.corners[1]

    @property
    def area(self) -> float:
        """Square metres."""
        return self.width * self.depth

    @property
    def middle(self) -> tuple[float, float]:
        """World x and z."""
        return (self.corners[0] + self.corners[2]) / 2, (self.corners[1] + self.corners[3]) / 2

    def contains(self, x: float, z: float, margin: float = 0.0) -> bool:
        """Whether a point is inside, at least `margin` metres from the sides."""
        x0, z0, x1, z1 = self.corners
        return x0 + margin < x < x1 - margin and z0 + margin < z < z1 - margin


@dataclass(frozen=True)
class Plan:
    """Rooms and walls of a home."""

    rooms: tuple[Room, ...]
    walls: tuple[Wall, ...]

    @property
    def bounds(self) -> Rectangle:
        """The rectangle around all rooms."""
        corners = np.array([room.corners for room in self.rooms])
        low, high = corners[:, :2].min(axis=0), corners[:, 2:].max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def room_at(self, x: float, z: float) -> int:
        """Index of the room at a point, or `OUTSIDE`."""
        for index, room in enumerate(self.rooms):
            if room.contains(x, z):
                return index
        return OUTSIDE

    def walls_of(self, room: int) -> list[Wall]:
        """Walls at the sides of a room."""
        return [wall for wall in self.walls if room in wall.rooms]

    def interior(self, room: int) -> Rectangle:
        """The rectangle between the visible walls of a room."""
        insets = [0.0, 0.0, 0.0, 0.0]
        for wall in self.walls_of(room):
            if not wall.is_outer and not (
                wall.holes and wall.holes[0].top == np.inf and wall.holes[0].width == wall.length
            ):
                insets[(0 if wall.axis == 0 else 1) + (2 if wall.rooms[0] == room else 0)] = INNER / 2
        x0, z0, x1, z1 = self.rooms[room].corners
        return x0 + insets[0], z0 + insets[1], x1 - insets[2], z1 - insets[3]

    def sides(self, room: int) -> list[Side]:
        """The four visible sides of a room."""
        inner, walls = self.interior(room), self.walls_of(room)
        found = []
        for side in range(4):
            axis, outward = (0 if side % 2 == 0 else 2), (-1 if side < 2 else 1)
            mine = [w for w in walls if w.axis == axis and w.rooms[0 if outward > 0 else 1] == room]
            holes = tuple(hole for wall in mine for hole in wall.holes)
            start, end = (inner[1], inner[3]) if axis == 0 else (inner[0], inner[2])
            found.append(Side(axis, inner[side], start, end, outward, holes, all(w.is_outer for w in mine)))
        return found

    def passages(self) -> list[tuple[Wall, Hole]]:
        """Doors and openings between rooms through which one can walk, with their walls."""
        return [(wall, hole) for wall in self.walls if not wall.is_outer for hole in wall.holes if hole.low == 0]

    def steps_from(self, room: int) -> list[int]:
        """Number of passages on the shortest way from one room to each room; -1 if there is no way."""
        steps = [-1] * len(self.rooms)
        steps[room], reached = 0, [room]
        links = [wall.rooms for wall, _ in self.passages()]
        for here in reached:
            for first, second in links:
                there = second if here == first else first if here == second else here
                if steps[there] < 0:
                    steps[there] = steps[here] + 1
                    reached.append(there)
        return steps


@dataclass(frozen=True)
class Side:
    """A visible side of a room: the plane x = face (axis 0) or z = face (axis 2).

    Attributes:
        start, end: its extent along the wall, metres.
        outward: sign of the direction out of the room.
        holes: all holes in it.
        is_outer: whether it is a side of an outer wall only.
    """

    axis: int
    face: float
    start: float
    end: float
    outward: int
    holes: tuple[Hole, ...]
    is_outer: bool

    @property
    def length(self) -> float:
        """Metres."""
        return self.end - self.start

    @property
    def yaw(self) -> float:
        """Yaw of a piece of furniture with its back to the wall."""
        return np.pi / 2 * self.outward if self.axis == 0 else (0.0 if self.outward > 0 else np.pi)

    def point(self, along: float, away: float) -> tuple[float, float]:
        """World x and z at a coordinate along the wall and a distance from it into the room."""
        across = self.face - self.outward * away
        return (across, along) if self.axis == 0 else (along, across)

    def area(self, start: float, end: float, depth: float) -> Rectangle:
        """The floor in front of a part of the wall."""
        (x0, z0), (x1, z1) = self.point(start, 0.0), self.point(end, depth)
        return min(x0, x1), min(z0, z1), max(x0, x1), max(z0, z1)

    def free_spans(self, height: float, depth: float, occupied: list[Rectangle]) -> list[tuple[float, float]]:
        """Parts of the wall where a body of that height and depth covers no hole and no occupied floor."""
        blocked = [(hole.start - 0.1, hole.end + 0.1) for hole in self.holes if hole.low < height]
        x0, z0, x1, z1 = self.area(self.start, self.end, depth)
        for a0, b0, a1, b1 in occupied:
            if a0 < x1 and a1 > x0 and b0 < z1 and b1 > z0:
                blocked.append((b0, b1) if self.axis == 0 else (a0, a1))
        spans, at = [], self.start
        for low, high in sorted(blocked):
            if low - at > 0.05:
                spans.append((at, low))
            at = max(at, high)
        if self.end - at > 0.05:
            spans.append((at, self.end))
        return spans


def overlaps(area: Rectangle, others: list[Rectangle]) -> bool:
    """Whether a rectangle has area in common with one of the others."""
    x0, z0, x1, z1 = area
    return any(x1 > a and x0 < c and z1 > b and z0 < d for a, b, c, d in others)


_SOCIAL = (RoomKind.LIVING, RoomKind.DINING, RoomKind.KITCHEN)


def sample_plan(rng: np.random.Generator) -> Plan:
    """A random plan of 1 to about 14 rooms around the origin, 3 x 3 to 14 x 12 metres."""
    while True:
        rooms = _transform(_sample_rooms(rng), rng)
        plan = Plan(tuple(rooms), tuple(_find_walls(rooms)))
        _connect(plan, rng)
        if all(step >= 0 for step in plan.steps_from(0)):
            _add_outer_holes(plan, rng)
            return plan


def _sample_rooms(rng: np.random.Generator) -> list[Room]:
    """Rooms of a home whose longer side is along x."""
    size = rng.choice(3, p=(0.16, 0.46, 0.38))
    if size == 0:
        width, depth = rng.uniform(3.2, 7.0), rng.uniform(3.0, 5.5)
    elif size == 1:
        width, depth = rng.uniform(6.5, 11.0), rng.uniform(4.6, 8.5)
    else:
        width, depth = rng.uniform(10.0, 14.0), rng.uniform(7.5, 12.0)
    if size == 0:
        kind = (RoomKind.LIVING, RoomKind.BEDROOM, RoomKind.KITCHEN)[rng.choice(3, p=(0.5, 0.3, 0.2))]
        rooms = [Room((0.0, 0.0, width, depth), kind)]
        if width > 4.6 and rng.random() < 0.8:
            at = width - rng.uniform(1.4, min(2.4, width - 2.6))
            side = [RoomKind.BATHROOM, RoomKind.KITCHEN, RoomKind.HALL][rng.integers(3)]
            rooms = [Room((0.0, 0.0, at, depth), kind), Room((at, 0.0, width, depth), side)]
    else:
        at = width * rng.uniform(0.35, 0.6)
        rooms = _social_rooms((0.0, 0.0, at, depth), rng) + _private_rooms((at, 0.0, width, depth), rng)
        if rng.random() < 0.2:
            _remove_a_corner(rooms, rng)
    _carve_behind_bathrooms(rooms)
    _carve_closets(rooms, rng)
    return rooms


def _split(area: Rectangle, share: float) -> tuple[Rectangle, Rectangle]:
    """A rectangle cut across its longer side."""
    x0, z0, x1, z1 = area
    if x1 - x0 > z1 - z0:
        at = x0 + share * (x1 - x0)
        return (x0, z0, at, z1), (at, z0, x1, z1)
    at = z0 + share * (z1 - z0)
    return (x0, z0, x1, at), (x0, at, x1, z1)


def _social_rooms(area: Rectangle, rng: np.random.Generator) -> list[Room]:
    """Living room, kitchen and dining room, of which some may be missing."""
    size = (area[2] - area[0]) * (area[3] - area[1])
    if size < 14:
        return [Room(area, RoomKind.LIVING)]
    living, rest = _split(area, rng.uniform(0.42, 0.68))
    if rng.random() < 0.5:
        living, rest = rest, living
    rooms = [Room(living, RoomKind.LIVING)]
    if (rest[2] - rest[0]) * (rest[3] - rest[1]) < 13 or rng.random() < 0.2:
        return [*rooms, Room(rest, RoomKind.KITCHEN)]
    first, second = _split(rest, rng.uniform(0.4, 0.6))
    kinds = (RoomKind.KITCHEN, RoomKind.DINING) if rng.random() < 0.5 else (RoomKind.DINING, RoomKind.KITCHEN)
    return [*rooms, Room(first, kinds[0]), Room(second, kinds[1])]


def _private_rooms(area: Rectangle, rng: np.random.Generator) -> list[Room]:
    """A corridor with bedrooms and bathrooms at one or both sides, and perhaps a room at its end."""
    x0, z0, x1, z1 = area
    depth, wide = z1 - z0, rng.uniform(0.95, 1.5)
    if depth < 2.4 + wide or x1 - x0 < 2.6:
        return _row_of_rooms(area, rng)
    rooms, end = [], x1
    if x1 - x0 > 6.0 and rng.random() < 0.5:
        end = x1 - rng.uniform(2.8, 3.8)
        rooms.append(Room((end, z0, x1, z1), RoomKind.BEDROOM))
    if depth < 4.6 + wide:
        low, high = (z0, z0 + wide) if rng.random() < 0.5 else (z1 - wide, z1)
    else:
        low = z0 + rng.uniform(2.3, depth - 2.3 - wide)
        high = low + wide
    rooms.insert(0, Room((x0, low, end, high), RoomKind.HALL))
    for start, stop in ((z0, low), (high, z1)):
        if stop > start:
            rooms += _row_of_rooms((x0, start, end, stop), rng)
    return rooms


def _row_of_rooms(area: Rectangle, rng: np.random.Generator) -> list[Room]:
    """Rooms side by side along x that fill an area."""
    x0, z0, x1, z1 = area
    rooms, at, kind = [], x0, RoomKind.BEDROOM
    while at < x1 - 1e-9:
        choices = (RoomKind.BEDROOM, RoomKind.BATHROOM, RoomKind.UTILITY)
        kind = choices[rng.choice(3, p=(0.25, 0.6, 0.15) if kind == RoomKind.BEDROOM else (0.85, 0.1, 0.05))]
        width = rng.uniform(2.6, 4.3) if kind == RoomKind.BEDROOM else rng.uniform(1.5, 2.4)
        if at + width > x1 - 1.4:
            width = x1 - at
        if width < 2.3 and kind == RoomKind.BEDROOM:
            kind = RoomKind.BATHROOM
        elif width > 3.2:
            kind = RoomKind.BEDROOM
        end = x1 if at + width > x1 - 1e-6 else at + width
        rooms.append(Room((at, z0, end, z1), kind))
        at = end
    return rooms


def _remove_a_corner(rooms: list[Room], rng: np.random.Generator) -> None:
    """Remove a room at a corner of the home, which leaves an L shape."""
    bounds = Plan(tuple(rooms), ()).bounds
    corners = [
        k
        for k, room in enumerate(rooms)
        if k > 0
        and room.kind not in (RoomKind.HALL, RoomKind.KITCHEN)
        and sum(a == b for a, b in zip(room.corners, bounds, strict=True)) == 2
    ]
    if len(rooms) > 3 and corners:
        rooms.pop(corners[rng.integers(len(corners))])


def _carve_closets(rooms: list[Room], rng: np.random.Generator) -> None:
    """Cut strips for closets, pantries and alcoves off rooms, but not at a hall or at a closet of the same room."""
    for index in range(len(rooms)):
        room = rooms[index]
        chance = {RoomKind.BEDROOM: 0.65, RoomKind.KITCHEN: 0.25, RoomKind.LIVING: 0.3}.get(room.kind, 0.0)
        if rng.random() >= chance:
            continue
        depth = rng.uniform(1.2, 1.8) if rng.random() < 0.2 else rng.uniform(0.6, 1.0)
        side = int(rng.integers(4))
        if (room.width if side % 2 == 0 else room.depth) - depth < 2.3:
            continue
        inner = room.corners[side] + (depth if side < 2 else -depth)
        strip, rest = _with_corner(room.corners, (side + 2) % 4, inner), _with_corner(room.corners, side, inner)
        is_needed = any(
            _shared_side(other.corners, strip)
            for other in rooms
            if other.kind == RoomKind.HALL or other.parent == index
        )
        if is_needed:
            continue
        rooms[index] = replace(room, corners=rest)
        low, high = (strip[1], strip[3]) if side % 2 == 0 else (strip[0], strip[2])
        length = rng.uniform(0.45, 1.2) * (high - low)
        if length > high - low - 0.7:
            parts = [(low, high, RoomKind.CLOSET)]
        elif rng.random() < 0.5:
            parts = [(low, low + length, RoomKind.CLOSET), (low + length, high, RoomKind.ALCOVE)]
        else:
            parts = [(low, high - length, RoomKind.ALCOVE), (high - length, high, RoomKind.CLOSET)]
        for start, end, kind in parts:
            part = (strip[0], start, strip[2], end) if side % 2 == 0 else (start, strip[1], end, strip[3])
            rooms.append(Room(part, kind, index))


def _with_corner(area: Rectangle, place: int, value: float) -> Rectangle:
    """A rectangle with another coordinate at one of its four places."""
    x0, z0, x1, z1 = (value if k == place else old for k, old in enumerate(area))
    return x0, z0, x1, z1


def _carve_behind_bathrooms(rooms: list[Room]) -> None:
    """Turn the far part of deep bathrooms into closets of neighbouring bedrooms."""
    halls = [room for room in rooms if room.kind == RoomKind.HALL]
    for index in range(len(rooms)):
        room = rooms[index]
        x0, z0, x1, z1 = room.corners
        if room.kind != RoomKind.BATHROOM or room.depth < 3.1:
            continue
        for part, rest in (
            ((x0, z0, x1, z1 - 2.2), (x0, z1 - 2.2, x1, z1)),
            ((x0, z0 + 2.2, x1, z1), (x0, z0, x1, z0 + 2.2)),
        ):
            owners = [
                k
                for k, other in enumerate(rooms)
                if other.kind == RoomKind.BEDROOM and _shared_side(other.corners, part) > 0.85
            ]
            if owners and not any(_shared_side(hall.corners, part) for hall in halls):
                rooms[index] = replace(room, corners=rest)
                rooms.append(Room(part, RoomKind.CLOSET, owners[0]))
                break


def _transform(rooms: list[Room], rng: np.random.Generator) -> list[Room]:
    """Centre the rooms at the origin, mirror them and exchange the axes at random."""
    corners = np.array([room.corners for room in rooms])
    corners -= np.tile((corners[:, :2].min(axis=0) + corners[:, 2:].max(axis=0)) / 2, 2)
    for axis in (0, 1):
        if rng.random() < 0.5:
            corners[:, [axis, axis + 2]] = -corners[:, [axis + 2, axis]]
    if rng.random() < 0.5:
        corners = corners[:, [1, 0, 3, 2]]
    return [replace(room, corners=tuple(map(float, row))) for room, row in zip(rooms, corners.round(4), strict=True)]


def _shared_side(first: Rectangle, second: Rectangle) -> float:
    """Length of the common side of two rectangles, metres; 0 if there is none."""
    for k in (0, 1):
        if abs(first[k] - second[k + 2]) < 1e-6 or abs(first[k + 2] - second[k]) < 1e-6:
            length = min(first[3 - k], second[3 - k]) - max(first[1 - k], second[1 - k])
            if length > 1e-6:
                return length
    return 0.0


def _find_walls(rooms: list[Room]) -> list[Wall]:
    """Walls at all sides of rooms, split wherever a room begins or ends on one of their sides."""
    walls = []
    for k, axis in ((0, 0), (1, 2)):
        for at in sorted({room.corners[side] for room in rooms for side in (k, k + 2)}):
            beside = [i for i, room in enumerate(rooms) if at in (room.corners[k], room.corners[k + 2])]
            stops = sorted({rooms[i].corners[side] for i in beside for side in (1 - k, 3 - k)})
            line: list[Wall] = []
            for start, end in itertools.pairwise(stops):
                pair = [OUTSIDE, OUTSIDE]
                for i in beside:
                    corners = rooms[i].corners
                    if corners[1 - k] <= start and corners[3 - k] >= end:
                        pair[0 if corners[k + 2] == at else 1] = i
                if line and line[-1].rooms == tuple(pair) and line[-1].end == start:
                    line[-1].end = end
                elif pair != [OUTSIDE, OUTSIDE]:
                    line.append(Wall(axis, at, start, end, (pair[0], pair[1])))
            walls += line
    return walls


def _affinity(first: Room, second: Room) -> float:
    """Weight of a passage between two rooms; 0 excludes it."""
    kinds = {first.kind, second.kind}
    if kinds & {RoomKind.CLOSET, RoomKind.ALCOVE}:
        return 0.0
    if RoomKind.HALL in kinds:
        return 30.0
    if kinds <= set(_SOCIAL):
        return 20.0
    if kinds == {RoomKind.BEDROOM, RoomKind.BATHROOM}:
        return 2.0
    return 1.0 if kinds & set(_SOCIAL) else 0.05


def _connect(plan: Plan, rng: np.random.Generator) -> None:
    """Add doors and openings: a random spanning tree, some more, and one for each closet and alcove."""
    pairs: dict[tuple[int, int], Wall] = {}
    for wall in plan.walls:
        if not wall.is_outer and (wall.rooms not in pairs or pairs[wall.rooms].length < wall.length):
            pairs[wall.rooms] = wall
    for index, room in enumerate(plan.rooms):
        if room.parent >= 0:
            _add_passage(plan, pairs.get((index, room.parent)) or pairs[room.parent, index], rng)
    inner = {i for i, room in enumerate(plan.rooms) if room.parent >= 0}
    candidates = [
        (wall, _affinity(*(plan.rooms[i] for i in wall.rooms))) for wall in pairs.values() if wall.length > 0.95
    ]
    candidates = [(wall, weight) for wall, weight in candidates if weight > 0]
    reached = {0}
    while len(reached | inner) < len(plan.rooms):
        border = [(wall, weight) for wall, weight in candidates if len(reached & set(wall.rooms)) == 1]
        if not border:
            return
        weights = np.array([weight for _, weight in border])
        wall = border[rng.choice(len(border), p=weights / weights.sum())][0]
        _add_passage(plan, wall, rng)
        reached |= set(wall.rooms)
    for wall, weight in candidates:
        if not wall.holes and rng.random() < {30.0: 0.8, 20.0: 0.6, 2.0: 0.25, 1.0: 0.08}.get(weight, 0.0):
            _add_passage(plan, wall, rng)
    for wall, weight in candidates:
        if weight == 20.0 and wall.length > 1.8 and rng.random() < 0.25:
            _add_pass_through(wall, rng)


def _add_pass_through(wall: Wall, rng: np.random.Generator) -> None:
    """Add an opening above a half-height wall, as between kitchens and living rooms, where there is space."""
    stops = sorted([wall.start, *(at for hole in wall.holes for at in (hole.start, hole.end)), wall.end])
    start, end = max(zip(stops[::2], stops[1::2], strict=True), key=lambda part: part[1] - part[0])
    if end - start > 1.2:
        width = rng.uniform(0.8, end - start - 0.3)
        left = start + rng.uniform(0.15, end - start - width - 0.15)
        wall.holes.append(Hole(left, left + width, rng.uniform(0.9, 1.1), rng.uniform(1.95, 2.2), HoleKind.OPENING))


def _add_passage(plan: Plan, wall: Wall, rng: np.random.Generator) -> None:
    """Add a door or an opening to an inner wall, as the kinds of its rooms need it."""
    kinds = {plan.rooms[i].kind for i in wall.rooms}
    free = wall.length - 0.3
    if RoomKind.ALCOVE in kinds:
        wall.holes.append(Hole(wall.start, wall.end, 0.0, np.inf, HoleKind.OPENING))
        return
    kind, top, width = HoleKind.DOOR, rng.uniform(1.98, 2.12), rng.uniform(0.68, 0.93)
    if RoomKind.CLOSET in kinds:
        if rng.random() < 0.6:
            width = rng.uniform(0.55, 0.95) * free
            width = min(width, 2.4)
    elif kinds <= {*_SOCIAL, RoomKind.HALL}:
        choice = rng.random()
        if choice < 0.2 and RoomKind.HALL not in kinds:
            wall.holes.append(Hole(wall.start, wall.end, 0.0, np.inf, HoleKind.OPENING))
            return
        if choice < 0.75:
            kind, width = HoleKind.OPENING, rng.uniform(0.85, max(0.9, min(3.5, free)))
            top = rng.uniform(2.0, 2.25) if rng.random() < 0.7 else np.inf
    width = min(width, free)
    slack = free - width
    # Most doors are near a corner of their room.
    offset = rng.choice(
        (rng.uniform(0, min(0.3, slack)), slack - rng.uniform(0, min(0.3, slack)), rng.uniform(0, slack))
    )
    left = wall.start + 0.15 + offset
    wall.holes.append(Hole(left, left + width, 0.0, top, kind))


_WINDOW_CHANCE = {
    RoomKind.LIVING: 0.9,
    RoomKind.DINING: 0.9,
    RoomKind.KITCHEN: 0.8,
    RoomKind.BEDROOM: 0.8,
    RoomKind.BATHROOM: 0.4,
    RoomKind.HALL: 0.1,
    RoomKind.UTILITY: 0.3,
    RoomKind.ALCOVE: 0.4,
}


def _add_outer_holes(plan: Plan, rng: np.random.Generator) -> None:
    """Add windows, patio doors and one entrance to outer walls."""
    outer = [wall for wall in plan.walls if wall.is_outer]
    has_entrance = False
    for place in rng.permutation(len(outer)):
        wall = outer[place]
        kind = plan.rooms[max(wall.rooms)].kind
        free = wall.length - 0.5
        suits = kind in (RoomKind.HALL, RoomKind.LIVING, RoomKind.DINING, RoomKind.KITCHEN)
        if not has_entrance and suits and 0.85 < free < (3.0 if kind == RoomKind.HALL else 20.0):
            width = rng.uniform(0.82, 0.95)
            left = wall.start + 0.25 + rng.choice((0.0, free - width))
            wall.holes.append(Hole(left, left + width, 0.0, rng.uniform(2.0, 2.12), HoleKind.ENTRANCE))
            has_entrance = True
            continue
        if free < 0.6 or rng.random() > _WINDOW_CHANCE.get(kind, 0.0):
            continue
        if kind in _SOCIAL and free > 1.5 and rng.random() < 0.25:
            width = rng.uniform(1.4, min(3.0, free))
            left = wall.start + 0.25 + rng.uniform(0, free - width)
            wall.holes.append(Hole(left, left + width, 0.0, rng.uniform(2.0, 2.15), HoleKind.PATIO_DOOR))
            continue
        count = 1 + int(free > 3.0 and rng.random() < 0.5)
        top = rng.uniform(1.95, 2.2)
        low = rng.uniform(1.2, 1.5) if kind == RoomKind.BATHROOM else rng.uniform(0.35, 1.1)
        for part in range(count):
            span = free / count
            width = rng.uniform(0.45, min(0.9 if kind == RoomKind.BATHROOM else 2.4, span))
            middle = wall.start + 0.25 + (part + 0.5) * span + rng.uniform(-0.5, 0.5) * 0.8 * (span - width)
            wall.holes.append(Hole(middle - width / 2, middle + width / 2, low, top, HoleKind.WINDOW))
