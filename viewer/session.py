"""The scenes of the window: those to choose from, which one is shown, which one comes next, and those of a tour.

`Session` follows the loader; the stage draws the scenes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene, empty_gaussians
from pansplat.geometry.level import find_direction
from pansplat.inputs.panorama_sets import Panorama
from pansplat.tours.route import REST_SECONDS, Route
from pansplat.tours.scene_graph import list_starts
from pansplat_viewer.core import camera as cameras
from pansplat_viewer.core.hotspots import PlaceFacts
from pansplat_viewer.core.loader import Find, LoadedScene, SceneEntry, SceneLoader, choose_entry
from pansplat_viewer.core.state import ViewerState, advance_route, enter_scene, limit_camera
from pansplat_viewer.core.tour_scenes import TourScenes, plan_way
from pansplat_viewer.ui.photograph_textures import find_open_view
from pansplat_viewer.ui.stage import Stage


class Session:
    """Shows what the loader finds, predicts and refines.

    Attributes:
        loader: loads one entry at a time; closed with the viewer.
        entries: to choose from.
        current: number of the one that is shown or loaded; -1 if there is none.
        path: where they were found; None if they are only loaded again.
        loaded: the scene that is shown, of a tour the first one; None before the first one.
        tour: the scenes of the tour that is shown, or whose photographs are; None for other scenes.
    """

    def __init__(
        self,
        state: ViewerState,
        stage: Stage,
        loader: SceneLoader,
        find: Find,
        *,
        show_error: Callable[[str], None],
        listed: Callable[[Path | None], None],
    ) -> None:
        """Show nothing yet.

        Args:
            state: of the viewer.
            stage: draws the image.
            loader: finds and loads entries.
            find: returns the entries of a path; called in a worker thread.
            show_error: shows a message.
            listed: called when other entries are listed, with the path at which they were found.
        """
        self._state, self._stage, self.loader, self._find = state, stage, loader, find
        self._show_error, self._listed = show_error, listed
        self.entries: list[SceneEntry] = []
        self.current = -1
        self.path: Path | None = None
        self._wanted: tuple[Path, str | None] = Path(), None  # path, and the entry to show of those found there
        # What `entries`, `current` and `path` were for the scene that is shown.
        self._kept: tuple[list[SceneEntry], int, Path | None] | None = None
        self.loaded: LoadedScene | None = None
        self._waiting: LoadedScene | None = None  # it is shown once it is converted for the renderer
        self.tour: TourScenes | None = None

    # --- what the panels read ---

    @property
    def names(self) -> list[str]:
        """The names of the entries."""
        return [entry.name for entry in self.entries]

    @property
    def notes(self) -> tuple[str, ...]:
        """What was not used or not placed at the path, and why."""
        return () if self.entry is None else self.entry.notes

    @property
    def entry(self) -> SceneEntry | None:
        """The entry that is shown or loaded."""
        return self.entries[self.current] if 0 <= self.current < len(self.entries) else None

    @property
    def is_busy(self) -> bool:
        """Whether something is looked for, made or prepared."""
        loader = self.loader
        is_loading = loader.entry is not None or loader.is_searching
        return is_loading or self._waiting is not None or self._stage.preparer.progress is not None

    @property
    def loading(self) -> tuple[str, str, float] | None:
        """Name, task and fraction done of the search, or of the scene that will be shown; None without them."""
        if self._loads_for_tour and not self.loader.is_searching:
            return None
        progress, waiting = self._stage.preparer.progress, self._waiting
        if waiting is not None and progress is not None:
            return waiting.entry.name, f"preparing {len(waiting.scene.gaussians):,} Gaussians", progress
        return self.loader.progress

    @property
    def refinement(self) -> float | None:
        """Fraction of the refinement of the scene that is done; None without one."""
        return None if self._loads_for_tour else self.loader.refinement

    @property
    def background(self) -> tuple[str, float] | None:
        """Work of the loader on the tour, and the fraction done."""
        loader = self.loader
        if not self._loads_for_tour or loader.entry is None:
            return None
        if loader.progress is not None:
            return f"next: {loader.entry.name}", loader.progress[2]
        return f"refining: {loader.entry.name}", loader.refinement or 0.0

    @property
    def _loads_for_tour(self) -> bool:
        """Whether the loader works for the tour that is shown, and not for a scene that the user has chosen."""
        entry = self.loader.entry
        if self.tour is None or self.loaded is None:
            return False
        return self._waiting is None if entry is None else self.tour.is_of(entry)

    # --- what a user does ---

    def search(self, path: Path, name: str | None = None) -> None:
        """Look for the scenes at a path and show one; for an invalid path, show an error and keep the scene.

        Args:
            path: a file or folder.
            name: name or number of the entry to show; the first one if there is none of this name.
        """
        self._wanted = path, name
        self.loader.search(path, self._find)

    def show(self, entries: list[SceneEntry], index: int, path: Path | None = None) -> None:
        """List these entries and load one of them.

        Args:
            entries: to choose from.
            index: of the entry to load.
            path: where they were found, so that a reload finds new ones; None if they are only loaded again.
        """
        self.entries, self.current, self.path = entries, index, path
        self._listed(path)
        if self.loaded is None:
            self._preview(entries[index])
        self._waiting = None
        self.loader.request(entries[index])

    def expect(self, entries: list[SceneEntry], path: Path, name: str | None) -> None:
        """Show panoramas while their poses are estimated by a search of the loader, which has begun.

        Args:
            entries: the panoramas, none of which is placed.
            path: where they are.
            name: name or number of the entry to show when the search ends; None for the first.
        """
        self._wanted = path, name
        self._show_unplaced(entries)

    def _show_unplaced(self, entries: list[SceneEntry]) -> None:
        if self.loaded is None and entries:
            self.entries, self.current, self.path = entries, 0, None
            self._preview(entries[0])

    def choose(self, index: int) -> None:
        """Show another entry of the list."""
        if index != self.current:
            self.show(self.entries, index, self.path)

    def reload(self) -> None:
        """Load the entry again."""
        current = max(self.current, 0)
        if self.path is None:
            self.show(self.entries, current)
        else:
            self.search(self.path, self.entries[current].name)

    def cancel_loading(self) -> None:
        """End the search for scenes, else the prediction."""
        if not self.loader.cancel_search():
            self.loader.cancel()
            self._stage.preparer.stop()
            self._waiting, self.current = None, -1
            self._restore()

    def cancel_refinement(self) -> None:
        """End the refinement of the scene that is shown."""
        self.loader.cancel()

    def dismiss(self) -> None:
        """Go on with the scene that is shown after an error."""
        self._stage.has_failed = False
        self._restore()

    def _restore(self) -> None:
        """List the entry that is shown again, after another one was not loaded."""
        if self._kept is not None:
            self.entries, self.current, self.path = self._kept

    # --- frames ---

    def poll(self) -> None:
        """Show the scene, the entries or the error of a finished load or search."""
        loader, waiting = self.loader, self._waiting
        if waiting is not None and self._stage.preparer.is_ready(waiting.scene):
            self._replace(waiting)
        requested = loader.entry
        result = loader.poll() if self._waiting is None else None
        if isinstance(result, list) and loader.is_searching:
            self._show_unplaced(result)
        elif isinstance(result, list):
            (path, name), index = self._wanted, 0
            with contextlib.suppress(InputError):
                index = choose_entry(result, name)
            self.show(result, index, path)
        elif isinstance(result, LoadedScene):
            self._receive(result)
        elif result is not None:
            known = isinstance(result, (InputError, OSError))  # else a defect, or out of memory
            self._show_error(str(result) if known else f"{type(result).__name__}: {result}")
            if requested is not None and loader.entry is None and self.tour is not None and self.tour.is_of(requested):
                self.tour.fail(requested.views)
            self._restore()

    def _receive(self, result: LoadedScene) -> None:
        """Take a prediction or a refined scene of the loader."""
        if self.loaded is not None and self.tour is not None and self.tour.is_of(result.entry):
            self.tour.add(result)
        elif self.loaded is not None and self.loaded.entry is result.entry and not self.loaded.is_final:
            self.loaded = result
        elif self._stage.preparer.is_ready(result.scene):
            self._replace(result)
        else:
            self._waiting = result

    def _replace(self, loaded: LoadedScene) -> None:
        """Show a scene; if it does not fit into memory, keep the one before."""
        self._waiting = None
        if self._stage.upload(self._stage.slots[0], loaded.scene, loaded.entry.name):
            self._stage.has_failed = False
            self._enter(loaded)

    def exchange(self) -> None:
        """Show the refined scene in place of its prediction, while the camera stands still."""
        stage, loaded = self._stage, self.loaded
        if loaded is None or self.tour is not None or self._waiting is not None or loaded.scene is stage.slot.scene:
            return
        if stage.preparer.is_ready(loaded.scene) and not stage.upload(stage.slot, loaded.scene, loaded.entry.name):
            self.loaded = replace(loaded, scene=stage.slot.scene)  # the prediction stays

    def _enter(self, loaded: LoadedScene) -> None:
        """Show a scene that is uploaded, and go to its start."""
        stage, state, entry = self._stage, self._state, loaded.entry
        photograph = stage.photograph if self.loaded is None else None
        remaining = self._list_remaining() if self.loaded is None else ()
        self.loaded, self.tour = loaded, None
        self._kept = self.entries, self.current, self.path
        stage.clear()
        stage.photographs.open(entry.panoramas)
        state.show_message(f"{entry.name}   (H shows the keys)")
        enter_scene(state, loaded.scene, entry.tour, entry.start)
        if entry.tour is None:
            state.graph = state.graph if loaded.facts is None else loaded.facts.graph.with_all_edges()
            limit_camera(state, state.home)
        else:
            stage.add_slot()
            self.tour = TourScenes.start(loaded)
            self.tour.move(np.asarray(state.camera.position))
        if remaining:  # a way over the photographs goes on
            state.route, state.playing = self._plan_way(remaining, REST_SECONDS), True
        tour, part = self.tour, 0 if self.tour is None else self.tour.part
        stage.scene_views = entry.views
        is_here = tour is None or tour.is_inside(np.asarray(state.camera.position), entry.views)
        if photograph is not None:
            stage.fade.show(1 if is_here else 0, photograph, state.now, part)
        if is_here or photograph is None:
            stage.fade.show(0, loaded.scene, state.now, part)
        stage.last_camera = state.camera

    def _preview(self, entry: SceneEntry) -> None:
        """Show the photographs of an entry until its scene is there; the camera can turn and fly."""
        photographs, view = self._stage.photographs, self._find_view()
        photographs.open(entry.panoramas)
        self._stage.clear()
        source = entry.tour or entry.pair
        if source is None:
            self.tour = None
            return
        panoramas = entry.panoramas if entry.pair is None else entry.pair.context
        poses = torch.stack([panorama.cam2world for panorama in panoramas])
        starts, frame = list_starts(panoramas), panoramas[0].frame
        scene = Scene(empty_gaussians(), poses, source.near, source.far, starts=starts, frame=frame)
        enter_scene(self._state, scene, entry.tour)
        self.tour = None if entry.tour is None else TourScenes(entry.tour)
        self._keep_view(view, entry.panoramas)
        nearest = photographs.find_nearest(np.asarray(self._state.camera.position))
        if nearest is not None:
            photographs.wait(nearest)  # else the first frames are black
            self._face_open_view(entry, nearest)
        self._stage.last_camera = self._state.camera

    def _find_view(self) -> tuple[Path, np.ndarray] | None:
        """The photograph at the camera, and where the camera looks in it; None at none."""
        photographs, camera = self._stage.photographs, self._state.camera
        index = photographs.find_stop(np.asarray(camera.position))
        if index is None:
            return None
        return photographs.panoramas[index].image, photographs.pose(index)[:3, :3].T @ camera.rotation[:, 2]

    def _keep_view(self, view: tuple[Path, np.ndarray] | None, panoramas: Sequence[Panorama]) -> None:
        """Look at the same place of the same photograph, whose pose may be another one."""
        for each in panoramas:
            if view is not None and each.image == view[0]:
                camera, pose = self._state.camera, each.cam2world.double().numpy()
                moved = replace(camera, position=tuple(pose[:3, 3].tolist()))
                turned = cameras.focus_on_point(moved, pose[:3, 3] + pose[:3, :3] @ view[1])
                self._state.camera = replace(turned, distance=camera.distance)

    def _face_open_view(self, entry: SceneEntry, index: int) -> None:
        """Turn the start to a wide view, if the panorama has neither a neighbour to look at nor a start view."""
        panorama, camera = entry.panoramas[index], self._state.camera
        is_alone = len(entry.panoramas) == 1 if entry.tour is None else not entry.tour.neighbours(index)
        if is_alone and panorama.start is None and camera == self._state.home:
            try:
                forward = find_direction(panorama.cam2world, find_open_view(panorama), 0.0).numpy()
            except InputError:  # it is shown when the photograph is
                return
            self._state.camera = self._state.home = cameras.focus_on_point(camera, camera.position + forward)

    # --- tours ---

    def _list_remaining(self) -> tuple[int, ...]:
        """The panoramas that a route still visits; none if the camera follows none."""
        route, state = self._state.route, self._state
        return route.list_remaining(state.route_fraction) if route is not None and state.playing else ()

    def update(self) -> None:
        """Show the scene of the camera's place, and load those that are next."""
        tour, state = self.tour, self._state
        if tour is None:
            return
        route = state.route if state.playing else None
        tour.move(np.asarray(state.camera.position), None if state.moment is None else state.moment.step.edge)
        state.graph = tour.tour  # poor edges and walls are found later
        self._show_place(tour)
        self._stage.fade.move(state.camera.cam2world, tour.part)
        if self._loads_for_tour:
            loader = self.loader
            request = tour.choose_request(tour.list_next(route, state.route_fraction), loader.entry)
            if request is not None:
                loader.request(request)

    def _show_place(self, tour: TourScenes) -> None:
        """Start to fade to the scene of the camera's place; without it, to the nearest photograph.

        Until then another scene stays within its panoramas.
        """
        stage, position = self._stage, np.asarray(self._state.camera.position)
        stage.fade.compute_weight(self._state.now)
        loaded = tour.get(tour.views)
        if loaded is not None and stage.fade_to_scene(loaded, tour.part, can_wait=self._waiting is None):
            return
        shows_scene = stage.photograph is None and stage.fade.parts[stage.fade.front] == tour.part
        if self.loaded is None or not (shows_scene and tour.is_inside(position, stage.scene_views)):
            for end in tour.edge:  # that of the other end is read before it is needed
                stage.get_photograph(end)
            stage.fade_to_photograph(tour.find_nearest(position), tour.part)

    def fly(self, seconds: float, was_playing: bool) -> None:
        """Follow the route, from wherever the camera is."""
        state, route = self._state, self._state.route
        if route is None:
            return
        if state.target is not None:
            state.route, state.route_fraction, state.playing = self._plan_way((state.target,)), 0.0, True
        elif state.playing and not was_playing:
            if state.route_fraction == 0:
                state.route = self._plan_way((), REST_SECONDS)
            elif not np.allclose(state.camera.cam2world, route.pose(state.route_fraction), atol=1e-4):
                state.route, state.route_fraction = (
                    self._plan_way(route.list_remaining(state.route_fraction), REST_SECONDS),
                    0.0,
                )
        state.target = None
        for node in self._list_remaining()[:2]:  # photographs are read before they are shown
            self._stage.get_photograph(node)
        if not (state.is_zooming and self._stage.photographs.is_reading):
            advance_route(state, seconds)

    def find_place(self) -> PlaceFacts | None:
        """What is known of the panorama that is nearest to the camera; None without any."""
        state, facts = self._state, None if self.loaded is None else self.loaded.facts
        position = np.asarray(state.camera.position)
        if self.tour is not None:
            return self.tour.find_place(position)
        if state.graph is None or facts is None:
            return None
        node = state.graph.find_nearest(position)
        return PlaceFacts(node, facts.usual_heights[node], facts.hidden[node])

    def _plan_way(self, nodes: Sequence[int], rest: float = 0.0) -> Route:
        """A route from the camera through panoramas; see `plan_way`."""
        graph, pose = self._state.graph, self._state.camera.cam2world
        if self.tour is not None:
            return self.tour.plan_way(pose, nodes, rest=rest)
        assert graph is not None
        graph = graph if self.loaded is not None else replace(graph, poor=tuple(graph.overlaps))  # only photographs
        return plan_way(graph, pose, nodes, rest=rest)
