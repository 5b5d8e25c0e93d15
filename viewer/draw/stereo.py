"""Projections and stereo: which images make up a still or a frame of a film, and their arrangement.

`render_image` waits for one image of any projection. Needs no OpenGL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.geometry.cubemap import FACES
from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.rendering.image_planes import image_planes
from pansplat.system.options import EYE_DISTANCE
from pansplat_viewer.draw.frame_renderer import FrameRenderer
from pansplat_viewer.scene.settings import DrawSettings, Preset, Projection, Stereo

# Places of the faces in an image of three columns and two rows: layout 0 of the spherical metadata, version 2.
_GRID = ("right", "left", "up"), ("down", "front", "back")
_DEFAULT_SIZES = {"perspective": (1920, 1080), "equirect": (2880, 1440), "cubemap": (2160, 1440)}
_STEREO_FACE_OVERSAMPLING = 1.5  # of the panorama that the faces of stereo cubemaps are interpolated in


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
            options = {"layout": "pinhole", "vertical_fov_degrees": 90.0, "by_direction": False}
            faces[name] = draw(pose, (side, side), **options)
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
