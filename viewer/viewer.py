"""The viewer without its window: scene, image and panels on any OpenGL context, one frame at a time."""

import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import torch
from imgui_bundle import imgui
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.files import find_scene_suffix, require_replaceable
from pansplat.gaussians.scene import Scene, empty_gaussians
from pansplat.geometry.path import find_direction
from pansplat.geometry.world import USER_FRAME
from pansplat.tours import list_starts, plan_route
from pansplat_viewer.capture import (
    find_free_name,
    open_frames,
    write_path_film,
    write_screenshot,
)
from pansplat_viewer.draw.cpu_renderer import CpuRenderer
from pansplat_viewer.draw.resolution import AdaptiveResolution, ResolutionPlan
from pansplat_viewer.draw.stereo import (
    WindowRenderer,
    choose_format,
    create_window_renderer,
    get_eye_size,
    render_image,
)
from pansplat_viewer.scene import camera as cameras
from pansplat_viewer.scene.background import BackgroundWorker, Report
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.cleaning import Cleaned, Cleaner, MaskPainter, measure_bounds
from pansplat_viewer.scene.doll_house import DollHouse
from pansplat_viewer.scene.key_frames import read_path, write_path
from pansplat_viewer.scene.loader import LoadedScene, Progress, SceneEntry, SceneLoader, list_panoramas
from pansplat_viewer.scene.picking import compute_pixel_ray, pick_point
from pansplat_viewer.scene.placing import Placing
from pansplat_viewer.scene.settings import DrawSettings, RendererChoice
from pansplat_viewer.scene.slots import ScenePreparer, SceneSlot, keep_largest
from pansplat_viewer.scene.state import (
    GLIDE_SECONDS,
    Glide,
    ViewerState,
    adapt_settings,
    advance_flight,
    advance_path,
    enter_scene,
    enter_tour,
    fit_settings,
    leave_doll_house,
)
from pansplat_viewer.scene.tour import DEFAULT_MEMORY, CrossFade, TourScenes, find_clicked, find_hotspots
from pansplat_viewer.ui.compare import Comparer
from pansplat_viewer.ui.panels import PanelData, Panels
from pansplat_viewer.ui.photographs import find_open_view
from pansplat_viewer.ui.presenter import PhotographLayer, Presenter
from pansplat_viewer.window.file_watch import FileWatch
from pansplat_viewer.window.gui import Gui
from pansplat_viewer.window.input import Commands, Input, apply_input, read_input
from pansplat_viewer.window.preferences import read_preferences, write_preferences

PANORAMA_HEIGHT = 1024  # of a panorama screenshot, pixels
_MAX_STEP_SECONDS = 0.25  # of camera movement in one frame
_REDUCTION = 4  # a scene that does not fit is offered with this fraction of its Gaussians


class Viewer:
    """Scene, image and panels; tests run it on a context without a window.

    Attributes:
        state: the values that a user can change.
        panels: the panels, with the rectangles of their widgets.
        panel_data: the data of the panels in the last frame.
        screenshots: files written so far.
        path: where the listed entries were found; None if they are only loaded again.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        loader: SceneLoader,
        *,
        find: Callable[[Path, Progress], list[SceneEntry]],
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
        self.ctx, self.loader, self.state = ctx, loader, state or ViewerState()
        self.panels, self.panel_data = Panels(ctx), PanelData()
        self.entries: list[SceneEntry] = []
        self.screenshots: list[Path] = []
        self._preferences_file = preferences
        values = self.panel_data.preferences = read_preferences(preferences)
        self.gui = Gui(dpi_scale, theme=values.theme, layout=values.layout)
        self._choice, self._memory = renderer, memory
        self._fade = CrossFade()
        self._scene_slot: int = 0  # that of the scene that was shown last, and its panoramas in a tour
        self._scene_views: tuple[int, ...] = ()
        self._doll_house: tuple[DollHouse, SceneSlot, Camera] | None = None  # with the first camera
        self._slots = [SceneSlot(create_window_renderer(ctx, renderer))]
        self._preparer = ScenePreparer(self.renderer.prepare)
        self._incoming: LoadedScene | None = None  # shown when it is prepared
        self.presenter = Presenter(ctx)
        self._comparer = Comparer(ctx, lambda: create_window_renderer(ctx, renderer))
        self.path: Path | None = None
        self._searched: tuple[Path, str | None] = Path(), None  # path, and the entry to show of those found there
        self._too_large: LoadedScene | None = None
        self._draw_failed = False
        self._watch = FileWatch()
        self._find, self._folder, self._at, self._clock = find, folder, at, clock
        self._resolution = self._create_resolution()
        self._loaded: LoadedScene | None = None
        # Entries when the scene was loaded, its place among them, and their path.
        self._shown: tuple[list[SceneEntry], int, Path | None] | None = None
        self._refined: Scene | None = None
        self._films: BackgroundWorker[list[Path]] = BackgroundWorker("film-writer")
        self._tour: TourScenes | None = None
        self._layers = [PhotographLayer(self.presenter), PhotographLayer(self.presenter)]  # of the fade's photographs
        self._placing: Placing | None = None
        self._cleaner = Cleaner()
        self._painter: MaskPainter | None = None
        self._held: tuple[Callable[[], None], bool, Callable[[], None]] | None = None  # see `_leave_mask`
        self._bounds: tuple[Scene, tuple[float, ...]] | None = None  # a scene and its box
        self._doll_houses: BackgroundWorker[DollHouse | None] = BackgroundWorker("doll-house")
        self._inside = self.state.camera  # before the doll's house
        self._last_camera = self.state.camera

    @property
    def renderer(self) -> WindowRenderer:
        """The renderer of the scene that is shown, or that was shown before a photograph."""
        return self._slot.renderer

    def _create_resolution(self) -> AdaptiveResolution:
        return AdaptiveResolution(
            settle_after=self.renderer.pacing.settle_seconds, turn_ms=self.renderer.pacing.turn_ms
        )

    @property
    def _slot(self) -> SceneSlot:
        return self._slots[self._scene_slot] if self._doll_house is None else self._doll_house[1]

    @property
    def _shows_photograph(self) -> bool:
        """Whether a photograph is shown, because there is no scene of the camera's place yet."""
        return self._doll_house is None and isinstance(self._fade.contents[self._fade.front], int)

    @property
    def busy(self) -> bool:
        """Whether the next frame differs without new input."""
        loading = self.loader.entry is not None or self.loader.is_searching or self._comparer.photographs.is_reading
        loading = loading or self._incoming is not None or self._preparer.progress is not None
        loading = loading or (self._placing is not None and self._placing.is_busy)
        working = self._films.future is not None or self._doll_houses.future is not None
        return self.moving or loading or working or self._cleaner.progress is not None

    @property
    def moving(self) -> bool:
        """Whether the image is still changing, so that a window draws as often as it can."""
        recently = self._clock() - self._resolution.last_motion < 2 * self._resolution.settle_after
        unsettled = any(slot.scene is not None and not slot.renderer.stats.settled for slot in self._shown_slots)
        return self._is_animated or recently or (unsettled and not self._draw_failed)

    @property
    def pending(self) -> Future[Any] | None:
        """The image that is drawn in the background, if the window changes only when it is finished."""
        if self._is_animated:
            return None
        return next((slot.renderer.pending for slot in self._shown_slots if slot.renderer.pending is not None), None)

    @property
    def _shown_slots(self) -> list[SceneSlot]:
        slots = [] if self._shows_photograph else [self._slot]
        return slots if self._comparer.pinned is None else [*slots, self._comparer.pinned.slot]

    @property
    def _is_animated(self) -> bool:
        fading = self._fade.compute_weight(self._clock()) < 1
        return fading or self.state.path_playing or self.state.playing or self.state.glide is not None

    def open(self, path: Path, name: str | None = None) -> None:
        """Look for the scenes at a path and show one; for an invalid path, show an error and keep the scene.

        Args:
            path: a file or folder.
            name: of the entry to show; the first one if there is none of this name.
        """
        self._searched = path, name
        self.loader.search(path, self._find)

    def show(self, entries: list[SceneEntry], index: int, path: Path | None = None) -> None:
        """List these entries and load one of them.

        Args:
            entries: to choose from.
            index: of the entry to load.
            path: where they were found, so that a reload finds new ones; None if they are only loaded again.
        """
        self._incoming, self.panel_data.error = None, None
        self._list_entries(entries, index, path)
        if path is not None:
            self._write_preferences(recent=self.panel_data.preferences.add_recent(path).recent)
        if self._loaded is None:
            self._preview(entries[index])
        self.loader.request(entries[index])

    def _list_entries(self, entries: list[SceneEntry], index: int, path: Path | None) -> None:
        self.entries, self.path = entries, path
        self.panel_data.entries, self.panel_data.current = [entry.name for entry in entries], index
        self._watch.start(entries[index].files)

    def frame(self, target: moderngl.Framebuffer, seconds: float, new_frame: Callable[[], None] | None = None) -> None:
        """Apply the input of a frame of `seconds`, and draw image and panels into the viewport of `target`.

        `new_frame` passes the window's size and pointer to imgui; without it the caller has set imgui's io.
        """
        start = time.perf_counter()
        now, size = self._clock(), target.viewport[2:]
        self._take_loaded(now)
        self._take_film(now)
        self._take_cleaned(now)
        self._take_doll_house(size, now)
        self._watch.look(now)
        self._exchange_scene()
        self.gui.begin(seconds, new_frame)
        self._update_panel_data(size)
        was_playing = self.state.playing
        panel_commands = self.panels.draw(self.state, self.panel_data, now)
        # The step is limited, so that after a slow frame the camera does not move far.
        events = self._paint(self._leave_placing(read_input(min(seconds, _MAX_STEP_SECONDS))), size)
        key_commands = apply_input(self.state, events)
        if self.state.quit:
            self.state.quit = False
            self.request_quit()
        self._update_doll_house(min(seconds, 2 * _MAX_STEP_SECONDS))
        self._fly_tour(min(seconds, 2 * _MAX_STEP_SECONDS), was_playing)
        advance_path(self.state, min(seconds, 2 * _MAX_STEP_SECONDS))
        self._update_tour(now)
        if self._loaded is None and self._tour is None:
            self._show_photograph(self._comparer.choose_photograph(self.state), now)
        if key_commands.focus:
            self._focus_center()
        if key_commands.pick is not None:
            self._pick(key_commands.pick, size, now)
        self._try_to_draw(size, target, now)
        self.gui.end(self.ctx, target)
        self._save_layout()
        for commands in (panel_commands, key_commands):
            self._execute(commands, size, now)
        milliseconds = 1000 * (time.perf_counter() - start)
        data = self.panel_data
        data.frame_ms += (milliseconds - data.frame_ms) * (0.15 if data.frame_ms else 1.0)

    def request_quit(self) -> None:
        """Close the viewer, after a question if a mask is not saved."""
        self._leave_mask(lambda: setattr(self.state, "quit", True))

    def close(self) -> None:
        """Stop the threads and free every GL object; the context must still be current."""
        self._save_layout(changed=False)
        self._films.close()
        self._cleaner.close()
        self._doll_houses.close()
        self._close_doll_house()
        if self._placing is not None:
            self._placing.close()
        self.loader.close()
        self._preparer.close()
        for layer in self._layers:
            layer.release()
        self.presenter.release()
        self._comparer.release()
        self.panels.release()
        for slot in self._slots:
            slot.renderer.release()
        self.gui.close()

    def _take_loaded(self, now: float) -> None:
        """Show the scene, the entries or the error of a finished load or search, which wait during a question."""
        if self._held is not None:
            return
        if self._incoming is not None and self._preparer.is_ready(self._incoming.scene):
            incoming, self._incoming = self._incoming, None
            self._show_loaded(incoming, now)
        requested = self.loader.entry
        result = self.loader.poll() if self._incoming is None else None
        if isinstance(result, list):
            path, wanted = self._searched
            names = [entry.name for entry in result]
            self.show(result, names.index(wanted) if wanted in names else 0, path)
        elif isinstance(result, LoadedScene):
            loaded = self._loaded
            if loaded is not None and self._tour is not None and result.entry.tour is self._tour.tour:
                self._tour.add(result)
            elif loaded is not None and loaded.entry is result.entry and result.is_final and not loaded.is_final:
                self._refined = result.scene
            elif self._preparer.is_ready(result.scene):
                self._show_loaded(result, now)
            else:
                self._incoming = result
        elif result is not None:
            known = isinstance(result, (InputError, OSError))  # else a defect, or out of memory
            self.panel_data.error = str(result) if known else f"{type(result).__name__}: {result}"
            has_failed = requested is not None and self.loader.entry is None  # else the search
            if has_failed and self._tour is not None and requested.tour is self._tour.tour:
                self._tour.fail(requested.views)
            self._list_shown()

    def _list_shown(self) -> None:
        """List the scene that is shown again, after another one was not loaded."""
        if self._shown is not None:
            self._list_entries(*self._shown)

    def _show_loaded(self, loaded: LoadedScene, now: float) -> None:
        """Show a scene, after a question if that ends an unsaved mask."""
        if self._find_painted(loaded.entry) is None:
            self._leave_mask(lambda: self._replace_scene(loaded, now), otherwise=self._list_shown)
        else:
            self._replace_scene(loaded, now)

    def _replace_scene(self, loaded: LoadedScene, now: float) -> None:
        """Show a scene; if it does not fit into memory, keep the one before and offer the largest Gaussians."""
        error = self._upload(self._slots[0], loaded.scene, loaded.entry)
        if error is None:
            self._draw_failed = False
            self._enter(loaded, now)
        else:
            self._offer_reduced(loaded, error)

    def _offer_reduced(self, loaded: LoadedScene, error: Exception) -> None:
        """Offer the largest Gaussians of a scene that does not fit into memory."""
        count = len(loaded.scene.gaussians) // _REDUCTION if isinstance(error, MemoryError) else 0
        self._too_large, self.panel_data.reduced = (loaded, count) if count else (None, None)

    def _upload(self, slot: SceneSlot, scene: Scene, entry: SceneEntry) -> Exception | None:
        """Upload a scene; if this fails, shows the error and returns it."""
        try:
            slot.upload(scene, self._preparer.take(scene))
        except (InputError, MemoryError, moderngl.Error) as error:
            self.panel_data.error = f"{entry.name}: {_describe(error)}"
            return error
        return None

    def _exchange_scene(self) -> None:
        """Show the refined scene or the prediction, whichever is chosen, while the camera stands still."""
        if self._loaded is None or self._refined is None or self._incoming is not None or self.moving:
            return
        if self._doll_house is not None:
            return
        scene = self._refined if self.state.refined else self._loaded.scene
        if scene is self._slot.scene or not self._preparer.is_ready(scene):
            return
        if self._upload(self._slot, scene, self._loaded.entry) is not None:
            self._refined = None

    def _enter(self, loaded: LoadedScene, now: float) -> None:
        photograph = self._fade.contents[self._fade.front] if self._loaded is None else None
        remaining = self._list_remaining() if self._loaded is None else ()
        if self._doll_house is not None:
            self.state.camera = self._inside
        self._close_doll_house()
        self._loaded, self._refined, self._tour = loaded, None, None
        self._shown = self.entries, self.panel_data.current, self.path
        self._resolution = self._create_resolution()
        self._fade.clear()
        self._comparer.photographs.open(loaded.entry.panoramas)
        painted = self._find_painted(loaded.entry)
        if painted is None:
            self._stop_painting()
        self._open_placing(loaded.entry)
        if loaded.entry.tour is None:
            enter_scene(self.state, loaded.scene, at=self._at)
        else:
            self._enter_tour(loaded, remaining)
        if painted is not None and self._painter is not None:
            self._painter.move(loaded.entry.panoramas[painted])
            self.state.photograph = painted
        tour, part = self._tour, 0 if self._tour is None else self._tour.part
        self._scene_slot, self._scene_views = 0, loaded.entry.views
        is_here = tour is None or tour.is_inside(np.asarray(self.state.camera.position), self._scene_views)
        if isinstance(photograph, int):
            self._fade.show(1 if is_here else 0, photograph, now, part)
        if is_here or photograph is None:
            self._fade.show(0, loaded.scene, now, part)
        self._last_camera = self.state.camera
        self.state.show_message(f"{loaded.entry.name}   (H shows the keys)", now)

    # --- poses by hand ---

    def _open_placing(self, entry: SceneEntry) -> None:
        """The photographs of the folder of an entry, whose poses the panel shows."""
        source = entry.tour or entry.pair
        panoramas = [] if source is None or entry.merged is not None else list_panoramas(self.entries, source.folder)
        if self._placing is not None:
            if source is not None and self._placing.is_of(source.folder, panoramas):
                self._placing.reopen(panoramas)
                return
            self._placing.close()
        self._placing = Placing(source.folder, panoramas) if source is not None and panoramas else None

    def _update_placing(self) -> None:
        placing = self._placing
        if placing is not None:
            placing.update()
            if placing.error is not None:
                self.panel_data.error, placing.error = placing.error, None
        self.panel_data.placing = placing

    def _leave_placing(self, events: Input) -> Input:
        """The input without the keys of the window in which a photograph is placed; Escape closes it."""
        placing = self._placing
        if placing is None or placing.node is None or not self.state.overlay:
            return events
        if "escape" in events.pressed:
            placing.stop()
        return replace(events, pressed=events.pressed - {",", ".", "escape"})

    # --- clean up ---

    def _paint(self, events: Input, size: tuple[int, int]) -> Input:
        """Paint what is to be hidden with the left button, and return the other input: the right one looks around."""
        painter = self._painter
        if painter is None:
            return events
        if events.pointer is None:
            painter.lift()
        else:
            pixel = events.pointer[0] * size[0], events.pointer[1] * size[1]
            direction = compute_pixel_ray(self.state.camera, pixel, size)[1]
            painter.paint(direction, math.radians(self.state.brush_degrees), erase="shift" in events.held)
        pressed = events.pressed - {"escape"}
        if pressed != events.pressed:
            self._leave_mask(self._stop_painting)
        return replace(events, pressed=pressed, drag=events.pan, pan=(0.0, 0.0), click=None, pointer=None)

    def _start_painting(self) -> None:
        """Paint on the photograph of the comparison, which fills the window."""
        index = self._comparer.choose_photograph(self.state)
        if index is None:
            return
        try:
            self._painter = MaskPainter(self._comparer.photographs.panoramas[index])
        except InputError as error:
            self.panel_data.error = str(error)
            return
        state = self.state
        state.playing = state.path_playing = False
        state.photograph, state.comparison, state.split = index, "photograph", 0.0
        state.settings = replace(state.settings, stereo="mono")

    def _stop_painting(self) -> None:
        self._held = None
        if self._painter is not None:
            self._painter = None
            self.state.photograph, self.state.comparison, self.state.split = None, "off", ViewerState().split

    def _find_painted(self, entry: SceneEntry) -> int | None:
        """The place of the photograph that is painted on among those of an entry, which may have been loaded again."""
        image = None if self._painter is None else self._painter.panorama.image
        return next((n for n, view in enumerate(entry.panoramas) if view.image == image), None)

    def _leave_mask(
        self, action: Callable[[], None], *, after_saving: bool = True, otherwise: Callable[[], None] = lambda: None
    ) -> None:
        """Do what drops a mask, or writes a scene without it; if the mask is not saved, ask first.

        The action is done after the answer to drop the mask, or with `after_saving` to save it; else `otherwise` is.
        """
        if self._painter is not None and self._painter.is_changed:
            self._held = action, after_saving, otherwise
        else:
            action()

    def _save_mask(self, now: float) -> bool:
        """Write the mask that is painted; returns whether that was possible."""
        assert self._painter is not None
        try:
            self.state.show_message(f"wrote {self._painter.save()}; Reload predicts the scene again", now)
        except (InputError, OSError) as error:
            self.panel_data.error = str(error)
        return not self._painter.is_changed

    def _execute_cleaning(self, commands: Commands, now: float) -> None:
        scene, painter = self._slot.scene, self._painter
        if commands.paint:
            self._start_painting()
        elif commands.paint is not None:
            self._leave_mask(self._stop_painting)
        if painter is not None and commands.clear_mask:
            painter.clear()
        if painter is not None and commands.save_mask:
            self._save_mask(now)
        if scene is None:
            return
        if commands.remove_floaters:
            self._cleaner.remove_floaters(scene)
        elif commands.save_scene is not None:
            path = Path(commands.save_scene).expanduser()
            try:
                find_scene_suffix(path)
                require_replaceable("the scene", [path])
            except InputError as error:
                self.panel_data.error = str(error)
            else:
                settings = self.state.settings
                self._leave_mask(lambda: self._cleaner.save(scene, settings, path), after_saving=False)

    def _take_cleaned(self, now: float) -> None:
        """Show the scene without floaters, or report the file that is written, or the error."""
        result = self._cleaner.poll()
        if isinstance(result, Cleaned):
            loaded, is_shown = self._loaded, self._tour is None and self._slot.scene is result.given
            if loaded is not None and is_shown and result.scene is not None:
                self._incoming, self._refined = replace(loaded, scene=result.scene, is_final=True), None
            self.state.show_message(result.message, now)
        elif result is not None:
            self.panel_data.error = str(result)

    def _measure_bounds(self) -> tuple[float, ...] | None:
        """The box of the scene; None for tours, whose scenes are parts, and in the doll's house."""
        scene = self._slot.scene
        if self._loaded is None or self._tour is not None or self._doll_house is not None or scene is None:
            return None
        if self._bounds is None or self._bounds[0] is not scene:
            self._bounds = scene, measure_bounds(scene)
        return self._bounds[1]

    # --- tours ---

    def _enter_tour(self, loaded: LoadedScene, remaining: tuple[int, ...]) -> None:
        """Enter a tour; a flight over its photographs goes on through the remaining panoramas."""
        tour, state = loaded.entry.tour, self.state
        assert tour is not None
        if len(self._slots) == 1:
            self._slots.append(SceneSlot(create_window_renderer(self.ctx, self._choice)))
        self._tour = TourScenes.start(loaded, self._memory)
        enter_tour(state, tour, loaded.scene, plan_route(tour, tour.plan_walk(loaded.entry.start)), at=self._at)
        self._tour.move(np.asarray(state.camera.position))
        if remaining:
            state.route, state.playing = self._tour.plan_route(state.camera.cam2world, remaining), True

    def _list_remaining(self) -> tuple[int, ...]:
        """The panoramas that a flight through a tour still visits; none if there is no flight."""
        route, state = self.state.route, self.state
        return route.walk[route.leg(state.flight) + 1 :] if route is not None and state.playing else ()

    def _update_tour(self, now: float) -> None:
        """Show the scene of the camera's place, and load those that are next."""
        tour, state = self._tour, self.state
        if tour is None:
            return
        route = state.route if state.playing else None
        if not state.doll_house:
            tour.move(np.asarray(state.camera.position), route, state.flight)
            self._show_place(tour, now)
            self._fade.move(state.camera.cam2world, tour.part)
        if self._loaded is None or self._is_other_requested():
            return
        request = tour.choose_request(tour.list_next(route, state.flight), self.loader.entry)
        if request is not None:
            self.loader.request(request)

    def _show_place(self, tour: TourScenes, now: float) -> None:
        """Start to fade to the scene of the camera's place; without it, to the nearest photograph.

        Until then another scene stays within its panoramas.
        """
        self._fade.compute_weight(now)
        front, loaded, position = self._fade.front, tour.get(tour.views), np.asarray(self.state.camera.position)
        if loaded is not None and self._show_tour_scene(loaded, now, tour.part):
            return
        shows_scene = not self._shows_photograph and self._fade.parts[front] == tour.part
        if self._loaded is None or not (shows_scene and tour.is_inside(position, self._scene_views)):
            for end in tour.edge:  # that of the other end is read before it is needed
                self._comparer.get_photograph(self.state, end)
            self._show_photograph(tour.find_nearest(position), now, tour.part)

    def _show_tour_scene(self, loaded: LoadedScene, now: float, part: int) -> bool:
        """Start to fade to a scene; returns False if it is not prepared."""
        slot = self._fade.choose_slot(loaded.scene)
        if slot is None:  # it is shown, or a fade goes on
            return True
        if self._slots[slot].scene is not loaded.scene:
            ready = self._incoming is None and self._preparer.is_ready(loaded.scene)
            if not ready or self._upload(self._slots[slot], loaded.scene, loaded.entry) is not None:
                return False
        self._fade.show(slot, loaded.scene, now, part)
        self._scene_slot, self._scene_views = slot, loaded.entry.views
        adapt_settings(self.state, loaded.scene)
        self.state.points = []
        return True

    def _show_photograph(self, index: int | None, now: float, part: int = 0) -> None:
        """Start to fade to a photograph; what is shown stays while it is read."""
        self._fade.compute_weight(now)
        slot = None if index is None else self._fade.choose_slot(index)
        if index is not None and slot is not None and self._comparer.get_photograph(self.state, index) is not None:
            self._fade.show(slot, index, now, part)

    def _is_other_requested(self) -> bool:
        """Whether a scene that is not of this tour, which the user has chosen, is loaded or prepared."""
        entry = self.loader.entry
        if entry is None:
            return self._incoming is not None
        return self._tour is None or entry.tour is not self._tour.tour

    def _fly_tour(self, seconds: float, was_playing: bool) -> None:
        """Advance the flight; in a tour from wherever the camera is."""
        state, tour = self.state, self._tour
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
        advance_flight(state, seconds)

    def _visit(self, place: tuple[float, float]) -> bool:
        """Fly to the panorama whose hotspot is at a place of the window; returns whether there is one."""
        if not (self.state.hotspots and self.state.overlay) or self.state.glide is not None:
            return False
        size = imgui.get_io().display_size
        self.state.target = find_clicked(self.panel_data.hotspots, (place[0] * size.x, place[1] * size.y))
        return self.state.target is not None

    # --- the doll's house ---

    def _toggle_doll_house(self, now: float) -> None:
        """Make the doll's house of the part and the storey of the camera, or fly back into it."""
        state, loaded = self.state, self._loaded
        if self._doll_houses.cancel() or loaded is None or state.glide is not None:
            return
        node = self._find_nearest_panorama(self._inside if self._doll_house else state.camera)
        if self._doll_house is not None:
            state.target = node
        elif node is None:
            state.show_message("there are no panoramas", now)
        else:
            labels, tour = self._name_panoramas(), self._tour
            if tour is not None:
                labels = [panorama.label for panorama in tour.tour.panoramas]
            scene = self._slot.scene
            gather = None if tour is None else tour.gather_part()

            def make(report: Report) -> DollHouse | None:
                gathered = scene if gather is None else gather()
                assert gathered is not None
                report()
                return DollHouse.make(gathered, labels, node)

            self._doll_houses.start(make)

    def _find_nearest_panorama(self, camera: Camera) -> int | None:
        """The panorama nearest to a camera, in a tour one of the edge at the camera; None if there is none."""
        if self._tour is not None:
            return self._tour.find_nearest(np.asarray(camera.position))
        distances = np.linalg.norm(self.state.context[:, :3, 3] - camera.position, axis=1)
        return int(distances.argmin()) if len(distances) else None

    def _take_doll_house(self, size: tuple[int, int], now: float) -> None:
        """Show the doll's house that was made, and fly out of the rooms."""
        made = self._doll_houses.future
        is_done = made is not None and made.done()
        found = self._doll_houses.poll()
        if not is_done or self._loaded is None:
            return
        if not isinstance(found, DollHouse):
            self.state.show_message("no room is known here" if found is None else f"no doll's house: {found}", now)
            return
        state, slot = self.state, SceneSlot(create_window_renderer(self.ctx, self._choice))
        if self._upload(slot, found.scene, self._loaded.entry) is not None:
            slot.renderer.release()
            return
        first = found.frame(state.camera, get_eye_size(size, state.settings.stereo))
        self._doll_house, self._inside = (found, slot, first), state.camera
        state.playing = state.path_playing = False
        state.doll_house, state.glide, state.points = True, Glide(state.camera, first, is_entry=False), []
        self._resolution = self._create_resolution()

    def _update_doll_house(self, seconds: float) -> None:
        """Move the camera outside of the rooms, and back into the panorama that is chosen."""
        if self._doll_house is None:
            return
        state, (house, _, first) = self.state, self._doll_house
        if state.doll_house and state.target is not None:
            if state.target in house.nodes:
                end = house.enter(state.camera, state.target, self._inside)
                state.glide, state.target = Glide(state.camera, end, is_entry=True), None
            else:  # of another part or storey
                state.camera = self._inside
                leave_doll_house(state)
        if state.glide is not None:
            state.glide = replace(state.glide, seconds=state.glide.seconds + seconds)
            state.camera = state.glide.camera
            if state.glide.seconds >= GLIDE_SECONDS:
                if state.glide.is_entry:
                    leave_doll_house(state)
                state.glide = None
        elif state.doll_house:
            state.camera = house.limit(state.camera, first)
        if not state.doll_house:
            self._close_doll_house()

    def _close_doll_house(self) -> None:
        if self._doll_house is not None:
            self._doll_house[1].renderer.release()
            self._doll_house = None
            self._resolution = self._create_resolution()

    # --- frames ---

    def _update_panel_data(self, size: tuple[int, int]) -> None:
        data, comparer = self.panel_data, self._comparer
        data.stats, data.loading = self.renderer.stats, self.loader.progress
        if self._incoming is not None and self._preparer.progress is not None:
            count, done = len(self._incoming.scene.gaussians), self._preparer.progress
            data.loading = self._incoming.entry.name, f"preparing {count:,} Gaussians", done
        data.refinement = self.loader.refinement if self._refined is None else 1.0
        data.notes = self.entries[data.current].notes if 0 <= data.current < len(self.entries) else ()
        data.changed, data.photographs, data.pinned = (
            self._watch.changed,
            comparer.photographs.names,
            comparer.pinned is not None,
        )
        mono = self.state.settings.stereo == "mono"
        data.right_name = comparer.describe(self.state) if self._loaded and mono else None
        data.photograph_distance = comparer.measure_distance(self.state)
        if comparer.error is not None:
            data.error, comparer.error = comparer.error, None
        data.panoramas = self._name_panoramas()
        data.unsaved = None if self._held is None or self._painter is None else self._painter.panorama.label
        data.bounds, data.painter, data.cleaning = self._measure_bounds(), self._painter, self._cleaner.progress
        film = self._films.progress
        data.tour, data.film = self._tour, None if film is None else film[1]
        data.hotspots = []
        self._update_placing()
        knows_rooms = self._loaded is not None and len(self.state.context) > 0
        is_making = self._doll_houses.future is not None
        data.doll_house = (self._doll_house is not None or is_making) if knows_rooms else None
        if self._doll_house is not None and get_eye_size(size, self.state.settings.stereo) == size:
            points = imgui.get_io().display_size
            if self.state.glide is None:
                data.hotspots = self._doll_house[0].find_marks(self.state.camera, (int(points.x), int(points.y)))
        elif self._tour is not None:
            has_arrived = self._fade.parts[self._fade.front] == self._tour.part
            if has_arrived and get_eye_size(size, self.state.settings.stereo) == size:
                # Panels are drawn in points of the window, of which a screen of high resolution has fewer than pixels.
                points = imgui.get_io().display_size
                data.hotspots = find_hotspots(self._tour, self.state.camera, (int(points.x), int(points.y)))
            data.background = None
            if self._loaded is not None and not self._is_other_requested():
                data.background, data.loading, data.refinement = self._describe_loading(), None, None

    def _name_panoramas(self) -> list[str]:
        """The names of the input cameras of the scene, or their numbers."""
        names = self._slot.scene.names if self._slot.scene is not None else ()
        return [names[k] if k < len(names) else str(k + 1) for k in range(len(self.state.context))]

    def _describe_loading(self) -> tuple[str, float] | None:
        """The work of the loader on a tour, and the fraction done."""
        entry, progress, refinement = self.loader.entry, self.loader.progress, self.loader.refinement
        if entry is None:
            return None
        if progress is not None:
            return f"next: {entry.name}", progress[2]
        return f"refining: {entry.name}", refinement or 0.0

    def _preview(self, entry: SceneEntry) -> None:
        """Show the photographs of an entry until its scene is there; the camera can turn and fly."""
        self._comparer.photographs.open(entry.panoramas)
        self._fade.clear()
        self._tour = None
        source = entry.tour or entry.pair
        if source is not None:
            panoramas = entry.panoramas if entry.pair is None else entry.pair.context
            poses = torch.stack([panorama.cam2world for panorama in panoramas])
            starts, frame = list_starts(panoramas), panoramas[0].frame
            scene = Scene(empty_gaussians(), poses, source.near, source.far, starts=starts, frame=frame)
            if entry.tour is None:
                enter_scene(self.state, scene, at=self._at)
            else:
                enter_tour(self.state, entry.tour, scene, plan_route(entry.tour, entry.tour.plan_walk()), at=self._at)
                self._tour = TourScenes(entry.tour)
            nearest = self._comparer.choose_photograph(self.state)
            if nearest is not None:
                self._comparer.photographs.wait(nearest)  # else the first frames are black
                self._face_open_view(entry, nearest)
            self._last_camera = self.state.camera

    def _face_open_view(self, entry: SceneEntry, index: int) -> None:
        """Turn the start to a wide view, if the panorama has neither a neighbour to look at nor a start view."""
        panorama = self._comparer.photographs.panoramas[index]
        is_alone = len(entry.panoramas) == 1 if entry.tour is None else not entry.tour.neighbours(index)
        if is_alone and panorama.start is None and self.state.camera == self.state.home:
            try:
                forward = find_direction(panorama.cam2world, find_open_view(panorama), 0.0).numpy()
            except InputError:  # it is shown when the photograph is
                return
            camera = self.state.camera
            self.state.camera = self.state.home = cameras.focus_on_point(camera, camera.position + forward)

    def _draw_photograph(self, target: moderngl.Framebuffer) -> None:
        """Draw the nearest photograph, at an infinite distance around its camera, or the background."""
        photograph = self._comparer.get_photograph(self.state)
        if photograph is None:
            target.use()
            self.ctx.clear(*self.state.settings.background)
        else:
            self.presenter.draw_photograph(photograph, target, self.state.camera)

    def _plan_resolution(self, size: tuple[int, int], now: float) -> ResolutionPlan:
        """The plan of the frame, from the movement since the last one."""
        camera = self.state.camera
        moved = camera.position != self._last_camera.position
        turned = not moved and camera != self._last_camera
        self._last_camera = camera
        self._resolution.limit(size, self.renderer.pacing.min_size)
        return self._resolution.plan(now, moved=moved, turned=turned, adaptive=self.state.adaptive)

    def _try_to_draw(self, size: tuple[int, int], target: moderngl.Framebuffer, now: float) -> None:
        """Draw the image. If this fails, show an error, and try again when it is dismissed."""
        if not self._draw_failed:
            try:
                self._draw_image(size, target, now)
                return
            except (InputError, MemoryError, moderngl.Error) as error:
                self._draw_failed, self._slot.image = True, None
                self.panel_data.error = _describe(error)
                if self._loaded is not None and self._tour is None:
                    self._offer_reduced(self._loaded, error)
        target.use()
        self.ctx.clear(*self.state.settings.background)

    def _draw_image(self, size: tuple[int, int], target: moderngl.Framebuffer, now: float) -> None:
        camera, plan = self.state.camera, self._plan_resolution(size, now)
        if self._doll_house is not None:
            self._draw_doll_house(self._doll_house[1], size, target, plan)
            return
        weight, front = self._fade.compute_weight(now), self._fade.front
        image, milliseconds = self._draw_content(front, size, plan)
        fading = None
        if weight < 1:
            fading, more = self._draw_content(1 - front, size, plan)
            milliseconds += more
        self._record_time(plan, milliseconds)
        if image is None:  # the first one of a large scene is not finished
            image, fading = fading, None
        if image is None:
            self._draw_photograph(target)
            return
        self.panel_data.size = size if self._shows_photograph else self.renderer.stats.size
        settings, pose = self.state.draw_settings, camera.cam2world

        def draw_pinned(slot: SceneSlot, settings: DrawSettings) -> moderngl.Texture | None:
            self._render(slot, pose, size, settings, plan)
            return slot.image

        mono = settings.stereo == "mono"
        right = self._comparer.get_right_side(self.state, draw_pinned) if mono else None
        self.presenter.draw(image, target, camera, right=right, fading=fading, weight=weight)

    def _record_time(self, plan: ResolutionPlan, milliseconds: float) -> None:
        if milliseconds > 0:  # else the image is not new, or not finished
            timed = self.renderer.stats.timed
            timed_plan = plan if timed is None else ResolutionPlan(timed.scale, cached=timed.cached)
            self._resolution.record(timed_plan, milliseconds)

    def _draw_doll_house(
        self, slot: SceneSlot, size: tuple[int, int], target: moderngl.Framebuffer, plan: ResolutionPlan
    ) -> None:
        camera = self.state.camera
        milliseconds = self._render(slot, camera.cam2world, size, self.state.draw_settings, plan)
        self._record_time(plan, milliseconds)
        self.panel_data.size = slot.renderer.stats.size
        if slot.image is None:
            target.use()
            self.ctx.clear(*self.state.settings.background)
        else:
            self.presenter.draw(slot.image, target, camera)

    def _draw_content(
        self, slot: int, size: tuple[int, int], plan: ResolutionPlan
    ) -> tuple[moderngl.Texture | None, float]:
        """The image of a slot of the fade, None if there is none yet, and the milliseconds of drawing a new one."""
        content, camera, pose = self._fade.contents[slot], self.state.camera, self._fade.poses[slot]
        if pose is None or self._tour is None:
            pose = camera.cam2world
        if isinstance(content, int):
            photograph = self._comparer.get_photograph(self.state, content)
            if photograph is None:
                return None, 0.0
            return self._layers[slot].draw(photograph, cameras.move_to_pose(camera, pose), size), 0.0
        scene_slot = self._slots[slot]
        if content is None or scene_slot.scene is None:
            return None, 0.0
        settings = fit_settings(self.state.draw_settings, scene_slot.scene)  # that which fades may have fewer views
        milliseconds = self._render(scene_slot, pose, size, settings, plan)
        return scene_slot.image, milliseconds

    def _render(
        self,
        slot: SceneSlot,
        cam2world: Float[np.ndarray, "4 4"],
        size: tuple[int, int],
        settings: DrawSettings,
        plan: ResolutionPlan,
    ) -> float:
        """Draw the image of this plan; returns milliseconds, 0 if it is not new."""
        settings = replace(settings, cached=plan.cached)
        if not (plan.cached and slot.renderer.has_faces(cam2world, size, settings)):
            settings = replace(settings, scale=plan.scale)
        wait = plan.moving and slot.renderer.pacing.waits_while_moving
        return slot.draw(cam2world, size, settings, wait=wait)

    def _focus_center(self) -> None:
        """Orbit the point in the centre of the last image."""
        if self._slot.image is None or self._shows_photograph:
            return
        depth, stereo = self.renderer.read_depth(), self.state.settings.stereo
        width, height = get_eye_size(depth.shape[::-1], stereo)
        distance = measure_center_depth(depth[:height, :width])  # of the left eye
        self._slot.image = None  # `read_depth` may have replaced the texture
        if distance is not None:
            camera = self.state.camera
            point = np.asarray(camera.position) + distance * camera.rotation[:, 2]
            self.state.camera = cameras.focus_on_point(camera, point)
            self.state.orbiting = True

    def _pick(self, place: tuple[float, float], size: tuple[int, int], now: float) -> None:
        """Show the point of the scene at a place of the window, as fractions of width and height."""
        if self._visit(place) or self._slot.scene is None or self._shows_photograph or self.state.glide is not None:
            return
        eye_size = get_eye_size(size, self.state.settings.stereo)
        pixel = place[0] * size[0] % eye_size[0], place[1] * size[1] % eye_size[1]
        origin, direction = compute_pixel_ray(self.state.camera, pixel, eye_size)
        point = pick_point(self._slot.scene, origin, direction, self.state.settings)
        if point is not None and self.state.doll_house:
            self.state.target = point.view
        elif point is None:
            self.state.points = []
            self.state.show_message("no Gaussian there", now)
        else:
            self.state.points = [*self.state.points[-1:], point]

    def _execute(self, commands: Commands, size: tuple[int, int], now: float) -> None:
        """Execute the commands of the frame, except `focus` and `pick`."""
        if commands.dismiss_error or commands.reduce is not None:
            loaded, self._too_large = self._too_large, None
            self.panel_data.error = self.panel_data.reduced = None
            self._draw_failed = False
            if commands.reduce is not None and loaded is not None:
                self._incoming = replace(loaded, scene=keep_largest(loaded.scene, commands.reduce))
            else:
                self._list_shown()
        if commands.cancel_loading and not self.loader.cancel_search():
            self.loader.cancel()
            self._preparer.stop()
            self._incoming, self.panel_data.current = None, -1
            self._list_shown()
        if commands.theme is not None:
            self.gui.set_theme(commands.theme)
            self._write_preferences(theme=commands.theme)
        if commands.reset_layout:
            self.gui.reset_layout()
        if commands.cancel_refinement:
            self.loader.cancel()
        if commands.visit is not None:
            self.state.target = commands.visit
        if commands.doll_house:
            self._toggle_doll_house(now)
        if commands.answer is not None and self._held is not None:
            (action, after_saving, otherwise), self._held = self._held, None
            if commands.answer == "drop":
                self._stop_painting()
            is_saved = commands.answer == "save" and self._save_mask(now)
            (action if commands.answer == "drop" or (is_saved and after_saving) else otherwise)()
        if commands.choose is not None and commands.choose != self.panel_data.current:
            self._leave_mask(partial(self.show, self.entries, commands.choose, self.path))
        elif commands.reload:
            self._leave_mask(self._reload)
        elif commands.open is not None:
            self._leave_mask(partial(self.open, Path(commands.open).expanduser()))
        self._execute_cleaning(commands, now)
        if self._loaded is None:
            return
        self._execute_path(commands, size, now)
        if self._shows_photograph and (commands.pin or commands.png or commands.exr or commands.panorama):
            self.state.show_message("there is no scene of this place yet", now)
            return
        if commands.pin:
            self._pin(now)
        if commands.go_to_photograph:
            self._comparer.go_to_photograph(self.state)
        if commands.png:
            self._write_screenshot("png", size, now)
        if commands.exr:
            self._write_screenshot("exr", size, now)
        if commands.panorama:
            self._write_screenshot("png", (2 * PANORAMA_HEIGHT, PANORAMA_HEIGHT), now, panorama=True)

    def _reload(self) -> None:
        """Load the entry again."""
        current = max(self.panel_data.current, 0)
        if self.path is None:
            self.show(self.entries, current)
        else:
            self.open(self.path, self.entries[current].name)

    def _pin(self, now: float) -> None:
        """Keep this image as the right side of a comparison."""
        scene, state, loaded = self._slot.scene, self.state, self._loaded
        assert scene is not None and loaded is not None
        name = f"{loaded.entry.name}, {state.settings.mode}, {state.settings.display}"
        try:
            self._comparer.pin(scene, state.settings, name)
        except (InputError, MemoryError, moderngl.Error) as error:
            self.panel_data.error = f"not pinned: {_describe(error)}"
            return
        state.comparison = "pinned"
        state.show_message("pinned; changes show left of the line", now)

    def _save_layout(self, *, changed: bool = True) -> None:
        """Remember the layout of the panels."""
        layout = None if self._preferences_file is None else self.gui.save_layout(changed=changed)
        if layout is not None:
            self._write_preferences(layout=layout)

    def _write_preferences(self, **values: object) -> None:
        preferences = replace(self.panel_data.preferences, **values)
        if preferences != self.panel_data.preferences:
            self.panel_data.preferences = preferences
            write_preferences(preferences, self._preferences_file)

    def _execute_path(self, commands: Commands, size: tuple[int, int], now: float) -> None:
        """Save, load and film the camera path."""
        frame = USER_FRAME if self._loaded is None else self._loaded.scene.frame
        try:
            if commands.save_path is not None:
                file = Path(commands.save_path).expanduser()
                require_replaceable("the camera path", [file])
                write_path(self.state.path.map_places(frame.globalize_places), file)
                self.state.show_message(f"wrote {commands.save_path}", now)
            elif commands.open_path is not None:
                users = read_path(Path(commands.open_path).expanduser())
                self.state.path = users.map_places(frame.localize_places)
                self.state.path_seconds, self.state.path_playing = 0.0, False
            elif commands.film:
                self._start_film(size)
        except (InputError, OSError) as error:
            self.panel_data.error = str(error)
        if commands.cancel_film:
            self._films.cancel(join=True)

    def _start_film(self, size: tuple[int, int]) -> None:
        """Write the film of the path in a worker thread, drawn on the processor, so that the window stays free."""
        state, tour, loaded = self.state, self._tour, self._loaded
        assert loaded is not None
        scene, settings, fps = self._slot.scene, state.draw_settings, state.film_fps
        path, level, scenes = state.path, state.camera, None if tour is None else tour.copy()
        image_format = choose_format(state.film_projection, settings)
        if state.film_projection != "perspective":
            size = image_format.default_size
        image_format.check(size, settings.preset)
        assert scene is not None
        folder = self._folder / loaded.entry.folder_name
        folder.mkdir(parents=True, exist_ok=True)
        file = find_free_name(folder, "path", state.film_suffix)

        def write(progress: Report) -> list[Path]:
            def load(entry: SceneEntry) -> LoadedScene:  # a film that is cancelled does not wait for a prediction
                return self.loader.load(entry, lambda task, done: progress())

            with open_frames(lambda: CpuRenderer(None), scene, scenes, load, size, settings, image_format) as frames:
                return write_path_film(frames, path, level, file, fps, progress)

        self._films.start(write)

    def _take_film(self, now: float) -> None:
        """Report a film that is finished, or its error."""
        result = self._films.poll()
        if isinstance(result, list):
            self.screenshots += result
            self.state.show_message(f"wrote {result[-1]}", now)
        elif result is not None:
            self.panel_data.error = f"no film written: {result}"

    def _write_screenshot(self, suffix: str, size: tuple[int, int], now: float, *, panorama: bool = False) -> None:
        assert self._loaded is not None
        settings = self.state.draw_settings
        self._slot.image = None  # the texture will hold the screenshot
        try:
            if panorama:
                color, depth = self._render_panorama(size, settings), None
            else:
                self.renderer.render(self.state.camera.cam2world, size, settings, wait=True)
                color = self.renderer.read_color()[..., :3]
                depth = self._loaded.scene.frame.unit * self.renderer.read_depth() if suffix == "exr" else None
            path = write_screenshot(
                self._folder / self._loaded.entry.folder_name,
                suffix,
                color,
                depth,
                panorama=panorama,
            )
        except (InputError, OSError, MemoryError, moderngl.Error) as error:
            self.panel_data.error = f"no screenshot written: {_describe(error)}"
            return
        self.screenshots.append(path)
        self.state.show_message(f"wrote {path}", now)

    def _render_panorama(self, size: tuple[int, int], settings: DrawSettings) -> Float[np.ndarray, "height width 3"]:
        """The panorama at the camera; in stereo, both eyes', the left one at the top, drawn on the processor."""
        cam2world, image_format = self.state.camera.cam2world, choose_format("equirect", settings)
        image_format.check(size, settings.preset)
        if not image_format.is_omnidirectional:
            return render_image(self.renderer, cam2world, size, settings, image_format)[0]
        assert self._slot.scene is not None
        renderer = CpuRenderer(None)
        try:
            renderer.upload(self._slot.scene)
            return render_image(renderer, cam2world, size, settings, image_format)[0]
        finally:
            renderer.release()


def _describe(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return f"the memory is exhausted ({type(error).__name__}: {error})"
    return f"OpenGL failed: {error}" if isinstance(error, moderngl.Error) else str(error)


def measure_center_depth(depth: Float[np.ndarray, "height width"]) -> float | None:
    """Return the median depth around the image centre, metres; None if nothing is drawn there."""
    row, column = depth.shape[0] // 2, depth.shape[1] // 2
    for reach in (4, 16, 64):
        window = depth[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        if (window > 0).any():
            return float(np.median(window[window > 0]))
    return None
