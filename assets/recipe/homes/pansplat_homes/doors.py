"""Walls with holes, and what fills the holes: casings, door leaves, window frames, blinds and curtains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pansplat_homes import materials
from pansplat_homes.plans import INNER, OUTER, OUTSIDE, Hole, HoleKind, Plan, RoomKind, Wall
from pansplat_homes.raytracer import WALL
from pansplat_homes.scene import SceneBuilder
from pansplat_homes.textures import Pattern

LINING = 0.012  # thickness of the boards in a door hole, metres
_LEAF = 0.046  # thickness of a door leaf, metres; the light of each face is that of its own side of the wall


@dataclass(frozen=True)
class Leaf:
    """A hinged door leaf.

    Attributes:
        hinge: coordinate of the hinge along the wall, metres.
        towards: sign of the direction from the hinge to the handle when the door is closed.
        side: sign of the side of the wall to which the door opens.
        largest: largest angle, radians.
        slides: whether it moves along the wall instead.
    """

    wall: Wall
    hole: Hole
    hinge: float
    towards: int
    side: int
    width: float
    largest: float
    slides: bool = False


@dataclass(frozen=True)
class DoorStyle:
    """Materials and shape of the doors of a home.

    Attributes:
        panels: rows and columns of raised panels, or of none.
        casing: width of the boards around holes, metres; 0 for none.
        has_glass: whether windows have panes, which reflect.
        sliding: material of sliding doors.
        curtains: share of the windows with curtains.
    """

    trim: int
    leaf: int
    knob: int
    panels: tuple[int, int]
    casing: float
    has_glass: bool
    sliding: int
    curtains: float


def add_wall_box(
    builder: SceneBuilder,
    wall: Wall,
    along: tuple[float, float],
    rise: tuple[float, float],
    across: tuple[float, float],
    material: int,
) -> None:
    """Add a box by its extents along a wall, above the floor, and across the plane of the wall in any order, metres."""
    if along[1] - along[0] < 1e-6 or rise[1] - rise[0] < 1e-6:
        return
    x, z = wall.point((along[0] + along[1]) / 2, (across[0] + across[1]) / 2)
    thick, wide = abs(across[1] - across[0]) / 2, (along[1] - along[0]) / 2
    half = (thick, wide) if wall.axis == 0 else (wide, thick)
    builder.add_box((x, -(rise[0] + rise[1]) / 2, z), (half[0], (rise[1] - rise[0]) / 2, half[1]), material)


def extent_across(wall: Wall) -> tuple[float, float]:
    """The faces of a wall, relative to its plane."""
    if not wall.is_outer:
        return -INNER / 2, INNER / 2
    return (-OUTER, 0.0) if wall.rooms[0] == OUTSIDE else (0.0, OUTER)


def add_wall(builder: SceneBuilder, plan: Plan, wall: Wall, top: float) -> None:
    """Add the parts of a wall around its holes, up to `top` metres."""
    across = extent_across(wall)
    at, end = wall.start - _extension(plan, wall, -1), wall.end + _extension(plan, wall, 1)
    for hole in sorted(wall.holes, key=lambda hole: hole.start):
        if at < hole.start and not (hole.top == np.inf and hole.start == wall.start):
            add_wall_box(builder, wall, (at, hole.start), (0, top), across, WALL)
        add_wall_box(builder, wall, (hole.start, hole.end), (min(hole.top, top), top), across, WALL)
        add_wall_box(builder, wall, (hole.start, hole.end), (0, hole.low), across, WALL)
        at = hole.end
    if at < wall.end:
        add_wall_box(builder, wall, (at, end), (0, top), across, WALL)


def _extension(plan: Plan, wall: Wall, sign: int) -> float:
    """Metres by which a wall continues at its start (-1) or end (1) to close a corner."""
    if not wall.is_outer:
        return INNER / 2 - 1e-3
    end = wall.start if sign < 0 else wall.end
    low, high = extent_across(wall)
    return OUTER if plan.room_at(*wall.point(end + 0.1 * sign, (low + high) / 2)) == OUTSIDE else 0.0


def add_casing(builder: SceneBuilder, wall: Wall, hole: Hole, style: DoorStyle, wide: float) -> None:
    """Add boards around a hole, `wide` metres on the wall, which also line the hole."""
    low, high = extent_across(wall)
    if wall.rooms[0] != OUTSIDE:
        low -= 0.015
    if wall.rooms[1] != OUTSIDE:
        high += 0.015
    if wall.is_outer:  # the frame is at the outer face
        low, high = (-0.2, high) if wall.rooms[0] == OUTSIDE else (low, 0.2)
    bottom = max(0.0, hole.low - wide)
    for inner, outer in ((hole.start + LINING, hole.start - wide), (hole.end - LINING, hole.end + wide)):
        along = (min(inner, outer), max(inner, outer))
        add_wall_box(builder, wall, along, (bottom, hole.top + wide), (low, high), style.trim)
    span = (hole.start + LINING, hole.end - LINING)
    add_wall_box(builder, wall, span, (hole.top - LINING, hole.top + wide), (low, high), style.trim)
    if hole.low > 0:
        add_wall_box(builder, wall, span, (bottom, hole.low + LINING), (low, high), style.trim)


def plan_leaves(plan: Plan, wall: Wall, hole: Hole, rng: np.random.Generator) -> list[Leaf]:
    """The leaves of a door between rooms; it opens into bedrooms and bathrooms, and out of closets."""
    kinds = [plan.rooms[i].kind for i in wall.rooms]
    side = 1 if rng.random() < 0.5 else -1
    if RoomKind.CLOSET in kinds:
        side = 1 if kinds[0] == RoomKind.CLOSET else -1
    elif RoomKind.HALL in kinds and kinds[0] != kinds[1]:
        side = 1 if kinds[0] == RoomKind.HALL else -1
    x0, z0, x1, z1 = plan.interior(wall.rooms[1 if side > 0 else 0])
    (low, high), depth = ((z0, z1), x1 - x0) if wall.axis == 0 else ((x0, x1), z1 - z0)
    clear = hole.width - 2 * LINING - 0.004
    ends = [(hole.start + LINING + 0.002, 1), (hole.end - LINING - 0.002, -1)]
    if RoomKind.CLOSET in kinds and clear > 1.2 and rng.random() < 0.45:
        return [Leaf(wall, hole, hinge, towards, side, 0.52 * clear, np.pi / 2, True) for hinge, towards in ends]
    if clear < 1.1:
        # The hinge is at the end nearer to a corner, mostly.
        nearer = hole.start - low < high - hole.end
        ends = ends[:1] if nearer == bool(rng.random() < 0.85) else ends[1:]
    leaves = []
    for hinge, towards in ends:
        width = clear / len(ends)
        beside = (hinge - low if towards > 0 else high - hinge) - 0.04
        largest = np.pi - np.arccos(np.clip(beside / width, 0, 0.96))
        if depth < width + 0.1:
            largest = np.arcsin((depth - 0.1) / width)
        leaves.append(Leaf(wall, hole, hinge, towards, side, width, float(largest)))
    return leaves


def add_leaf(builder: SceneBuilder, leaf: Leaf, angle: float, style: DoorStyle) -> None:
    """Add a door leaf at an angle, radians; 0 is closed. Sliding leaves are closed at 0 and open at pi / 2."""
    shift, slide = 0.0, 0.0
    if leaf.slides:  # two panels behind each other, of which the first moves
        shift = -leaf.side * (0.005 if leaf.towards > 0 else 0.06)
        slide = (leaf.hole.width - leaf.width - 2 * LINING) * angle / leaf.largest if leaf.towards > 0 else 0.0
        angle = 0.0
    cos, sin = np.cos(angle), np.sin(angle)
    along, normal = leaf.towards, leaf.side

    def point(out: float, thick: float) -> tuple[float, float]:
        """World x and z at a distance from the hinge and a depth behind the leaf's face."""
        return leaf.wall.point(
            leaf.hinge + along * (cos * out + sin * thick + slide),
            normal * (INNER / 2 + sin * out - cos * thick) + shift,
        )

    (x0, z0), (x1, z1) = point(0.0, 0.0), point(1.0, 0.0)
    yaw = float(np.arctan2(-(z1 - z0), x1 - x0))
    high = leaf.hole.top - LINING - 0.005

    def add(start: float, end: float, low: float, top: float, thick: float, material: int) -> None:
        x, z = point((start + end) / 2, _LEAF / 2)
        builder.add_box((x, -(low + top) / 2, z), ((end - start) / 2, (top - low) / 2, thick / 2), material, yaw)

    if leaf.slides:
        add(0.0, leaf.width, 0.008, high, _LEAF, style.leaf)
        add(0.05, leaf.width - 0.05, 0.06, high - 0.05, _LEAF + 0.006, style.sliding)
        return
    add(0.0, leaf.width, 0.008, high, _LEAF, style.leaf)
    rows, columns = style.panels
    if leaf.width < 0.5:
        columns = min(columns, 1)
    for row in range(rows):
        for column in range(columns):
            wide, tall = (leaf.width - 0.1) / columns, (high - 0.2) / rows
            start, low = 0.05 + column * wide, 0.12 + row * tall
            add(start + 0.04, start + wide - 0.04, low + 0.04, low + tall - 0.04, _LEAF + 0.014, style.leaf)
    for depth in (-0.04, _LEAF + 0.04):
        x, z = point(leaf.width - 0.06, depth)
        builder.add_ellipsoid((x, -1.0, z), (0.03, 0.03, 0.03), style.knob)
    x, z = point(leaf.width - 0.06, _LEAF / 2)
    builder.add_box((x, -1.0, z), (0.012, 0.012, _LEAF / 2 + 0.03), style.knob, yaw)


def add_window(builder: SceneBuilder, wall: Wall, hole: Hole, style: DoorStyle, rng: np.random.Generator) -> None:
    """Add the casing, frame and bars of a window or patio door, and perhaps a blind or curtains."""
    sign = -1 if wall.rooms[0] == OUTSIDE else 1
    frame = materials.frame(builder)
    cased = style.casing > 0 and rng.random() < 0.8
    if cased:
        add_casing(builder, wall, hole, style, style.casing)
    elif hole.low > 0:
        along, rise = (hole.start - 0.02, hole.end + 0.02), (hole.low, hole.low + 0.02)
        add_wall_box(builder, wall, along, rise, (-sign * 0.03, sign * 0.15), style.trim)
    middle = (sign * 0.13, sign * 0.19)
    bar = rng.uniform(0.025, 0.05)
    columns = int(rng.integers(2, 4)) if hole.width > 1.1 else 1 + int(rng.random() < 0.3)
    for k in range(columns + 1):
        at = hole.start + (hole.width - bar) * k / columns
        add_wall_box(builder, wall, (at, at + bar), (hole.low, hole.top), middle, frame)
    rises = [hole.low, hole.top - bar]
    if hole.kind == HoleKind.WINDOW and rng.random() < 0.4:
        rises.append(hole.low + rng.uniform(0.4, 0.6) * (hole.top - hole.low))
    for rise in rises:
        add_wall_box(builder, wall, (hole.start, hole.end), (rise, rise + bar), middle, frame)
    if style.has_glass:
        x, z = wall.point(hole.middle, sign * 0.16)
        half = (0.003, hole.width / 2) if wall.axis == 0 else (hole.width / 2, 0.003)
        builder.add_glass((x, -(hole.low + hole.top) / 2, z), (half[0], (hole.top - hole.low) / 2, half[1]))
    _add_shade(builder, wall, hole, sign, style.curtains)


def _add_shade(builder: SceneBuilder, wall: Wall, hole: Hole, sign: int, curtains: float) -> None:
    rng = builder.rng
    kind = rng.random()
    high, span = hole.top - hole.low, (hole.start + 0.02, hole.end - 0.02)
    if kind < 0.18:  # slats
        material, pitch = materials.trim(builder), rng.uniform(0.035, 0.06)
        bottom = hole.low + (0.0 if rng.random() < 0.6 else rng.uniform(0.3, 0.8) * high)
        for rise in np.arange(bottom + 0.03, hole.top - 0.02, pitch):
            add_wall_box(builder, wall, span, (rise, rise + 0.004), (sign * 0.06, sign * 0.095), material)
    elif kind < 0.3:  # a roller blind
        material = materials.trim(builder)
        drop = rng.uniform(0.1, 0.9) * high
        add_wall_box(builder, wall, span, (hole.top - drop, hole.top), (sign * 0.05, sign * 0.06), material)
    elif kind < 0.3 + curtains:  # curtains beside the window, with folds
        cloth, rod = materials.fabric(builder), materials.metal(builder)
        width, low = rng.uniform(0.15, 0.35), 0.04 if rng.random() < 0.7 else max(0.0, hole.low - 0.2)
        top = hole.top + 0.12
        for end, out in ((hole.start, -1), (hole.end, 1)):
            inner, outer = end - 0.3 * out * width, end + 0.7 * out * width
            if min(inner, outer) < wall.start + 0.08 or max(inner, outer) > wall.end - 0.08:
                continue
            for k, at in enumerate(np.linspace(min(inner, outer), max(inner, outer), 5)[:-1]):
                away = 0.07 + 0.02 * (k % 2)
                x, z = wall.point(at + width / 8, -sign * away)
                builder.add_cylinder((x, -(low + top) / 2, z), width / 7, (top - low) / 2, cloth)
        span = (hole.start - width, hole.end + width)
        add_wall_box(builder, wall, span, (top, top + 0.025), (-sign * 0.06, -sign * 0.085), rod)


def add_entrance(builder: SceneBuilder, wall: Wall, hole: Hole, style: DoorStyle) -> None:
    """Add the closed door of a home."""
    rng, sign = builder.rng, -1 if wall.rooms[0] == OUTSIDE else 1
    leaf = style.leaf if rng.random() < 0.5 else materials.trim(builder)
    add_wall_box(builder, wall, (hole.start, hole.end), (0.0, hole.top), (sign * 0.03, sign * 0.08), leaf)
    glass = builder.add_material(Pattern.STONE, (0.6, 0.65, 0.7), (0.9, 0.9, 0.95), size=0.15, fraction=0, glow=0.6)
    across = (sign * 0.02, sign * 0.05)
    rows, columns = (3, 2) if rng.random() < 0.7 else (2, 1)
    wide, tall = (hole.width - 0.16) / columns, (hole.top - 0.2) / rows
    for row in range(rows):
        for column in range(columns):
            start, low = hole.start + 0.08 + column * wide, 0.12 + row * tall
            material = glass if row == rows - 1 and rng.random() < 0.3 else leaf
            along, rise = (start + 0.05, start + wide - 0.05), (low + 0.05, low + tall - 0.05)
            add_wall_box(builder, wall, along, rise, across, material)
    x, z = wall.point(hole.start + 0.07 if rng.random() < 0.5 else hole.end - 0.07, -sign * 0.01)
    for up in (1.0, 1.15):
        builder.add_ellipsoid((x, -up, z), (0.03, 0.03, 0.04), style.knob)
