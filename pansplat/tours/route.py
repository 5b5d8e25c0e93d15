"""Ways of the camera through the panoramas of a tour: turns, flights and zooms, one after the other.

At a panorama the camera turns to where it goes. Along an edge it flies, and looks ahead. Any other step is a zoom: the
photograph grows towards the next panorama, whose photograph fades in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float

from pansplat.geometry.level import turn_axes, wrap_angle
from pansplat.tours.graph import Edge, TourGraph
from pansplat.tours.outlook import find_bins, find_turns, find_widest

FADE_SECONDS = 1.0  # duration of the fade between two scenes
NEAR_OF_FAR = 0.03  # Gaussians of a tour within this fraction of far are not drawn, because ways pass door frames
STOP_REACH = 0.03  # metres from a panorama, within which its photograph is shown
STOP_SECONDS = 0.2  # duration of the fade between scene and photograph
REST_SECONDS = 3.0  # time at each panorama of a flight through a tour
TURN_SECONDS, TURN_DEGREES = 0.4, 45.0  # time of a turn by at least that angle; a smaller turn takes less
ZOOM_SECONDS = 0.7  # duration of a zoom
_END_SECONDS = 0.1  # rest after a zoom, so that a route ends in the scene of its last panorama
ZOOM = 2 / 3  # field of view at the end of a zoom, relative to that at its start
LOWEST_PITCH = -0.2  # least pitch towards a link, which may be on the floor, radians
FLIGHT_SECONDS = 1.0, 1.6  # least and largest duration of a flight
SHORT_FLIGHT, METRE_SECONDS = 2.0, 0.1  # longest flight of the least duration, metres; time of each further metre
_NEAR = 1.0  # distance of the first panorama below which the camera keeps its heading, metres
COVERED = 0.1  # share of a flight, from either end, that shows the photograph; it fades over as much again
SURFACES, MOST_BESIDE = 2.5, 0.4  # usual distance of surfaces, metres; largest part of it beside a photograph's camera

Kind = Literal["turn", "flight", "zoom", "rest"]


@dataclass(frozen=True, eq=False)
class Step:
    """A movement of the camera, which starts and stops smoothly.

    Attributes:
        start, end: right, down and forward in metres, yaw and pitch in radians, relative to the route's `level`. In
            a zoom the camera stays at `start` and jumps to `end`.
        edge: whose scene is shown; None is that of the camera's place.
        nodes: the panoramas at both ends; None elsewhere.
        following: index in the walk of the next panorama.
    """

    kind: Kind
    start: Float[np.ndarray, "5"]
    end: Float[np.ndarray, "5"]
    seconds: float
    edge: Edge | None
    nodes: tuple[int | None, int | None]
    following: int


@dataclass(frozen=True, eq=False)
class Moment:
    """A time of a route.

    Attributes:
        step: that goes on.
        pose: of the camera (cam2world).
        photograph: the panorama whose photograph is shown; None for none.
        weight: of the photograph over the Gaussians, 0 to 1.
        arrival: of a zoom, the pose at its end; else None.
        zoom: fraction of a zoom that is done.
    """

    step: Step
    pose: Float[np.ndarray, "4 4"]
    photograph: int | None
    weight: float
    arrival: Float[np.ndarray, "4 4"] | None = None
    zoom: float = 0.0

    @property
    def narrowing(self) -> float:
        """Field of view of the photograph that a zoom begins with, as a fraction of the camera's."""
        return 1 - (1 - ZOOM) * self.zoom

    @property
    def arrived(self) -> float:
        """Weight of the photograph that a zoom ends with, 0 to 1: the first one is seen to grow."""
        return self.zoom**2


@dataclass(frozen=True, eq=False)
class Route:
    """A way through panoramas.

    Attributes:
        steps: one or more.
        walk: the panoramas in the order of the way.
        level: axes of a level camera (columns right, down, forward).
    """

    steps: tuple[Step, ...]
    walk: tuple[int, ...]
    level: Float[np.ndarray, "3 3"]

    @cached_property
    def _ends(self) -> Float[np.ndarray, "step"]:
        return np.cumsum([step.seconds for step in self.steps])

    @property
    def seconds(self) -> float:
        """The duration."""
        return float(self._ends[-1])

    @property
    def visits(self) -> dict[int, float]:
        """The fraction of the duration at which the camera comes to rest at a panorama, by panorama."""
        begins = zip(self.steps, self._ends - [step.seconds for step in self.steps], strict=True)
        rests = [(step.nodes[1], begin / self.seconds) for step, begin in begins if step.kind == "rest"]
        return {node: at for node, at in rests if node is not None}

    def _find(self, fraction: float) -> tuple[int, float]:
        """The step at a fraction of the duration, and the eased fraction of it that is done."""
        time = min(max(fraction, 0.0), 1.0) * self.seconds
        number = min(int(np.searchsorted(self._ends, time, side="right")), len(self.steps) - 1)
        return number, ease(1 + (time - float(self._ends[number])) / self.steps[number].seconds)

    def at(self, fraction: float) -> Moment:
        """The camera at a fraction of the duration, 0 to 1."""
        number, part = self._find(fraction)
        step = self.steps[number]
        if step.kind == "zoom" and part < 1:
            return Moment(step, self._pose(step.start), step.nodes[0], 1.0, self._pose(step.end), part)
        pose = self._pose((1 - part) * step.start + part * step.end)
        end, away = (0, part) if part < 0.5 else (1, 1 - part)
        weight = min(max(2 - away / COVERED, 0.0), 1.0) if step.kind == "flight" else 1.0
        return Moment(step, pose, step.nodes[end], weight if step.nodes[end] is not None else 0.0)

    def pose(self, fraction: float) -> Float[np.ndarray, "4 4"]:
        """The pose (cam2world) at a fraction of the duration."""
        return self.at(fraction).pose

    def _pose(self, camera: Float[np.ndarray, "5"]) -> Float[np.ndarray, "4 4"]:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn_axes(self.level, *camera[3:].tolist()), self.level @ camera[:3]
        return pose

    def edges_after(self, fraction: float) -> list[Edge]:
        """The edges from a fraction of the duration on."""
        return [step.edge for step in self.steps[self._find(fraction)[0] :] if step.edge is not None]

    def list_remaining(self, fraction: float) -> tuple[int, ...]:
        """The panoramas after a fraction of the duration."""
        return self.walk[self.at(fraction).step.following :]


def plan_route(
    tour: TourGraph,
    walk: Sequence[int],
    start: Float[np.ndarray, "4 4"] | None = None,
    *,
    rest: float = 0.0,
    outlooks: Mapping[int, Float[np.ndarray, "bin"]] | None = None,
) -> Route:
    """A way along a walk. It ends in the start view of its last panorama, else in the direction of arrival, turned from
    a wall that is close.

    Args:
        tour: the graph.
        walk: nodes; consecutive ones share an edge, or are of different parts.
        start: pose from which the first node is approached; None starts at that node, in the direction of its start
            view, or of the second node.
        rest: seconds at each panorama on the first visit, in its start view.
        outlooks: of panoramas (`measure_outlook`), which show walls that are close (`find_turns`), and the widest view,
            in which a zoom to another world ends if nothing else is stated.
    """
    planner = _Planner(tour, outlooks or {})
    planner.begin(walk, start)
    for number, node in enumerate(walk):
        planner.go(node, walk[number + 1 : number + 2])
        is_visit = rest > 0 and node not in walk[:number] and (start is None or len(planner.steps) > 0)
        has_zoomed = len(planner.steps) > 0 and planner.steps[-1].kind == "zoom"
        if (is_visit or number == len(walk) - 1) and not has_zoomed:
            planner.turn(find_start_angles(tour, node) or planner.avoid_wall(node, *planner.camera[3:]))
        if is_visit:
            planner.add("rest", planner.camera, rest)
    if not planner.steps or planner.steps[-1].kind == "zoom":
        planner.add("rest", planner.camera, _END_SECONDS)
    return Route(tuple(planner.steps), tuple(walk), tour.level_axes)


class _Planner:
    """Adds the steps of a route; `camera`, `node` and `edge` are those at the end of the last one."""

    def __init__(self, tour: TourGraph, outlooks: Mapping[int, Float[np.ndarray, "bin"]]) -> None:
        self.tour, self.outlooks = tour, outlooks
        self.level, self.places = tour.level_axes, tour.positions @ tour.level_axes
        self.steps: list[Step] = []
        self.node: int | None = None
        self.edge: Edge | None = None
        self.following = 0

    def begin(self, walk: Sequence[int], start: Float[np.ndarray, "4 4"] | None) -> None:
        """Stand at a pose, or at the first panorama."""
        if start is None:
            ahead = self.find_way(walk[0], walk[1]) if len(walk) > 1 else None
            view = find_start_angles(self.tour, walk[0]) or ahead or (0.0, 0.0)
            self.camera = np.array((*self.places[walk[0]], *view))
        else:
            self.camera = np.array((*self.level.T @ start[:3, 3], *find_angles(self.level.T @ start[:3, 2])))
        distances = np.linalg.norm(self.places - self.camera[:3], axis=1)
        if distances.min() <= STOP_REACH:
            self.node = int(distances.argmin())

    def add(self, kind: Kind, camera: Sequence[float] | np.ndarray, seconds: float, node: int | None = None) -> None:
        """Go to a camera, at a panorama or where the camera is."""
        end, nodes = np.array(camera, dtype=float), (self.node, self.node if node is None else node)
        self.steps.append(Step(kind, self.camera, end, seconds, self.edge, nodes, self.following))
        self.camera, self.node = end, nodes[1]

    def turn(self, view: Sequence[float] | None) -> None:
        """Turn to a yaw and pitch; a small angle takes less time."""
        yaw, pitch = self.camera[3:] if view is None else view
        across = wrap_angle(yaw - self.camera[3])
        part = min(math.hypot(across, pitch - self.camera[4]) / math.radians(TURN_DEGREES), 1.0)
        if part > 1e-6:
            self.add("turn", (*self.camera[:3], self.camera[3] + across, pitch), part * TURN_SECONDS)

    def go(self, node: int, after: Sequence[int]) -> None:
        """Go to a panorama, after which another one may follow."""
        before = self.node
        if before is not None and self.tour.is_zoom(before, node):
            self.turn(self.find_way(before, node))
            self.add("zoom", (*self.places[node], *self.find_arrival(before, node)), ZOOM_SECONDS, node)
        elif before != node:
            edge = None if before is None else (min(before, node), max(before, node))
            self.edge = edge if edge in self.tour.overlaps else self.edge
            self.fly(node)
        self.following += 1
        if self.edge is None or node not in self.edge:
            is_flown = len(after) > 0 and not self.tour.is_zoom(node, after[0])
            self.edge = (min(node, after[0]), max(node, after[0])) if is_flown else self.tour.find_edge(node)

    def fly(self, node: int) -> None:
        """Turn to a panorama and fly there; straight up or down, and from near its place, the heading stays."""
        right, down, forward = away = self.places[node] - self.camera[:3]
        length, (seconds, longest) = float(np.linalg.norm(away)), FLIGHT_SECONDS
        if self.node is None and length < _NEAR:
            seconds = TURN_SECONDS
        else:
            is_level = math.hypot(right, forward) > abs(down) / 10
            self.turn((math.atan2(right, forward) if is_level else self.camera[3], 0.0))
            seconds = min(max(seconds + METRE_SECONDS * (length - SHORT_FLIGHT), seconds), longest)
        self.add("flight", (*self.places[node], *self.camera[3:]), seconds, node)

    def find_way(self, start: int, end: int) -> tuple[float, float] | None:
        """Yaw and pitch from a panorama to another one: of its place, or of the link to it; None if unknown."""
        link, away = self.tour.find_direction(start, end), self.places[end] - self.places[start]
        if link is not None and self.tour.is_zoom(start, end):
            yaw, pitch = find_angles(link)
            return yaw, max(pitch, LOWEST_PITCH)
        return (math.atan2(away[0], away[2]), 0.0) if self.tour.worlds[start] == self.tour.worlds[end] else None

    def find_arrival(self, start: int, end: int) -> tuple[float, float]:
        """Yaw and pitch at the end of a zoom: away from the link back, else the start view, else that of the way."""
        if (back := self.tour.find_direction(end, start)) is not None:
            right, _, forward = -back
            return self.avoid_wall(end, math.atan2(right, forward), 0.0)
        if (view := find_start_angles(self.tour, end)) is not None:
            return view
        if self.tour.worlds[start] != self.tour.worlds[end] and end in self.outlooks:
            return find_widest(self.outlooks[end]), 0.0
        return self.avoid_wall(end, *self.camera[3:])

    def avoid_wall(self, node: int, yaw: float, pitch: float) -> tuple[float, float]:
        """The yaw and pitch of an arrival, turned away from a wall that is close."""
        turn = find_turns(self.outlooks[node])[find_bins(np.array(yaw))] if node in self.outlooks else 0.0
        return float(yaw + turn), float(pitch)


def find_start_angles(tour: TourGraph, node: int) -> tuple[float, float] | None:
    """Yaw and pitch, in level axes, of the view that a visitor of a panorama sees first; None if none is stated."""
    start = tour.panoramas[node].start
    return None if start is None else find_angles(tour.look(node, *start))


def find_angles(direction: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Yaw and pitch of a unit direction (right, down, forward)."""
    return math.atan2(direction[0], direction[2]), math.asin(min(max(-float(direction[1]), -1.0), 1.0))


def find_offset(pose: Float[np.ndarray, "4 4"], position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """From a panorama to a camera beside it, in its axes, as a fraction of the usual distance of surfaces."""
    offset = pose[:3, :3].T @ (position - pose[:3, 3]) / SURFACES
    return offset * min(MOST_BESIDE / max(float(np.linalg.norm(offset)), 1e-9), 1.0)


def ease(fraction: float) -> float:
    """From 0 to 1 without a speed at either end."""
    t = min(max(fraction, 0.0), 1.0)
    return t * t * (3 - 2 * t)
