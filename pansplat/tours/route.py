"""Smooth flights through the panoramas of a tour."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float, Int

from pansplat.geometry.path import turn_axes
from pansplat.tours.graph import Edge, TourGraph
from pansplat.tours.links import find_way_along_link
from pansplat.tours.outlook import choose_arrival

FADE_SECONDS = 1.0
NEAR_OF_FAR = 0.03  # of a tour: Gaussians within this fraction of far are not drawn, because ways pass door frames
STOP_REACH = 0.03  # metres from a panorama, within which its photograph is shown
STOP_SECONDS = 0.2  # of the fade between scene and photograph
_FLY_SPEED = 1.0  # metres per second
_TURN_DEGREES = 45.0  # per second
_LOOK_AHEAD = 1.5  # metres along the way, the point that the camera looks at
_TURN_BACK_DEGREES = 120.0  # of the way at a panorama, at which the camera turns in place
_TURN_IN_PLACE_DEGREES = 60.0  # between the heading and the way, at which the camera stands still
_SMOOTHING_SECONDS = 1.2
_SAMPLES_PER_SECOND = 60
_LOOK_AROUND_DEGREES = 90.0  # that the camera turns in a part without a way


@dataclass(frozen=True, eq=False)
class Route:
    """A smooth flight through panoramas, in samples of equal duration.

    Leg i is the step from `walk[i]` to `walk[i + 1]`. That of a fade begins with the jump to the other part, after
    which the camera stands for a moment while the image fades.

    Attributes:
        positions: camera centres, metres.
        yaws, pitches: radians, relative to `level`; positive turns right and up.
        legs: leg of each sample; -1 before the first panorama.
        walk: the panoramas in the order of the flight.
        edges: of each leg, whose scene is shown; of a fade, that of the part where it ends.
        fades: the legs that are fades.
        level: axes of a level camera (columns right, down, forward).
        seconds: duration.
    """

    positions: Float[np.ndarray, "sample 3"]
    yaws: Float[np.ndarray, "sample"]
    pitches: Float[np.ndarray, "sample"]
    legs: Int[np.ndarray, "sample"]
    walk: tuple[int, ...]
    edges: tuple[Edge, ...]
    fades: tuple[int, ...]
    level: Float[np.ndarray, "3 3"]
    seconds: float

    @cached_property
    def jumps(self) -> Int[np.ndarray, "jump"]:
        """The samples after which the camera jumps to another part."""
        begins = (self.legs[1:] != self.legs[:-1]) & np.isin(self.legs[1:], self.fades)
        return np.flatnonzero(begins)

    def leg(self, fraction: float) -> int:
        """Index of the edge that is flown at a fraction of the duration; -1 before the first panorama."""
        return int(self.legs[round(min(max(fraction, 0.0), 1.0) * (len(self.legs) - 1))])

    def pose(self, fraction: float) -> Float[np.ndarray, "4 4"]:
        """The pose (cam2world) at a fraction of the duration, 0 to 1."""
        at = min(max(fraction, 0.0), 1.0) * (len(self.yaws) - 1)
        if math.floor(at) in self.jumps:
            at = round(at)
        steps = np.arange(len(self.yaws))
        yaw, pitch = (np.interp(at, steps, values) for values in (self.yaws, self.pitches))
        pose = np.eye(4)
        pose[:3, :3] = turn_axes(self.level, float(yaw), float(pitch))
        pose[:3, 3] = [np.interp(at, steps, column) for column in self.positions.T]
        return pose

    def edge(self, fraction: float) -> Edge | None:
        """The edge that is flown at a fraction of the duration; None before the first panorama."""
        leg = self.leg(fraction)
        return self.edges[leg] if leg >= 0 else None

    def edges_after(self, fraction: float) -> list[Edge]:
        """The edges from a fraction of the duration on."""
        return list(self.edges[max(self.leg(fraction), 0) :])


def plan_route(
    tour: TourGraph,
    walk: Sequence[int],
    start: Float[np.ndarray, "4 4"] | None = None,
    outlook: Float[np.ndarray, "bin"] | None = None,
) -> Route:
    """A flight along a walk. The camera looks ahead along its way, and flies slower while it turns.

    Where the way turns back, the camera turns in place. All is smoothed over time, so that corners are rounded.

    Before a fade along a link the camera turns in the direction of the link, and goes 0.7 m. Before another one, at a
    panorama alone, it turns by 90 degrees; so it does at the end, unless a start pose is given. After a fade, it looks
    in the direction of the panorama's start view; without one, away from the link back; else its heading stays.

    Args:
        tour: the graph.
        walk: nodes; consecutive ones share an edge, or are of different parts.
        start: pose from which the first node is approached; None starts at that node, in the direction of its start
            view, or of the second node.
        outlook: of the last node (`measure_outlook`), at which the flight ends as `choose_arrival` states; None leaves
            it as it is.
    """
    steps = list(itertools.pairwise(walk))
    fades = [leg for leg, step in enumerate(steps) if tour.is_fade(*step)]
    edges = [(min(step), max(step)) for step in steps]
    for leg in fades:
        is_flown = leg + 1 < len(steps) and leg + 1 not in fades
        edges[leg] = edges[leg + 1] if is_flown else tour.find_edge(walk[leg + 1])
    level, yaw, pitch = tour.level_axes, None, 0.0
    if start is not None:
        yaw, pitch = find_angles(level.T @ start[:3, 2])
    elif (view := tour.find_start_view(walk[0])) is not None:
        yaw, pitch = find_angles(level.T @ view)
    sections = []
    for first, last in itertools.pairwise([-1, *fades, len(steps)]):
        nodes = walk[first + 1 : last + 1]
        places, legs = [tour.positions[node] for node in nodes], list(range(first + 1, last))
        link = find_way_along_link(tour, *steps[last]) if last < len(steps) else None
        if link is not None:
            places.append(places[-1] + link)
            legs.append(legs[-1] if legs else first)
        if first < 0 and start is not None:
            if last == 0 < len(steps):  # a fade begins where the camera is, or near the link
                places = places[1:]
            else:
                legs = [-1, *legs]
            places = [start[:3, 3], *places]
        if first >= 0:
            yaw, pitch = _find_arrival(tour, *steps[first]) or (yaw, 0.0)
        is_seen = start is None or 0 <= first < last < len(steps)  # of a user's flight, not the ends
        around = math.radians(_LOOK_AROUND_DEGREES) if is_seen and len(places) == 1 and steps else 0.0
        arrival = None
        if outlook is not None and last == len(steps):
            view = tour.find_start_view(walk[-1])
            arrival = partial(choose_arrival, outlook, start=None if view is None else find_angles(level.T @ view))
        sections.append(_fly(np.array(places) @ level, legs, first, yaw, pitch, around, arrival))
        yaw = float(sections[-1][3][-1])
    *positions, yaws, pitches, numbers = (np.concatenate(values) for values in zip(*sections, strict=True))
    return Route(
        np.stack(positions, axis=1) @ level.T,
        yaws,
        pitches,
        numbers,
        tuple(walk),
        tuple(edges),
        tuple(fades),
        level,
        (len(yaws) - 1) / _SAMPLES_PER_SECOND,
    )


def find_angles(direction: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Yaw and pitch of a unit direction (right, down, forward)."""
    return math.atan2(direction[0], direction[2]), math.asin(min(max(-float(direction[1]), -1.0), 1.0))


def _find_arrival(tour: TourGraph, start: int, end: int) -> tuple[float, float] | None:
    """Yaw and pitch of a camera after a fade; None to keep the heading."""
    back, view = find_way_along_link(tour, end, start), tour.find_start_view(end)
    if view is not None:
        return find_angles(tour.level_axes.T @ view)
    return None if back is None else find_angles(-tour.level_axes.T @ back / np.linalg.norm(back))


def _fly(
    path: Float[np.ndarray, "place 3"],
    legs: Sequence[int],
    before: int,
    yaw: float | None,
    pitch: float,
    around: float = 0.0,
    arrival: Callable[[float], tuple[float, float]] | None = None,
) -> tuple[np.ndarray, ...]:
    """The flight through places of one part: right, down, forward, yaw, pitch and leg of each sample.

    Args:
        path: places (right, down, forward).
        legs: of the steps between them.
        before: the leg that leads to this part, during which the camera stands.
        yaw: at the start, radians; None looks along the path.
        pitch: at the start, radians.
        around: turn to the right at the end, radians.
        arrival: yaw and pitch of the end, of the yaw with which the camera arrives.
    """
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    kept = lengths > 1e-6
    lengths, numbers = lengths[kept], np.array(legs, dtype=int)[kept]
    path = path[np.concatenate(([True], kept))]
    if not len(lengths):
        numbers = np.array([before])
    ends = np.concatenate(([0.0], np.cumsum(lengths)))
    stops = [*ends[_find_turns_back(path)], ends[-1]]
    place, step = 0.0, 1 / _SAMPLES_PER_SECOND
    places, yaws = [place], [yaw]
    while place < ends[-1]:
        stop = next(end for end in stops if end > place)
        heading = _look_ahead(path, ends, place, stop)
        if yaw is None or heading is None:
            yaw = heading or yaw or 0.0
        error = 0.0 if heading is None else math.remainder(heading - yaw, 2 * math.pi)
        limit = math.radians(_TURN_DEGREES) * step
        yaw += min(max(error, -limit), limit)
        slower = max(1 - abs(error) / math.radians(_TURN_IN_PLACE_DEGREES), 0.0)
        place = min(place + _FLY_SPEED * slower * step, stop)
        if stop - place < 1e-3:
            place = stop
        places.append(place)
        yaws.append(yaw)
    yaws[0] = yaws[1] if len(yaws) > 1 and yaws[0] is None else yaws[0] or 0.0
    end = None if arrival is None else arrival(yaws[-1])
    if end is not None:
        around += math.remainder(end[0] - yaws[-1], 2 * math.pi)
    turns = (math.copysign(1, around) * np.arange(0, abs(around), math.radians(_TURN_DEGREES) * step)).tolist()
    places += [place for _ in turns]
    yaws += [yaws[-1] + turn for turn in turns]
    along = np.array(places)
    pitches = np.zeros(len(yaws))
    pitches[0] = pitch
    if end is not None:  # the camera looks up or down while it turns, or at the end
        pitches[-len(turns) - 1 :] = np.linspace(0, end[1], len(turns) + 2)[1:]
    positions = [np.interp(along, ends, column) for column in path.T]
    numbers = numbers[np.clip(np.searchsorted(ends, along, side="right") - 1, 0, len(numbers) - 1)]
    half = round(_SMOOTHING_SECONDS / 2 * _SAMPLES_PER_SECOND)
    smooth = [_smooth(values, half) for values in (*positions, np.array(yaws), pitches)]
    numbers = np.pad(numbers, half, mode="edge")
    if before >= 0:
        numbers[:half] = before
    return *smooth, numbers


def _find_turns_back(path: Float[np.ndarray, "place 3"]) -> list[int]:
    """The inner places at which a path turns by more than `_TURN_BACK_DEGREES`."""
    steps = np.diff(path, axis=0)
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    cosines = (steps[1:] * steps[:-1]).sum(axis=1)
    return [i for i, cosine in enumerate(cosines, start=1) if cosine < math.cos(math.radians(_TURN_BACK_DEGREES))]


def _look_ahead(
    path: Float[np.ndarray, "place 3"], ends: Float[np.ndarray, "place"], place: float, stop: float
) -> float | None:
    """Yaw towards the point ahead on the path, not beyond `stop`; None if that is straight up or down."""
    ahead = min(place + _LOOK_AHEAD, stop)
    if ahead - place < 0.3:  # near a stop: the direction in which it is approached
        place = max(ahead - 0.3, ends[np.searchsorted(ends, stop) - 1])
    here, there = (np.array([np.interp(at, ends, column) for column in path.T]) for at in (place, ahead))
    along = there - here
    return math.atan2(along[0], along[2]) if math.hypot(along[0], along[2]) > 1e-3 else None


def _smooth(values: Float[np.ndarray, "sample"], half: int) -> Float[np.ndarray, "sample_2"]:
    """The values convolved with a Hann window; the first and the last value are kept, and `half` samples are added."""
    window = np.hanning(2 * half + 3)[1:-1]
    return np.convolve(np.pad(values, 2 * half, mode="edge"), window / window.sum(), mode="valid")
