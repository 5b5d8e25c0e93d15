"""Where a plan shows worlds whose places are not known: beside the rooms from which links of the tour lead to them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from shapely import Geometry
from shapely.geometry import Point, Polygon

from pansplat.geometry.level import wrap_angle
from pansplat.tours.floor import assign_storeys
from pansplat.tours.graph import TourGraph
from pansplat.tours.surfaces import RAY_DIRECTIONS, Outline, meet_outline

# Lengths are fractions of the height of the cameras over the floor, about 1.5 m.
_ASIDE, _LINK_ERROR = range(-180, 180, 6), 12.0  # tried and usual angles between a door and its link, degrees
WALL_THICKNESS, _STEP = 0.08, 0.45  # thickness of a wall between two rooms; distance of a dot from the wall before it
_MOST_OVERLAP, _PUSH = 0.01, 0.1  # largest share of a room that is in others; length of a step away from them
_APART, _FARTHEST = 9.0, 200.0  # cost of a unit away from the door; least cost of a place that is not used
_PLACE_ERROR, _TURN_ERROR = 0.5, 0.25  # usual errors of a stated place, and of its turn, radians
_FAN = math.radians(50)  # angle between dots that are behind one dot


Vector, Way = Float[np.ndarray, "2"], tuple[int, int]


class DrawnPlace(NamedTuple):
    """Where a plan shows a panorama at an approximate place.

    Attributes:
        beside: the panorama whose world it is shown in.
        turn: of what is around it, radians to the right; None if it is unknown.
        shift: after the turn, to the right and forward of the tour's level axes, metres.
    """

    beside: int
    turn: float | None
    shift: Float[np.ndarray, "2"]

    def move(self, places: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where places around the panorama are shown, to the right and forward."""
        return places @ turn_plan(self.turn or 0.0) + self.shift


class _Shown(NamedTuple):
    """A panorama on the plan: its camera, turn (None of a dot), outline, and the direction away from its neighbour."""

    place: Vector
    turn: float | None
    outline: Outline
    away: Vector


def place_rooms(tour: TourGraph, outlines: Mapping[int, Outline], unit: float) -> dict[int, DrawnPlace]:
    """Where the plan shows panoramas of worlds that links join with larger ones; others stand apart.

    With links in both directions the outlines of two rooms are wall to wall at their door; without a link back the
    heading is unknown, and the room is a dot behind the door.

    Args:
        tour: with links.
        outlines: of the rooms of panoramas, to the right and forward, anticlockwise; others are small squares.
        unit: height of the cameras over the floor.
    """
    centers, storeys, worlds = tour.positions @ tour.level_axes[:, (0, 2)], assign_storeys(tour), tour.worlds
    square = unit / 2 * np.array(((-1, -1), (1, -1), (1, 1), (-1, 1)))
    shapes = [outlines.get(node, center + square) for node, center in enumerate(centers)]
    own = [_Shown(center, 0.0, shape, np.zeros(2)) for center, shape in zip(centers, shapes, strict=True)]
    starts = [worlds[a] for a, b in tour.links if worlds[a] != worlds[b]]
    roots = sorted(set(worlds), key=lambda world: (-worlds.count(world), -starts.count(world), world))
    shown: dict[int, _Shown] = {}
    drawn: dict[int, DrawnPlace] = {}
    for root in roots:
        piece = {node for node, world in enumerate(worlds) if world == root and node not in shown}
        shown |= {node: own[node] for node in piece}
        while ways := _list_ways(tour, shown, piece):
            a, b = ways[0]
            first = drawn[a].beside if a in drawn else a
            around = [n for n in piece if storeys[drawn[n].beside if n in drawn else n] == storeys[first]]
            taken = shapely.union_all([Polygon(shown[n].outline) for n in around if shown[n].turn is not None])
            is_stated = b in tour.approximate and worlds[tour.approximate[b][0]] == root
            stated = find_stated_place(tour, b) if is_stated else None
            moved = _find_motion(tour, (a, b), (shown[a], own[b]), taken, unit, stated)
            if moved is None:
                dots = shapely.MultiPoint([shown[n].place for n in around]).buffer(_STEP * unit)
                moved = _put_behind(tour, (a, b), shown[a], taken | dots, unit)
            place, away = DrawnPlace(first, *moved[:2]), moved[2]
            for node in [node for node, world in enumerate(worlds) if world == worlds[b]]:
                shown[node] = _Shown(place.move(centers[node]), place.turn, place.move(shapes[node]), away)
                drawn[node] = place
                piece.add(node)
    return drawn


def turn_plan(yaw: float) -> Float[np.ndarray, "2 2"]:
    """The rotation to the right of rows (right, forward), which is applied from the right."""
    return np.array(((math.cos(yaw), -math.sin(yaw)), (math.sin(yaw), math.cos(yaw))))


def find_stated_place(tour: TourGraph, node: int) -> DrawnPlace:
    """Where the plan shows a panorama at an approximate place (`TourGraph.approximate`), by that alone."""
    beside, about = tour.approximate[node]
    yaw, own = (math.atan2(*(tour.level_axes.T @ tour.cam2world[n, :3, 2].numpy())[::2]) for n in (beside, node))
    view, centers = tour.panoramas[beside], tour.positions @ tour.level_axes[:, (0, 2)]
    scale = view.camera_height if about.is_in_heights else 1 / view.frame.unit
    offset, turn = scale * np.array((about.right, about.forward)), wrap_angle(yaw + about.yaw - own)
    return DrawnPlace(beside, turn, centers[beside] + offset @ turn_plan(yaw) - centers[node] @ turn_plan(turn))


def _list_ways(tour: TourGraph, shown: Mapping[int, _Shown], piece: set[int]) -> list[Way]:
    """The links to panoramas that are not shown yet; those with a link back first, from rooms with an outline."""
    stated = [(beside, node) for node, (beside, _) in tour.approximate.items()]
    ways = [(a, b) for a, b in (*tour.links, *stated) if a in piece and b not in shown]
    return sorted(ways, key=lambda way: ((shown[way[0]].turn is None) + (way[::-1] not in tour.links), way))


def _measure_azimuth(tour: TourGraph, way: Way) -> float:
    """The direction of a link, radians from forward to the right; 0 if it is vertical."""
    right, _, forward = tour.find_direction(*way)
    return math.atan2(right, forward)


def _find_doors(room: _Shown, azimuth: float) -> list[tuple[Vector, Vector, float]]:
    """Where directions around that of a link meet the walls of a room: place, normal outwards, error."""
    reach, walls = meet_outline(room.place, room.outline)
    rays, sides, found = RAY_DIRECTIONS, np.roll(room.outline, -1, axis=0) - room.outline, []
    for aside in _ASIDE:
        ray = math.floor(math.degrees(azimuth) + aside) % len(rays)
        if walls[ray] >= 0:
            right, forward = sides[walls[ray]] / np.linalg.norm(sides[walls[ray]])
            found.append((room.place + reach[ray] * rays[ray], np.array((forward, -right)), abs(aside) / _LINK_ERROR))
    return found


def _find_motion(
    tour: TourGraph, way: Way, rooms: tuple[_Shown, _Shown], taken: Geometry, unit: float, stated: DrawnPlace | None
) -> tuple[float, Vector, Vector] | None:
    """The turn and shift after which a room stands wall to wall at a door, and the direction through it.

    The best place is the one with doors near the links, near a stated place, and not in other rooms. Without links in
    both directions it is the stated place; None without that, too.
    """
    back, (first, second) = way[::-1], rooms
    found: list[tuple[float, float, Vector, Vector]] = []
    doors: list[tuple[Vector, Vector, float]] = []
    if first.turn is not None and {way, back} <= tour.links.keys():
        doors = _find_doors(first, _measure_azimuth(tour, way) + first.turn)
    elif stated is not None:
        away = stated.move(second.place) - first.place
        found = [(0.0, stated.turn or 0.0, stated.shift, away / max(np.linalg.norm(away), 1e-9))]
    for here, there in itertools.product(doors, _find_doors(second, _measure_azimuth(tour, back)) if doors else ()):
        turn = wrap_angle(math.atan2(*-here[1]) - math.atan2(*there[1]))
        shift = here[0] + WALL_THICKNESS * unit * here[1] - there[0] @ turn_plan(turn)
        cost = here[2] + there[2]
        if stated is not None:
            away = np.linalg.norm(second.place @ turn_plan(turn) + shift - stated.move(second.place)) / unit
            cost += away / _PLACE_ERROR + abs(wrap_angle(turn - stated.turn)) / _TURN_ERROR
        found.append((cost, turn, shift, here[1]))
    best, least = None, _FARTHEST
    for cost, turn, shift, away in sorted(found, key=lambda each: each[0]):
        while cost < least and _measure_overlap(second.outline @ turn_plan(turn) + shift, taken) > _MOST_OVERLAP:
            shift, cost = shift + _PUSH * unit * away, cost + _APART * _PUSH
        if cost < least:
            best, least = (turn, shift, away), cost
    return best


def _measure_overlap(outline: Outline, taken: Geometry) -> float:
    """The share of a room that is in others."""
    shape = Polygon(outline).buffer(0)
    return float(shape.intersection(taken).area / max(shape.area, 1e-12))


def _put_behind(tour: TourGraph, way: Way, first: _Shown, taken: Geometry, unit: float) -> tuple[None, Vector, Vector]:
    """Where the dot of a room is whose heading is unknown, and the direction from its neighbour."""
    doors = [] if first.turn is None else _find_doors(first, _measure_azimuth(tour, way) + first.turn)
    if not doors:
        ways = [first.away @ turn_plan(_FAN * step) for step in (0, 1, -1, 2, -2)]
        doors = [(first.place + _STEP * unit * away, away, float(k)) for k, away in enumerate(ways)]
    spots = [(place + _STEP * unit * away, away, error) for place, away, error in doors]
    place, away, _ = min(spots, key=lambda spot: spot[2] + 3 * taken.intersects(Point(spot[0])))
    return None, place - tour.positions[way[1]] @ tour.level_axes[:, (0, 2)], away
