"""Build a furnished living room with a dining room behind it, and render posed panoramas with exact depth.

    python living_room.py --sources FOLDER --out ../../living_room

FOLDER holds the files that fetch.sh downloads. Needs bpy 4.2.0 (Blender as a Python module), numpy and Pillow; see
README.md.

Blender's world is x east, y north, z up; the sample's is x east, y down, z north, so that gravity is +y.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import bpy
import finishes as f
import numpy as np
import panoramas
import pictures
from furniture import Furniture, unpack
from shell import Box, Opening, Wall, boxes, curtain, cushion, framed

HEIGHT = 2.72  # of the ceiling, metres


@dataclass(frozen=True)
class RoomStyle:
    """Properties that depend on the seed. Colours are linear RGB."""

    wall: f.Color = (0.66, 0.54, 0.38)
    second_wall: f.Color = (0.30, 0.42, 0.40)
    panel: f.Color = (0.38, 0.43, 0.35)
    floor: f.Color = (0.22, 0.125, 0.066)
    sofa: f.Color = (0.21, 0.060, 0.022)
    chair: f.Color = (0.07, 0.20, 0.20)
    drape: f.Color = (0.42, 0.13, 0.06)
    sun_degrees: float = 212.0
    jitter: float = 0.0

    @staticmethod
    def from_seed(seed: int) -> RoomStyle:
        """The shipped room for seed 0; other seeds change colours, the sun and the positions of furniture."""
        if seed == 0:
            return RoomStyle()
        rng = np.random.default_rng(seed)

        def near(color: f.Color, hue: bool = True) -> f.Color:
            shuffled = rng.permutation(color) if hue and rng.random() < 0.6 else np.array(color)
            return tuple((shuffled * rng.uniform(0.7, 1.35, 3)).clip(0.01, 0.8).tolist())

        base = RoomStyle()
        return RoomStyle(
            near(base.wall), near(base.second_wall), base.panel, near(base.floor, False), near(base.sofa),
            near(base.chair), near(base.drape), rng.uniform(150, 230), 0.12,
        )  # fmt: skip


WINDOWS = (Opening(-2.45, -1.0, 0.72, 2.32), Opening(0.9, 2.35, 0.72, 2.32))
FAR_WINDOW = Opening(4.5, 6.1, 0.72, 2.32)
END_WINDOW = Opening(-1.15, 0.75, 0.72, 2.32)
ARCH = Opening(-1.05, 1.0, 0.0, 2.28)
DOOR = Opening(1.95, 2.8, 0.0, 2.08)

SOUTH = Wall(0, -3.45, 3.45, -2.85, -2.6, HEIGHT, 1, WINDOWS)
NORTH = Wall(0, -3.45, 3.45, 2.6, 2.8, HEIGHT, -1, (DOOR,))
WEST = Wall(1, -2.6, 2.6, -3.5, -3.3, HEIGHT, 1)
EAST = Wall(1, -2.6, 2.6, 3.3, 3.46, HEIGHT, -1, (ARCH,))
SOUTH2 = Wall(0, 3.45, 7.4, -2.85, -2.6, HEIGHT, 1, (FAR_WINDOW,))
NORTH2 = Wall(0, 3.45, 7.4, 2.6, 2.8, HEIGHT, -1)
END = Wall(1, -2.6, 2.6, 7.2, 7.45, HEIGHT, -1, (END_WINDOW,))
BACK_OF_EAST = Wall(1, -2.6, 2.6, 3.3, 3.46, HEIGHT, 1, (ARCH,))


def build_shell(style: RoomStyle) -> None:
    """Add floor, ceiling, walls, windows, doors and mouldings of both rooms."""
    painted, trim = f.plaster(style.wall), f.wood(style.panel, axis=2, fineness=0.5)
    second = f.plaster(style.second_wall)
    beam = f.wood((0.20, 0.105, 0.05), axis=1, fineness=0.8)
    boxes("walls", SOUTH.solid() + NORTH.solid() + EAST.solid(), painted)
    boxes("chimney wall", WEST.solid(), f.bricks((0.45, 0.19, 0.11), (0.26, 0.10, 0.065)))
    boxes("walls beyond", SOUTH2.solid() + NORTH2.solid() + END.solid(), second)
    boxes("lining beyond", _lining(BACK_OF_EAST), second)
    boxes("floor", [(-3.5, 7.5, -2.9, 2.9, -0.1, 0.0)], f.planks(style.floor))
    boards = f.planks((0.70, 0.67, 0.60), 1.9, 0.105, 0.16)
    boxes("ceiling", [(-3.5, 7.5, -2.9, 2.9, HEIGHT, HEIGHT + 0.1)], boards)
    boxes("beams", [(x - 0.075, x + 0.075, -2.6, 2.6, HEIGHT - 0.15, HEIGHT) for x in np.arange(-2.5, 7.2, 1.32)], beam)
    for wall in (SOUTH, NORTH, EAST, WEST, SOUTH2, NORTH2, END, BACK_OF_EAST):
        boxes("skirting", wall.strip(0.0, 0.13, 0.022) + wall.strip(HEIGHT - 0.07, HEIGHT, 0.03), trim)
        for opening in wall.openings:
            boxes("casing", wall.casing(opening), trim)
    # Wainscot with stiles, below the chair rail of the north and east walls.
    for wall, top in ((NORTH, 0.80), (EAST, 0.80), (SOUTH, 0.62)):
        boxes("wainscot", wall.strip(0.13, top, 0.012) + wall.strip(top, top + 0.05, 0.035), trim)
        edge = wall.face + wall.inside * 0.026
        stiles = [x for x in np.arange(wall.start + 0.3, wall.end, 0.52) if not _crosses(wall, x, top)]
        boxes("stiles", [wall.box(x, x + 0.07, wall.face, edge, 0.13, top) for x in stiles], trim)
    for wall, opening in ((SOUTH, WINDOWS[0]), (SOUTH, WINDOWS[1]), (SOUTH2, FAR_WINDOW), (END, END_WINDOW)):
        boxes("window", wall.sashes(opening, 2 if wall is not END else 3), trim)
        wall.portal(opening)
    boxes("door", NORTH.door(DOOR), f.wood((0.33, 0.17, 0.075), axis=2))
    knob = (DOOR.start + 0.06, DOOR.start + 0.11, 2.55, 2.64, 1.0, 1.05)
    boxes("knob", [knob], f.leather((0.5, 0.36, 0.12)))


def _crosses(wall: Wall, x: float, top: float) -> bool:
    return any(o.start - 0.15 < x < o.end + 0.1 and o.bottom < top for o in wall.openings)


def _lining(wall: Wall) -> list[Box]:
    """Thin boxes that give this side of a shared wall its own colour."""
    return [
        wall.box(a, b, wall.face, wall.face + wall.inside * 0.008, z0, z1)
        for a, b, z0, z1 in (
            (wall.start, ARCH.start, 0.0, HEIGHT),
            (ARCH.end, wall.end, 0.0, HEIGHT),
            (ARCH.start, ARCH.end, ARCH.top, HEIGHT),
        )
    ]


def hang_curtains(style: RoomStyle) -> None:
    """Add curtains on a rod left and right of each window."""
    cloth = f.fabric(style.drape, 0.3, 60.0)
    rod = f.wood((0.16, 0.08, 0.04), axis=0)
    for k, (wall, o) in enumerate(((SOUTH, WINDOWS[0]), (SOUTH, WINDOWS[1]), (SOUTH2, FAR_WINDOW), (END, END_WINDOW))):
        for side, (a, b) in enumerate(((o.start - 0.34, o.start + 0.10), (o.end - 0.10, o.end + 0.34))):
            curtain(wall, a, b, 0.04, 2.46, cloth, 10 * k + side)
        near, far = wall.face + wall.inside * 0.085, wall.face + wall.inside * 0.115
        boxes("rod", [wall.box(o.start - 0.45, o.end + 0.45, near, far, 2.45, 2.48)], rod)


def books(x: float, y: float, z: float, count: int, seed: int, flat: bool = False) -> None:
    """Add a row of books, or a pile if `flat`, that starts at (x, y, z)."""
    rng = np.random.default_rng(seed)
    colors = [(0.35, 0.05, 0.04), (0.05, 0.12, 0.25), (0.06, 0.2, 0.1), (0.45, 0.3, 0.08), (0.3, 0.26, 0.2)]
    for _ in range(count):
        cover = f.fabric(colors[int(rng.integers(5))], 0.4, 140.0)
        thick, wide, tall = rng.uniform(0.022, 0.05), rng.uniform(0.14, 0.19), rng.uniform(0.2, 0.27)
        if flat:
            dx, dy = rng.uniform(-0.015, 0.015, 2)
            boxes("book", [(x + dx, x + dx + tall, y + dy, y + dy + wide, z, z + thick)], cover)
            z += thick
        else:
            boxes("book", [(x, x + thick, y, y + wide, z, z + tall)], cover)
            x += thick + 0.001


def furnish_living(room: Furniture, style: RoomStyle, jitter: Callable[[], float]) -> None:
    """Add sofa, armchairs, fireplace, bookcases, piano and plants."""
    hide = f.leather(style.sofa)
    oak = f.wood((0.25, 0.12, 0.055), axis=2)
    legs = {"feet": f.wood((0.1, 0.05, 0.025), axis=2)}
    room.place("KatorLegaz/oriental-rug", -0.25, 0.85, 0.0, degrees=90 + 20 * jitter(), scale=(1.2, 1.2, 0.5))
    room.place("BlendSwap-CC-0/winchesterSofa", -0.35 + jitter(), 2.06, finishes={**legs, "": hide})
    room.place(
        "BlendSwap-CC-0/winchesterArmchair", 1.85, 0.75 + jitter(), degrees=-78 + 60 * jitter(),
        finishes={**legs, "": f.fabric(style.chair, 0.45)},
    )  # fmt: skip
    room.place("Scopia/armchair2", -2.05 + jitter(), -1.55, degrees=128 + 60 * jitter())
    room.place(
        "KatorLegaz/chair-ottoman", 2.15, -1.75 + jitter(), degrees=218,
        finishes={"leather": f.leather((0.34, 0.17, 0.075))},
    )  # fmt: skip
    room.place(
        "Scopia/saloon_table", -0.3, 0.95, 0.008, degrees=4 + 30 * jitter(), finish=f.wood((0.13, 0.06, 0.03), axis=0)
    )
    room.place("Scopia/bowlWithFruits", -0.42, 0.97, 0.525)
    room.place("Scopia/teapot", 0.12, 1.05, 0.525, degrees=30)
    room.place("Scopia/cup", 0.22, 0.8, 0.525, degrees=-40)
    books(-0.92, 0.82, 0.525, 3, 5, flat=True)
    room.place("Scopia/fireplace1", -3.1, -0.25, degrees=90, scale=(1.25, 1.15, 1.2))
    room.place("Scopia/candle", -3.1, -0.78, 1.26)
    room.place("Scopia/candle", -3.1, 0.28, 1.26)
    room.place("Scopia/vase3", -3.08, -0.58, 1.26, scale=0.7)
    room.place("Scopia/wood_logs", -2.95, 0.72, degrees=90)
    for y in (1.32, -1.35):
        room.place("KatorLegaz/full-bookcase", -3.11, y, degrees=90, finishes={"white": oak})
    clay = {"pot": f.plaster((0.42, 0.17, 0.09), 0.3)}
    room.place("BlendSwap-CC-0/plant", -2.88, 2.15, scale=1.3, finishes=clay)
    room.place("BlendSwap-CC-BY/spatifilum", -2.85, -2.15, scale=0.95)
    room.place("BlendSwap-CC-0/bedsideTable2", -1.86, 2.28, finish=oak)
    room.place("Scopia/little_lamp1", -1.86, 2.3, 0.455, scale=1.2)
    room.place("Scopia/living_lamp", 1.25, 2.22, scale=1.12, degrees=160)
    room.place("BlendSwap-CC-BY/piano", -0.05, -2.26, degrees=180, finishes={"material.001": oak, "klavierlack": oak})
    room.place("BlendSwap-CC-0/pianoBench", -0.05 + jitter(), -1.62, degrees=180)
    room.place("Scopia/calla_lily_with_roses", 0.4, -2.35, 1.385)
    books(-0.6, -2.45, 1.385, 6, 21)
    room.place("BlendSwap-CC-0/cuckooClock", 3.21, -1.55, 1.45, degrees=-90)
    room.place("BlendSwap-CC-BY/spider_plant", 1.35, -2.52, 0.72, scale=0.7)
    room.place("BlendSwap-CC-BY/tulips", -1.5, -2.52, 0.72, scale=0.9)
    room.place("Scopia/ficus", 2.9, 2.15, scale=2.1)
    room.place("BlendSwap-CC-0/lamp2", -0.3, 0.95, HEIGHT - 0.65)
    for i, (x, color) in enumerate(((-1.1, (0.5, 0.33, 0.1)), (-0.78, style.chair), (0.35, (0.55, 0.48, 0.36)))):
        cushion((x, 2.06, 0.66), 0.42, 0.25 * (i - 1), 0.35, f.fabric(color, 0.6, 35.0))


def furnish_dining(room: Furniture, jitter: Callable[[], float]) -> None:
    """Add a table with chairs, a dresser and plants."""
    room.place("BlendSwap-CC-0/oakTable", 5.35, -0.1, scale=(1.15, 1.15, 1.0))
    for k, degrees in enumerate((12, 100, 195, 280)):
        angle = math.radians(degrees + 40 * jitter())
        room.place(
            "BlendSwap-CC-0/oakChair", 5.35 + 0.82 * math.sin(angle), -0.1 + 0.82 * math.cos(angle),
            degrees=-math.degrees(angle) + 8 * (k % 2),
        )  # fmt: skip
    room.place("Scopia/bowlWithFruits", 5.25, -0.1, 0.745)
    room.place("Scopia/wine_bottle", 5.62, 0.1, 0.745)
    room.place("KatorLegaz/hanging-restaurant-light", 5.35, -0.1, 2.0)
    oak = f.wood((0.30, 0.16, 0.08), axis=0)
    room.place("BlendSwap-CC-BY/dresserWithDrawers", 5.4, 2.32, finishes={"white": oak})
    room.place("BlendSwap-CC-0/augalas", 4.9, 2.35, 0.81)
    books(5.7, 2.3, 0.81, 7, 33)
    room.place("BlendSwap-CC-BY/spatifilum", 6.75, -2.1)
    room.place("Scopia/ficus", 6.8, 2.1, scale=2.0)


def hang_pictures(folder: Path, seed: int) -> None:
    """Add pictures on all walls."""
    works = {name: bpy.data.images.load(str(path)) for name, path in pictures.paint_all(folder, seed + 1).items()}
    dark, gold = f.wood((0.08, 0.04, 0.02), axis=0), f.wood((0.5, 0.33, 0.12), axis=2)
    framed(NORTH, -0.35, 1.70, (1.4, 0.84), works["evening"], gold)
    framed(NORTH, 1.3, 1.78, (0.5, 0.5), works["coast"], dark)
    framed(NORTH, -2.02, 1.66, (0.62, 0.87), works["poster"], dark)
    framed(WEST, -0.25, 1.92, (0.9, 0.66), works["sea"], gold)
    framed(EAST, 1.75, 1.62, (0.72, 0.88), works["morning"], gold)
    framed(EAST, -2.15, 1.62, (0.5, 0.5), works["hills"], dark)
    framed(SOUTH, -0.05, 2.02, (0.62, 0.72), works["dusk"], dark)
    framed(NORTH2, 5.4, 1.68, (0.9, 1.0), works["dusk"], gold)
    framed(END, 1.75, 1.62, (0.6, 0.84), works["poster"], dark)
    framed(END, -1.95, 1.62, (0.6, 0.6), works["hills"], gold)


def light_up(style: RoomStyle, garden: Path) -> None:
    """Add sun, sky, the garden outside and the lamps inside."""
    f.sky(garden, 6.5, 1.2)
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle, sun.color = 3.5, math.radians(1.5), (1.0, 0.9, 0.76)
    item = bpy.data.objects.new("sun", sun)
    item.rotation_euler = (math.radians(52), 0.0, math.radians(style.sun_degrees - 180))
    bpy.context.scene.collection.objects.link(item)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=9.0, location=(2.0, 0.0, 1.4))
    dome = bpy.context.object
    dome.data.materials.append(f.backdrop(garden, 2.4, 1.2))
    for flag in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(dome, f"visible_{flag}", False)
    lamps = [((-1.86, 2.3, 0.86), 16), ((1.25, 2.22, 1.5), 20), ((5.35, -0.1, 1.95), 45), ((-2.95, -0.25, 0.35), 10)]
    lamps += [((-0.3 + 0.28 * math.cos(a), 0.95 + 0.28 * math.sin(a), 2.3), 7) for a in (0.3, 2.4, 4.5)]
    for place, watts in lamps:
        lamp = bpy.data.lights.new("lamp", "POINT")
        lamp.energy, lamp.shadow_soft_size, lamp.color = watts, 0.06, (1.0, 0.72, 0.42)
        item = bpy.data.objects.new("lamp", lamp)
        item.location = place
        bpy.context.scene.collection.objects.link(item)


def build(sources: Path, scratch: Path, seed: int) -> Furniture:
    """Build the scene of a seed and return its furniture with the credits."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    style, rng = RoomStyle.from_seed(seed), np.random.default_rng(seed)
    garden = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world" / "forest.exr"

    def jitter() -> float:
        return float(rng.uniform(-style.jitter, style.jitter))

    build_shell(style)
    hang_curtains(style)
    room = Furniture(sources / "models")
    furnish_living(room, style, jitter)
    furnish_dining(room, jitter)
    hang_pictures(scratch / "pictures", seed)
    light_up(style, garden)
    return room


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sources", type=Path, required=True, help="folder filled by fetch.sh")
    parser.add_argument("--out", type=Path, required=True, help="pair folder to write")
    parser.add_argument("--seed", type=int, default=0, help="0 is the shipped room")
    parser.add_argument("--height", type=int, default=2048, help="of the panoramas, pixels")
    parser.add_argument("--depth-height", type=int, default=768, help="of the depth maps, pixels")
    parser.add_argument("--samples", type=int, default=14, help="light paths a pixel")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--views", nargs="+", default=list(panoramas.VIEWS), choices=list(panoramas.VIEWS))
    options = parser.parse_args()
    unpack(options.sources / "libraries", options.sources / "models")
    with tempfile.TemporaryDirectory() as scratch:
        room = build(options.sources.resolve(), Path(scratch), options.seed)
        panoramas.render_all(
            options.out,
            options.views,
            (options.height, options.depth_height),
            options.samples,
            options.threads,
            Path(scratch),
        )
    panoramas.write_credits(options.out / "credits.json", room.credits.values())


if __name__ == "__main__":
    main()
