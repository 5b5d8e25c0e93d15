"""Layers: premultiplied images of sets of Gaussians, drawn directly or as six cube faces and kept between frames.

`LayerPainter.paint` draws the parts of a layer that a frame reads and that are not valid. `SplatRasterizer` draws
splats with OpenGL: it projects Gaussians to records and rasterises the records as quads, back to front.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

import moderngl
import numpy as np
from jaxtyping import Bool, Float, UInt

from pansplat.errors import InputError
from pansplat_viewer.core.camera import Pinhole
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.draw.frames import Frame
from pansplat_viewer.draw.programs import RECORD, RECORD_BYTES, Programs, Resources, checking_memory, set_uniforms
from pansplat_viewer.draw.splats import SortedSplats, Splats

_MAX_SELECTIONS = 8  # masks of levels and views that are kept, a byte a Gaussian each
_CHUNK_SIZE = 1 << 20  # records that are made and drawn together; limits their memory to 100 MB

Viewport = tuple[int, int, int, int]  # left, bottom, width, height, pixels


class Target:
    """A render target: a framebuffer with an RGBA colour texture and an optional float32 texture for depth.

    Attributes:
        key: identifies the values that the content depends on; None if there is no valid content.
        parts: the parts (cube faces; 0 if there is one part) whose content is valid.
    """

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int], color_bits: int, depth_components: int) -> None:
        """Allocate the textures; their content is undefined.

        Raises:
            MemoryError: the GPU's memory is exhausted.
        """
        self._ctx = ctx
        self.size = size
        self.key: Hashable = None
        self.parts: set[int] = set()
        self._resources = Resources()
        keep = self._resources.keep
        try:
            with checking_memory(ctx):
                self.color = keep(ctx.texture(size, 4, dtype=f"f{color_bits // 8}"))
                self.color.repeat_x = self.color.repeat_y = False
                self.depth = keep(ctx.texture(size, depth_components, dtype="f4")) if depth_components else None
                attachments = [self.color] if self.depth is None else [self.color, self.depth]
                self.framebuffer = keep(ctx.framebuffer(attachments))
        except BaseException:
            self._resources.release()
            raise
        self.num_bytes = size[0] * size[1] * (color_bits // 2 + 4 * depth_components)

    def invalidate(self, key: Hashable) -> None:
        """Mark the content as invalid; `key` is that of the next content."""
        self.key = key
        self.parts.clear()

    def release(self) -> None:
        """Free the textures."""
        if self._ctx.fbo is self.framebuffer:
            # moderngl binds the previous framebuffer again after it creates one, so the previous one must exist.
            (self._ctx.screen or self._ctx.detect_framebuffer(0)).use()
        self._resources.release()


class TargetStore:
    """Render targets by name, reused while size and depth match; least recently used ones are freed over a budget."""

    def __init__(self, ctx: moderngl.Context, *, color_bits: int, budget_bytes: int = 1 << 30) -> None:
        """Create an empty store."""
        self._ctx = ctx
        self._max_size = ctx.info["GL_MAX_TEXTURE_SIZE"]
        self.color_bits = color_bits
        self._budget = budget_bytes
        self._targets: OrderedDict[Hashable, Target] = OrderedDict()
        self._in_use: set[Hashable] = set()

    def get(self, name: Hashable, size: tuple[int, int], *, depth_components: int = 0, key: Hashable = None) -> Target:
        """Return the target of this name and size, with content of the same `key` or without valid content.

        A target with valid content keeps its depth texture even if the call does not need it.
        """
        if max(size) > self._max_size:
            raise InputError(
                f"the image needs a texture of {size[0]}x{size[1]} pixels, this GPU's limit is {self._max_size}; "
                "use a smaller size"
            )
        target = self._targets.get(name)
        if target is not None:
            components = 0 if target.depth is None else target.depth.components
            valid = key is not None and target.key == key
            if target.size != size or components < depth_components or (components > depth_components and not valid):
                self._targets.pop(name).release()
                target = None
        if target is None:
            target = Target(self._ctx, size, self.color_bits, depth_components)
            self._targets[name] = target
        if key is None or target.key != key:
            target.invalidate(key)
        self._targets.move_to_end(name)
        self._in_use.add(name)
        return target

    def trim(self) -> None:
        """Free least recently used targets over the budget, except those returned since the last call."""
        total = sum(target.num_bytes for target in self._targets.values())
        for name in [name for name in self._targets if name not in self._in_use]:
            if total <= self._budget:
                break
            target = self._targets.pop(name)
            total -= target.num_bytes
            target.release()
        self._in_use.clear()

    def invalidate(self) -> None:
        """Mark the content of all targets as invalid."""
        for target in self._targets.values():
            target.invalidate(None)

    def release(self) -> None:
        """Free all targets."""
        for target in self._targets.values():
            target.release()
        self._targets.clear()


class LayerPainter:
    """Draws the layers of one scene and keeps them in a target store."""

    def __init__(self, ctx: moderngl.Context, programs: Programs, targets: TargetStore, splats: Splats) -> None:
        """Upload the splats."""
        self._targets = targets
        self._splats = splats
        self._selections: dict[Hashable, Bool[np.ndarray, "n"]] = {}
        self.rasterizer = SplatRasterizer(ctx, programs, splats)

    def paint(self, frame: Frame, splats: SortedSplats, view: int | None, *, with_depth: bool) -> Target:
        """Return the layer of one view's Gaussians, or of all (None); draws the parts in view that are not valid."""
        selected = self._select(frame.settings, view)
        cameras = frame.create_layer_cameras()
        width, height = cameras[0].width, cameras[0].height
        size = (3 * width, 2 * height) if frame.has_faces else (width, height)
        target = self._targets.get(
            (frame.has_faces, view), size, depth_components=int(with_depth), key=frame.create_layer_key(splats)
        )
        missing = [part for part in frame.find_parts_in_view() if part not in target.parts]
        places = {part: (part % 3 * width, part // 3 * height, width, height) for part in missing}
        target.framebuffer.use()
        for place in places.values():
            target.framebuffer.viewport = target.framebuffer.scissor = place
            target.framebuffer.clear(0.0, 0.0, 0.0, 0.0)
        target.framebuffer.scissor = None
        for part, place in places.items():
            target.framebuffer.viewport = place
            self.rasterizer.draw(cameras[part], place, splats, selected, frame.settings)
        target.parts.update(missing)
        return target

    def release(self) -> None:
        """Free the splats on the GPU."""
        self.rasterizer.release()

    def _select(self, settings: DrawSettings, view: int | None) -> Bool[np.ndarray, "n"]:
        key = (settings.levels, view)
        if key not in self._selections:
            if len(self._selections) > _MAX_SELECTIONS:
                self._selections.clear()
            self._selections[key] = self._splats.select(*key)
        return self._selections[key]


class SplatRasterizer:
    """Draws the splats of one scene with OpenGL: the processor culls and sorts, transform feedback makes records."""

    def __init__(self, ctx: moderngl.Context, programs: Programs, splats: Splats) -> None:
        """Upload the geometry and constant colours, and allocate buffers for indices and records.

        Raises:
            MemoryError: the GPU's memory is exhausted.
            moderngl.Error: the driver refuses a program or a buffer.
        """
        self._ctx = ctx
        self._programs = programs
        self._capacity = max(min(_CHUNK_SIZE, len(splats)), 1)
        self._resources = Resources()
        try:
            with checking_memory(ctx):
                self._allocate(splats)
        except BaseException:
            self._resources.release()
            raise

    def _allocate(self, splats: Splats) -> None:
        ctx, programs, keep = self._ctx, self._programs, self._resources.keep
        self._geometry = keep(ctx.buffer(splats.geometry) if len(splats) else ctx.buffer(reserve=48))
        self._colors = keep(ctx.buffer(reserve=max(16 * len(splats), 16), dynamic=True))
        if splats.base_colors is not None:
            self.write_colors(splats.base_colors)
        self._records = keep(ctx.buffer(reserve=RECORD_BYTES * self._capacity, dynamic=True))
        self._quads = keep(ctx.vertex_array(programs.splat(), [(self._records, "4f " * len(RECORD) + "/i", *RECORD)]))
        self._indices = keep(ctx.buffer(reserve=4 * self._capacity, dynamic=True))
        rows = self._geometry, "4f 4f 4f", "in_mean_opacity", "in_quat", "in_scale"
        self._points = keep(
            ctx.vertex_array(
                programs.project(),
                [rows, (self._colors, "4f", "in_color")],
                index_buffer=self._indices,
                index_element_size=4,
                mode=moderngl.POINTS,
            )
        )

    def write_colors(self, colors: Float[np.ndarray, "n 4"]) -> None:
        """Replace the colours."""
        if len(colors):
            self._colors.write(colors)

    def draw(
        self,
        camera: Pinhole,
        place: Viewport,
        splats: SortedSplats,
        selected: Bool[np.ndarray, "n"],
        settings: DrawSettings,
    ) -> None:
        """Blend the selected splats that a camera sees into the framebuffer in use, whose viewport is `place`."""
        self._set_uniforms(camera, place, settings)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        self._draw_in_order(splats.find_back_to_front(camera, selected, settings.largest_blur))
        self._ctx.enable_only(moderngl.NOTHING)

    def release(self) -> None:
        """Free the buffers and vertex arrays."""
        self._resources.release()

    def _draw_in_order(self, back_to_front: UInt[np.ndarray, "n"]) -> None:
        """Project the splats with these indices by transform feedback, and draw them."""
        for start in range(0, len(back_to_front), self._capacity):
            indices = np.ascontiguousarray(back_to_front[start : start + self._capacity], dtype=np.uint32)
            self._indices.write(indices)
            self._points.transform(self._records, moderngl.POINTS, vertices=len(indices))
            self._quads.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(indices))

    def _set_uniforms(self, camera: Pinhole, place: Viewport, settings: DrawSettings) -> None:
        set_uniforms(
            self._programs.project(),
            # GLSL reads columns: the rows of camera-to-world are the columns of its inverse.
            world_to_camera=np.ascontiguousarray(camera.rotation, dtype=np.float32).tobytes(),
            position=camera.position,
            near=settings.near,
            filter_variance=camera.filter_deviation**2,
            half_size=camera.half_size,
            margin=0.02 / camera.focal,
            shift=tuple((camera.rotation.T @ settings.shift).tolist()),
        )
        x, y, width, height = place
        set_uniforms(
            self._programs.splat(),
            half_size=camera.half_size,
            focal=(camera.focal, camera.focal),
            principal=(x + 0.5 * width, y + 0.5 * height),
        )
