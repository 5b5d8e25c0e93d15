"""The scenes of a tour in a viewer: which one is shown, which are loaded next, which stay in memory, how they fade.

Imports no OpenGL: the film and the window use the same objects.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import torch
from jaxtyping import Float

from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.tours.floor import FloorOutline, choose_camera_height
from pansplat.tours.graph import Edge, TourGraph, ViewNumbers
from pansplat.tours.limits import EDGE_HYSTERESIS, follow_edge
from pansplat.tours.links import link_parts
from pansplat.tours.merge import select_views
from pansplat.tours.route import REST_SECONDS, STOP_SECONDS, Moment, Route, plan_route
from pansplat.tours.scene_views import MAX_SCENE_VIEWS, choose_predictions, choose_scene_views
from pansplat.tours.walks import find_walk, find_way, plan_walk
from pansplat_viewer.scene.life import SceneLife
from pansplat_viewer.scene.loader import LoadedScene, SceneEntry

_MEMORY = 2 << 30  # bytes of the scenes of a tour that are kept; two predictions are kept in any case
_LARGEST_STOP_STEP = 1 / 3  # of this fade in a frame, also after a pause without frames
_NEXT_SCENES = 3  # that are dropped last


class TourScenes:
    """The scenes of one tour: chooses, requests and keeps them. It loads nothing itself.

    A scene is that of an edge. Its Gaussians are selected from predictions of whole parts
    (`TourGraph.choose_predictions`); of a network it is a prediction of its own.

    Attributes:
        tour: the graph.
        edge: the edge that the camera is at.
        outlines: floor outlines of the panoramas whose scenes have been loaded, also after a scene is dropped.
        outlooks: what is seen around panoramas whose scenes have been loaded (`measure_outlook`).
        hidden: the panoramas whose places on the floor surfaces hide, by those panoramas.
    """

    def __init__(self, tour: TourGraph, *, merged: Scene | None = None, max_views: int = MAX_SCENE_VIEWS) -> None:
        """Start without scenes.

        Args:
            tour: the graph.
            merged: the scene of all panoramas that the scenes of the edges are parts of; None to predict them.
            max_views: of the predictor (`TourGraph.choose_predictions`).
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
        # Predictions, the least recently used one first.
        self._lives = OrderedDict((views, SceneLife(SceneEntry("", tour=tour, views=views))) for views in predictions)
        self._selected: OrderedDict[ViewNumbers, LoadedScene] = OrderedDict()  # from predictions, and the first one
        self._following: tuple[Edge, list[ViewNumbers]] | None = None
        if merged is not None:
            entry = SceneEntry(tour.name, tour=tour, views=everything)
            self._lives.setdefault(everything, SceneLife(entry)).receive(LoadedScene(entry, merged))

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
        return self._lives[views].loaded if views in self._lives else None

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
            self._block(facts.walls)
            clearances = dict(zip(facts.views, facts.clearances, strict=True))
            if clearances.keys() - self.tour.clearances.keys():  # a refinement changes them little
                self._change(replace(self.tour, clearances=self.tour.clearances | clearances))
            if poor := set(facts.poor) & self.tour.overlaps.keys() - set(self.tour.poor):
                self._change(replace(self.tour, poor=(*self.tour.poor, *sorted(poor))))
        if views not in self._lives:
            self._selected[views] = loaded
            return
        self._lives[views].receive(loaded)
        self._lives.move_to_end(views)
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
        kept = [views for views, life in self._lives.items() if life.loaded is not None]
        every = (*self._selected.values(), *filter(None, map(self._find, kept)))
        total = sum(measure_bytes(each.scene) for each in every)
        needed = {newest, self.views, *self._sources[self.views]}
        for other in [other for other in self._selected if other not in needed]:
            if total > _MEMORY:
                total -= measure_bytes(self._selected.pop(other).scene)
        may_go = [other for other in kept if other not in needed][: max(len(kept) - 2, 0)]
        for other in may_go:
            if total > _MEMORY:
                total -= measure_bytes(self._lives[other].drop().scene)

    def fail(self, views: ViewNumbers) -> None:
        """Do not request a prediction again, because it could not be loaded or refined."""
        if views in self._lives:
            self._lives[views].fail()

    def get(self, views: ViewNumbers) -> LoadedScene | None:
        """The scene of an edge if it is in memory; it becomes the most recently used."""
        if views in self._lives:
            loaded = self._find(views)
        elif views not in self._selected and self._has_sources(views):
            loaded = self._selected[views] = self._select(views)
            self._drop(views)
        else:
            loaded = self._selected.get(views)
        for scenes in (self._selected, self._lives):
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
        return min(self.edge, key=lambda node: float(np.linalg.norm(self.tour.positions[node] - position)))

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
        lives = {views: self._lives[views] for views in wanted if self._lives[views].state != "failed"}
        for views in reversed(list(lives)[: 1 + _NEXT_SCENES]):
            self._lives.move_to_end(views)
        missing = [views for views, life in lives.items() if life.loaded is None]
        missing = [views for views in missing if not lives[views].is_known or views in self.missing]
        if current is not None and (current.views in lives or not missing):
            is_refined = self._find(current.views) is not None
            if not missing or missing[0] not in self.missing or not is_refined:
                return None
        unrefined = (views for views, life in lives.items() if life.loaded is not None and not life.loaded.is_final)
        views = missing[0] if missing else next(unrefined, None)
        if views is None:
            return None
        if current is not None and current.views in self._lives:
            self._lives[current.views].cancel()
        self._lives[views].request()
        return self.make_entry(views)

    def plan_route(self, camera: Float[np.ndarray, "4 4"], remaining: Sequence[int] = ()) -> Route:
        """A route from a pose through the remaining panoramas; without any, through all of them."""
        position = camera[:3, 3]
        if remaining:
            walk = self._find_way(position, remaining[0])
            for a, b in itertools.pairwise(remaining):
                walk += find_walk(self.tour, a, b)[1:]
        else:
            edge, _ = self.tour.find_nearest_edge(position, self._find_part(position))
            distances = np.linalg.norm(self.tour.positions[list(edge)] - position, axis=1)
            walk = plan_walk(self.tour, edge[int(distances.argmin())])
        return plan_route(self.tour, walk, camera, rest=REST_SECONDS, outlooks=self.outlooks)

    def plan_way(self, camera: Float[np.ndarray, "4 4"], node: int) -> Route:
        """A route from a pose to a panorama."""
        return plan_route(self.tour, self._find_way(camera[:3, 3], node), camera, outlooks=self.outlooks)

    def _find_way(self, position: Float[np.ndarray, "3"], node: int) -> list[int]:
        return find_way(self.tour, position, node, self._find_part(position))

    def _find_part(self, position: Float[np.ndarray, "3"]) -> int:
        """The part of a position, which may be that after a jump."""
        return self.tour.parts[follow_edge(self.tour, position, self.edge)[0]]

    @property
    def camera_height(self) -> float:
        """Height of the cameras over the floor, in the part of the camera if it is known there, metres."""
        parts = self.tour.parts
        here = [outline for node, outline in self.outlines.items() if parts[node] == self.part]
        heights = (outline.camera_height for outline in here or self.outlines.values())
        return choose_camera_height(heights, self.tour.far)


def measure_bytes(scene: Scene) -> int:
    """Bytes of a scene's Gaussians in memory."""
    values = (getattr(scene.gaussians, field.name) for field in fields(scene.gaussians))
    return sum(value.numel() * value.element_size() for value in values)


class StopFade:
    """The photograph of the panorama at which the camera stands; it fades in and out for `STOP_SECONDS`.

    Attributes:
        index: number of the photograph; None if none is shown.
        before: of a zoom, the photograph that it begins with; else None.
        weight: of the photograph over that one or the scene, 0 to 1.
    """

    def __init__(self) -> None:
        """No photograph is shown."""
        self.index: int | None = None
        self.before: int | None = None
        self.weight = 0.0
        self._last = 0.0

    @property
    def is_whole(self) -> bool:
        """Whether nothing is seen of the scene."""
        return self.weight >= 1 or self.before is not None

    def follow(self, moment: Moment, now: float) -> None:
        """Show what a route shows at time `now` (seconds)."""
        self._last, self.before, self.index, self.weight = now, None, moment.photograph, moment.weight
        if moment.arrival is not None:
            self.before, self.index, self.weight = self.index, moment.step.nodes[1], moment.arrived

    def update(self, index: int | None, now: float, *, at_once: bool = False) -> None:
        """Go on to time `now`, while the camera stands at a panorama, or at none.

        With `at_once` its photograph is shown already and does not fade in.
        """
        step = min(max(now - self._last, 0.0) / STOP_SECONDS, _LARGEST_STOP_STEP)
        at_once = at_once or self.before is not None  # a zoom has shown it
        self._last, self.before = now, None
        if self.weight <= 0 or at_once:
            self.index = index
        is_here = index is not None and index == self.index
        self.weight = 1.0 if is_here and at_once else min(max(self.weight + (step if is_here else -step), 0.0), 1.0)
