"""Graphs of panoramas: nodes, edges and parts, and the tours of folders."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.scene import Scene
from pansplat.geometry.level import find_direction, level_pose, up_direction
from pansplat.inputs.panorama_sets import FAR, NEAR, Link, Panorama, PanoramaSet
from pansplat.inputs.placements import ApproximatePlace
from pansplat.system.components import label_components
from pansplat.system.descriptions import describe_count, describe_range, list_first
from pansplat.tours.layout import lay_out

Edge = tuple[int, int]
"""Indices of two panoramas, the smaller one first; a panorama without another one has a self-edge, twice its index."""

ViewNumbers = tuple[int, ...]
"""The panoramas of a scene, by their number in the tour."""

_MIN_PANORAMAS = 3  # least number of panoramas of a tour of one part


@dataclass(frozen=True, eq=False)
class TourGraph:
    """Panoramas of one place and the edges between them.

    Panoramas that edges connect are a part. A camera flies along edges, and zooms along poor edges and between parts.
    Parts without a common world are side by side (`lay_out`).

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
        poor: edges along which the camera zooms, because the surfaces of their panoramas disagree (`find_poor_edges`).
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
        """The world of each node: parts with walls between them have known relative places.

        Without edges (a scene that is no tour): the worlds of the files.
        """
        if not self.overlaps:
            return tuple(panorama.world for panorama in self.panoramas)
        return tuple(label_components(len(self), [*self.overlaps, *self.walls]))

    def is_placed(self, node: int) -> bool:
        """Whether the place of a node relative to another one is known."""
        return len(self.overlaps) > 0 and self.worlds.count(self.worlds[node]) > 1

    @cached_property
    def approximate(self) -> dict[int, tuple[int, ApproximatePlace]]:
        """For each node that is not placed: the node beside which the files put it, and where."""
        number = {view.image: node for node, view in enumerate(self.panoramas) if view.placement.about is None}
        stated = ((node, view.placement.about) for node, view in enumerate(self.panoramas) if not self.is_placed(node))
        return {node: (number[about.beside], about) for node, about in stated if about and about.beside in number}

    def with_walls(self, walls: Iterable[Edge]) -> TourGraph:
        """The graph with further walls in place of edges; a node without another edge gets a self-edge."""
        every = tuple(dict.fromkeys((*self.walls, *walls)))
        overlaps = {edge: overlap for edge, overlap in self.overlaps.items() if edge not in every}
        return dataclasses.replace(self, overlaps=add_self_edges(overlaps, range(len(self))), walls=every)

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
        """The unit direction, in level axes, of the link from a node to another one; None if there is none."""
        link = self.links.get((start, end))
        return None if link is None else self.look(start, link.yaw, link.pitch)

    def look(self, node: int, yaw: float, pitch: float) -> Float[np.ndarray, "3"]:
        """The unit direction, in level axes, of a yaw and pitch (as of a link) in a panorama."""
        return self.level_axes.T @ find_direction(self.cam2world[node], yaw, pitch).numpy()

    def neighbours(self, node: int) -> list[int]:
        """The other nodes that share an edge with a node."""
        return sorted({sum(edge) - node for edge in self.overlaps if node in edge} - {node})

    def find_edge(self, node: int) -> Edge:
        """The edge of a node with the largest overlap."""
        return max((edge for edge in self.overlaps if node in edge), key=self.overlaps.__getitem__)

    def find_nearest(self, position: Float[np.ndarray, "3"], nodes: Sequence[int] | None = None) -> int:
        """The node of some nodes, by default of all, that is nearest to a position, metres."""
        nodes = range(len(self)) if nodes is None else nodes
        return nodes[int(np.linalg.norm(self.positions[list(nodes)] - position, axis=1).argmin())]

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
        if len(context) == 1:  # walls may be nearer than what the cameras of pairs see
            near, far = min(near, NEAR), max(far, FAR)
        return PanoramaSet(name, self.folder, context, (), near, far, self.siblings)

    def place(self, scene: Scene, views: ViewNumbers) -> Scene:
        """The scene of `make_set` in the world of the tour."""
        if not self.originals or self.panoramas[views[0]] is self.originals[views[0]]:
            return scene
        first = self.panoramas[views[0]]
        return scene.moved(first.cam2world @ self.originals[views[0]].cam2world.inverse(), first.frame)

    def find_nearest_edge(self, position: Float[np.ndarray, "3"], part: int | None = None) -> tuple[Edge, float]:
        """The edge nearest to a position, of all or of one part, and the distance in metres."""
        edges = [edge for edge in self.overlaps if part is None or self.parts[edge[0]] == part]
        distances = self.measure_distances(edges, position)
        return edges[int(distances.argmin())], float(distances.min())

    def measure_distances(self, edges: Sequence[Edge], position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "edge"]:
        """Distances of a position from the lines between the cameras of some edges, metres."""
        a, b = self.positions[np.array(edges).T]
        along = b - a
        fractions = ((position - a) * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-12)
        return np.linalg.norm(position - (a + np.clip(fractions, 0, 1)[:, None] * along), axis=1)

    def is_zoom(self, start: int, end: int) -> bool:
        """Whether a step of a walk is a zoom: its nodes are of different parts, or its edge is poor."""
        return self.parts[start] != self.parts[end] or (min(start, end), max(start, end)) in self.poor


def add_self_edges(overlaps: dict[Edge, float], nodes: Iterable[int]) -> dict[Edge, float]:
    """The overlaps, with a self-edge for each of these nodes that has no edge."""
    joined = {*itertools.chain(*overlaps)}
    return overlaps | {(node, node): 1.0 for node in nodes if node not in joined}


def find_tours(sets: Sequence[PanoramaSet]) -> list[TourGraph]:
    """Tours of the pairs of folders; their edges are the pairs, with overlaps that are not measured (1).

    Three or more panoramas that pairs connect are a tour. But if a panorama of a folder is in no pair with another one,
    or the folder has several worlds, all its panoramas are one tour; a panorama without another one has a self-edge.
    """
    of_folder: dict[Path, list[PanoramaSet]] = {}
    for each in sets:
        of_folder.setdefault(each.folder, []).append(each)
    joint = {folder for folder, group in of_folder.items() if _is_one_tour(group)}
    others = [each for each in sets if each.folder not in joint]
    number: dict[Path, int] = {}
    edges: list[Edge] = []
    for each in others:
        edges += itertools.pairwise([number.setdefault(view.image, len(number)) for view in each.context])
    labels = label_components(len(number), edges)
    groups: dict[int, list[PanoramaSet]] = {}
    for each in others:
        groups.setdefault(labels[number[each.context[0].image]], []).append(each)
    tours = [_make_tour(group) for label, group in groups.items() if labels.count(label) >= _MIN_PANORAMAS]
    tours += [_make_tour(of_folder[folder]) for folder in of_folder if folder in joint]
    if len(tours) > 1:
        tours = [dataclasses.replace(tour, name=f"{tour.name} {i}") for i, tour in enumerate(tours, start=1)]
    return tours


def _is_one_tour(sets: Sequence[PanoramaSet]) -> bool:
    """Whether the panoramas of a folder are one tour of several parts."""
    views = [view for each in sets for view in each.context]
    is_alone = any(len(each.context) == 1 for each in sets)
    return len({view.world for view in views}) > 1 or (is_alone and len({view.image for view in views}) > 1)


def _make_tour(sets: Sequence[PanoramaSet]) -> TourGraph:
    """The tour of all panoramas of some pairs."""
    first = sets[0]
    found = {panorama.image: panorama for each in sets for panorama in each.context}
    every = max((each.siblings for each in sets), key=len)  # those of a single view include panoramas of other parts
    rank = {image: index for index, image in enumerate(every)}
    images = sorted(found, key=lambda image: rank.get(image, len(rank)))
    number = {image: index for index, image in enumerate(images)}
    edges = {
        tuple(sorted((number[a.image], number[b.image])))
        for each in sets
        for a, b in itertools.combinations(each.context, 2)
    }
    overlaps = add_self_edges(dict.fromkeys(sorted(edges), 1.0), range(len(images)))
    measured = [each for each in sets if len(each.context) > 1] or sets  # the range of a single view is a default
    near, far = min(each.near for each in measured), max(each.far for each in measured)
    originals = tuple(found[image] for image in images)
    name = f"{first.folder.resolve().name} tour"
    return TourGraph(name, first.folder, lay_out(originals), near, far, first.siblings, overlaps, originals)
