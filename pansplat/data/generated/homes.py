"""A furnished home from a seed: its floor plan, walls, rooms, furniture and lights."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from pansplat.data.generated import materials as surfaces
from pansplat.data.generated.furniture import AGAINST_WALL, STANDING, Place
from pansplat.data.generated.raytracer import CEILING, FLOOR, WALL
from pansplat.data.generated.scene import GeneratedScene, SceneBuilder
from pansplat.data.generated.textures import Pattern

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


_GROUND = 27.0  # metres from the middle to where the ground ends, within the sky


def build_home(rng: np.random.Generator) -> tuple[GeneratedScene, Plan]:
    """A furnished home and its plan; the floor is at y = 0, y points down."""
    build, plan = SceneBuilder(rng), draw_plan(rng)
    outside, sky, grass = _outside(build)
    tall = [rng.uniform(2.3, 3.3) for _ in plan.rooms]
    if rng.random() < 0.6:
        tall = [tall[0]] * len(tall)
    top = max(tall) + 0.1
    x0, z0, x1, z1 = plan.whole
    middle, half = ((x0 + x1) / 2, (z0 + z1) / 2), ((x1 - x0) / 2 + OUTER, (z1 - z0) / 2 + OUTER)
    build.box((middle[0], 0.1, middle[1]), (half[0], 0.1, half[1]), FLOOR)
    build.box((0, 0.45, 0), (_GROUND, 0.3, _GROUND), grass)
    for wall in plan.walls:
        _build_wall(build, wall, top)
    trim = surfaces.plain(build, 0.2, 0.6) if rng.random() < 0.6 else surfaces.wood(build)
    for room, height in zip(plan.rooms, tall, strict=True):
        _build_room(build, room, height, top, trim)
        taken = _doorways(plan, room)
        _furnish(build, plan, room, taken)
        _decorate(build, plan, room, height)
    if rng.random() < 0.6:
        _sun(build)
    warm = rng.uniform(-0.12, 0.12)
    ambient = rng.uniform(0.35, 0.7) * np.array((1 + warm, 1.0, 1 - warm))
    return build.finish(ambient, outside, sky), plan


def _outside(build: SceneBuilder) -> tuple[int, int, int]:
    """Materials of the house's outside, the sky and the ground."""
    rng = build.rng
    outside = surfaces.wall(build)
    blue = rng.uniform(0.2, 0.6)
    sky = build.look(
        Pattern.PLAIN,
        (blue * 0.4, blue * 0.7, blue * 1.4),
        (0.7, 0.8, 0.9),
        surfaces.any_color(rng, 0.5, 0.2, 0.6),
        glow=rng.uniform(0.8, 2.0),
    )
    green = (rng.uniform(0.05, 0.25), rng.uniform(0.1, 0.3), rng.uniform(0.02, 0.15))
    grass = build.look(Pattern.STONE, green, surfaces.shade(green, 0.4), size=(0.7, 0.7), share=0, mottle=0.6)
    return outside, sky, grass


def _sun(build: SceneBuilder) -> None:
    rng = build.rng
    up, around = np.radians(rng.uniform(20, 55)), rng.uniform(0, 2 * np.pi)
    power = rng.uniform(0.8, 2.0)
    direction = (np.cos(up) * np.sin(around), -np.sin(up), np.cos(up) * np.cos(around))
    build.light(direction, (power, 0.93 * power, 0.8 * power), 0.01, sun=True)


def _wall_box(build: SceneBuilder, wall: Wall, span: tuple[float, float], rise: tuple[float, float]) -> None:
    """A piece of a wall, from and to along it and above the floor."""
    if span[1] - span[0] < 1e-6 or rise[1] - rise[0] < 1e-6:
        return
    thick = OUTER if wall.outer else INNER
    across = wall.at + (np.sign(wall.at) * OUTER / 2 if wall.outer else 0.0)
    along, y = (span[0] + span[1]) / 2, -(rise[0] + rise[1]) / 2
    half = ((span[1] - span[0]) / 2, (rise[1] - rise[0]) / 2)
    if wall.axis == 0:
        build.box((across, y, along), (thick / 2, half[1], half[0]), WALL)
    else:
        build.box((along, y, across), (half[0], half[1], thick / 2), WALL)


def _build_wall(build: SceneBuilder, wall: Wall, top: float) -> None:
    """The wall round its holes, with frames in the windows."""
    extra = OUTER if wall.outer else 0.0  # outer walls meet in the corners
    at = wall.start - extra
    for hole in sorted(wall.holes, key=lambda hole: hole.start):
        _wall_box(build, wall, (at, hole.start), (0, top))
        _wall_box(build, wall, (hole.start, hole.end), (hole.top, top))
        _wall_box(build, wall, (hole.start, hole.end), (0, hole.low))
        at = hole.end
        if wall.outer:
            _window_frame(build, wall, hole)
    _wall_box(build, wall, (at, wall.end + extra), (0, top))


def _window_frame(build: SceneBuilder, wall: Wall, hole: Hole) -> None:
    """Bars round and across a window."""
    rng = build.rng
    look, bar = surfaces.plain(build, 0.2, 0.5), rng.uniform(0.02, 0.04)
    across = wall.at + np.sign(wall.at) * OUTER / 2
    y, tall = -(hole.low + hole.top) / 2, (hole.top - hole.low) / 2
    middle, half = (hole.start + hole.end) / 2, (hole.end - hole.start) / 2
    posts = np.linspace(hole.start + bar, hole.end - bar, 2 + int(rng.integers(1, 4)))
    bars = [(post, y, bar, tall) for post in posts]
    bars += [(middle, rise, half, bar) for rise in (-hole.low - bar, -hole.top + bar)]
    if rng.random() < 0.5:
        bars.append((middle, y, half, bar * 0.7))
    for along, rise, wide, high in bars:
        centre = (across, rise, along) if wall.axis == 0 else (along, rise, across)
        size = (0.03, high, wide) if wall.axis == 0 else (wide, high, 0.03)
        build.box(centre, size, look)


def _build_room(build: SceneBuilder, room: Rectangle, tall: float, top: float, trim: int) -> None:
    """Ceiling, surfaces and a lamp."""
    rng = build.rng
    x0, z0, x1, z1 = room
    x, z = (x0 + x1) / 2, (z0 + z1) / 2
    build.box((x, -(tall + top + 0.2) / 2, z), ((x1 - x0) / 2, (top + 0.2 - tall) / 2, (z1 - z0) / 2), CEILING)
    looks = [surfaces.wall(build), surfaces.floor(build), surfaces.ceiling(build), trim, surfaces.wall(build)]
    panel = rng.uniform(0.8, 1.3) if rng.random() < 0.25 else 0.0
    build.room(room, looks, panel, rng.uniform(0.05, 0.14) if rng.random() < 0.75 else 0.0, tall)
    if rng.random() < 0.15:
        beam = surfaces.wood(build)
        for at in np.arange(x0 + 0.5, x1 - 0.3, rng.uniform(0.8, 1.4)):
            build.box((at, -tall + 0.08, z), (0.07, 0.08, (z1 - z0) / 2), beam)
    x, z = x + rng.uniform(-0.3, 0.3), z + rng.uniform(-0.3, 0.3)
    shade = build.look(Pattern.PLAIN, surfaces.any_color(rng, 0.3, 0.8, 1.0), glow=rng.uniform(0.8, 2.0))
    power, warm = rng.uniform(0.7, 2.6), rng.uniform(0, 0.3)
    if rng.random() < 0.5:
        drop, size = rng.uniform(0.2, 0.5), rng.uniform(0.08, 0.22)
        build.cylinder((x, -tall + drop / 2, z), 0.008, drop / 2, trim)
        build.ellipsoid((x, -tall + drop, z), (size, size * rng.uniform(0.5, 1), size), shade)
        drop += size + 0.05
    else:
        drop = 0.1
        build.box((x, -tall, z), (rng.uniform(0.1, 0.4), 0.03, rng.uniform(0.1, 0.4)), shade)
    build.light((x, -tall + drop, z), (power, power * (1 - warm / 2), power * (1 - warm)), rng.uniform(0.03, 0.12))


def _doorways(plan: Plan, room: Rectangle) -> list[Rectangle]:
    """The floor in front of doors, to be kept free."""
    taken = []
    for side in sides(room):
        axis, at, _, _, sign = side
        for hole in holes_of_side(plan, side):
            if hole.low > 0:
                continue
            near, far = sorted((at, at - 0.9 * sign))
            taken.append((near, hole.start, far, hole.end) if axis == 0 else (hole.start, near, hole.end, far))
    return taken


def _free(place: Rectangle, taken: list[Rectangle], room: Rectangle) -> bool:
    x0, z0, x1, z1 = place
    if x0 < room[0] + 0.07 or z0 < room[1] + 0.07 or x1 > room[2] - 0.07 or z1 > room[3] - 0.07:
        return False
    return all(x1 < t[0] or x0 > t[2] or z1 < t[1] or z0 > t[3] for t in taken)


def _furnish(build: SceneBuilder, plan: Plan, room: Rectangle, taken: list[Rectangle]) -> None:
    """Pieces along the walls and in the room, as many as find a place."""
    rng = build.rng
    area = (room[2] - room[0]) * (room[3] - room[1])
    if rng.random() < 0.5:
        _rug(build, room)
    for _ in range(round(area * rng.uniform(0.1, 0.45))):
        piece, wide, deep = AGAINST_WALL[rng.integers(len(AGAINST_WALL))]
        wide *= rng.uniform(0.75, 1.25)
        axis, at, start, end, sign = sides(room)[rng.integers(4)]
        if end - start < wide + 0.2:
            continue
        along, across = rng.uniform(start + wide / 2, end - wide / 2), at - sign * (deep / 2 + 0.09)
        x, z = (across, along) if axis == 0 else (along, across)
        half = (deep / 2, wide / 2) if axis == 0 else (wide / 2, deep / 2)
        place = (x - half[0], z - half[1], x + half[0], z + half[1])
        if _free(place, taken, room):
            taken.append(place)
            yaw = np.pi / 2 * sign if axis == 0 else (0.0 if sign > 0 else np.pi)
            piece(Place(build, x, z, yaw), rng, wide, deep)
    for _ in range(round(area * rng.uniform(0.1, 0.6))):
        piece, wide, deep = STANDING[rng.integers(len(STANDING))]
        reach = 0.5 * np.hypot(wide, deep)
        x, z = rng.uniform(room[0], room[2]), rng.uniform(room[1], room[3])
        place = (x - reach, z - reach, x + reach, z + reach)
        if _free(place, taken, room):
            taken.append(place)
            piece(Place(build, x, z, rng.uniform(0, 2 * np.pi)), rng, wide, deep)


def _rug(build: SceneBuilder, room: Rectangle) -> None:
    rng = build.rng
    wide, deep = (rng.uniform(0.3, 0.7) * (room[k + 2] - room[k]) for k in (0, 1))
    size = rng.uniform(0.04, 0.15)
    colors = [surfaces.any_color(rng) for _ in range(3)]
    look = build.look(Pattern.RUG, *colors, size=(size, size), mottle=0.4)
    x, z = (room[0] + room[2]) / 2, (room[1] + room[3]) / 2
    build.box((x, -0.008, z), (wide / 2, 0.008, deep / 2), look)


def _decorate(build: SceneBuilder, plan: Plan, room: Rectangle, tall: float) -> None:
    """Pictures and curtains on the walls."""
    rng = build.rng
    for side in sides(room):
        axis, at, start, end, sign = side
        holes = holes_of_side(plan, side)
        inner = at - sign * (0.0 if abs(at) >= max(map(abs, plan.whole)) - 1e-9 else INNER / 2)
        for _ in range(rng.integers(0, 4)):
            wide, high = rng.uniform(0.2, 1.2), rng.uniform(0.2, 0.9)
            if end - start < wide + 0.4:
                continue
            along = rng.uniform(start + wide / 2 + 0.15, end - wide / 2 - 0.15)
            if any(hole.start - wide / 2 - 0.1 < along < hole.end + wide / 2 + 0.1 for hole in holes):
                continue
            holes.append(Hole(along - wide / 2, along + wide / 2, 1, 2))
            rise = -rng.uniform(1.3, min(1.9, tall - high / 2 - 0.1))
            frame = surfaces.wood(build) if rng.random() < 0.5 else surfaces.plain(build)
            for look, grow, thick in ((frame, rng.uniform(0.0, 0.06), 0.02), (surfaces.picture(build), 0.0, 0.025)):
                _on_wall(build, axis, inner, along, rise, (wide / 2 + grow, high / 2 + grow, thick), look)
        for hole in holes_of_side(plan, side):
            if hole.low > 0 and rng.random() < 0.4:
                cloth, wide = surfaces.fabric(build), rng.uniform(0.1, 0.25)
                for along in (hole.start - wide, hole.end + wide):
                    if start + wide < along < end - wide:
                        _on_wall(build, axis, inner - sign * 0.05, along, -1.15, (wide, 1.1, 0.04), cloth)


def _on_wall(
    build: SceneBuilder, axis: int, at: float, along: float, y: float, half: tuple[float, float, float], look: int
) -> None:
    """A box on a wall: half its width, height and thickness."""
    wide, high, thick = half
    if axis == 0:
        build.box((at, y, along), (thick, high, wide), look)
    else:
        build.box((along, y, at), (wide, high, thick), look)
