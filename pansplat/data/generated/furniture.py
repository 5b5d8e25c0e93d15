"""Pieces of furniture made of boxes, ellipsoids and cylinders; each stands on the floor at a place, turned by a yaw."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pansplat.data.generated import materials as surfaces
from pansplat.data.generated.scene import SceneBuilder
from pansplat.data.generated.textures import Pattern


class Place:
    """A place on the floor (x, z) and a yaw; parts are given in the piece's own axes, y counted up from the floor."""

    def __init__(self, build: SceneBuilder, x: float, z: float, yaw: float) -> None:
        self.build, self.x, self.z, self.yaw = build, x, z, yaw
        self.cos, self.sin = np.cos(yaw), np.sin(yaw)

    def _world(self, x: float, up: float, z: float) -> tuple[float, float, float]:
        return self.x + self.cos * x + self.sin * z, -up, self.z - self.sin * x + self.cos * z

    def box(self, x, up, z, wide, tall, deep, look, yaw=0.0, pitch=0.0) -> None:
        """A box that is `wide` x `tall` x `deep` metres with its middle at (x, up, z)."""
        self.build.box(self._world(x, up, z), (wide / 2, tall / 2, deep / 2), look, self.yaw + yaw, pitch)

    def ellipsoid(self, x, up, z, wide, tall, deep, look) -> None:
        """An ellipsoid of that size."""
        self.build.ellipsoid(self._world(x, up, z), (wide / 2, tall / 2, deep / 2), look, self.yaw)

    def cylinder(self, x, up, z, radius, tall, look) -> None:
        """An upright cylinder with its middle at (x, up, z)."""
        self.build.cylinder(self._world(x, up, z), radius, tall / 2, look)


Piece = Callable[[Place, np.random.Generator, float, float], None]


def _legs(at: Place, look: int, wide: float, deep: float, tall: float, thick: float, round_ones: bool) -> None:
    for sx in (-1, 1):
        for sz in (-1, 1):
            x, z = sx * (wide / 2 - thick), sz * (deep / 2 - thick)
            if round_ones:
                at.cylinder(x, tall / 2, z, thick / 2, tall, look)
            else:
                at.box(x, tall / 2, z, thick, tall, thick, look)


def clutter(at: Place, rng: np.random.Generator, up: float, wide: float, deep: float, most: int) -> None:
    """Small things on a surface: books, bowls, boxes, bottles, sheets of paper."""
    build = at.build
    for _ in range(rng.integers(most + 1)):
        x, z, size = rng.uniform(-0.4, 0.4) * wide, rng.uniform(-0.4, 0.4) * deep, rng.uniform(0.05, 0.2)
        kind = rng.integers(5)
        if kind == 0:
            at.box(x, up + size / 4, z, size * 1.4, size / 2, size, surfaces.anything(build), rng.uniform(0, 3))
        elif kind == 1:
            at.ellipsoid(x, up + size / 2, z, size, size, size, surfaces.plain(build))
        elif kind == 2:
            at.cylinder(x, up + size * 0.7, z, size / 3, size * 1.4, surfaces.plain(build))
            at.ellipsoid(x, up + size * 1.4, z, size / 2, size / 2, size / 2, surfaces.plain(build))
        elif kind == 3:
            at.box(x, up + 0.004, z, 0.21, 0.008, 0.3, surfaces.picture(build), rng.uniform(0, 3))
        else:
            at.box(x, up + size, z, size, 2 * size, size, surfaces.anything(build), rng.uniform(0, 3))


def table(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A table with things on it."""
    tall, look = rng.choice((rng.uniform(0.35, 0.5), rng.uniform(0.7, 0.78))), surfaces.wood(at.build)
    if rng.random() < 0.25:
        look = surfaces.plain(at.build)
    if rng.random() < 0.3:
        radius = min(wide, deep) / 2
        at.cylinder(0, tall, 0, radius, 0.04, look)
        at.cylinder(0, tall / 2, 0, 0.06, tall, look)
        clutter(at, rng, tall + 0.02, radius, radius, 5)
        return
    at.box(0, tall, 0, wide, 0.04, deep, look)
    _legs(at, look, wide, deep, tall, rng.uniform(0.04, 0.08), bool(rng.random() < 0.4))
    clutter(at, rng, tall + 0.02, wide, deep, 7)


def chair(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A chair with a slatted or a full back."""
    frame, seat = surfaces.wood(at.build), surfaces.anything(at.build)
    at.box(0, 0.45, 0, 0.42, 0.05, 0.42, seat)
    _legs(at, frame, 0.42, 0.42, 0.43, 0.035, bool(rng.random() < 0.5))
    if rng.random() < 0.5:
        at.box(0, 0.72, 0.19, 0.4, 0.5, 0.03, seat, pitch=rng.uniform(-0.15, 0))
        return
    for x in (-0.18, -0.06, 0.06, 0.18):
        at.box(x, 0.7, 0.19, 0.03, 0.5, 0.03, frame)
    at.box(0, 0.95, 0.19, 0.42, 0.06, 0.03, frame)


def sofa(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A sofa with cushions; its back is towards +z."""
    cover = surfaces.fabric(at.build)
    deep = min(deep, 1.0)
    at.box(0, 0.25, 0, wide, 0.34, deep, cover)
    at.box(0, 0.55, deep / 2 - 0.1, wide, 0.6, 0.2, cover, pitch=-0.1)
    for side in (-1, 1):
        at.box(side * (wide / 2 - 0.09), 0.4, 0, 0.18, 0.45, deep, cover)
    for _ in range(rng.integers(1, 5)):
        x = rng.uniform(-0.35, 0.35) * wide
        at.box(x, 0.6, deep / 2 - 0.3, 0.4, 0.35, 0.12, surfaces.fabric(at.build), rng.uniform(-0.3, 0.3), -0.35)


def bed(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A bed with a cover and pillows; its head is towards +z."""
    at.box(0, 0.18, 0, wide, 0.36, deep, surfaces.wood(at.build))
    at.box(0, 0.45, -0.1, wide * 0.97, 0.2, deep * 0.85, surfaces.fabric(at.build))
    at.box(0, 0.6, deep / 2 - 0.04, wide, 1.1, 0.08, surfaces.anything(at.build))
    pillow = surfaces.fabric(at.build)
    for x in (-0.25, 0.25):
        at.ellipsoid(x * wide, 0.56, deep / 2 - 0.35, 0.4 * wide, 0.18, 0.45, pillow)


def shelf(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A bookcase; its back is towards +z."""
    build, look, tall = at.build, surfaces.wood(at.build), rng.uniform(1.0, 2.1)
    deep = min(deep, 0.35)
    for x in (-wide / 2 + 0.012, wide / 2 - 0.012):
        at.box(x, tall / 2, 0, 0.025, tall, deep, look)
    at.box(0, tall / 2, deep / 2 - 0.01, wide, tall, 0.02, look)
    levels = int(tall / 0.35)
    for k in range(levels + 1):
        up = 0.06 + k * (tall - 0.08) / levels
        at.box(0, up, 0, wide, 0.025, deep, look)
        if k < levels and rng.random() < 0.75:
            share = rng.uniform(0.4, 0.92)
            books = build.look(Pattern.BOOKS, (0.5, 0.5, 0.5), size=(rng.uniform(0.025, 0.05), 0.2))
            at.box((share - 1) * wide / 2 + 0.02, up + 0.13, 0.02, share * wide - 0.06, 0.22, deep * 0.75, books)
        elif k < levels:
            clutter(at, rng, up + 0.012, wide * 0.8, deep * 0.5, 3)


def cabinet(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A chest or cupboard with drawers or doors, and things on top."""
    build, tall = at.build, rng.choice((rng.uniform(0.5, 1.0), rng.uniform(1.7, 2.1)))
    light, dark = surfaces.wood_colors(build.rng)
    if rng.random() < 0.4:
        light = surfaces.any_color(rng, 0.5, 0.4, 0.95)
    size = (wide / rng.integers(1, 4), tall / rng.integers(1, 5))
    front = build.look(Pattern.TILES, light, surfaces.shade(light, 0.85), dark, size=size, share=0.03, mottle=0.1)
    at.box(0, tall / 2, 0, wide, tall, min(deep, 0.6), front)
    knob = surfaces.plain(build, 0.3)
    for k in range(rng.integers(1, 4)):
        at.ellipsoid((k - 1) * wide / 4, 0.6 * tall, -min(deep, 0.6) / 2, 0.04, 0.04, 0.04, knob)
    if tall < 1.2:
        clutter(at, rng, tall, wide, min(deep, 0.6), 5)


def lamp(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A standing lamp with a bright shade."""
    build, tall = at.build, rng.uniform(1.3, 1.8)
    at.cylinder(0, 0.015, 0, 0.15, 0.03, surfaces.plain(build))
    at.cylinder(0, tall / 2, 0, 0.015, tall, surfaces.plain(build, 0.2))
    shade = build.look(Pattern.PLAIN, surfaces.any_color(rng, 0.4, 0.7, 1.0), glow=rng.uniform(0.3, 1.5))
    if rng.random() < 0.5:
        at.cylinder(0, tall, 0, 0.18, 0.28, shade)
    else:
        at.ellipsoid(0, tall, 0, 0.35, 0.35, 0.35, shade)


def plant(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A pot with leaves."""
    build, size = at.build, rng.uniform(0.15, 0.25)
    at.cylinder(0, size, 0, size * 0.8, 2 * size, surfaces.anything(build))
    green = (rng.uniform(0.02, 0.15), rng.uniform(0.1, 0.35), rng.uniform(0.01, 0.1))
    leaf = build.look(Pattern.STONE, green, surfaces.shade(green, 0.3), size=(0.08, 0.08), share=0, mottle=0.5)
    for _ in range(rng.integers(5, 14)):
        x, z = rng.normal(0, size * 0.8, size=2)
        wide, tall, deep = rng.uniform(0.08, 0.35, size=3)
        at.ellipsoid(x, 2 * size + rng.uniform(0.0, 4 * size), z, wide, tall, deep, leaf)


def crates(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """Boxes on one another, each turned a little."""
    up = 0.0
    for _ in range(rng.integers(1, 4)):
        tall = rng.uniform(0.2, 0.45)
        sides = rng.uniform(0.5, 1.0, size=2) * (min(wide, 0.6), min(deep, 0.6))
        at.box(0, up + tall / 2, 0, sides[0], tall, sides[1], surfaces.anything(at.build), rng.uniform(-0.5, 0.5))
        up += tall


def board(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A large board leaning back, as an easel or a slide."""
    tall, lean = rng.uniform(0.8, 1.7), rng.uniform(0.15, 0.6)
    look = surfaces.picture(at.build)
    at.box(0, tall / 2, 0, min(wide, 1.2), tall, 0.03, look, pitch=-lean)


def ball(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A ball, a drum or a column."""
    size = rng.uniform(0.25, 0.7)
    kind = rng.integers(3)
    if kind == 0:
        at.ellipsoid(0, size / 2, 0, size, size, size, surfaces.anything(at.build))
    else:
        tall = rng.uniform(0.3, 0.6) if kind == 1 else 2.0
        at.cylinder(0, tall / 2, 0, size / 2, tall, surfaces.anything(at.build))


def stairs(at: Place, rng: np.random.Generator, wide: float, deep: float) -> None:
    """A few steps."""
    look, count = surfaces.floor(at.build), rng.integers(3, 7)
    run = deep / count
    for k in range(count):
        tall = 0.17 * (k + 1)
        at.box(0, tall / 2, -deep / 2 + (k + 0.5) * run, wide, tall, run, look)


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
"""Pieces with the width and depth in metres that they take."""
