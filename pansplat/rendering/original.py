"""Pictures as the original program draws them, for the figures that were published of its weights.

Source: OFFICIAL.md, section 10.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from pansplat.constants import EWA_NEAR_FACTOR
from pansplat.gaussians.harmonics import official_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.rasterize import Backend, Rendering, rasterize

KERNEL: dict[str, Any] = {"kernel": "ewa", "order": "z", "lowpass": "3dgs"}


def rasterize_as_original(
    gaussians: Gaussians,
    cam2world: Float[Tensor, "4 4"],
    *,
    size: tuple[int, int],
    near: float,
    backend: Backend = "auto",
) -> Rendering:
    """A panorama stitched from classic splats on six faces of half its height, its defects included.

    Gaussians are in the order of their depth on each face, widened by 0.3 pixel^2, of harmonics of degree 3 at most.

    Args:
        cam2world: pose of the camera, OpenCV axes, metres.
        size: height, a multiple of 4, and width of the panorama, pixels.
        near: of the prediction, metres; what is nearer than a fifth of it is left out. The original measures that along
            a face's axis.
        backend: see `rasterize`.
    """
    shown = replace(gaussians, harmonics=official_harmonics(gaussians.harmonics))
    return rasterize(
        shown,
        cam2world,
        size=size,
        layout="cubemap",
        face_size=size[0] // 2,
        stitching="official",
        near=EWA_NEAR_FACTOR * near,
        backend=backend,
        **KERNEL,
    )
