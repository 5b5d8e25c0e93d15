"""Projections and stereo: which images make up a still, a frame of a film or the window's image, and their arrangement.

`render_image` waits for one image of any projection. `StereoRenderer` draws the window's images.
"""

from __future__ import annotations

import math
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

import moderngl
import numpy as np
import torch
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.geometry.cubemap import FACES
from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.rendering.image_planes import image_planes
from pansplat.system.options import EYE_DISTANCE
from pansplat_viewer.draw.cpu_renderer import CpuRenderer, create_renderer
from pansplat_viewer.draw.frame_renderer import FrameRenderer
from pansplat_viewer.draw.programs import Programs, set_uniforms
from pansplat_viewer.draw.renderer import SplatRenderer, bind
from pansplat_viewer.scene.settings import DrawSettings, FrameStats, Preset, Projection, RendererChoice, Stereo

# Places of the faces in an image of three columns and two rows: layout 0 of the spherical metadata, version 2.
_GRID = ("right", "left", "up"), ("down", "front", "back")
_DEFAULT_SIZES = {"perspective": (1920, 1080), "equirect": (2880, 1440), "cubemap": (2160, 1440)}
MAX_TURN = math.radians(20)  # of the camera before the eyes follow, while cached faces are read
_STEREO_FACE_OVERSAMPLING = 1.5  # of the panorama that the faces of stereo cubemaps are interpolated in

_MAX_TARGETS = 4


@dataclass(frozen=True)
class ImageFormat:
    """What an image shows of all directions, and to which eyes.

    Attributes:
        projection: a perspective image, or all directions as an equirectangular panorama or as six cube faces.
        stereo: one eye, both eyes next to each other, or the left above the right eye. Both eyes of a panorama are
            omni-directional stereo (docs/rendering.md, section 9).
        eye_distance: metres.
    """

    projection: Projection = "perspective"
    stereo: Stereo = "mono"
    eye_distance: float = EYE_DISTANCE

    @property
    def is_omnidirectional(self) -> bool:
        """Whether the image is omni-directional stereo, which is drawn on the processor."""
        return self.projection != "perspective" and self.stereo != "mono"

    @property
    def default_size(self) -> tuple[int, int]:
        """(width, height) of the image of one eye, pixels."""
        return _DEFAULT_SIZES[self.projection]

    def check(self, size: tuple[int, int], preset: Preset = "exact") -> None:
        """Refuse a size (width, height) or a preset that does not fit."""
        width, height = size
        if self.projection == "equirect" and width != 2 * height:
            raise InputError(f"`--size` must be 2:1 for projection equirect, got {width}x{height}")
        if self.projection == "cubemap" and (2 * width != 3 * height or height % 2):
            raise InputError(
                f"`--size` must be 3:2, of an even height, for projection cubemap, got {width}x{height}; the image has "
                "three columns and two rows of faces"
            )
        if self.is_omnidirectional and preset != "exact":
            raise InputError(f"stereo of projection {self.projection} needs preset exact, got {preset}")


def choose_format(projection: Projection, settings: DrawSettings) -> ImageFormat:
    """The format of a file that shows what the window shows; a pair of panoramas is top-bottom, as headsets expect."""
    is_pair = projection != "perspective" and settings.stereo == "side-by-side"
    return ImageFormat(projection, "top-bottom" if is_pair else settings.stereo, settings.eye_distance)


def render_image(
    renderer: FrameRenderer,
    cam2world: Float[np.ndarray, "4 4"],
    size: tuple[int, int],
    settings: DrawSettings,
    image_format: ImageFormat | None = None,
    *,
    with_depth: bool = False,
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"] | None]:
    """Render an image of any projection for one or both eyes.

    Args:
        renderer: has the scene; a `CpuRenderer` for omni-directional stereo.
        cam2world: pose between the eyes.
        size: (width, height) of the image of one eye, pixels.
        settings: draw settings; the format replaces their layout.
        image_format: a perspective image of one eye by default.
        with_depth: whether depth is returned.

    Returns:
        Colour in [0, 1], and radial depth in metres.
    """
    image_format = image_format or ImageFormat()
    half = 0.5 * image_format.eye_distance
    offsets = (0.0,) if image_format.stereo == "mono" else (-half, half)
    settings = replace(settings, cached=False, stereo="mono")
    eyes = [_render_eye(renderer, cam2world, size, settings, image_format, offset, with_depth) for offset in offsets]
    color = arrange_eyes([color for color, _ in eyes], image_format.stereo)
    if not with_depth:
        return color, None
    depths = [depth[..., None] for _, depth in eyes if depth is not None]
    return color, arrange_eyes(depths, image_format.stereo)[..., 0]


def arrange_eyes(
    eyes: list[Float[np.ndarray, "height width channel"]], stereo: Stereo
) -> Float[np.ndarray, "all_height all_width channel"]:
    """The image of one eye, or of the left and the right eye."""
    if stereo == "mono":
        return eyes[0]
    return np.concatenate(eyes, axis=1 if stereo == "side-by-side" else 0)


def move_eye(cam2world: Float[np.ndarray, "4 4"], offset: float) -> Float[np.ndarray, "4 4"]:
    """The pose moved to the right by a distance in metres."""
    moved = cam2world.copy()
    moved[:3, 3] += offset * cam2world[:3, 0]
    return moved


def _render_eye(
    renderer: FrameRenderer,
    cam2world: np.ndarray,
    size: tuple[int, int],
    settings: DrawSettings,
    image_format: ImageFormat,
    offset: float,
    with_depth: bool,
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"] | None]:
    """The image of one eye, which is `offset` metres to the right of the centre."""

    def draw(pose: np.ndarray, size: tuple[int, int], **changes: object) -> tuple[np.ndarray, np.ndarray | None]:
        renderer.render(pose, size, replace(settings, **changes), wait=True)
        color = np.clip(renderer.read_color()[..., :3], 0.0, 1.0)
        return color, renderer.read_depth() if with_depth else None

    if image_format.projection == "perspective":
        return draw(move_eye(cam2world, offset), size, layout="pinhole")
    if image_format.projection == "equirect":
        return draw(cam2world, size, layout="equirect", eye_offset=offset)
    side = size[1] // 2
    planes = dict(zip(FACES, image_planes("cubemap", size, face_size=side), strict=True))
    if offset == 0:
        faces = {}
        for name, plane in planes.items():
            pose = cam2world.copy()
            pose[:3, :3] = cam2world[:3, :3] @ plane.rotation.numpy()
            faces[name] = draw(pose, (side, side), layout="pinhole", vertical_fov_degrees=90.0)
    else:  # at the poles, a face has no columns of one longitude: interpolate in the exact panorama
        height = round(_STEREO_FACE_OVERSAMPLING * math.pi * side / 2)
        images = draw(cam2world, (2 * height, height), layout="equirect", eye_offset=offset)
        faces = {name: tuple(_sample(image, plane.directions()) for image in images) for name, plane in planes.items()}
    color, depth = (
        None if faces["front"][i] is None else np.vstack([np.hstack([faces[name][i] for name in row]) for row in _GRID])
        for i in range(2)
    )
    assert color is not None
    return color, depth


def _sample(image: np.ndarray | None, directions: Float[torch.Tensor, "height width 3"]) -> np.ndarray | None:
    """The pixels of a panorama in these directions, by bilinear interpolation."""
    if image is None:
        return None
    channels = torch.from_numpy(np.atleast_3d(image)).permute(2, 0, 1).double()
    sampled = sample_equirect(channels, uv_from_directions(directions)).permute(1, 2, 0).float().numpy()
    return sampled.reshape(*sampled.shape[:2], *image.shape[2:])


# --- the window's images ---


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
