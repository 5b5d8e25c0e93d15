"""Pieces of furniture made of boxes, ellipsoids and cylinders. Each stands on the floor at a `Place`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pansplat.data.generated import materials
from pansplat.data.generated.scene import SceneBuilder
from pansplat.data.generated.textures import Pattern


class Place:
    """A place on the floor (x, z) with a yaw. Parts are given in local axes; `up` is the height above the floor."""

    def __init__(self, builder: SceneBuilder, x: float, z: float, yaw: float) -> None:
        self.builder, self.x, self.z, self.yaw = builder, x, z, yaw
        self.cos, self.sin = np.cos(yaw), np.sin(yaw)

    def _world(self, x: float, up: float, z: float) -> tuple[float, float, float]:
        return self.x + self.cos * x + self.sin * z, -up, self.z - self.sin * x + self.cos * z

    def add_box(self, x, up, z, width, height, depth, material, yaw=0.0, pitch=0.0) -> None:
        """Add a box of `width` x `height` x `depth` metres, centred at (x, up, z)."""
        self.builder.add_box(self._world(x, up, z), (width / 2, height / 2, depth / 2), material, self.yaw + yaw, pitch)

    def add_ellipsoid(self, x, up, z, width, height, depth, material) -> None:
        """Add an ellipsoid of that size, centred at (x, up, z)."""
        self.builder.add_ellipsoid(self._world(x, up, z), (width / 2, height / 2, depth / 2), material, self.yaw)

    def add_cylinder(self, x, up, z, radius, height, material) -> None:
        """Add an upright cylinder, centred at (x, up, z)."""
        self.builder.add_cylinder(self._world(x, up, z), radius, height / 2, material)


Piece = Callable[[Place, np.random.Generator, float, float], None]


def _add_legs(
    place: Place, material: int, width: float, depth: float, height: float, thick: float, are_round: bool
) -> None:
    for sx in (-1, 1):
        for sz in (-1, 1):
            x, z = sx * (width / 2 - thick), sz * (depth / 2 - thick)
            if are_round:
                place.add_cylinder(x, height / 2, z, thick / 2, height, material)
            else:
                place.add_box(x, height / 2, z, thick, height, thick, material)


def clutter(place: Place, rng: np.random.Generator, up: float, width: float, depth: float, limit: int) -> None:
    """Up to `limit` small objects on a surface: books, bowls, boxes, bottles, sheets of paper."""
    builder = place.builder
    for _ in range(rng.integers(limit + 1)):
        x, z, size = rng.uniform(-0.4, 0.4) * width, rng.uniform(-0.4, 0.4) * depth, rng.uniform(0.05, 0.2)
        kind = rng.integers(5)
        if kind == 0:
            material = materials.random_material(builder)
            place.add_box(x, up + size / 4, z, size * 1.4, size / 2, size, material, rng.uniform(0, 3))
        elif kind == 1:
            place.add_ellipsoid(x, up + size / 2, z, size, size, size, materials.plain(builder))
        elif kind == 2:
            place.add_cylinder(x, up + size * 0.7, z, size / 3, size * 1.4, materials.plain(builder))
            place.add_ellipsoid(x, up + size * 1.4, z, size / 2, size / 2, size / 2, materials.plain(builder))
        elif kind == 3:
            place.add_box(x, up + 0.004, z, 0.21, 0.008, 0.3, materials.picture(builder), rng.uniform(0, 3))
        else:
            place.add_box(x, up + size, z, size, 2 * size, size, materials.random_material(builder), rng.uniform(0, 3))


def table(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A table with objects on it."""
    height, material = rng.choice((rng.uniform(0.35, 0.5), rng.uniform(0.7, 0.78))), materials.wood(place.builder)
    if rng.random() < 0.25:
        material = materials.plain(place.builder)
    if rng.random() < 0.3:
        radius = min(width, depth) / 2
        place.add_cylinder(0, height, 0, radius, 0.04, material)
        place.add_cylinder(0, height / 2, 0, 0.06, height, material)
        clutter(place, rng, height + 0.02, radius, radius, 5)
        return
    place.add_box(0, height, 0, width, 0.04, depth, material)
    _add_legs(place, material, width, depth, height, rng.uniform(0.04, 0.08), bool(rng.random() < 0.4))
    clutter(place, rng, height + 0.02, width, depth, 7)


def chair(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A chair with a slatted or a full back."""
    frame, seat = materials.wood(place.builder), materials.random_material(place.builder)
    place.add_box(0, 0.45, 0, 0.42, 0.05, 0.42, seat)
    _add_legs(place, frame, 0.42, 0.42, 0.43, 0.035, bool(rng.random() < 0.5))
    if rng.random() < 0.5:
        place.add_box(0, 0.72, 0.19, 0.4, 0.5, 0.03, seat, pitch=rng.uniform(-0.15, 0))
        return
    for x in (-0.18, -0.06, 0.06, 0.18):
        place.add_box(x, 0.7, 0.19, 0.03, 0.5, 0.03, frame)
    place.add_box(0, 0.95, 0.19, 0.42, 0.06, 0.03, frame)


def sofa(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A sofa with cushions; its back is towards +z."""
    cover = materials.fabric(place.builder)
    depth = min(depth, 1.0)
    place.add_box(0, 0.25, 0, width, 0.34, depth, cover)
    place.add_box(0, 0.55, depth / 2 - 0.1, width, 0.6, 0.2, cover, pitch=-0.1)
    for side in (-1, 1):
        place.add_box(side * (width / 2 - 0.09), 0.4, 0, 0.18, 0.45, depth, cover)
    for _ in range(rng.integers(1, 5)):
        x, cushion = rng.uniform(-0.35, 0.35) * width, materials.fabric(place.builder)
        place.add_box(x, 0.6, depth / 2 - 0.3, 0.4, 0.35, 0.12, cushion, rng.uniform(-0.3, 0.3), -0.35)


def bed(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A bed with a cover and pillows; its head is towards +z."""
    place.add_box(0, 0.18, 0, width, 0.36, depth, materials.wood(place.builder))
    place.add_box(0, 0.45, -0.1, width * 0.97, 0.2, depth * 0.85, materials.fabric(place.builder))
    place.add_box(0, 0.6, depth / 2 - 0.04, width, 1.1, 0.08, materials.random_material(place.builder))
    pillow = materials.fabric(place.builder)
    for x in (-0.25, 0.25):
        place.add_ellipsoid(x * width, 0.56, depth / 2 - 0.35, 0.4 * width, 0.18, 0.45, pillow)


def shelf(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A bookcase; its back is towards +z."""
    builder, material, height = place.builder, materials.wood(place.builder), rng.uniform(1.0, 2.1)
    depth = min(depth, 0.35)
    for x in (-width / 2 + 0.012, width / 2 - 0.012):
        place.add_box(x, height / 2, 0, 0.025, height, depth, material)
    place.add_box(0, height / 2, depth / 2 - 0.01, width, height, 0.02, material)
    levels = int(height / 0.35)
    for k in range(levels + 1):
        up = 0.06 + k * (height - 0.08) / levels
        place.add_box(0, up, 0, width, 0.025, depth, material)
        if k < levels and rng.random() < 0.75:
            filled = rng.uniform(0.4, 0.92)
            books = builder.add_material(Pattern.BOOKS, (0.5, 0.5, 0.5), size=(rng.uniform(0.025, 0.05), 0.2))
            x = (filled - 1) * width / 2 + 0.02
            place.add_box(x, up + 0.13, 0.02, filled * width - 0.06, 0.22, depth * 0.75, books)
        elif k < levels:
            clutter(place, rng, up + 0.012, width * 0.8, depth * 0.5, 3)


def cabinet(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A chest or cupboard with drawers or doors, and objects on top."""
    builder, height = place.builder, rng.choice((rng.uniform(0.5, 1.0), rng.uniform(1.7, 2.1)))
    light, dark = materials.random_wood_colors(builder.rng)
    if rng.random() < 0.4:
        light = materials.random_color(rng, 0.5, 0.4, 0.95)
    size = (width / rng.integers(1, 4), height / rng.integers(1, 5))
    front = builder.add_material(
        Pattern.TILES, light, materials.shade(light, 0.85), dark, size=size, fraction=0.03, mottle=0.1
    )
    place.add_box(0, height / 2, 0, width, height, min(depth, 0.6), front)
    knob = materials.plain(builder, 0.3)
    for k in range(rng.integers(1, 4)):
        place.add_ellipsoid((k - 1) * width / 4, 0.6 * height, -min(depth, 0.6) / 2, 0.04, 0.04, 0.04, knob)
    if height < 1.2:
        clutter(place, rng, height, width, min(depth, 0.6), 5)


def lamp(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A standing lamp with a bright shade."""
    builder, height = place.builder, rng.uniform(1.3, 1.8)
    place.add_cylinder(0, 0.015, 0, 0.15, 0.03, materials.plain(builder))
    place.add_cylinder(0, height / 2, 0, 0.015, height, materials.plain(builder, 0.2))
    shade = builder.add_material(Pattern.PLAIN, materials.random_color(rng, 0.4, 0.7, 1.0), glow=rng.uniform(0.3, 1.5))
    if rng.random() < 0.5:
        place.add_cylinder(0, height, 0, 0.18, 0.28, shade)
    else:
        place.add_ellipsoid(0, height, 0, 0.35, 0.35, 0.35, shade)


def plant(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A pot with leaves."""
    builder, size = place.builder, rng.uniform(0.15, 0.25)
    place.add_cylinder(0, size, 0, size * 0.8, 2 * size, materials.random_material(builder))
    green = (rng.uniform(0.02, 0.15), rng.uniform(0.1, 0.35), rng.uniform(0.01, 0.1))
    leaf = builder.add_material(Pattern.STONE, green, materials.shade(green, 0.3), size=0.08, fraction=0, mottle=0.5)
    for _ in range(rng.integers(5, 14)):
        x, z = rng.normal(0, size * 0.8, size=2)
        width, height, depth = rng.uniform(0.08, 0.35, size=3)
        place.add_ellipsoid(x, 2 * size + rng.uniform(0.0, 4 * size), z, width, height, depth, leaf)


def crates(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """Stacked boxes with random yaws."""
    up = 0.0
    for _ in range(rng.integers(1, 4)):
        height = rng.uniform(0.2, 0.45)
        wide, deep = rng.uniform(0.5, 1.0, size=2) * (min(width, 0.6), min(depth, 0.6))
        material = materials.random_material(place.builder)
        place.add_box(0, up + height / 2, 0, wide, height, deep, material, rng.uniform(-0.5, 0.5))
        up += height


def board(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A large board that leans back, as on an easel."""
    height, lean = rng.uniform(0.8, 1.7), rng.uniform(0.15, 0.6)
    material = materials.picture(place.builder)
    place.add_box(0, height / 2, 0, min(width, 1.2), height, 0.03, material, pitch=-lean)


def ball(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A ball, a drum or a column."""
    size = rng.uniform(0.25, 0.7)
    kind = rng.integers(3)
    if kind == 0:
        place.add_ellipsoid(0, size / 2, 0, size, size, size, materials.random_material(place.builder))
    else:
        height = rng.uniform(0.3, 0.6) if kind == 1 else 2.0
        place.add_cylinder(0, height / 2, 0, size / 2, height, materials.random_material(place.builder))


def stairs(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A few steps."""
    material, count = materials.floor(place.builder), rng.integers(3, 7)
    run = depth / count
    for k in range(count):
        height = 0.17 * (k + 1)
        place.add_box(0, height / 2, -depth / 2 + (k + 0.5) * run, width, height, run, material)


AGAINST_WALL: tuple[tuple[Piece, float, float], ...] = (
    (sofa, 2.0, 0.95),
    (bed, 1.6, 2.1),
    (shelf, 1.2, 0.36),
    (cabinet, 1.2, 0.55),
    (cabinet, 0.8, 0.5),
    (table, 1.3, 0.6),
    (stairs, 1.0, 1.4),
)
STANDING: tuple[tuple[Piece, float, float], ...] = (
    (table, 1.4, 0.9),
    (table, 0.9, 0.9),
    (chair, 0.5, 0.5),
    (chair, 0.5, 0.5),
    (lamp, 0.4, 0.4),
    (plant, 0.6, 0.6),
    (crates, 0.6, 0.6),
    (board, 1.0, 0.7),
    (ball, 0.6, 0.6),
)
"""Pieces with their nominal width and depth, metres."""
