"""Pieces of furniture made of boxes, ellipsoids and cylinders. Each stands on the floor at a `Place`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from pansplat_homes import materials
from pansplat_homes.library import FurniturePiece
from pansplat_homes.meshes import MeshMaterial
from pansplat_homes.plans import Plan, Rectangle, RoomKind, overlaps
from pansplat_homes.scene import SceneBuilder
from pansplat_homes.textures import Pattern


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

    def add_mesh(self, piece: FurniturePiece, x, up, z, size, yaw=0.0) -> None:
        """Add a piece of the library with random colours; its lower side is centred at (x, up, z)."""
        found = [_mesh_material(self.builder, piece.category, material) for material in piece.mesh.materials]
        half = (size[0] / 2, size[1] / 2, size[2] / 2)
        self.builder.add_mesh(piece.mesh, self._world(x, up + half[1], z), half, found, self.yaw + yaw)


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
        if _add_small_piece(place, rng, x, up, z, min(width, depth)):
            continue
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


def screen(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A television on a low board."""
    board, black = materials.wood(place.builder), materials.paint(place.builder, (0.015, 0.015, 0.02))
    high, wide = rng.uniform(0.35, 0.6), rng.uniform(0.8, 1.0) * width
    place.add_box(0, high / 2, 0, width, high, depth, board)
    place.add_box(0, high + 0.06, 0.05, 0.3, 0.12, 0.15, black)
    place.add_box(0, high + 0.1 + 0.28 * wide, 0.05, wide, 0.56 * wide, 0.04, black)


def chair(place: Place, rng: np.random.Generator, width: float, depth: float) -> None:
    """A chair with a slatted or a full back."""
    _chair(place, rng, materials.wood(place.builder), materials.random_material(place.builder))


def _chair(place: Place, rng: np.random.Generator, frame: int, seat: int) -> None:
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


_LIBRARY: dict[Piece, tuple[str, ...]] = {
    sofa: ("sofa",),
    bed: ("bed",),
    shelf: ("shelf", "piano", "wardrobe"),
    cabinet: ("cabinet", "wardrobe", "nightstand", "cabinet"),
    table: ("desk", "table", "coffee table"),
    screen: ("cabinet", "fireplace", "shelf"),
    chair: ("chair", "chair", "armchair", "office chair", "stool"),
    lamp: ("lamp", "speaker", "plant"),
    plant: ("plant",),
    crates: ("box", "bin", "toy", "washing machine"),
    board: ("gear",),
    ball: ("toy", "game", "gear"),
}
"""Categories of the library for which our own pieces stand."""


def _library_piece(builder: SceneBuilder, own: Piece) -> tuple[Piece, float, float, float] | None:
    """Sometimes a piece of the library in place of `own`, with its width, depth and height in metres."""
    rng = builder.rng
    if builder.library is None or own not in _LIBRARY or rng.random() > 0.5:
        return None
    categories = _LIBRARY[own]
    pieces = builder.library.by_category.get(categories[rng.integers(len(categories))], ())
    if not pieces:
        return None
    chosen = pieces[rng.integers(len(pieces))]
    width, height, depth = np.array(chosen.size) * rng.uniform(0.9, 1.1)
    return partial(_place_mesh, chosen, height), width, depth, height


def add_fixture(place: Place, category: str, width: float, depth: float) -> float:
    """Sometimes add a piece of the library to a place at a wall; its upper side above the floor in metres, or 0.

    Args:
        width, depth: size of the place, metres; pieces that are slightly larger are reduced.
    """
    builder = place.builder
    if builder.library is None or builder.rng.random() > 0.45:
        return 0.0
    pieces = builder.library.by_category.get(category, ())
    pieces = [piece for piece in pieces if min(width / piece.size[0], depth / piece.size[2]) > 0.85]
    if not pieces:
        return 0.0
    chosen = pieces[builder.rng.integers(len(pieces))]
    scale = min(1.0, width / chosen.size[0], depth / chosen.size[2])
    size = (scale * chosen.size[0], scale * chosen.size[1], scale * chosen.size[2])
    place.add_mesh(chosen, 0, chosen.elevation, (depth - size[2]) / 2, size)
    return chosen.elevation + size[1]


def _add_small_piece(place: Place, rng: np.random.Generator, x: float, up: float, z: float, space: float) -> bool:
    """Sometimes add a small piece of the library that fits into a space (metres); whether one was added."""
    if place.builder.library is None or rng.random() > 0.5:
        return False
    kinds = place.builder.library.by_category
    pieces = kinds.get(("small", "small", "table plant", "table lamp")[rng.integers(4)], ())
    pieces = [piece for piece in pieces if max(piece.size[0], piece.size[2]) < 0.8 * space]
    if not pieces:
        return False
    chosen = pieces[rng.integers(len(pieces))]
    turned = rng.normal(0, 0.4) if rng.random() < 0.7 else rng.uniform(0, 2 * np.pi)
    place.add_mesh(chosen, x, up, z, chosen.size, turned)
    return True


def _place_mesh(
    chosen: FurniturePiece, height: float, place: Place, rng: np.random.Generator, width: float, depth: float
) -> None:
    """Place a piece of the library; its back is towards +z."""
    place.add_mesh(chosen, 0, chosen.elevation, 0, (width, height, depth))


def _mesh_material(builder: SceneBuilder, category: str, material: MeshMaterial) -> int:
    """The material of a mesh, often with another colour or cloth."""
    rng = builder.rng
    if material.texture is not None:
        tint = np.array(material.color) * (materials.random_color(rng, 0.3, 0.8, 1.0) if rng.random() < 0.4 else 1.0)
        return builder.add_image_material(material.texture, tuple(tint), gloss=material.gloss)
    kind = rng.random()
    if kind < 0.25 and category in ("sofa", "bed", "armchair"):
        return materials.fabric(builder)
    if kind < 0.25 and category in ("cabinet", "wardrobe", "nightstand", "shelf", "table", "coffee table", "desk"):
        return materials.wood(builder)
    if kind < 0.5 and category in ("sofa", "bed", "armchair", "chair", "stool", "office chair", "lamp", "box", "toy"):
        color = materials.random_color(rng, 0.5)
    else:
        color = materials.shade(material.color, rng.uniform(0.6, 1.2))
    return builder.add_material(Pattern.PLAIN, color, mottle=rng.uniform(0.05, 0.3), gloss=material.gloss)


_Choice = tuple[Piece, float, float, float]
"""A piece, its nominal width and depth in metres, and its weight."""

_AGAINST_WALL: dict[RoomKind, tuple[_Choice, ...]] = {
    RoomKind.LIVING: (
        (sofa, 2.0, 0.95, 3),
        (shelf, 1.2, 0.36, 2),
        (cabinet, 1.4, 0.5, 2),
        (table, 1.3, 0.6, 1),
        (lamp, 0.5, 0.5, 1),
        (plant, 0.6, 0.6, 1),
        (screen, 1.5, 0.45, 2),
    ),
    RoomKind.DINING: ((cabinet, 1.4, 0.5, 2), (shelf, 1.0, 0.36, 1), (plant, 0.6, 0.6, 1), (table, 1.2, 0.6, 1)),
    RoomKind.KITCHEN: ((cabinet, 0.8, 0.5, 1), (shelf, 0.8, 0.36, 1), (table, 1.0, 0.7, 1)),
    RoomKind.BEDROOM: (
        (bed, 1.6, 2.1, 5),
        (cabinet, 1.2, 0.55, 3),
        (cabinet, 0.5, 0.4, 2),
        (shelf, 1.0, 0.36, 1),
        (table, 1.2, 0.6, 1),
        (plant, 0.6, 0.6, 1),
    ),
    RoomKind.BATHROOM: ((crates, 0.4, 0.4, 1), (shelf, 0.5, 0.3, 1), (plant, 0.4, 0.4, 1)),
    RoomKind.HALL: ((cabinet, 0.9, 0.35, 2), (shelf, 0.8, 0.3, 1), (plant, 0.4, 0.4, 1)),
    RoomKind.UTILITY: ((shelf, 1.0, 0.4, 2), (crates, 0.5, 0.5, 2), (cabinet, 0.8, 0.5, 1)),
    RoomKind.CLOSET: ((crates, 0.4, 0.4, 1),),
    RoomKind.ALCOVE: ((shelf, 0.9, 0.36, 1), (plant, 0.5, 0.5, 1), (table, 1.0, 0.5, 1)),
}
_STANDING: tuple[_Choice, ...] = (
    (chair, 0.5, 0.5, 3),
    (table, 1.1, 0.7, 1.5),
    (lamp, 0.4, 0.4, 1),
    (plant, 0.6, 0.6, 1),
    (crates, 0.6, 0.6, 1),
    (board, 1.0, 0.7, 0.3),
    (ball, 0.6, 0.6, 0.5),
)
_WALL_DENSITY = (0.0, 0.12, 0.3, 0.5)  # pieces per square metre, by furnishing
_FLOOR_DENSITY = (0.0, 0.04, 0.12, 0.35)


def furnish(builder: SceneBuilder, plan: Plan, index: int, occupied: list[Rectangle], furnishing: int) -> None:
    """Add furniture of a room's kind along its walls and in it; `occupied` gets the floor that it covers."""
    rng, room = builder.rng, plan.rooms[index]
    is_staged = rng.random() < (0.0, 0.5, 0.95, 1.0)[furnishing]
    if not is_staged:
        return
    interior = plan.interior(index)
    area, sides = (interior[2] - interior[0]) * (interior[3] - interior[1]), plan.sides(index)
    if room.kind in (RoomKind.LIVING, RoomKind.BEDROOM, RoomKind.DINING) and rng.random() < 0.45:
        _add_rug(builder, interior)
    if room.kind == RoomKind.DINING or (room.kind == RoomKind.KITCHEN and area > 10):
        _add_dining_table(builder, interior, occupied)
    against = _AGAINST_WALL[room.kind]
    weights = np.array([choice[3] for choice in against])
    for attempt in range(round(2 + area * _WALL_DENSITY[furnishing] * rng.uniform(0.5, 1.5))):
        chosen = 0 if attempt == 0 else rng.choice(len(against), p=weights / weights.sum())
        piece, width, depth, _ = against[chosen]
        width *= rng.uniform(0.8, 1.2)
        high = 2.1 if piece in (shelf, cabinet) and rng.random() < 0.6 else 0.9
        is_centred = piece in (sofa, bed) and rng.random() < 0.6
        if (found := _library_piece(builder, piece)) is not None:
            piece, width, depth, high = found
        side = sides[rng.integers(4)]
        spans = [(a, b) for a, b in side.free_spans(high, depth + 0.1, occupied) if b - a > width + 0.04]
        if not spans:
            continue
        low, end = spans[rng.integers(len(spans))]
        along = rng.uniform(low + width / 2 + 0.02, end - width / 2 - 0.02)
        if is_centred:
            along = (low + end) / 2
        occupied.append(side.area(along - width / 2, along + width / 2, depth + 0.25))
        piece(Place(builder, *side.point(along, depth / 2 + 0.03), side.yaw), rng, width, depth)
    weights = np.array([choice[3] for choice in _STANDING])
    for _ in range(round(area * _FLOOR_DENSITY[furnishing] * rng.uniform(0.3, 1.7))):
        piece, width, depth, _ = _STANDING[rng.choice(len(_STANDING), p=weights / weights.sum())]
        if (found := _library_piece(builder, piece)) is not None:
            piece, width, depth, _ = found
        reach = 0.5 * float(np.hypot(width, depth))
        x, z = rng.uniform(interior[0], interior[2]), rng.uniform(interior[1], interior[3])
        place = (x - reach, z - reach, x + reach, z + reach)
        if _is_free(place, occupied, interior):
            occupied.append(place)
            piece(Place(builder, x, z, rng.uniform(0, 2 * np.pi)), rng, width, depth)


def _is_free(place: Rectangle, occupied: list[Rectangle], room: Rectangle) -> bool:
    x0, z0, x1, z1 = place
    if x0 < room[0] + 0.02 or z0 < room[1] + 0.02 or x1 > room[2] - 0.02 or z1 > room[3] - 0.02:
        return False
    return not overlaps(place, occupied)


def _add_rug(builder: SceneBuilder, room: Rectangle) -> None:
    rng = builder.rng
    width, depth = (rng.uniform(0.35, 0.7) * (room[k + 2] - room[k]) for k in (0, 1))
    kind = rng.random()
    if kind < 0.5:
        colors = [materials.random_color(rng, 0.4) for _ in range(3)]
        material = builder.add_material(Pattern.RUG, *colors, size=rng.uniform(0.04, 0.15), mottle=0.4)
    else:
        material = materials.carpet(builder) if kind < 0.75 else materials.fabric(builder)
    x, z = (room[0] + room[2]) / 2, (room[1] + room[3]) / 2
    builder.add_box((x, -0.004, z), (width / 2, 0.008, depth / 2), material)


def _add_dining_table(builder: SceneBuilder, room: Rectangle, occupied: list[Rectangle]) -> None:
    """Add a table with chairs around it in the middle of a room, if there is space."""
    rng = builder.rng
    width, depth = rng.uniform(1.1, 2.0), rng.uniform(0.8, 1.0)
    x, z, is_along_x = (room[0] + room[2]) / 2, (room[1] + room[3]) / 2, room[2] - room[0] > room[3] - room[1]
    half = (width / 2 + 0.15, depth / 2 + 0.45) if is_along_x else (depth / 2 + 0.45, width / 2 + 0.15)
    area = (x - half[0], z - half[1], x + half[0], z + half[1])
    if not _is_free(area, occupied, room):
        return
    occupied.append(area)
    yaw = 0.0 if is_along_x else np.pi / 2
    place = Place(builder, x, z, yaw)
    wood = materials.wood(builder)
    place.add_box(0, 0.74, 0, width, 0.04, depth, wood)
    _add_legs(place, wood, width, depth, 0.74, 0.07, bool(rng.random() < 0.3))
    clutter(place, rng, 0.76, width, depth, 5)
    seat = materials.random_material(builder)
    frame = materials.wood(builder)
    count = max(1, round(width / 0.6))
    for k in range(count):
        for sign in (-1, 1):
            along, across = (k + 0.5) * width / count - width / 2, sign * (depth / 2 + rng.uniform(0.0, 0.2))
            dx, dz = place.cos * along + place.sin * across, -place.sin * along + place.cos * across
            turn = yaw + (0 if sign > 0 else np.pi) + rng.normal(0, 0.1)
            _chair(Place(builder, x + dx, z + dz, turn), rng, frame, seat)
