"""Draws a scene's Gaussians with OpenGL into a texture: any pose and blending mode.

Needs no window. All calls must come from the thread of the context. `SplatRenderer._draw` has the data flow of a frame:
the splats are painted into layers (one for each set of Gaussians), and the layers are composed to the image.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Any, Literal

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat_viewer.core.background import BackgroundWorker
from pansplat_viewer.core.settings import SCALAR_MAPS, DrawSettings, FrameStats
from pansplat_viewer.draw.color_maps import get_table
from pansplat_viewer.draw.frame_renderer import Pacing
from pansplat_viewer.draw.frames import Frame, choose_layer_weights
from pansplat_viewer.draw.layers import LayerPainter, Target, TargetStore
from pansplat_viewer.draw.programs import Programs, set_uniforms
from pansplat_viewer.draw.resolution import BUDGET_MS, SETTLE_AFTER
from pansplat_viewer.draw.splats import SortedSplats, Splats, sort_splats

_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software")

# Smallest weight of a view in deferred blending, by the bits of the render targets. With it, a view shows where the
# others are empty (such as the masked tripod of an input); elsewhere it vanishes in rounding.
_MIN_WEIGHT = {16: 1e-4, 32: 2.0**-26}


def is_software(ctx: moderngl.Context) -> bool:
    """Whether the context draws on the processor."""
    return any(name in ctx.info["GL_RENDERER"].lower() for name in _SOFTWARE)


_COLOR_MAP_UNIT = 8  # the texture unit of the colour map; layers have those before it


class SplatRenderer:
    """Renders scenes of 3D Gaussians on a context of OpenGL 3.3; see `FrameRenderer`.

    Each call leaves blending disabled and restores the framebuffer binding.

    Attributes:
        stats: times of the last frame.
    """

    pending: Future[Any] | None = None  # nothing is drawn in the background
    pacing = Pacing(min_size=(1, 1), settle_seconds=SETTLE_AFTER, turn_ms=BUDGET_MS, waits_while_moving=False)

    def __init__(self, ctx: moderngl.Context, *, color_bits: Literal[16, 32] | None = None) -> None:
        """Create the renderer without a scene.

        Args:
            ctx: the current context.
            color_bits: bits per channel of the render targets. None is 16 on a GPU, and 32 on software OpenGL, which
                truncates half floats (images get darker with every layer) and is not slower with 32.
        """
        if color_bits is None:
            color_bits = 32 if is_software(ctx) else 16
        self.stats = FrameStats()
        self._ctx = ctx
        self._programs = Programs(ctx)
        self._targets = TargetStore(ctx, color_bits=color_bits)
        self._compositor = Compositor(ctx, self._programs, self._targets)
        self._sorter: BackgroundWorker[SortedSplats] = BackgroundWorker("splat-sorter")
        self._splats: Splats | None = None
        self._painter: LayerPainter | None = None
        self._sorted: SortedSplats | None = None
        self._color_key: tuple[object, ...] | None = None
        self._frame: Frame | None = None
        self._image: Target | None = None
        self._timer: moderngl.Query | None = ctx.query(time=True)
        # Settings and milliseconds on the processor of the frame that `_timer` has measured.
        self._unread: tuple[DrawSettings, float] | None = None

    prepare = staticmethod(Splats.from_scene)

    def upload(self, scene: Scene, prepared: Splats | None = None) -> None:
        """Replace the scene on the GPU."""
        splats = prepared or self.prepare(scene)
        try:
            painter = self._create_painter(splats)
        except MemoryError:
            before = self._splats
            if before is None:
                raise
            self._release_scene()  # the memory does not hold both scenes
            self._targets.release()
            try:
                painter = self._create_painter(splats)
            except BaseException:
                self._show(before, self._create_painter(before))
                raise
        self._release_scene()
        self._show(splats, painter)

    def _create_painter(self, splats: Splats) -> LayerPainter:
        return LayerPainter(self._ctx, self._programs, self._targets, splats)

    def _show(self, splats: Splats, painter: LayerPainter) -> None:
        self._splats, self._painter = splats, painter
        self._unread = None
        self.stats = FrameStats()

    def render(
        self,
        cam2world: Float[np.ndarray, "4 4"],
        size: tuple[int, int],
        settings: DrawSettings,
        *,
        wait: bool = True,
    ) -> moderngl.Texture:
        """See `FrameRenderer`; without `wait`, a worker thread sorts, and the GPU draws while the caller goes on."""
        if self._splats is None:
            raise InputError("there is no scene to draw; call `upload` first")
        before = self._read_times()
        start = time.perf_counter()
        bound = self._ctx.fbo
        frame = Frame.create(self._splats, np.asarray(cam2world, dtype=np.float64), size, settings)
        settled = self._update_order(frame.position, wait)
        self._frame = frame
        with contextlib.nullcontext() if self._timer is None else self._timer:
            image = self._draw(frame, with_depth=False)
        waits = wait or self._timer is None
        if waits:
            self._ctx.finish()
        bind(bound)
        self._unread = settings, 1e3 * (time.perf_counter() - start)
        known = self._read_times() if waits else before
        sort_ms = 0.0 if self._sorted is None else self._sorted.milliseconds
        self.stats = dataclasses.replace(known, settled=settled, sort_ms=sort_ms)
        return image.color

    def _read_times(self) -> FrameStats:
        """Time of the frame that is not read yet, for whose end on the GPU this waits."""
        if self._unread is None:
            return FrameStats()
        (settings, milliseconds), self._unread = self._unread, None
        start = time.perf_counter()
        elapsed = 1e-6 * self._timer.elapsed if self._timer is not None else 0.0
        waited = 1e3 * (time.perf_counter() - start)  # the timer has 32 bits: 4.3 s
        if elapsed == 0:  # some drivers of macOS do not measure: wait for the end of each frame from now on
            self._timer = None
        return FrameStats(frame_ms=max(milliseconds, elapsed, waited), timed=settings)

    def has_faces(self, *_: object) -> bool:
        """See `FrameRenderer`; OpenGL draws a face when it is read."""
        return False

    def draw_faces(self, *_: object) -> None:
        """See `FrameRenderer`; draws nothing."""

    def read_color(self) -> Float[np.ndarray, "height width 4"]:
        """Return the last image, float32, top row first: RGB over the background, and coverage."""
        return self._read(attachment=0, components=4)

    def read_depth(self) -> Float[np.ndarray, "height width"]:
        """Return the radial depth of the last image in metres, float32, top row first; 0 where nothing is drawn.

        `render` draws no depth. The first call after it draws the frame again with depth.
        """
        if self._image is not None and self._frame is not None and self._image.depth is None:
            bound = self._ctx.fbo
            self._draw(self._frame, with_depth=True)
            bind(bound)
        return self._read(attachment=1, components=1)[..., 0]

    def release(self) -> None:
        """Stop the sorting thread and free every GL object."""
        self._sorter.close()
        self._release_scene()
        self._compositor.release()
        self._targets.release()
        self._programs.release()

    def _draw(self, frame: Frame, *, with_depth: bool) -> Target:
        """Paint the layers that the frame needs and compose them to the image."""
        splats, painter = self._sorted, self._painter
        assert splats is not None and painter is not None
        with_depth = with_depth or frame.settings.display == "depth"
        self._write_colors(splats, frame.settings.splat_colors)
        weights = choose_layer_weights(frame, splats.splats, _MIN_WEIGHT[self._targets.color_bits])
        layers = [painter.paint(frame, splats, view, with_depth=with_depth) for view in weights]
        weighted = list(zip(layers, weights.values(), strict=True))
        self._image = self._compositor.compose(frame, weighted, with_depth=with_depth)
        self._targets.trim()
        return self._image

    def _update_order(self, position: tuple[float, float, float], wait: bool) -> bool:
        """Sort for this position, here or in the worker thread; returns whether the order fits the position."""
        assert self._splats is not None
        if self._sorted is None or (wait and self._sorted.position != position):
            self._sorted = sort_splats(self._splats, position)
        elif self._sorted.position != position:
            ready, splats = self._sorter.poll(), self._splats
            if isinstance(ready, BaseException):
                raise ready
            if ready is not None and ready.splats is splats:
                self._sorted = ready
            if self._sorted.position != position and self._sorter.future is None:
                self._sorter.start(lambda _: sort_splats(splats, position))
        return self._sorted.position == position

    def _write_colors(self, splats: SortedSplats, display: str) -> None:
        """Write the colours of the Gaussians unless they are on the GPU."""
        own = splats.splats.base_colors if splats.colors is None else splats.colors
        key = (splats.splats, own if display == "color" else display)
        if self._color_key is not None and all(a is b for a, b in zip(key, self._color_key, strict=True)):
            return
        assert self._painter is not None and own is not None
        self._painter.rasterizer.write_colors(own if display == "color" else splats.splats.color_by(display))
        self._color_key = key

    def _read(self, attachment: int, components: int) -> np.ndarray:
        if self._image is None:
            raise InputError("there is no image to read; call `render` first")
        width, height = self._image.size
        data = self._image.framebuffer.read(components=components, attachment=attachment, dtype="f4", alignment=1)
        return np.frombuffer(data, np.float32).reshape(height, width, components)[::-1].copy()

    def _release_scene(self) -> None:
        if self._painter is not None:
            self._painter.release()
        self._splats = self._painter = self._sorted = self._color_key = self._frame = self._image = None
        self._targets.invalidate()


class Compositor:
    """Adds weighted layers, normalises the sum and puts it over the background."""

    def __init__(self, ctx: moderngl.Context, programs: Programs, targets: TargetStore) -> None:
        """Compile the program of the final pass."""
        self._ctx = ctx
        self._programs = programs
        self._targets = targets
        self._accumulate: dict[bool, moderngl.VertexArray] = {}
        self._resolve = ctx.vertex_array(programs.resolve(), [])
        self._tables: dict[str, moderngl.Texture] = {}

    def compose(self, frame: Frame, weighted: Sequence[tuple[Target, float]], *, with_depth: bool) -> Target:
        """Return the frame's image: RGB over the background, coverage, and depth if the layers have it.

        Args:
            frame: size, camera and background.
            weighted: the layers and their weights.
            with_depth: whether the layers have depth.
        """
        total = self._add_layers(frame, weighted, with_depth)
        image = self._targets.get("image", frame.size, depth_components=int(with_depth))
        image.framebuffer.use()
        image.framebuffer.viewport = (0, 0, *frame.size)
        program = self._programs.resolve()
        set_uniforms(program, background=frame.settings.background)
        self._set_color_map(program, frame.settings)
        self._bind_textures(program, sum_color=total.color, sum_depth=total.depth)
        self._ctx.enable_only(moderngl.NOTHING)
        self._resolve.render(moderngl.TRIANGLES, vertices=3)
        return image

    def release(self) -> None:
        """Free the vertex arrays."""
        for resource in (*self._accumulate.values(), self._resolve, *self._tables.values()):
            resource.release()

    def _set_color_map(self, program: moderngl.Program, settings: DrawSettings) -> None:
        """Set the number that the display shows, and its colours."""
        name = SCALAR_MAPS.get(settings.display)
        scalar = 0 if name is None else 1 if settings.display == "depth" else 2
        set_uniforms(program, scalar=scalar, scalar_max=settings.display_max, color_map=_COLOR_MAP_UNIT)
        if name is None:
            return
        if name not in self._tables:
            self._tables[name] = _create_table_texture(self._ctx, name)
        self._tables[name].use(_COLOR_MAP_UNIT)

    def _add_layers(self, frame: Frame, weighted: Sequence[tuple[Target, float]], with_depth: bool) -> Target:
        target = self._targets.get("sum", frame.size, depth_components=2)
        target.framebuffer.use()
        target.framebuffer.viewport = (0, 0, *frame.size)
        program = self._programs.accumulate(frame.has_faces)
        if frame.has_faces not in self._accumulate:
            self._accumulate[frame.has_faces] = self._ctx.vertex_array(program, [])
        set_uniforms(
            program,
            with_depth=with_depth,
            size=frame.size,
            focal=frame.focal,
            camera_to_faces=np.ascontiguousarray(frame.rotation.T, dtype=np.float32).tobytes(),
            face_size=frame.face_size,
        )
        self._ctx.enable_only(moderngl.NOTHING)  # the first layer overwrites the target, the others are added
        self._ctx.blend_func = moderngl.ONE, moderngl.ONE
        self._ctx.blend_equation = moderngl.FUNC_ADD, moderngl.MAX
        for layer, weight in weighted:
            set_uniforms(program, weight=weight)
            self._bind_textures(program, layer_color=layer.color, layer_depth=layer.depth)
            self._accumulate[frame.has_faces].render(moderngl.TRIANGLES, vertices=3)
            self._ctx.enable_only(moderngl.BLEND)
        self._ctx.enable_only(moderngl.NOTHING)
        self._ctx.blend_equation = moderngl.FUNC_ADD
        return target

    def _bind_textures(self, program: moderngl.Program, **textures: moderngl.Texture | None) -> None:
        for unit, (name, texture) in enumerate(textures.items()):
            # An unused sampler still needs a texture of its type.
            (texture or next(iter(textures.values()))).use(location=unit)  # type: ignore[union-attr]
            set_uniforms(program, **{name: unit})


def _create_table_texture(ctx: moderngl.Context, name: str) -> moderngl.Texture:
    """A colour map as a texture of one row, for look-ups of the nearest colour."""
    table = get_table(name)
    texture = ctx.texture((table.shape[0], 1), 3, table.tobytes(), alignment=1)
    texture.filter, texture.repeat_x = (moderngl.NEAREST, moderngl.NEAREST), False
    return texture


def bind(framebuffer: moderngl.Framebuffer | None) -> None:
    """Bind a framebuffer unless it is released: on a context without a window it may be a freed render target."""
    if framebuffer is not None and hasattr(framebuffer.mglo, "use"):
        framebuffer.use()
