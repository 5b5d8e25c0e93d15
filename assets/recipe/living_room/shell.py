"""The modelled parts of a room: walls with openings, windows, doors, curtains, picture frames and cushions.

Blender's world: x east, y north, z up, metres. Meshes have world coordinates, because finishes depend on the position.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import bpy
import finishes
import numpy as np

Material = bpy.types.Material
Box = tuple[float, float, float, float, float, float]


def mesh(
    name: str,
    vertices: Sequence[Sequence[float]],
    faces: Sequence[Sequence[int]],
    material: Material,
    *,
    uvs: Sequence[Sequence[float]] | None = None,
    smooth: bool = False,
) -> bpy.types.Object:
    """Add a mesh object to the scene; `uvs` has one entry per vertex."""
    data = bpy.data.meshes.new(name)
    data.from_pydata(vertices, [], faces)
    if uvs is not None:
        layer = data.uv_layers.new()
        for loop in data.loops:
            layer.data[loop.index].uv = uvs[loop.vertex_index]
    for polygon in data.polygons:
        polygon.use_smooth = smooth
    data.materials.append(material)
    item = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(item)
    return item


_CORNERS = [(0, 2, 4), (1, 2, 4), (1, 3, 4), (0, 3, 4), (0, 2, 5), (1, 2, 5), (1, 3, 5), (0, 3, 5)]
_SIDES = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]


def boxes(name: str, items: Sequence[Box], material: Material) -> bpy.types.Object:
    """Add boxes (x0, x1, y0, y1, z0, z1) as one object."""
    vertices, faces = [], []
    for box in items:
        faces += [[len(vertices) + i for i in side] for side in _SIDES]
        vertices += [[box[i] for i in corner] for corner in _CORNERS]
    return mesh(name, vertices, faces, material)


@dataclass(frozen=True)
class Opening:
    """A hole in a wall, from `start` to `end` along it and `bottom` to `top` in height, metres."""

    start: float
    end: float
    bottom: float
    top: float


@dataclass(frozen=True)
class Wall:
    """A straight wall along `axis` (0 x, 1 y); `low` and `high` bound it on the other axis.

    `inside` is the sign of the direction across the wall towards the room.
    """

    axis: int
    start: float
    end: float
    low: float
    high: float
    height: float
    inside: int
    openings: tuple[Opening, ...] = ()

    def box(self, a: float, b: float, across0: float, across1: float, z0: float, z1: float) -> Box:
        """A box from coordinates along and across the wall."""
        across0, across1 = sorted((across0, across1))
        return (a, b, across0, across1, z0, z1) if self.axis == 0 else (across0, across1, a, b, z0, z1)

    @property
    def face(self) -> float:
        """Coordinate, across the wall, of the surface that is visible from the room."""
        return self.high if self.inside > 0 else self.low

    def solid(self) -> list[Box]:
        """The wall as boxes around its openings."""
        cuts = sorted({self.start, self.end, *(x for o in self.openings for x in (o.start, o.end))})
        result = []
        for a, b in pairwise(cuts):
            bottom = 0.0
            for o in sorted(self.openings, key=lambda o: o.bottom):
                if o.start <= a and b <= o.end:
                    if o.bottom > bottom:
                        result.append(self.box(a, b, self.low, self.high, bottom, o.bottom))
                    bottom = o.top
            result.append(self.box(a, b, self.low, self.high, bottom, self.height))
        return result

    def strip(self, z0: float, z1: float, depth: float) -> list[Box]:
        """A skirting board or moulding along the wall, interrupted at openings."""
        spans, x = [], self.start
        for o in sorted(self.openings, key=lambda o: o.start):
            if o.bottom < z1 and o.top > z0:
                spans.append((x, o.start))
                x = o.end
        spans.append((x, self.end))
        edge = self.face + self.inside * depth
        return [self.box(a, b, self.face, edge, z0, z1) for a, b in spans if b > a]

    def casing(self, o: Opening, width: float = 0.09, depth: float = 0.03) -> list[Box]:
        """Boards around an opening, on the side of the room."""
        edge = self.face + self.inside * depth
        sides = [
            self.box(o.start - width, o.start, self.face, edge, o.bottom, o.top + width),
            self.box(o.end, o.end + width, self.face, edge, o.bottom, o.top + width),
            self.box(o.start, o.end, self.face, edge, o.top, o.top + width),
        ]
        if o.bottom > 0:
            sill = self.face + self.inside * 0.12
            sides.append(self.box(o.start - width, o.end + width, self.face, sill, o.bottom - 0.04, o.bottom))
        return sides

    def sashes(self, o: Opening, columns: int = 2, rows: int = 2, bar: float = 0.045) -> list[Box]:
        """The wooden bars of a window, in the middle of the wall."""
        middle = (self.low + self.high) / 2
        parts = []
        for i in range(columns + 1):
            x = o.start + (o.end - o.start) * i / columns
            a = min(max(x - bar / 2, o.start), o.end - bar)
            parts.append(self.box(a, a + bar, middle - 0.03, middle + 0.03, o.bottom, o.top))
        for i in range(rows + 1):
            z = o.bottom + (o.top - o.bottom) * i / rows
            b = min(max(z - bar / 2, o.bottom), o.top - bar)
            parts.append(self.box(o.start, o.end, middle - 0.025, middle + 0.025, b, b + bar))
        return parts

    def door(self, o: Opening, panels: int = 3) -> list[Box]:
        """A closed panelled door in an opening."""
        back = self.face - self.inside * 0.04
        parts = [self.box(o.start, o.end, back, back - self.inside * 0.04, o.bottom, o.top)]
        step = (o.top - o.bottom - 0.12) / panels
        for i in range(panels):
            z = o.bottom + 0.12 + i * step
            for a, b in ((o.start + 0.1, (o.start + o.end) / 2 - 0.05), ((o.start + o.end) / 2 + 0.05, o.end - 0.1)):
                parts.append(self.box(a, b, back, back + self.inside * 0.018, z, z + step - 0.12))
        return parts

    def portal(self, o: Opening) -> None:
        """Add a light portal, where the path tracer samples daylight."""
        light = bpy.data.lights.new("portal", "AREA")
        light.shape, light.size, light.size_y = "RECTANGLE", o.end - o.start, o.top - o.bottom
        light.cycles.is_portal = True
        item = bpy.data.objects.new("portal", light)
        along, across, z = (o.start + o.end) / 2, (self.low + self.high) / 2, (o.bottom + o.top) / 2
        item.location = (along, across, z) if self.axis == 0 else (across, along, z)
        turn = {(0, 1): 0.0, (0, -1): math.pi, (1, 1): -math.pi / 2, (1, -1): math.pi / 2}[self.axis, self.inside]
        item.rotation_euler = (math.pi / 2, 0.0, turn)
        bpy.context.scene.collection.objects.link(item)


def curtain(
    wall: Wall, start: float, end: float, bottom: float, top: float, material: Material, seed: int
) -> bpy.types.Object:
    """Add a hanging curtain whose folds are deeper near the floor."""
    rng = np.random.default_rng(seed)
    columns, rows = 120, 14
    s, t = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    folds = 2 * math.pi * 7 * s + rng.uniform(-0.8, 0.8) * np.sin(2 * math.pi * (s * 2 + rng.uniform())) * 2
    depth = 0.10 + (0.025 + 0.02 * t) * np.sin(folds) + 0.012 * np.sin(2.3 * folds + 3 * t)
    along = start + (end - start) * (s + 0.015 * np.sin(folds * 0.5 + 4 * t))
    across = wall.face + wall.inside * depth
    height = top + (bottom - top) * t
    points = np.stack((along, across, height) if wall.axis == 0 else (across, along, height), -1).reshape(-1, 3)
    faces = [
        (r * columns + c, r * columns + c + 1, (r + 1) * columns + c + 1, (r + 1) * columns + c)
        for r in range(rows - 1)
        for c in range(columns - 1)
    ]
    return mesh("curtain", points.tolist(), faces, material, smooth=True)


def framed(
    wall: Wall, along: float, height: float, size: tuple[float, float], image: bpy.types.Image, frame: Material
) -> None:
    """Add a framed picture of `size` (width, height) metres on a wall, with its centre at `height`."""
    width, tall = size
    rim, out = 0.045, wall.inside
    a, b, z0, z1 = along - width / 2, along + width / 2, height - tall / 2, height + tall / 2
    edge, canvas = wall.face + out * 0.035, wall.face + out * 0.02
    boxes(
        "frame",
        [
            wall.box(a - rim, b + rim, wall.face, edge, z1, z1 + rim),
            wall.box(a - rim, b + rim, wall.face, edge, z0 - rim, z0),
            wall.box(a - rim, a, wall.face, edge, z0, z1),
            wall.box(b, b + rim, wall.face, edge, z0, z1),
        ],
        frame,
    )
    # As seen from the room, the picture's left side is at the wall's low end if the room is south or east of the wall.
    mirrored = wall.inside > 0 if wall.axis == 0 else wall.inside < 0
    left, right = (b, a) if mirrored else (a, b)
    corners = [(left, z0), (right, z0), (right, z1), (left, z1)]
    points = [(x, canvas, z) if wall.axis == 0 else (canvas, x, z) for x, z in corners]
    mesh("picture", points, [(0, 1, 2, 3)], finishes.picture(image), uvs=[(0, 0), (1, 0), (1, 1), (0, 1)])


def cushion(center: Sequence[float], size: float, turn: float, lean: float, material: Material) -> None:
    """Add a square cushion that leans back by `lean` radians."""
    n = 25
    s, t = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    bulge = 0.32 * size * ((1 - s**2) * (1 - t**2)) ** 0.45
    pinch = 1 - 0.08 * (np.abs(s * t)) ** 2 + 0.03 * (s**2 - t**2) ** 2
    points, faces = [], []
    for sign in (1, -1):
        base = len(points)
        sheet = np.stack((s * pinch * size / 2, sign * bulge, t * pinch * size / 2), -1).reshape(-1, 3)
        points += sheet.tolist()
        for r in range(n - 1):
            for c in range(n - 1):
                quad = [base + r * n + c, base + r * n + c + 1, base + (r + 1) * n + c + 1, base + (r + 1) * n + c]
                faces.append(quad if sign < 0 else quad[::-1])
    item = mesh("cushion", points, faces, material, smooth=True)
    item.rotation_euler = (-lean, 0.0, turn)
    item.location = center
