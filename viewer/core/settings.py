"""Draw settings and frame statistics: the records between the renderer and its callers. Imports no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from pansplat.constants import EXPOSURE_WAY, NEAR

Mode = Literal["joint", "view", "deferred"]
RendererChoice = Literal["auto", "gl", "cpu"]
Display = Literal["color", "depth", "opacity", "levels", "views"]

_BLUR_STEPS = 20  # steps a metre; movements are rounded up to them, so that a selection serves several frames
SCALAR_MAPS: dict[Display, str] = {"depth": "turbo", "opacity": "viridis"}
"""Displays of one number a pixel, and their colour maps."""


@dataclass(frozen=True)
class DrawSettings:
    """Everything that changes the image except the scene, the pose and the size.

    Attributes:
        mode: `joint` draws all Gaussians together. `view` draws those of one context view. `deferred` draws each
            context view separately and blends the images per pixel by distance.
        display: `color`; `depth`, the mean radial distance, metres; `opacity` of the pixel; `levels` and
            `views`, a colour for each label.
        display_max: of `depth` and `opacity`, the number with the last colour of the map; the first is 0.
        cached: draw the image from six cube faces that are kept for this position, so that a rotation of the
            camera costs one texture look-up a pixel. Missing faces in the field of view are drawn first. Where that
            would need faces of more than 2048 pixels (a narrow field of view), the image is drawn directly.
        shift: movement of the camera while the picture is exposed, metres, world axes: Gaussians blur along it.
        scale: drawn pixels over those of the image, along each side, in (0, 1]. `CpuRenderer` enlarges the image;
            OpenGL returns the smaller texture, because a GPU enlarges it without cost.
    """

    mode: Mode = "joint"
    view: int = 0  # the context view of mode `view`
    levels: frozenset[int] | None = None  # pyramid levels to draw; None draws all
    display: Display = "color"
    display_max: float = 1.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB in [0, 1]
    near: float = NEAR  # Gaussians whose mean is nearer than this radial distance, metres, are not drawn
    vertical_fov_degrees: float = 90.0  # vertical field of view of pinhole images, between 0 and 180 degrees
    cached: bool = False
    scale: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def shows_scene(self) -> bool:
        """Whether the colours of the whole scene are shown."""
        return self.levels is None and self.display == "color" and self.mode != "view"

    @property
    def largest_blur(self) -> float:
        """Standard deviation, radians, by which the movement blurs the nearest Gaussians at most."""
        return math.ceil(_BLUR_STEPS * math.hypot(*self.shift)) / _BLUR_STEPS / (EXPOSURE_WAY * self.near)

    @property
    def splat_colors(self) -> Literal["color", "levels", "views"]:
        """The colours of the Gaussians."""
        return self.display if self.display in ("levels", "views") else "color"


@dataclass(frozen=True)
class FrameStats:
    """Times of the last frame.

    Attributes:
        sort_ms: time of the last sort and of the colours that depend on the position, possibly in the background.
        settled: False if the frame used the order and colours of an earlier position because the new ones are not
            ready, or the last image because the new one is not ready; render again to get it.
        frame_ms: from the call of `render` until the GPU had finished. Of an image that OpenGL draws without waiting,
            this is the longer of the times on the processor and the GPU, and known when the next one is drawn.
        timed: settings of the image that took `frame_ms`; None is this one.
        stages: milliseconds of each stage, where the renderer measures them.
    """

    sort_ms: float = 0.0
    frame_ms: float = 0.0
    timed: DrawSettings | None = None
    settled: bool = True
    stages: Mapping[str, float] = field(default_factory=dict)
