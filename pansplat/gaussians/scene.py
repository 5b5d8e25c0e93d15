"""A scene: Gaussians together with the cameras they were predicted from."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Scene:
    """What `predict` returns, `render` and the viewer draw, and `save`/`load` keep.

    Attributes:
        gaussians: all context views' Gaussians.
        cam2world: poses of the context views, float64, in the order of `gaussians.views`; may hold no view when
            the file came from elsewhere.
        near, far: depth range of the prediction, metres.
        names: one name a context view (its image file's name).
        model: what made it, e.g. "sweep".
        height: height of the panoramas it was predicted from, pixels.
    """

    gaussians: Gaussians
    cam2world: Float[Tensor, "view 4 4"]
    near: float
    far: float
    names: tuple[str, ...] = ()
    model: str = ""
    height: int = 512
