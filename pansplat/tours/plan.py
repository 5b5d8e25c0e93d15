"""The floor plan of a scene as straight walls: rooms with their areas, doors, and how far the panoramas disagree.

A wall is sought above the doors, just below the ceiling, where a room is closed and little furniture stands. Each
direction around a camera ends at one of few lines, which are parallel to the main directions of the place: the
sequence of lines with the least error is found by dynamic programming. Panoramas that are in each other's outlines are
in one room; their lines are common and their outlines are joined.

Lengths below are fractions of the height of the cameras over the floor, about 1.5 m, so that the unit has no influence.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Bool, Float
from shapely.geometry import Polygon

from pansplat.system.components import label_components
from pansplat.tours.floor import FloorOutline, choose_camera_height, list_storeys_of_worlds
from pansplat.tours.graph import TourGraph
from pansplat.tours.linked_rooms import DrawnPlace, place_rooms
from pansplat.tours.surfaces import RAY_ANGLES, RAY_DIRECTIONS, RAYS, Outline, Surfaces, meet_outline, split_by_azimuth

# What a panorama shows of walls.
_WALL_BAND = 0.6, 0.85  # walls are sought between these fractions of the ceiling's height over the camera
_LEAST_CEILING = 0.25  # least height of a ceiling over the camera; doors may reach into the band of a lower one
_SURFACE = 0.12  # largest difference of the places of one surface, as a fraction of their distance
_BESIDE = 1  # number of rays on either side of one whose places count for it, too
_LEAST_DISTANCE = 0.25  # least distance of a wall from the camera; nearer places may be a lamp above it
_LOW = 0.5, 0.9  # openings reach to the floor if they are seen between these fractions of the height below the camera
# Directions and lines of walls. Chords connect places of walls; their lengths are the weights.
_SPAN = 2  # number of rays on either side of the one whose chord states a wall's direction
_LARGEST_STEP = 0.3  # largest length of a chord, as a fraction of its distance
_PARALLEL = math.radians(15)  # largest angle between a chord and its wall
_SKEW = math.radians(3)  # largest angle between a side of an outline and its wall
_OBLIQUE, _OBLIQUE_SHARE = math.radians(12), 0.15  # oblique walls: least angle to others, and share of all chords
_CLUSTER, _LEAST_WALL, _MOST_LINES = 0.07, 0.2, 24  # a line: half its width, its least length; lines of a direction
# The outline of a room. Costs are in errors of one ray.
_DISTANCE_NOISE, _LARGEST_ERROR = 0.07, 0.35  # usual and largest error of the distance of a wall
_CORNER, _JUMP, _LARGEST_JUMP = 5.0, 0.15, 5.0  # cost of another wall; a jump in depth that costs 1, and its most
_NEVER = 1e4  # cost of a wall in a direction in which it is not
_NARROW, _COLLINEAR = 0.12, 0.02  # half the width of spikes that are left out; pieces of one wall differ by less
_LEAST_AREA = 0.4  # least area of a room, squared camera heights
_SHAPE_ERROR = 0.2  # error of an area by its shape, as a fraction; 13 of 19 generated rooms of two panoramas have less
# Rectangles around cameras whose walls are open.
_BROAD = 0.12, 0.88  # quantiles of the ends of a floor, which goes on behind doors
_LEAST_HALF, _LEAST_PIECE = 0.5, 0.1  # least half side, and least area, squared camera heights, without other rooms
_EYE_BAND = 0.4  # surfaces around a camera without a floor are at most so far over or under it
# Doors, and the accuracy of walls.
_BEYOND = 0.25  # least length of the floor that is seen behind an opening
_DOOR_WIDTHS = 0.33, 1.7  # least and largest width of an opening
_SAME_DOOR = 0.4  # largest distance of the middles of an opening as seen from two sides
_NEAR_WALL, _LEAST_SEEN = 0.2, 8  # largest distance of places from their wall; least number of them by one panorama


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


@dataclass(frozen=True, eq=False)
class Door:
    """An opening of a room down to the floor: a door, or a window of a room's height.

    Attributes:
        ends: on the wall of the room, metres.
        rooms: the room, and the one on the other side if the opening is seen from there, too.
    """

    ends: Float[np.ndarray, "2 2"]
    rooms: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Plan:
    """The floor plan of a tour: rooms with straight walls, and doors.

    Attributes:
        tour: the panoramas, their edges and links.
        rooms: of all storeys.
        doors: of all rooms; one between two rooms once.
        camera_height: of the cameras over the floor, metres, the median.
        scale_error: standard deviation of these heights as a fraction; None if fewer than three are known.
        wall_error: standard deviation of a wall as one panorama shows it, metres; None if no wall is shown by two.
        num_heights, num_walls: that these figures are from.
    """

    tour: TourGraph
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    camera_height: float
    scale_error: float | None
    wall_error: float | None
    num_heights: int
    num_walls: int

    @cached_property
    def drawn(self) -> dict[int, DrawnPlace]:
        """Where panoramas are that links join with others (`place_rooms`)."""
        outlines = {node: room.outline for room in self.rooms for node in room.panoramas}
        return place_rooms(self.tour, outlines, self.camera_height) if outlines else {}

    def draw(self, node: int, places: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where the plan shows places around a panorama, to the right and forward of the level axes."""
        return self.drawn[node].move(places) if node in self.drawn else places

    @cached_property
    def turns(self) -> list[float]:
        """For each world the angle, anticlockwise, by which it is turned so that its longest wall is horizontal."""
        worlds, turns = self.tour.worlds, []
        for world in range(max(worlds) + 1):
            outlines = [room.outline for room in self.rooms if worlds[room.panoramas[0]] == world]
            sides = [np.roll(outline, -1, axis=0) - outline for outline in outlines]
            walls = np.concatenate([*sides, np.eye(2)[:1] * 1e-9])
            x, y = walls[np.linalg.norm(walls, axis=1).argmax()]
            turns.append(-math.remainder(math.atan2(y, x), math.pi))
        return turns

    def area_error(self, room: Room) -> float:
        """Standard deviation of a room's area, square metres, by those of the scale, of its walls and of its shape."""
        edges = np.linalg.norm(np.roll(room.outline, -1, axis=0) - room.outline, axis=1)
        walls = (self.wall_error or 0.0) * float(np.linalg.norm(edges))
        area = room.shape.area
        return math.hypot(walls, 2 * (self.scale_error or 0.0) * area, _SHAPE_ERROR * area)


@dataclass(frozen=True, eq=False)
class _Sight:
    """What one panorama shows of its room.

    Attributes:
        center: of the camera, in the plan.
        walls: where each ray meets a wall, relative to the camera; NaN where it is unknown.
        shown: all places of walls, in the plan.
        low: places below the camera and above the floor, relative to the camera.
    """

    center: Float[np.ndarray, "2"]
    walls: Float[np.ndarray, "ray 2"]
    shown: Float[np.ndarray, "n 2"]
    low: Float[np.ndarray, "m 2"]


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines of walls: places with normal @ place = offset."""

    normals: Float[np.ndarray, "line 2"]
    offsets: Float[np.ndarray, "line"]


def make_plan(
    surfaces: Sequence[Surfaces],
    tour: TourGraph,
    heights: Sequence[float | None],
    ceilings: Sequence[float | None],
    floors: Sequence[FloorOutline | None],
) -> Plan:
    """The floor plan of a tour.

    Args:
        surfaces: that each panorama shows.
        tour: the graph.
        heights, ceilings: distances of floors and ceilings below and above the cameras (`find_floor`, `find_ceiling`).
        floors: their outlines (`find_floor_outline`).
    """
    known = np.array([height for height in heights if height is not None])
    count, unit = len(tour), choose_camera_height(heights, tour.far)
    seen = zip(surfaces, heights, ceilings, floors, strict=True)
    sights = [_look(own, height or unit, ceiling, floor) for own, height, ceiling, floor in seen]
    pieces, worlds = list_storeys_of_worlds(tour), tour.worlds
    rooms: list[Room] = []
    for piece in sorted({*pieces}):
        world, storey = piece
        members = [k for k in range(count) if sights[k] is not None and pieces[k] == piece]
        in_world = [sights[k] for k in range(count) if sights[k] is not None and worlds[k] == world]
        normals = _find_directions(in_world, unit) if in_world else np.eye(2)
        found = [(*room, True) for room in _outline_rooms(sights, members, normals, unit)] if members else []
        free = {k for k in range(count) if pieces[k] == piece}.difference(*(n for n, *_ in found))
        for view in sorted(free):  # those in a room come last in it
            point = shapely.Point(surfaces[view].center[[0, 2]])
            inside = [n for n, (_, outline, _) in enumerate(found) if Polygon(outline).contains(point)]
            beside = shapely.union_all([Polygon(outline) for _, outline, _ in found])
            if inside:
                nodes, *others = found[inside[0]]
                found[inside[0]] = ((*nodes, view), *others)
            elif (outline := _enclose(surfaces[view], floors[view], normals, beside, unit)) is not None:
                found.append(((view,), outline, False))
        for nodes, outline, is_closed in found:
            is_placed = not tour.overlaps or tour.is_placed(nodes[0]) or len(tour) == 1
            rooms.append(Room(_name_room(tour, nodes), nodes, outline, storey, is_placed, is_closed))
    disagreement, num_walls = _measure_walls([room for room in rooms if room.is_closed], sights, worlds, unit)
    scale = float(1.4826 * np.median(np.abs(known - unit)) / unit) if len(known) > 2 else None
    doors = _find_doors(rooms, sights, unit)
    return Plan(tour, tuple(rooms), doors, unit, scale, disagreement, len(known), num_walls)


def _enclose(
    surfaces: Surfaces, floor: FloorOutline | None, normals: np.ndarray, beside: shapely.Geometry, unit: float
) -> Outline | None:
    """A rectangle along the walls around a camera without closed walls: the extent of its floor, or of the surfaces at
    its height, without the rooms beside it; None if nothing of it is left.
    """
    center, places = surfaces.center[[0, 2]], surfaces.samples
    ends = _measure_reach(places[np.abs(places[:, 1]) < _EYE_BAND * unit][:, (0, 2)])[:, None] * RAY_DIRECTIONS
    corners = center + ends[np.isfinite(ends[:, 0])] if floor is None else floor.corners
    axes, least = np.stack((normals[0], (-normals[0, 1], normals[0, 0])), axis=1), _LEAST_HALF * unit
    low, high = np.quantile(corners @ axes, _BROAD, axis=0) if len(corners) else (center @ axes,) * 2
    low, high = np.minimum(low, center @ axes - least), np.maximum(high, center @ axes + least)
    box = Polygon(shapely.get_coordinates(shapely.box(*low, *high)) @ axes.T)
    free = _clean(box.difference(beside).buffer(0), unit)
    pieces = [piece for piece in shapely.get_parts(free) if piece.area > _LEAST_PIECE * unit**2]
    piece = min(pieces, key=lambda piece: piece.distance(shapely.Point(center)), default=None)
    return None if piece is None else _list_corners(piece)


def _name_room(tour: TourGraph, nodes: Sequence[int]) -> str:
    names = [*dict.fromkeys(tour.panoramas[node].title or tour.panoramas[node].name for node in nodes)]
    return " / ".join(names) if len(names) < 3 else f"{names[0]} + {len(names) - 1}"


def _look(surfaces: Surfaces, height: float, ceiling: float | None, floor: FloorOutline | None) -> _Sight | None:
    """What a panorama shows; None if it shows no walls."""
    center, places = surfaces.center[[0, 2]], surfaces.samples
    down, flat = places[:, 1], places[:, (0, 2)]
    low = flat[(down > _LOW[0] * height) & (down < _LOW[1] * height)]
    if ceiling is None or ceiling < _LEAST_CEILING * height:
        if floor is None:
            return None
        reach = np.repeat(np.linalg.norm(floor.corners - center, axis=1), RAYS // len(floor.corners))
        walls = reach[:, None] * RAY_DIRECTIONS
        return _Sight(center, walls, center + walls, low[:0])  # no wall is above the openings
    band = flat[(-down > _WALL_BAND[0] * ceiling) & (-down < _WALL_BAND[1] * ceiling)]
    band = band[np.linalg.norm(band, axis=1) > _LEAST_DISTANCE * height]
    reach = _measure_reach(band)
    if np.isfinite(reach).sum() < RAYS // 2:
        return None
    return _Sight(center, reach[:, None] * RAY_DIRECTIONS, center + band, low)


def _measure_reach(places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "ray"]:
    """Distance around each ray of the surface that most places show; NaN where there are fewer than three.

    It is the median of those near the median of all, so that a beam in front or an opening does not move it.
    """
    distances = split_by_azimuth(places, np.linalg.norm(places, axis=1), RAYS)
    reach = np.full(RAYS, np.nan)
    for ray in range(RAYS):
        found = np.sort(np.concatenate([distances[(ray + shift) % RAYS] for shift in range(-_BESIDE, _BESIDE + 1)]))
        if len(found) > 2:
            middle = found[(len(found) - 1) // 2]
            near = found[np.abs(found - middle) <= _SURFACE * middle]
            reach[ray] = (near[(len(near) - 1) // 2] + near[len(near) // 2]) / 2  # np.median takes ten times as long
    return reach


def _find_chords(sight: _Sight, unit: float) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Middles in the plan, and vectors, of chords along the walls."""
    chords = np.roll(sight.walls, -_SPAN, axis=0) - np.roll(sight.walls, _SPAN, axis=0)
    length, distance = (np.linalg.norm(values, axis=1) for values in (chords, sight.walls))
    with np.errstate(invalid="ignore"):
        usable = (length > 0) & (length < np.maximum(_LARGEST_STEP * distance, _LEAST_WALL * unit))
    return sight.center + sight.walls[usable], chords[usable] / (2 * _SPAN)


def _find_directions(sights: Sequence[_Sight], unit: float) -> Float[np.ndarray, "direction 2"]:
    """Normals of the main walls, two of them at right angles, and those of frequent oblique ones."""
    chords = np.concatenate([_find_chords(sight, unit)[1] for sight in sights])
    angles, weights = np.arctan2(chords[:, 1], chords[:, 0]), np.linalg.norm(chords, axis=1)
    main = _find_peak(angles, weights, 90)
    found = [main, main + math.pi / 2]
    total = weights.sum()
    for _ in range(2):
        free = np.min([np.abs(_wrap(angles - angle, math.pi)) for angle in found], axis=0) > _OBLIQUE
        if not free.any():
            break
        angle = _find_peak(angles[free], weights[free], 180)
        near = np.abs(_wrap(angles - angle, math.pi)) < math.radians(5)
        if weights[near & free].sum() < _OBLIQUE_SHARE * total:
            break
        found.append(angle)
    turned = np.array(found) + math.pi / 2
    return np.stack((np.cos(turned), np.sin(turned)), axis=1)


def _find_peak(angles: np.ndarray, weights: np.ndarray, period: int) -> float:
    """The most frequent angle, radians, of angles that are equal after a period (degrees)."""
    degrees = np.degrees(angles) % period
    counts = np.bincount(degrees.astype(int) % period, weights, period)
    smooth = sum(np.roll(counts, shift) for shift in range(-2, 3))
    peak = math.radians(int(np.argmax(smooth)) + 0.5)
    for tolerance in (6, 3, 3):
        offset = _wrap(angles - peak, math.radians(period))
        near = np.abs(offset) < math.radians(tolerance)
        if not near.any():
            break
        peak += float(np.average(offset[near], weights=weights[near]))
    return peak


def _wrap(angles: np.ndarray, period: float) -> np.ndarray:
    """Angles in half a period around 0."""
    return (angles + period / 2) % period - period / 2


def _find_lines(sights: Sequence[_Sight], normals: Float[np.ndarray, "direction 2"], unit: float) -> _Lines:
    """The lines on which the walls of some panoramas are."""
    middles, chords = (np.concatenate(values) for values in zip(*(_find_chords(s, unit) for s in sights), strict=True))
    length = np.linalg.norm(chords, axis=1)
    found = []
    for normal in normals:
        chosen = np.abs(chords @ normal) < math.sin(_PARALLEL) * length
        offsets, weights = middles[chosen] @ normal, length[chosen]
        for _ in range(_MOST_LINES):
            if not len(offsets):
                break
            order = np.argsort(offsets, kind="stable")
            offsets, weights = offsets[order], weights[order]
            sums = np.concatenate(([0.0], np.cumsum(weights)))
            first, last = (np.searchsorted(offsets, offsets + sign * _CLUSTER * unit) for sign in (-1, 1))
            near = sums[last] - sums[first]
            best = int(near.argmax())
            if near[best] < _LEAST_WALL * unit * len(sights) ** 0.5:
                break
            a, b = first[best], last[best]
            middle = np.searchsorted(sums[a : b + 1], (sums[a] + sums[b]) / 2)
            found.append((normal, offsets[a + max(int(middle) - 1, 0)]))
            offsets, weights = (np.delete(values, np.s_[a:b]) for values in (offsets, weights))
    return _Lines(np.array([n for n, _ in found]).reshape(-1, 2), np.array([offset for _, offset in found]))


def _trace_outline(sight: _Sight, lines: _Lines, unit: float) -> Polygon | None:
    """The outline of the walls around a camera; None if no lines enclose it."""
    sequence = _choose_lines(sight, lines, unit)
    if sequence is None:
        return None
    changes = np.flatnonzero(sequence != np.roll(sequence, 1))
    if len(changes) < 3:
        return None
    corners: list[np.ndarray] = []
    offsets = lines.offsets - lines.normals @ sight.center  # relative to the camera
    for ray in changes.tolist():
        before, after = int(sequence[ray - 1]), int(sequence[ray])
        border = ray * 2 * math.pi / RAYS  # between the two rays
        direction = np.array((math.sin(border), math.cos(border)))
        corners += _join(direction, lines.normals[[before, after]], offsets[[before, after]], unit)
    outline = np.array(corners).reshape(-1, 2)
    if len(outline) < 3 or not _is_along(outline, lines, unit):
        return None
    # Behind an opening no end of a wall may be seen: it ends where the farthest surfaces are.
    axes = np.stack((lines.normals[0], (-lines.normals[0, 1], lines.normals[0, 0])))
    low, high = (find(sight.walls @ axes.T, axis=0) for find in (np.nanmin, np.nanmax))
    margin = _LARGEST_ERROR * unit
    outline = np.clip(outline @ axes.T, low - margin, high + margin) @ axes
    pieces = shapely.get_parts(shapely.make_valid(Polygon(sight.center + outline)).buffer(0))
    return next((piece for piece in pieces if piece.contains(shapely.Point(sight.center))), None)


def _is_along(outline: Outline, lines: _Lines, unit: float) -> bool:
    """Whether all longer sides of an outline are parallel to a wall, so that the walls enclose the camera."""
    sides = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(sides, axis=1)
    away = np.abs(sides @ lines.normals.T).min(axis=1)
    return not ((length > _LEAST_WALL * unit) & (away > math.sin(_SKEW) * length)).any()


def _choose_lines(sight: _Sight, lines: _Lines, unit: float) -> np.ndarray | None:
    """The line that each ray ends at, by dynamic programming around the circle; None without lines."""
    if len(lines.offsets) < 3:
        return None
    measured = np.linalg.norm(sight.walls, axis=1)
    offsets = lines.offsets - lines.normals @ sight.center

    def meet(rays: np.ndarray) -> np.ndarray:
        """Distances (ray, line) at which rays meet the lines; infinite if they do not."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = offsets / (rays @ lines.normals.T)
        return np.where(distance > 0, distance, np.inf)

    reached = meet(RAY_DIRECTIONS)
    error = np.abs(reached - measured[:, None]) / unit
    costs = np.minimum(np.where(np.isnan(error), 0, error), _LARGEST_ERROR) / _DISTANCE_NOISE
    costs[np.isinf(reached)] = _NEVER
    angles = np.arange(RAYS) * 2 * math.pi / RAYS
    between = meet(np.stack((np.sin(angles), np.cos(angles)), axis=1))
    beyond = np.where(np.isinf(between), _NEVER, 0.0)  # a wall ends where a ray meets it
    between = np.minimum(between, 1e3 * unit)
    total, origins = costs[0], []
    for step in range(1, 3 * RAYS):
        ray = step % RAYS
        jump = np.abs(between[ray][:, None] - between[ray]) / (_JUMP * unit)
        change = _CORNER + np.minimum(jump, _LARGEST_JUMP) + beyond[ray] + beyond[ray][:, None]
        np.fill_diagonal(change, 0)
        reached = total[:, None] + change  # from each line to each line
        origins.append(reached.argmin(axis=0))
        total = reached.min(axis=0) + costs[ray]
    state, sequence = int(total.argmin()), []
    for origin in reversed(origins):
        sequence.append(state)
        state = int(origin[state])
    sequence.append(state)
    return np.array(sequence[::-1])[RAYS : 2 * RAYS]


def _join(
    direction: Float[np.ndarray, "2"], normals: Float[np.ndarray, "2 2"], offsets: Float[np.ndarray, "2"], unit: float
) -> list[np.ndarray]:
    """Corners relative to a camera between two walls that meet, or of which the nearer one hides the other's end.

    Args:
        direction: in which the first wall ends.
        normals, offsets: of the two walls, relative to the camera.
    """
    along = normals @ direction
    distance = offsets / np.where(np.abs(along) < 1e-9, 1e-9, along)
    ends = distance[:, None] * direction
    if abs(np.linalg.det(normals)) > 0.17:  # 10 degrees
        corner = np.linalg.solve(normals, offsets)
        if min(np.linalg.norm(ends - corner, axis=1)) < 2 * _LARGEST_ERROR * unit and corner @ direction > 0:
            return [corner]
    if (distance <= 0).any() or not np.isfinite(distance).all():
        return []
    near = int(distance.argmin())
    far = 1 - near
    if abs(np.linalg.det(normals)) < 0.17:
        step = (offsets[far] - normals[far] @ ends[near]) / (normals[far] @ normals[near])
        hidden = [ends[near] + step * normals[near]]
    else:
        # The hidden wall starts at right angles to the nearer one, and another one ends at the farther one.
        across = np.stack((normals[near], -normals[far]), axis=1)
        lengths = np.linalg.solve(across, ends[far] - ends[near])
        hidden = [ends[near] + lengths[0] * normals[near], ends[far]]
    path = [ends[near], *hidden]
    return path if near == 0 else path[::-1]


def _outline_rooms(
    sights: Sequence[_Sight | None], members: Sequence[int], normals: Float[np.ndarray, "direction 2"], unit: float
) -> list[tuple[tuple[int, ...], Outline]]:
    """The rooms of a storey: the panoramas whose own walls are closed, and outlines."""
    seen = {k: sights[k] for k in members}
    alone = {k: _trace_outline(sight, _find_lines([sight], normals, unit), unit) for k, sight in seen.items()}
    traced = [k for k in members if alone[k] is not None and alone[k].area > _LEAST_AREA * unit**2]
    inside = {k: _list_inside(traced, seen, alone[k]) for k in traced}
    mutual = [(traced.index(a), traced.index(b)) for a in traced for b in inside[a] if a in inside[b]]
    labels = np.array(label_components(len(traced), mutual))
    shapes: list[tuple[tuple[int, ...], shapely.Geometry]] = []
    for label in np.unique(labels):
        nodes = tuple(traced[k] for k in np.flatnonzero(labels == label))
        outlines = [alone[k] for k in nodes]
        if len(nodes) > 1:
            lines = _find_lines([seen[k] for k in nodes], normals, unit)
            outlines = [_trace_outline(seen[k], lines, unit) or alone[k] for k in nodes]
        shapes.append((nodes, _clean(shapely.union_all(outlines), unit)))
    pieces = [
        (nodes, piece) for nodes, shape in _separate(shapes, seen) for piece in shapely.get_parts(_clean(shape, unit))
    ]
    pieces = [(_list_inside(nodes, seen, piece), piece) for nodes, piece in pieces]
    pieces = [(nodes, piece) for nodes, piece in pieces if nodes and piece.area > _LEAST_AREA * unit**2]
    return [(nodes, _list_corners(shapely.normalize(piece))) for nodes, piece in pieces]


def _list_corners(shape: Polygon) -> Outline:
    """The corners of a shape, anticlockwise."""
    return np.array(shapely.orient_polygons(shape).exterior.coords)[:-1]


def _list_inside(nodes: Iterable[int], sights: dict[int, _Sight], shape: shapely.Geometry) -> tuple[int, ...]:
    """The panoramas whose cameras are in a shape."""
    return tuple(node for node in nodes if shape.contains(shapely.Point(sights[node].center)))


def _clean(shape: shapely.Geometry, unit: float) -> shapely.Geometry:
    """A shape without spikes and slots, and with one piece for each straight wall."""
    narrow = _NARROW * unit
    for sign in (-1, 1):  # first spikes, then slots
        shape = shape.buffer(sign * narrow, join_style="mitre").buffer(-sign * narrow, join_style="mitre")
    pieces = [piece for piece in shapely.get_parts(shape) if not piece.is_empty]
    return shapely.union_all([Polygon(piece.exterior).simplify(_COLLINEAR * unit) for piece in pieces])


def _separate(
    shapes: Sequence[tuple[tuple[int, ...], shapely.Geometry]], sights: dict[int, _Sight]
) -> list[tuple[tuple[int, ...], shapely.Geometry]]:
    """The rooms without the places that belong to other ones: those of the room with most cameras there, or the nearest
    one."""
    result = [shape for _, shape in shapes]
    centers = [shapely.MultiPoint([sights[node].center for node in nodes]) for nodes, _ in shapes]
    for a, b in itertools.combinations(range(len(shapes)), 2):
        common = result[a].intersection(result[b])
        for piece in shapely.get_parts(common):
            if piece.area == 0:
                continue
            place = piece.representative_point()
            rank = {k: (len(_list_inside(shapes[k][0], sights, piece)), -centers[k].distance(place)) for k in (a, b)}
            loser = min(b, a, key=lambda k: rank[k])
            result[loser] = result[loser].difference(piece)
    return [(nodes, shape) for (nodes, _), shape in zip(shapes, result, strict=True)]


def _measure_walls(
    rooms: Sequence[Room], sights: Sequence[_Sight | None], worlds: Sequence[int], unit: float
) -> tuple[float | None, int]:
    """Standard deviation of a wall by the panoramas that show it from the room's side, and the number of such walls."""
    variances = []
    for room in rooms:
        near_room = [s for k, s in enumerate(sights) if s is not None and worlds[k] == worlds[room.panoramas[0]]]
        for start, end in zip(room.outline, np.roll(room.outline, -1, axis=0), strict=True):
            length = float(np.linalg.norm(end - start))
            if length < 2 * _LEAST_WALL * unit:
                continue
            along = (end - start) / length
            inward = np.array((-along[1], along[0]))  # corners are anticlockwise
            offsets = []
            for sight in near_room:
                if (sight.center - start) @ inward < _NEAR_WALL * unit:
                    continue
                places = sight.shown - start
                offset, position = places @ inward, places @ along / length
                near = (np.abs(offset) < _NEAR_WALL * unit) & (position > 0.1) & (position < 0.9)
                if near.sum() >= _LEAST_SEEN:
                    offsets.append(float(np.median(offset[near])))
            if len(offsets) > 1:
                variances.append(float(np.var(offsets, ddof=1)))
    return (math.sqrt(float(np.mean(variances))), len(variances)) if variances else (None, 0)


def _find_doors(rooms: Sequence[Room], sights: Sequence[_Sight | None], unit: float) -> tuple[Door, ...]:
    """The openings through which panoramas show what is beyond the walls of their rooms, down to the floor."""
    found: list[tuple[int, np.ndarray, int]] = []  # room, ends, rays
    for number, room in enumerate(rooms):
        for node in [node for node in room.panoramas if room.is_closed and sights[node] is not None]:
            found += [(number, ends, rays) for ends, rays in _find_openings(sights[node], room.outline, unit)]
    found.sort(key=lambda opening: -opening[2])
    doors: list[Door] = []
    for number, ends, _ in found:
        middle = ends.mean(axis=0)
        near = [
            k
            for k, door in enumerate(doors)
            if np.linalg.norm(door.ends.mean(axis=0) - middle) < _SAME_DOOR * unit
            and rooms[door.rooms[0]].storey == rooms[number].storey
        ]
        if not near:
            doors.append(Door(ends, (number,)))
        elif number not in doors[near[0]].rooms:
            doors[near[0]] = Door(doors[near[0]].ends, (*doors[near[0]].rooms, number))
    return tuple(doors)


def _find_openings(sight: _Sight, outline: Outline, unit: float) -> list[tuple[np.ndarray, int]]:
    """Ends on one wall of each opening that a panorama shows, and the number of its rays."""
    reach = _measure_reach(sight.low)
    distance, wall = meet_outline(sight.center, outline)
    with np.errstate(invalid="ignore"):
        is_open: Bool[np.ndarray, "ray"] = (reach > distance + _BEYOND * unit) & (wall >= 0)
    labels = np.where(is_open, wall, -1)
    start = int(np.argmin(is_open)) if not is_open.all() else 0  # a ray that is not open, so that no run is cut
    order = np.roll(np.arange(RAYS), -start)
    openings = []
    for label, run in itertools.groupby(order.tolist(), key=lambda ray: labels[ray]):
        rays = list(run)
        if label < 0 or len(rays) < 3:
            continue
        half = math.pi / RAYS
        corners = outline[label], outline[(label + 1) % len(outline)]
        angles = RAY_ANGLES[[rays[0], rays[-1]]] + (-half, half)
        ends = np.array([_meet_line(sight.center, angle, *corners) for angle in angles])
        width = float(np.linalg.norm(ends[1] - ends[0]))
        if _DOOR_WIDTHS[0] * unit < width < _DOOR_WIDTHS[1] * unit:
            openings.append((ends, len(rays)))
    return openings


def _meet_line(center: np.ndarray, angle: float, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Where a ray meets the line of a wall, within its ends."""
    direction = np.array((math.sin(angle), math.cos(angle)))
    system = np.stack((end - start, -direction), axis=1)
    if abs(np.linalg.det(system)) < 1e-12:
        return start
    return start + float(np.clip(np.linalg.solve(system, center - start)[0], 0, 1)) * (end - start)
