"""Posed panoramas as tensors."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Views:
    """Panoramas of one place with their poses, all at one size.

    Attributes:
        images: RGB in [0, 1], float32.
        cam2world: float64, OpenCV axes, metres.
        masks: True where a pixel shows the scene; False for what travels with the camera (tripod, caps, operator).
        near, far: radial depth range to search, metres.
        names: one a view, for messages and file names.
        depths: radial distance in metres, 0 where unknown; None when the data set has none.
    """

    images: Float[Tensor, "view 3 height width"]
    cam2world: Float[Tensor, "view 4 4"]
    masks: Bool[Tensor, "view height width"]
    near: float
    far: float
    names: tuple[str, ...]
    depths: Float[Tensor, "view height width"] | None = None
