"""The images of a window, for one or two eyes."""

from __future__ import annotations

import math
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat_viewer.draw.cpu_renderer import CpuRenderer, create_renderer
from pansplat_viewer.draw.programs import Programs, set_uniforms
from pansplat_viewer.draw.renderer import SplatRenderer, bind
from pansplat_viewer.scene.settings import DrawSettings, FrameStats, RendererChoice, Stereo

MAX_TURN = math.radians(20)  # of the camera before the eyes follow, while cached faces are read
_MAX_TARGETS = 4


def get_eye_size(size: tuple[int, int], stereo: Stereo) -> tuple[int, int]:
    """(width, height) of the image of one eye in an image of this size."""
    columns, rows = 2 if stereo == "side-by-side" else 1, 2 if stereo == "top-bottom" else 1
    return max(size[0] // columns, 1), max(size[1] // rows, 1)


def _join_sizes(eye_size: tuple[int, int], stereo: Stereo) -> tuple[int, int]:
    """(width, height) of an image of both eyes."""
    return eye_size[0] * (2 if stereo == "side-by-side" else 1), eye_size[1] * (2 if stereo == "top-bottom" else 1)


class StereoRenderer:
    """A `FrameRenderer` of images for one or two eyes over that of OpenGL.

    The second eye has a renderer of its own, made at the first stereo image. While `settings.cached`, the eyes stay
    where they are in the faces, until the camera has turned by `MAX_TURN`; then they move to where they belong.
    """

    pending: Future[Any] | None = None  # nothing is drawn in the background
    pacing = SplatRenderer.pacing
    prepare = staticmethod(SplatRenderer.prepare)

    def __init__(self, renderer: SplatRenderer, ctx: moderngl.Context) -> None:
        """Take over a renderer; `ctx` is its context."""
        self._eyes = [renderer]
        self._ctx = ctx
        self._programs: Programs | None = None
        self._triangle: moderngl.VertexArray | None = None
        self._targets: dict[tuple[int, int], moderngl.Framebuffer] = {}
        self._axis: Float[np.ndarray, "3"] | None = None
        self._stereo: Stereo = "mono"

    @property
    def stats(self) -> FrameStats:
        """Counts and times of the last frame; of two eyes the times are summed."""
        stats = self._eyes[0].stats
        if self._stereo == "mono":
            return stats
        other = self._eyes[1].stats
        return replace(
            stats,
            drawn=stats.drawn + other.drawn,
            frame_ms=stats.frame_ms + other.frame_ms,
            sort_ms=stats.sort_ms + other.sort_ms,
            cached=stats.cached and other.cached,
            settled=stats.settled and other.settled,
            size=_join_sizes(stats.size, self._stereo),
        )

    def upload(self, scene: Scene, prepared: Any = None) -> None:
        """Replace the scene; `prepared` is the result of `prepare`."""
        self._eyes[0].upload(scene, prepared)
        for other in self._eyes[1:]:
            other.release()
        del self._eyes[1:]
        self._stereo = "mono"

    def render(
        self,
        cam2world: Float[np.ndarray, "4 4"],
        size: tuple[int, int],
        settings: DrawSettings,
        *,
        wait: bool = True,
    ) -> moderngl.Texture:
        """Render both eyes; `size` is that of the whole image, `cam2world` is between the eyes."""
        self._stereo = settings.stereo
        if settings.stereo == "mono":
            return self._eyes[0].render(cam2world, size, settings, wait=wait)
        if settings.layout != "pinhole":
            raise InputError(f"stereo of a window is perspective, got layout {settings.layout}; use `render_image`")
        if len(self._eyes) == 1:
            self._eyes.append(self._eyes[0].create_sibling())
        right, axis = cam2world[:3, 0], self._axis
        if axis is None or not settings.cached or float(right @ axis) <= math.cos(MAX_TURN):
            axis = self._axis = right.copy()
        eye_size, eye_settings = get_eye_size(size, settings.stereo), replace(settings, stereo="mono")
        textures = []
        for eye, sign in zip(self._eyes, (-0.5, 0.5), strict=True):
            pose = cam2world.copy()
            pose[:3, 3] += sign * settings.eye_distance * axis
            textures.append(eye.render(pose, eye_size, eye_settings, wait=wait))
        return self._arrange(*textures, settings.stereo)

    def has_faces(self, *_: object) -> bool:
        """Whether cube faces are finished that were drawn in the background: never."""
        return False

    def draw_faces(self, *_: object) -> None:
        """Draw nothing: OpenGL draws a face when it is read."""

    def read_color(self) -> Float[np.ndarray, "height width 4"]:
        """The colours of the left eye's image; `render_image` reads both."""
        return self._eyes[0].read_color()

    def read_depth(self) -> Float[np.ndarray, "height width"]:
        """The depth of the left eye's image, metres."""
        return self._eyes[0].read_depth()

    def release(self) -> None:
        """Release the renderers, and free the textures."""
        self._release_targets()
        if self._triangle is not None and self._programs is not None:
            self._triangle.release()
            self._programs.release()
        for eye in self._eyes:
            eye.release()

    def _release_targets(self) -> None:
        for target in self._targets.values():
            target.color_attachments[0].release()
            target.release()
        self._targets.clear()

    def _arrange(self, left: moderngl.Texture, right: moderngl.Texture, stereo: Stereo) -> moderngl.Texture:
        """One texture of both images."""
        bound = self._ctx.fbo
        target = self._get_target(left.size, stereo, left.dtype)
        if self._programs is None or self._triangle is None:
            self._programs = Programs(self._ctx)
            self._triangle = self._ctx.vertex_array(self._programs.arrange(), [])
        target.use()
        set_uniforms(self._programs.arrange(), left=0, right=1, is_stacked=stereo == "top-bottom")
        left.use(0)
        right.use(1)
        self._ctx.enable_only(moderngl.NOTHING)
        self._triangle.render(moderngl.TRIANGLES, vertices=3)
        bind(bound)
        texture = target.color_attachments[0]
        assert isinstance(texture, moderngl.Texture)
        return texture

    def _get_target(self, eye_size: tuple[int, int], stereo: Stereo, dtype: str) -> moderngl.Framebuffer:
        size = _join_sizes(eye_size, stereo)
        if size not in self._targets:
            if len(self._targets) >= _MAX_TARGETS:
                self._release_targets()
            texture = self._ctx.texture(size, 4, dtype=dtype)
            texture.repeat_x = texture.repeat_y = False
            self._targets[size] = self._ctx.framebuffer([texture])
        return self._targets[size]


WindowRenderer = StereoRenderer | CpuRenderer


def create_window_renderer(ctx: moderngl.Context, choice: RendererChoice) -> WindowRenderer:
    """The renderer of a window; without a GPU it draws one eye."""
    renderer = create_renderer(ctx, choice)
    return renderer if isinstance(renderer, CpuRenderer) else StereoRenderer(renderer, ctx)
