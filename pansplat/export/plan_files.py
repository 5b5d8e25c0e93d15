"""Floor plans of straight walls as drawings: SVG, and PNG of the same.

The longest wall is horizontal. Storeys are in rows, the lowest first. Rooms that are not placed are dashed
and stand beside the others. Drawings are 1:50.
"""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from shapely import affinity
from shapely.geometry import LineString, Polygon

from pansplat.errors import InputError
from pansplat.export.page_data import PagePlan
from pansplat.gaussians.scene import Scene
from pansplat.system.atomic import replacing
from pansplat.system.descriptions import describe_count
from pansplat.system.files import SOFTWARE
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import list_storeys_of_worlds
from pansplat.tours.layout import arrange_in_rows
from pansplat.tours.linked_rooms import turn_plan
from pansplat.tours.plan import Plan
from pansplat.tours.rooms import Room

_PAPER = 0.02  # metres of paper for a metre of the plan: 1:50
_INCH = 0.0254  # metres
_POINTS = 72 * _PAPER / _INCH  # points of paper for a metre of the plan
_DOTS_PER_INCH = 150  # resolution of the PNG
_MARGIN = 0.8  # space around a storey, metres of the plan
_LINE = 0.35  # distance of two lines of notes, metres of the plan
_TEXT, _SMALL_TEXT, _LEAST_TEXT, _NOTE = 0.22, 0.13, 0.08, 0.15  # heights of capital letters, metres of the plan
# The plan in a corner of a page: up to this width, in metres, its texts can be read in a quarter of a window; the
# height of its largest texts, metres.
_SMALL_SHEET, _SMALL_SHEET_TEXT = 5.5, 0.17
_LETTER = 0.72  # mean width of a letter over the height of a capital one, of DejaVu Sans
_CAP_HEIGHT = 0.73  # height of a capital letter over the size of the font, of DejaVu Sans
_MEASURED = 0.6  # shortest wall whose length is written, metres
_UPWARDS = math.radians(1)  # texts from -89 to 91 degrees are read from the left or from below
_FLOOR, _INK, _DOOR, _DOT = "#f2f0ea", "#222", "#c26a1b", "#2b7bb9"
_COLORS = {"LENGTHS": "#777", "PANORAMAS": _DOT}  # colours of texts by layer; others are in ink


@dataclass(frozen=True, eq=False)
class _Line:
    """A line, closed around its fill if it has one; its width in metres."""

    places: Float[np.ndarray, "n 2"]
    color: str
    width: float
    fill: str = "none"
    is_dashed: bool = False


@dataclass(frozen=True)
class _Text:
    """A text around a place or, if it starts there, on its right; sizes in metres, the angle in degrees."""

    layer: str
    place: tuple[float, float]
    text: str
    size: float
    is_centred: bool = True
    angle: float = 0.0

    @property
    def cover(self) -> Polygon:
        """What a text around its place covers."""
        width = _LETTER * self.size * len(self.text)
        box = shapely.box(-width / 2, -self.size / 2, width / 2, self.size / 2)
        return affinity.translate(affinity.rotate(box, self.angle), *self.place)


def write_plan(scene: Scene, path: str | Path, folder: Path | None = None) -> Plan:
    """Write the floor plan of a scene with straight walls, and return it.

    Args:
        scene: with input cameras, not fused.
        path: a .svg or .png.
        folder: of the panoramas, in which the plan is stored; None keeps nothing.
    """
    if scene.joint:
        raise InputError(
            f"cannot write {path}: needed all that each panorama shows, got a scene with each surface once; give the "
            "folder of the panoramas, or a scene that was exported with --layers"
        )
    facts = TourFacts(scene, folder=folder)
    plan = facts.plan if len(facts.tour) else None
    if plan is None or not plan.num_heights:
        raise InputError(
            f"cannot write {path}: needed a floor, and walls around at least one of "
            f"{describe_count(len(scene.cam2world), 'input camera')}, got none; "
            "export a folder of upright panoramas of rooms"
        )
    path = Path(path)
    drawing = _Drawing(plan)
    with replacing(path) as partial:
        partial.write_bytes(_draw_figure(drawing, path.suffix[1:].lower()))
    return plan


def draw_page_plan(plan: Plan) -> PagePlan:
    """The plan for a corner of a page."""
    drawing = _Drawing(plan, is_small=True)
    places = (drawing.panoramas * (1, -1) + (0, drawing.size[1])).tolist()
    return PagePlan(
        worlds=plan.tour.worlds,
        drawing=base64.b64encode(_draw_figure(drawing, "svg")).decode(),
        is_sure=all(room.is_placed for room in plan.rooms),
        size=drawing.size,
        places=tuple((x, y, heading) for (x, y), heading in zip(places, drawing.headings, strict=True)),
    )


def describe_plan(plan: Plan) -> list[str]:
    """Lines on the size of a plan and its uncertainty."""
    dots = {node for node, place in plan.drawn.items() if place.turn is None}
    closed = [room for room in plan.rooms if room.is_closed and dots.isdisjoint(room.panoramas)]
    area = sum(room.shape.area for room in closed)
    spread = "" if plan.scale_error is None else f", which differ by {100 * plan.scale_error:.1f} %"
    count = describe_count(plan.num_heights, "panorama")
    lines = [
        f"{describe_count(len(closed), 'room')}, {_format_number(plan, area, 1, power=2)} m² between the walls",
        f"scale: cameras {_format_number(plan, plan.camera_height, 2)} m over the floor (median of {count}{spread})",
    ]
    inside, labels = {node for room in closed for node in room.panoramas}, [view.label for view in plan.tour.panoramas]
    if outside := [label for node, label in enumerate(labels) if node not in inside | dots]:
        lines.append(f"thin: by the extent of the floor, as walls do not close around {', '.join(outside)}")
    if dots:
        names = ", ".join(labels[node] for node in sorted(dots))
        lines.append(f"dots without walls: nothing shows how they are turned: {names}; a link back would")
    if not all(room.is_placed for room in plan.rooms):
        about = " or are approximate" if plan.drawn else ""
        lines.append(f"dashed: rooms whose places are not known{about}")
    if plan.wall_error is None:
        return [*lines, "walls: of one panorama each, so that their uncertainty is unknown"]
    walls = describe_count(plan.num_walls, "wall")
    error = _format_number(plan, 100 * plan.wall_error, 1)
    return [*lines, f"walls: ± {error} cm, by the panoramas that show the same {walls}"]


def _format_number(plan: Plan, value: float, decimals: int, power: int = 1) -> str:
    """A length, or with a power of 2 an area, in the unit of the poses.

    Args:
        plan: of the value.
        value: in metres of the plan.
        decimals: of metres; in other units as many digits are written.
    """
    factor = plan.tour.panoramas[0].frame.unit ** power
    return f"{factor * value:.{max(decimals - round(math.log10(factor)), 0)}f}"


@dataclass(frozen=True, eq=False)
class _Drawing:
    """A plan on a sheet: where its rooms, doors, panoramas and texts are, metres to the right and up.

    Attributes:
        plan: what is drawn.
        is_small: for a corner of a page: names only, and larger ones.
    """

    plan: Plan
    is_small: bool = False

    @cached_property
    def enlarged(self) -> float:
        """Factor of texts and dots."""
        return max(self.size[0] / _SMALL_SHEET, 1.0) if self.is_small else 1.0

    @cached_property
    def headings(self) -> list[float | None]:
        """What the azimuths of each panorama are turned by on the sheet, radians to the right; None if unknown."""
        turns = [self.plan.drawn[node].turn if node in self.plan.drawn else 0.0 for node in range(len(self._pieces))]
        worlds = [self.plan.turns[world] for world, _ in self._pieces]
        return [None if own is None else own - turn for own, turn in zip(turns, worlds, strict=True)]

    @cached_property
    def rooms(self) -> list[Room]:
        """The rooms with an outline; others are dots."""
        return [room for room in self.plan.rooms if self.headings[room.panoramas[0]] is not None]

    @cached_property
    def _pieces(self) -> list[tuple[int, int]]:
        """World and storey in which each panorama is drawn."""
        pieces = list_storeys_of_worlds(self.plan.tour)
        drawn = self.plan.drawn
        return [pieces[drawn[node].beside] if node in drawn else piece for node, piece in enumerate(pieces)]

    @cached_property
    def _turns(self) -> Float[np.ndarray, "world 2 2"]:
        """For each world the rotation, applied from the right, after which its longest wall is horizontal."""
        return np.stack([turn_plan(-turn) for turn in self.plan.turns])

    @cached_property
    def _centers(self) -> Float[np.ndarray, "node 2"]:
        places = self.plan.tour.positions @ self.plan.tour.level_axes[:, (0, 2)]
        return np.stack([self._turn(place, node) for node, place in enumerate(places)])

    def _turn(self, places: Float[np.ndarray, "*n 2"], node: int) -> Float[np.ndarray, "*n 2"]:
        """Places around a panorama in its turned world."""
        moved = self.plan.drawn[node].move(places) if node in self.plan.drawn else places
        return moved @ self._turns[self._pieces[node][0]]

    @cached_property
    def _layout(self) -> tuple[dict[tuple[int, int], Float[np.ndarray, "2"]], tuple[float, float]]:
        """What each storey of each world is moved by, so that all are in rows from (0, 0) on, and their size.

        The lowest storey of the largest world is in the upper left corner.
        """
        worlds, boxes = self.plan.tour.worlds, []
        order = sorted(set(self._pieces), key=lambda piece: (-worlds.count(piece[0]), piece))
        for piece in order:
            nodes = [node for node, own in enumerate(self._pieces) if own == piece]
            rooms = [room for room in self.rooms if room.panoramas[0] in nodes]
            outlines = [self._turn(room.outline, room.panoramas[0]) for room in rooms]
            places = np.concatenate([self._centers[nodes], *outlines])
            boxes.append((places.min(axis=0) - _MARGIN, np.ptp(places, axis=0) + 2 * _MARGIN))
        lows, sizes = np.array(boxes).transpose(1, 0, 2)
        corners = np.array(arrange_in_rows(sizes))
        width, height = (corners + sizes).max(axis=0).tolist()
        moves = np.stack((corners[:, 0], height - (corners + sizes)[:, 1]), axis=1) - lows
        return dict(zip(order, moves, strict=True)), (width, height)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of all storeys."""
        return self._layout[1]

    def _draw(self, places: Float[np.ndarray, "n 2"], room: Room) -> Float[np.ndarray, "n 2"]:
        """Places of a room on the sheet."""
        return self._turn(places, room.panoramas[0]) + self._layout[0][self._pieces[room.panoramas[0]]]

    def outline(self, room: Room) -> Float[np.ndarray, "corner 2"]:
        """The corners of a room."""
        return self._draw(room.outline, room)

    @cached_property
    def doors(self) -> list[Float[np.ndarray, "2 2"]]:
        """The ends of all doors."""
        found = [(door.ends, self.plan.rooms[door.rooms[0]]) for door in self.plan.doors]
        return [self._draw(ends, room) for ends, room in found if room in self.rooms]

    @cached_property
    def panoramas(self) -> Float[np.ndarray, "node 2"]:
        """The places of all panoramas."""
        return self._centers + np.stack([self._layout[0][piece] for piece in self._pieces])

    @property
    def dot(self) -> float:
        """Diameter of the dot of a panorama."""
        return 0.12 * self.enlarged

    def list_lines(self) -> list[_Line]:
        """The outlines of the rooms, those that are placed on top, the doors, and a bar of a metre below."""
        lines = [
            _Line(self.outline(room), _INK, 0.07 if room.is_closed else 0.03, _FLOOR, not room.is_placed)
            for room in sorted(self.rooms, key=lambda room: room.is_placed)
        ]
        lines += [_Line(ends, *style) for ends in self.doors for style in ((_FLOOR, 0.09), (_DOOR, 0.035))]
        bar = -_LINE * len(self.notes) - 0.4  # on a small sheet, which has no notes, it is outside
        return [*lines, _Line(np.array(((_MARGIN / 2, bar), (_MARGIN / 2 + 1, bar))), _INK, 0.05)]

    @cached_property
    def notes(self) -> list[str]:
        """Lines below the plan."""
        unit = self.plan.tour.panoramas[0].frame.unit
        scale = f"1:{unit / _PAPER:g} on paper; the bar is {unit:g} m"
        return [] if self.is_small else [*describe_plan(self.plan), scale]

    def list_texts(self) -> list[_Text]:
        """Names and areas of rooms, names of panoramas outside of rooms, and lengths of walls where there is space."""
        outlines = {room: self.outline(room) for room in self.rooms}
        walls = shapely.union_all([Polygon(corners).exterior for corners in outlines.values()])
        sizes = (
            (_SMALL_SHEET_TEXT, _SMALL_TEXT, 0.75 * _SMALL_TEXT) if self.is_small else (_TEXT, _SMALL_TEXT, _LEAST_TEXT)
        )
        large, small, least = (self.enlarged * size for size in sizes)
        taken = shapely.MultiPoint(self.panoramas).buffer(0.7 * small) | shapely.box(0, 0, *self.size).exterior.buffer(
            0.01
        )
        texts: list[_Text] = []

        def add(*options: _Text) -> None:
            nonlocal taken
            texts.append(next((text for text in options if not text.cover.intersects(walls | taken)), options[0]))
            taken |= texts[-1].cover

        inside: set[int] = set()
        for room, corners in outlines.items():
            shape, others = Polygon(corners), np.delete(self.panoramas, room.panoramas, axis=0)
            free = shape.buffer(-2 * small) - walls.buffer(small) - taken
            free -= shapely.MultiPoint(others).buffer(6 * small)
            circle = shapely.maximum_inscribed_circle(shape if free.is_empty else free)
            (x, y), radius = circle.coords[0], circle.length
            values = room.shape.area, self.plan.area_error(room)
            area, error = (_format_number(self.plan, value, 1, power=2) for value in values)
            lines = [f"{area} m² ± {error}"] * room.is_closed + ["about here"] * (room.panoramas[0] in self.plan.drawn)
            for row, text in zip((0.7, -0.7, -2.1), [room.name, *lines[: 0 if self.is_small else None]], strict=False):
                size = min(large, 0.9 * radius / math.hypot(_LETTER * len(text) / 2, abs(row) + 0.5))
                inside |= set(room.panoramas[size <= least :])  # one of them has the name of a small room
                if size > least:
                    add(_Text("ROOMS", (x, y + row * size), text, size))
        for node, (x, y) in enumerate(self.panoramas.tolist()):
            if node not in inside:
                name = self.plan.tour.panoramas[node].label
                away, beyond = 1.1 * small + _LETTER * small * len(name) / 2, 1.3 * small
                places = (x + away, y), (x - away, y), (x, y + beyond), (x, y - beyond)
                options = [_Text("PANORAMAS", place, name, small) for place in places]
                add(*sorted(options, key=lambda text: LineString(((x, y), text.place)).intersects(walls)))
        for room, corners in [each for each in outlines.items() if each[0].is_closed and not self.is_small]:
            above = [Polygon(c) for r, c in outlines.items() if r is not room and r.is_placed >= room.is_placed]
            for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                length = float(np.linalg.norm(end - start))
                x, y = (start + end) / 2 + 1.2 * small * np.array((start - end)[::-1]) * (1, -1) / length
                angle = math.degrees(math.remainder(math.atan2(*(end - start)[::-1]) - _UPWARDS, math.pi) + _UPWARDS)
                text = _Text("LENGTHS", (x, y), _format_number(self.plan, length, 2), small, angle=angle)
                if length >= _MEASURED and not text.cover.intersects(walls | taken | shapely.union_all(above)):
                    add(text)
        return texts


def _draw_figure(drawing: _Drawing, kind: str) -> bytes:
    """The plan as a file, 1:50 on paper: "svg", whose texts are texts, or "png"."""
    notes, (width, height) = drawing.notes, drawing.size
    places = [(_MARGIN / 2, -_LINE * (row + 1)) for row in range(len(notes))]
    lines = [_Text("NOTES", place, note, _NOTE, is_centred=False) for place, note in zip(places, notes, strict=True)]
    texts = [*drawing.list_texts(), *lines]
    width = max(width, _NOTE * _LETTER * max(map(len, notes), default=0) + _MARGIN)
    below = _LINE * len(notes) + _MARGIN if notes else 0.0
    return (_write_svg if kind == "svg" else _write_png)(drawing, texts, (width, height, below))


def _write_svg(drawing: _Drawing, texts: Sequence[_Text], sizes: tuple[float, float, float]) -> bytes:
    """An SVG in points of paper. `sizes`: width, and heights of the plan and of the notes below it, metres."""
    width, height, below = sizes
    size = f"{_POINTS * width:.2f}", f"{_POINTS * (height + below):.2f}"
    marks = [f'<rect width="{size[0]}" height="{size[1]}" fill="#fff"/>']
    for line in drawing.list_lines():
        points = " ".join(f"{x:.2f},{y:.2f}" for x, y in _POINTS * ((0, height) + line.places * (1, -1)))
        step = _POINTS * line.width
        dashes = f' stroke-dasharray="{3.7 * step:.2f} {1.6 * step:.2f}"' if line.is_dashed else ""
        marks.append(
            f'<{"polyline" if line.fill == "none" else "polygon"} points="{points}" fill="{line.fill}" '
            f'stroke="{line.color}" stroke-width="{step:.2f}"{dashes}/>'
        )
    for x, y in _POINTS * ((0, height) + drawing.panoramas * (1, -1)):
        marks.append(f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{_POINTS * drawing.dot / 2:.2f}" fill="{_DOT}"/>')
    for text in texts:
        (x, y), font = (_POINTS * text.place[0], _POINTS * (height - text.place[1])), _POINTS * text.size / _CAP_HEIGHT
        content = html.escape(text.text.encode(errors="backslashreplace").decode())
        marks.append(
            f'<text transform="translate({x:.2f} {y:.2f}) rotate({-text.angle:.2f})" y="{_CAP_HEIGHT / 2 * font:.2f}" '
            f'font-size="{font:.2f}" text-anchor="{"middle" if text.is_centred else "start"}" '
            f'fill="{_COLORS.get(text.layer, _INK)}">{content}</text>'
        )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{size[0]}pt" height="{size[1]}pt" '
        f'viewBox="0 0 {size[0]} {size[1]}" font-family="DejaVu Sans, Verdana, sans-serif"><!-- {SOFTWARE} -->\n'
        + "\n".join(marks)
        + "\n</svg>\n"
    ).encode()


def _write_png(drawing: _Drawing, texts: Sequence[_Text], sizes: tuple[float, float, float]) -> bytes:
    """The same as a PNG by matplotlib."""
    from matplotlib.figure import Figure

    width, height, below = sizes
    figure = Figure(figsize=(width * _PAPER / _INCH, (height + below) * _PAPER / _INCH))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(-below, height))
    axes.set_axis_off()
    for line in drawing.list_lines():
        style: dict[str, Any] = {
            "linewidth": _POINTS * line.width,
            "linestyle": "dashed" if line.is_dashed else "solid",
        }
        if line.fill == "none":
            axes.plot(*line.places.T, color=line.color, solid_capstyle="butt", **style)
        else:
            axes.fill(*line.places.T, facecolor=line.fill, edgecolor=line.color, joinstyle="miter", **style)
    axes.plot(*drawing.panoramas.T, "o", color=_DOT, markersize=_POINTS * drawing.dot, markeredgewidth=0)
    for text in texts:
        axes.text(
            *text.place,
            text.text.encode(errors="backslashreplace").decode(),
            fontsize=_POINTS * text.size / _CAP_HEIGHT,
            rotation=text.angle,
            rotation_mode="anchor",
            ha="center" if text.is_centred else "left",
            va="center",
            color=_COLORS.get(text.layer, _INK),
            parse_math=False,
        )
    with io.BytesIO() as file:
        figure.savefig(file, format="png", dpi=_DOTS_PER_INCH, metadata={"Software": SOFTWARE})
        return file.getvalue()
