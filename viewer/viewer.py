"""The viewer without its window: scene, picture and panels on any OpenGL context, one frame at a time."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat_viewer import camera as cameras
from pansplat_viewer.capture import write_screenshot
from pansplat_viewer.controls import apply, read_input
from pansplat_viewer.gui import Gui
from pansplat_viewer.library import Entry, Loaded, Loader
from pansplat_viewer.pacing import REFINE_AFTER, Pacer, Plan
from pansplat_viewer.panels import Facts, Panels, Requests
from pansplat_viewer.present import Presenter
from pansplat_viewer.renderer import SplatRenderer
from pansplat_viewer.state import ViewerState, advance, enter

PANORAMA_HEIGHT = 1024  # of a 360 screenshot, pixels
_LONGEST_STEP = 0.25  # seconds of movement in one frame


def middle_depth(depth: Float[np.ndarray, "height width"]) -> float | None:
    """Median of the depths around the middle, metres; None when there is nothing."""
    row, column = depth.shape[0] // 2, depth.shape[1] // 2
    for reach in (4, 16, 64):
        middle = depth[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        if (middle > 0).any():
            return float(np.median(middle[middle > 0]))
    return None


class Viewer:
    """Everything the window shows; tests run it on a context without a window.

    Attributes:
        state: what a person can change.
        panels: the panels, with the places of their widgets.
        facts: what the panels showed in the last frame.
        screenshots: files written so far.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        loader: Loader,
        *,
        find: Callable[[Path], list[Entry]],
        state: ViewerState | None = None,
        folder: Path = Path("renders"),
        at: float = 0.0,
        dpi_scale: float = 1.0,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Make GL objects on the current context.

        Args:
            ctx: the context to draw with.
            loader: makes scenes from entries; closed with the viewer.
            find: entries of a path that a person opens or drops.
            state: to start from.
            folder: screenshots go to a folder in it that has the entry's name.
            at: where on the flight to enter a scene.
            dpi_scale: size of the panels.
            clock: seconds.
        """
        self.ctx, self.loader, self.state = ctx, loader, state or ViewerState()
        self.panels, self.facts = Panels(), Facts()
        self.entries: list[Entry] = []
        self.screenshots: list[Path] = []
        self.gui = Gui(dpi_scale)
        self.renderer = SplatRenderer(ctx)
        self.presenter = Presenter(ctx)
        self._find, self._folder, self._at, self._clock = find, folder, at, clock
        self._pacer = Pacer()
        self._loaded: Loaded | None = None
        self._picture: moderngl.Texture | None = None
        self._drawn: tuple[object, ...] | None = None
        self._last_camera = self.state.camera

    @property
    def busy(self) -> bool:
        """Whether the next frame will differ without any new input."""
        return self.moving or self.facts.loading is not None

    @property
    def moving(self) -> bool:
        """Whether the picture is still changing: a window should draw as often as it can."""
        recently = self._clock() - self._pacer.last_motion < 2 * REFINE_AFTER
        unsettled = self._picture is not None and not self.renderer.stats.settled
        return self.state.playing or recently or unsettled

    def open(self, path: Path) -> None:
        """Show what a path holds; an unusable path is said in the window and changes nothing else."""
        try:
            entries = self._find(path)
        except (InputError, OSError) as error:
            self.facts.error = str(error)
            return
        self.show(entries, 0)

    def show(self, entries: list[Entry], index: int) -> None:
        """Offer these entries and load one of them."""
        self.entries = entries
        self.facts.entries = [entry.name for entry in entries]
        self.facts.current, self.facts.error = index, None
        self.loader.request(entries[index])

    def frame(self, target: moderngl.Framebuffer, seconds: float, new_frame: Callable[[], None] | None = None) -> None:
        """Take the input, let `seconds` pass, and draw picture and panels into `target`'s viewport.

        `new_frame` tells imgui about the window (size, pointer); without it the caller has set imgui's io.
        """
        begun = time.perf_counter()
        now, size = self._clock(), target.viewport[2:]
        self._collect(now)
        self.gui.begin(seconds, new_frame)
        self._update_facts()
        requests = self.panels.draw(self.state, self.facts, now)
        # One slow frame must not fling the camera away, nor skip most of a flight.
        wishes = apply(self.state, read_input(min(seconds, _LONGEST_STEP)))
        advance(self.state, min(seconds, 2 * _LONGEST_STEP))
        requests.png, requests.exr = requests.png or wishes.png, requests.exr or wishes.exr
        target.use()
        self.ctx.clear(*self.state.settings.background)
        if self._loaded is not None:
            if wishes.focus:
                self._focus()
            self._draw(size, target, now)
        self.gui.end(self.ctx, target)
        self._serve(requests, size, now)
        milliseconds = 1000 * (time.perf_counter() - begun)
        self.facts.frame_ms += (milliseconds - self.facts.frame_ms) * (0.15 if self.facts.frame_ms else 1.0)

    def close(self) -> None:
        """Stop the threads and free every GL object; the context must still be current."""
        self.loader.close()
        self.presenter.release()
        self.renderer.release()
        self.gui.close()

    def _collect(self, now: float) -> None:
        """Take over what the loader has finished."""
        outcome = self.loader.poll()
        if isinstance(outcome, Loaded):
            try:
                self.renderer.upload(outcome.scene)
            except (InputError, moderngl.Error) as error:  # the latter when it does not fit the GPU
                self.facts.error = f"{outcome.entry.name}: {error}"
                return
            self._enter(outcome, now)
        elif isinstance(outcome, InputError):
            self.facts.error = str(outcome)
        elif outcome is not None:
            # Not the person's input: a fault of ours or of the machine (out of memory).
            self.facts.error = f"{type(outcome).__name__}: {outcome}"

    def _enter(self, loaded: Loaded, now: float) -> None:
        self._loaded, self._drawn, self._picture = loaded, None, None
        self._pacer = Pacer()
        photos = loaded.photos
        images = None if photos is None else photos.images.permute(0, 2, 3, 1).numpy()
        poses = np.zeros((0, 4, 4)) if photos is None else photos.cam2world.double().numpy()
        self.presenter.upload_photos(images, poses)
        enter(self.state, loaded.scene, at=self._at)
        self._last_camera = self.state.camera
        self.state.say(f"{loaded.entry.name}   (H shows the keys)", now)

    def _update_facts(self) -> None:
        facts = self.facts
        facts.stats, facts.loading = self.renderer.stats, self.loader.progress
        facts.photo_name = None
        photos = self._loaded.photos if self._loaded else None
        if photos is not None and self.presenter.photo_count:
            poses = photos.cam2world.double().numpy()
            facts.photo_name = photos.names[cameras.nearest_view(self.state.camera, poses)]

    def _draw(self, size: tuple[int, int], target: moderngl.Framebuffer, now: float) -> None:
        camera = self.state.camera
        moved = camera.position != self._last_camera.position
        turned = not moved and camera != self._last_camera
        self._last_camera = camera
        plan = self._pacer.plan(now, moved=moved, turned=turned, adaptive=self.state.adaptive)
        picture = self._render(cameras.pose(camera), size, plan)
        target.use()
        photo = None
        if self.state.photo and self.facts.photo_name is not None and self._loaded and self._loaded.photos:
            photo = cameras.nearest_view(camera, self._loaded.photos.cam2world.double().numpy())
        self.presenter.draw(
            picture,
            target,
            photo=photo,
            split=self.state.split,
            cam2world=cameras.pose(camera),
            vertical_fov_degrees=camera.vertical_fov_degrees,
        )

    def _render(self, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], plan: Plan) -> moderngl.Texture:
        """The picture of this plan, drawn only when something changed since the last one."""
        drawn = (max(round(size[0] * plan.scale), 1), max(round(size[1] * plan.scale), 1))
        settings = replace(self.state.draw_settings, cached=plan.cached)
        key = (cam2world.tobytes(), drawn, settings)
        if self._picture is None or key != self._drawn or not self.renderer.stats.settled:
            self._picture = self.renderer.render(cam2world, drawn, settings, wait=False)
            self._pacer.measure(plan, self.renderer.stats.frame_ms)
            self._drawn = key
            self.facts.size = drawn
        assert self._picture is not None
        return self._picture

    def _focus(self) -> None:
        """Turn orbits around what is in the middle of the last picture."""
        if self._picture is None:
            return
        distance = middle_depth(self.renderer.read_depth())
        self._picture = None  # drawn anew for its depth; the texture is not the one we held
        if distance is not None:
            camera = self.state.camera
            point = np.asarray(camera.position) + distance * cameras.rotation(camera)[:, 2]
            self.state.camera = cameras.focus(camera, point)
            self.state.orbiting = True

    def _serve(self, requests: Requests, size: tuple[int, int], now: float) -> None:
        """Do what the panels asked for, after the frame."""
        if requests.dismiss_error:
            self.facts.error = None
        if requests.choose is not None and requests.choose != self.facts.current:
            self.show(self.entries, requests.choose)
        elif requests.open is not None:
            self.open(Path(requests.open).expanduser())
        if self._loaded is None:
            return
        if requests.png:
            self._screenshot("png", size, now)
        if requests.exr:
            self._screenshot("exr", size, now)
        if requests.panorama:
            self._screenshot("png", (2 * PANORAMA_HEIGHT, PANORAMA_HEIGHT), now, panorama=True)

    def _screenshot(self, suffix: str, size: tuple[int, int], now: float, *, panorama: bool = False) -> None:
        assert self._loaded is not None
        settings = self.state.draw_settings
        if panorama:
            settings = replace(settings, layout="equirect")
        self.renderer.render(cameras.pose(self.state.camera), size, settings, wait=True)
        self._picture = None  # the texture now shows the screenshot
        try:
            path = write_screenshot(
                self._folder / self._loaded.entry.folder_name,
                suffix,
                self.renderer.read_color()[..., :3],
                self.renderer.read_depth() if suffix == "exr" else None,
                panorama=panorama,
            )
        except (InputError, OSError) as error:
            self.facts.error = f"no screenshot written: {error}"
            return
        self.screenshots.append(path)
        self.state.say(f"wrote {path}", now)
