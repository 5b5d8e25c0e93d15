"""Tours: many posed panoramas of one place as a graph, the scenes of its edges, routes along it, and its floor plan.

An edge joins two panoramas that show the same surfaces. A camera flies along edges; the scene of an edge is predicted
from its two panoramas and a third one that overlaps with both.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse.csgraph import shortest_path
from torch import Tensor

from pansplat.data.images import read_panorama, write_image
from pansplat.data.pairs import Pair, Panorama
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import pad_equirect, row_weights
from pansplat.geometry.path import level_pose, up_direction
from pansplat.geometry.warp import relative_pose, warp_panorama

Edge = tuple[int, int]
"""Indices of two panoramas, the smaller one first."""

Views = tuple[int, ...]
"""The panoramas of a scene, by their number in the tour."""

MIN_PANORAMAS = 3

# The overlap of two panoramas is measured in small images by a sweep over depth.
_HEIGHT = 48
_CANDIDATES = 24
_MIN_OVERLAP = 0.12
_MAX_BASELINE = 0.4  # of an edge that is not given, as a fraction of far
_MAX_NEIGHBOURS = 6  # nearest panoramas that are compared
_MIN_BASELINE = 0.03  # of a scene of two views, as a fraction of far; depth is inaccurate below it
_MAX_STARTS = 10_000  # of a walk, divided by the number of nodes

EDGE_HYSTERESIS = 0.25  # metres that another edge must be nearer than the current one
FLY_SPEED = 1.0  # metres per second
TURN_DEGREES = 45.0  # per second
_LOOK_AHEAD = 1.5  # metres along the way, the point that the camera looks at
_TURN_BACK_DEGREES = 120.0  # of the way at a panorama, at which the camera turns in place
_TURN_IN_PLACE_DEGREES = 60.0  # between the heading and the way, at which the camera stands still
_SMOOTHING_SECONDS = 1.2
_SAMPLES_PER_SECOND = 60

_AZIMUTHS = 180  # of a floor outline
PLAN_SIZE = 1024  # of the longer side of a floor plan as a file, pixels
_PLAN_MARGIN = 0.5  # around the panoramas and outlines of a floor plan, metres


@dataclass(frozen=True, eq=False)
class TourGraph:
    """Posed panoramas of one place and the edges between them.

    Attributes:
        name: for lists and folders.
        folder: of the files.
        panoramas: the nodes, in file order.
        near, far: depth range to search, metres.
        siblings: all panoramas taken with the same camera.
        overlaps: of each edge: 1 if one panorama explains the other at each pixel, 0 for unrelated panoramas.
    """

    name: str
    folder: Path
    panoramas: tuple[Panorama, ...]
    near: float
    far: float
    siblings: tuple[Path, ...] = field(default=(), repr=False)
    overlaps: dict[Edge, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.panoramas)

    @cached_property
    def cam2world(self) -> Float[Tensor, "node 4 4"]:
        """Poses of the panoramas."""
        return torch.stack([panorama.cam2world for panorama in self.panoramas]).double()

    @cached_property
    def positions(self) -> Float[np.ndarray, "node 3"]:
        """Camera centres, metres."""
        return self.cam2world[:, :3, 3].numpy()

    @cached_property
    def level_axes(self) -> Float[np.ndarray, "3 3"]:
        """Right, down and forward (columns, world axes) of a level camera at the first panorama."""
        return level_pose(self.cam2world[0], up_direction(self.cam2world))[:3, :3].numpy()

    def neighbours(self, node: int) -> list[int]:
        """Nodes that share an edge with a node."""
        return sorted({sum(edge) - node for edge in self.overlaps if node in edge})

    def choose_scene_views(self) -> dict[Edge, Views]:
        """The panoramas of the scene of each edge: two, or three that overlap with each other.

        Edges share scenes where they can, so that fewer scenes are predicted and exchanged.
        """
        around = {node: set(self.neighbours(node)) for node in range(len(self))}
        triangles = [(a, b, c) for a, b in self.overlaps for c in sorted(around[a] & around[b]) if c > b]
        triangles.sort(key=lambda nodes: (-self._weakest_overlap(nodes), nodes))
        scenes: dict[Edge, Views] = {}
        for needed in (2, 1):
            for nodes in triangles:
                free = [edge for edge in itertools.combinations(nodes, 2) if edge not in scenes]
                if len(free) >= needed:
                    scenes |= {edge: nodes for edge in free}
        for edge in self.overlaps:
            if edge not in scenes:
                scenes[edge] = self._add_baseline(edge)
        return scenes

    def choose_sources(self) -> dict[Views, tuple[int, ...]]:
        """The scenes that one scene of all panoramas is made of, and the panoramas whose Gaussians each provides.

        They are scenes of `choose_scene_views`, those of the largest overlaps first, until all panoramas are provided.
        """
        scenes = sorted(
            set(self.choose_scene_views().values()), key=lambda nodes: (-self._weakest_overlap(nodes), nodes)
        )
        sources: dict[Views, tuple[int, ...]] = {}
        missing = set(range(len(self)))
        for views in scenes:
            provided = tuple(node for node in views if node in missing)
            if provided:
                sources[views] = provided
                missing -= set(provided)
        return sources

    def _weakest_overlap(self, nodes: Views) -> float:
        """The smallest overlap of the edges between the panoramas of a scene."""
        return min(self.overlaps[edge] for edge in itertools.combinations(nodes, 2) if edge in self.overlaps)

    def _add_baseline(self, edge: Edge) -> Views:
        """The edge's panoramas, with the best neighbour of either if they are too close together for depth."""
        if self.length(edge) >= _MIN_BASELINE * self.far:
            return edge
        others = [
            (self.overlaps[around], node)
            for around in self.overlaps
            for node in around
            if around != edge and set(around) & set(edge) and node not in edge
        ]
        return tuple(sorted((*edge, max(others)[1]))) if others else edge

    def length(self, edge: Edge) -> float:
        """Distance between the cameras of an edge, metres."""
        a, b = self.positions[list(edge)]
        return float(np.linalg.norm(a - b))

    def make_pair(self, views: Sequence[int]) -> Pair:
        """The panoramas of a scene as the input of a prediction."""
        context = tuple(self.panoramas[view] for view in views)
        name = "-".join(panorama.name for panorama in context)
        return Pair(name, self.folder, context, (), self.near, self.far, self.siblings)

    def find_nearest_edge(self, position: Float[np.ndarray, "3"]) -> tuple[Edge, float]:
        """The edge nearest to a position, and the distance in metres."""
        distances = {edge: self.measure_distance(edge, position) for edge in self.overlaps}
        edge = min(distances, key=distances.__getitem__)
        return edge, distances[edge]

    def measure_distance(self, edge: Edge, position: Float[np.ndarray, "3"]) -> float:
        """Distance of a position from the line between an edge's cameras, metres."""
        a, b = self.positions[list(edge)]
        along = b - a
        fraction = float((position - a) @ along / max(float(along @ along), 1e-12))
        return float(np.linalg.norm(position - (a + min(max(fraction, 0.0), 1.0) * along)))

    def find_walk(self, start: int, end: int) -> list[int]:
        """The nodes of the cheapest way along edges, both ends included."""
        _, previous = self._shortest
        walk = [end]
        while walk[-1] != start:
            walk.append(int(previous[start, walk[-1]]))
        return walk[::-1]

    def find_next_nodes(self) -> list[list[int]]:
        """The next node on the cheapest way from a node (row) to another one (column)."""
        _, previous = self._shortest  # the costs are symmetric: the node before the end of the way back
        return [
            [int(previous[end, node]) if end != node else node for end in range(len(self))] for node in range(len(self))
        ]

    def plan_walk(self, start: int | None = None) -> list[int]:
        """Nodes of a short walk along edges that visits all nodes; some of them more than once.

        Nearest neighbours first, improved by exchanging parts of the order (2-opt).

        Args:
            start: its first node; None chooses the start of the shortest walk, of some starts for more than 100 nodes.
        """
        costs, _ = self._shortest
        count = len(self)
        starts = range(0, count, math.ceil(count**2 / _MAX_STARTS)) if start is None else (start,)
        orders = [_improve_order(_order_by_distance(costs, first), costs) for first in starts]
        order = min(orders, key=lambda order: float(costs[order[:-1], order[1:]].sum()))
        walk = [order[0]]
        for node in order[1:]:
            walk += self.find_walk(walk[-1], node)[1:]
        return walk

    @cached_property
    def _shortest(self) -> tuple[Float[np.ndarray, "node node"], Int[np.ndarray, "node node"]]:
        """Cost of the cheapest way between all nodes, and the node before its end.

        Raises:
            InputError: the edges do not connect all nodes.
        """
        costs = np.full((len(self), len(self)), np.inf)
        for (a, b), overlap in self.overlaps.items():
            doubt = max(1 - overlap / 0.25, 0.0)  # with little overlap a way around looks better
            costs[a, b] = costs[b, a] = max(self.length((a, b)), 1e-3) * (1 + 3 * doubt)
        ways, previous = shortest_path(costs, directed=False, return_predecessors=True)
        if not np.isfinite(ways).all():
            raise InputError(f"tour: needed edges that connect all {len(self)} panoramas, got separate parts")
        return ways, previous


def _order_by_distance(costs: Float[np.ndarray, "node node"], start: int) -> Int[np.ndarray, "node"]:
    """All nodes; the one after a node is its nearest one of those that are left."""
    order, left = [start], np.arange(len(costs)) != start
    while left.any():
        order.append(int(np.where(left, costs[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order)


def _improve_order(order: Int[np.ndarray, "node"], costs: Float[np.ndarray, "node node"]) -> Int[np.ndarray, "node"]:
    """Reverse parts of the order, except its start, as long as it gets shorter."""
    order, improved = order.copy(), True
    while improved:
        improved = False
        for first in range(1, len(order)):
            last = first + 1
            while last < len(order):
                # The change of the length if the part from `first` to each of `ends` is reversed.
                before, here, ends = order[first - 1], order[first], order[last:]
                change = costs[before, ends] - costs[before, here]
                change[:-1] += costs[here, ends[1:]] - costs[ends[:-1], ends[1:]]
                shorter = np.flatnonzero(change < -1e-9)
                if not len(shorter):
                    break
                last += int(shorter[0]) + 1
                order[first:last] = order[first:last][::-1].copy()
                improved = True
    return order


# --- the graph of a folder ---


def find_tours(pairs: Sequence[Pair]) -> list[TourGraph]:
    """Tours of three or more panoramas that the pairs connect; their edges are the pairs, without overlaps (0)."""
    components: list[list[Pair]] = []
    for pair in pairs:
        images = {panorama.image for panorama in pair.context}
        joined = [part for part in components if any(images & _list_images(other) for other in part)]
        components = [part for part in components if part not in joined]
        components.append([*itertools.chain.from_iterable(joined), pair])
    tours = []
    for component in components:
        first = component[0]
        found = {panorama.image: panorama for pair in component for panorama in pair.context}
        if len(found) < MIN_PANORAMAS:
            continue
        rank = {image: index for index, image in enumerate(first.siblings)}
        images = sorted(found, key=lambda image: rank.get(image, len(rank)))
        number = {image: index for index, image in enumerate(images)}
        edges = {
            tuple(sorted((number[a.image], number[b.image])))
            for pair in component
            for a, b in itertools.combinations(pair.context, 2)
        }
        near, far = min(pair.near for pair in component), max(pair.far for pair in component)
        name = f"{first.folder.resolve().name} tour"
        panoramas = tuple(found[image] for image in images)
        tours.append(
            TourGraph(name, first.folder, panoramas, near, far, first.siblings, dict.fromkeys(sorted(edges), 0.0))
        )
    if len(tours) > 1:
        tours = [dataclasses.replace(tour, name=f"{tour.name} {i}") for i, tour in enumerate(tours, start=1)]
    return tours


def _list_images(pair: Pair) -> set[Path]:
    return {panorama.image for panorama in pair.context}


def connect(tour: TourGraph, progress: Callable[[str, float], None] | None = None) -> TourGraph:
    """The tour with measured overlaps, and with edges between further panoramas that overlap.

    Each panorama is compared with its nearest neighbours within 0.4 far. Given edges are kept whatever their overlap.

    Raises:
        InputError: an image cannot be read.
    """
    report = progress or (lambda what, done: None)
    features = []
    for index, panorama in enumerate(tour.panoramas):
        report("comparing panoramas", 0.5 * index / len(tour))
        features.append(_compute_features(read_panorama(panorama.image, _HEIGHT)[0]))
    distances = np.linalg.norm(tour.positions[:, None] - tour.positions[None], axis=2)
    compared = set(tour.overlaps)
    for node in range(len(tour)):
        for other in distances[node].argsort(kind="stable")[1 : _MAX_NEIGHBOURS + 1].tolist():
            if other != node and distances[node, other] <= _MAX_BASELINE * tour.far:
                compared.add((min(node, other), max(node, other)))
    overlaps = {}
    for index, (a, b) in enumerate(sorted(compared)):
        report("comparing panoramas", 0.5 + 0.5 * index / len(compared))
        poses = tour.cam2world[[a, b]]
        overlap = _measure_overlap(features[a], features[b], poses, tour.near, tour.far)
        if overlap >= _MIN_OVERLAP or (a, b) in tour.overlaps:
            overlaps[a, b] = max(overlap, 0.0)
    return dataclasses.replace(tour, overlaps=overlaps)


def _compute_features(image: Float[Tensor, "3 height width"]) -> Float[Tensor, "feature height width"]:
    """Colour, and brightness and gradients relative to the local contrast."""
    gray = image.mean(dim=0)
    window = pad_equirect(gray, 3)[None, None]
    mean = torch.nn.functional.avg_pool2d(window, 7, stride=1)[0, 0]
    square = torch.nn.functional.avg_pool2d(window * window, 7, stride=1)[0, 0]
    contrast = 2 * (square - mean * mean).clamp_min(0).sqrt() + 0.06
    padded = pad_equirect(gray, 1)
    right = padded[1:-1, 2:] - padded[1:-1, :-2]
    down = padded[2:, 1:-1] - padded[:-2, 1:-1]
    return torch.cat((1.5 * image, torch.stack((gray - mean, right, down)) / contrast))


def _measure_overlap(
    first: Float[Tensor, "feature height width"],
    second: Float[Tensor, "feature height width"],
    poses: Float[Tensor, "2 4 4"],
    near: float,
    far: float,
) -> float:
    """One minus the error of the best depth at each pixel, relative to the error with a wrong rotation.

    With the other panorama turned by a quarter, the best depth of a pixel is chance.
    """
    errors, chances = 0.0, 0.0
    for reference, other, pair in ((first, second, poses), (second, first, poses.flip(0))):
        motion = relative_pose(pair[0], pair[1])
        errors += _sweep_error(reference, other, motion, near, far)
        for sign in (1, -1):
            turn = torch.eye(4, dtype=torch.float64)
            turn[0, 0] = turn[2, 2] = 0
            turn[0, 2], turn[2, 0] = sign, -sign
            chances += 0.5 * _sweep_error(reference, other, turn @ motion, near, far)
    return 1 - errors / max(chances, 1e-9)


def _sweep_error(
    reference: Float[Tensor, "feature height width"],
    other: Float[Tensor, "feature height width"],
    motion: Float[Tensor, "4 4"],
    near: float,
    far: float,
) -> float:
    """Mean over the sphere of the smallest difference over all depth candidates."""
    height, width = reference.shape[-2:]
    inverse = torch.linspace(1 / far, 1 / near, _CANDIDATES)[None, :, None, None].expand(1, -1, height, width)
    warped = warp_panorama(other[None], inverse, motion.float()[None])[0]
    difference = (warped - reference[:, None]).abs().clamp_max(1.0).mean(dim=0)
    lowest = torch.nn.functional.avg_pool2d(pad_equirect(difference, 2)[:, None], 5, stride=1)[:, 0].amin(dim=0)
    weights = row_weights(height, dtype=lowest.dtype)[:, None].expand(height, width)
    return float((lowest * weights).sum() / weights.sum())


# --- one scene of all panoramas ---


def merge_scenes(tour: TourGraph, load: Callable[[Views], Scene]) -> Scene:
    """One scene of all panoramas. The Gaussians of each panorama are those of one scene (`TourGraph.choose_sources`).

    Args:
        tour: the graph.
        load: returns the scene of some panoramas; called once for each scene that is needed.
    """
    parts: dict[int, Gaussians] = {}
    names: dict[int, str] = {}
    scene = None
    for views, provided in tour.choose_sources().items():
        scene = load(views)
        for node in provided:
            view = views.index(node)
            part = scene.gaussians.select(scene.gaussians.views == view)
            parts[node] = dataclasses.replace(part, views=torch.full_like(part.views, node, dtype=torch.int64))
            names[node] = scene.names[view] if view < len(scene.names) else tour.panoramas[node].name
    assert scene is not None
    return dataclasses.replace(
        scene,
        gaussians=Gaussians.cat([parts[node] for node in range(len(tour))]),
        cam2world=tour.cam2world,
        near=tour.near,
        far=tour.far,
        names=tuple(names[node] for node in range(len(tour))),
        gains=(),
        overlaps=tuple((a, b, overlap) for (a, b), overlap in tour.overlaps.items()),
    )


def select_views(scene: Scene, views: Views) -> Scene:
    """The scene of some panoramas of a scene that `merge_scenes` made."""
    chosen = list(views)
    index = torch.full((len(scene.cam2world),), -1)
    index[chosen] = torch.arange(len(chosen))
    labels = index[scene.gaussians.views.long()]
    gaussians = scene.gaussians.select(labels >= 0)
    return dataclasses.replace(
        scene,
        gaussians=dataclasses.replace(gaussians, views=labels[labels >= 0]),
        cam2world=scene.cam2world[chosen],
        names=tuple(scene.names[view] for view in chosen) if scene.names else (),
        gains=tuple(scene.gains[view] for view in chosen) if scene.gains else (),
        overlaps=(),
    )


def make_graph(scene: Scene) -> TourGraph:
    """The graph of a scene's cameras, with the edges that `merge_scenes` has kept in the scene."""
    names = [scene.names[k] if k < len(scene.names) else f"panorama {k + 1}" for k in range(len(scene.cam2world))]
    panoramas = tuple(
        Panorama(name, Path(name), pose) for name, pose in zip(names, scene.cam2world.double(), strict=True)
    )
    overlaps = {(a, b): overlap for a, b, overlap in scene.overlaps}
    return TourGraph("", Path(), panoramas, scene.near, scene.far, overlaps=overlaps)


# --- routes ---


@dataclass(frozen=True, eq=False)
class Route:
    """A smooth flight through panoramas, in samples of equal duration.

    Attributes:
        positions: camera centres, metres.
        yaws, pitches: radians, relative to `level`; positive turns right and up.
        legs: index of the edge in `edges` at each sample; -1 before the first panorama.
        walk: the panoramas in the order of the flight.
        level: axes of a level camera (columns right, down, forward).
        seconds: duration.
    """

    positions: Float[np.ndarray, "sample 3"]
    yaws: Float[np.ndarray, "sample"]
    pitches: Float[np.ndarray, "sample"]
    legs: Int[np.ndarray, "sample"]
    walk: tuple[int, ...]
    level: Float[np.ndarray, "3 3"]
    seconds: float

    @property
    def edges(self) -> list[Edge]:
        """The edges in the order of the flight."""
        return [(min(a, b), max(a, b)) for a, b in itertools.pairwise(self.walk)]

    def leg(self, fraction: float) -> int:
        """Index of the edge that is flown at a fraction of the duration; -1 before the first panorama."""
        return int(self.legs[round(min(max(fraction, 0.0), 1.0) * (len(self.legs) - 1))])

    def pose(self, fraction: float) -> Float[np.ndarray, "4 4"]:
        """The pose (cam2world) at a fraction of the duration, 0 to 1."""
        at = min(max(fraction, 0.0), 1.0) * (len(self.yaws) - 1)
        steps = np.arange(len(self.yaws))
        yaw, pitch = (np.interp(at, steps, values) for values in (self.yaws, self.pitches))
        cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
        pose = np.eye(4)
        turn = np.array(((cy, 0, sy), (0, 1, 0), (-sy, 0, cy))) @ np.array(((1, 0, 0), (0, cp, -sp), (0, sp, cp)))
        pose[:3, :3] = self.level @ turn
        pose[:3, 3] = [np.interp(at, steps, column) for column in self.positions.T]
        return pose

    def edge(self, fraction: float) -> Edge | None:
        """The edge that is flown at a fraction of the duration; None before the first panorama."""
        leg = self.leg(fraction)
        return self.edges[leg] if leg >= 0 else None

    def edges_after(self, fraction: float) -> list[Edge]:
        """The edges from a fraction of the duration on."""
        return self.edges[max(self.leg(fraction), 0) :]


def plan_route(
    tour: TourGraph,
    walk: Sequence[int],
    start: Float[np.ndarray, "4 4"] | None = None,
    *,
    speed: float = FLY_SPEED,
) -> Route:
    """A flight along a walk. The camera looks ahead along its way, and flies slower while it turns.

    Where the way turns back, the camera turns in place. All is smoothed over time, so that corners are rounded.

    Args:
        tour: the graph.
        walk: nodes; consecutive ones share an edge.
        start: pose from which the first node is approached; None starts at that node, in the direction of the second.
        speed: metres per second.
    """
    level, places = tour.level_axes, [tour.positions[node] for node in walk]
    legs = list(range(len(walk) - 1))
    if start is not None:
        places, legs = [start[:3, 3], *places], [-1, *legs]
    path = np.array(places) @ level  # right, down, forward
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    kept = lengths > 1e-6
    lengths, legs = lengths[kept], np.array(legs, dtype=int)[kept]
    path = path[np.concatenate(([True], kept))]
    if not len(lengths):
        legs = np.array([-1])
    ends = np.concatenate(([0.0], np.cumsum(lengths)))
    stops = [*ends[_find_turns_back(path)], ends[-1]]
    yaw, pitch = None, 0.0
    if start is not None:
        forward = level.T @ start[:3, 2]
        yaw, pitch = math.atan2(forward[0], forward[2]), math.asin(min(max(-float(forward[1]), -1.0), 1.0))
    place, step = 0.0, 1 / _SAMPLES_PER_SECOND
    places, yaws = [place], [yaw]
    while place < ends[-1]:
        stop = next(end for end in stops if end > place)
        heading = _look_ahead(path, ends, place, stop)
        if yaw is None or heading is None:
            yaw = heading or yaw or 0.0
        error = 0.0 if heading is None else math.remainder(heading - yaw, 2 * math.pi)
        limit = math.radians(TURN_DEGREES) * step
        yaw += min(max(error, -limit), limit)
        slower = max(1 - abs(error) / math.radians(_TURN_IN_PLACE_DEGREES), 0.0)
        place = min(place + speed * slower * step, stop)
        if stop - place < 1e-3:
            place = stop
        places.append(place)
        yaws.append(yaw)
    yaws[0] = yaws[1] if len(yaws) > 1 and yaws[0] is None else yaws[0] or 0.0
    along = np.array(places)
    pitches = np.zeros(len(yaws))
    pitches[0] = pitch
    positions = [np.interp(along, ends, column) for column in path.T]
    numbers = legs[np.clip(np.searchsorted(ends, along, side="right") - 1, 0, len(legs) - 1)]
    half = round(_SMOOTHING_SECONDS / 2 * _SAMPLES_PER_SECOND)
    smooth = [_smooth(values, half) for values in (*positions, np.array(yaws), pitches)]
    return Route(
        np.stack(smooth[:3], axis=1) @ level.T,
        smooth[3],
        smooth[4],
        np.pad(numbers, half, mode="edge"),
        tuple(walk),
        level,
        (len(smooth[3]) - 1) / _SAMPLES_PER_SECOND,
    )


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


# --- the floor plan ---


@dataclass(frozen=True, eq=False)
class FloorOutline:
    """Where the floor that one panorama shows ends, seen from above.

    Attributes:
        center: of the camera, in the plan's coordinates: metres to the right and forward of the tour's level axes.
        corners: end of the floor at equal steps of azimuth.
        camera_height: of the camera over the floor, metres.
    """

    center: Float[np.ndarray, "2"]
    corners: Float[np.ndarray, "azimuth 2"]
    camera_height: float


def find_floor_outline(scene: Scene, view: int, level: Float[np.ndarray, "3 3"]) -> FloorOutline | None:
    """The floor outline of a view from its Gaussians; None if they show no floor.

    The floor is the most frequent height in the directions steeply below the camera. At each azimuth it ends at the
    distance within which 98 % of its Gaussians are, or at the surfaces that stand on it, if these are nearer.

    Args:
        scene: the scene.
        view: index of the view.
        level: right, down and forward (columns) of a level camera.
    """
    gaussians = scene.gaussians
    # Coarse levels have Gaussians behind the surfaces.
    shown = (gaussians.views == view) & (gaussians.opacities > 0.1) & (gaussians.levels <= 1)
    position = scene.cam2world[view, :3, 3].double().numpy()
    right, down, forward = (gaussians.means[shown].double().numpy() - position).dot(level).T
    flat = np.hypot(right, forward)
    steep = (down > 0.6 * flat) & (down > 0)
    if steep.sum() < 20:
        return None
    logs = np.log(down[steep])
    counts, borders = np.histogram(logs, bins=max(int((logs.max() - logs.min()) / 0.04), 1))
    peak = borders[counts.argmax() : counts.argmax() + 2].mean()
    height = float(np.exp(np.median(logs[np.abs(logs - peak) < 0.08])))
    sector = ((np.arctan2(right, forward) / (2 * math.pi) % 1.0) * _AZIMUTHS).astype(int) % _AZIMUTHS
    floor = _measure_reach(flat, sector, np.abs(down - height) < 0.08 * height, 0.98)
    standing = _measure_reach(flat, sector, (down > 0.15 * height) & (down < 0.8 * height), 0.5)
    reach = np.fmin(floor, standing)
    known = np.flatnonzero(np.isfinite(floor))
    if len(known) < _AZIMUTHS // 4:
        return None
    reach = np.interp(np.arange(_AZIMUTHS), known, reach[known], period=_AZIMUTHS)
    neighbours = np.stack([np.roll(reach, shift) for shift in range(-2, 3)])
    reach = np.median(neighbours, axis=0)  # without single outliers
    angles = (np.arange(_AZIMUTHS) + 0.5) * 2 * math.pi / _AZIMUTHS
    center = level[:, (0, 2)].T @ position
    corners = center + reach[:, None] * np.stack((np.sin(angles), np.cos(angles)), axis=1)
    return FloorOutline(center, corners, height)


def _measure_reach(
    distances: Float[np.ndarray, "n"],
    sector: Int[np.ndarray, "n"],
    selected: Bool[np.ndarray, "n"],
    quantile: float,
) -> Float[np.ndarray, "azimuth"]:
    """A quantile of the selected distances at each azimuth; NaN where there are fewer than three."""
    reach = np.full(_AZIMUTHS, np.nan)
    order = np.argsort(sector[selected], kind="stable")
    ordered, borders = distances[selected][order], np.searchsorted(sector[selected][order], np.arange(_AZIMUTHS + 1))
    for azimuth, (first, last) in enumerate(itertools.pairwise(borders.tolist())):
        if last - first >= 3:
            reach[azimuth] = np.quantile(ordered[first:last], quantile)
    return reach


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """An image of the floor from above, and its place.

    Attributes:
        image: RGBA; transparent where no floor is known.
        origin: plan coordinates of the upper left corner, metres.
        pixels_per_metre: scale.
    """

    image: UInt8[np.ndarray, "height width 4"]
    origin: Float[np.ndarray, "2"]
    pixels_per_metre: float

    def to_pixels(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixel coordinates (right, down) of plan coordinates (right, forward)."""
        return (places - self.origin) * (self.pixels_per_metre, -self.pixels_per_metre)


def draw_floor_plan(tour: TourGraph, outlines: Sequence[FloorOutline], *, size: int = 256) -> FloorPlan:
    """The floors that the outlines enclose, with walls where they end.

    Args:
        tour: all its panoramas fit into the image.
        outlines: of any of the panoramas.
        size: longer side of the image, pixels.
    """
    places = np.concatenate([tour.positions @ tour.level_axes[:, (0, 2)], *(outline.corners for outline in outlines)])
    low, high = places.min(axis=0) - _PLAN_MARGIN, places.max(axis=0) + _PLAN_MARGIN
    scale = size / float((high - low).max())
    width, height = np.maximum(np.ceil((high - low) * scale).astype(int), 1)
    plan = FloorPlan(np.zeros((height, width, 4), np.uint8), np.array((low[0], high[1])), scale)
    floor = np.zeros((height, width), np.uint8)
    for outline in outlines:
        cv2.fillPoly(floor, [plan.to_pixels(outline.corners).round().astype(np.int32)], 255)
    # A wall is the border of all floors together, so that an outline that ends in another view's floor draws no wall.
    wall = cv2.morphologyEx(floor, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    plan.image[floor > 0] = (96, 104, 116, 255)
    plan.image[wall > 0] = (228, 230, 235, 255)
    return plan


def find_floor_outlines(tour: TourGraph, scene: Scene, views: Views) -> dict[int, FloorOutline]:
    """The floor outlines of a scene's views that show a floor, by panorama."""
    outlines = {node: find_floor_outline(scene, view, tour.level_axes) for view, node in enumerate(views)}
    return {node: outline for node, outline in outlines.items() if outline is not None}


def write_floor_plan(scene: Scene, path: str | Path) -> None:
    """Write the floor plan of a scene as an image, with the edges of its tour.

    Args:
        scene: with input cameras.
        path: the file, such as a .png.

    Raises:
        InputError: no view shows a floor, or the file cannot be written.
    """
    tour = make_graph(scene)
    outlines = find_floor_outlines(tour, scene, tuple(range(len(tour)))) if len(tour) else {}
    if not outlines:
        raise InputError(
            f"cannot write {path}: needed a floor below at least one of the {len(tour)} input cameras, got none; "
            "export a folder of upright panoramas"
        )
    write_image(path, paint_floor_plan(tour, list(outlines.values())).astype(np.float32) / 255)


def paint_floor_plan(
    tour: TourGraph, outlines: Sequence[FloorOutline], *, route: Route | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    """The floor plan over dark grey with the names of the panoramas, the edges between them, and a route.

    Args:
        tour, outlines: see `draw_floor_plan`.
        route: drawn instead of the edges.
    """
    plan = draw_floor_plan(tour, outlines, size=PLAN_SIZE)
    alpha = plan.image[..., 3:] / 255.0
    image = np.ascontiguousarray((plan.image[..., :3] * alpha + 24 * (1 - alpha)).astype(np.uint8))
    axes = tour.level_axes[:, (0, 2)]
    centers = plan.to_pixels(tour.positions @ axes).round().astype(np.int32)
    if route is not None:
        line = plan.to_pixels(route.positions @ axes).round().astype(np.int32)
        cv2.polylines(image, [line], False, (255, 204, 51), 2, cv2.LINE_AA)
    else:
        for edge in tour.overlaps:
            cv2.polylines(image, [centers[list(edge)]], False, (170, 180, 190), 1, cv2.LINE_AA)
    for panorama, (x, y) in zip(tour.panoramas, centers.tolist(), strict=True):
        cv2.circle(image, (x, y), 6, (90, 204, 255), -1, cv2.LINE_AA)
        cv2.putText(image, panorama.name, (x + 9, y + 5), 0, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return image
