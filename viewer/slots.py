"""A renderer with its scene and last image."""

from __future__ import annotations

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat_viewer.settings import DrawSettings
from pansplat_viewer.stereo import StereoRenderer


class SceneSlot:
    """A renderer, the scene that it draws, and its last image, which is drawn again only if something changed.

    Attributes:
        renderer: draws the scene.
        scene: None before the first upload.
        image: the last image; None if it has to be drawn again.
    """

    def __init__(self, renderer: StereoRenderer) -> None:
        """The slot is empty."""
        self.renderer = renderer
        self.scene: Scene | None = None
        self.image: moderngl.Texture | None = None
        self._key: tuple[object, ...] = ()

    def upload(self, scene: Scene) -> None:
        """Replace the scene; raises the renderer's errors, and keeps the old scene then."""
        self.renderer.upload(scene)
        self.scene, self.image = scene, None

    def draw(
        self, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings, *, wait: bool
    ) -> float:
        """Make `image` that of a pose, size (width, height) and settings.

        The first image of a scene is waited for.

        Returns:
            Milliseconds; 0 if nothing was drawn, or the image is not finished.
        """
        key = (cam2world.tobytes(), size, settings)
        if self.image is not None and key == self._key and self.renderer.stats.settled:
            return 0.0
        self.image = self.renderer.render(cam2world, size, settings, wait=wait or self.image is None)
        self._key = key
        return self.renderer.stats.frame_ms
