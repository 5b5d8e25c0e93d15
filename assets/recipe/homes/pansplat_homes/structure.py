"""What shapes rooms beside their walls: slopes, soffits and beams of ceilings, pillars, stairs to another floor."""

from __future__ import annotations

import numpy as np

from pansplat_homes import materials
from pansplat_homes.furniture import Place
from pansplat_homes.plans import HoleKind, Plan, Rectangle, RoomKind, Side
from pansplat_homes.raytracer import CEILING, WALL
from pansplat_homes.scene import SceneBuilder

_HEADROOM = 2.05  # above the steps of a flight, metres
_SHAFT = 2.2  # height of a stair well above the ceiling, metres


def drop_windows_under_slopes(plan: Plan, axis: int) -> None:
    """Remove the windows of all outer walls across an axis."""
    for wall in plan.walls:
        if wall.is_outer and wall.axis == axis:
            wall.holes = [hole for hole in wall.holes if hole.kind == HoleKind.ENTRANCE]


def add_ceiling(
    builder: SceneBuilder, plan: Plan, index: int, height: float, top: float, well: Rectangle | None
) -> None:
    """Add the ceiling of a room, with a hole and the walls of a shaft if there is a stair well."""
    x0, z0, x1, z1 = plan.rooms[index].corners
    pieces = [(x0, z0, x1, z1)]
    if well is not None:
        a0, b0, a1, b1 = well
        pieces = [(x0, z0, a0, z1), (a1, z0, x1, z1), (a0, z0, a1, b0), (a0, b1, a1, z1)]
    for p0, q0, p1, q1 in pieces:
        if p1 - p0 > 1e-6 and q1 - q0 > 1e-6:
            centre = ((p0 + p1) / 2, -(height + top + 0.2) / 2, (q0 + q1) / 2)
            builder.add_box(centre, ((p1 - p0) / 2, (top + 0.2 - height) / 2, (q1 - q0) / 2), CEILING)
    if well is not None:
        a0, b0, a1, b1 = well
        x, z, low, end = (a0 + a1) / 2, (b0 + b1) / 2, height + 0.02, height + 0.4 + _SHAFT
        y, half = -(low + end) / 2, (end - low) / 2
        builder.add_box((x, -end, z), ((a1 - a0) / 2 + 0.1, 0.05, (b1 - b0) / 2 + 0.1), CEILING)
        for sign in (-1, 1):
            across, along = x + sign * ((a1 - a0) / 2 + 0.05), z + sign * ((b1 - b0) / 2 + 0.05)
            builder.add_box((across, y, z), (0.0495, half, (b1 - b0) / 2 + 0.09), WALL)
            builder.add_box((x, y, along), ((a1 - a0) / 2 + 0.09, half, 0.0495), WALL)


def add_structure(builder: SceneBuilder, plan: Plan, index: int, height: float, occupied: list[Rectangle]) -> None:
    """Add a pillar or chimney in a corner, a soffit, or beams to some rooms."""
    rng, room = builder.rng, plan.rooms[index]
    if room.kind in (RoomKind.CLOSET, RoomKind.ALCOVE) or room.area < 5:
        return
    sides = plan.sides(index)
    if rng.random() < 0.2:
        side = sides[rng.integers(4)]
        wide, deep = rng.uniform(0.25, 0.9), rng.uniform(0.15, 0.6)
        spans = [(a, b) for a, b in side.free_spans(height, deep, occupied) if b - a > wide]
        ends = [at for a, b in spans for at, end in ((a, a), (b - wide, b)) if end in (side.start, side.end)]
        other = {s.outward: s for s in sides if s.axis != side.axis}
        for at in ends[:1]:
            across = other[-1 if at < (side.start + side.end) / 2 else 1]
            area = side.area(at, at + wide, deep)
            low, high = (area[1], area[3]) if across.axis == 0 else (area[0], area[2])
            if all(hole.start > high + 0.1 or hole.end < low - 0.1 for hole in across.holes):
                occupied.append(area)
                centre = ((area[0] + area[2]) / 2, -height / 2, (area[1] + area[3]) / 2)
                builder.add_box(centre, ((area[2] - area[0]) / 2, height / 2, (area[3] - area[1]) / 2), WALL)
    kind = rng.random()
    if kind < 0.14:
        side = sides[rng.integers(4)]
        wide, tall = rng.uniform(0.25, 0.7), rng.uniform(0.2, max(0.21, min(0.4, height - 2.1)))
        if all(hole.top < height - tall for hole in side.holes):
            area = side.area(side.start, side.end, wide)
            centre = ((area[0] + area[2]) / 2, -height + tall / 2, (area[1] + area[3]) / 2)
            builder.add_box(centre, ((area[2] - area[0]) / 2, tall / 2, (area[3] - area[1]) / 2), CEILING)
    elif kind < 0.18:
        x0, z0, x1, z1 = plan.interior(index)
        beam, tall = materials.wood(builder), rng.uniform(0.08, 0.2)
        for at in np.arange(x0 + 0.5, x1 - 0.3, rng.uniform(0.7, 1.4)):
            builder.add_box((at, -height + tall / 2, (z0 + z1) / 2), (0.06, tall / 2, (z1 - z0) / 2), beam)


def add_slopes(builder: SceneBuilder, plan: Plan, index: int, height: float, axis: int, knee: float) -> None:
    """Add sloped ceilings above the outer sides of a room that are across an axis; they begin at `knee` metres."""
    interior = plan.interior(index)
    extent = interior[2] - interior[0] if axis == 0 else interior[3] - interior[1]
    for side in plan.sides(index):
        if side.axis != axis or not side.is_outer or side.holes:
            continue
        reach = min((height - knee) / np.tan(np.radians(45)), 0.38 * extent)
        angle = float(np.arctan2(height - knee, reach))
        length = float(np.hypot(height - knee, reach)) + 0.3
        # The slab's lower face joins the wall at the knee and the ceiling.
        away, up = reach / 2 - 0.04 * np.sin(angle), (height + knee) / 2 + 0.04 * np.cos(angle)
        (x, z), (bx, bz) = side.point((side.start + side.end) / 2, away), side.point((side.start + side.end) / 2, 9.0)
        yaw = float(np.arctan2(bx - x, bz - z))
        builder.add_box((x, -up, z), (side.length / 2 + 0.03, 0.04, length / 2), CEILING, yaw, angle)


def plan_stairs(
    plan: Plan, index: int, height: float, occupied: list[Rectangle], rng: np.random.Generator
) -> tuple[Side, float, float, float, Rectangle] | None:
    """A flight along a wall: its side, lower and upper end along it, width and stair well; None without space."""
    width, run = rng.uniform(0.8, 1.0), rng.uniform(0.22, 0.27)
    length = run * round(height / 0.19)
    for side in plan.sides(index):
        other = next(s for s in plan.sides(index) if s.axis != side.axis)
        for low, end in side.free_spans(3.0, width + 0.05, occupied):
            if end - low < length + 0.7 or other.length < width + 1.0:
                continue
            lower, upper = (low + 0.7, low + 0.7 + length) if rng.random() < 0.5 else (end - 0.7, end - 0.7 - length)
            start = lower + (upper - lower) * max(0.0, (height + 0.3 - _HEADROOM - 0.19) / height)
            well = side.area(min(start, upper), max(start, upper), width)
            occupied.append(side.area(min(lower, upper) - 0.7, max(lower, upper) + 0.7, width + 0.1))
            return side, lower, upper, width, well
    return None


def add_stairs(
    builder: SceneBuilder, side: Side, lower: float, upper: float, width: float, height: float, looks: tuple[int, int]
) -> None:
    """Add a flight of stairs with a balustrade; `looks` are the materials of steps and posts."""
    rng, (steps, posts) = builder.rng, looks
    count = round(height / 0.19)
    rise, run = height / count, abs(upper - lower) / count
    sign = 1 if upper > lower else -1
    riser = materials.paint(builder, (0.8, 0.8, 0.78)) if rng.random() < 0.5 else steps
    for k in range(count):
        x, z = side.point(lower + sign * (k + 0.5) * run, width / 2)
        half = (width / 2, run / 2) if side.axis == 0 else (run / 2, width / 2)
        top = (k + 1) * rise
        builder.add_box((x, -(top - 0.03) / 2, z), (half[0], (top - 0.03) / 2, half[1]), riser)
        x, z = side.point(lower + sign * ((k + 0.5) * run - 0.01), width / 2 + 0.01)
        half = (width / 2 + 0.01, run / 2 + 0.01) if side.axis == 0 else (run / 2 + 0.01, width / 2 + 0.01)
        builder.add_box((x, -top + 0.015, z), (half[0], 0.015, half[1]), steps)
        if top < height - 0.9:
            for part in (0.25, 0.75):
                x, z = side.point(lower + sign * (k + part) * run, width - 0.04)
                builder.add_box((x, -top - 0.43 - (part - 0.5) * rise / 2, z), (0.015, 0.45, 0.015), posts)
    ends = [
        side.point(lower, width - 0.04),
        side.point(lower + sign * run * max(1, int((height - 0.9) / rise)), width - 0.04),
    ]
    top = rise * max(1, int((height - 0.9) / rise))
    (x0, z0), (x1, z1) = ends
    length, yaw = float(np.hypot(x1 - x0, z1 - z0)), float(np.arctan2(x1 - x0, z1 - z0))
    centre = ((x0 + x1) / 2, -(top / 2 + 0.95), (z0 + z1) / 2)
    builder.add_box(centre, (0.03, 0.02, np.hypot(length, top) / 2), steps, yaw, float(np.arctan2(top, length)))
    Place(builder, x0, z0, 0.0).add_box(0, 0.55, 0, 0.09, 1.1, 0.09, steps)
