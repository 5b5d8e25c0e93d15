"""Floor plans of straight walls as drawings: SVG and PNG of one figure.

The longest wall is horizontal. Storeys are in rows, the lowest first. Rooms that are not placed are dashed, and beside
them. They are 1:50 on paper.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float
from shapely import affinity
from shapely.geometry import LineString, Polygon

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.system.atomic import replacing
from pansplat.system.descriptions import describe_count
from pansplat.system.files import SOFTWARE
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import assign_storeys
from pansplat.tours.layout import arrange_in_rows
from pansplat.tours.plan import Plan, Room

SUFFIXES = (".svg", ".png")

_PAPER = 0.02  # metres of paper for a metre: 1:50
_INCH = 0.0254  # metres
_DOTS_PER_INCH = 150
_MARGIN, _LINE = 0.8, 0.35  # around a storey, and between lines of notes, metres
_TEXT, _SMALL_TEXT, _LEAST_TEXT = 0.22, 0.13, 0.08  # heights, metres
_SMALL_SHEET, _SMALL_SHEET_TEXT = 5.5, 0.17  # metres: width and largest text that a quarter of a window shows legibly
_LETTER = 0.72  # width of a letter, of its height
_MEASURED = 0.6  # metres, the shortest wall whose length is written
_UPWARDS = math.radians(1)  # texts from -89 to 91 degrees are read from the left or from below
_CAP_HEIGHT = 0.73  # of a letter, of the font's size
_POINT = _INCH / 72


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
    if (suffix := path.suffix.lower()) not in SUFFIXES:
        raise InputError(f"cannot write {path}: needed a name ending in {', '.join(SUFFIXES)}; rename it")
    drawing = _Drawing(plan)
    with replacing(path) as partial:
        partial.write_bytes(_draw_figure(drawing, suffix[1:]))
    return plan


def draw_page_plan(plan: Plan) -> tuple[bytes, tuple[float, float], list[tuple[float, float, float | None]]]:
    """The plan for a corner of a page as SVG, its width and height, and the place of each panorama from the upper left
    corner, metres, with what its azimuths are turned by."""
    drawing = _Drawing(plan, is_small=True)
    places = drawing.panoramas * (1, -1) + (0, drawing.size[1])
    marks = [(x, y, heading) for (x, y), heading in zip(places.tolist(), drawing.headings, strict=True)]
    return _draw_figure(drawing, "svg"), drawing.size, marks


def describe_plan(plan: Plan) -> list[str]:
    """Lines on the size of a plan and its uncertainty."""
    closed = [room for room in plan.rooms if room.is_closed]
    area = sum(room.shape.area for room in closed)
    spread = "" if plan.scale_error is None else f", which differ by {100 * plan.scale_error:.1f} %"
    count = describe_count(plan.num_heights, "panorama")
    lines = [
        f"{describe_count(len(closed), 'room')}, {_format_number(plan, area, 1, power=2)} m² between the walls",
        f"scale: cameras {_format_number(plan, plan.camera_height, 2)} m over the floor (median of {count}{spread})",
    ]
    inside = {node for room in closed for node in room.panoramas}
    if outside := [panorama.label for node, panorama in enumerate(plan.tour.panoramas) if node not in inside]:
        lines.append(f"thin: by the extent of the floor, as walls do not close around {', '.join(outside)}")
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
        pieces = list(zip(self.plan.tour.worlds, assign_storeys(self.plan.tour), strict=True))
        drawn = self.plan.drawn
        return [pieces[drawn[node].beside] if node in drawn else piece for node, piece in enumerate(pieces)]

    @cached_property
    def _turns(self) -> Float[np.ndarray, "world 2 2"]:
        """For each world the rotation, applied from the right, after which its longest wall is horizontal."""
        cosines, sines = np.cos(self.plan.turns), np.sin(self.plan.turns)
        return np.stack((cosines, sines, -sines, cosines), axis=1).reshape(-1, 2, 2)

    @cached_property
    def _centers(self) -> Float[np.ndarray, "node 2"]:
        places = self.plan.tour.positions @ self.plan.tour.level_axes[:, (0, 2)]
        return np.stack([self._turn(place, node) for node, place in enumerate(places)])

    def _turn(self, places: Float[np.ndarray, "*n 2"], node: int) -> Float[np.ndarray, "*n 2"]:
        """Places around a panorama in its turned world."""
        return self.plan.draw(node, places) @ self._turns[self._pieces[node][0]]

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


def _place_notes(notes: list[str]) -> list[_Text]:
    places = [(_MARGIN / 2, -_LINE * (row + 1)) for row in range(len(notes))]
    return [_Text("NOTES", place, note, 0.15, is_centred=False) for place, note in zip(places, notes, strict=True)]


def _draw_figure(drawing: _Drawing, kind: str) -> bytes:
    """The plan as a file of a figure, 1:50 on paper: "svg", whose texts are texts, or "png"."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    notes = drawing.notes
    width, height = drawing.size
    width = max(width, 0.15 * _LETTER * max(map(len, notes), default=0) + _MARGIN)
    below = _LINE * len(notes) + _MARGIN if notes else 0.0
    figure = Figure(figsize=(width * _PAPER / _INCH, (height + below) * _PAPER / _INCH))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(-below, height))
    axes.set_axis_off()

    def points(metres: float) -> float:
        return metres * _PAPER / _POINT

    for room in drawing.rooms:
        dashes = "solid" if room.is_placed else "dashed"
        style = {"facecolor": "#f2f0ea", "edgecolor": "#222", "linestyle": dashes}
        style["linewidth"] = points(0.07 if room.is_closed else 0.03)
        above = 2 * room.is_placed - 4  # what is sure is on top
        axes.fill(*drawing.outline(room).T, gid="room", joinstyle="miter", zorder=above, **style)
    for ends in drawing.doors:
        axes.plot(*ends.T, color="#f2f0ea", linewidth=points(0.09), solid_capstyle="butt", zorder=0)
        axes.plot(*ends.T, color="#c26a1b", linewidth=points(0.035), solid_capstyle="butt", zorder=0)
    axes.plot(*drawing.panoramas.T, "o", color="#2b7bb9", markersize=points(0.12 * drawing.enlarged), markeredgewidth=0)
    for text in [*drawing.list_texts(), *_place_notes(notes)]:
        axes.text(
            *text.place,
            text.text.encode(errors="backslashreplace").decode(),
            fontsize=points(text.size) / _CAP_HEIGHT,
            rotation=text.angle,
            rotation_mode="anchor",
            ha="center" if text.is_centred else "left",
            va="center",
            color={"LENGTHS": "#777", "PANORAMAS": "#2b7bb9"}.get(text.layer, "#222"),
            parse_math=False,
        )
    bar = -_LINE * len(notes) - 0.4  # on a small sheet it is below it
    axes.plot((_MARGIN / 2, _MARGIN / 2 + 1), (bar, bar), color="#222", linewidth=points(0.05))
    file = io.BytesIO()
    stated = {"Creator": SOFTWARE, "Date": None} if kind == "svg" else {"Software": SOFTWARE}
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "pansplat"}):
        figure.savefig(file, format=kind, dpi=_DOTS_PER_INCH, metadata=stated)
    return file.getvalue()
