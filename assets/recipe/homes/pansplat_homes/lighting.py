"""Light of generated homes: sun, lamps, windows and open doors, and the light that the surfaces of rooms exchange.

Rooms that share a wide opening form a light group with one level of indirect light. The levels solve a radiosity
equation whose elements are the groups: what enters through windows and from lamps is absorbed by the surfaces, or goes
through doors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pansplat_homes.plans import OUTSIDE, Hole, HoleKind, Plan
from pansplat_homes.scene import SceneBuilder
from pansplat_homes.textures import COLOR_A

Array = NDArray[np.float64]

_LEVEL = 0.8  # mean light on surfaces indoors
_WIDE = 1.25  # openings of at least this width join light groups, metres


@dataclass(frozen=True)
class LightMood:
    """Light of one home.

    Attributes:
        window: light that a surface at a window receives from outdoors (red, green, blue).
        outdoors: ambient light of surfaces outdoors, as cameras see it.
        sun: direction to the sun and its light, or None.
        lamps: share of the lamps that are on.
        lamp: light of a lamp one metre away.
        compression: exponent in (0, 1] of the rooms' brightness, as photographs of high dynamic range show it.
    """

    window: Array
    outdoors: Array
    sun: tuple[Array, Array] | None
    lamps: float
    lamp: Array
    compression: float


def sample_mood(rng: np.random.Generator, plan: Plan) -> LightMood:
    """A random time of day, weather and camera. The sun shines into a window, mostly."""
    kind = rng.choice(3, p=(0.35, 0.5, 0.15))  # daylight, daylight and lamps, lamps
    cool, warm = rng.uniform(-0.05, 0.12), rng.uniform(0.05, 0.4)
    day = np.array((1 - cool, 1.0, 1 + cool))
    window = day * (rng.uniform(0.05, 0.3) if kind == 2 else rng.uniform(5, 20))
    outdoors = day * (rng.uniform(0.03, 0.3) if kind == 2 else np.exp(rng.uniform(np.log(0.9), np.log(16))))
    sun = None
    if kind < 2 and rng.random() < 0.75:
        up, around = np.radians(rng.uniform(12, 50)), rng.uniform(0, 2 * np.pi)
        windows = [w for w in plan.walls if w.is_outer and any(h.kind != HoleKind.ENTRANCE for h in w.holes)]
        if windows and rng.random() < 0.85:
            sizes = np.array([sum(h.width * (h.top - h.low) for h in w.holes) for w in windows])
            wall = windows[rng.choice(len(windows), p=sizes / sizes.sum())]
            outward = (0.0 if wall.axis == 2 else np.pi / 2) + (np.pi if wall.rooms[0] == OUTSIDE else 0.0)
            around = outward + np.radians(rng.uniform(-60, 60))
        direction = np.array((np.cos(up) * np.sin(around), -np.sin(up), np.cos(up) * np.cos(around)))
        sun = direction, rng.uniform(1.0, 6.0) * np.array((1.0, 0.94, 0.82))
    lamp = rng.uniform(0.6, 1.8) * np.array((1.0, 1 - 0.5 * warm, 1 - warm))
    lamps = (0.0, rng.uniform(0.3, 1.0), rng.uniform(0.7, 1.0))[kind]
    return LightMood(window, outdoors, sun, lamps, lamp, rng.uniform(0.35, 0.85))


def light_groups(plan: Plan) -> list[int]:
    """For each room, the number of its light group."""
    groups = list(range(len(plan.rooms)))
    for wall in plan.walls:
        if not wall.is_outer and any(h.kind == HoleKind.OPENING and h.width > _WIDE for h in wall.holes):
            first, second = (groups[i] for i in wall.rooms)
            groups = [first if group == second else group for group in groups]
    numbers = {group: number for number, group in enumerate(sorted(set(groups)))}
    return [numbers[group] for group in groups]


def add_lights(
    builder: SceneBuilder,
    plan: Plan,
    rooms: list[tuple[list[int], float, float]],
    heights: Array,
    lamps: list[tuple[int, tuple[float, float, float]]],
    openness: dict[Hole, float],
    mood: LightMood,
    has_shadows: bool,
) -> None:
    """Add sun, lamps, portals at windows and doors, and the rooms with their indirect light.

    Args:
        rooms: for each room its materials, and the heights of panel and trim.
        lamps: rooms and positions of the lamps that are on.
        has_shadows: whether bodies hide the largest window of a light group.
        openness: free fraction of doors; doors and openings that are missing here are open.
    """
    groups = np.array(light_groups(plan))
    count = groups.max() + 1
    area, reflected = np.zeros(count), np.zeros((count, 3))
    for room, group, height, (row, _, _) in zip(plan.rooms, groups, heights, rooms, strict=True):
        sides = 2 * (room.width + room.depth) * height
        colors = [np.array(builder.materials[k][COLOR_A : COLOR_A + 3]) for k in row[:3]]
        area[group] += sides + 2 * room.area
        reflected[group] += sides * colors[0] + room.area * (colors[1] + colors[2])
    reflectance = np.clip(0.85 * reflected / area[:, None], 0.05, 0.75)
    flux = np.zeros((count, 3))
    for index, _ in lamps:
        flux[groups[index]] += 4 * np.pi * mood.lamp
    passages: list[tuple[int, int, float]] = []
    portals, largest = [], {}
    for wall in plan.walls:
        for hole in wall.holes:
            first, second = (groups[i] if i >= 0 else -1 for i in wall.rooms)
            size = hole.width * (min(hole.top, 2.4) - hole.low)
            if wall.is_outer and hole.kind != HoleKind.ENTRANCE:
                group = int(max(first, second))
                flux[group] += size * mood.window
                if group not in largest or hole.width > largest[group].width:
                    largest[group] = hole
                portals.append((wall, hole, 1.0))
            elif not wall.is_outer and first != second:
                share = openness.get(hole, 1.0)
                passages.append((first, second, size * share))
                if share > 0.05:
                    portals.append((wall, hole, share))
    total = np.zeros((count, 3))
    for channel in range(3):
        rho = reflectance[:, channel]
        system = np.diag(area * (1 - rho))
        for first, second, size in passages:
            system[first, first] += size * rho[first]
            system[second, second] += size * rho[second]
            system[first, second] -= size * rho[second]
            system[second, first] -= size * rho[first]
        total[:, channel] = np.linalg.solve(system, flux[:, channel] + 0.002 * area)
    level = total.mean(axis=1)
    mean = (level * area).sum() / area.sum()
    scale = _LEVEL / mean * np.clip((level / mean), 0.02, 50.0) ** (mood.compression - 1)
    ambient = reflectance * total * scale[:, None]
    for wall, hole, share in portals:
        top = min(hole.top, float(heights[[i for i in wall.rooms if i >= 0]].min()))
        middle, half = -(hole.low + top) / 2, (hole.width / 2, (top - hole.low) / 2)
        if wall.is_outer:
            sign = -1 if wall.rooms[0] == OUTSIDE else 1
            group = groups[max(wall.rooms)]
            x, z = wall.point(hole.middle, -0.02 * sign)  # before blinds and the sides of the hole
            shadows = has_shadows and hole is largest.get(int(group))
            builder.add_portal((x, middle, z), half, wall.axis, mood.window * scale[group], int(group), shadows=shadows)
            continue
        x, z = wall.point(hole.middle)
        for here, there in (wall.rooms, wall.rooms[::-1]):
            color = share * (ambient[groups[there]] - ambient[groups[here]])
            builder.add_portal((x, middle, z), half, wall.axis, color, int(groups[here]))
    for index, position in lamps:
        builder.add_light(position, mood.lamp * scale[groups[index]], 0.03, group=int(groups[index]))
    if mood.sun is not None:
        builder.add_light(*mood.sun, 0.01, sun=True)
    for index, (room, (row, panel, trim)) in enumerate(zip(plan.rooms, rooms, strict=True)):
        corners = list(room.corners)
        for k, side in enumerate(plan.sides(index)):
            if side.is_outer:  # the inner half of the wall's holes belongs to the room
                corners[k] += 0.12 * side.outward
        builder.add_room(corners, row, panel, trim, float(heights[index]), ambient[groups[index]], int(groups[index]))
