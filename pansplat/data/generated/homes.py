"""Random furnished homes: floor plan, walls, rooms, furniture and lights."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from pansplat.data.generated import materials
from pansplat.data.generated.furniture import AGAINST_WALL, STANDING, Place
from pansplat.data.generated.raytracer import CEILING, FLOOR, WALL
from pansplat.data.generated.scene import GeneratedScene, SceneBuilder
from pansplat.data.generated.textures import Pattern

Rectangle = tuple[float, float, float, float]
"""x0, z0, x1, z1, metres."""

INNER, OUTER = 0.12, 0.25  # thickness of walls, metres
_MIN_SIDE = 2.2  # side of a room, metres


@dataclass(frozen=True)
class Hole:
    """A door or window from `start` to `end` along its wall and from `low` to `top` above the floor, metres."""

    start: float
    end: float
    low: float
    top: float


@dataclass
class Wall:
    """A wall in the plane x = at (axis 0) or z = at (axis 2), from `start` to `end` along the other axis, metres."""

    axis: int
    at: float
    start: float
    end: float
    outer: bool
    holes: list[Hole] = field(default_factory=list)


@dataclass(frozen=True)
class Plan:
    """Rooms that fill a rectangle, and their walls."""

    whole: Rectangle
    rooms: tuple[Rectangle, ...]
    walls: tuple[Wall, ...]


def sample_plan(rng: np.random.Generator) -> Plan:
    """A random plan of one to four rooms, with doors in inner walls and windows in outer walls."""
    width, depth = rng.uniform(3.2, 9.0), rng.uniform(3.0, 8.0)
    whole = (-width / 2, -depth / 2, width / 2, depth / 2)
    rooms, walls = [whole], []
    for _ in range(rng.integers(0, 4)):
        rooms.sort(key=_longer_side)
        x0, z0, x1, z1 = room = rooms[-1]
        if _longer_side(room) < 2 * _MIN_SIDE + 0.2:
            break
        rooms.pop()
        if x1 - x0 > z1 - z0:
            at = rng.uniform(x0 + _MIN_SIDE, x1 - _MIN_SIDE)
            rooms += [(x0, z0, at, z1), (at, z0, x1, z1)]
            walls.append(Wall(0, at, z0, z1, False))
        else:
            at = rng.uniform(z0 + _MIN_SIDE, z1 - _MIN_SIDE)
            rooms += [(x0, z0, x1, at), (x0, at, x1, z1)]
            walls.append(Wall(2, at, x0, x1, False))
    x0, z0, x1, z1 = whole
    walls += [Wall(0, x0, z0, z1, True), Wall(0, x1, z0, z1, True)]
    walls += [Wall(2, z0, x0, x1, True), Wall(2, z1, x0, x1, True)]
    for wall in walls:
        _add_holes(wall, walls, rng)
    return Plan(whole, tuple(rooms), tuple(walls))


def sides(room: Rectangle) -> list[tuple[int, float, float, float, int]]:
    """The four sides of a room: axis, coordinate, start, end, and the sign of the outward direction on the axis."""
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


def _longer_side(room: Rectangle) -> float:
    return max(room[2] - room[0], room[3] - room[1])


def _add_holes(wall: Wall, walls: list[Wall], rng: np.random.Generator) -> None:
    """Add random holes between the junctions with other walls."""
    junctions = [
        other.at
        for other in walls
        if other.axis != wall.axis
        and wall.start < other.at < wall.end
        and min(abs(other.start - wall.at), abs(other.end - wall.at)) < 1e-9
    ]
    stops = [wall.start, *sorted(junctions), wall.end]
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


_GROUND = 27.0  # half the side of the ground, metres; within the sphere of the sky


def build_home(rng: np.random.Generator) -> tuple[GeneratedScene, Plan]:
    """A random furnished home and its plan. World axes: y down, the floor at y = 0."""
    builder, plan = SceneBuilder(rng), sample_plan(rng)
    outside, sky, grass = _outdoor_materials(builder)
    heights = [rng.uniform(2.3, 3.3) for _ in plan.rooms]
    if rng.random() < 0.6:
        heights = [heights[0]] * len(heights)
    top = max(heights) + 0.1
    x0, z0, x1, z1 = plan.whole
    middle, half = ((x0 + x1) / 2, (z0 + z1) / 2), ((x1 - x0) / 2 + OUTER, (z1 - z0) / 2 + OUTER)
    builder.add_box((middle[0], 0.1, middle[1]), (half[0], 0.1, half[1]), FLOOR)
    builder.add_box((0, 0.45, 0), (_GROUND, 0.3, _GROUND), grass)
    for wall in plan.walls:
        _add_wall(builder, wall, top)
    trim = materials.plain(builder, 0.2, 0.6) if rng.random() < 0.6 else materials.wood(builder)
    for room, height in zip(plan.rooms, heights, strict=True):
        _add_room(builder, room, height, top, trim)
        occupied = _find_doorways(plan, room)
        _furnish_room(builder, plan, room, occupied)
        _decorate_walls(builder, plan, room, height)
    if rng.random() < 0.6:
        _add_sun(builder)
    warm = rng.uniform(-0.12, 0.12)
    ambient = rng.uniform(0.35, 0.7) * np.array((1 + warm, 1.0, 1 - warm))
    return builder.finish(ambient, outside, sky), plan


def _outdoor_materials(builder: SceneBuilder) -> tuple[int, int, int]:
    rng = builder.rng
    outside = materials.wall(builder)
    blue = rng.uniform(0.2, 0.6)
    sky = builder.add_material(
        Pattern.PLAIN,
        (blue * 0.4, blue * 0.7, blue * 1.4),
        (0.7, 0.8, 0.9),
        materials.random_color(rng, 0.5, 0.2, 0.6),
        glow=rng.uniform(0.8, 2.0),
    )
    green = (rng.uniform(0.05, 0.25), rng.uniform(0.1, 0.3), rng.uniform(0.02, 0.15))
    grass = builder.add_material(Pattern.STONE, green, materials.shade(green, 0.4), size=0.7, fraction=0, mottle=0.6)
    return outside, sky, grass


def _add_sun(builder: SceneBuilder) -> None:
    rng = builder.rng
    up, around = np.radians(rng.uniform(20, 55)), rng.uniform(0, 2 * np.pi)
    power = rng.uniform(0.8, 2.0)
    direction = (np.cos(up) * np.sin(around), -np.sin(up), np.cos(up) * np.cos(around))
    builder.add_light(direction, (power, 0.93 * power, 0.8 * power), 0.01, sun=True)


def _add_wall_part(builder: SceneBuilder, wall: Wall, span: tuple[float, float], rise: tuple[float, float]) -> None:
    """Add a part of a wall: its extent along the wall and above the floor, metres."""
    if span[1] - span[0] < 1e-6 or rise[1] - rise[0] < 1e-6:
        return
    thick = OUTER if wall.outer else INNER
    across = wall.at + (np.sign(wall.at) * OUTER / 2 if wall.outer else 0.0)
    along, y = (span[0] + span[1]) / 2, -(rise[0] + rise[1]) / 2
    half = ((span[1] - span[0]) / 2, (rise[1] - rise[0]) / 2, thick / 2)
    _add_wall_box(builder, wall.axis, across, along, y, half, WALL)


def _add_wall(builder: SceneBuilder, wall: Wall, top: float) -> None:
    """Add the parts of a wall around its holes, and window frames."""
    extra = OUTER if wall.outer else 0.0  # outer walls overlap in the corners
    at = wall.start - extra
    for hole in sorted(wall.holes, key=lambda hole: hole.start):
        _add_wall_part(builder, wall, (at, hole.start), (0, top))
        _add_wall_part(builder, wall, (hole.start, hole.end), (hole.top, top))
        _add_wall_part(builder, wall, (hole.start, hole.end), (0, hole.low))
        at = hole.end
        if wall.outer:
            _add_window_frame(builder, wall, hole)
    _add_wall_part(builder, wall, (at, wall.end + extra), (0, top))


def _add_window_frame(builder: SceneBuilder, wall: Wall, hole: Hole) -> None:
    rng = builder.rng
    material, bar = materials.plain(builder, 0.2, 0.5), rng.uniform(0.02, 0.04)
    across = wall.at + np.sign(wall.at) * OUTER / 2
    y, height = -(hole.low + hole.top) / 2, (hole.top - hole.low) / 2
    middle, half = (hole.start + hole.end) / 2, (hole.end - hole.start) / 2
    posts = np.linspace(hole.start + bar, hole.end - bar, 2 + int(rng.integers(1, 4)))
    bars = [(post, y, bar, height) for post in posts]
    bars += [(middle, rise, half, bar) for rise in (-hole.low - bar, -hole.top + bar)]
    if rng.random() < 0.5:
        bars.append((middle, y, half, bar * 0.7))
    for along, rise, width, high in bars:
        _add_wall_box(builder, wall.axis, across, along, rise, (width, high, 0.03), material)


def _add_room(builder: SceneBuilder, room: Rectangle, height: float, top: float, trim: int) -> None:
    """Add the ceiling, materials, beams and lamp of a room."""
    rng = builder.rng
    x0, z0, x1, z1 = room
    x, z = (x0 + x1) / 2, (z0 + z1) / 2
    builder.add_box(
        (x, -(height + top + 0.2) / 2, z), ((x1 - x0) / 2, (top + 0.2 - height) / 2, (z1 - z0) / 2), CEILING
    )
    room_materials = [
        materials.wall(builder),
        materials.floor(builder),
        materials.ceiling(builder),
        trim,
        materials.wall(builder),
    ]
    panel = rng.uniform(0.8, 1.3) if rng.random() < 0.25 else 0.0
    trim_height = rng.uniform(0.05, 0.14) if rng.random() < 0.75 else 0.0
    builder.add_room(room, room_materials, panel, trim_height, height, [rng.uniform(0.35, 0.7)] * 3)
    if rng.random() < 0.15:
        beam = materials.wood(builder)
        for at in np.arange(x0 + 0.5, x1 - 0.3, rng.uniform(0.8, 1.4)):
            builder.add_box((at, -height + 0.08, z), (0.07, 0.08, (z1 - z0) / 2), beam)
    x, z = x + rng.uniform(-0.3, 0.3), z + rng.uniform(-0.3, 0.3)
    shade = builder.add_material(Pattern.PLAIN, materials.random_color(rng, 0.3, 0.8, 1.0), glow=rng.uniform(0.8, 2.0))
    power, warm = rng.uniform(0.7, 2.6), rng.uniform(0, 0.3)
    if rng.random() < 0.5:
        drop, size = rng.uniform(0.2, 0.5), rng.uniform(0.08, 0.22)
        builder.add_cylinder((x, -height + drop / 2, z), 0.008, drop / 2, trim)
        builder.add_ellipsoid((x, -height + drop, z), (size, size * rng.uniform(0.5, 1), size), shade)
        drop += size + 0.05
    else:
        drop = 0.1
        builder.add_box((x, -height, z), (rng.uniform(0.1, 0.4), 0.03, rng.uniform(0.1, 0.4)), shade)
    builder.add_light(
        (x, -height + drop, z), (power, power * (1 - warm / 2), power * (1 - warm)), rng.uniform(0.03, 0.12)
    )


def _find_doorways(plan: Plan, room: Rectangle) -> list[Rectangle]:
    """The areas in front of doors, where no furniture may stand."""
    occupied = []
    for side in sides(room):
        axis, at, _, _, sign = side
        for hole in holes_of_side(plan, side):
            if hole.low > 0:
                continue
            near, far = sorted((at, at - 0.9 * sign))
            occupied.append((near, hole.start, far, hole.end) if axis == 0 else (hole.start, near, hole.end, far))
    return occupied


def _is_free(place: Rectangle, occupied: list[Rectangle], room: Rectangle) -> bool:
    x0, z0, x1, z1 = place
    if x0 < room[0] + 0.07 or z0 < room[1] + 0.07 or x1 > room[2] - 0.07 or z1 > room[3] - 0.07:
        return False
    return all(x1 < t[0] or x0 > t[2] or z1 < t[1] or z0 > t[3] for t in occupied)


def _furnish_room(builder: SceneBuilder, plan: Plan, room: Rectangle, occupied: list[Rectangle]) -> None:
    """Add furniture along the walls and in the room where there is space."""
    rng = builder.rng
    area = (room[2] - room[0]) * (room[3] - room[1])
    if rng.random() < 0.5:
        _add_rug(builder, room)
    for _ in range(round(area * rng.uniform(0.1, 0.45))):
        piece, width, depth = AGAINST_WALL[rng.integers(len(AGAINST_WALL))]
        width *= rng.uniform(0.75, 1.25)
        axis, at, start, end, sign = sides(room)[rng.integers(4)]
        if end - start < width + 0.2:
            continue
        along, across = rng.uniform(start + width / 2, end - width / 2), at - sign * (depth / 2 + 0.09)
        x, z = (across, along) if axis == 0 else (along, across)
        half = (depth / 2, width / 2) if axis == 0 else (width / 2, depth / 2)
        place = (x - half[0], z - half[1], x + half[0], z + half[1])
        if _is_free(place, occupied, room):
            occupied.append(place)
            yaw = np.pi / 2 * sign if axis == 0 else (0.0 if sign > 0 else np.pi)
            piece(Place(builder, x, z, yaw), rng, width, depth)
    for _ in range(round(area * rng.uniform(0.1, 0.6))):
        piece, width, depth = STANDING[rng.integers(len(STANDING))]
        reach = 0.5 * np.hypot(width, depth)
        x, z = rng.uniform(room[0], room[2]), rng.uniform(room[1], room[3])
        place = (x - reach, z - reach, x + reach, z + reach)
        if _is_free(place, occupied, room):
            occupied.append(place)
            piece(Place(builder, x, z, rng.uniform(0, 2 * np.pi)), rng, width, depth)


def _add_rug(builder: SceneBuilder, room: Rectangle) -> None:
    rng = builder.rng
    width, depth = (rng.uniform(0.3, 0.7) * (room[k + 2] - room[k]) for k in (0, 1))
    size = rng.uniform(0.04, 0.15)
    colors = [materials.random_color(rng) for _ in range(3)]
    material = builder.add_material(Pattern.RUG, *colors, size=size, mottle=0.4)
    x, z = (room[0] + room[2]) / 2, (room[1] + room[3]) / 2
    builder.add_box((x, -0.008, z), (width / 2, 0.008, depth / 2), material)


def _decorate_walls(builder: SceneBuilder, plan: Plan, room: Rectangle, height: float) -> None:
    """Add pictures and curtains to the walls."""
    rng = builder.rng
    for side in sides(room):
        axis, at, start, end, sign = side
        holes = holes_of_side(plan, side)
        inner = at - sign * (0.0 if abs(at) >= max(map(abs, plan.whole)) - 1e-9 else INNER / 2)
        for _ in range(rng.integers(0, 4)):
            width, high = rng.uniform(0.2, 1.2), rng.uniform(0.2, 0.9)
            if end - start < width + 0.4:
                continue
            along = rng.uniform(start + width / 2 + 0.15, end - width / 2 - 0.15)
            if any(hole.start - width / 2 - 0.1 < along < hole.end + width / 2 + 0.1 for hole in holes):
                continue
            holes.append(Hole(along - width / 2, along + width / 2, 1, 2))
            rise = -rng.uniform(1.3, min(1.9, height - high / 2 - 0.1))
            frame = materials.wood(builder) if rng.random() < 0.5 else materials.plain(builder)
            for material, grow, thick in (
                (frame, rng.uniform(0.0, 0.06), 0.02),
                (materials.picture(builder), 0.0, 0.025),
            ):
                _add_wall_box(builder, axis, inner, along, rise, (width / 2 + grow, high / 2 + grow, thick), material)
        for hole in holes_of_side(plan, side):
            if hole.low > 0 and rng.random() < 0.4:
                cloth, width = materials.fabric(builder), rng.uniform(0.1, 0.25)
                for along in (hole.start - width, hole.end + width):
                    if start + width < along < end - width:
                        _add_wall_box(builder, axis, inner - sign * 0.05, along, -1.15, (width, 1.1, 0.04), cloth)


def _add_wall_box(
    builder: SceneBuilder, axis: int, at: float, along: float, y: float, half: tuple[float, float, float], material: int
) -> None:
    """Add a box along a wall; `half` is half its width, height and thickness, metres."""
    width, high, thick = half
    if axis == 0:
        builder.add_box((at, y, along), (thick, high, width), material)
    else:
        builder.add_box((along, y, at), (width, high, thick), material)
