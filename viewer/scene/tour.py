"""The scenes of a tour in a viewer: which one is shown, which are loaded next, which stay in memory, how they fade.

Imports no OpenGL: the film and the window use the same objects.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat.tours import (
    FADE_SECONDS,
    Edge,
    FloorOutline,
    Route,
    TourGraph,
    Views,
    choose_camera_height,
    find_link_ring,
    plan_route,
)
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.loader import LoadedScene, SceneEntry
from pansplat_viewer.scene.picking import project_point

DEFAULT_MEMORY = 2.0  # GiB, of the scenes of a tour
_NEXT_SCENES = 3  # that are predicted before they are needed
_HOTSPOT_RADIUS = 0.22  # metres, on the floor
_MIN_HOTSPOT_PIXELS = 14.0


class TourScenes:
    """The scenes of one tour: chooses, requests and keeps them. It loads nothing itself.

    Attributes:
        tour: the graph.
        edge: the edge that the camera is at.
        outlines: floor outlines of the panoramas whose scenes have been loaded, also after a scene is dropped.
    """

    def __init__(
        self,
        tour: TourGraph,
        *,
        memory: float = DEFAULT_MEMORY,
        merged: Scene | None = None,
    ) -> None:
        """Start without scenes.

        Args:
            tour: the graph.
            memory: limit of the loaded scenes, GiB; two scenes are kept in any case.
            merged: the scene of all panoramas that the scenes of the edges are parts of; None to predict them.
        """
        self.tour, self._merged = tour, merged
        self.edge: Edge = next(iter(tour.overlaps))
        self._is_placed = False  # whether the camera has been at the edge
        self.outlines: dict[int, FloorOutline] = {}
        self._views = tour.choose_scene_views()
        self._budget = memory * 2**30
        self._loaded: OrderedDict[Views, LoadedScene] = OrderedDict()
        self._failed: set[Views] = set()

    @property
    def views(self) -> Views:
        """The panoramas of the scene that the camera needs."""
        return self._views[self.edge]

    @property
    def part(self) -> int:
        """The part of the tour that the camera is in."""
        return self.tour.parts[self.edge[0]]

    @property
    def num_scenes(self) -> int:
        """Number of scenes of the tour."""
        return len(set(self._views.values()))

    @property
    def loaded(self) -> list[Views]:
        """The scenes in memory, the least recently used first."""
        return list(self._loaded)

    def make_entry(self, views: Views) -> SceneEntry:
        """The scene of these panoramas as an entry for the loader."""
        pair = self.tour.make_pair(views)
        return SceneEntry(pair.name, pair=pair, tour=self.tour, views=views, merged=self._merged)

    def add(self, loaded: LoadedScene) -> None:
        """Keep a scene; the least recently used ones are dropped if the memory is exceeded."""
        views = loaded.entry.views
        self._loaded[views] = loaded
        self._loaded.move_to_end(views)
        self.outlines |= loaded.outlines
        self._failed.discard(views)
        total = sum(measure_bytes(scene.scene) for scene in self._loaded.values())
        for other in [other for other in self._loaded if other not in (views, self.views)]:
            if total <= self._budget or len(self._loaded) <= 2:
                break
            total -= measure_bytes(self._loaded.pop(other).scene)

    def fail(self, views: Views) -> None:
        """Do not request a scene again, because it could not be loaded or refined."""
        self._failed.add(views)

    def get(self, views: Views) -> LoadedScene | None:
        """A scene if it is in memory; it becomes the most recently used."""
        loaded = self._loaded.get(views)
        if loaded is not None:
            self._loaded.move_to_end(views)
        return loaded

    def move(self, position: Float[np.ndarray, "3"], route: Route | None = None, fraction: float = 0.0) -> None:
        """Choose the edge of a camera position, or of a fraction of a route that is being flown."""
        edge = None if route is None else route.edge(fraction)
        if edge is None:
            tour, known = self.tour, self._is_placed
            edge = tour.follow_edge(position, self.edge) if known else tour.find_nearest_edge(position)[0]
        self.edge, self._is_placed = edge, True

    def list_next(self, route: Route | None, fraction: float) -> list[Views]:
        """The scenes to have in memory, the most urgent first: that of the camera, then those that are next.

        These are the next ones of a route; or those around the nearest panorama, then those of other parts: first
        where links lead to, then in the order of the panoramas.
        """
        tour = self.tour
        if route is not None:
            edges = list(route.edges_after(fraction))
        else:
            a, b = self.edge
            edges = [edge for edge in self._views if {a, b} & set(edge)]
            edges.sort(key=tour.length)
            linked = [end for start, end in tour.links if start in self.edge]
            following = (node % len(tour) for node in range(b + 1, b + len(tour)))
            others = [node for node in (*linked, *following) if tour.is_fade(a, node)]
            edges += [tour.find_edge(node) for node in others[: 2 * _NEXT_SCENES]]
        wanted = dict.fromkeys([self.views, *(self._views[edge] for edge in edges)])
        return list(wanted)[: 1 + _NEXT_SCENES]

    def choose_request(self, wanted: Sequence[Views], current: SceneEntry | None) -> SceneEntry | None:
        """The entry to load now, or None to let the loader continue with `current` (None: it is idle).

        Predictions come before refinements. A refinement ends if the scene of the camera is missing.
        """
        first, wanted = wanted[0], [views for views in wanted if views not in self._failed]
        missing = [views for views in wanted if views not in self._loaded]
        if current is not None:
            needed = missing and missing[0] == first
            replaced = needed and current.views != missing[0]
            if not replaced and (current.views in wanted or not missing):
                return None
        if missing:
            return self.make_entry(missing[0])
        return next((self.make_entry(views) for views in wanted if not self._loaded[views].is_final), None)

    def find_limit(self, route: Route, fraction: float) -> float:
        """The fraction up to which a route can be flown with the scenes in memory."""
        numbers = route.legs[round(fraction * (len(route.legs) - 1)) :]
        ready = [self._views[edge] in self._loaded for edge in route.edges] + [True]  # the last one is leg -1
        missing = np.flatnonzero(~np.array(ready)[numbers])
        if not len(missing):
            return 1.0
        return max((len(route.legs) - len(numbers) + int(missing[0]) - 1) / (len(route.legs) - 1), fraction)

    def is_blocked(self, route: Route, fraction: float) -> bool:
        """Whether a route cannot be flown on from a fraction, because the next scene could not be loaded."""
        leg = int(route.legs[min(round(fraction * (len(route.legs) - 1)) + 1, len(route.legs) - 1)])
        return leg >= 0 and self._views[route.edges[leg]] in self._failed

    def plan_route(self, camera: Float[np.ndarray, "4 4"], remaining: Sequence[int] = ()) -> Route:
        """A route from a pose through the remaining panoramas; without any, through all of them."""
        position = camera[:3, 3]
        if remaining:
            walk = [*self._find_way(position, remaining[0]), *remaining[1:]]
        else:
            edge, _ = self.tour.find_nearest_edge(position, self._find_part(position))
            distances = np.linalg.norm(self.tour.positions[list(edge)] - position, axis=1)
            walk = self.tour.plan_walk(edge[int(distances.argmin())])
        return plan_route(self.tour, walk, camera)

    def plan_way(self, camera: Float[np.ndarray, "4 4"], node: int) -> Route:
        """A route from a pose to a panorama."""
        return plan_route(self.tour, self._find_way(camera[:3, 3], node), camera)

    def _find_way(self, position: Float[np.ndarray, "3"], node: int) -> list[int]:
        return self.tour.find_way(position, node, self._find_part(position))

    def _find_part(self, position: Float[np.ndarray, "3"]) -> int:
        """The part of a position, which may be that after a jump."""
        return self.tour.parts[self.tour.follow_edge(position, self.edge)[0]]

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


class CrossFade:
    """Two slots for scenes: one is shown, and the other one fades out for `FADE_SECONDS` after an exchange.

    A scene of another part of a tour than that of the camera is drawn from the last pose in its part.

    Attributes:
        front: slot of the scene that is shown.
        scenes: of both slots.
        parts: of the tour, of both scenes.
        poses: from which the scenes are drawn; None before the first one.
    """

    def __init__(self) -> None:
        """Both slots are empty."""
        self.front = 0
        self.scenes: list[Scene | None] = [None, None]
        self.poses: list[Float[np.ndarray, "4 4"] | None] = [None, None]
        self.parts = [0, 0]
        self._start = -1e9
        self._fading = False

    def choose_slot(self, scene: Scene) -> int | None:
        """The slot for a scene; None while the other one is fading out, or if it is shown already."""
        if self._fading or self.scenes[self.front] is scene:
            return None
        return self.front if self.scenes[self.front] is None else 1 - self.front

    def show(self, slot: int, scene: Scene, now: float, part: int = 0) -> None:
        """Show a scene that has been uploaded to a slot; at time `now` (seconds) the other one starts to fade out."""
        self._fading = self.scenes[slot] is not None or slot != self.front
        self.scenes[slot], self.front, self._start = scene, slot, now
        self.poses[slot], self.parts[slot] = None, part

    def move(self, pose: Float[np.ndarray, "4 4"], part: int = 0) -> None:
        """Draw the scenes of a part from this pose."""
        for slot in range(2):
            if self.parts[slot] == part or self.poses[slot] is None:
                self.poses[slot] = pose

    def compute_weight(self, now: float) -> float:
        """Weight of the scene that is shown, 0 to 1; that of the other one is the rest."""
        done = min(max((now - self._start) / FADE_SECONDS, 0.0), 1.0)
        self._fading = self._fading and done < 1
        return done * done * (3 - 2 * done) if self._fading else 1.0

    def clear(self) -> None:
        """Forget both scenes; the first slot is the front."""
        self.front, self.scenes, self.poses, self._fading = 0, [None, None], [None, None], False


@dataclass(frozen=True)
class Hotspot:
    """The place of a panorama in the image, on the floor below its camera, or on the floor where a link leads to it.

    Attributes:
        node: number of the panorama.
        label: its name, or the text of the link.
        center: pixels, from the left and from the top.
        radius: pixels, within which a click is meant.
        ring: corners of the circle on the floor, pixels.
        is_fade: whether the panorama is in another part, to which the image fades.
    """

    node: int
    label: str
    center: tuple[float, float]
    radius: float
    ring: tuple[tuple[float, float], ...]
    is_fade: bool = False


def find_hotspots(scenes: TourScenes, camera: Camera, size: tuple[int, int]) -> list[Hotspot]:
    """The panoramas that can be reached next, and that are in the image; the nearest last.

    They share an edge with those near the camera, or a link leads to them from there, to another part.
    """
    tour, position = scenes.tour, np.asarray(camera.position)
    right, down, forward = np.asarray(camera.level).T
    below = scenes.camera_height * down
    feet = {
        node: (tour.positions[node] + below, tour.panoramas[node].label)
        for node in tour.list_reachable(scenes.edge)
        if np.linalg.norm(tour.positions[node] - position) >= 3 * _HOTSPOT_RADIUS
    }
    for start in sorted(set(scenes.edge), key=lambda node: float(np.linalg.norm(tour.positions[node] - position))):
        for (first, node), link in tour.links.items():
            if first == start and tour.is_fade(first, node) and node not in feet:
                ring = find_link_ring(tour, first, node, scenes.camera_height)
                if ring is not None:
                    feet[node] = (tour.positions[first] + ring, link.text or tour.panoramas[node].label)
    found = []
    for node, (foot, label) in feet.items():
        angles = np.arange(24) * (2 * np.pi / 24)
        circle = foot + _HOTSPOT_RADIUS * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * forward)
        center = project_point(camera, tuple(foot), size)
        ring = [project_point(camera, tuple(corner), size) for corner in circle]
        if center is None or None in ring or not (0 <= center[0] < size[0] and 0 <= center[1] < size[1]):
            continue
        radius = max(np.ptp([corner[0] for corner in ring]) / 2, _MIN_HOTSPOT_PIXELS)
        is_fade = tour.is_fade(scenes.edge[0], node)
        hotspot = Hotspot(node, label, center, float(radius), tuple(ring), is_fade)
        found.append((float(np.linalg.norm(foot - position)), hotspot))
    return [hotspot for _, hotspot in sorted(found, key=lambda item: -item[0])]


def find_clicked(hotspots: Sequence[Hotspot], pixel: tuple[float, float]) -> int | None:
    """The panorama of the hotspot at a pixel, the nearest one first; None if there is none."""
    for hotspot in reversed(hotspots):
        if np.hypot(pixel[0] - hotspot.center[0], pixel[1] - hotspot.center[1]) <= hotspot.radius:
            return hotspot.node
    return None
