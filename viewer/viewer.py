"""The viewer without its window: scene, image and panels on any OpenGL context, one frame at a time.

`Viewer` holds the objects of the application; `Session` has the scenes.
Keys and panels change `state` at once, and queue all other actions, which are done at the end of the frame.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import torch
from imgui_bundle import imgui

from pansplat import pipeline
from pansplat.errors import InputError
from pansplat.geometry.level import find_direction
from pansplat.images.image_files import write_image
from pansplat.inputs.panorama_sets import Note
from pansplat.inputs.photographs import read_notes, write_notes
from pansplat.inputs.web_tours.entries import make_note
from pansplat.system.files import require_replaceable
from pansplat.tours.camera_path import read_path, write_path
from pansplat.tours.route import find_angles
from pansplat_viewer.core import camera as cameras
from pansplat_viewer.core.hotspots import Hotspot, find_clicked, find_hotspots
from pansplat_viewer.core.loader import Find, SceneEntry, SceneLoader
from pansplat_viewer.core.picking import PickedPoint, compute_pixel_ray, pick_point
from pansplat_viewer.core.placing_by_hand import PlacingByHand
from pansplat_viewer.core.settings import RendererChoice
from pansplat_viewer.core.state import ViewerState, advance_path
from pansplat_viewer.draw.frame_renderer import render_image
from pansplat_viewer.session import Session
from pansplat_viewer.ui.panels import Panels
from pansplat_viewer.ui.stage import DRAW_ERRORS, Stage, describe_error
from pansplat_viewer.window.gui import Gui
from pansplat_viewer.window.input import apply_input, read_input
from pansplat_viewer.window.recent import add_recent, read_recent

PANORAMA_HEIGHT = 1024  # pixels, of screenshots
_MAX_STEP_SECONDS = 0.25  # longest camera movement of one frame
_NOTE_COSINE = math.cos(math.radians(5))  # within this angle of the image's middle, a note is there


class Viewer:
    """The application; tests run it on a context without a window.

    Attributes:
        state: the values that a user can change.
        session: the scenes to choose from, which one is shown, and which one comes next.
        stage: draws the image.
        placing: the panoramas whose poses a user changes; None without any.
        hotspots: places of panoramas in the image.
        panels: the panels, with the rectangles of their widgets.
        recent: the paths that were opened, the last one first.
        error: message of the last failure.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        loader: SceneLoader,
        *,
        find: Find,
        state: ViewerState | None = None,
        folder: Path = Path("renders"),
        dpi_scale: float = 1.0,
        renderer: RendererChoice = "auto",
        recent: Path | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Create GL objects on the current context.

        Args:
            ctx: the context to draw with.
            loader: loads entries; closed with the viewer.
            find: returns the entries of a path that a user opens or drops; called in a worker thread.
            state: the initial state.
            folder: screenshots are written to its subfolder with the entry's name.
            dpi_scale: size of the panels.
            renderer: draws the image; `auto` is `cpu` where OpenGL is software.
            recent: file of the paths that were opened; None remembers none.
            clock: returns seconds.
        """
        self._ctx, self.state = ctx, state or ViewerState()
        self.error: str | None = None
        self._clock = clock
        self.stage = Stage(ctx, renderer, self.state, self.show_error)
        self.session = Session(
            self.state,
            self.stage,
            loader,
            find,
            show_error=self.show_error,
            listed=self._note_listed,
        )
        self.placing: PlacingByHand | None = None
        self._placed: SceneEntry | None = None  # whose panoramas `placing` has
        self._folder = folder
        self.panels = Panels(ctx)
        self._recent_file, self.recent = recent, read_recent(recent)
        self.gui = Gui(dpi_scale)
        self.hotspots: list[Hotspot] = []
        self._queue: list[Callable[[], object]] = []

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
        is_placing = self.placing is not None and self.placing.progress is not None
        return self.moving or self.session.is_busy or self.stage.photographs.is_reading or is_placing

    @property
    def moving(self) -> bool:
        """Whether the image is still changing, so that a window draws as often as it can."""
        return self.stage.is_moving(self._clock())

    @property
    def pending(self) -> Future[Any] | None:
        """The image that is drawn in the background, if the window changes only when it is finished."""
        return None if self.stage.is_animated(self._clock()) else self.stage.pending

    def _find_hotspots(self) -> list[Hotspot]:
        """The places of panoramas in the image, in points of the window, which may have several pixels; none while the
        camera flies."""
        state, fade, size = self.state, self.stage.fade, imgui.get_io().display_size
        tour, moment, place = self.session.tour, state.moment, None
        if moment is None or moment.step.kind not in ("flight", "zoom"):
            place = self.session.find_place()
        if state.graph is None or place is None or (tour is not None and fade.parts[fade.front] != tour.part):
            return []
        left = self.panels.width if state.overlay else 0.0
        return find_hotspots(state.graph, place, state.camera, (int(size.x), int(size.y)), left)

    # --- frames ---

    def frame(self, target: moderngl.Framebuffer, seconds: float, new_frame: Callable[[], None] | None = None) -> None:
        """Apply the input of a frame of `seconds`, and draw image and panels into the viewport of `target`.

        `new_frame` passes the window's size and pointer to imgui; without it the caller has set imgui's io.
        """
        state, stage = self.state, self.stage
        _, _, width, height = target.viewport
        state.now, stage.size = self._clock(), (width, height)
        self.session.poll()
        if not self.moving:
            self.session.exchange()
        if self.session.entry is not self._placed:
            self._placed = self.session.entry
            self.placing = PlacingByHand.open(self.placing, self._placed, self.session.entries)
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
        apply_input(self, events)
        step = min(seconds, 2 * _MAX_STEP_SECONDS)
        self.session.fly(step, was_playing)
        advance_path(state, step)
        self.session.update()
        if self.session.loaded is None and self.session.tour is None:
            stage.fade_to_photograph(stage.photographs.find_nearest(np.asarray(state.camera.position)))
        stage.draw(target)
        self.gui.end(self._ctx, target)
        actions, self._queue = self._queue, []
        for action in actions:
            action()

    def close(self) -> None:
        """Stop the threads and free every GL object; the context must still be current."""
        if self.placing is not None:
            self.placing.close()
        self.session.loader.close()
        self.stage.release()
        self.panels.release()
        self.gui.close()

    # --- scenes ---

    def _note_listed(self, path: Path | None) -> None:
        self.error = None
        if path is not None:
            self.recent = add_recent(self.recent, path, self._recent_file)

    def dismiss_error(self) -> None:
        """Close the error message, and go on with the scene that is shown."""
        self.error = None
        self.session.dismiss()

    # --- actions of keys and panels ---

    def focus_center(self) -> None:
        """Orbit the point in the centre of the image."""
        point, state = self._pick((0.5, 0.5)), self.state
        if point is not None:
            state.camera, state.orbiting = cameras.focus_on_point(state.camera, np.array(point.position)), True

    def click(self, place: tuple[float, float]) -> None:
        """Fly to the panorama of the hotspot at a place, or show the point there; fractions of width and height."""
        state = self.state
        if state.plan and state.overlay:
            points = imgui.get_io().display_size
            state.target = find_clicked(self.hotspots, (place[0] * points.x, place[1] * points.y))
        if state.target is None:
            point = self._pick(place)
            state.points = [] if point is None else [*state.points[-1:], point]

    def _pick(self, place: tuple[float, float]) -> PickedPoint | None:
        """The point of the scene at a place of the image; None, and a message, if there is none."""
        state, stage = self.state, self.stage
        if stage.slot.scene is None or stage.photograph is not None:
            return None
        pixel = place[0] * stage.size[0], place[1] * stage.size[1]
        ray = compute_pixel_ray(state.camera, pixel, stage.size)
        stage.slot.image = None  # its texture may hold another image afterwards
        try:
            point = pick_point(stage.renderer, *ray, state.settings)
        except DRAW_ERRORS as error:
            self.show_error(describe_error(error))
            return None
        if point is None:
            state.show_message("no Gaussian there")
        return point

    def write_screenshot(self, suffix: str, panorama: bool = False) -> None:
        """Write the image as PNG, or EXR with depth in metres, or the panorama at the camera without its display.

        The file is the first of `view_001.png`, `view_002.png`, ... (`panorama_001.png`, ...) that does not exist.
        """
        stage, state, loaded = self.stage, self.state, self.session.loaded
        if loaded is None or stage.photograph is not None:
            state.show_message("there is no scene of this place yet")
            return
        stage.slot.image = None  # the texture will hold the screenshot
        pose, settings, depth = state.camera.cam2world, state.draw_settings, None
        try:
            if panorama:
                blend, size = settings.view if settings.mode == "view" else settings.mode, PANORAMA_HEIGHT
                color = pipeline.render(stage.slot.scene, pose, blend=blend, size=(size, 2 * size)).color
            else:
                color, depth = render_image(stage.renderer, pose, stage.size, settings, with_depth=suffix == "exr")
            folder, stem = self._folder / loaded.entry.folder_name, "panorama" if panorama else "view"
            folder.mkdir(parents=True, exist_ok=True)
            files = (folder / f"{stem}_{number:03d}.{suffix}" for number in itertools.count(1))
            file = next(file for file in files if not file.exists())
            unit = loaded.scene.frame.unit
            write_image(file, color, depth=None if depth is None else unit * depth, panorama=panorama)
            state.show_message(f"wrote {file}")
        except (*DRAW_ERRORS, OSError) as error:
            self.show_error(f"no screenshot written: {describe_error(error)}")

    def put_note(self, text: str) -> None:
        """State a note at the middle of the image, in place of one that is there; without a text remove that one."""
        photographs, camera = self.stage.photographs, self.state.camera
        index = photographs.find_stop(np.asarray(camera.position))
        if index is None or (panorama := photographs.panoramas[index]).links_at is None:
            self.state.show_message("a note is put at a panorama of a folder; open the folder of this one")
            return
        away = photographs.pose(index)[:3, :3].T @ camera.rotation[:, 2]
        yaw, pitch = find_angles(away)

        def is_here(note: Note) -> bool:
            return float(away @ find_direction(torch.eye(4), note.yaw, note.pitch).numpy()) >= _NOTE_COSINE

        with self._showing_errors():
            file = write_notes(panorama, [make_note((yaw, -pitch), text)] if text.strip() else [], is_here)
            photographs.change_notes(index, read_notes(panorama))
            self.state.show_message(f"wrote {file}")

    def save_path(self, text: str) -> None:
        """Write the key frames of the camera path."""
        file = Path(text).expanduser()
        with self._showing_errors():
            if self.session.loaded is not None:
                require_replaceable("the camera path", [file])
                write_path(self.state.path.map_places(self.session.loaded.scene.frame.globalize_places), file)
                self.state.show_message(f"wrote {text}; pansplat render SCENE --path {text} -o film.mp4 draws it")

    def open_path(self, text: str) -> None:
        """Read the key frames of a camera path."""
        with self._showing_errors():
            if self.session.loaded is not None:
                path = read_path(Path(text).expanduser())
                self.state.path = path.map_places(self.session.loaded.scene.frame.localize_places)
                self.state.path_seconds, self.state.path_playing = 0.0, False

    @contextlib.contextmanager
    def _showing_errors(self) -> Iterator[None]:
        """Show an error of input or of the file system in the block."""
        try:
            yield
        except (InputError, OSError) as error:
            self.show_error(str(error))
