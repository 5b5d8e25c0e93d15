"""The rooms of a tour: their outlines of straight walls, and the panoramas in them.

Panoramas that are in each other's outlines are in one room; their lines are common and their outlines are joined.
Lengths below are fractions of the height of the cameras over the floor, see `walls`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import Polygon

from pansplat.system.components import label_components
from pansplat.tours.floor import FloorOutline, list_storeys_of_worlds
from pansplat.tours.graph import TourGraph
from pansplat.tours.surfaces import RAY_DIRECTIONS, Outline, Surfaces
from pansplat.tours.walls import Sight, find_directions, find_lines, measure_reach, trace_outline

_NARROW, _COLLINEAR = 0.12, 0.02  # half the width of spikes that are left out; pieces of one wall differ by less
_LEAST_AREA = 0.4  # least area of a room, squared camera heights
# Rectangles around cameras whose walls are open.
_BROAD = 0.12, 0.88  # quantiles of the ends of a floor, which goes on behind doors
_LEAST_HALF, _LEAST_PIECE = 0.5, 0.1  # least half side, and least area, squared camera heights, without other rooms
_EYE_BAND = 0.4  # surfaces around a camera without a floor are at most so far over or under it


@dataclass(frozen=True, eq=False)
class Room:
    """A room of a plan.

    Attributes:
        name: from the titles of its panoramas.
        panoramas: those in it, by number.
        outline: corners in plan coordinates, metres to the right and forward of the tour's level axes, anticlockwise.
        storey: 0 is the lowest.
        is_placed: whether its place relative to other rooms is known.
        is_closed: whether walls enclose its cameras; else it is a rectangle by the extent of its floor.
    """

    name: str
    panoramas: tuple[int, ...]
    outline: Outline
    storey: int
    is_placed: bool
    is_closed: bool = True

    @cached_property
    def shape(self) -> Polygon:
        """The outline as a shape."""
        return Polygon(self.outline)


def find_rooms(
    tour: TourGraph,
    sights: Mapping[int, Sight],
    surfaces: Sequence[Surfaces],
    floors: Sequence[FloorOutline | None],
    unit: float,
) -> list[Room]:
    """The rooms of all storeys; those whose walls do not close are rectangles by the extent of their floors.

    Args:
        tour: the graph.
        sights: of the panoramas that show walls.
        surfaces, floors: of all panoramas.
        unit: height of the cameras over the floor.
    """
    pieces, rooms = list_storeys_of_worlds(tour), []
    for piece in sorted({*pieces}):
        world, storey = piece
        in_world = [sight for node, sight in sights.items() if tour.worlds[node] == world]
        normals = find_directions(in_world, unit) if in_world else np.eye(2)
        members = {node: sight for node, sight in sights.items() if pieces[node] == piece}
        found = [([*nodes], shape, True) for nodes, shape in _outline_rooms(members, normals, unit)]
        free = {node for node, other in enumerate(pieces) if other == piece}.difference(*(nodes for nodes, *_ in found))
        for view in sorted(free):  # those in a room come last in it
            point = shapely.Point(surfaces[view].center[[0, 2]])
            inside = next((nodes for nodes, shape, _ in found if shape.contains(point)), None)
            beside = shapely.union_all([shape for _, shape, _ in found])
            if inside is not None:
                inside.append(view)
            elif (shape := _enclose(surfaces[view], floors[view], normals, beside, unit)) is not None:
                found.append(([view], shape, False))
        for nodes, shape, is_closed in found:
            is_placed = not tour.overlaps or tour.is_placed(nodes[0]) or len(tour) == 1
            corners = np.array(shapely.orient_polygons(shape).exterior.coords)[:-1]
            rooms.append(Room(_name_room(tour, nodes), tuple(nodes), corners, storey, is_placed, is_closed))
    return rooms


def _name_room(tour: TourGraph, nodes: Sequence[int]) -> str:
    names = [*dict.fromkeys(tour.panoramas[node].title or tour.panoramas[node].name for node in nodes)]
    return " / ".join(names) if len(names) < 3 else f"{names[0]} + {len(names) - 1}"


def _outline_rooms(
    sights: Mapping[int, Sight], normals: Float[np.ndarray, "direction 2"], unit: float
) -> list[tuple[tuple[int, ...], Polygon]]:
    """The rooms of a storey: the panoramas whose own walls are closed, and outlines."""
    alone = {node: trace_outline(sight, find_lines([sight], normals, unit), unit) for node, sight in sights.items()}
    traced = [node for node, own in alone.items() if own is not None and own.area > _LEAST_AREA * unit**2]
    inside = {node: _list_inside(traced, sights, alone[node]) for node in traced}
    mutual = [(traced.index(a), traced.index(b)) for a in traced for b in inside[a] if a in inside[b]]
    labels = np.array(label_components(len(traced), mutual))
    shapes: list[tuple[tuple[int, ...], shapely.Geometry]] = []
    for label in np.unique(labels):
        nodes = tuple(traced[k] for k in np.flatnonzero(labels == label))
        outlines = [alone[node] for node in nodes]
        if len(nodes) > 1:
            lines = find_lines([sights[node] for node in nodes], normals, unit)
            outlines = [trace_outline(sights[node], lines, unit) or alone[node] for node in nodes]
        shapes.append((nodes, _clean(shapely.union_all(outlines), unit)))
    pieces = [
        (_list_inside(nodes, sights, piece), piece)
        for nodes, shape in _separate(shapes, sights)
        for piece in shapely.get_parts(_clean(shape, unit))
        if piece.area > _LEAST_AREA * unit**2
    ]
    return [(nodes, shapely.normalize(piece)) for nodes, piece in pieces if nodes]


def _separate(
    shapes: Sequence[tuple[tuple[int, ...], shapely.Geometry]], sights: Mapping[int, Sight]
) -> list[tuple[tuple[int, ...], shapely.Geometry]]:
    """The rooms without the places that belong to other ones: those of the room with most cameras there, or the nearest
    one."""
    result = [shape for _, shape in shapes]
    centers = [shapely.MultiPoint([sights[node].center for node in nodes]) for nodes, _ in shapes]
    for a, b in itertools.combinations(range(len(shapes)), 2):
        common = shapely.get_parts(result[a].intersection(result[b]))
        for piece in common[shapely.area(common) > 0]:
            place = piece.representative_point()
            rank = {k: (len(_list_inside(shapes[k][0], sights, piece)), -centers[k].distance(place)) for k in (a, b)}
            loser = min(b, a, key=lambda k: rank[k])
            result[loser] = result[loser].difference(piece)
    return [(nodes, shape) for (nodes, _), shape in zip(shapes, result, strict=True)]


def _clean(shape: shapely.Geometry, unit: float) -> shapely.Geometry:
    """A shape without spikes and slots, and with one piece for each straight wall."""
    narrow = _NARROW * unit
    for sign in (-1, 1):  # first spikes, then slots
        shape = shape.buffer(sign * narrow, join_style="mitre").buffer(-sign * narrow, join_style="mitre")
    pieces = [piece for piece in shapely.get_parts(shape) if not piece.is_empty]
    return shapely.union_all([Polygon(piece.exterior).simplify(_COLLINEAR * unit) for piece in pieces])


def _enclose(
    surfaces: Surfaces, floor: FloorOutline | None, normals: np.ndarray, beside: shapely.Geometry, unit: float
) -> Polygon | None:
    """A rectangle along the walls around a camera without closed walls: the extent of its floor, or of the surfaces at
    its height, without the rooms beside it; None if nothing of it is left.
    """
    center, places = surfaces.center[[0, 2]], surfaces.samples
    ends = measure_reach(places[np.abs(places[:, 1]) < _EYE_BAND * unit][:, (0, 2)])[:, None] * RAY_DIRECTIONS
    corners = center + ends[np.isfinite(ends[:, 0])] if floor is None else floor.corners
    axes, least = np.stack((normals[0], (-normals[0, 1], normals[0, 0])), axis=1), _LEAST_HALF * unit
    low, high = np.quantile(corners @ axes, _BROAD, axis=0) if len(corners) else (center @ axes,) * 2
    low, high = np.minimum(low, center @ axes - least), np.maximum(high, center @ axes + least)
    box = Polygon(shapely.get_coordinates(shapely.box(*low, *high)) @ axes.T)
    free = _clean(box.difference(beside).buffer(0), unit)
    pieces = [piece for piece in shapely.get_parts(free) if piece.area > _LEAST_PIECE * unit**2]
    return min(pieces, key=lambda piece: piece.distance(shapely.Point(center)), default=None)


def _list_inside(nodes: Iterable[int], sights: Mapping[int, Sight], shape: shapely.Geometry) -> tuple[int, ...]:
    """The panoramas whose cameras are in a shape."""
    return tuple(node for node in nodes if shape.contains(shapely.Point(sights[node].center)))
