"""Layers: premultiplied images of sets of Gaussians, drawn directly or as six cube faces and kept between frames.

`LayerPainter.paint` draws the parts of a layer that a frame reads and that are not valid. `SplatRasterizer` draws
splats with OpenGL: it projects Gaussians to records and rasterises the records as quads, back to front.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import moderngl
import numpy as np
from jaxtyping import Bool, Float, UInt

from pansplat.constants import FILTER_VARIANCE
from pansplat.errors import InputError
from pansplat_viewer.draw.gpu_sort import MAX_PARTS, GpuSplats
from pansplat_viewer.draw.programs import RECORD, RECORD_BYTES, Programs, Resources, checking_memory, set_uniforms
from pansplat_viewer.draw.splats import SortedSplats, Splats
from pansplat_viewer.scene.camera import Pinhole, create_face_cameras, find_faces_in_view
from pansplat_viewer.scene.settings import DrawSettings

_MAX_CACHED_FACE_SIZE = 2048  # pixels; six faces take 200 MB at 16 bits
_MAX_SELECTIONS = 8
_CAMERAS_UNIT = 9  # texture unit
_CLIP_DISTANCE_0 = 0x3000  # GL_CLIP_DISTANCE0
_CHUNK_SIZE = 1 << 20  # records that are made and drawn together; limits their memory to 100 MB

Viewport = tuple[int, int, int, int]  # left, bottom, width, height, pixels


class LayerStorage(IntEnum):
    """How a layer is stored; the constant LAYER_STORAGE of shaders/accumulate.frag.

    IMAGE is one image of the frame's size. PADDED_FACES are six cube faces with one extra pixel on each side, which
    the texture unit can filter. FACES are six cube faces without border, interpolated in float32 by the shader.
    """

    IMAGE = 0
    PADDED_FACES = 1
    FACES = 2


@dataclass(frozen=True, eq=False)
class Frame:
    """One image to draw: camera, size and settings, and the values that follow from them."""

    rotation: Float[np.ndarray, "3 3"]  # camera to world
    position: tuple[float, float, float]  # camera centre in the splats' moved frame
    world_position: Float[np.ndarray, "3"]  # camera centre, metres
    size: tuple[int, int]  # (width, height) at which the image is drawn, pixels
    settings: DrawSettings
    full_size: tuple[int, int]  # (width, height) without `settings.scale`

    @staticmethod
    def create(splats: Splats, cam2world: np.ndarray, size: tuple[int, int], settings: DrawSettings) -> Frame:
        """Check the arguments and return the frame."""
        if cam2world.shape != (4, 4) or not np.isfinite(cam2world).all():
            raise InputError(f"`cam2world` must be a finite 4x4 matrix, got {cam2world.tolist()}")
        width, height = (int(length) for length in size)
        if width < 1 or height < 1:
            raise InputError(f"`size` must be at least 1x1 pixel, got {width}x{height}")
        moved = cam2world[:3, 3] - splats.origin
        position = (float(moved[0]), float(moved[1]), float(moved[2]))
        drawn = max(round(width * settings.scale), 1), max(round(height * settings.scale), 1)
        return Frame(cam2world[:3, :3], position, cam2world[:3, 3], drawn, settings, (width, height))

    @property
    def storage(self) -> LayerStorage:
        """How this frame's layers are stored."""
        if self.settings.layout == "equirect":
            return LayerStorage.FACES
        if self.settings.cached and self.face_size <= _MAX_CACHED_FACE_SIZE:
            return LayerStorage.PADDED_FACES
        return LayerStorage.IMAGE

    @property
    def focal(self) -> float:
        """Focal length of a pinhole image, pixels."""
        return 0.5 * self.size[1] / math.tan(0.5 * math.radians(self.settings.vertical_fov_degrees))

    @property
    def face_size(self) -> int:
        """Side of a cube face without border, pixels: the resolution of the equator, or of the image's centre."""
        if self.settings.layout == "equirect":
            return max(round(2 * self.size[1] / math.pi), 1)
        return max(math.ceil(2 * self.focal), 1)

    @property
    def faces_to_world(self) -> Float[np.ndarray, "3 3"]:
        """Axes of the cube: those of the panorama camera, or of the world for faces that serve every rotation."""
        return self.rotation if self.settings.layout == "equirect" else np.eye(3)

    @property
    def camera_to_faces(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the camera's axes to the cube's."""
        return self.faces_to_world.T @ self.rotation

    @property
    def _pinhole(self) -> Pinhole:
        return Pinhole(self.rotation, self.position, self.focal, *self.size)

    def create_layer_cameras(self) -> list[Pinhole]:
        """Return the cameras of a layer's parts: one, or one for each cube face."""
        if self.storage == LayerStorage.IMAGE:
            return [self._pinhole]
        border = 1 if self.storage == LayerStorage.PADDED_FACES else 0
        return create_face_cameras(self.faces_to_world, self.position, self.face_size, border)

    def find_parts_in_view(self) -> list[int]:
        """Return the indices of the layer parts that the frame reads."""
        if self.storage == LayerStorage.IMAGE:
            return [0]
        if self.storage == LayerStorage.FACES:
            return list(range(6))
        return find_faces_in_view(self.camera_to_faces, self._pinhole.half_size)

    def create_layer_key(self, splats: SortedSplats) -> tuple[Hashable, ...]:
        """Return the values that a layer's content depends on, except its set of Gaussians."""
        s = self.settings
        key = (splats, self.position, s.preset, *s.selection, s.near)
        key += (s.splat_colors, s.outside)
        if self.storage == LayerStorage.IMAGE:
            return (*key, self.rotation.tobytes(), self.focal)
        return (*key, self.faces_to_world.tobytes())


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


@dataclass(frozen=True, eq=False)
class Layer:
    """The premultiplied image of one set of Gaussians, and the work that it took in this frame."""

    target: Target
    visible: int  # number of Gaussians in the set
    drawn: int  # number of splats drawn for this frame
    cached: bool  # whether all parts in view were valid before


class LayerPainter:
    """Draws the layers of one scene and keeps them in a target store."""

    def __init__(self, ctx: moderngl.Context, programs: Programs, targets: TargetStore, splats: Splats, tier: str):
        """Upload the splats."""
        self._targets = targets
        self._splats = splats
        self._selections: dict[Hashable, Bool[np.ndarray, "n"]] = {}
        self.rasterizer = SplatRasterizer(ctx, programs, splats, tier)

    def paint(self, frame: Frame, splats: SortedSplats, view: int | None, *, with_depth: bool) -> Layer:
        """Return the layer of one view's Gaussians, or of all (None); draws the parts in view that are not valid."""
        selected = self._select(frame.settings, view)
        cameras = frame.create_layer_cameras()
        width, height = cameras[0].width, cameras[0].height
        size = (width, height) if frame.storage == LayerStorage.IMAGE else (3 * width, 2 * height)
        target = self._targets.get(
            (frame.storage, view), size, depth_components=int(with_depth), key=frame.create_layer_key(splats)
        )
        missing = [part for part in frame.find_parts_in_view() if part not in target.parts]
        places = {part: (part % 3 * width, part // 3 * height, width, height) for part in missing}
        target.framebuffer.use()
        for place in places.values():
            target.framebuffer.viewport = target.framebuffer.scissor = place
            target.framebuffer.clear(0.0, 0.0, 0.0, 0.0)
        target.framebuffer.scissor = None
        drawn, settings = 0, frame.settings
        # One order by distance serves all parts, so the GPU draws them together.
        together = self.rasterizer.draws_parts_together and settings.is_exact
        for parts in [missing] if together and missing else [[part] for part in missing]:
            drawn += self.rasterizer.draw(
                target.framebuffer,
                [(cameras[part], places[part]) for part in parts],
                splats,
                selected,
                view,
                settings,
            )
        target.parts.update(missing)
        return Layer(target, int(np.count_nonzero(selected)), drawn, cached=not missing)

    def release(self) -> None:
        """Free the splats on the GPU."""
        self.rasterizer.release()

    def _select(self, settings: DrawSettings, view: int | None) -> Bool[np.ndarray, "n"]:
        key = (settings.selection, view)
        if key not in self._selections:
            if len(self._selections) > _MAX_SELECTIONS:
                self._selections.clear()
            self._selections[key] = self._splats.select(*key)
        return self._selections[key]


def compute_filter_variance(settings: DrawSettings, focal: float) -> float:
    """Variance of the low-pass filter (docs/rendering.md, section 2), in image-plane units squared."""
    return FILTER_VARIANCE["angular" if settings.is_exact else "3dgs"] / (focal * focal)


class SplatRasterizer:
    """Draws the splats of one scene with OpenGL.

    Tier `gl33` culls and sorts on the processor and makes records by transform feedback. Tier `gl43` does all of it by
    compute shaders (`GpuSplats`). Both draw the same records in the same order.

    Attributes:
        tier: `gl33` or `gl43`.
    """

    def __init__(self, ctx: moderngl.Context, programs: Programs, splats: Splats, tier: str) -> None:
        """Upload the geometry and constant colours, and allocate buffers for indices and records.

        Raises:
            MemoryError: the GPU's memory is exhausted.
            moderngl.Error: the driver refuses a program or a buffer.
        """
        self._ctx = ctx
        self._programs = programs
        self.tier = tier
        self._capacity = max(min(_CHUNK_SIZE, len(splats)), 1)
        self._indices: moderngl.Buffer | None = None
        self._points: moderngl.VertexArray | None = None
        self._gpu: GpuSplats | None = None
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
        cameras = np.zeros((max(len(splats.view_positions), 1), 4), np.float32)
        cameras[: len(splats.view_positions), :3] = splats.view_positions - splats.origin
        self._cameras = keep(ctx.texture((len(cameras), 1), 4, cameras, dtype="f4"))
        self._records = keep(ctx.buffer(reserve=RECORD_BYTES * self._capacity, dynamic=True))
        self._quads = keep(ctx.vertex_array(programs.splat(), [(self._records, "4f " * len(RECORD) + "/i", *RECORD)]))
        if self.tier == "gl43":
            buffers = self._geometry, self._colors, self._records
            self._gpu = GpuSplats(ctx, programs, self._resources, *buffers, len(splats), self._capacity)
            return
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

    @property
    def draws_parts_together(self) -> bool:
        """Whether several parts of a layer can be drawn at once."""
        return self._gpu is not None

    def draw(
        self,
        framebuffer: moderngl.Framebuffer,
        parts: Sequence[tuple[Pinhole, Viewport]],
        splats: SortedSplats,
        selected: Bool[np.ndarray, "n"],
        view: int | None,
        settings: DrawSettings,
    ) -> int:
        """Blend the selected splats that the cameras see into their places in a framebuffer.

        Args:
            framebuffer: the target.
            parts: cameras of one size and position, and their places; only tier `gl43` draws several.
            splats: sorted for a position; tier `gl43` reads the position only.
            selected: the splats to draw, those of `view` and the settings' levels and opacity.
            view: of the layer, or None.
            settings: draw settings.

        Returns:
            The number of splats, or 0 if only the GPU has it: see `take_drawn`.
        """
        cameras = [camera for camera, _ in parts]
        camera, viewport = parts[0]
        if len(parts) > 1:
            viewport = (0, 0, framebuffer.width, framebuffer.height)
        framebuffer.viewport = viewport
        self._set_uniforms(camera, settings)
        self._place_parts([place for _, place in parts], viewport)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        variance = compute_filter_variance(settings, camera.focal)
        drawn = 0
        if self._gpu is not None:
            for distance in range(4 if len(parts) > 1 else 0):
                self._ctx.enable_direct(_CLIP_DISTANCE_0 + distance)
            selection = settings.selection, view
            self._gpu.draw(self._quads, cameras, splats.position, selected, selection, settings, variance)
            for distance in range(4 if len(parts) > 1 else 0):
                self._ctx.disable_direct(_CLIP_DISTANCE_0 + distance)
        else:
            seen = splats.cull(camera, selected, variance, bounded=settings.is_exact)
            drawn = self._draw_in_order(splats.sort_back_to_front(camera, seen, by_depth=not settings.is_exact))
        self._ctx.enable_only(moderngl.NOTHING)
        return drawn

    def take_drawn(self) -> int:
        """Number of splats that the GPU has culled to and drawn since the last call."""
        return 0 if self._gpu is None else self._gpu.take_drawn()

    def release(self) -> None:
        """Free the buffers and vertex arrays."""
        self._resources.release()

    def _draw_in_order(self, back_to_front: UInt[np.ndarray, "n"]) -> int:
        """Project the splats with these indices by transform feedback, and draw them; returns their number."""
        assert self._indices is not None and self._points is not None
        for start in range(0, len(back_to_front), self._capacity):
            indices = np.ascontiguousarray(back_to_front[start : start + self._capacity], dtype=np.uint32)
            self._indices.write(indices)
            self._points.transform(self._records, moderngl.POINTS, vertices=len(indices))
            self._quads.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(indices))
        return len(back_to_front)

    def _set_uniforms(self, camera: Pinhole, settings: DrawSettings) -> None:
        project = self._programs.project() if self.tier == "gl33" else self._programs.project_compute()
        set_uniforms(
            project,
            # GLSL reads columns: the rows of camera-to-world are the columns of its inverse.
            world_to_camera=np.ascontiguousarray(camera.rotation, dtype=np.float32).tobytes(),
            position=camera.position,
            near=settings.near,
            exact=settings.is_exact,
            filter_variance=compute_filter_variance(settings, camera.focal),
            half_size=camera.half_size,
            margin=0.02 / camera.focal,
            outside=settings.outside,
            cameras=_CAMERAS_UNIT,
        )
        self._cameras.use(_CAMERAS_UNIT)
        set_uniforms(self._programs.splat(), half_size=camera.half_size, focal=camera.focal)

    def _place_parts(self, places: Sequence[Viewport], viewport: Viewport) -> None:
        """Set where the parts of a layer are in the viewport."""
        cells, principals = np.zeros((MAX_PARTS, 4), np.float32), np.zeros((MAX_PARTS, 2), np.float32)
        for part, (x, y, width, height) in enumerate(places):
            centre = np.array((x + 0.5 * width, y + 0.5 * height))
            principals[part] = centre
            scale = width / viewport[2], height / viewport[3]
            cells[part] = *scale, *(2 * (centre - viewport[:2]) / viewport[2:] - 1)
        set_uniforms(self._programs.splat(), cells=cells.tobytes(), principals=principals.tobytes())
