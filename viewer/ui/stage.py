"""What the window shows: scenes and photographs that fade into each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.tours.cross_fade import CrossFade
from pansplat_viewer.core import camera as cameras
from pansplat_viewer.core.loader import LoadedScene
from pansplat_viewer.core.settings import DrawSettings, RendererChoice
from pansplat_viewer.core.state import ViewerState, adapt_settings, fit_settings
from pansplat_viewer.core.stop_fade import StopFade
from pansplat_viewer.draw.cpu_renderer import create_renderer
from pansplat_viewer.draw.frame_renderer import FrameRenderer
from pansplat_viewer.draw.rendered_scene import RenderedScene, ScenePreparer
from pansplat_viewer.draw.resolution import AdaptiveResolution, ResolutionPlan
from pansplat_viewer.ui.photograph_textures import PhotographTextures
from pansplat_viewer.ui.presenter import PhotographLayer, PosedPhotograph, Presenter

DRAW_ERRORS = (InputError, MemoryError, moderngl.Error)
_EXPOSURE_SECONDS = 1 / 30  # longest exposure of a frame of a flight, by which its Gaussians blur
_JUMP = 1.0  # distance between two frames that only a jump has, metres


class Stage:
    """Draws the image of the window.

    Attributes:
        slots: renderers of a scene and of that which it fades to; the second one is for tours.
        scene_views: the panoramas in its tour of the scene that was shown last.
        fade: what is shown, and what it fades from.
        stop: the photograph over the scene while the camera stands at a panorama.
        preparer: converts large scenes.
        photographs: of the scene.
        resolution: of the frames.
        size: of the window, pixels.
        has_failed: whether drawing has failed; nothing is drawn until this is False.
        last_camera: of the last frame; a change since then is a movement.
    """

    def __init__(
        self, ctx: moderngl.Context, choice: RendererChoice, state: ViewerState, show_error: Callable[[str], None]
    ) -> None:
        """Create GL objects on the current context."""
        self._ctx, self._state, self._show_error = ctx, state, show_error
        self._choice: RendererChoice = choice
        self.slots = [self._create_slot()]
        self._scene_slot = 0  # that of the scene that was shown last
        self.scene_views: tuple[int, ...] = ()
        self.fade, self.stop = CrossFade(), StopFade()
        self.preparer = ScenePreparer(self.renderer.prepare)
        self.presenter = Presenter(ctx)
        self.photographs = PhotographTextures(ctx)
        self._layers = PhotographLayer(self.presenter), PhotographLayer(self.presenter)  # photographs in a fade
        self._stop_layer, self._zoom_layer = PhotographLayer(self.presenter), PhotographLayer(self.presenter)
        self.resolution = self._create_resolution()
        self.size: tuple[int, int] = (1, 1)
        self.has_failed = False
        self.last_camera = state.camera
        self._last_frame, self._shift = state.now, (0.0, 0.0, 0.0)  # its time, and the movement during the exposure

    def _create_slot(self) -> RenderedScene:
        return RenderedScene(create_renderer(self._ctx, self._choice))

    def _create_resolution(self) -> AdaptiveResolution:
        pacing = self.renderer.pacing
        return AdaptiveResolution(settle_after=pacing.settle_seconds, turn_ms=pacing.turn_ms)

    @property
    def slot(self) -> RenderedScene:
        """The scene that is shown, or that was shown before a photograph."""
        return self.slots[self._scene_slot]

    @property
    def renderer(self) -> FrameRenderer:
        """The renderer of `slot`."""
        return self.slot.renderer

    @property
    def photograph(self) -> int | None:
        """Number of the photograph that is shown, because there is no scene of the camera's place yet; else None."""
        content = self.fade.contents[self.fade.front]
        return content if isinstance(content, int) else None

    def is_animated(self, now: float) -> bool:
        """Whether the image changes with the time alone."""
        state = self._state
        fading = self.fade.compute_weight(now) < 1
        fading = fading or self.stop.weight not in (0, 1)
        return fading or state.path_playing or state.playing

    def is_moving(self, now: float) -> bool:
        """Whether the image is still changing, so that a window draws as often as it can."""
        recently = now - self.resolution.last_motion < 2 * self.resolution.settle_after
        unsettled = self.photograph is None and self.slot.scene is not None and not self.renderer.stats.settled
        return self.is_animated(now) or recently or (unsettled and not self.has_failed)

    @property
    def pending(self) -> Future[Any] | None:
        """The image that is drawn in the background."""
        return None if self.photograph is not None else self.renderer.pending

    # --- what is shown ---

    def upload(self, slot: RenderedScene, scene: Scene, name: str) -> bool:
        """Upload a scene; if this fails, show the error and return False."""
        try:
            slot.upload(scene, self.preparer.take(scene))
        except DRAW_ERRORS as error:
            self._show_error(f"{name}: {describe_error(error)}")
            return False
        return True

    def clear(self) -> None:
        """Show nothing; the next scene is that of the first slot."""
        self.fade.clear()
        self.stop = StopFade()
        self._scene_slot, self.resolution = 0, self._create_resolution()

    def add_slot(self) -> None:
        """Make the slot that the scenes of a tour fade to."""
        if len(self.slots) == 1:
            self.slots.append(self._create_slot())

    def fade_to_scene(self, loaded: LoadedScene, part: int, *, can_wait: bool) -> bool:
        """Start to fade to a scene of a tour; returns False if it is not prepared.

        Args:
            loaded: the scene.
            part: of the tour.
            can_wait: whether a scene that is not prepared may be prepared.
        """
        slot = self.fade.choose_slot(loaded.scene)
        if slot is None:  # it is shown, or a fade goes on
            return True
        if self.slots[slot].scene is not loaded.scene:
            ready = can_wait and self.preparer.is_ready(loaded.scene)
            if not ready or not self.upload(self.slots[slot], loaded.scene, loaded.entry.name):
                return False
        self.fade.show(slot, loaded.scene, self._state.now, part, at_once=self.stop.is_whole)
        self._scene_slot, self.scene_views = slot, loaded.entry.views
        adapt_settings(self._state, loaded.scene)
        self._state.points = []
        return True

    def fade_to_photograph(self, index: int | None, part: int = 0) -> None:
        """Start to fade to a photograph; what is shown stays while it is read."""
        self.fade.compute_weight(self._state.now)
        slot = None if index is None else self.fade.choose_slot(index)
        if index is not None and slot is not None and self.get_photograph(index) is not None:
            self.fade.show(slot, index, self._state.now, part, at_once=self.stop.is_whole)

    def get_photograph(self, index: int) -> PosedPhotograph | None:
        """A photograph; None while it is read, and if it cannot be, which is shown as an error once."""
        if index >= len(self.photographs):
            return None
        try:
            texture = self.photographs.get(index)
        except InputError as problem:
            self._show_error(str(problem))
            return None
        return None if texture is None else PosedPhotograph(texture, self.photographs.pose(index))

    # --- frames ---

    def draw(self, target: moderngl.Framebuffer) -> None:
        """Draw the image. If this fails, show the error, and draw the background while `has_failed`."""
        if not self.has_failed:
            try:
                self._draw_image(target)
                return
            except DRAW_ERRORS as error:
                self.has_failed, self.slot.image = True, None
                self._show_error(describe_error(error))
        self._draw_background(target)

    def _draw_background(self, target: moderngl.Framebuffer) -> None:
        target.use()
        self._ctx.clear(*self._state.settings.background)

    def _draw_image(self, target: moderngl.Framebuffer) -> None:
        state, plan, weight = self._state, self._plan_resolution(), 1.0
        image = fading = None
        (stop, before), milliseconds = self._draw_stop(), 0.0
        if stop is None or (before is None and (self.stop.weight < 1 or not plan.moving)):
            weight = self.fade.compute_weight(state.now)
            image, milliseconds = self._draw_content(self.fade.front, plan)
            if weight < 1:
                fading, more = self._draw_content(1 - self.fade.front, plan)
                milliseconds += more
            if image is None:  # the first one of a large scene is not finished
                image, fading = fading, None
        if stop is not None:
            below = None if self.stop.weight >= 1 else image if before is None else before
            image, fading, weight = stop, below, self.stop.weight
        self._record_time(plan, milliseconds)
        if image is None:
            nearest = self.photographs.find_nearest(np.asarray(state.camera.position))
            photograph = None if nearest is None else self.get_photograph(nearest)
            if photograph is None:
                self._draw_background(target)
            else:
                self.presenter.draw_photograph(photograph, target, state.camera)
            return
        self.presenter.draw(image, target, fading=fading, weight=weight)

    def _draw_stop(self) -> tuple[moderngl.Texture | None, moderngl.Texture | None]:
        """The photograph of the panorama at which the camera stands, or stood until now; of a zoom, both."""
        state, fade, moment = self._state, self.fade, self._state.moment
        if moment is not None and self._shows_stops and (moment.arrival is not None or self.photograph is None):
            self.stop.follow(moment, state.now)
        else:
            may_stop = self._shows_stops and self.photograph is None
            index = self.photographs.find_stop(np.asarray(state.camera.position)) if may_stop else None
            index = None if index is None or self.get_photograph(index) is None else index
            was_shown = fade.compute_weight(state.now) < 1 and fade.contents[1 - fade.front] == index
            self.stop.update(index, state.now, at_once=was_shown)
        photograph = None if self.stop.index is None else self.get_photograph(self.stop.index)
        if photograph is None or self.stop.weight <= 0:
            return None, None
        camera, below = state.camera, None
        before = None if self.stop.before is None else self.get_photograph(self.stop.before)
        if moment is not None and moment.arrival is not None:
            narrow = replace(camera, vertical_fov_degrees=moment.narrowing * camera.vertical_fov_degrees)
            camera = cameras.move_to_pose(camera, moment.arrival)
            below = before and self._zoom_layer.draw(before, narrow, self.size)
        return self._stop_layer.draw(photograph, camera, self.size), below

    @property
    def _shows_stops(self) -> bool:
        """Whether photographs are shown at panoramas."""
        return self._state.stops and self._state.settings.shows_scene and len(self.photographs) > 0

    def _plan_resolution(self) -> ResolutionPlan:
        """The plan of the frame, from the movement since the last one."""
        camera = self._state.camera
        moved = camera.position != self.last_camera.position
        turned = not moved and camera != self.last_camera
        elapsed, moves = max(self._state.now - self._last_frame, 1e-3), self._state.playing
        steps = [new - old for new, old in zip(camera.position, self.last_camera.position, strict=True)]
        share = min(_EXPOSURE_SECONDS / elapsed, 1.0) if moves and math.hypot(*steps) < _JUMP else 0.0
        self._shift = share * steps[0], share * steps[1], share * steps[2]
        self.last_camera, self._last_frame = camera, self._state.now
        self.resolution.limit(self.size, self.renderer.pacing.min_size)
        return self.resolution.plan(self._state.now, moved=moved, turned=turned)

    def _record_time(self, plan: ResolutionPlan, milliseconds: float) -> None:
        if milliseconds > 0:  # else the image is not new, or not finished
            timed = self.renderer.stats.timed
            timed_plan = plan if timed is None else ResolutionPlan(timed.scale, cached=timed.cached)
            self.resolution.record(timed_plan, milliseconds)

    def _draw_content(self, slot: int, plan: ResolutionPlan) -> tuple[moderngl.Texture | None, float]:
        """The image of a slot of the fade, None if there is none yet, and the milliseconds of drawing a new one."""
        state, content, pose = self._state, self.fade.contents[slot], self.fade.poses[slot]
        pose = state.camera.cam2world if pose is None else pose
        if isinstance(content, int):
            photograph = self.get_photograph(content)
            if photograph is None:
                return None, 0.0
            return self._layers[slot].draw(photograph, cameras.move_to_pose(state.camera, pose), self.size), 0.0
        scene_slot = self.slots[slot]
        if content is None or scene_slot.scene is None:
            return None, 0.0
        settings = fit_settings(state.draw_settings, scene_slot.scene)  # that which fades may have fewer views
        milliseconds = self._render(scene_slot, pose, settings, plan)
        return scene_slot.image, milliseconds

    def _render(
        self, slot: RenderedScene, cam2world: Float[np.ndarray, "4 4"], settings: DrawSettings, plan: ResolutionPlan
    ) -> float:
        """Draw the image of this plan; returns milliseconds, 0 if it is not new."""
        settings = replace(settings, cached=plan.cached, shift=self._shift)
        if not (plan.cached and slot.renderer.has_faces(cam2world, self.size, settings)):
            settings = replace(settings, scale=plan.scale)
        wait = plan.moving and slot.renderer.pacing.waits_while_moving
        return slot.draw(cam2world, self.size, settings, wait=wait)

    def release(self) -> None:
        """Stop the threads and free every GL object."""
        self.preparer.close()
        for layer in (*self._layers, self._stop_layer, self._zoom_layer):
            layer.release()
        self.presenter.release()
        self.photographs.release()
        for slot in self.slots:
            slot.renderer.release()


def describe_error(error: Exception) -> str:
    """The text of an error of drawing."""
    if isinstance(error, MemoryError):
        return f"the memory is exhausted ({type(error).__name__}: {error}); open a scene with fewer Gaussians"
    return f"OpenGL failed: {error}" if isinstance(error, moderngl.Error) else str(error)
