"""Floor plans of straight walls as drawings: SVG for browsers and DXF for CAD programs.

Storeys are next to each other, the lowest on the left. Both are to scale: an SVG is 1:50 on paper, a DXF is in metres.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import ezdxf
import numpy as np
from ezdxf import units
from ezdxf.enums import TextEntityAlignment
from jaxtyping import Float
from shapely.geometry import Polygon

from pansplat.atomic import replacing
from pansplat.errors import InputError
from pansplat.files import SOFTWARE
from pansplat.gaussians.scene import Scene
from pansplat.tours.floor import assign_storeys
from pansplat.tours.graph import make_graph
from pansplat.tours.plan import Plan, make_plan

SUFFIXES = (".svg", ".dxf")

_PAPER = 20.0  # millimetres of paper for a metre: 1:50
_MARGIN, _GAP = 0.8, 1.5  # around a storey and between two, metres
_TEXT, _SMALL_TEXT = 0.22, 0.13  # heights, metres
_LAYERS = {"WALLS": 7, "DOORS": 30, "ROOMS": 5, "PANORAMAS": 4, "EDGES": 8, "NOTES": 7}  # names and colours
_STYLE = (
    "polygon{fill:#f2f0ea;stroke:#222;stroke-width:.07;stroke-linejoin:miter}"
    "polygon.loose{stroke-dasharray:.2 .1}"
    ".door{stroke:#f2f0ea;stroke-width:.09}.leaf{stroke:#c26a1b;stroke-width:.035}"
    ".edge{stroke:#7a93a8;stroke-width:.02;stroke-dasharray:.08 .08}"
    "circle{fill:#2b7bb9}text{font-family:sans-serif;fill:#222}.camera{fill:#2b7bb9}"
)


@dataclass(frozen=True)
class _Text:
    """A text around a place or, if it starts there, on its right; sizes in metres."""

    layer: str
    place: tuple[float, float]
    text: str
    size: float
    is_centred: bool = True


def write_plan(scene: Scene, path: str | Path) -> Plan:
    """Write the floor plan of a scene with straight walls, and return it.

    Args:
        scene: with input cameras, not fused.
        path: a .svg or .dxf.

    Raises:
        InputError: no panorama shows walls around it, another suffix, or the file cannot be written.
    """
    path, tour = Path(path), make_graph(scene)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"cannot write {path}: needed a name ending in {' or '.join(SUFFIXES)}; rename it")
    if scene.joint:
        raise InputError(
            f"cannot write {path}: needed all that each panorama shows, got a scene with each surface once; give the "
            "folder of the panoramas, or a scene that was exported with --layers"
        )
    plan = make_plan(scene, tour) if len(tour) else None
    if plan is None or not plan.rooms:
        raise InputError(
            f"cannot write {path}: needed a floor, and walls around at least one of the {len(tour)} input cameras, "
            "got none; export a folder of upright panoramas of rooms"
        )
    with replacing(path) as partial:
        partial.write_text((_draw_svg if path.suffix.lower() == ".svg" else _draw_dxf)(plan), encoding="utf-8")
    return plan


def describe_plan(plan: Plan) -> list[str]:
    """Lines on the size of a plan and its uncertainty."""
    area = sum(room.area for room in plan.rooms)
    spread = "" if plan.scale_error is None else f", which differ by {100 * plan.scale_error:.1f} %"
    count = f"median of {plan.num_heights} panorama{'s' if plan.num_heights > 1 else ''}"
    lines = [
        f"{len(plan.rooms)} room{'s' if len(plan.rooms) > 1 else ''}, {area:.1f} m² between the walls",
        f"scale: cameras {plan.camera_height:.2f} m over the floor ({count}{spread})",
    ]
    inside = {node for room in plan.rooms for node in room.panoramas}
    if outside := [panorama.name for node, panorama in enumerate(plan.tour.panoramas) if node not in inside]:
        lines.append(f"no closed walls around {', '.join(outside)}")
    if plan.wall_error is None:
        return [*lines, "walls: of one panorama each, so that their uncertainty is unknown"]
    walls = f"{plan.num_walls} wall{'s' if plan.num_walls > 1 else ''}"
    return [*lines, f"walls: ± {100 * plan.wall_error:.1f} cm, by the panoramas that show the same {walls}"]


def _describe_area(plan: Plan, number: int) -> str:
    room = plan.rooms[number]
    error = plan.area_error(room)
    known = plan.wall_error is not None and error is not None
    return f"{room.area:.1f} m²" + (f" ± {error:.1f}" if known else "")


def _arrange(plan: Plan) -> tuple[Float[np.ndarray, "storey 2"], tuple[float, float]]:
    """What each storey is moved by, so that all are in one row from (0, 0) on, and the size of the row."""
    storeys = np.array(assign_storeys(plan.tour))
    centers = _centers(plan)
    moves, right, height = [], 0.0, 0.0
    for storey in range(int(storeys.max()) + 1):
        outlines = [room.outline for room in plan.rooms if room.storey == storey]
        places = np.concatenate([centers[storeys == storey], *outlines])
        low, size = places.min(axis=0) - _MARGIN, np.ptp(places, axis=0) + 2 * _MARGIN
        moves.append((right - low[0], -low[1]))
        right, height = right + float(size[0]) + _GAP, max(height, float(size[1]))
    return np.array(moves), (right - _GAP, height)


def _centers(plan: Plan) -> Float[np.ndarray, "node 2"]:
    return plan.tour.positions @ plan.tour.level_axes[:, (0, 2)]


def _list_edges(plan: Plan) -> Iterator[tuple[int, int]]:
    """Ways between panoramas: edges and links; each once."""
    ways = [*plan.tour.overlaps, *plan.tour.links]
    yield from dict.fromkeys((min(way), max(way)) for way in ways if way[0] != way[1])


def _list_texts(plan: Plan, moves: Float[np.ndarray, "storey 2"]) -> list[_Text]:
    """The texts inside the rooms and beside the panoramas."""
    texts, storeys, centers = [], assign_storeys(plan.tour), _centers(plan)
    for number, room in enumerate(plan.rooms):
        x, y = (_place_label(room.outline) + moves[room.storey]).tolist()
        name = room.name if room.is_placed else f"{room.name} (not placed)"
        texts.append(_Text("ROOMS", (x, y + 0.7 * _TEXT), name, _TEXT))
        texts.append(_Text("ROOMS", (x, y - 0.7 * _TEXT), _describe_area(plan, number), _TEXT))
    for node, panorama in enumerate(plan.tour.panoramas):
        x, y = (centers[node] + moves[storeys[node]]).tolist()
        texts.append(_Text("PANORAMAS", (x + 0.12, y), panorama.name, _SMALL_TEXT, is_centred=False))
    return texts


def _place_label(outline: Float[np.ndarray, "corner 2"]) -> Float[np.ndarray, "2"]:
    """A place well inside a room."""
    shape = Polygon(outline)
    if shape.contains(shape.centroid):
        return np.array(shape.centroid.coords[0])
    return np.array(shape.representative_point().coords[0])


def _draw_svg(plan: Plan) -> str:
    """The plan as the text of an SVG."""
    moves, (width, height) = _arrange(plan)
    notes = [*describe_plan(plan), "1:50 on paper; the bar is 1 m"]
    total = height + 0.35 * len(notes) + 0.8
    storeys, centers = assign_storeys(plan.tour), _centers(plan)
    width = max(width, 0.075 * max(map(len, notes)) + _MARGIN)

    def number(values: Sequence[float]) -> str:
        return " ".join(f"{value:.3f}" for value in values)

    def point(place: np.ndarray, storey: int) -> str:
        x, y = place + moves[storey]
        return f"{x:.3f},{height - y:.3f}"

    def line(kind: str, ends: np.ndarray, *at: int) -> str:
        (x1, y1), (x2, y2) = (end + moves[storey] for end, storey in zip(ends, at, strict=True))
        shape = f'x1="{x1:.3f}" y1="{height - y1:.3f}" x2="{x2:.3f}" y2="{height - y2:.3f}"'
        return f'<line class="{kind}" {shape}/>'

    def write(x: float, y: float, text: str, size: float, more: str = "") -> str:
        text = escape(text.encode(errors="backslashreplace").decode())
        return f'<text x="{x:.3f}" y="{y:.3f}" font-size="{size}"{more}>{text}</text>'

    parts = [
        f'<?xml version="1.0" encoding="UTF-8"?><!-- {SOFTWARE} -->',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width * _PAPER:.1f}mm" height="{total * _PAPER:.1f}mm" '
        f'viewBox="{number((0, 0, width, total))}">',
        f'<style>{_STYLE}</style><rect width="100%" height="100%" fill="#fff"/>',
    ]
    for room in plan.rooms:
        corners = " ".join(point(corner, room.storey) for corner in room.outline)
        kind = "room" if room.is_placed else "loose"
        parts.append(f'<polygon class="{kind}" points="{corners}"/>')
    for door in plan.doors:
        storey = plan.rooms[door.rooms[0]].storey
        parts += [line(kind, door.ends, storey, storey) for kind in ("door", "leaf")]
    for edge in _list_edges(plan):
        if storeys[edge[0]] == storeys[edge[1]]:
            parts.append(line("edge", centers[list(edge)], *(storeys[node] for node in edge)))
    for node, center in enumerate(centers):
        x, y = point(center, storeys[node]).split(",")
        parts.append(f'<circle cx="{x}" cy="{y}" r="0.06"/>')
    for text in _list_texts(plan, moves):
        x, y = text.place
        more = ' text-anchor="middle"' if text.is_centred else ' class="camera"'
        parts.append(write(x, height - y + 0.35 * text.size, text.text, text.size, more))
    for row, note in enumerate(notes):
        parts.append(write(_MARGIN / 2, height + 0.35 * (row + 1), note, 0.15))
    bar = height + 0.35 * len(notes) + 0.4
    parts.append(f'<path d="M{_MARGIN / 2} {bar:.3f}h1" stroke="#222" stroke-width=".05"/></svg>')
    return "\n".join(parts) + "\n"


def _draw_dxf(plan: Plan) -> str:
    """The plan as the text of a DXF of AutoCAD 2010, in metres."""
    document = ezdxf.new("R2010", setup=True)
    document.units = units.M
    for name, color in _LAYERS.items():
        document.layers.add(name, color=color, linetype="DASHED" if name == "EDGES" else "Continuous")
    space = document.modelspace()
    moves, _ = _arrange(plan)
    storeys, centers = assign_storeys(plan.tour), _centers(plan)
    for room in plan.rooms:
        space.add_lwpolyline((room.outline + moves[room.storey]).tolist(), close=True, dxfattribs={"layer": "WALLS"})
    for door in plan.doors:
        ends = (door.ends + moves[plan.rooms[door.rooms[0]].storey]).tolist()
        space.add_line(*ends, dxfattribs={"layer": "DOORS"})
    for a, b in _list_edges(plan):
        if storeys[a] == storeys[b]:
            ends = (centers[[a, b]] + moves[storeys[a]]).tolist()
            space.add_line(*ends, dxfattribs={"layer": "EDGES"})
    for node, center in enumerate(centers):
        space.add_circle((center + moves[storeys[node]]).tolist(), 0.06, dxfattribs={"layer": "PANORAMAS"})
    notes = [
        _Text("NOTES", (_MARGIN / 2, -0.35 * (row + 1)), note, 0.15, is_centred=False)
        for row, note in enumerate(describe_plan(plan))
    ]
    for text in [*_list_texts(plan, moves), *notes]:
        content = text.text.encode(errors="backslashreplace").decode().replace("\n", " ")
        align = TextEntityAlignment.MIDDLE_CENTER if text.is_centred else TextEntityAlignment.MIDDLE_LEFT
        entity = space.add_text(content, height=text.size, dxfattribs={"layer": text.layer})
        entity.set_placement(text.place, align=align)
    stream = io.StringIO()
    stream.write(f"999\n{SOFTWARE}\n")
    document.write(stream)
    return stream.getvalue()
