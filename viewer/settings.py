"""What to draw and how, and what drawing it cost: the records between the renderer and its users."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pansplat.constants import NEAR
from pansplat.errors import InputError

Kernel = Literal["ray", "ewa"]
Order = Literal["radial", "z"]
Lowpass = Literal["angular", "3dgs"]
Mode = Literal["joint", "view", "deferred", "difference"]
Layout = Literal["pinhole", "equirect"]

_CHOICES = {
    "kernel": ("ray", "ewa"),
    "order": ("radial", "z"),
    "lowpass": ("angular", "3dgs"),
    "mode": ("joint", "view", "deferred", "difference"),
    "layout": ("pinhole", "equirect"),
}


@dataclass(frozen=True)
class DrawSettings:
    """Everything that changes the picture except the scene, the pose and the size.

    Attributes:
        kernel: `ray` is the exact response on each ray, `ewa` the linearised one of 3DGS.
        order: sort key, radial distance or depth along the view axis.
        lowpass: `angular` with energy compensation, or `3dgs`.
        mode: `joint` draws all Gaussians together; `view` those of one context view; `deferred` each context
            view by itself, blended per pixel by distance; `difference` the absolute difference of the
            pictures of context views `view` and `view + 1` (cyclic), each over the background.
        view: the context view of mode `view` and the first of mode `difference`.
        levels: pyramid levels to draw; None draws all.
        opacity_threshold: Gaussians of lower opacity are left out.
        background: RGB in [0, 1].
        near: Gaussians whose mean is nearer than this radial distance, metres, are left out.
        vertical_fov_degrees: of layout `pinhole`, in (0, 180).
        layout: `pinhole`, or `equirect` stitched from six faces.
        face_size: side of a cube face in pixels; None is as fine as the panorama's equator (2 height / pi),
            or as the middle of a pinhole picture that is drawn from cached faces.
        cached: draw a pinhole picture from six faces kept for this position, so that turning costs a texture
            look-up a pixel. The faces in sight that are not there yet are drawn first. Where that needs faces
            of more than 2048 pixels (a narrow field of view) the picture is drawn directly.
    """

    kernel: Kernel = "ray"
    order: Order = "radial"
    lowpass: Lowpass = "angular"
    mode: Mode = "joint"
    view: int = 0
    levels: frozenset[int] | None = None
    opacity_threshold: float = 0.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near: float = NEAR
    vertical_fov_degrees: float = 90.0
    layout: Layout = "pinhole"
    face_size: int | None = None
    cached: bool = False

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise InputError(f"`{name}` must be one of {', '.join(choices)}, got {value!r}")
        if not 0 < self.vertical_fov_degrees < 180:
            raise InputError(
                f"`vertical_fov_degrees` must be between 0 and 180, got {self.vertical_fov_degrees}; "
                "use layout equirect for a whole panorama"
            )
        if not 0 < self.near < math.inf:
            raise InputError(f"`near` must be a positive distance in metres, got {self.near}")
        if self.face_size is not None and self.face_size < 1:
            raise InputError(f"`face_size` must be at least 1 pixel, got {self.face_size}")


@dataclass(frozen=True)
class FrameStats:
    """What the last frame drew and what it took.

    Attributes:
        total: Gaussians of the scene on the GPU.
        dropped: Gaussians left out at upload because a number in them is NaN or infinite.
        visible: those left by view, level and opacity threshold; in mode `deferred`, over all views.
        drawn: splats sent to the GPU for this frame after culling, over all faces and views; 0 when all is
            cached.
        sort_ms: time of the last sort (and of the colours that depend on the position), possibly in the
            background.
        frame_ms: from the call of `render` until the GPU had finished.
        tier: `gl33` or `gl43`.
        cached: True when nothing was drawn but a look-up in faces kept from before.
        settled: False when the order or colours of an earlier position were used because the new ones are
            still in the making; render again to get them.
    """

    total: int = 0
    dropped: int = 0
    visible: int = 0
    drawn: int = 0
    sort_ms: float = 0.0
    frame_ms: float = 0.0
    tier: str = "gl33"
    cached: bool = False
    settled: bool = True
