"""Draws a scene's Gaussians with OpenGL into a texture: any pose, pinhole or panorama, any blending mode.

Needs no window. GL objects belong to the context's thread: call everything from there.
"""

from __future__ import annotations

from typing import Literal

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat_viewer.settings import DrawSettings, FrameStats

__all__ = ["DrawSettings", "FrameStats", "SplatRenderer"]


class SplatRenderer:
    """Renders scenes of 3D Gaussians on an OpenGL 3.3 or 4.3 context.

    Attributes:
        stats: counts and times of the last frame.
        tier: `gl33` or `gl43`, the same picture either way.
    """

    stats: FrameStats

    def __init__(
        self,
        ctx: moderngl.Context,
        *,
        tier: Literal["auto", "gl33", "gl43"] = "auto",
        color_bits: Literal[16, 32] = 16,
    ) -> None:
        """`color_bits` of the targets: 16 for a window, 32 for checks and captures."""

    def upload(self, scene: Scene) -> None:
        """Replace the scene on the GPU; Gaussians with NaN or infinity are left out and counted."""

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
            RGBA texture, colour over the background, alpha the coverage; GL's bottom row first, so that it shows
            upright when drawn as any texture. Its content changes with the next call.
        """
        raise NotImplementedError

    def read_color(self) -> Float[np.ndarray, "height width 4"]:
        """The last picture, float32, top row first: RGB over the background and coverage."""
        raise NotImplementedError

    def read_depth(self) -> Float[np.ndarray, "height width"]:
        """Radial depth of the last picture in metres, float32, top row first; 0 where nothing is drawn."""
        raise NotImplementedError

    def release(self) -> None:
        """Stop the sorting thread and free every GL object."""
