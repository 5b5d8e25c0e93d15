"""Draws a scene's Gaussians with OpenGL into a texture: any pose, pinhole or panorama, any blending mode.

Needs no window. GL objects belong to the context's thread: call everything from there. A picture is made in
three steps: splats into layers (one a set of Gaussians: all, or one context view's), layers added with
weights, the sum over the background. Layers are kept until something that changes them has changed.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Literal

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat_viewer.compose import Composer
from pansplat_viewer.draw import SplatDrawer, choose_tier
from pansplat_viewer.layers import LayerPainter, Shot
from pansplat_viewer.order import Ordering, Sorter, make_ordering
from pansplat_viewer.programs import Programs
from pansplat_viewer.settings import DrawSettings, FrameStats
from pansplat_viewer.splats import SplatBuffers, Splats
from pansplat_viewer.targets import Target, TargetStore

_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software")

__all__ = ["DrawSettings", "FrameStats", "SplatRenderer"]


class SplatRenderer:
    """Renders scenes of 3D Gaussians on an OpenGL 3.3 or 4.3 context.

    Blending is off and the framebuffer bound before the call is bound again after each call.

    Attributes:
        stats: counts and times of the last frame.
        tier: `gl33` or `gl43`, the same picture either way.
        num_views: context views of the uploaded scene.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        *,
        tier: Literal["auto", "gl33", "gl43"] = "auto",
        color_bits: Literal[16, 32] | None = None,
    ) -> None:
        """`color_bits` of the targets: 16 for a window, 32 for checks and captures.

        None takes 16 on a GPU and 32 where GL runs in software, which truncates half floats so that pictures
        darken with every layer, and for which 32 cost no more.

        Raises:
            InputError: `tier` is more than the context can do, or `color_bits` is neither.
        """
        if color_bits is None:
            software = any(name in ctx.info["GL_RENDERER"].lower() for name in _SOFTWARE)
            color_bits = 32 if software else 16
        if color_bits not in (16, 32):
            raise InputError(f"`color_bits` must be 16 or 32, got {color_bits}")
        self.tier = choose_tier(ctx, tier)
        self.stats = FrameStats(tier=self.tier)
        self._ctx = ctx
        self._programs = Programs(ctx)
        self._targets = TargetStore(ctx, color_bits=color_bits)
        self._composer = Composer(ctx, self._programs, self._targets)
        self._sorter = Sorter()
        self._buffers: SplatBuffers | None = None
        self._painter: LayerPainter | None = None
        self._drawer: SplatDrawer | None = None
        self._ordering: Ordering | None = None
        self._shot: Shot | None = None
        self._picture: Target | None = None

    @property
    def num_views(self) -> int:
        """Context views of the uploaded scene."""
        return self._buffers.splats.num_views if self._buffers is not None else 0

    def upload(self, scene: Scene) -> None:
        """Replace the scene on the GPU; Gaussians with NaN or infinity are left out and counted."""
        splats = Splats.from_scene(scene)
        self._release_scene()
        self._buffers = SplatBuffers(self._ctx, splats)
        self._drawer = SplatDrawer(self._ctx, self._programs, self._buffers, self.tier)
        self._painter = LayerPainter(self._drawer, self._targets, self._ctx.info["GL_MAX_TEXTURE_SIZE"])
        self.stats = FrameStats(total=len(splats), dropped=splats.dropped, tier=self.tier)

    def render(
        self,
        cam2world: Float[np.ndarray, "4 4"],
        size: tuple[int, int],
        settings: DrawSettings,
        *,
        wait: bool = True,
    ) -> moderngl.Texture:
        """Draw the scene and return the picture's texture.

        Args:
            cam2world: rigid pose, OpenCV axes, metres.
            size: (width, height) in pixels.
            settings: what to draw and how.
            wait: sort for exactly this position first; False draws at once with the last order while a thread
                makes the new one (`stats.settled` is then False: render again until it is True).

        Returns:
            RGBA texture, colour over the background, alpha the coverage; GL's bottom row first, so that it
            shows upright when drawn as any texture. Its content changes with the next call.

        Raises:
            InputError: nothing is uploaded, the size or a setting does not fit the scene or the GPU.
        """
        start = time.perf_counter()
        if self._buffers is None:
            raise InputError("there is no scene to draw; call `upload` first")
        previous = self._ctx.fbo
        shot = Shot.make(self._buffers.splats, np.asarray(cam2world, dtype=np.float64), size, settings)
        settled = self._update_ordering(shot, wait)
        self._shot = shot
        self._draw(shot, with_depth=False)
        self._ctx.finish()
        _bind(previous)
        self.stats = dataclasses.replace(self.stats, settled=settled, frame_ms=1e3 * (time.perf_counter() - start))
        assert self._picture is not None
        return self._picture.color

    def read_color(self) -> Float[np.ndarray, "height width 4"]:
        """The last picture, float32, top row first: RGB over the background and coverage."""
        return self._read(0, 4)

    def read_depth(self) -> Float[np.ndarray, "height width"]:
        """Radial depth of the last picture in metres, float32, top row first; 0 where nothing is drawn.

        Windows rarely need it, so it is drawn when asked for. Mode `difference` gives the depths' difference.
        """
        if self._picture is None or self._shot is None:
            raise InputError("there is no picture to read; call `render` first")
        if self._picture.depth is None:
            previous, stats = self._ctx.fbo, self.stats
            self._draw(self._shot, with_depth=True)
            self.stats = stats
            _bind(previous)
        return self._read(1, 1)[..., 0]

    def release(self) -> None:
        """Stop the sorting thread and free every GL object."""
        self._sorter.close()
        self._release_scene()
        self._composer.release()
        self._targets.release()
        self._programs.release()

    def _draw(self, shot: Shot, *, with_depth: bool) -> None:
        painter, ordering = self._painter, self._ordering
        assert painter is not None and ordering is not None
        painter.start(shot, ordering, with_depth=with_depth)
        self._picture = self._composer.compose(shot, painter)
        self._targets.trim(painter.in_use | self._composer.in_use)
        self.stats = FrameStats(
            total=len(ordering.splats),
            dropped=ordering.splats.dropped,
            visible=painter.visible,
            drawn=painter.drawn,
            sort_ms=ordering.milliseconds,
            tier=self.tier,
            cached=not painter.painted,
        )

    def _update_ordering(self, shot: Shot, wait: bool) -> bool:
        """Bring the order to the shot's position or ask for it; True when it fits the position."""
        assert self._buffers is not None
        splats, position = self._buffers.splats, shot.position
        if self._ordering is None or (wait and self._ordering.position != position):
            self._adopt(make_ordering(splats, position))
        elif self._ordering.position != position:
            ready = self._sorter.take()
            if ready is not None and ready.splats is splats:
                self._adopt(ready)
            if self._ordering.position != position:
                self._sorter.request(splats, position)
        assert self._ordering is not None
        return self._ordering.position == position

    def _adopt(self, ordering: Ordering) -> None:
        assert self._buffers is not None
        if ordering.colors is not None:
            self._buffers.write_colors(ordering.colors)
        self._ordering = ordering

    def _read(self, attachment: int, components: int) -> np.ndarray:
        if self._picture is None:
            raise InputError("there is no picture to read; call `render` first")
        width, height = self._picture.size
        data = self._picture.framebuffer.read(components=components, attachment=attachment, dtype="f4", alignment=1)
        return np.frombuffer(data, np.float32).reshape(height, width, components)[::-1].copy()

    def _release_scene(self) -> None:
        if self._drawer is not None:
            self._drawer.release()
        if self._buffers is not None:
            self._buffers.release()
        self._drawer = self._buffers = self._painter = self._ordering = None
        self._shot = self._picture = None
        self._targets.forget()


def _bind(framebuffer: moderngl.Framebuffer | None) -> None:
    """Bind a framebuffer again unless it is gone: on a context without a window it may be one of ours."""
    if framebuffer is not None and hasattr(framebuffer.mglo, "use"):
        framebuffer.use()
