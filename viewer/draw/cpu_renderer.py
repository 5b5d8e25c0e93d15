"""Draws a scene's Gaussians on the processor, for machines without a GPU.

`CpuRenderer` rasterises with numba kernels in a worker thread and uploads the finished image as a texture. Turns are
read from cube faces that are kept for the position.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import Future, TimeoutError
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt32

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.rendering.cpu.display import (
    MIN_TRANSMITTANCE,
    NO_LAYER,
    DisplayScene,
    Layers,
    PixelFaces,
    blend_layers,
    blend_to_pixels,
)
from pansplat.rendering.cpu.rasterize import MIN_TRANSMITTANCE as EXACT_TRANSMITTANCE
from pansplat.rendering.cpu.tiling import LARGEST_SIDE
from pansplat.rendering.image_planes import ImagePlane
from pansplat.system.devices import say_detail
from pansplat.system.kernels import checking_each_item, pooled_empty
from pansplat_viewer.core.background import BackgroundWorker, Report
from pansplat_viewer.core.camera import Pinhole
from pansplat_viewer.core.settings import SCALAR_MAPS, DrawSettings, FrameStats, RendererChoice
from pansplat_viewer.draw.color_maps import color_by_label, map_values
from pansplat_viewer.draw.frame_renderer import Pacing
from pansplat_viewer.draw.frames import Frame, choose_layer_weights
from pansplat_viewer.draw.splats import Splats, drop_not_finite, select_in_view

if TYPE_CHECKING:
    import moderngl

    from pansplat_viewer.draw.renderer import SplatRenderer

_MIN_WEIGHT = 2.0**-26  # least weight of a view in deferred blending, as in OpenGL with 32-bit targets
_POLL_SECONDS = 0.02  # wait for an image in the background, so that a window does not draw the old one again
_MAX_FACE_SETS = 5  # positions whose cube faces are kept; the oldest set goes
_MAX_SELECTIONS = 8  # selections of levels and views that are kept, a byte or two a Gaussian each
_MAX_TEXTURES = 4  # textures of different sizes that are kept


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene as the renderer needs it."""

    splats: Splats  # without `geometry` and `harmonics`, which `scene` has
    scene: DisplayScene


@dataclass(frozen=True, eq=False)
class _Groups:
    """The sets of Gaussians that the layers show."""

    labels: Int[np.ndarray, "n"]  # layer of each Gaussian, or `NO_LAYER`
    weights: Float[np.ndarray, "layer"]  # weight of each layer


@dataclass(frozen=True, eq=False)
class _Picture:
    """A finished image.

    Attributes:
        groups, sums: its layers; None if it was read from cube faces.
    """

    frame: Frame  # its camera, size and settings
    pixels: UInt32[np.ndarray, "height width"]  # at full size, bottom row first
    groups: _Groups | None
    sums: Float[np.ndarray, "layer 5 height width"] | None
    stats: FrameStats


@dataclass(eq=False)
class _FaceSet:
    """Cube faces of one position and settings, and those that are finished."""

    faces: PixelFaces
    groups: _Groups  # its weights are chosen in the direction of the first frame
    done: set[int] = field(default_factory=set)

    def find_missing(self, frame: Frame) -> list[int]:
        """The faces that a frame reads and that are not finished."""
        if len(self.done) == 6:
            return []
        return [face for face in frame.find_parts_in_view() if face not in self.done]


class CpuRenderer:
    """Renders scenes of 3D Gaussians on the processor; see `FrameRenderer`."""

    # The worker draws the faces before a turn, so that reading them is always faster than 1/60 s.
    pacing = Pacing(min_size=(640, 360), settle_seconds=0.02, turn_ms=1000 / 60, waits_while_moving=True)

    def __init__(self, ctx: moderngl.Context | None, *, exact: bool = False) -> None:
        """Create the renderer without a scene.

        Args:
            ctx: the current context; without one, `render` returns no texture and `read_color` has the image.
            exact: continue behind a transmittance of 2^-10, which 8 bits do not show.
        """
        self.stats = FrameStats()
        self._ctx = ctx
        self._min_transmittance = EXACT_TRANSMITTANCE if exact else MIN_TRANSMITTANCE
        self._worker: BackgroundWorker[_Picture | None] = BackgroundWorker("cpu-renderer")
        self._pending: Hashable = None  # identifies the image that the worker draws
        self._splats: Splats | None = None
        self._scene: DisplayScene | None = None
        self._colored: tuple[str, DisplayScene] | None = None  # with the colours of a display
        self._groups: dict[Hashable, Int[np.ndarray, "n"]] = {}
        self._faces: OrderedDict[Hashable, _FaceSet] = OrderedDict()
        self._textures: dict[tuple[int, int], moderngl.Texture] = {}
        self._picture: _Picture | None = None
        self._texture: moderngl.Texture | None = None

    @property
    def pending(self) -> Future[_Picture | None] | None:
        """The image that the worker draws; None if `render` has returned it, or waits for it."""
        return None if self._pending is None else self._worker.future

    @staticmethod
    def prepare(scene: Scene, report: Callable[[float], None] = lambda done: None) -> PreparedScene:
        """See `FrameRenderer`."""
        gaussians = drop_not_finite(scene.gaussians, lambda done: report(0.2 * done))
        finite = replace(scene, gaussians=gaussians)
        splats = Splats.from_scene(finite, lambda done: report(0.2 + 0.4 * done), with_rows=False)
        arrays = (values.detach().numpy() for values in (gaussians.quats, gaussians.scales.abs(), gaussians.harmonics))
        rows = DisplayScene(
            splats.means, splats.opacities, *arrays, splats.reach, lambda done: report(0.6 + 0.4 * done)
        )
        return PreparedScene(splats, rows)

    def upload(self, scene: Scene, prepared: PreparedScene | None = None) -> None:
        """Replace the scene; with `prepared` this takes no time."""
        self._stop()
        prepared = prepared or self.prepare(scene)
        self._splats, self._scene = prepared.splats, prepared.scene
        self._groups.clear()
        self._faces.clear()
        self._picture = self._texture = self._colored = None
        self.stats = FrameStats()

    def render(
        self,
        cam2world: Float[np.ndarray, "4 4"],
        size: tuple[int, int],
        settings: DrawSettings,
        *,
        wait: bool = True,
    ) -> moderngl.Texture | None:
        """See `FrameRenderer`; the texture has 8 bits per channel."""
        if self._splats is None:
            raise InputError("there is no scene to draw; call `upload` first")
        frame = Frame.create(self._splats, np.asarray(cam2world, dtype=np.float64), size, settings)
        if (largest := max(frame.size)) > LARGEST_SIDE:
            raise InputError(
                f"the image needs {largest} pixels a side, the limit is {LARGEST_SIDE}; use a smaller size"
            )
        if frame.has_faces:
            return self._show(self._read_from_faces(frame))
        groups = self._choose_groups(frame)
        key = (frame.rotation.tobytes(), frame.world_position.tobytes(), frame.full_size, settings)
        if self._pending != key:
            self._stop()
            self._start(lambda: self._draw(frame, groups))
            self._pending = key
        assert self._worker.future is not None
        try:
            picture = self._worker.future.result(None if wait else _POLL_SECONDS)
        except TimeoutError:
            self.stats = replace(self.stats, settled=False, frame_ms=0.0)
            return self._texture
        except BaseException:
            self._pending = None
            raise
        self._pending = None
        assert picture is not None
        return self._show(picture)

    def has_faces(self, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings) -> bool:
        """Whether the cube faces that the camera reads are finished."""
        frame = self._create_cached_frame(cam2world, size, settings)
        if not frame.has_faces:
            return False
        stored = self._faces.get(_face_key(frame))
        return stored is not None and not stored.find_missing(frame)

    def draw_faces(self, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings) -> None:
        """Draw the cube faces of a position for the next turn in the worker, unless it works; those in view first."""
        if self._worker.future is not None and not self._worker.future.done():
            return
        frame = self._create_cached_frame(cam2world, size, settings)
        if not frame.has_faces:
            return
        stored = self._find_face_set(frame)
        if len(stored.done) < 6:
            self._start(lambda: self._draw_faces(frame, stored, [*stored.find_missing(frame), *range(6)]))

    def _create_cached_frame(
        self, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings
    ) -> Frame:
        assert self._splats is not None
        return Frame.create(self._splats, np.asarray(cam2world, dtype=np.float64), size, replace(settings, cached=True))

    def read_color(self) -> Float[np.ndarray, "height width 4"]:
        """Return the last image, float32, top row first: RGB over the background, and coverage."""
        return self._blend_last()[0]

    def read_depth(self) -> Float[np.ndarray, "height width"]:
        """Return the radial depth of the last image in metres, float32, top row first; 0 where nothing is drawn."""
        return self._blend_last()[1]

    def release(self) -> None:
        """Stop the worker thread and free the textures."""
        self._worker.close()
        for texture in self._textures.values():
            texture.release()
        self._textures.clear()

    # --- the worker ---

    def _start(self, work: Callable[[], _Picture | None]) -> Future[_Picture | None]:
        """Let the worker do this work, after `_stop`."""

        def run(report: Report) -> _Picture | None:
            report()
            with checking_each_item(report):
                return work()

        self._worker.start(run)
        assert self._worker.future is not None
        return self._worker.future

    def _stop(self) -> None:
        """Stop all work and wait until it has stopped."""
        self._worker.cancel(join=True)
        self._pending = None

    # --- drawing ---

    def _choose_groups(self, frame: Frame) -> _Groups:
        """The sets of Gaussians of a frame and their weights."""
        assert self._splats is not None
        splats, settings = self._splats, frame.settings
        layer_weights = choose_layer_weights(frame, splats, _MIN_WEIGHT)
        views = tuple(layer_weights)
        key = (views, settings.levels)
        if key not in self._groups:
            if len(self._groups) >= _MAX_SELECTIONS:
                self._groups.clear()
            labels = np.full(len(splats), NO_LAYER, np.int16)
            for layer, view in enumerate(views):
                labels[splats.select(settings.levels, view)] = layer
            self._groups[key] = labels
        return _Groups(self._groups[key], np.array(list(layer_weights.values()), np.float32))

    def _draw(self, frame: Frame, groups: _Groups) -> _Picture:
        """Draw the image of a frame."""
        start = time.perf_counter()
        plane = ImagePlane(frame.size[::-1], torch.from_numpy(frame.rotation.copy()), frame.focal)
        layers = self._rasterize(frame, groups, plane)
        sums = layers.sums
        stages = {name: 1e3 * seconds for name, seconds in layers.statistics.seconds.items()}
        pixels = pooled_empty(frame.size[::-1], np.uint32)
        before = time.perf_counter()
        _write_pixels(frame.settings, groups, sums, pixels, bottom_up=True)
        stages["blend"] = 1e3 * (time.perf_counter() - before)
        pixels = _enlarge(frame, pixels, stages)
        now = time.perf_counter()
        return _Picture(frame, pixels, groups, sums, _make_stats(1e3 * (now - start), stages))

    def _rasterize(self, frame: Frame, groups: _Groups, plane: ImagePlane) -> Layers:
        """Rasterise the Gaussians in view of a plane."""
        camera = Pinhole(plane.rotation.numpy(), frame.position, plane.focal, *plane.size[::-1])
        selection = select_in_view(camera, frame.settings.largest_blur)
        return self._find_scene(frame.settings).rasterize(
            np.asarray(frame.position),
            plane,
            groups.labels,
            len(groups.weights),
            frame.settings.near,
            selection=selection,
            min_transmittance=self._min_transmittance,
            shift=frame.settings.shift,
        )

    def _find_scene(self, settings: DrawSettings) -> DisplayScene:
        """The Gaussians with the colours of a display."""
        assert self._scene is not None and self._splats is not None
        name, splats, scene = settings.splat_colors, self._splats, self._scene
        if name == "color":
            return scene
        if self._colored is None or self._colored[0] != name:
            self._colored = name, scene.with_colors(color_by_label(getattr(splats, name)))
        return self._colored[1]

    def _read_from_faces(self, frame: Frame) -> _Picture:
        """Read the image from the cube faces of the position; draws those that are missing."""
        start = time.perf_counter()
        stored = self._find_face_set(frame)
        missing = stored.find_missing(frame)
        stages = {}
        if missing:
            self._stop()
            self._start(lambda: self._draw_faces(frame, stored, missing)).result()
            stages["faces"] = 1e3 * (time.perf_counter() - start)
        pixels = pooled_empty(frame.size[::-1], np.uint32)
        before = time.perf_counter()
        stored.faces.sample(frame.rotation, frame.focal, pixels, bottom_up=True)
        stages["sample"] = 1e3 * (time.perf_counter() - before)
        pixels = _enlarge(frame, pixels, stages)
        return _Picture(frame, pixels, None, None, _make_stats(1e3 * (time.perf_counter() - start), stages))

    def _draw_faces(self, frame: Frame, stored: _FaceSet, faces: Iterable[int]) -> None:
        """Draw the faces that are not finished."""
        for face in faces:
            if face not in stored.done:
                layers = self._rasterize(frame, stored.groups, stored.faces.plane(face))
                _write_pixels(frame.settings, stored.groups, layers.sums, stored.faces.pixels[face])
                stored.done.add(face)

    def _find_face_set(self, frame: Frame) -> _FaceSet:
        """The faces of a frame's position, settings and resolution; the least recently used set is dropped."""
        key = _face_key(frame)
        if key not in self._faces:
            while len(self._faces) >= _MAX_FACE_SETS:
                self._faces.popitem(last=False)
            self._faces[key] = _FaceSet(PixelFaces.allocate(frame.focal), self._choose_groups(frame))
        self._faces.move_to_end(key)
        return self._faces[key]

    # --- results ---

    def _show(self, picture: _Picture) -> moderngl.Texture | None:
        """Upload a picture and return its texture."""
        self._picture = picture
        before = time.perf_counter()
        if self._ctx is not None:
            size = picture.frame.full_size
            limit = self._ctx.info["GL_MAX_TEXTURE_SIZE"]
            if size not in self._textures and max(size) <= limit:
                if len(self._textures) >= _MAX_TEXTURES:
                    for texture in self._textures.values():
                        texture.release()
                    self._textures.clear()
                self._textures[size] = self._ctx.texture(size, 4)
                self._textures[size].repeat_x = self._textures[size].repeat_y = False
            self._texture = self._textures.get(size)
            if self._texture is not None:  # else the image is only read, such as a large panorama
                self._texture.write(picture.pixels)
        upload_ms = 1e3 * (time.perf_counter() - before)
        stats = picture.stats
        self.stats = replace(stats, frame_ms=stats.frame_ms + upload_ms, stages={**stats.stages, "upload": upload_ms})
        return self._texture

    def _blend_last(self) -> tuple[Float[np.ndarray, "height width 4"], Float[np.ndarray, "height width"]]:
        """Colours and depth of the last picture; one that was read from cube faces is drawn directly."""
        if self._picture is None:
            raise InputError("there is no image to read; call `render` first")
        if self._picture.sums is None:
            frame = self._picture.frame
            frame = replace(frame, settings=replace(frame.settings, cached=False))
            self._picture = self._draw(frame, self._choose_groups(frame))
        picture = self._picture
        assert picture.sums is not None and picture.groups is not None
        return _blend(picture.frame.settings, picture.groups, picture.sums)


def choose_renderer(ctx: moderngl.Context | None, choice: RendererChoice) -> RendererChoice:
    """Return `gl` or `cpu`; `auto` is `cpu` where there is no OpenGL or OpenGL is software."""
    if choice != "auto":
        return choice
    if ctx is None:
        return "cpu"
    from pansplat_viewer.draw.renderer import is_software

    return "cpu" if is_software(ctx) else "gl"


def create_renderer(
    ctx: moderngl.Context | None, choice: RendererChoice = "auto", *, color_bits: int | None = None
) -> SplatRenderer | CpuRenderer:
    """Create the renderer of this choice; `color_bits` is for `gl`."""
    if choose_renderer(ctx, choice) == "cpu":
        say_detail("drawing", "on the processor")
        return CpuRenderer(ctx)
    if ctx is None:
        raise InputError("renderer `gl` needs an OpenGL context; use `cpu`")
    from pansplat_viewer.draw.renderer import SplatRenderer

    say_detail("drawing", f"by OpenGL, {ctx.info['GL_RENDERER']}")
    return SplatRenderer(ctx, color_bits=color_bits)


def _make_stats(frame_ms: float, stages: dict[str, float]) -> FrameStats:
    return FrameStats(sort_ms=stages.get("sort", 0.0), frame_ms=frame_ms, stages=stages)


def _face_key(frame: Frame) -> Hashable:
    """The values that the faces of a frame depend on: everything but rotation and image size."""
    settings = replace(frame.settings, cached=True, vertical_fov_degrees=90.0, scale=1.0)
    return frame.world_position.tobytes(), frame.focal, settings


def _blend(
    settings: DrawSettings, groups: _Groups, sums: Float[np.ndarray, "layer 5 height width"]
) -> tuple[Float[np.ndarray, "height width 4"], Float[np.ndarray, "height width"]]:
    """Colour over the background and coverage, and depth."""
    color, depth = blend_layers(sums, groups.weights, settings.background)
    if settings.display in SCALAR_MAPS:
        values = depth if settings.display == "depth" else color[..., 3]
        mapped = map_values(values, settings.display_max, SCALAR_MAPS[settings.display]) / np.float32(255)
        color[..., :3] = np.where(color[..., 3:] > 0, mapped, np.array(settings.background, np.float32))
    return color, depth


def _write_pixels(
    settings: DrawSettings,
    groups: _Groups,
    sums: Float[np.ndarray, "layer 5 height width"],
    pixels: UInt32[np.ndarray, "height width"],
    *,
    bottom_up: bool = False,
) -> None:
    """Write the colours of `_blend` with 8 bits per channel, by the kernel where the display has one."""
    weights, background = groups.weights, settings.background
    if settings.display not in SCALAR_MAPS:
        blend_to_pixels(sums, weights, background, pixels, bottom_up=bottom_up)
        return
    color, _ = _blend(settings, groups, sums)
    color[..., 3] = 1
    words = (color * 255 + 0.5).astype(np.uint8).view(np.uint32)[..., 0]
    pixels[...] = words[::-1] if bottom_up else words


def _enlarge(
    frame: Frame, pixels: UInt32[np.ndarray, "height width"], stages: dict[str, float]
) -> UInt32[np.ndarray, "full_height full_width"]:
    """The pixels at the full size of the frame: OpenGL in software takes ten times as long to enlarge a texture."""
    if frame.size == frame.full_size:
        return pixels
    start, large = time.perf_counter(), pooled_empty((*frame.full_size[::-1], 4), np.uint8)
    cv2.resize(pixels.view(np.uint8).reshape(*pixels.shape, 4), frame.full_size, large)
    stages["enlarge"] = 1e3 * (time.perf_counter() - start)
    return large.view(np.uint32)[..., 0]
