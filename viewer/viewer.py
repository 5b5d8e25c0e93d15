"""The viewer without its window: scene, image and panels on any OpenGL context, one frame at a time.

`Viewer` holds the objects of the application and the life of the scene: found, previewed, loaded, entered, refined.
Keys and panels change `state` at once, and queue all other actions, which are done at the end of the frame.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import torch
from imgui_bundle import imgui

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene, empty_gaussians
from pansplat.geometry.path import find_direction
from pansplat.inputs.photographs import write_notes
from pansplat.inputs.web_tours.entries import make_note
from pansplat.system.files import find_scene_suffix, require_replaceable
from pansplat.tours.graph import list_starts
from pansplat.tours.route import find_angles, plan_route
from pansplat_viewer.recorder import Recorder
from pansplat_viewer.scene import camera as cameras
from pansplat_viewer.scene.background import Jobs
from pansplat_viewer.scene.cleaning import CLEANING_JOB, Painting, measure_bounds, remove_floaters, save_cleaned
from pansplat_viewer.scene.doll_house import DollHouseView
from pansplat_viewer.scene.key_frames import read_path, write_path
from pansplat_viewer.scene.library import Library
from pansplat_viewer.scene.loader import Find, LoadedScene, SceneEntry, SceneLoader
from pansplat_viewer.scene.picking import compute_pixel_ray, pick_point
from pansplat_viewer.scene.placing import Placing
from pansplat_viewer.scene.settings import RendererChoice
from pansplat_viewer.scene.slots import keep_largest
from pansplat_viewer.scene.state import ViewerState, advance_flight, advance_path, enter_scene, enter_tour
from pansplat_viewer.scene.tour import DEFAULT_MEMORY, Hotspot, TourScenes, find_clicked, find_hotspots
from pansplat_viewer.ui.panels import Panels
from pansplat_viewer.ui.photographs import find_open_view
from pansplat_viewer.ui.stage import DRAW_ERRORS, Stage, describe_error
from pansplat_viewer.window.gui import Gui
from pansplat_viewer.window.input import apply_input, read_input
from pansplat_viewer.window.preferences import Theme, read_preferences, write_preferences

_MAX_STEP_SECONDS = 0.25  # of camera movement in one frame
_NOTE_COSINE = math.cos(math.radians(5))  # of the angle within which a note is at the middle of the image
_REDUCTION = 4  # a scene that does not fit is offered with this fraction of its Gaussians


class Viewer:
    """The application; tests run it on a context without a window.

    Attributes:
        state: the values that a user can change.
        library: the scenes to choose from.
        loaded: the scene that is shown; None before the first one.
        tour: the scenes of the tour that is shown, or whose photographs are; None for other scenes.
        stage: draws the image.
        jobs: work in the background: films, cleaning, the doll's house.
        doll_house, painting, placing, recorder: what else a user does with the scene.
        hotspots: places of panoramas in the image.
        panels: the panels, with the rectangles of their widgets.
        preferences: the remembered values.
        error: message of the last failure.
        reduced: number of Gaussians that are offered in place of a scene that did not fit; None if there is none.
        frame_ms: time of a whole frame, smoothed.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        loader: SceneLoader,
        *,
        find: Find,
        state: ViewerState | None = None,
        folder: Path = Path("renders"),
        at: float = 0.0,
        dpi_scale: float = 1.0,
        renderer: RendererChoice = "auto",
        memory: float = DEFAULT_MEMORY,
        preferences: Path | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Create GL objects on the current context.

        Args:
            ctx: the context to draw with.
            loader: loads entries; closed with the viewer.
            find: returns the entries of a path that a user opens or drops; called in a worker thread.
            state: the initial state.
            folder: screenshots are written to its subfolder with the entry's name.
            at: fraction of the flight at which a scene is entered.
            dpi_scale: size of the panels.
            renderer: draws the image; `auto` is `cpu` where OpenGL is software.
            memory: limit of the scenes of a tour, GiB.
            preferences: file of the remembered values; None remembers nothing.
            clock: returns seconds.
        """
        self._ctx, self.state = ctx, state or ViewerState()
        self.error: str | None = None
        self.frame_ms = 0.0
        self._at, self._memory, self._clock = at, memory, clock
        self.library = Library(loader, find)
        self.jobs = Jobs(self.show_error)
        self.stage = Stage(ctx, renderer, self.state, self.show_error)
        self.doll_house = DollHouseView(self.state, self.jobs, self.stage)
        self.painting = Painting(self.state, self.show_error)
        self.placing: Placing | None = None
        self.recorder = Recorder(self.state, self.stage, self.jobs, folder, self.show_error)
        self.panels = Panels(ctx)
        self._preferences_file, self.preferences = preferences, read_preferences(preferences)
        self.gui = Gui(dpi_scale, theme=self.preferences.theme, layout=self.preferences.layout)
        self.loaded: LoadedScene | None = None
        self.tour: TourScenes | None = None
        self.hotspots: list[Hotspot] = []
        self._queue: list[Callable[[], object]] = []
        self._incoming: LoadedScene | None = None  # shown when it is prepared
        self._refined: Scene | None = None
        self._too_large: tuple[LoadedScene, int] | None = None  # a scene, and the number of Gaussians to offer
        self._bounds: tuple[Scene, tuple[float, ...]] | None = None  # a scene and its box

    def show_error(self, message: str) -> None:
        """Show a message until the user dismisses it."""
        self.error = message

    def queue(self, action: Callable[..., object], *arguments: object) -> None:
        """Do something at the end of the frame."""
        self._queue.append(partial(action, *arguments))

    # --- what the window and the panels read ---

    @property
    def busy(self) -> bool:
        """Whether the next frame differs without new input."""
        loader, preparer = self.library.loader, self.stage.preparer
        loading = loader.entry is not None or loader.is_searching or self.stage.comparer.photographs.is_reading
        loading = loading or self._incoming is not None or preparer.progress is not None
        placing = self.placing is not None and self.placing.is_busy
        return self.moving or loading or placing or self.jobs.is_busy

    @property
    def moving(self) -> bool:
        """Whether the image is still changing, so that a window draws as often as it can."""
        return self.stage.is_moving(self._clock())

    @property
    def pending(self) -> Future[Any] | None:
        """The image that is drawn in the background, if the window changes only when it is finished."""
        return None if self.stage.is_animated(self._clock()) else self.stage.pending

    @property
    def loading(self) -> tuple[str, str, float] | None:
        """Name, task and fraction done of the search, or of the scene that will be shown; None without them."""
        if self._loads_for_tour and not self.library.loader.is_searching:
            return None
        progress = self.stage.preparer.progress
        if self._incoming is not None and progress is not None:
            count = len(self._incoming.scene.gaussians)
            return self._incoming.entry.name, f"preparing {count:,} Gaussians", progress
        return self.library.loader.progress

    @property
    def refinement(self) -> float | None:
        """Fraction of the refinement that is done; 1 if the refined scene is there, None without a refinement."""
        if self._loads_for_tour:
            return None
        return self.library.loader.refinement if self._refined is None else 1.0

    @property
    def background(self) -> tuple[str, float] | None:
        """Work of the loader on the tour, and the fraction done."""
        loader = self.library.loader
        if not self._loads_for_tour or loader.entry is None:
            return None
        if loader.progress is not None:
            return f"next: {loader.entry.name}", loader.progress[2]
        return f"refining: {loader.entry.name}", loader.refinement or 0.0

    @property
    def _loads_for_tour(self) -> bool:
        """Whether the loader works for the tour that is shown, and not for a scene that the user has chosen."""
        entry = self.library.loader.entry
        if self.tour is None or self.loaded is None:
            return False
        return self._incoming is None if entry is None else self.tour.is_of(entry)

    @property
    def reduced(self) -> int | None:
        """See the attributes of the class."""
        return None if self._too_large is None else self._too_large[1]

    @property
    def right_name(self) -> str | None:
        """What is right of the divider; None if there is nothing."""
        mono = self.state.settings.stereo == "mono"
        return self.stage.comparer.describe(self.state) if self.loaded is not None and mono else None

    @property
    def bounds(self) -> tuple[float, ...] | None:
        """The box of the scene; None for tours, whose scenes are parts, and in the doll's house."""
        scene = self.stage.slot.scene
        if self.loaded is None or self.tour is not None or self.doll_house.house is not None or scene is None:
            return None
        if self._bounds is None or self._bounds[0] is not scene:
            self._bounds = scene, measure_bounds(scene)
        return self._bounds[1]

    @property
    def panoramas(self) -> list[str]:
        """The names of the input cameras of the scene, or their numbers."""
        scene = self.stage.slot.scene
        names = scene.names if scene is not None else ()
        return [names[k] if k < len(names) else str(k + 1) for k in range(len(self.state.context))]

    def _find_hotspots(self) -> list[Hotspot]:
        """The places of panoramas in the image, in points of the window, which may have several pixels."""
        camera, house, fade = self.state.camera, self.doll_house.house, self.stage.fade
        if self.stage.eye_size != self.stage.size:
            return []
        size = imgui.get_io().display_size
        points = int(size.x), int(size.y)
        if house is not None:
            return [] if self.state.glide is not None else house.find_marks(camera, points)
        has_arrived = self.tour is not None and fade.parts[fade.front] == self.tour.part
        return find_hotspots(self.tour, camera, points) if self.tour is not None and has_arrived else []

    # --- frames ---

    def frame(self, target: moderngl.Framebuffer, seconds: float, new_frame: Callable[[], None] | None = None) -> None:
        """Apply the input of a frame of `seconds`, and draw image and panels into the viewport of `target`.

        `new_frame` passes the window's size and pointer to imgui; without it the caller has set imgui's io.
        """
        start, state, stage = time.perf_counter(), self.state, self.stage
        _, _, width, height = target.viewport
        state.now, stage.size = self._clock(), (width, height)
        self._take_loaded()
        self.jobs.poll()
        self.library.watch.look(state.now)
        self._exchange_scene()
        if self.placing is not None:
            self.placing.update()
            self.error, self.placing.error = self.placing.error or self.error, None
        self.gui.begin(seconds, new_frame)
        self.hotspots = self._find_hotspots()
        was_playing = state.playing
        self.panels.draw(self)
        events = read_input(min(seconds, _MAX_STEP_SECONDS))  # so that after a slow frame the camera does not move far
        if self.placing is not None and state.overlay:
            events = self.placing.apply(events)
        apply_input(self, self.painting.apply(events, stage.size))
        step = min(seconds, 2 * _MAX_STEP_SECONDS)
        self.doll_house.update(step)
        self._fly_tour(step, was_playing)
        advance_path(state, step)
        self._update_tour()
        if self.loaded is None and self.tour is None:
            stage.fade_to_photograph(stage.comparer.choose_photograph(state))
        problem = stage.draw(target)
        if problem is not None and self.loaded is not None and self.tour is None:
            self._offer_reduced(self.loaded, problem)
        self.gui.end(self._ctx, target)
        self._save_layout()
        actions, self._queue = self._queue, []
        for action in actions:
            action()
        milliseconds = 1000 * (time.perf_counter() - start)
        self.frame_ms += (milliseconds - self.frame_ms) * (0.15 if self.frame_ms else 1.0)

    def request_quit(self) -> None:
        """Close the viewer, after a question if a mask is not saved."""
        self.painting.leave(lambda: setattr(self.state, "quit", True))

    def close(self) -> None:
        """Stop the threads and free every GL object; the context must still be current."""
        self._save_layout(changed=False)
        self.jobs.close()
        if self.placing is not None:
            self.placing.close()
        self.library.loader.close()
        self.stage.release()
        self.panels.release()
        self.gui.close()

    # --- scenes: search, preview, load, enter, refine ---

    def open(self, path: Path, name: str | None = None) -> None:
        """Look for the scenes at a path and show one; for an invalid path, show an error and keep the scene.

        Args:
            path: a file or folder.
            name: of the entry to show; the first one if there is none of this name.
        """
        self.library.search(path, name)

    def show(self, entries: list[SceneEntry], index: int, path: Path | None = None) -> None:
        """List these entries and load one of them.

        Args:
            entries: to choose from.
            index: of the entry to load.
            path: where they were found, so that a reload finds new ones; None if they are only loaded again.
        """
        self._incoming, self.error = None, None
        self.library.offer(entries, index, path)
        if path is not None:
            self._remember(recent=self.preferences.add_recent(path).recent)
        if self.loaded is None:
            self._preview(entries[index])
        self.library.loader.request(entries[index])

    def expect(self, entries: list[SceneEntry], path: Path, name: str | None) -> None:
        """Show panoramas while their poses are estimated by a search of the loader, which has begun.

        Args:
            entries: the panoramas, none of which is placed.
            path: where they are.
            name: name or number of the entry to show when the search ends; None for the first.
        """
        self.library.expect(path, name)
        self._show_unplaced(entries)

    def _show_unplaced(self, entries: list[SceneEntry]) -> None:
        if self.loaded is None and entries:
            self.library.offer(entries, 0, None)
            self._preview(entries[0])

    def choose(self, index: int) -> None:
        """Show another entry of the list."""
        if index != self.library.current:
            self.painting.leave(partial(self.show, self.library.entries, index, self.library.path))

    def open_text(self, text: str) -> None:
        """Show the scenes at the path that a user has typed."""
        self.painting.leave(partial(self.open, Path(text).expanduser()))

    def reload(self) -> None:
        """Load the entry again."""
        self.painting.leave(self._reload)

    def _reload(self) -> None:
        library, current = self.library, max(self.library.current, 0)
        if library.path is None:
            self.show(library.entries, current)
        else:
            self.open(library.path, library.entries[current].name)

    def cancel_loading(self) -> None:
        """End the search for scenes, else the prediction."""
        loader = self.library.loader
        if not loader.cancel_search():
            loader.cancel()
            self.stage.preparer.stop()
            self._incoming, self.library.current = None, -1
            self.library.restore()

    def dismiss_error(self) -> None:
        """Close the error message, and go on with the scene that is shown."""
        self.error = self._too_large = None
        self.stage.has_failed = False
        self.library.restore()

    def show_reduced(self) -> None:
        """Show the largest Gaussians of the scene that did not fit."""
        if self._too_large is not None:
            loaded, count = self._too_large
            self.error = self._too_large = None
            self.stage.has_failed = False
            self._incoming = replace(loaded, scene=keep_largest(loaded.scene, count))

    def _take_loaded(self) -> None:
        """Show the scene, the entries or the error of a finished load or search, which wait during a question."""
        if self.painting.question is not None:
            return
        is_ready, loader = self.stage.preparer.is_ready, self.library.loader
        if self._incoming is not None and is_ready(self._incoming.scene):
            incoming, self._incoming = self._incoming, None
            self._show_loaded(incoming)
        requested = loader.entry
        result = loader.poll() if self._incoming is None else None
        if isinstance(result, list) and loader.is_searching:
            self._show_unplaced(result)
        elif isinstance(result, list):
            self.show(result, *self.library.choose_found(result))
        elif isinstance(result, LoadedScene):
            loaded = self.loaded
            if loaded is not None and self.tour is not None and self.tour.is_of(result.entry):
                self.tour.add(result)
            elif loaded is not None and loaded.entry is result.entry and result.is_final and not loaded.is_final:
                self._refined = result.scene
            elif is_ready(result.scene):
                self._show_loaded(result)
            else:
                self._incoming = result
        elif result is not None:
            known = isinstance(result, (InputError, OSError))  # else a defect, or out of memory
            self.show_error(str(result) if known else f"{type(result).__name__}: {result}")
            has_failed = requested is not None and loader.entry is None  # else the search
            if has_failed and self.tour is not None and self.tour.is_of(requested):
                self.tour.fail(requested.views)
            self.library.restore()

    def _show_loaded(self, loaded: LoadedScene) -> None:
        """Show a scene, after a question if that ends an unsaved mask."""
        if self.painting.follow(loaded.entry.panoramas) is None:
            self.painting.leave(lambda: self._replace_scene(loaded), otherwise=self.library.restore)
        else:
            self._replace_scene(loaded)

    def _replace_scene(self, loaded: LoadedScene) -> None:
        """Show a scene; if it does not fit into memory, keep the one before and offer the largest Gaussians."""
        error = self.stage.upload(self.stage.slots[0], loaded.scene, loaded.entry.name)
        if error is None:
            self.stage.has_failed = False
            self._enter(loaded)
        else:
            self._offer_reduced(loaded, error)

    def _offer_reduced(self, loaded: LoadedScene, error: Exception) -> None:
        """Offer the largest Gaussians of a scene that does not fit into memory."""
        count = len(loaded.scene.gaussians) // _REDUCTION if isinstance(error, MemoryError) else 0
        self._too_large = (loaded, count) if count else None

    def _exchange_scene(self) -> None:
        """Show the refined scene or the prediction, whichever is chosen, while the camera stands still."""
        stage, loaded, refined = self.stage, self.loaded, self._refined
        if loaded is None or refined is None or self._incoming is not None or stage.outside is not None or self.moving:
            return
        scene = refined if self.state.refined else loaded.scene
        if scene is stage.slot.scene or not stage.preparer.is_ready(scene):
            return
        if stage.upload(stage.slot, scene, loaded.entry.name) is not None:
            self._refined = None

    def _enter(self, loaded: LoadedScene) -> None:
        """Show a scene that is uploaded, and go to its start."""
        stage, state, entry = self.stage, self.state, loaded.entry
        photograph = stage.photograph if self.loaded is None else None
        remaining = self._list_remaining() if self.loaded is None else ()
        self.doll_house.reset()
        self.loaded, self._refined, self.tour = loaded, None, None
        self.library.keep()
        stage.clear()
        stage.comparer.photographs.open(entry.panoramas)
        painted = self.painting.follow(entry.panoramas)
        if painted is None:
            self.painting.stop()
        self.placing = Placing.open(self.placing, entry, self.library.entries)
        if entry.tour is None:
            enter_scene(state, loaded.scene, at=self._at)
        else:
            self._enter_tour(loaded, remaining)
        if painted is not None:
            state.photograph = painted
        tour, part = self.tour, 0 if self.tour is None else self.tour.part
        stage.scene_views = entry.views
        is_here = tour is None or tour.is_inside(np.asarray(state.camera.position), entry.views)
        if photograph is not None:
            stage.fade.show(1 if is_here else 0, photograph, state.now, part)
        if is_here or photograph is None:
            stage.fade.show(0, loaded.scene, state.now, part)
        stage.last_camera = self.state.camera
        state.show_message(f"{entry.name}   (H shows the keys)")

    def _preview(self, entry: SceneEntry) -> None:
        """Show the photographs of an entry until its scene is there; the camera can turn and fly."""
        comparer = self.stage.comparer
        comparer.photographs.open(entry.panoramas)
        self.stage.clear()
        self.tour = None
        source = entry.tour or entry.pair
        if source is None:
            return
        panoramas = entry.panoramas if entry.pair is None else entry.pair.context
        poses = torch.stack([panorama.cam2world for panorama in panoramas])
        starts, frame = list_starts(panoramas), panoramas[0].frame
        scene = Scene(empty_gaussians(), poses, source.near, source.far, starts=starts, frame=frame)
        if entry.tour is None:
            enter_scene(self.state, scene, at=self._at)
        else:
            enter_tour(self.state, entry.tour, scene, plan_route(entry.tour, entry.tour.plan_walk()), at=self._at)
            self.tour = TourScenes(entry.tour)
        nearest = comparer.choose_photograph(self.state)
        if nearest is not None:
            comparer.photographs.wait(nearest)  # else the first frames are black
            self._face_open_view(entry, nearest)
        self.stage.last_camera = self.state.camera

    def _face_open_view(self, entry: SceneEntry, index: int) -> None:
        """Turn the start to a wide view, if the panorama has neither a neighbour to look at nor a start view."""
        panorama, camera = entry.panoramas[index], self.state.camera
        is_alone = len(entry.panoramas) == 1 if entry.tour is None else not entry.tour.neighbours(index)
        if is_alone and panorama.start is None and camera == self.state.home:
            try:
                forward = find_direction(panorama.cam2world, find_open_view(panorama), 0.0).numpy()
            except InputError:  # it is shown when the photograph is
                return
            self.state.camera = self.state.home = cameras.focus_on_point(camera, camera.position + forward)

    # --- tours ---

    def _enter_tour(self, loaded: LoadedScene, remaining: tuple[int, ...]) -> None:
        """Enter a tour; a flight over its photographs goes on through the remaining panoramas."""
        tour, state = loaded.entry.tour, self.state
        assert tour is not None
        self.stage.add_slot()
        self.tour = TourScenes.start(loaded, self._memory)
        enter_tour(state, tour, loaded.scene, plan_route(tour, tour.plan_walk(loaded.entry.start)), at=self._at)
        self.tour.move(np.asarray(state.camera.position))
        if remaining:
            state.route, state.playing = self.tour.plan_route(state.camera.cam2world, remaining), True

    def _list_remaining(self) -> tuple[int, ...]:
        """The panoramas that a flight through a tour still visits; none if there is no flight."""
        route, state = self.state.route, self.state
        return route.walk[route.leg(state.flight) + 1 :] if route is not None and state.playing else ()

    def _update_tour(self) -> None:
        """Show the scene of the camera's place, and load those that are next."""
        tour, state = self.tour, self.state
        if tour is None:
            return
        route = state.route if state.playing else None
        if not state.doll_house:
            tour.move(np.asarray(state.camera.position), route, state.flight)
            self._show_place(tour)
            self.stage.fade.move(state.camera.cam2world, tour.part)
        if self._loads_for_tour:
            loader = self.library.loader
            request = tour.choose_request(tour.list_next(route, state.flight), loader.entry)
            if request is not None:
                loader.request(request)

    def _show_place(self, tour: TourScenes) -> None:
        """Start to fade to the scene of the camera's place; without it, to the nearest photograph.

        Until then another scene stays within its panoramas.
        """
        stage, position = self.stage, np.asarray(self.state.camera.position)
        stage.fade.compute_weight(self.state.now)
        loaded = tour.get(tour.views)
        if loaded is not None and stage.fade_to_scene(loaded, tour.part, can_wait=self._incoming is None):
            return
        shows_scene = stage.photograph is None and stage.fade.parts[stage.fade.front] == tour.part
        if self.loaded is None or not (shows_scene and tour.is_inside(position, stage.scene_views)):
            for end in tour.edge:  # that of the other end is read before it is needed
                stage.comparer.get_photograph(self.state, end)
            stage.fade_to_photograph(tour.find_nearest(position), tour.part)

    def _fly_tour(self, seconds: float, was_playing: bool) -> None:
        """Advance the flight; in a tour from wherever the camera is."""
        state, tour = self.state, self.tour
        if tour is not None and state.route is not None:
            pose = state.camera.cam2world
            if state.target is not None:
                state.route, state.flight, state.playing = tour.plan_way(pose, state.target), 0.0, True
            elif state.playing and not was_playing:
                if state.flight == 0:
                    state.route = tour.plan_route(pose)
                elif not np.allclose(pose, state.route.pose(state.flight), atol=1e-4):
                    state.route = tour.plan_route(pose, state.route.walk[state.route.leg(state.flight) + 1 :])
                    state.flight = 0.0
            state.target = None
            if state.playing:  # photographs are read before they are shown
                leg = state.route.leg(state.flight)
                for node in state.route.walk[leg + 1 : leg + 3]:
                    self.stage.comparer.get_photograph(state, node)
        advance_flight(state, seconds)

    # --- actions of keys and panels ---

    def toggle_doll_house(self) -> None:
        """Fly out of the rooms, or back into them."""
        if self.loaded is not None:
            self.doll_house.toggle(self.tour, self.panoramas)

    def focus_center(self) -> None:
        """Orbit the point in the centre of the last image."""
        distance, camera = self.stage.measure_center_depth(), self.state.camera
        if distance is not None:
            point = np.asarray(camera.position) + distance * camera.rotation[:, 2]
            self.state.camera, self.state.orbiting = cameras.focus_on_point(camera, point), True

    def click(self, place: tuple[float, float]) -> None:
        """Fly to the panorama of the hotspot at a place, or show the point there; fractions of width and height."""
        state, stage, scene = self.state, self.stage, self.stage.slot.scene
        if state.glide is not None:
            return
        if state.hotspots and state.overlay:
            points = imgui.get_io().display_size
            state.target = find_clicked(self.hotspots, (place[0] * points.x, place[1] * points.y))
        if state.target is not None or scene is None or stage.photograph is not None:
            return
        (width, height), size = stage.size, stage.eye_size
        pixel = place[0] * width % size[0], place[1] * height % size[1]
        point = pick_point(scene, *compute_pixel_ray(state.camera, pixel, size), state.settings)
        if point is not None and state.doll_house:
            state.target = point.view
        elif point is None:
            state.points = []
            state.show_message("no Gaussian there")
        else:
            state.points = [*state.points[-1:], point]

    def pin(self) -> None:
        """Keep this image as the right side of a comparison."""
        scene, state = self.stage.slot.scene, self.state
        if not self._has_scene() or scene is None or self.loaded is None:
            return
        name = f"{self.loaded.entry.name}, {state.settings.mode}, {state.settings.display}"
        try:
            self.stage.comparer.pin(scene, state.settings, name)
        except DRAW_ERRORS as error:
            self.show_error(f"not pinned: {describe_error(error)}")
            return
        state.comparison = "pinned"
        state.show_message("pinned; changes show left of the line")

    def write_screenshot(self, suffix: str, panorama: bool = False) -> None:
        """Write the image as PNG, or EXR with depth; or the panorama at the camera."""
        if self._has_scene() and self.loaded is not None:
            self.recorder.write_screenshot(self.loaded, suffix, panorama=panorama)

    def _has_scene(self) -> bool:
        """Whether a scene is shown; while a photograph is, a message says so."""
        if self.loaded is not None and self.stage.photograph is not None:
            self.state.show_message("there is no scene of this place yet")
        return self.loaded is not None and self.stage.photograph is None

    def put_note(self, text: str) -> None:
        """State a note at the middle of the image, in place of one that is there; without a text remove that one."""
        photographs, camera = self.stage.comparer.photographs, self.state.camera
        index = photographs.find_stop(np.asarray(camera.position))
        if index is None or photographs.panoramas[index].links_at is None:
            self.state.show_message("a note is put at a panorama of a folder; open the folder of this one")
            return
        away = photographs.pose(index)[:3, :3].T @ camera.rotation[:, 2]
        kept = photographs.list_notes(index)
        angles = [away @ find_direction(torch.eye(4), note.yaw, note.pitch).numpy() for note in kept]
        kept = tuple(note for note, cosine in zip(kept, angles, strict=True) if cosine < _NOTE_COSINE)
        yaw, pitch = find_angles(away)
        notes = (*kept, make_note((yaw, -pitch), text)) if text.strip() else kept
        with self._showing_errors():
            file = write_notes(photographs.panoramas[index], notes)
            photographs.change_notes(index, notes)
            self.library.watch.skip(file)
            self.state.show_message(f"wrote {file}")

    def save_path(self, text: str) -> None:
        """Write the key frames of the camera path."""
        file = Path(text).expanduser()
        with self._showing_errors():
            if self.loaded is not None:
                require_replaceable("the camera path", [file])
                write_path(self.state.path.map_places(self.loaded.scene.frame.globalize_places), file)
                self.state.show_message(f"wrote {text}")

    def open_path(self, text: str) -> None:
        """Read the key frames of a camera path."""
        with self._showing_errors():
            if self.loaded is not None:
                path = read_path(Path(text).expanduser())
                self.state.path = path.map_places(self.loaded.scene.frame.localize_places)
                self.state.path_seconds, self.state.path_playing = 0.0, False

    def start_film(self) -> None:
        """Write the film of the camera path in the background."""
        with self._showing_errors():
            if self.loaded is not None:
                self.recorder.start_film(self.loaded, self.tour, self.library.loader)

    @contextlib.contextmanager
    def _showing_errors(self) -> Iterator[None]:
        """Show an error of input or of the file system in the block."""
        try:
            yield
        except (InputError, OSError) as error:
            self.show_error(str(error))

    def start_painting(self) -> None:
        """Paint a mask on the photograph of the comparison."""
        comparer = self.stage.comparer
        index = comparer.choose_photograph(self.state)
        if index is not None:
            self.painting.start(comparer.photographs.panoramas, index)

    def remove_floaters(self) -> None:
        """Show the scene without isolated Gaussians."""
        scene = self.stage.slot.scene
        if scene is None:
            return

        def show(result: tuple[Scene | None, str]) -> None:
            cleaned, message = result
            if self.loaded is not None and self.tour is None and self.stage.slot.scene is scene and cleaned is not None:
                self._incoming, self._refined = replace(self.loaded, scene=cleaned, is_final=True), None
            self.state.show_message(message)

        self.jobs.start(CLEANING_JOB, partial(remove_floaters, scene), show, description="looking for floaters")

    def save_scene(self, text: str) -> None:
        """Write the scene without what is hidden to a file."""
        scene, settings, path = self.stage.slot.scene, self.state.settings, Path(text).expanduser()
        if scene is None:
            return
        with self._showing_errors():
            find_scene_suffix(path)
            require_replaceable("the scene", [path])
            work, description = partial(save_cleaned, scene, settings, path), f"writing {path.name}"
            start = partial(self.jobs.start, CLEANING_JOB, work, self.state.show_message, description=description)
            self.painting.leave(start, after_saving=False)

    # --- preferences ---

    def set_theme(self, theme: Theme) -> None:
        """Choose the colours of the panels."""
        self.gui.set_theme(theme)
        self._remember(theme=theme)

    def _save_layout(self, *, changed: bool = True) -> None:
        """Remember the layout of the panels."""
        layout = None if self._preferences_file is None else self.gui.save_layout(changed=changed)
        if layout is not None:
            self._remember(layout=layout)

    def _remember(self, **values: object) -> None:
        preferences = replace(self.preferences, **values)
        if preferences != self.preferences:
            self.preferences = preferences
            write_preferences(preferences, self._preferences_file)
