"""What is fixed in homes: ceiling lamps, kitchens, bathrooms, shelves of closets, fireplaces, outlets and vents."""

from __future__ import annotations

import numpy as np

from pansplat_homes import materials
from pansplat_homes.furniture import Place, add_fixture, clutter
from pansplat_homes.plans import Plan, Rectangle, RoomKind, Side, overlaps
from pansplat_homes.scene import SceneBuilder
from pansplat_homes.textures import Pattern

Position = tuple[float, float, float]


def add_ceiling_lamp(
    builder: SceneBuilder, plan: Plan, index: int, height: float, share: float, occupied: list[Rectangle]
) -> list[tuple[int, Position]]:
    """Add a room's lamp; the room and the position of its light if it is on.

    Args:
        share: probability that it is on.
        occupied: gets the place under low lamps.
    """
    rng, room = builder.rng, plan.rooms[index]
    if room.kind == RoomKind.ALCOVE or (room.kind == RoomKind.CLOSET and rng.random() < 0.7):
        return []
    x0, z0, x1, z1 = plan.interior(index)
    small = min(x1 - x0, z1 - z0)
    x, z = (x0 + x1) / 2 + rng.uniform(-0.1, 0.1) * (x1 - x0), (z0 + z1) / 2 + rng.uniform(-0.1, 0.1) * (z1 - z0)
    is_on = rng.random() < share
    white = (0.9, rng.uniform(0.8, 0.9), rng.uniform(0.6, 0.9))
    shade = builder.add_material(Pattern.PLAIN, white, mottle=0.05, glow=rng.uniform(1.5, 5.0) if is_on else 0.0)
    metal = materials.metal(builder) if rng.random() < 0.7 else materials.trim(builder)
    is_large = room.kind in (RoomKind.LIVING, RoomKind.DINING, RoomKind.BEDROOM) and small > 2.2
    kind = rng.choice(5, p=(0.3, 0.2, 0.15, 0.15, 0.2) if is_large else (0.65, 0.1, 0.0, 0.0, 0.25))
    drop = 0.12
    if kind == 0:  # a flat bowl
        radius = rng.uniform(0.12, 0.22)
        builder.add_cylinder((x, -height + 0.02, z), radius * 1.05, 0.02, metal)
        builder.add_ellipsoid((x, -height + 0.04, z), (radius, 0.08, radius), shade)
        drop = 0.2
    elif kind == 1:  # a pendant
        length, size = rng.uniform(0.15, max(0.16, min(0.8, height - 2.05))), rng.uniform(0.1, 0.22)
        builder.add_cylinder((x, -height + length / 2, z), 0.006, length / 2, metal)
        builder.add_ellipsoid((x, -height + length + size * 0.5, z), (size, size * rng.uniform(0.5, 1), size), shade)
        drop = length + 0.5 * size
        occupied.append((x - 0.2, z - 0.2, x + 0.2, z + 0.2))
    elif kind == 2:  # a chandelier
        length, reach = rng.uniform(0.3, max(0.31, min(0.7, height - 1.95))), rng.uniform(0.2, 0.35)
        builder.add_cylinder((x, -height + length / 2, z), 0.012, length / 2, metal)
        builder.add_ellipsoid((x, -height + length, z), (0.05, 0.09, 0.05), metal)
        for k in range(5):
            turn = 2 * np.pi * k / 5
            dx, dz = reach * np.cos(turn), reach * np.sin(turn)
            builder.add_box((x + dx / 2, -height + length, z + dz / 2), (reach / 2, 0.008, 0.008), metal, -turn)
            builder.add_ellipsoid((x + dx, -height + length - 0.06, z + dz), (0.055, 0.07, 0.055), shade)
        drop = length + 0.1
    elif kind == 3:  # a fan
        count, turn, length = int(rng.integers(4, 6)), rng.uniform(0, 2), rng.uniform(0.15, 0.3)
        builder.add_cylinder((x, -height + length / 2, z), 0.02, length / 2, metal)
        builder.add_cylinder((x, -height + length, z), 0.09, 0.06, metal)
        builder.add_ellipsoid((x, -height + length + 0.1, z), (0.1, 0.06, 0.1), shade)
        blade = materials.trim(builder) if rng.random() < 0.5 else materials.wood(builder)
        for k in range(count):
            around = turn + 2 * np.pi * k / count
            dx, dz = 0.36 * np.cos(around), 0.36 * np.sin(around)
            builder.add_box((x + dx, -height + length, z + dz), (0.27, 0.006, 0.065), blade, -around)
        drop = length + 0.2
    else:  # spots in the ceiling
        for px in np.linspace(x0, x1, max(1, round((x1 - x0) / 1.6)) + 2)[1:-1]:
            for pz in np.linspace(z0, z1, max(1, round((z1 - z0) / 1.6)) + 2)[1:-1]:
                builder.add_cylinder((px, -height, pz), 0.07, 0.006, shade)
    return [(index, (x, -height + drop, z))] if is_on else []


def add_fixtures(
    builder: SceneBuilder, plan: Plan, index: int, height: float, occupied: list[Rectangle], trim: int, is_bare: bool
) -> None:
    """Add what is built into a room of its kind; `occupied` gets the floor that it covers.

    Args:
        is_bare: whether counters, rails and shelves are empty.
    """
    rng, kind, sides = builder.rng, plan.rooms[index].kind, plan.sides(index)
    if kind == RoomKind.KITCHEN:
        _add_kitchen(builder, sides, plan.interior(index), height, occupied, is_bare)
    elif kind == RoomKind.BATHROOM:
        _add_bathroom(builder, sides, occupied, is_bare)
    elif kind == RoomKind.CLOSET:
        _add_closet(builder, sides, occupied, trim, is_bare)
    elif kind == RoomKind.UTILITY:
        _add_machines(builder, sides, occupied)
    elif kind == RoomKind.LIVING and rng.random() < 0.25:
        _add_fireplace(builder, sides, height, occupied)


def _longest_spans(
    sides: list[Side], height: float, depth: float, least: float, occupied: list[Rectangle]
) -> list[tuple[Side, float, float]]:
    """Free parts of walls of at least that length, metres, the longest first."""
    spans = [(s, a, b) for s in sides for a, b in s.free_spans(height, depth, occupied) if b - a >= least]
    return sorted(spans, key=lambda span: span[1] - span[2])


def _front(
    place: Place, x: float, low: float, top: float, depth: float, width: float, material: int, knob: int
) -> None:
    """Add a front with a small gap around it, before a body of that depth, and its handle."""
    place.add_box(x, (low + top) / 2, -depth / 2, width - 0.012, top - low - 0.012, 0.03, material)
    if top - low > 0.3 and width > 0.25:  # a raised panel
        place.add_box(x, (low + top) / 2, -depth / 2, width - 0.13, top - low - 0.13, 0.042, material)
    up = top - 0.1 if low < 1 else low + 0.1
    if top - low < 0.3:
        place.add_box(x, (low + top) / 2, -depth / 2 - 0.025, min(0.12, width / 2), 0.012, 0.02, knob)
    else:
        place.add_box(x + width * 0.38, up, -depth / 2 - 0.025, 0.012, 0.1, 0.02, knob)


def _add_kitchen(
    builder: SceneBuilder,
    sides: list[Side],
    interior: Rectangle,
    height: float,
    occupied: list[Rectangle],
    is_bare: bool,
) -> None:
    rng = builder.rng
    if rng.random() < 0.45:
        front = materials.upright_wood(builder)
    else:
        front = materials.paint(
            builder, materials.paint_color(rng) if rng.random() < 0.75 else materials.random_color(rng)
        )
    top = materials.countertop(builder)
    steel, knob, black = (
        materials.metal(builder),
        materials.metal(builder),
        materials.paint(builder, (0.02, 0.02, 0.02)),
    )
    appliance = steel if rng.random() < 0.5 else materials.paint(builder, materials.grey((0.85, 0.03)[rng.integers(2)]))
    tiles = materials.wall_tiles(builder) if rng.random() < 0.6 else -1
    needed = ["fridge", "stove", "sink", "dishwasher"]
    if rng.random() < 0.2:
        needed.remove("fridge")
    for _ in range(int(rng.integers(1, 4))):
        spans = _longest_spans(sides, 0.95, 0.66, 1.0, occupied)
        if not spans:
            break
        side, start, end = spans[0]
        length = min(end - start, rng.uniform(1.8, 4.6))
        if rng.random() < 0.5:
            start = end - length
        end = start + length
        occupied.append(side.area(start, end, 0.66))
        at = start
        if "fridge" in needed and length > 2.0 and not any(h.start < start + 0.9 and h.end > start for h in side.holes):
            _add_fridge(Place(builder, *side.point(start + 0.42, 0.36), side.yaw), rng, appliance, knob)
            needed.remove("fridge")
            at = start + 0.84
        _add_counter(builder, side, (at, end), (front, top, knob), (appliance, steel, black), needed, tiles)
        if not is_bare and rng.random() < 0.5:
            place = Place(builder, *side.point((at + end) / 2, 0.31), side.yaw)
            clutter(place, rng, 0.92, end - at, 0.4, 6)
        for low, high in side.free_spans(2.1, 0.3, []):
            low, high = max(low, start), min(high, end)
            if high - low > 0.4 and rng.random() < 0.85:
                _add_upper_cabinets(builder, side, (low, high), front, knob, height)
    x0, z0, x1, z1 = interior
    if min(x1 - x0, z1 - z0) > 3.3 and rng.random() < 0.5:
        x, z, along_x = (x0 + x1) / 2, (z0 + z1) / 2, x1 - x0 > z1 - z0
        length = rng.uniform(1.0, min(2.2, max(x1 - x0, z1 - z0) - 2.2))
        place = Place(builder, x, z, 0.0 if along_x else np.pi / 2)
        area = (length / 2 + 0.1, 0.5) if along_x else (0.5, length / 2 + 0.1)
        if not overlaps((x - area[0], z - area[1], x + area[0], z + area[1]), occupied):
            occupied.append((x - area[0], z - area[1], x + area[0], z + area[1]))
            place.add_box(0, 0.44, 0, length, 0.88, 0.7, front)
            place.add_box(0, 0.9, 0, length + 0.1, 0.04, 0.9, top)
            count = max(1, round(length / 0.5))
            for k in range(count):
                _front(place, (k + 0.5) * length / count - length / 2, 0.1, 0.86, 0.7, length / count, front, knob)


def _add_counter(
    builder: SceneBuilder,
    side: Side,
    span: tuple[float, float],
    looks: tuple[int, int, int],
    machines: tuple[int, int, int],
    needed: list[str],
    tiles: int,
) -> None:
    """Add base cabinets with a counter, and what is still needed of stove, sink and dishwasher."""
    rng = builder.rng
    (front, top, knob), (appliance, steel, black) = looks, machines
    start, end = span
    count = max(1, round((end - start) / 0.58))
    width, middle = (end - start) / count, (start + end) / 2
    place = Place(builder, *side.point(middle, 0.31), side.yaw)
    place.add_box(0, 0.06, 0.03, end - start, 0.12, 0.54, black)
    place.add_box(0, 0.49, 0.0, end - start, 0.76, 0.58, front)
    windows = [hole.low for hole in side.holes if hole.start < end and hole.end > start]
    splash = min([1.4 if tiles >= 0 else 1.0, *windows]) - 0.92
    if splash > 0.04:
        place.add_box(0, 0.92 + splash / 2, 0.3, end - start, splash, 0.02, tiles if tiles >= 0 else top)
    kinds = [""] * count
    for name in ("stove", "sink", "dishwasher"):
        free = [k for k in range(count) if not kinds[k]]
        if name in needed and free and count > 1:
            kinds[free[rng.integers(len(free))]] = name
            needed.remove(name)
    for k, kind in enumerate(kinds):
        x = (k + 0.5) * width - (end - start) / 2
        if kind == "stove":
            place.add_box(x, 0.46, -0.01, width - 0.01, 0.9, 0.64, appliance)
            place.add_box(x, 0.915, -0.01, width - 0.02, 0.02, 0.6, black)
            place.add_box(x, 0.5, -0.335, width * 0.7, 0.3, 0.012, black)
            place.add_box(x, 0.74, -0.36, width * 0.8, 0.025, 0.025, steel)
            if rng.random() < 0.6:
                place.add_box(x, 1.0, 0.27, width - 0.01, 0.18, 0.06, appliance if rng.random() < 0.5 else black)
            for dx in (-0.25, 0.25):
                for dz in (-0.15, 0.12):
                    place.add_cylinder(x + dx * width, 0.93, dz - 0.01, 0.08, 0.008, steel)
            continue
        place.add_box(x, 0.9, -0.005, width, 0.04, 0.64, top)
        if kind == "dishwasher":
            place.add_box(x, 0.48, -0.3, width - 0.01, 0.74, 0.03, appliance)
            place.add_box(x, 0.78, -0.33, width * 0.8, 0.03, 0.025, steel)
            continue
        if kind == "sink":
            _add_sink(place, x, width, steel, black, rng)
        if rng.random() < 0.3 and kind == "":
            for low, high in ((0.12, 0.38), (0.38, 0.62), (0.62, 0.86)):
                _front(place, x, low, high, 0.58, width, front, knob)
        else:
            _front(place, x, 0.12, 0.68, 0.58, width, front, knob)
            _front(place, x, 0.68, 0.86, 0.58, width, front, knob)


def _add_sink(place: Place, x: float, width: float, steel: int, dark: int, rng: np.random.Generator) -> None:
    """Add a sink with a rim and a tap."""
    place.add_box(x, 0.922, 0, width * 0.9, 0.008, 0.46, steel)
    for dx in (-0.22, 0.22):
        place.add_box(x + dx * width, 0.9265, -0.02, width * 0.38, 0.004, 0.34, dark)
        place.add_ellipsoid(x + dx * width, 0.928, -0.02, width * 0.3, 0.006, 0.28, steel)
    high = rng.uniform(0.15, 0.35)
    place.add_cylinder(x, 0.92 + high / 2, 0.19, 0.015, high, steel)
    place.add_box(x, 0.92 + high, 0.1, 0.02, 0.02, 0.2, steel)


def _add_upper_cabinets(
    builder: SceneBuilder, side: Side, span: tuple[float, float], front: int, knob: int, height: float
) -> None:
    start, end = span
    count = max(1, round((end - start) / 0.5))
    width, low, top = (end - start) / count, 1.4, min(2.12, height - 0.1)
    place = Place(builder, *side.point((start + end) / 2, 0.165), side.yaw)
    place.add_box(0, (low + top) / 2, 0, end - start, top - low, 0.33, front)
    for k in range(count):
        _front(place, (k + 0.5) * width - (end - start) / 2, low, top, 0.33, width, front, knob)


def _add_fridge(place: Place, rng: np.random.Generator, material: int, knob: int) -> None:
    if add_fixture(place, "fridge", 0.84, 0.72):
        return
    high, split = rng.uniform(1.65, 1.85), rng.uniform(0.55, 0.75)
    place.add_box(0, high / 2, 0, 0.8, high, 0.66, material)
    for low, top in ((0.05, high * split), (high * split, high)):
        place.add_box(0, (low + top) / 2, -0.35, 0.79, top - low - 0.015, 0.05, material)
        place.add_box(-0.33, (low + top) / 2, -0.4, 0.025, 0.6 * (top - low), 0.03, knob)


def _add_bathroom(builder: SceneBuilder, sides: list[Side], occupied: list[Rectangle], is_bare: bool) -> None:
    rng = builder.rng
    white = materials.paint(builder, materials.grey(rng.uniform(0.75, 0.92)))
    steel, tiles = materials.metal(builder), materials.wall_tiles(builder)
    length = rng.uniform(1.45, 1.75)
    for least, is_shower in ((length, False), (0.85, True)):
        spans = _longest_spans(sides, 0.6, 0.75, least, occupied)
        if spans and (is_shower or rng.random() < 0.75):
            side, start, end = spans[rng.integers(len(spans))]
            at = start if rng.random() < 0.5 else end - least
            occupied.append(side.area(at, at + least, 0.78))
            _add_tub(builder, side, at, least, is_shower, (white, steel, tiles), is_bare)
            break
    spans = _longest_spans(sides, 0.8, 0.5, 0.65, occupied)
    if spans:
        side, start, end = spans[0]
        width = rng.uniform(0.6, min(1.5, end - start)) if end - start > 0.65 else 0.6
        at = rng.uniform(start, end - width)
        occupied.append(side.area(at, at + width, 0.7))
        _add_vanity(builder, side, at, width, white, steel)
    spans = _longest_spans(sides, 0.8, 0.7, 0.6, occupied)
    if spans:
        side, start, end = spans[rng.integers(len(spans))]
        at = rng.uniform(start, end - 0.5)
        occupied.append(side.area(at, at + 0.5, 0.75))
        place = Place(builder, *side.point(at + 0.25, 0.35), side.yaw)
        if not add_fixture(place, "toilet", 0.6, 0.7):
            place.add_box(0, 0.58, 0.25, 0.4, 0.36, 0.19, white)
            place.add_box(0, 0.78, 0.25, 0.43, 0.04, 0.21, white)
            place.add_box(0, 0.18, 0.02, 0.22, 0.36, 0.5, white)
            place.add_ellipsoid(0, 0.34, -0.08, 0.38, 0.26, 0.5, white)
            place.add_ellipsoid(0, 0.42, -0.08, 0.4, 0.05, 0.52, white)
    for side in sides:
        if rng.random() < 0.4 and side.length > 1.4:
            for low, high in side.free_spans(1.6, 0.1, occupied)[:1]:
                if high - low > 0.6:
                    x, z = side.point((low + high) / 2, 0.06)
                    place = Place(builder, x, z, side.yaw)
                    place.add_box(0, 1.25, 0, 0.5, 0.02, 0.02, steel)
                    if not is_bare and rng.random() < 0.5:
                        place.add_box(0, 1.0, -0.01, 0.35, 0.5, 0.03, materials.fabric(builder))


def _add_tub(
    builder: SceneBuilder,
    side: Side,
    at: float,
    length: float,
    is_shower: bool,
    looks: tuple[int, int, int],
    is_bare: bool,
) -> None:
    """Add a bathtub or a shower tray with tiled walls, a tap, and perhaps a curtain."""
    rng, (white, steel, tiles) = builder.rng, looks
    place = Place(builder, *side.point(at + length / 2, 0.375), side.yaw)
    high = 0.1 if is_shower else rng.uniform(0.38, 0.55)
    if is_shower or not add_fixture(place, "bath", length, 0.75):
        place.add_box(0, 0.05, 0, length, 0.1, 0.75, white)
        for x in (-length / 2 + 0.04, length / 2 - 0.04):
            place.add_box(x, high / 2, 0, 0.08, high, 0.75, white)
        for z in (-0.335, 0.335):
            place.add_box(0, high / 2, z, length, high, 0.08, white)
    top = rng.uniform(1.7, 2.2)
    tops = [hole.low - 0.02 for hole in side.holes if hole.start < at + length and hole.end > at]
    if min([top, *tops]) > high + 0.1:
        top = min([top, *tops])
        place.add_box(0, (high + top) / 2, 0.37, length, top - high, 0.012, tiles)
    end = 1 if rng.random() < 0.5 else -1
    place.add_cylinder(end * length * 0.4, 1.9, 0.33, 0.06, 0.03, steel)
    place.add_box(end * length * 0.4, 1.4, 0.36, 0.02, 1.0, 0.02, steel)
    place.add_ellipsoid(end * length * 0.4, 0.9, 0.35, 0.08, 0.08, 0.06, steel)
    if rng.random() < 0.3:
        x, z = side.point(at + length / 2, 0.73)
        half = (0.004, length / 2) if side.axis == 0 else (length / 2, 0.004)
        builder.add_glass((x, -(high + 1.9) / 2, z), (half[0], (1.9 - high) / 2, half[1]))
        for up in (high + 0.01, 1.9):
            place.add_box(0, up, -0.355, length, 0.03, 0.03, steel)
    elif rng.random() < 0.7:
        place.add_box(0, 2.0, -0.36, length, 0.025, 0.025, steel)
        if not is_bare and rng.random() < 0.7:
            cloth, wide = materials.fabric(builder), rng.uniform(0.2, 0.9) * length
            for k, x in enumerate(np.arange(0, wide, 0.07)):
                offset = end * (length / 2 - 0.03 - x)
                place.add_cylinder(offset, 1.1, -0.37 + 0.02 * (k % 2), 0.04, 1.75, cloth)


def _add_vanity(builder: SceneBuilder, side: Side, at: float, width: float, white: int, steel: int) -> None:
    rng = builder.rng
    front = (
        materials.upright_wood(builder) if rng.random() < 0.5 else materials.paint(builder, materials.paint_color(rng))
    )
    place = Place(builder, *side.point(at + width / 2, 0.25), side.yaw)
    upper = add_fixture(place, "washbasin", width, 0.5)
    if upper == 0:
        _add_cabinet_basin(place, width, front, white, steel)
    if upper < 1 and all(hole.low > 2.0 or hole.end < at or hole.start > at + width for hole in side.holes):
        mirror = materials.mirror(builder)
        high = rng.uniform(0.6, 1.05)
        place.add_box(0, 1.0 + high / 2, 0.245, width * rng.uniform(0.7, 1.0), high, 0.012, mirror)
        if rng.random() < 0.7:
            bulb = builder.add_material(Pattern.PLAIN, (0.9, 0.88, 0.8), mottle=0, glow=rng.uniform(0.0, 3.0))
            place.add_box(0, 1.1 + high, 0.22, min(width, 0.6), 0.08, 0.05, steel)
            for x in (-0.2, 0.0, 0.2):
                place.add_ellipsoid(x * min(width, 1), 1.1 + high, 0.16, 0.1, 0.1, 0.1, bulb)


def _add_cabinet_basin(place: Place, width: float, front: int, white: int, steel: int) -> None:
    """Add a column or a cabinet with one or two basins."""
    builder, rng = place.builder, place.builder.rng
    if rng.random() < 0.2:
        place.add_cylinder(0, 0.4, 0.05, 0.09, 0.8, white)
    else:
        place.add_box(0, 0.42, 0.01, width, 0.76, 0.46, front)
        count = max(1, round(width / 0.45))
        for k in range(count):
            _front(place, (k + 0.5) * width / count - width / 2, 0.08, 0.78, 0.45, width / count, front, steel)
    top = white if rng.random() < 0.6 else materials.countertop(builder)
    place.add_box(0, 0.83, 0, width, 0.05, 0.5, top)
    for x in (-width / 4, width / 4) if width > 1.2 else (0.0,):
        place.add_ellipsoid(x, 0.855, -0.02, 0.42, 0.03, 0.34, white)
        place.add_ellipsoid(x, 0.868, -0.02, 0.3, 0.015, 0.24, steel)
        place.add_cylinder(x, 0.92, 0.17, 0.014, 0.15, steel)
        place.add_box(x, 0.99, 0.11, 0.02, 0.02, 0.13, steel)


def _add_closet(builder: SceneBuilder, sides: list[Side], occupied: list[Rectangle], trim: int, is_bare: bool) -> None:
    """Shelves and a rail for clothes at the wall opposite to the door."""
    rng = builder.rng
    board = trim if rng.random() < 0.6 else materials.wood(builder)
    spans = _longest_spans(sides, 1.8, 0.3, 0.4, occupied)
    if not spans:
        return
    side, start, end = spans[0]
    length, depth = end - start, rng.uniform(0.28, 0.42)
    other = next(s for s in sides if s.axis != side.axis)
    depth = min(depth, 0.6 * other.length)
    place = Place(builder, *side.point((start + end) / 2, depth / 2), side.yaw)
    if rng.random() < 0.35:
        for up in np.arange(rng.uniform(0.3, 0.5), 2.1, rng.uniform(0.3, 0.45)):
            place.add_box(0, up, 0, length, 0.025, depth, board)
            if not is_bare and rng.random() < 0.5:
                clutter(place, rng, up + 0.0125, length * 0.9, depth * 0.5, 5)
        return
    up = rng.uniform(1.65, 1.9)
    if rng.random() < 0.4:  # a shelf of wire
        wire = materials.paint(builder, (0.85, 0.85, 0.85))
        for z in np.linspace(-depth / 2, depth / 2, 9):
            place.add_box(0, up, z, length, 0.006, 0.006, wire)
        place.add_box(0, up - 0.03, -depth / 2, length, 0.03, 0.006, wire)
    else:
        place.add_box(0, up, 0, length, 0.02, depth, board)
        place.add_box(0, up - 0.06, depth / 2 - 0.01, length, 0.09, 0.02, board)
    rail = materials.metal(builder)
    place.add_box(0, up - 0.09, -0.02, length, 0.028, 0.028, rail)
    if not is_bare and rng.random() < 0.45:
        for x in np.arange(-0.45 * length, rng.uniform(-0.4, 0.45) * length, rng.uniform(0.05, 0.12)):
            high = rng.uniform(0.6, 1.1)
            cloth = materials.fabric(builder)
            place.add_box(x, up - 0.14 - high / 2, 0, rng.uniform(0.03, 0.06), high, depth * 0.95, cloth)


def _add_machines(builder: SceneBuilder, sides: list[Side], occupied: list[Rectangle]) -> None:
    """A washing machine, a dryer and a water heater, some of them."""
    rng = builder.rng
    white, dark = materials.paint(builder, (0.85, 0.85, 0.86)), materials.paint(builder, (0.05, 0.05, 0.06))
    for _ in range(int(rng.integers(0, 3))):
        for side, start, _ in _longest_spans(sides, 1.0, 0.7, 0.68, occupied)[:1]:
            occupied.append(side.area(start, start + 0.68, 0.9))
            place = Place(builder, *side.point(start + 0.34, 0.35), side.yaw)
            if add_fixture(place, "washing machine", 0.68, 0.7):
                continue
            place.add_box(0, 0.45, 0, 0.64, 0.9, 0.64, white)
            place.add_box(0, 0.97, 0.25, 0.64, 0.14, 0.12, white)
            place.add_ellipsoid(0, 0.5, -0.32, 0.4, 0.4, 0.06, dark)
    if rng.random() < 0.4:
        for side, _, end in _longest_spans(sides, 1.6, 0.6, 0.6, occupied)[:1]:
            occupied.append(side.area(end - 0.6, end, 0.6))
            x, z = side.point(end - 0.32, 0.32)
            builder.add_cylinder((x, -0.8, z), 0.26, 0.75, white)
            builder.add_cylinder((x, -1.8, z), 0.05, 0.3, materials.metal(builder))


def _add_fireplace(builder: SceneBuilder, sides: list[Side], height: float, occupied: list[Rectangle]) -> None:
    rng = builder.rng
    width, depth = rng.uniform(1.2, 2.0), rng.uniform(0.25, 0.5)
    spans = _longest_spans(sides, height, depth, width + 0.2, occupied)
    if not spans:
        return
    side, start, end = spans[rng.integers(len(spans))]
    at = (start + end) / 2
    occupied.append(side.area(at - width / 2, at + width / 2, depth + 0.8))
    place = Place(builder, *side.point(at, depth / 2), side.yaw)
    stone = materials.stone_wall(builder)
    high = height if rng.random() < 0.5 else rng.uniform(1.1, 1.4)
    mouth, tall = 0.45 * width, rng.uniform(0.55, 0.75)
    pillar = (width - mouth) / 2
    for sign in (-1, 1):
        place.add_box(sign * (width - pillar) / 2, high / 2, 0, pillar, high, depth, stone)
    place.add_box(0, (high + tall) / 2, 0, mouth, high - tall, depth, stone)
    soot = materials.paint(builder, (0.02, 0.018, 0.016))
    place.add_box(0, tall / 2, depth / 2 - 0.01, mouth, tall, 0.02, soot)
    place.add_box(0, 0.03, -depth / 2 - 0.2, width, 0.06, 0.4, stone)
    shelf = materials.trim(builder) if rng.random() < 0.5 else materials.wood(builder)
    up = 1.25 if high > 1.5 else high + 0.03
    place.add_box(0, up, -0.06, width + 0.2, 0.06, depth + 0.14, shelf)


def add_details(
    builder: SceneBuilder,
    plan: Plan,
    index: int,
    height: float,
    furnishing: int,
    has_radiators: bool,
    fixed: list[Rectangle],
) -> None:
    """Add outlets, switches, vents, a smoke detector, radiators, and pictures in furnished homes.

    Args:
        fixed: floor that fixtures cover; no picture hangs above it.
    """
    rng, room = builder.rng, plan.rooms[index]
    if room.kind == RoomKind.CLOSET:
        return
    white = materials.paint(builder, materials.grey(rng.uniform(0.7, 0.9)))
    for side in plan.sides(index):
        spans = side.free_spans(1.4, 0.02, [])
        for _ in range(int(rng.integers(0, 3))):
            if spans:
                low, high = spans[rng.integers(len(spans))]
                place = Place(
                    builder, *side.point(rng.uniform(low + 0.05, max(high - 0.05, low + 0.05)), 0.0), side.yaw
                )
                place.add_box(0, rng.uniform(0.3, 0.42), 0, 0.07, 0.115, 0.016, white)
        for hole in side.holes:
            if hole.low == 0 and rng.random() < 0.5:
                along = hole.start - 0.2 if rng.random() < 0.5 else hole.end + 0.2
                if any(low < along - 0.06 and along + 0.06 < high for low, high in spans):
                    place = Place(builder, *side.point(along, 0.0), side.yaw)
                    place.add_box(0, 1.15, 0, rng.choice((0.07, 0.12)), 0.115, 0.016, white)
        if has_radiators:
            _add_radiator(builder, side, white)
        if furnishing:
            _hang_pictures(builder, side, height, furnishing, fixed)
    x0, z0, x1, z1 = plan.interior(index)
    if rng.random() < 0.5:
        vent = materials.metal(builder)
        side = plan.sides(index)[rng.integers(4)]
        x, z = side.point(rng.uniform(side.start + 0.3, max(side.end - 0.3, side.start + 0.3)), 0.25)
        Place(builder, x, z, side.yaw).add_box(0, 0.0, 0, 0.3, 0.012, 0.12, vent)
    if rng.random() < 0.4:
        x, z = rng.uniform(x0 + 0.3, max(x1 - 0.3, x0 + 0.3)), rng.uniform(z0 + 0.3, max(z1 - 0.3, z0 + 0.3))
        builder.add_cylinder((x, -height + 0.015, z), 0.065, 0.02, white)


def _add_radiator(builder: SceneBuilder, side: Side, white: int) -> None:
    """Add a radiator below the first window of a side."""
    for hole in side.holes[:1]:
        high = min(0.6, hole.low - 0.2)
        if high > 0.25:
            width = min(hole.width, builder.rng.uniform(0.6, 1.6))
            place = Place(builder, *side.point(hole.middle, 0.07), side.yaw)
            place.add_box(0, 0.12 + high / 2, 0, width, high, 0.06, white)
            for x in np.arange(-width / 2 + 0.03, width / 2, 0.06):
                place.add_box(x, 0.12 + high / 2, -0.035, 0.035, high - 0.04, 0.02, white)


def _hang_pictures(builder: SceneBuilder, side: Side, height: float, furnishing: int, fixed: list[Rectangle]) -> None:
    rng = builder.rng
    taken: list[tuple[float, float]] = []
    for _ in range(int(rng.integers(0, (1, 2, 3, 5)[furnishing]))):
        wide, high = rng.uniform(0.2, 1.2), rng.uniform(0.2, 0.9)
        spans = [(a, b) for a, b in side.free_spans(2.1, 0.05, fixed) if b - a > wide + 0.3]
        if not spans:
            continue
        low, end = spans[rng.integers(len(spans))]
        along = rng.uniform(low + wide / 2 + 0.1, end - wide / 2 - 0.1)
        if any(along - wide / 2 < b and along + wide / 2 > a for a, b in taken):
            continue
        taken.append((along - wide / 2 - 0.1, along + wide / 2 + 0.1))
        place = Place(builder, *side.point(along, 0.0), side.yaw)
        up = rng.uniform(1.4, max(1.41, min(1.8, height - high / 2 - 0.1)))
        frame, border = materials.frame(builder), rng.uniform(0.02, 0.12)
        place.add_box(0, up, 0, wide + border, high + border, 0.04, frame)
        content = materials.mirror(builder) if rng.random() < 0.1 else materials.picture(builder)
        place.add_box(0, up, 0, wide, high, 0.05, content)
