"""The surfaces that a panorama shows, by its Gaussians."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene


def locate_surfaces(
    scene: Scene, view: int, level: Float[np.ndarray, "3 3"], *, min_opacity: float = 0.1
) -> Float[np.ndarray, "n 3"]:
    """Places (right, down, forward) relative to a view's camera of its Gaussians that show surfaces, metres.

    Args:
        scene: with all Gaussians of the view.
        view: number of the camera.
        level: axes of a level camera, as columns right, down and forward.
        min_opacity: Gaussians of lower opacity are left out.
    """
    gaussians = scene.gaussians
    # Coarse levels have Gaussians behind the surfaces.
    shown = (gaussians.views == view) & (gaussians.opacities > min_opacity) & (gaussians.levels <= 1)
    return (gaussians.means[shown].double().cpu().numpy() - scene.cam2world[view, :3, 3].double().cpu().numpy()).dot(
        level
    )
