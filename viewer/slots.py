"""A renderer with its scene and last image."""

from __future__ import annotations

from dataclasses import replace

import moderngl
import numpy as np
import torch
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat_viewer.settings import DrawSettings
from pansplat_viewer.stereo import StereoRenderer


def keep_largest(scene: Scene, count: int) -> Scene:
    """The scene with the Gaussians that cover the largest solid angles, weighted by opacity, seen from its cameras."""
    gaussians = scene.gaussians
    cameras = scene.cam2world[:, :3, 3].float() if len(scene.cam2world) else gaussians.means.mean(dim=0, keepdim=True)
    squared = torch.full((len(gaussians),), torch.inf)
    for camera in cameras:
        squared = torch.minimum(squared, (gaussians.means - camera).square().sum(dim=1))
    scales = gaussians.scales.sort(dim=1).values
    cover = gaussians.opacities * scales[:, 1] * scales[:, 2] / squared.clamp(min=1e-12)
    largest = cover.nan_to_num(0.0).topk(min(count, len(cover))).indices
    return replace(scene, gaussians=gaussians.select(largest.sort().values))


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
