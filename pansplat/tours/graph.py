"""Graphs of panoramas: their edges and walks, the scenes of the edges, and one scene of all panoramas."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.gaussians.scene import Gains, Gaussians, Overlaps, Scene, Starts
from pansplat.geometry.path import find_direction, level_pose, up_direction, wrap_angle
from pansplat.inputs.panorama_sets import FAR, NEAR, Link, Panorama, PanoramaSet
from pansplat.inputs.placements import PLACED, ApproximatePlace, Placement
from pansplat.system.components import label_components
from pansplat.system.descriptions import describe_count, describe_range, list_first
from pansplat.tours.edges import find_walls
from pansplat.tours.layout import REACH, lay_out
from pansplat.tours.outlook import find_clearance
from pansplat.tours.surfaces import find_surfaces

Edge = tuple[int, int]
"""Indices of two panoramas, the smaller one first; a panorama without another one has a self-edge, twice its index."""

ViewNumbers = tuple[int, ...]
"""The panoramas of a scene, by their number in the tour."""

EDGE_HYSTERESIS = 0.25  # metres that another edge must be nearer than the current one
POOR_REACH = 0.5  # metres that a camera may walk from a panorama along a poor edge, at most a quarter of it
CLEARANCE = 0.25  # metres before a surface, at which a walk ends
MAX_SCENE_VIEWS = 3  # of a scene of an edge
_MAX_PREDICTED = 16  # panoramas that a window predicts at once; bounds its memory and the time until they are shown
_MIN_PANORAMAS = 3  # of a tour of one part
_MIN_BASELINE = 0.03  # of a scene of two views, as a fraction of far; depth is inaccurate below it
_MAX_STARTS = 10_000  # of a walk, divided by the number of nodes
_LINKED_FADE = 0.5  # cost of a fade along a link, as a fraction of far
_UNLINKED_FADE = 2.5  # cost of another fade, as a factor, so that two fades along links cost less


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


@dataclass(frozen=True, eq=False)
class TourGraph:
    """Panoramas of one place and the edges between them.

    Panoramas that edges connect are a part. Within a part the camera flies; from part to part it zooms. Parts
    without a common world are side by side (`lay_out`).

    Attributes:
        name: for lists and folders.
        folder: of the files.
        panoramas: the nodes, in file order.
        near, far: depth range to search, metres.
        siblings: all panoramas taken with the same camera.
        overlaps: of each edge: 1 if one panorama explains the other at each pixel, 0 for unrelated panoramas. That of a
            self-edge is 1.
        originals: the panoramas with poses in their own worlds, which scenes are predicted from; none if these
            are `panoramas`.
        walls: pairs of panoramas of one world between which is a wall or a closed door; they are no edges.
        poor: edges along which the image fades, because the surfaces of their panoramas disagree (`judge_edges`).
        clearances: of panoramas whose surfaces are known (`measure_clearance`, relative to `level_axes`).
    """

    name: str
    folder: Path
    panoramas: tuple[Panorama, ...]
    near: float
    far: float
    siblings: tuple[Path, ...] = ()
    overlaps: dict[Edge, float] = field(default_factory=dict)
    originals: tuple[Panorama, ...] = ()
    walls: tuple[Edge, ...] = ()
    poor: tuple[Edge, ...] = ()
    clearances: dict[int, Float[np.ndarray, "row bin"]] = field(default_factory=dict)

    def __repr__(self) -> str:
        names = list_first([panorama.label for panorama in self.panoramas])
        edges = sum(a != b for a, b in self.overlaps)
        parts = [
            f"{describe_count(len(self), 'panorama')} ({names})",
            f"{describe_count(edges, 'edge')} in {describe_count(len(set(self.parts)), 'part')}",
            f"near and far {describe_range(self.near, self.far, 'm')}",
        ]
        return f"<TourGraph {self.name}: {', '.join(parts)}>"

    def __len__(self) -> int:
        return len(self.panoramas)

    @cached_property
    def cam2world(self) -> Float[Tensor, "node 4 4"]:
        """Poses of the panoramas."""
        return torch.stack([panorama.cam2world for panorama in self.panoramas]).double()

    @cached_property
    def positions(self) -> Float[np.ndarray, "node 3"]:
        """The camera centres of all panoramas, metres."""
        return self.cam2world[:, :3, 3].numpy()

    @cached_property
    def level_axes(self) -> Float[np.ndarray, "3 3"]:
        """Right, down and forward (columns, world axes) of a level camera at the first panorama."""
        return level_pose(self.cam2world[0], up_direction(self.cam2world))[:3, :3].numpy()

    @cached_property
    def parts(self) -> tuple[int, ...]:
        """The part of each node; parts are numbered in the order of their first nodes."""
        return tuple(label_components(len(self), self.overlaps))

    @cached_property
    def worlds(self) -> tuple[int, ...]:
        """The world of each node: parts with walls between them have known relative places. A pair has no edges."""
        if not self.overlaps:
            return tuple(panorama.world for panorama in self.panoramas)
        return tuple(label_components(len(self), [*self.overlaps, *self.walls]))

    def is_placed(self, node: int) -> bool:
        """Whether the place of a node relative to another one is known."""
        return len(self.overlaps) > 0 and self.worlds.count(self.worlds[node]) > 1

    @cached_property
    def approximate(self) -> dict[int, DrawnPlace]:
        """Where the nodes that are not placed probably are, as the files of the tour state it."""
        number, found = {panorama.image: node for node, panorama in enumerate(self.panoramas)}, {}
        for node, panorama in enumerate(self.panoramas):
            about = panorama.placement.about
            beside = None if about is None or self.is_placed(node) else number.get(about.beside)
            if about is not None and beside is not None and self.panoramas[beside].placement.about is None:
                yaw, own = (
                    math.atan2(*(self.level_axes.T @ self.cam2world[n, :3, 2].numpy())[::2]) for n in (beside, node)
                )
                offset = np.array((about.right, about.forward)) * self._find_scale(about, beside)
                centers, turn = self.positions @ self.level_axes[:, (0, 2)], wrap_angle(yaw + about.yaw - own)
                shift = centers[beside] + offset @ turn_plan(yaw) - centers[node] @ turn_plan(turn)
                found[node] = DrawnPlace(beside, turn, shift)
        return found

    def _find_scale(self, about: ApproximatePlace, beside: int) -> float:
        """Metres of the tour's world that are 1 in a place beside a panorama."""
        view = self.panoramas[beside]
        return view.camera_height if about.is_in_heights else 1 / view.frame.unit

    def with_walls(self, walls: Iterable[Edge]) -> TourGraph:
        """The graph with further walls in place of edges; a node without another edge gets a self-edge."""
        every = tuple(dict.fromkeys((*self.walls, *walls)))
        overlaps = {edge: overlap for edge, overlap in self.overlaps.items() if edge not in every}
        joined = {node for edge in overlaps for node in edge}
        overlaps |= {(node, node): 1.0 for edge in every for node in edge if node not in joined}
        return dataclasses.replace(self, overlaps=overlaps, walls=every)

    def list_overlaps(self) -> Overlaps:
        """The edges with their overlaps, as a scene keeps them; walls are edges without overlap."""
        return (*((a, b, overlap) for (a, b), overlap in self.overlaps.items()), *((a, b, 0.0) for a, b in self.walls))

    def with_overlaps(self, overlaps: Overlaps) -> TourGraph:
        """The graph with the edges and walls of `list_overlaps`."""
        graph = dataclasses.replace(self, overlaps={(a, b): overlap for a, b, overlap in overlaps}, walls=())
        return graph.with_walls((a, b) for a, b, overlap in overlaps if a != b and overlap == 0)

    def with_all_edges(self) -> TourGraph:
        """The graph of a scene without edges, in which cameras may fly between any two panoramas."""
        edges = [*itertools.combinations(range(len(self)), 2)] or [(0, 0)]
        return dataclasses.replace(self, overlaps=dict.fromkeys(edges, 1.0))

    def list_parts(self) -> list[ViewNumbers]:
        """The nodes of each part."""
        numbers = np.array(self.parts)
        return [tuple(np.flatnonzero(numbers == part).tolist()) for part in range(max(self.parts) + 1)]

    @cached_property
    def links(self) -> dict[tuple[int, int], Link]:
        """The links by the nodes at which they start and end; of several ones between two nodes, the first."""
        number = {panorama.name: node for node, panorama in enumerate(self.panoramas)}
        found: dict[tuple[int, int], Link] = {}
        for node, panorama in enumerate(self.panoramas):
            for link in panorama.links:
                if number.get(link.target, node) != node:
                    found.setdefault((node, number[link.target]), link)
        return found

    def find_direction(self, start: int, end: int) -> Float[np.ndarray, "3"] | None:
        """The unit direction, in world axes, of the link from a node to another one; None if there is none."""
        link = self.links.get((start, end))
        return None if link is None else find_direction(self.cam2world[start], link.yaw, link.pitch).numpy()

    def find_start_view(self, node: int) -> Float[np.ndarray, "3"] | None:
        """The unit direction, in world axes, of the view that a visitor of a node sees first; None if it has none."""
        start = self.panoramas[node].start
        return None if start is None else find_direction(self.cam2world[node], *start).numpy()

    def neighbours(self, node: int) -> list[int]:
        """The other nodes that share an edge with a node."""
        return sorted({sum(edge) - node for edge in self.overlaps if node in edge} - {node})

    def find_edge(self, node: int) -> Edge:
        """The edge of a node with the largest overlap."""
        return max((edge for edge in self.overlaps if node in edge), key=self.overlaps.__getitem__)

    def choose_scene_views(self) -> dict[Edge, ViewNumbers]:
        """The panoramas of the scene of each edge: two, or three that overlap with each other; one of a self-edge.

        Edges share scenes where they can, so that fewer scenes are predicted and exchanged.
        """
        around = {node: set(self.neighbours(node)) for node in range(len(self))}
        triangles = [(a, b, c) for a, b in self.overlaps for c in sorted(around[a] & around[b]) if c > b]
        triangles.sort(key=lambda nodes: (-self._weakest_overlap(nodes), nodes))
        scenes: dict[Edge, ViewNumbers] = {}
        for needed in (2, 1):
            for nodes in triangles:
                free = [edge for edge in itertools.combinations(nodes, 2) if edge not in scenes]
                if len(free) >= needed:
                    scenes |= {edge: nodes for edge in free}
        for edge in self.overlaps:
            if edge not in scenes:
                scenes[edge] = self._add_baseline(edge)
        return scenes

    def choose_sources(self, max_views: int = MAX_SCENE_VIEWS) -> dict[ViewNumbers, tuple[int, ...]]:
        """The scenes that one scene of all panoramas is made of, and the panoramas whose Gaussians each provides.

        They are the parts, if the predictor takes as many views. Else they are scenes of `choose_scene_views`, those of
        the largest overlaps first, until all panoramas are provided.

        Args:
            max_views: of the predictor.
        """
        parts = self.list_parts()
        if max_views > MAX_SCENE_VIEWS and max(map(len, parts)) <= max_views:
            return {part: part for part in parts}
        scenes = sorted(
            set(self.choose_scene_views().values()), key=lambda nodes: (-self._weakest_overlap(nodes), nodes)
        )
        sources: dict[ViewNumbers, tuple[int, ...]] = {}
        missing = set(range(len(self)))
        for views in scenes:
            provided = tuple(node for node in views if node in missing)
            if provided:
                sources[views] = provided
                missing -= set(provided)
        return sources

    def choose_predictions(self, max_views: int) -> dict[int, ViewNumbers]:
        """The panoramas that each panorama is predicted with, so that scenes of edges are parts of few predictions.

        They are its part. A part of more than 16 panoramas is cut into pieces of its walk; the best neighbour of each
        panorama of a piece is predicted with it. There are none for a predictor of scenes of edges.

        Args:
            max_views: of the predictor.
        """
        if max_views <= MAX_SCENE_VIEWS:
            return {}
        predictions: dict[int, ViewNumbers] = {}
        walk = dict.fromkeys(self.plan_walk())
        for part in range(max(self.parts) + 1):
            nodes = [node for node in walk if self.parts[node] == part]
            for piece in np.array_split(nodes, math.ceil(len(nodes) / min(max_views, _MAX_PREDICTED))):
                members = piece.tolist()
                neighbours = {end for node in members for end in self.find_edge(node)}
                predictions |= dict.fromkeys(members, tuple(sorted({*members, *neighbours})))
        return predictions

    def _weakest_overlap(self, nodes: ViewNumbers) -> float:
        """The smallest overlap of the edges between the panoramas of a scene."""
        edges = itertools.combinations_with_replacement(nodes, 2)
        return min(self.overlaps[edge] for edge in edges if edge in self.overlaps)

    def _add_baseline(self, edge: Edge) -> ViewNumbers:
        """The edge's panoramas, with the best neighbour of either if they are too close together for depth."""
        if edge[0] == edge[1]:
            return edge[:1]
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

    def make_set(self, views: Sequence[int]) -> PanoramaSet:
        """The panoramas of a scene as the input of a prediction, in their own world.

        It does not depend on other worlds, so that cached predictions stay valid when panoramas are added.
        """
        context = tuple((self.originals or self.panoramas)[view] for view in views)
        name = "-".join(panorama.name for panorama in context)
        near, far = self.near, self.far
        if len(context) == 1:  # its walls may be nearer than what the cameras of the pairs see
            near, far = min(near, NEAR), max(far, FAR)
        return PanoramaSet(name, self.folder, context, (), near, far, self.siblings)

    def leave_out(self, node: int) -> PanoramaSet:
        """A pair whose target is a panorama, and whose context is what the tour without it would show at its position.

        That is the scene of the nearest edge of its world.
        """
        overlaps = {edge: overlap for edge, overlap in self.overlaps.items() if node not in edge}
        joined = {*itertools.chain(*overlaps), node}
        overlaps |= {(other, other): 1.0 for other in range(len(self)) if other not in joined}
        others = dataclasses.replace(self, overlaps=overlaps)
        near = [edge for edge in overlaps if self.worlds[edge[0]] == self.worlds[node]]
        edge = min(near, key=lambda edge: others.measure_distance(edge, self.positions[node]))
        pair = self.make_set(others.choose_scene_views()[edge])
        target = (self.originals or self.panoramas)[node]
        return dataclasses.replace(pair, name=target.name, targets=(target,))

    def place(self, scene: Scene, views: ViewNumbers) -> Scene:
        """The scene of `make_set` in the world of the tour."""
        if not self.originals or self.panoramas[views[0]] is self.originals[views[0]]:
            return scene
        first = self.panoramas[views[0]]
        return scene.moved(first.cam2world @ self.originals[views[0]].cam2world.inverse(), first.frame)

    def find_nearest_edge(self, position: Float[np.ndarray, "3"], part: int | None = None) -> tuple[Edge, float]:
        """The edge nearest to a position, of all or of one part, and the distance in metres."""
        edges = np.array([*self.overlaps])
        if part is not None:
            edges = edges[np.array(self.parts)[edges[:, 0]] == part]
        distances = self._measure_distances(edges, position)
        nearest = int(distances.argmin())
        a, b = edges[nearest].tolist()
        return (a, b), float(distances[nearest])

    def follow_edge(self, position: Float[np.ndarray, "3"], current: Edge) -> Edge:
        """The edge of a camera that moves: `current`, unless another edge is nearer by `EDGE_HYSTERESIS`.

        It is an edge of the part of `current`, unless the camera is within reach of another part after a jump.
        """
        nearest, distance = self.find_nearest_edge(position)
        part = self.parts[current[0]]
        if self.parts[nearest[0]] != part and distance > REACH:
            nearest, distance = self.find_nearest_edge(position, part)
        return current if self.measure_distance(current, position) <= distance + EDGE_HYSTERESIS else nearest

    def limit_step(
        self, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], part: int | None = None
    ) -> Float[np.ndarray, "3"]:
        """Where a step of a camera that walks ends: before surfaces, and near a poor edge not between its panoramas.

        Args:
            start, end: of the step.
            part: of the camera, if it is known.
        """
        edge, _ = self.find_nearest_edge(end, part)
        if edge in self.poor:
            end = self._limit_along(edge, start, end, part)
        most = min(self._measure_free(edge, start)[0], 0.0)
        free, away = self._measure_free(edge, end)
        slid = end - max(most - free, 0.0) * away
        is_step = np.linalg.norm(slid - start) <= np.linalg.norm(end - start) + 1e-9
        return slid if is_step and self._measure_free(edge, slid)[0] >= most - 1e-9 else start

    def _measure_free(self, edge: Edge, place: Float[np.ndarray, "3"]) -> tuple[float, Float[np.ndarray, "3"]]:
        """How far a camera near an edge may go on, metres, negative too near a surface; and the direction from the
        panorama that sees it free.

        Beside a panorama, and beside a line along which cameras fly, it is free.
        """
        found = []
        for node in [node for node in edge if node in self.clearances]:
            offset = place - self.positions[node]
            distance = float(np.linalg.norm(offset))
            free = find_clearance(self.clearances[node], self.level_axes.T @ offset) - distance - CLEARANCE
            found.append((max(free, CLEARANCE - distance), offset / max(distance, 1e-9)))
        free, away = max(found, key=lambda item: item[0], default=(math.inf, np.zeros(3)))
        beside = -math.inf if edge in self.poor else CLEARANCE - self.measure_distance(edge, place)
        return max(free, beside), away

    def _limit_along(
        self, edge: Edge, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], part: int | None
    ) -> Float[np.ndarray, "3"]:
        """Where a step near a poor edge ends."""
        first, last = self.positions[list(edge)]
        length = max(float(np.linalg.norm(last - first)), 1e-9)
        along, reach = (last - first) / length, min(POOR_REACH, length / 4)

        def measure_depth(place: Float[np.ndarray, "3"]) -> float:
            walked = float((place - first) @ along)
            return min(walked, length - walked)

        if self.find_nearest_edge(start, part)[0] != edge:
            return end if measure_depth(end) <= reach else start
        excess = max(measure_depth(end) - max(measure_depth(start), reach), 0.0)
        return end - math.copysign(excess, length / 2 - float((end - first) @ along)) * along

    def measure_distance(self, edge: Edge, position: Float[np.ndarray, "3"]) -> float:
        """Distance of a position from the line between an edge's cameras, metres."""
        return float(self._measure_distances(np.array([edge]), position)[0])

    def _measure_distances(
        self, edges: Int[np.ndarray, "edge 2"], position: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "edge"]:
        a, b = self.positions[edges[:, 0]], self.positions[edges[:, 1]]
        along = b - a
        fractions = ((position - a) * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-12)
        return np.linalg.norm(position - (a + np.clip(fractions, 0, 1)[:, None] * along), axis=1)

    def find_walk(self, start: int, end: int) -> list[int]:
        """The nodes of the cheapest way along edges and fades, both ends included.

        It stays in the part of both ends, if they are of one part.
        """
        _, previous = self._shortest
        walk = [end]
        while walk[-1] != start:
            walk.append(int(previous[start, walk[-1]]))
        return walk[::-1]

    def find_way(self, position: Float[np.ndarray, "3"], node: int, part: int | None = None) -> list[int]:
        """The nodes on the way from a position to a node: from that end of the nearest edge which makes it better.

        The better way has fewer fades. Of those with as many, it is the shorter one.

        Args:
            position: of the camera.
            node: the last one.
            part: of the camera, if it is known.
        """
        nearest, _ = self.find_nearest_edge(position, part)

        def measure(walk: list[int]) -> tuple[int, float]:
            fades = [self.is_fade(a, b) for a, b in itertools.pairwise(walk)]
            steps = np.linalg.norm(np.diff([position, *self.positions[walk]], axis=0), axis=1)
            return sum(fades), float(steps[~np.array([False, *fades])].sum())

        ends: Sequence[int] = nearest
        if nearest in self.poor:  # no camera flies to its other end
            ends = [min(nearest, key=lambda end: float(np.linalg.norm(self.positions[end] - position)))]
        return min((self.find_walk(end, node) for end in ends), key=measure)

    def is_fade(self, start: int, end: int) -> bool:
        """Whether a step of a walk is a fade: its nodes are of different parts, or its edge is poor."""
        return self.parts[start] != self.parts[end] or (min(start, end), max(start, end)) in self.poor

    def find_next_nodes(self) -> list[list[int]]:
        """The next node on the cheapest way from a node (row) to another one (column)."""
        _, previous = self._shortest  # the costs are symmetric: the node before the end of the way back
        return [
            [int(previous[end, node]) if end != node else node for end in range(len(self))] for node in range(len(self))
        ]

    def plan_walk(self, start: int | None = None) -> list[int]:
        """Nodes of a short walk along edges and fades that visits all nodes; some of them more than once.

        Nearest neighbours first, improved by exchanging parts of the order (2-opt).

        Args:
            start: its first node. None starts at the first node if that has a start view, or in a tour of parts with
                links: its author has chosen so. Else it chooses the start of the shortest walk, of some starts for more
                than 100 nodes; in a tour of parts one in the largest part.
        """
        costs, _ = self._shortest
        starts = np.arange(len(self)) if start is None else np.array([start])
        has_parts = max(self.parts) > 0
        if start is None and (self.panoramas[0].start is not None or (has_parts and self.links)):
            starts = starts[:1]
        elif start is None and has_parts:
            starts = np.flatnonzero(np.array(self.parts) == np.bincount(self.parts).argmax())
        starts = starts[:: math.ceil(len(starts) * len(self) / _MAX_STARTS)].tolist()
        orders = [_improve_order(_order_by_distance(costs, first), costs) for first in starts]
        order = min(orders, key=lambda order: float(costs[order[:-1], order[1:]].sum()))
        first, *others = order.tolist()
        walk = [first]
        for node in others:
            walk += self.find_walk(walk[-1], node)[1:]
        return walk

    @cached_property
    def _shortest(self) -> tuple[Float[np.ndarray, "node node"], Int[np.ndarray, "node node"]]:
        """Cost of the cheapest way between all nodes, and the node before its end."""
        find_ways = partial(scipy.sparse.csgraph.shortest_path, method="FW", directed=False, return_predecessors=True)
        costs = np.full((len(self), len(self)), np.inf)
        for (a, b), overlap in self.overlaps.items():
            # With little overlap a way around looks better.
            doubt = 1.0 if (a, b) in self.poor else max(1 - overlap / 0.25, 0.0)
            costs[a, b] = costs[b, a] = max(self.length((a, b)), 1e-3) * (1 + 3 * doubt)
        ways, previous = find_ways(costs)
        is_near = np.isfinite(ways)
        if not is_near.all():
            # Two fades cost more than each way within a part, so that a way between nodes of a part stays in it.
            longest = ways[is_near].max()
            fade = 0.5 * longest + _LINKED_FADE * self.far
            costs[~is_near] = _UNLINKED_FADE * fade + longest
            for a, b in (*self.links, *self.walls):
                if self.parts[a] != self.parts[b]:
                    costs[a, b] = costs[b, a] = fade
            ways, previous = find_ways(costs)
        return ways, previous


def turn_plan(yaw: float) -> Float[np.ndarray, "2 2"]:
    """The rotation to the right of rows (right, forward), which is applied from the right."""
    return np.array(((math.cos(yaw), -math.sin(yaw)), (math.sin(yaw), math.cos(yaw))))


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


def find_tours(pairs: Sequence[PanoramaSet]) -> list[TourGraph]:
    """Tours of the pairs of folders; their edges are the pairs, with overlaps that are not measured (1).

    Three or more panoramas that pairs connect are a tour. But if a panorama of a folder is in no pair with another one,
    or the folder has several worlds, all its panoramas are one tour; a panorama without another one has a self-edge.
    """
    of_folder: dict[Path, list[PanoramaSet]] = {}
    for pair in pairs:
        of_folder.setdefault(pair.folder, []).append(pair)
    joint = {folder for folder, group in of_folder.items() if _is_one_tour(group)}
    components: list[list[PanoramaSet]] = []
    for pair in pairs:
        if pair.folder in joint:
            continue
        images = {panorama.image for panorama in pair.context}
        joined = [group for group in components if any(images & _list_images(other) for other in group)]
        components = [group for group in components if group not in joined]
        components.append([*itertools.chain.from_iterable(joined), pair])
    components = [group for group in components if len(set().union(*map(_list_images, group))) >= _MIN_PANORAMAS]
    components += [group for folder, group in of_folder.items() if folder in joint]
    tours = [_make_tour(component) for component in components]
    if len(tours) > 1:
        tours = [dataclasses.replace(tour, name=f"{tour.name} {i}") for i, tour in enumerate(tours, start=1)]
    return tours


def _is_one_tour(pairs: Sequence[PanoramaSet]) -> bool:
    """Whether the panoramas of a folder are one tour of several parts."""
    images = set().union(*map(_list_images, pairs))
    is_alone = any(len(pair.context) == 1 for pair in pairs)
    return len({view.world for pair in pairs for view in pair.context}) > 1 or (is_alone and len(images) > 1)


def _make_tour(pairs: Sequence[PanoramaSet]) -> TourGraph:
    """The tour of all panoramas of some pairs."""
    first = pairs[0]
    found = {panorama.image: panorama for pair in pairs for panorama in pair.context}
    every = max((pair.siblings for pair in pairs), key=len)  # those of a single view include panoramas of other parts
    rank = {image: index for index, image in enumerate(every)}
    images = sorted(found, key=lambda image: rank.get(image, len(rank)))
    number = {image: index for index, image in enumerate(images)}
    edges = {
        tuple(sorted((number[a.image], number[b.image])))
        for pair in pairs
        for a, b in itertools.combinations(pair.context, 2)
    }
    overlaps = dict.fromkeys(sorted(edges), 1.0)
    overlaps |= {(node, node): 1.0 for node in sorted(set(range(len(images))) - {*itertools.chain(*edges)})}
    measured = [pair for pair in pairs if len(pair.context) > 1] or pairs  # the range of a single view is a default
    near, far = min(pair.near for pair in measured), max(pair.far for pair in measured)
    originals = tuple(found[image] for image in images)
    name = f"{first.folder.resolve().name} tour"
    return TourGraph(name, first.folder, lay_out(originals), near, far, first.siblings, overlaps, originals)


def _list_images(pair: PanoramaSet) -> set[Path]:
    return {panorama.image for panorama in pair.context}


def merge_scenes(tour: TourGraph, load: Callable[[ViewNumbers], Scene], max_views: int = MAX_SCENE_VIEWS) -> Scene:
    """One scene of all panoramas. The Gaussians of each panorama are those of one scene (`TourGraph.choose_sources`).

    Args:
        tour: the graph.
        load: returns the scene of some panoramas (`make_set`); called once for each scene that is needed.
        max_views: of the predictor (`TourGraph.choose_sources`).
    """
    parts: dict[int, Gaussians] = {}
    names: dict[int, str] = {}
    gains: dict[ViewNumbers, Gains] = {}
    scene = None
    for views, provided in tour.choose_sources(max_views).items():
        scene = tour.place(load(views), views)
        gains[views] = scene.gains
        for node in provided:
            view = views.index(node)
            part = scene.gaussians.select(scene.gaussians.views == view)
            parts[node] = dataclasses.replace(part, views=torch.full_like(part.views, node, dtype=torch.int64))
            panorama = tour.panoramas[node]
            names[node] = panorama.title or (scene.names[view] if view < len(scene.names) else panorama.name)
    assert scene is not None
    merged = dataclasses.replace(
        scene,
        gaussians=Gaussians.cat([parts[node] for node in range(len(tour))]),
        cam2world=tour.cam2world,
        near=tour.near,
        far=tour.far,
        names=tuple(names[node] for node in range(len(tour))),
        gains=_join_gains(gains, tour.parts),
        links=tuple(
            (a, b, wrap_angle(link.yaw), wrap_angle(link.pitch), link.text) for (a, b), link in tour.links.items()
        ),
        starts=list_starts(tour.panoramas),
        approximate=tuple(
            (node, drawn.beside, scale * about.right, scale * about.forward, wrap_angle(about.yaw))
            for node, drawn in tour.approximate.items()
            if (about := tour.panoramas[node].placement.about) is not None
            and (scale := tour._find_scale(about, drawn.beside) * tour.panoramas[drawn.beside].frame.unit)
        ),
    )
    walls = find_walls(dict(enumerate(find_surfaces(merged, tour.level_axes))), tour.overlaps)
    return dataclasses.replace(merged, overlaps=tour.with_walls(walls).list_overlaps())


def list_starts(panoramas: Sequence[Panorama]) -> Starts:
    """The start views of panoramas, as a scene keeps them; nothing if there is none."""
    starts = tuple(view.start and (wrap_angle(view.start[0]), wrap_angle(view.start[1])) for view in panoramas)
    return starts if any(starts) else ()


def _join_gains(gains: dict[ViewNumbers, Gains], parts: Sequence[int]) -> Gains:
    """Gains of all panoramas from those of scenes, each of which are relative to the mean of the scene's photographs.

    Panoramas that scenes have in common give the ratios of these means, by least squares. Scenes without gains count
    with none; without any gains there are none. Those of a part are relative to the mean of the part.

    Args:
        gains: of each scene's views.
        parts: of the panoramas.
    """
    count = len(parts)
    known = [
        (node, scene, row)
        for scene, (views, rows) in enumerate(gains.items())
        if rows
        for node, row in zip(views, rows, strict=True)
    ]
    if not known:
        return ()
    system = np.zeros((len(known), count + len(gains)))
    for equation, (node, scene, _) in zip(system, known, strict=True):
        equation[node], equation[count + scene] = 1, -1
    logs = np.linalg.lstsq(system, np.log([row for *_, row in known]), rcond=None)[0][:count]
    for part in set(parts):
        members = np.array(parts) == part
        logs[members] -= logs[members].mean(axis=0)
    return tuple(map(tuple, np.exp(logs).tolist()))


def select_views(scene: Scene, views: ViewNumbers) -> Scene:
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
        links=(),
        starts=(),
        approximate=(),
    )


def make_graph(scene: Scene) -> TourGraph:
    """The graph of a scene's cameras, with the edges and links that `merge_scenes` has kept in the scene."""
    count = len(scene.cam2world)
    titles = [scene.names[k] if k < len(scene.names) else f"panorama {k + 1}" for k in range(count)]
    names = [f"{title} ({k + 1})" for k, title in enumerate(titles)]  # no two are equal, whatever the titles are
    links: list[list[Link]] = [[] for _ in range(count)]
    for start, end, yaw, pitch, text in scene.links:
        links[start].append(Link(names[end], yaw, pitch, text))
    starts = scene.starts or (None,) * count
    placements = {
        view: Placement("not placed", about=ApproximatePlace(Path(names[beside]), right, forward, yaw))
        for view, beside, right, forward, yaw in scene.approximate
    }
    panoramas = tuple(
        Panorama(
            names[k],
            Path(names[k]),
            pose,
            title=titles[k],
            links=tuple(links[k]),
            start=starts[k],
            placement=placements.get(k, PLACED),
            frame=scene.frame,
        )
        for k, pose in enumerate(scene.cam2world.double())
    )
    return TourGraph("", Path(), panoramas, scene.near, scene.far).with_overlaps(scene.overlaps)
