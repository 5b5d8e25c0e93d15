"""The calls that all renderers have."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat_viewer.core.settings import DrawSettings, FrameStats

if TYPE_CHECKING:
    import moderngl


@dataclass(frozen=True)
class Pacing:
    """How a window draws with a renderer while the camera moves."""

    min_size: tuple[int, int]  # the image is not drawn at a lower resolution (width, height), pixels
    settle_seconds: float  # after the last movement, until the image is drawn at full resolution
    turn_ms: float  # time of a full image above which turns read cached faces
    waits_while_moving: bool  # whether a window waits for the image of each position


class FrameRenderer(Protocol):
    """Draws images of one scene: `SplatRenderer` (OpenGL) and `CpuRenderer`."""

    pacing: Pacing

    @property
    def pending(self) -> Future[Any] | None:
        """The image that is drawn in the background."""
        ...

    @property
    def stats(self) -> FrameStats:
        """Times of the last frame."""
        ...

    @property
    def prepare(self) -> Callable[[Scene, Callable[[float], None]], Any]:
        """A function that converts a scene for `upload`, in any thread.

        It reports the fraction done, from any thread; an exception of the report ends the work. Gaussians with NaN or
        infinity are dropped.
        """
        ...

    def upload(self, scene: Scene, prepared: Any = None) -> None:
        """Replace the scene, which `prepare` may have converted before; if this fails, the scene before is kept."""

    def render(
        self,
        cam2world: Float[np.ndarray, "4 4"],
        size: tuple[int, int],
        settings: DrawSettings,
        *,
        wait: bool = True,
    ) -> moderngl.Texture | None:
        """Draw the scene and return the image's texture.

        Args:
            cam2world: rigid pose, OpenCV axes, metres.
            size: (width, height) in pixels.
            settings: draw settings.
            wait: finish this image. If False, return at once what there is: an image with the order of the last
                position (OpenGL), or the last image (processor). `stats.settled` is then False, and the caller renders
                again until it is True.

        Returns:
            RGBA texture: colour over the background, and coverage. Row 0 is the bottom row, so the texture is upright
            when drawn as any OpenGL texture. The next call overwrites its content. None while the processor draws the
            first image of a scene, and without a context.
        """

    def has_faces(self, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings) -> bool:
        """Whether the cube faces that the camera reads were drawn in the background."""
        ...

    def draw_faces(self, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings) -> None:
        """Draw the cube faces of a position for the next turn in the background, if the renderer does that."""

    def read_color(self) -> Float[np.ndarray, "height width 4"]:
        """Return the last image, float32, top row first: RGB over the background, and coverage."""
        ...

    def read_depth(self) -> Float[np.ndarray, "height width"]:
        """Return the radial depth of the last image in metres, float32, top row first; 0 where nothing is drawn."""
        ...

    def release(self) -> None:
        """Stop the threads and free every GL object."""


def render_image(
    renderer: FrameRenderer,
    cam2world: Float[np.ndarray, "4 4"],
    size: tuple[int, int],
    settings: DrawSettings,
    *,
    with_depth: bool = False,
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"] | None]:
    """Draw an image for a file: colour in [0, 1], and radial depth in metres; see `FrameRenderer.render`."""
    renderer.render(cam2world, size, replace(settings, cached=False), wait=True)
    color = np.clip(renderer.read_color()[..., :3], 0.0, 1.0)
    return color, renderer.read_depth() if with_depth else None
