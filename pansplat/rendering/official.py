"""Images equal to those of the official code, its defects included, to reproduce its published metrics.

Source: docs/official.md, section 10.
"""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from pansplat.constants import EWA_NEAR_FACTOR
from pansplat.gaussians.harmonics import official_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.rasterize import Backend, Rendering, rasterize


def official_face_size(height: int) -> int:
    """Side of the official code's cube faces for a panorama of this height, pixels."""
    return height // 2


def official_gaussians(gaussians: Gaussians) -> Gaussians:
    """Reduce the harmonics to those that the official rasteriser evaluates: degree 3 at most."""
    return replace(gaussians, harmonics=official_harmonics(gaussians.harmonics))


def rasterize_official(
    gaussians: Gaussians,
    cam2world: Float[Tensor, "4 4"],
    *,
    size: tuple[int, int],
    near: float,
    backend: Backend = "auto",
) -> Rendering:
    """Rasterise a panorama by the official kernel, stitched from six faces of half its height.

    Args:
        cam2world: pose of the camera, OpenCV axes, metres.
        size: height, a multiple of 4, and width of the panorama, pixels.
        near: near bound of the prediction, metres; Gaussians nearer than a fifth of it are not rasterised. The
            official code compares the depth along a face's axis with it instead.
        backend: see `rasterize`.
    """
    return rasterize(
        official_gaussians(gaussians),
        cam2world,
        size=size,
        layout="cubemap",
        face_size=official_face_size(size[0]),
        backend=backend,
        kernel="ewa",
        near=EWA_NEAR_FACTOR * near,
    )
