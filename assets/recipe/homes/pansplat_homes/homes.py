"""Random homes as real-estate tours show them: plan, walls, doors, fixtures, furniture, lights and cameras.

World axes: y down, the floor at y = 0, metres.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pansplat_homes import materials
from pansplat_homes.doors import (
    DoorStyle,
    Leaf,
    add_casing,
    add_entrance,
    add_leaf,
    add_wall,
    add_window,
    plan_leaves,
)
from pansplat_homes.fixtures import add_ceiling_lamp, add_details, add_fixtures
from pansplat_homes.furniture import Place, chair, crates, furnish
from pansplat_homes.library import FurnitureLibrary
from pansplat_homes.lighting import LightMood, add_lights, sample_mood
from pansplat_homes.plans import OUTER, Hole, HoleKind, Plan, Rectangle, RoomKind, overlaps, sample_plan
from pansplat_homes.raytracer import FLOOR
from pansplat_homes.scene import GeneratedScene, SceneBuilder
from pansplat_homes.structure import (
    add_ceiling,
    add_slopes,
    add_stairs,
    add_structure,
    drop_windows_under_slopes,
    plan_stairs,
)
from pansplat_homes.textures import Pattern

Array = NDArray[np.float64]

_GROUND = 27.0  # half the side of the ground, metres; within the sphere of the sky
_CLEARANCE = 0.35  # least distance of a camera to a body, metres
_LEAST_PHOTOGRAPHED, _LARGE = 3.0, 18.0  # square metres: of a room with a photograph; of one that may have two
_DISTANCE = 0.3, 4.0  # between a camera and the nearest other one of its set, metres


class Furnishing(IntEnum):
    """How much stands in a home."""

    EMPTY = 0
    HALF = 1
    FURNISHED = 2
    CLUTTERED = 3


@dataclass(frozen=True)
class Home:
    """A home in several states.

    Attributes:
        variants: scenes that differ in the angles of doors and in a few movable things.
        doorways: passages in which a camera may stand: world x, z and the room's index.
        camera_height: usual height of the cameras, metres.
    """

    plan: Plan
    furnishing: Furnishing
    variants: tuple[GeneratedScene, ...]
    camera_height: float

    def sample_cameras(self, rng: np.random.Generator, count: int = 4) -> list[tuple[int, Array]]:
        """Variants and poses (cam2world) of cameras of a tour, in rooms that are connected by at most three passages.

        Each camera is 0.3 to 4 metres from the nearest other one. Fewer than `count` are returned if there is no space.
        """
        areas = np.array([room.area if room.kind != RoomKind.CLOSET else 0.3 * room.area for room in self.plan.rooms])
        areas = areas**0.9
        has_changes = rng.random() < 0.6
        yaw, spread = rng.uniform(0, 2 * np.pi), 0.05 if rng.random() < 0.6 else np.pi
        keeps_height, cameras = rng.random() < 0.75, []
        steps = self.plan.steps_from(int(rng.choice(len(areas), p=areas / areas.sum())))
        near = np.array([(1.0, 0.6, 0.3, 0.1)[step] if 0 <= step < 4 else 0.0 for step in steps])
        for attempt in range(40 * count):
            if len(cameras) == count:
                break
            variant = int(has_changes and rng.random() < 0.5)
            weights = near * areas if attempt % 3 else areas * (np.array(steps) == 0)
            x, z = self._sample_place(int(rng.choice(len(areas), p=weights / weights.sum())), rng)
            height = self.camera_height + rng.normal(0, 0.01) if keeps_height else rng.uniform(0.9, 1.9)
            centre = np.array((x, -height, z))
            if cameras:
                distances = [np.linalg.norm(pose[:3, 3] - centre) for _, pose in cameras]
                if not _DISTANCE[0] <= min(distances) <= _DISTANCE[1]:
                    continue
            if self.variants[variant].clearance(centre[None])[0] >= _CLEARANCE:
                cameras.append((variant, make_pose(centre, yaw + spread * rng.uniform(-1, 1))))
        return cameras

    def sample_room_cameras(self, rng: np.random.Generator) -> list[tuple[int, Array]]:
        """Variants and poses (cam2world) as agents take them: one camera in each room, or two in a third of large ones.

        Rooms without a way from the first one have none. Doors may change between the photographs.
        """
        steps, cameras = self.plan.steps_from(0), []
        for number, room in enumerate(self.plan.rooms):
            if steps[number] < 0 or room.kind == RoomKind.CLOSET or room.area < _LEAST_PHOTOGRAPHED:
                continue
            x0, z0, x1, z1 = self.plan.interior(number)
            count = 1 + int(room.area > _LARGE and rng.random() < 1 / 3)
            for camera in range(count):
                middle = 0.5 if count == 1 else 0.3 + 0.4 * camera
                for _ in range(40):
                    share = np.array((middle, 0.5)) + rng.uniform(-0.2, 0.2, 2)
                    share = share if x1 - x0 > z1 - z0 else share[::-1]
                    centre = np.array((x0 + share[0] * (x1 - x0), -self.camera_height, z0 + share[1] * (z1 - z0)))
                    variant = int(rng.integers(len(self.variants)))
                    if self.variants[variant].clearance(centre[None])[0] >= _CLEARANCE:
                        cameras.append((variant, make_pose(centre, rng.uniform(0, 2 * np.pi))))
                        break
        return cameras

    def _sample_place(self, room: int, rng: np.random.Generator) -> tuple[float, float]:
        """World x and z of a camera in a room: near its middle, anywhere in it, or in one of its doorways."""
        kind = rng.random()
        x0, z0, x1, z1 = self.plan.interior(room)
        passages = [(wall, hole) for wall, hole in self.plan.passages() if room in wall.rooms]
        if kind < 0.22 and passages:
            wall, hole = passages[rng.integers(len(passages))]
            return wall.point(hole.middle + rng.normal(0, 0.05) * hole.width, rng.normal(0, 0.25))
        if kind < 0.68:
            share = rng.uniform(0.3, 0.7, size=2)
            return x0 + share[0] * (x1 - x0), z0 + share[1] * (z1 - z0)
        return rng.uniform(x0, x1), rng.uniform(z0, z1)


def make_pose(centre: Array, yaw: float) -> Array:
    """cam2world (4 4) of an upright camera that is turned to the right by `yaw` radians."""
    pose = np.eye(4)
    cos, sin = np.cos(yaw), np.sin(yaw)
    pose[:3, :3] = ((cos, 0, sin), (0, 1, 0), (-sin, 0, cos))
    pose[:3, 3] = centre
    return pose


@dataclass
class _Style:
    """Materials that several rooms of a home share."""

    wall: int
    ceiling: int
    trim_height: float
    doors: DoorStyle
    floors: dict[RoomKind, int]
    materials: dict[int, list[int]] = field(default_factory=dict)


def _sample_style(builder: SceneBuilder, plan: Plan, furnishing: Furnishing) -> _Style:
    rng = builder.rng
    trim = materials.trim(builder)
    leaf = trim if rng.random() < 0.6 else (materials.upright_wood if rng.random() < 0.6 else materials.trim)(builder)
    panels = ((0, 0), (1, 1), (2, 1), (3, 2), (2, 2))[rng.choice(5, p=(0.35, 0.1, 0.2, 0.25, 0.1))]
    casing = rng.uniform(0.05, 0.08) if rng.random() < 0.85 else 0.0
    sliding = materials.mirror(builder) if rng.random() < 0.3 else leaf
    doors = DoorStyle(
        trim,
        leaf,
        materials.metal(builder),
        panels,
        casing,
        bool(rng.random() < 0.6),
        sliding,
        (0.04, 0.12, 0.3, 0.3)[furnishing],
    )
    wall = materials.paint(builder, materials.paint_color(rng))
    if furnishing != Furnishing.EMPTY and rng.random() < 0.25:
        wall = materials.wall(builder)
    main = materials.floor(builder)
    bedroom = (
        main if rng.random() < 0.5 else materials.carpet(builder) if rng.random() < 0.7 else materials.floor(builder)
    )
    kitchen = (
        main
        if rng.random() < 0.6
        else materials.floor_tiles(builder)
        if rng.random() < 0.7
        else materials.boards(builder)
    )
    hall = bedroom if rng.random() < 0.5 else main
    wet = materials.floor_tiles(builder) if rng.random() < 0.75 else kitchen
    kinds = RoomKind
    floors = {
        kinds.LIVING: main,
        kinds.DINING: kitchen if rng.random() < 0.5 else main,
        kinds.KITCHEN: kitchen,
        kinds.BEDROOM: bedroom,
        kinds.BATHROOM: wet,
        kinds.HALL: hall,
        kinds.CLOSET: bedroom,
        kinds.UTILITY: wet,
    }
    trim_height = rng.uniform(0.05, 0.14) if rng.random() < 0.9 else 0.0
    return _Style(wall, materials.ceiling(builder), trim_height, doors, floors)


def build_home(rng: np.random.Generator, library: FurnitureLibrary | None = None) -> Home:
    """A random home; a part of its furniture comes from `library`, if there is one."""
    furnishing = Furnishing(rng.choice(4, p=(0.3, 0.2, 0.35, 0.15)))
    plan, builder = sample_plan(rng), SceneBuilder(rng, library)
    style, mood = _sample_style(builder, plan, furnishing), sample_mood(rng, plan)
    heights = np.full(len(plan.rooms), rng.uniform(2.3, 2.75) if rng.random() < 0.75 else rng.uniform(2.6, 3.3))
    if rng.random() < 0.25:
        heights += rng.uniform(-0.25, 0.4, size=len(heights)) * (rng.random(len(heights)) < 0.4)
    heights = np.maximum(heights, 2.3)
    for index, room in enumerate(plan.rooms):
        if room.kind == RoomKind.ALCOVE:
            heights[index] = heights[room.parent]
    top, is_attic = float(heights.max()) + 0.1, rng.random() < 0.1
    attic_axis = (0, 2)[rng.integers(2)]
    if is_attic:
        drop_windows_under_slopes(plan, attic_axis)
    outside, sky = _add_outdoors(builder, plan, mood)
    rooms = [_room_row(builder, plan, index, style, furnishing, heights[index]) for index in range(len(plan.rooms))]
    leaves, occupied = _add_walls(builder, plan, style, top)
    stairs, knee = None, rng.uniform(1.0, 1.7)
    host = 0
    if rng.random() < 0.35:
        for host in rng.permutation(len(plan.rooms)):
            if plan.rooms[host].kind in (RoomKind.LIVING, RoomKind.HALL, RoomKind.DINING):
                stairs = plan_stairs(plan, host, float(heights[host]), occupied[host], rng)
            if stairs is not None:
                break
    for index in range(len(plan.rooms)):
        height = float(heights[index])
        well = stairs[4] if stairs is not None and index == host else None
        add_ceiling(builder, plan, index, height, top, well)
        add_structure(builder, plan, index, height, occupied[index])
        if is_attic and well is None:
            add_slopes(builder, plan, index, height, attic_axis, knee)
    if stairs is not None:
        looks = (materials.wood(builder), style.doors.trim)
        add_stairs(builder, *stairs[:4], float(heights[host]), looks)
    has_radiators = bool(rng.random() < 0.25)
    spots: list[tuple[int, float, float]] = []
    lamps = []
    for index, room in enumerate(plan.rooms):
        lamps += add_ceiling_lamp(builder, plan, index, float(heights[index]), mood.lamps, occupied[index])
        add_fixtures(builder, plan, index, float(heights[index]), occupied[index], style.doors.trim, furnishing == 0)
        fixed = list(occupied[index])
        furnish(builder, plan, index, occupied[index], int(furnishing))
        add_details(builder, plan, index, float(heights[index]), int(furnishing), has_radiators, fixed)
        if furnishing != Furnishing.EMPTY and room.area > 5 and rng.random() < 0.5:
            place = _find_place(plan, index, occupied[index], rng)
            if place is not None:
                spots.append((int(rng.integers(1 << 31)), *place))
    variants = []
    angles = [_sample_angle(leaf, rng) for leaf in leaves]
    for _ in range(2):
        variant = _fork(builder)
        for leaf, angle in zip(leaves, angles, strict=True):
            add_leaf(variant, leaf, angle, style.doors)
        _add_movables(variant, spots)
        add_lights(variant, plan, rooms, heights, lamps, _openness(leaves, angles), mood, furnishing > 0)
        variants.append(variant.finish(mood.outdoors, outside, sky))
        angles = [
            angle if rng.random() < 0.55 else _sample_angle(leaf, rng)
            for leaf, angle in zip(leaves, angles, strict=True)
        ]
    height = rng.uniform(1.2, 1.75)
    return Home(plan, furnishing, tuple(variants), min(height, float(heights.min()) - 0.6))


def _fork(builder: SceneBuilder) -> SceneBuilder:
    """A builder that continues the same scene independently; it shares the random numbers."""
    fork = copy.copy(builder)
    for name, value in vars(builder).items():
        if isinstance(value, list | dict):
            setattr(fork, name, value.copy())
    return fork


def _sample_angle(leaf: Leaf, rng: np.random.Generator) -> float:
    """A closed, half open or fully open door, radians."""
    kind = rng.choice(3, p=(0.28, 0.22, 0.5))
    if kind == 0:
        return 0.0
    return rng.uniform(0.2, 0.8) * leaf.largest if kind == 1 else leaf.largest * rng.uniform(0.9, 1.0)


def _openness(leaves: list[Leaf], angles: list[float]) -> dict[Hole, float]:
    """For each door with leaves, the free fraction of its area."""
    found: dict[Hole, float] = {}
    for leaf, angle in zip(leaves, angles, strict=True):
        share = leaf.width / leaf.hole.width * float(1 - np.cos(min(angle, np.pi / 2)))
        if leaf.slides:
            share = 0.45 * angle / leaf.largest if leaf.towards > 0 else 0.0
        found[leaf.hole] = found.get(leaf.hole, 0.0) + share
    return found


def _room_row(
    builder: SceneBuilder, plan: Plan, index: int, style: _Style, furnishing: Furnishing, height: float
) -> tuple[list[int], float, float]:
    """Materials of a room, and heights of its panel and trim, metres."""
    rng, room = builder.rng, plan.rooms[index]
    if room.kind == RoomKind.ALCOVE and room.parent in style.materials:
        found = style.materials[room.parent]
    else:
        wall, panel = style.wall, style.wall
        if rng.random() < (0.15 if furnishing == Furnishing.EMPTY else 0.3):
            wall = materials.wall(builder)
        if room.kind == RoomKind.BATHROOM and rng.random() < 0.4:
            panel = materials.wall_tiles(builder)
            wall = panel if rng.random() < 0.4 else wall
        elif rng.random() < 0.03:
            panel = style.doors.trim
        ceiling = style.ceiling if rng.random() < 0.9 else materials.ceiling(builder)
        floor = style.floors.get(room.kind, style.floors[RoomKind.LIVING])
        if room.parent >= 0 and room.parent in style.materials:
            floor = style.materials[room.parent][1]
        found = [wall, floor, ceiling, style.doors.trim, panel if panel != style.wall else wall]
        style.materials[index] = found
    panel_height = rng.uniform(0.9, 1.4) if found[4] != found[0] else 0.0
    return found, panel_height, style.trim_height


def _add_walls(
    builder: SceneBuilder, plan: Plan, style: _Style, top: float
) -> tuple[list[Leaf], list[list[Rectangle]]]:
    """Add the walls and what is in their holes, except inner door leaves.

    Returns:
        The leaves of inner doors, and for each room the floor where nothing may stand.
    """
    rng, leaves = builder.rng, []
    occupied: list[list[Rectangle]] = [[] for _ in plan.rooms]
    for wall in plan.walls:
        add_wall(builder, plan, wall, top)
        for hole in wall.holes:
            if hole.kind == HoleKind.DOOR:
                add_casing(builder, wall, hole, style.doors, max(style.doors.casing, 0.0))
                if rng.random() < 0.85:
                    leaves += plan_leaves(plan, wall, hole, rng)
            elif hole.kind == HoleKind.OPENING:
                if hole.top < np.inf and style.doors.casing > 0 and rng.random() < 0.4:
                    add_casing(builder, wall, hole, style.doors, style.doors.casing)
            elif hole.kind == HoleKind.ENTRANCE:
                add_casing(builder, wall, hole, style.doors, style.doors.casing)
                add_entrance(builder, wall, hole, style.doors)
            else:
                add_window(builder, wall, hole, style.doors, rng)
            if hole.low == 0:
                for index, sign in zip(wall.rooms, (-1, 1), strict=True):
                    if index >= 0:
                        (ax, az), (bx, bz) = wall.point(hole.start, 0.0), wall.point(hole.end, 0.95 * sign)
                        occupied[index].append((min(ax, bx), min(az, bz), max(ax, bx), max(az, bz)))
    return leaves, occupied


def _find_place(
    plan: Plan, room: int, occupied: list[Rectangle], rng: np.random.Generator
) -> tuple[float, float] | None:
    """A free square of 1.2 metres in a room, which becomes occupied; its centre."""
    x0, z0, x1, z1 = plan.interior(room)
    for _ in range(6):
        x, z = rng.uniform(x0 + 0.6, max(x1 - 0.6, x0 + 0.6)), rng.uniform(z0 + 0.6, max(z1 - 0.6, z0 + 0.6))
        place = (x - 0.6, z - 0.6, x + 0.6, z + 0.6)
        if place[2] < x1 and place[3] < z1 and not overlaps(place, occupied):
            occupied.append(place)
            return x, z
    return None


def _add_movables(builder: SceneBuilder, spots: list[tuple[int, float, float]]) -> None:
    """Add a chair or boxes at random offsets, some of them missing; they look the same in all variants."""
    rng = builder.rng
    for seed, x, z in spots:
        if rng.random() < 0.75:
            dx, dz = rng.uniform(-0.25, 0.25, size=2)
            place = Place(builder, x + dx, z + dz, rng.uniform(0, 2 * np.pi))
            builder.rng = np.random.default_rng(seed)
            (chair if seed % 2 else crates)(place, builder.rng, 0.5, 0.5)
            builder.rng = rng


def _add_outdoors(builder: SceneBuilder, plan: Plan, mood: LightMood) -> tuple[int, int]:
    """Add ground, foundation, neighbours, fences and trees; the materials of outer walls and of the sky."""
    rng = builder.rng
    outside = materials.wall(builder)
    blue, land = rng.uniform(0.2, 0.6), materials.foliage_color(rng)
    if rng.random() < 0.3:
        land = materials.random_color(rng, 0.2, 0.2, 0.6)
    sky = builder.add_material(
        Pattern.PLAIN,
        (blue * 0.4, blue * 0.7, blue * 1.4),
        (0.7, 0.8, 0.9),
        land,
        glow=float(np.mean(mood.outdoors)) * 1.3,
    )
    green = materials.foliage_color(rng)
    grass = builder.add_material(Pattern.STONE, green, materials.shade(green, 0.4), size=0.7, fraction=0, mottle=0.6)
    x0, z0, x1, z1 = plan.bounds
    builder.add_box((0, 0.1, 0), ((x1 - x0) / 2 + OUTER, 0.1, (z1 - z0) / 2 + OUTER), FLOOR)
    builder.add_box((0, 0.45, 0), (_GROUND, 0.3, _GROUND), grass)
    bark = materials.wood(builder)
    for _ in range(rng.integers(2, 14)):
        angle, size = rng.uniform(0, 2 * np.pi), rng.uniform(0.8, 2.5)
        away = np.hypot(x1 - x0, z1 - z0) / 2 + rng.uniform(1.5 + size, 12)
        x, z = away * np.sin(angle), away * np.cos(angle)
        leaves = materials.shade(green, rng.uniform(0.3, 1.2))
        leaf = builder.add_material(
            Pattern.STONE, leaves, materials.shade(leaves, 0.2), size=0.4, fraction=0, mottle=0.8
        )
        if rng.random() < 0.4:
            builder.add_ellipsoid((x, -0.4 * size, z), (size, size * 0.8, size), leaf)
            continue
        height = rng.uniform(2, 5)
        builder.add_cylinder((x, -height / 2, z), 0.15, height / 2, bark)
        for _ in range(3):
            dx, dy, dz = rng.normal(0, 0.4 * size, size=3)
            builder.add_ellipsoid((x + dx, -height - dy, z + dz), rng.uniform(0.5, 1.0, size=3) * size, leaf)
    fence = materials.wood(builder, (0.14, 3.0)) if rng.random() < 0.7 else materials.wall(builder)
    for axis in (0, 1):
        for sign in (-1, 1):
            reach = (x1 - x0, z1 - z0)[axis] / 2 + rng.uniform(2.5, 9)
            if rng.random() < 0.35:  # a neighbour's house
                half = (rng.uniform(3, 7), rng.uniform(1.4, 3.0), rng.uniform(3, 7))
                centre = [0.0, -half[1] + 0.3, 0.0]
                centre[2 * axis], centre[2 - 2 * axis] = sign * (reach + half[2 * axis]), rng.uniform(-4, 4)
                builder.add_box(centre, half, materials.wall(builder))
            if rng.random() < 0.5:
                high = rng.uniform(0.5, 1.0)
                centre, half = [0.0, 0.15 - high, 0.0], [14.0, high, 14.0]
                centre[2 * axis], half[2 * axis] = sign * reach, 0.03
                builder.add_box(centre, half, fence)
    return outside, sky
