"""The viewer without its window: scene, image and panels on any OpenGL context, one frame at a time."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.data.images import read_panorama
from pansplat.data.views import Views
from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.tours import plan_route
from pansplat_viewer import camera as cameras
from pansplat_viewer.capture import (
    FilmWriter,
    SceneFrames,
    TourFrames,
    find_free_name,
    write_path_film,
    write_screenshot,
)
from pansplat_viewer.cpu_renderer import CpuRenderer, create_renderer
from pansplat_viewer.input import Commands, apply_input, read_input
from pansplat_viewer.key_frames import read_path, write_path
from pansplat_viewer.loader import PHOTO_HEIGHT, LoadedScene, SceneEntry, SceneLoader
from pansplat_viewer.panels import Gui, PanelData, Panels
from pansplat_viewer.picking import compute_pixel_ray, pick_point
from pansplat_viewer.programs import Programs
from pansplat_viewer.settings import DrawSettings, RendererChoice
from pansplat_viewer.slots import SceneSlot
from pansplat_viewer.state import (
    ViewerState,
    adapt_settings,
    advance_flight,
    advance_path,
    enter_scene,
    enter_tour,
    fit_settings,
)
from pansplat_viewer.stereo import StereoRenderer, choose_format, get_eye_size, render_image
from pansplat_viewer.tour import DEFAULT_MEMORY, CrossFade, TourScenes, find_clicked, find_hotspots

PANORAMA_HEIGHT = 1024  # of a panorama screenshot, pixels
_MAX_STEP_SECONDS = 0.25  # of camera movement in one frame

SCALES = (1.0, 0.75, 0.5, 0.35, 0.25)  # few values, because a new size allocates new GL textures
BUDGET_MS = 50.0
SETTLE_AFTER = 0.2  # seconds after the last movement


@dataclass(frozen=True)
class ResolutionPlan:
    """How one frame is rendered.

    Attributes:
        scale: rendered pixels over screen pixels, along each side.
        cached: whether the image is read from cube faces that are kept for this position.
        moving: whether the camera has just moved or turned.
    """

    scale: float
    cached: bool
    moving: bool = False


@dataclass
class AdaptiveResolution:
    """Chooses the resolution of each frame: full when the camera stands still, within a time budget when it moves.

    Attributes:
        budget_ms: time of a frame while the camera moves.
        step: index into SCALES of the scale while the camera moves.
        full_ms: time of the last frame at full resolution.
        last_motion: time of the last movement, seconds.
        translated: whether the last movement changed the position.
        settle_after: seconds after the last movement until the resolution is full.
        num_scales: how many of SCALES may be used, from the largest on.
    """

    budget_ms: float = BUDGET_MS
    step: int = 0
    full_ms: float = 0.0
    last_motion: float = -1e9
    translated: bool = False
    settle_after: float = SETTLE_AFTER
    num_scales: int = len(SCALES)

    def plan(self, now: float, *, moved: bool, turned: bool, adaptive: bool = True) -> ResolutionPlan:
        """Return the plan of the frame at time `now` (seconds) after the camera moved, turned or did neither."""
        if moved or turned:
            self.last_motion, self.translated = now, moved
        self.step = min(self.step, self.num_scales - 1)
        moving = now - self.last_motion < self.settle_after
        if not adaptive or not moving:
            return ResolutionPlan(1.0, cached=False, moving=moving)
        slow = self.full_ms > self.budget_ms
        return ResolutionPlan(SCALES[self.step], cached=slow and not self.translated, moving=True)

    def limit(self, size: tuple[int, int], min_size: tuple[int, int]) -> None:
        """Use no scale that makes an image of `size` smaller than `min_size`, pixels."""
        fits = [scale for scale in SCALES if all(a * scale >= b for a, b in zip(size, min_size, strict=True))]
        self.num_scales = max(len(fits), 1)

    def record(self, plan: ResolutionPlan, frame_ms: float) -> None:
        """Record the time of a frame and adjust the scale; frames from cached faces are ignored."""
        if plan.cached:
            return
        if plan.scale == 1.0:
            self.full_ms = frame_ms
        if frame_ms > 1.2 * self.budget_ms and plan.scale == SCALES[self.step]:
            self.step = min(self.step + 1, self.num_scales - 1)
        elif self.step > 0 and plan.scale == SCALES[self.step]:
            # A finer scale only if the next one is expected to fit the budget, else the resolution would oscillate.
            growth = (SCALES[self.step - 1] / SCALES[self.step]) ** 2
            if frame_ms * growth < 0.9 * self.budget_ms:
                self.step -= 1


class Presenter:
    """Draws the rendered image to the screen, and next to it an input photograph of the same directions."""

    def __init__(self, ctx: moderngl.Context) -> None:
        """Compile the program."""
        self.ctx = ctx
        self._programs = Programs(ctx)
        self._program = self._programs.present()
        self._triangle = ctx.vertex_array(self._program, [])
        self._program["image"], self._program["photograph"], self._program["fading"] = 0, 1, 2
        self._photos: list[moderngl.Texture] = []
        self._poses: Float[np.ndarray, "view 4 4"] = np.zeros((0, 4, 4))

    def upload_photos(self, photos: Views | None) -> None:
        """Replace the photographs and their poses; None removes them."""
        for texture in self._photos:
            texture.release()
        self._photos.clear()
        if photos is None:
            return
        self._poses = photos.cam2world.double().numpy()
        for image in photos.images.permute(0, 2, 3, 1).numpy():
            height, width = image.shape[:2]
            pixels = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
            texture = self.ctx.texture((width, height), 3, pixels.tobytes(), alignment=1)
            texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
            texture.repeat_x, texture.repeat_y = True, False
            self._photos.append(texture)

    def draw(
        self,
        image: moderngl.Texture,
        target: moderngl.Framebuffer,
        *,
        photo: int | None,
        split: float,
        camera: cameras.Camera,
        fading: moderngl.Texture | None = None,
        weight: float = 1.0,
    ) -> None:
        """Fill `target` with the image of `camera`, and right of `split` with the photograph of index `photo`.

        The photograph is sampled by direction only: it has no parallax and matches exactly at its own camera. The image
        is mixed with `fading`, the image of another scene; `weight` is that of the first, 0 to 1.
        """
        if photo is None and fading is None and target.viewport == (0, 0, *image.size) and image.dtype == "f1":
            self._copy(image, target)
            return
        target.use()
        self.ctx.disable(moderngl.DEPTH_TEST | moderngl.BLEND | moderngl.CULL_FACE)
        image.filter = (moderngl.LINEAR, moderngl.LINEAR)
        image.use(0)
        self._program["weight"] = weight
        (fading or image).use(2)
        if fading is not None:
            fading.filter = (moderngl.LINEAR, moderngl.LINEAR)
        if photo is None:
            self._program["split"] = 2.0
            image.use(1)
        else:
            self._program["split"] = split
            self._photos[photo].use(1)
            rotation = self._poses[photo][:3, :3].T @ camera.cam2world[:3, :3]
            self._program["camera_to_photo"] = tuple(rotation.T.ravel().tolist())  # column by column
            width, height = target.viewport[2:]
            tangent = math.tan(math.radians(camera.vertical_fov_degrees) / 2)
            self._program["tangent"] = (tangent * width / height, tangent)
        self._triangle.render(moderngl.TRIANGLES, vertices=3)

    def _copy(self, image: moderngl.Texture, target: moderngl.Framebuffer) -> None:
        """Copy an image of the target's size; software OpenGL copies fifty times as fast as it draws."""
        source = self.ctx.framebuffer([image])
        self.ctx.copy_framebuffer(target, source)
        target.use()
        source.release()

    def release(self) -> None:
        """Free the GL objects."""
        self.upload_photos(None)
        self._triangle.release()
        self._programs.release()


class Viewer:
    """Scene, image and panels; tests run it on a context without a window.

    Attributes:
        state: the values that a user can change.
        panels: the panels, with the rectangles of their widgets.
        panel_data: the data of the panels in the last frame.
        screenshots: files written so far.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        loader: SceneLoader,
        *,
        find: Callable[[Path], list[SceneEntry]],
        state: ViewerState | None = None,
        folder: Path = Path("renders"),
        at: float = 0.0,
        dpi_scale: float = 1.0,
        renderer: RendererChoice = "auto",
        memory: float = DEFAULT_MEMORY,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Create GL objects on the current context.

        Args:
            ctx: the context to draw with.
            loader: loads entries; closed with the viewer.
            find: returns the entries of a path that a user opens or drops.
            state: the initial state.
            folder: screenshots are written to its subfolder with the entry's name.
            at: fraction of the flight at which a scene is entered.
            dpi_scale: size of the panels.
            renderer: draws the image; `auto` is `cpu` where OpenGL is software.
            memory: limit of the scenes of a tour, GiB.
            clock: returns seconds.
        """
        self.ctx, self.loader, self.state = ctx, loader, state or ViewerState()
        self.panels, self.panel_data = Panels(ctx), PanelData()
        self.entries: list[SceneEntry] = []
        self.screenshots: list[Path] = []
        self.gui = Gui(dpi_scale)
        self._choice, self._memory = renderer, memory
        self._slots = [SceneSlot(StereoRenderer(create_renderer(ctx, renderer), ctx))]
        self._fade = CrossFade()
        self.presenter = Presenter(ctx)
        self._find, self._folder, self._at, self._clock = find, folder, at, clock
        self._resolution = AdaptiveResolution(settle_after=self.renderer.settle_seconds)
        self._loaded: LoadedScene | None = None
        self._refined: Scene | None = None
        self._films = FilmWriter()
        self._tour: TourScenes | None = None
        self._waiting = False
        self._photo_node: int | None = None
        self._last_camera = self.state.camera

    @property
    def renderer(self) -> StereoRenderer:
        """The renderer of the scene that is shown."""
        return self._slot.renderer

    @property
    def _slot(self) -> SceneSlot:
        return self._slots[self._fade.front]

    @property
    def busy(self) -> bool:
        """Whether the next frame differs without new input."""
        return self.moving or self.loader.entry is not None or self._films.progress is not None

    @property
    def moving(self) -> bool:
        """Whether the image is still changing, so that a window draws as often as it can."""
        recently = self._clock() - self._resolution.last_motion < 2 * self._resolution.settle_after
        unsettled = self._slot.image is not None and not self.renderer.stats.settled
        fading = self._fade.compute_weight(self._clock()) < 1
        playing = self.state.path_playing or (self.state.playing and not self._waiting)
        return playing or recently or unsettled or fading

    def open(self, path: Path) -> None:
        """Show the scenes at a path; for an invalid path, show an error and keep the current scene."""
        try:
            entries = self._find(path)
        except (InputError, OSError) as error:
            self.panel_data.error = str(error)
            return
        self.show(entries, 0)

    def show(self, entries: list[SceneEntry], index: int) -> None:
        """List these entries and load one of them."""
        self.entries = entries
        self.panel_data.entries = [entry.name for entry in entries]
        self.panel_data.current, self.panel_data.error = index, None
        self.loader.request(entries[index])

    def frame(self, target: moderngl.Framebuffer, seconds: float, new_frame: Callable[[], None] | None = None) -> None:
        """Apply the input of a frame of `seconds`, and draw image and panels into the viewport of `target`.

        `new_frame` passes the window's size and pointer to imgui; without it the caller has set imgui's io.
        """
        start = time.perf_counter()
        now, size = self._clock(), target.viewport[2:]
        self._take_loaded(now)
        self._take_film(now)
        self._exchange_scene()
        self._update_tour(now)
        self.gui.begin(seconds, new_frame)
        self._update_panel_data(size)
        was_playing = self.state.playing
        panel_commands = self.panels.draw(self.state, self.panel_data, now)
        # The step is limited, so that after a slow frame the camera does not move far.
        key_commands = apply_input(self.state, read_input(min(seconds, _MAX_STEP_SECONDS)))
        self._fly_tour(min(seconds, 2 * _MAX_STEP_SECONDS), was_playing)
        advance_path(self.state, min(seconds, 2 * _MAX_STEP_SECONDS))
        if self._loaded is None:
            target.use()
            self.ctx.clear(*self.state.settings.background)
        else:
            if key_commands.focus:
                self._focus_center()
            if key_commands.pick is not None:
                self._pick(key_commands.pick, size, now)
            self._draw_image(size, target, now)
        self.gui.end(self.ctx, target)
        for commands in (panel_commands, key_commands):
            self._execute(commands, size, now)
        milliseconds = 1000 * (time.perf_counter() - start)
        data = self.panel_data
        data.frame_ms += (milliseconds - data.frame_ms) * (0.15 if data.frame_ms else 1.0)

    def close(self) -> None:
        """Stop the threads and free every GL object; the context must still be current."""
        self._films.close()
        self.loader.close()
        self.presenter.release()
        self.panels.release()
        for slot in self._slots:
            slot.renderer.release()
        self.gui.close()

    def _take_loaded(self, now: float) -> None:
        """Show the scene or the error of a finished load."""
        result = self.loader.poll()
        if isinstance(result, LoadedScene):
            loaded = self._loaded
            if self._tour is not None and result.entry.tour is self._tour.tour:
                self._tour.add(result)
            elif loaded is not None and loaded.entry is result.entry and result.is_final and not loaded.is_final:
                self._refined = result.scene
            elif self._upload(self._slots[0], result.scene, result.entry):
                self._enter(result, now)
        elif isinstance(result, InputError):
            self.panel_data.error = str(result)
        elif result is not None:  # not a user error: a defect, or out of memory
            self.panel_data.error = f"{type(result).__name__}: {result}"

    def _upload(self, slot: SceneSlot, scene: Scene, entry: SceneEntry) -> bool:
        """Upload a scene; returns whether it fits the GPU's memory, and shows an error if not."""
        try:
            slot.upload(scene)
        except (InputError, MemoryError, moderngl.Error) as error:  # moderngl.Error: the GPU's memory is exhausted
            self.panel_data.error = f"{entry.name}: {error}"
            return False
        return True

    def _exchange_scene(self) -> None:
        """Show the refined scene or the prediction, whichever is chosen, while the camera stands still."""
        if self._loaded is None or self._refined is None or self.moving:
            return
        scene = self._refined if self.state.refined else self._loaded.scene
        if scene is not self._slot.scene and not self._upload(self._slot, scene, self._loaded.entry):
            self._refined = None

    def _enter(self, loaded: LoadedScene, now: float) -> None:
        self._loaded, self._refined, self._tour = loaded, None, None
        self._resolution = AdaptiveResolution(settle_after=self.renderer.settle_seconds)
        self._fade.clear()
        self._fade.show(0, loaded.scene, now)
        self.presenter.upload_photos(loaded.photos)
        self._photo_node = None
        if loaded.entry.tour is None:
            enter_scene(self.state, loaded.scene, at=self._at)
        else:
            self._enter_tour(loaded)
        self._last_camera = self.state.camera
        self.state.show_message(f"{loaded.entry.name}   (H shows the keys)", now)

    # --- tours ---

    def _enter_tour(self, loaded: LoadedScene) -> None:
        tour = loaded.entry.tour
        assert tour is not None
        if len(self._slots) == 1:
            self._slots.append(SceneSlot(StereoRenderer(create_renderer(self.ctx, self._choice), self.ctx)))
        self._tour = TourScenes(tour, memory=self._memory)
        self._tour.add(loaded)
        enter_tour(self.state, tour, loaded.scene, plan_route(tour, tour.plan_walk()), at=self._at)
        self._tour.move(np.asarray(self.state.camera.position), self.state.route, self.state.flight)

    def _update_tour(self, now: float) -> None:
        """Show the scene of the camera's place, and load those that are next."""
        tour, state = self._tour, self.state
        if tour is None:
            return
        route = state.route if state.playing else None
        tour.move(np.asarray(state.camera.position), route, state.flight)
        self._show_tour_scene(tour, now)
        if self._is_other_requested():
            return
        request = tour.choose_request(tour.list_next(route, state.flight), self.loader.entry)
        if request is not None:
            self.loader.request(request)

    def _show_tour_scene(self, tour: TourScenes, now: float) -> None:
        """Start to fade to the scene of the camera's place, if it is loaded and not shown."""
        self._fade.compute_weight(now)
        loaded = tour.get(tour.views)
        slot = None if loaded is None else self._fade.choose_slot(loaded.scene)
        if loaded is None or slot is None:
            return
        if self._slots[slot].scene is not loaded.scene and not self._upload(
            self._slots[slot], loaded.scene, loaded.entry
        ):
            return
        self._fade.show(slot, loaded.scene, now)
        adapt_settings(self.state, loaded.scene)
        self.state.points = []

    def _is_other_requested(self) -> bool:
        """Whether the loader works on a scene that is not of this tour, which the user has chosen."""
        entry = self.loader.entry
        return entry is not None and (self._tour is None or entry.tour is not self._tour.tour)

    def _fly_tour(self, seconds: float, was_playing: bool) -> None:
        """Advance the flight; in a tour only as far as scenes are loaded, and from wherever the camera is."""
        state, tour, limit = self.state, self._tour, 1.0
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
            limit = tour.find_limit(state.route, state.flight) if state.playing else 1.0
        before = state.flight
        advance_flight(state, seconds, limit)
        self._waiting = state.playing and state.flight == before and limit < 1

    def _visit(self, place: tuple[float, float], size: tuple[int, int]) -> bool:
        """Fly to the panorama whose hotspot is at a place of the window; returns whether there is one."""
        one_image = get_eye_size(size, self.state.settings.stereo) == size
        if self._tour is None or not (self.state.hotspots and self.state.overlay and one_image):
            return False
        pixel = place[0] * size[0], place[1] * size[1]
        self.state.target = find_clicked(find_hotspots(self._tour, self.state.camera, size), pixel)
        return self.state.target is not None

    # --- frames ---

    def _update_panel_data(self, size: tuple[int, int]) -> None:
        data, photo = self.panel_data, self._nearest_photo()
        data.stats, data.loading = self.renderer.stats, self.loader.progress
        data.refinement = self.loader.refinement if self._refined is None else 1.0
        data.photo_name = None
        if photo is not None and self._loaded and self._loaded.photos:
            data.photo_name = self._loaded.photos.names[photo]
        data.tour, data.film = self._tour, self._films.progress
        data.hotspots = []
        if self._tour is not None:
            data.photo_name = self._tour.tour.panoramas[self._nearest_node()].name
            if get_eye_size(size, self.state.settings.stereo) == size:
                data.hotspots = find_hotspots(self._tour, self.state.camera, size)
            data.background = None
            if not self._is_other_requested():
                data.background, data.loading, data.refinement = self._describe_loading(), None, None

    def _describe_loading(self) -> tuple[str, float] | None:
        """The work of the loader on a tour, and the fraction done."""
        entry, progress, refinement = self.loader.entry, self.loader.progress, self.loader.refinement
        if entry is None:
            return None
        if progress is not None:
            return f"{'waiting for' if self._waiting else 'next'}: {entry.name}", progress[2]
        return f"refining: {entry.name}", refinement or 0.0

    def _nearest_node(self) -> int:
        assert self._tour is not None
        return self._tour.tour.find_nearest_node(np.asarray(self.state.camera.position))

    def _nearest_photo(self) -> int | None:
        """Return the index of the photograph nearest to the camera; None if there is none."""
        photos = self._loaded.photos if self._loaded else None
        if self._tour is not None:
            return self._read_nearest_photo(self._tour) if self.state.photo else None
        if photos is None or not len(photos.cam2world):
            return None
        return cameras.find_nearest_view(self.state.camera, photos.cam2world.double().numpy())

    def _read_nearest_photo(self, tour: TourScenes) -> int | None:
        """Upload the panorama nearest to the camera, unless it is there; returns its index, which is 0."""
        node = self._nearest_node()
        if node == self._photo_node:
            return 0
        panorama = tour.tour.panoramas[node]
        try:
            image, opaque = read_panorama(panorama.image, PHOTO_HEIGHT)
        except InputError as error:
            self.panel_data.error, self.state.photo = str(error), False
            return None
        pose = tour.tour.cam2world[node][None]
        self.presenter.upload_photos(
            Views(image[None], pose, opaque[None], tour.tour.near, tour.tour.far, (panorama.name,))
        )
        self._photo_node = node
        return 0

    def _draw_image(self, size: tuple[int, int], target: moderngl.Framebuffer, now: float) -> None:
        camera = self.state.camera
        moved = camera.position != self._last_camera.position
        turned = not moved and camera != self._last_camera
        self._last_camera = camera
        self._resolution.limit(size, self.renderer.min_size)
        plan = self._resolution.plan(now, moved=moved, turned=turned, adaptive=self.state.adaptive)
        weight, fading = self._fade.compute_weight(now), None
        milliseconds = self._render(self._slot, camera.cam2world, size, plan)
        if weight < 1:
            back = self._slots[1 - self._fade.front]
            milliseconds += self._render(back, camera.cam2world, size, plan)
            fading = back.image
        if milliseconds > 0:  # else the image is not new, or not finished
            self._resolution.record(plan, milliseconds)
        image = self._slot.image
        assert image is not None
        self.panel_data.size = image.size
        photo = self._nearest_photo() if self.state.photo and self.state.settings.stereo == "mono" else None
        self.presenter.draw(
            image, target, photo=photo, split=self.state.split, camera=camera, fading=fading, weight=weight
        )

    def _render(
        self, slot: SceneSlot, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], plan: ResolutionPlan
    ) -> float:
        """Draw the image of this plan; returns milliseconds, 0 if it is not new."""
        scaled = (max(round(size[0] * plan.scale), 1), max(round(size[1] * plan.scale), 1))
        settings = replace(self.state.draw_settings, cached=plan.cached)
        if slot is not self._slot:  # the scene that fades out may have fewer views
            settings = fit_settings(settings, slot.scene)
        if plan.cached and slot.renderer.has_faces(cam2world, size, settings):
            scaled = size
        wait = plan.moving and slot.renderer.waits_while_moving
        return slot.draw(cam2world, scaled, settings, wait=wait)

    def _focus_center(self) -> None:
        """Orbit the point in the centre of the last image."""
        if self._slot.image is None:
            return
        distance = measure_center_depth(self.renderer.read_eye_depth())
        self._slot.image = None  # `read_depth` may have replaced the texture
        if distance is not None:
            camera = self.state.camera
            point = np.asarray(camera.position) + distance * camera.rotation[:, 2]
            self.state.camera = cameras.focus_on_point(camera, point)
            self.state.orbiting = True

    def _pick(self, place: tuple[float, float], size: tuple[int, int], now: float) -> None:
        """Show the point of the scene at a place of the window, as fractions of width and height."""
        if self._visit(place, size):
            return
        assert self._slot.scene is not None
        eye_size = get_eye_size(size, self.state.settings.stereo)
        pixel = place[0] * size[0] % eye_size[0], place[1] * size[1] % eye_size[1]
        origin, direction = compute_pixel_ray(self.state.camera, pixel, eye_size)
        point = pick_point(self._slot.scene, origin, direction, self.state.settings)
        if point is None:
            self.state.points = []
            self.state.show_message("no Gaussian there", now)
        else:
            self.state.points = [*self.state.points[-1:], point]

    def _execute(self, commands: Commands, size: tuple[int, int], now: float) -> None:
        """Execute the commands of the frame, except `focus` and `pick`."""
        if commands.dismiss_error:
            self.panel_data.error = None
        if commands.cancel_refinement:
            self.loader.cancel()
        if commands.visit is not None:
            self.state.target = commands.visit
        if commands.choose is not None and commands.choose != self.panel_data.current:
            self.show(self.entries, commands.choose)
        elif commands.open is not None:
            self.open(Path(commands.open).expanduser())
        if self._loaded is None:
            return
        self._execute_path(commands, size, now)
        if commands.png:
            self._write_screenshot("png", size, now)
        if commands.exr:
            self._write_screenshot("exr", size, now)
        if commands.panorama:
            self._write_screenshot("png", (2 * PANORAMA_HEIGHT, PANORAMA_HEIGHT), now, panorama=True)

    def _execute_path(self, commands: Commands, size: tuple[int, int], now: float) -> None:
        """Save, load and film the camera path."""
        try:
            if commands.save_path is not None:
                write_path(self.state.path, Path(commands.save_path).expanduser())
                self.state.show_message(f"wrote {commands.save_path}", now)
            elif commands.open_path is not None:
                self.state.path = read_path(Path(commands.open_path).expanduser())
                self.state.path_seconds, self.state.path_playing = 0.0, False
            elif commands.film:
                self._start_film(size)
        except (InputError, OSError) as error:
            self.panel_data.error = str(error)
        if commands.cancel_film:
            self._films.cancel()

    def _start_film(self, size: tuple[int, int]) -> None:
        """Write the film of the path in a worker thread, drawn on the processor, so that the window stays free."""
        state, tour, loaded = self.state, self._tour, self._loaded
        assert loaded is not None
        scene, settings, fps = self._slot.scene, state.draw_settings, state.film_fps
        path, level, memory = state.path, state.camera, self._memory
        image_format = choose_format(state.film_projection, settings)
        if state.film_projection != "perspective":
            size = image_format.default_size
        image_format.check(size, settings.kernel)
        assert scene is not None
        folder = self._folder / loaded.entry.folder_name
        folder.mkdir(parents=True, exist_ok=True)
        file = find_free_name(folder, "path", state.film_suffix)

        def write(progress: Callable[[str, float], None]) -> list[Path]:
            renderers = [CpuRenderer(None) for _ in range(1 if tour is None else 2)]
            try:
                if tour is None:
                    frames = SceneFrames(renderers[0], scene, size, settings, image_format)
                else:
                    scenes = TourScenes(tour.tour, memory=memory)
                    frames = TourFrames(renderers, scenes, self.loader.load, size, settings, image_format)
                return write_path_film(frames, path, level, file, fps, progress)
            finally:
                for renderer in renderers:
                    renderer.release()

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
                depth = self.renderer.read_depth() if suffix == "exr" else None
            path = write_screenshot(
                self._folder / self._loaded.entry.folder_name,
                suffix,
                color,
                depth,
                panorama=panorama,
            )
        except (InputError, OSError) as error:
            self.panel_data.error = f"no screenshot written: {error}"
            return
        self.screenshots.append(path)
        self.state.show_message(f"wrote {path}", now)

    def _render_panorama(self, size: tuple[int, int], settings: DrawSettings) -> Float[np.ndarray, "height width 3"]:
        """The panorama at the camera; in stereo, both eyes', the left one at the top, drawn on the processor."""
        cam2world, image_format = self.state.camera.cam2world, choose_format("equirect", settings)
        image_format.check(size, settings.kernel)
        if not image_format.is_omnidirectional:
            return render_image(self.renderer, cam2world, size, settings, image_format)[0]
        assert self._slot.scene is not None
        renderer = CpuRenderer(None)
        try:
            renderer.upload(self._slot.scene)
            return render_image(renderer, cam2world, size, settings, image_format)[0]
        finally:
            renderer.release()


def measure_center_depth(depth: Float[np.ndarray, "height width"]) -> float | None:
    """Return the median depth around the image centre, metres; None if nothing is drawn there."""
    row, column = depth.shape[0] // 2, depth.shape[1] // 2
    for reach in (4, 16, 64):
        window = depth[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        if (window > 0).any():
            return float(np.median(window[window > 0]))
    return None
