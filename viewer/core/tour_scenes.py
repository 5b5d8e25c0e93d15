"""The scenes of a tour in a viewer: which one is shown, which are loaded next, which stay in memory.

Imports no OpenGL: the film and the window use the same objects.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float

from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.tours.floor import FloorOutline, choose_camera_height
from pansplat.tours.graph import Edge, TourGraph, ViewNumbers
from pansplat.tours.limits import EDGE_HYSTERESIS, follow_edge
from pansplat.tours.links import link_parts
from pansplat.tours.merge import select_views
from pansplat.tours.route import Route, plan_route
from pansplat.tours.scene_views import MAX_SCENE_VIEWS, choose_predictions, choose_scene_views
from pansplat.tours.walks import find_walk, find_way, plan_walk
from pansplat_viewer.core.hotspots import PlaceFacts
from pansplat_viewer.core.loader import LoadedScene, SceneEntry

_MEMORY = 2 << 30  # bytes that the scenes of a tour may take; two predictions are kept in any case
_NEXT_SCENES = 3  # number of the next predictions of a way, which are dropped last


@dataclass
class _Prediction:
    """A prediction of some panoramas of a tour.

    Attributes:
        loaded: None before it is predicted, and while it is not in memory.
        is_known: whether it has been predicted.
        has_failed: whether it cannot be predicted or refined.
    """

    loaded: LoadedScene | None = None
    is_known: bool = False
    has_failed: bool = False

    def drop(self) -> LoadedScene:
        """Take the scene out of memory, and return it."""
        assert self.loaded is not None
        loaded, self.loaded = self.loaded, None
        return loaded


class TourScenes:
    """The scenes of one tour: chooses, requests and keeps them. It loads nothing itself.

    A scene is that of an edge. Its Gaussians are selected from predictions of whole parts
    (`choose_predictions`); of a network it is a prediction of its own.

    Attributes:
        tour: the graph.
        edge: the edge that the camera is at.
        outlines: floor outlines of the panoramas whose scenes have been loaded, also after a scene is dropped.
        outlooks: what is seen around panoramas whose scenes have been loaded (`measure_outlook`).
        hidden: for each panorama, those whose marks it does not see.
    """

    def __init__(self, tour: TourGraph, *, merged: Scene | None = None, max_views: int = MAX_SCENE_VIEWS) -> None:
        """Start without scenes.

        Args:
            tour: the graph.
            merged: the scene of all panoramas that the scenes of the edges are parts of; None to predict them.
            max_views: of the predictor (`choose_predictions`).
        """
        self.tour = tour
        self._graphs = [tour]  # also those before poor edges and walls were found, which pending entries have
        self.edge: Edge = next(iter(tour.overlaps))
        self._is_edge_known = False  # whether the camera has been at the edge
        self.outlines: dict[int, FloorOutline] = {}
        self.outlooks: dict[int, np.ndarray] = {}
        self.hidden: dict[int, list[int]] = {}
        self._views = choose_scene_views(tour)
        everything = tuple(range(len(tour)))
        # The prediction that has the Gaussians of a panorama; none if each scene is a prediction.
        self._providers = (
            choose_predictions(tour, max_views) if merged is None else dict.fromkeys(everything, everything)
        )
        self._sources = {
            views: tuple(dict.fromkeys(self._providers.get(node, views) for node in views))
            for views in self._views.values()
        }
        predictions = dict.fromkeys(source for sources in self._sources.values() for source in sources)
        # The least recently used one is the first.
        self._predictions = OrderedDict((views, _Prediction()) for views in predictions)
        self._selected: OrderedDict[ViewNumbers, LoadedScene] = OrderedDict()  # from predictions, and the first one
        self._following: tuple[Edge, list[ViewNumbers]] | None = None
        if merged is not None:
            entry = SceneEntry(tour.name, tour=tour, views=everything)
            self._predictions[everything] = _Prediction(LoadedScene(entry, merged), True)

    @staticmethod
    def start(loaded: LoadedScene) -> TourScenes:
        """The scenes of the tour whose first scene is loaded."""
        entry = loaded.entry
        assert entry.tour is not None
        scenes = TourScenes(entry.tour, merged=entry.merged, max_views=entry.max_views)
        scenes.add(loaded)
        edges = [edge for edge, views in scenes._views.items() if views == entry.views]
        if edges:  # else it is a prediction of a part
            scenes.edge, scenes._is_edge_known = max(edges, key=lambda edge: entry.start in edge), True
        return scenes

    @property
    def views(self) -> ViewNumbers:
        """The panoramas of the scene that the camera needs."""
        return self._views[self.edge]

    @property
    def part(self) -> int:
        """The part of the tour that the camera is in."""
        return self.tour.parts[self.edge[0]]

    @property
    def loaded(self) -> list[ViewNumbers]:
        """The scenes that need no prediction."""
        return [views for views in self._sources if views in self._selected or self._has_sources(views)]

    @property
    def missing(self) -> list[ViewNumbers]:
        """The predictions that the scene of the camera needs and that are not in memory."""
        return [source for source in self._sources[self.views] if self._find(source) is None]

    def _has_sources(self, views: ViewNumbers) -> bool:
        return all(self._find(source) is not None for source in self._sources[views])

    def _find(self, views: ViewNumbers) -> LoadedScene | None:
        """A prediction that is in memory."""
        return self._predictions[views].loaded if views in self._predictions else None

    def make_entry(self, views: ViewNumbers) -> SceneEntry:
        """The prediction of these panoramas as an entry for the loader."""
        pair = self.tour.make_set(views)
        name = pair.name if len(views) <= MAX_SCENE_VIEWS else f"{len(views)} panoramas"
        return SceneEntry(name, pair=pair, tour=self.tour, views=views)

    def add(self, loaded: LoadedScene) -> None:
        """Keep a prediction, or the scene of an edge that is shown until there is one.

        The least recently used ones are dropped if the memory is exceeded.
        """
        views = loaded.entry.views
        if (facts := loaded.facts) is not None:
            self.outlines |= facts.outlines
            self.outlooks |= zip(facts.views, facts.outlooks, strict=True)
            self.hidden |= zip(facts.views, facts.hidden, strict=True)
            self._block(facts.graph.walls)
            clearances = facts.graph.clearances
            if clearances.keys() - self.tour.clearances.keys():  # a refinement changes them little
                self._change(replace(self.tour, clearances=self.tour.clearances | clearances))
            if poor := set(facts.graph.poor) & self.tour.overlaps.keys() - set(self.tour.poor):
                self._change(replace(self.tour, poor=(*self.tour.poor, *sorted(poor))))
        if views not in self._predictions:
            self._selected[views] = loaded
            return
        prediction = self._predictions[views]
        prediction.loaded, prediction.is_known = loaded, True
        self._predictions.move_to_end(views)
        for scene in [scene for scene in self._selected if views in self._sources[scene] and self._has_sources(scene)]:
            del self._selected[scene]
        self._drop(views)

    def is_of(self, entry: SceneEntry) -> bool:
        """Whether an entry is a prediction of this tour, also one that was requested before its graph changed."""
        return any(entry.tour is graph for graph in self._graphs)

    def _change(self, tour: TourGraph) -> None:
        self.tour = tour
        self._graphs.append(tour)

    def _block(self, walls: Sequence[Edge]) -> None:
        """Put walls with links in place of edges. A panorama without another edge keeps the scene of its first one."""
        blocked = [edge for edge in walls if edge in self.tour.overlaps]
        if not blocked:
            return
        self._change(link_parts(self.tour.with_walls(blocked)))
        of_node = {node: views for edge, views in self._views.items() for node in edge}
        self._views = {edge: self._views.get(edge, of_node[edge[0]]) for edge in self.tour.overlaps}
        if self.edge in blocked:
            self.edge = self.tour.find_edge(self.edge[0])
        self._following = None

    def _drop(self, newest: ViewNumbers) -> None:
        """Drop what was not used for the longest time, until the memory is not exceeded."""
        kept = [views for views, prediction in self._predictions.items() if prediction.loaded is not None]
        every = (*self._selected.values(), *filter(None, map(self._find, kept)))
        total = sum(measure_bytes(each.scene) for each in every)
        needed = {newest, self.views, *self._sources[self.views]}
        for other in [other for other in self._selected if other not in needed]:
            if total > _MEMORY:
                total -= measure_bytes(self._selected.pop(other).scene)
        may_go = [other for other in kept if other not in needed][: max(len(kept) - 2, 0)]
        for other in may_go:
            if total > _MEMORY:
                total -= measure_bytes(self._predictions[other].drop().scene)

    def fail(self, views: ViewNumbers) -> None:
        """Do not request a prediction again, because it could not be loaded or refined."""
        if views in self._predictions:
            self._predictions[views].has_failed = True

    def get(self, views: ViewNumbers) -> LoadedScene | None:
        """The scene of an edge if it is in memory; it becomes the most recently used."""
        if views in self._predictions:
            loaded = self._find(views)
        elif views not in self._selected and self._has_sources(views):
            loaded = self._selected[views] = self._select(views)
            self._drop(views)
        else:
            loaded = self._selected.get(views)
        for scenes in (self._selected, self._predictions):
            for each in (views, *self._sources[views]):
                if each in scenes:
                    scenes.move_to_end(each)
        return loaded

    def _select(self, views: ViewNumbers) -> LoadedScene:
        """The scene of these panoramas, from the predictions that have their Gaussians."""
        parts: list[Gaussians] = []
        for source in self._sources[views]:
            nodes = [node for node in views if self._providers[node] == source]
            loaded = self._find(source)
            assert loaded is not None
            scene = select_views(loaded.scene, tuple(source.index(node) for node in nodes))
            labels = torch.tensor([views.index(node) for node in nodes])
            parts.append(replace(scene.gaussians, views=labels[scene.gaussians.views.long()]))
        cam2world, names = self.tour.cam2world[list(views)], tuple(self.tour.panoramas[node].label for node in views)
        scene = replace(scene, gaussians=Gaussians.cat(parts), cam2world=cam2world, names=names, gains=())
        return LoadedScene(self.make_entry(views), scene)

    def move(self, position: Float[np.ndarray, "3"], edge: Edge | None = None) -> None:
        """Choose an edge that is flown, or that of a camera position."""
        if edge is None or edge not in self._views:  # a wall was found while it was flown along
            tour, known = self.tour, self._is_edge_known
            edge = follow_edge(tour, position, self.edge) if known else tour.find_nearest_edge(position)[0]
        self.edge, self._is_edge_known = edge, True

    def find_nearest(self, position: Float[np.ndarray, "3"]) -> int:
        """The end of the edge that is nearer to a position: another panorama may be behind a wall."""
        return self.tour.find_nearest(position, self.edge)

    def is_inside(self, position: Float[np.ndarray, "3"], views: ViewNumbers) -> bool:
        """Whether the scene of some panoramas is good at a position: they are of its edge, or one of them is there."""
        node = self.find_nearest(position)
        is_there = bool(np.linalg.norm(self.tour.positions[node] - position) <= EDGE_HYSTERESIS)
        return set(self.edge) <= set(views) or (node in views and is_there)

    def list_next(self, route: Route | None, fraction: float) -> list[ViewNumbers]:
        """All predictions, the most urgent first: those that the camera needs, then those that are next.

        These are the next ones of a route; then those around the nearest panorama, those of its part by distance, and
        those of other parts: first where links lead to, then in the order of the panoramas.
        """
        ahead = (
            [] if route is None else [self._views[edge] for edge in route.edges_after(fraction) if edge in self._views]
        )
        if self._following is None or self._following[0] != self.edge:
            self._following = self.edge, self._list_following()
        scenes = [self.views, *ahead, *self._following[1]]
        return list(dict.fromkeys(source for views in scenes for source in self._sources[views]))

    def _list_following(self) -> list[ViewNumbers]:
        tour, here = self.tour, set(self.edge)
        middle = tour.positions[list(self.edge)].mean(axis=0)
        inside = [edge for edge in self._views if tour.parts[edge[0]] == self.part]
        away = dict(zip(inside, tour.measure_distances(inside, middle), strict=True))
        inside.sort(key=lambda edge: (not here & set(edge), away[edge], tour.length(edge)))
        linked = [end for start, end in tour.links if start in here]
        following = (node % len(tour) for node in range(self.edge[1] + 1, self.edge[1] + len(tour)))
        outside = [tour.find_edge(node) for node in (*linked, *following) if tour.parts[node] != self.part]
        return [self._views[edge] for edge in dict.fromkeys((*inside, *outside, *self._views))]

    def choose_request(self, wanted: Sequence[ViewNumbers], current: SceneEntry | None) -> SceneEntry | None:
        """The entry to load now, or None to let the loader continue with `current` (None: it is idle).

        Predictions come before refinements. A refinement ends if a prediction that the camera needs is missing; a
        prediction is finished, so that none is lost. One that was dropped from memory is read again when it is needed.
        """
        predictions = {views: self._predictions[views] for views in wanted if not self._predictions[views].has_failed}
        for views in reversed(list(predictions)[: 1 + _NEXT_SCENES]):
            self._predictions.move_to_end(views)
        missing = [views for views, each in predictions.items() if each.loaded is None]
        missing = [views for views in missing if not predictions[views].is_known or views in self.missing]
        if current is not None and (current.views in predictions or not missing):
            is_refined = self._find(current.views) is not None
            if not missing or missing[0] not in self.missing or not is_refined:
                return None
        unrefined = (views for views, each in predictions.items() if each.loaded and not each.loaded.is_final)
        views = missing[0] if missing else next(unrefined, None)
        if views is None:
            return None
        return self.make_entry(views)

    def plan_way(self, camera: Float[np.ndarray, "4 4"], nodes: Sequence[int] = (), *, rest: float = 0.0) -> Route:
        """`plan_way` in the part of a camera, which may be that after a jump; it zooms along edges without a scene."""
        part, loaded = self.tour.parts[follow_edge(self.tour, camera[:3, 3], self.edge)[0]], set(self.loaded)
        missing = [edge for edge, views in self._views.items() if views not in loaded]
        tour = replace(self.tour, poor=tuple({*self.tour.poor, *missing}))
        return plan_way(tour, camera, nodes, part=part, rest=rest, outlooks=self.outlooks)

    def find_place(self, position: Float[np.ndarray, "3"]) -> PlaceFacts:
        """What is known of the nearest panorama; the height is that of cameras in its part, if one is known there."""
        node, parts = self.find_nearest(position), self.tour.parts
        here = [outline for other, outline in self.outlines.items() if parts[other] == self.part]
        heights = (outline.camera_height for outline in here or self.outlines.values())
        height = choose_camera_height(heights, self.tour.far)
        return PlaceFacts(node, height, self.hidden.get(node, []), self.outlooks.get(node))


def plan_way(
    graph: TourGraph,
    camera: Float[np.ndarray, "4 4"],
    nodes: Sequence[int] = (),
    *,
    part: int | None = None,
    rest: float = 0.0,
    outlooks: dict[int, np.ndarray] | None = None,
) -> Route:
    """A route from a pose through panoramas in their order; without any, through all of them.

    Args:
        graph: of the panoramas.
        camera: the pose.
        nodes: where the route goes.
        part: of the camera; None if it is unknown.
        rest, outlooks: see `plan_route`.
    """
    position = camera[:3, 3]
    if nodes:
        walk = find_way(graph, position, nodes[0], part)
        for a, b in itertools.pairwise(nodes):
            walk += find_walk(graph, a, b)[1:]
    else:
        edge, _ = graph.find_nearest_edge(position, part)
        walk = plan_walk(graph, graph.find_nearest(position, edge))
    return plan_route(graph, walk, camera, rest=rest, outlooks=outlooks)


def measure_bytes(scene: Scene) -> int:
    """Bytes of a scene's Gaussians in memory."""
    values = (getattr(scene.gaussians, field.name) for field in fields(scene.gaussians))
    return sum(value.numel() * value.element_size() for value in values)
