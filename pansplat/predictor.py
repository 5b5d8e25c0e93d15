"""The interface of all predictors: the sweep and the networks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.gaussians.scene import Gaussians

Progress = Callable[[str, float], None]  # current step, fraction done in [0, 1]


@runtime_checkable
class Predictor(Protocol):
    """A callable from posed panoramas to Gaussians."""

    name: str
    """Name in messages and scene files."""

    @property
    def fingerprint(self) -> str:
        """Hash of all that determines the prediction besides the input; part of the cache key."""
        ...

    def __call__(
        self,
        images: Float[Tensor, "*batch view 3 height width"],
        cam2world: Float[Tensor, "*batch view 4 4"],
        near: float,
        far: float,
        *,
        masks: Bool[Tensor, "*batch view height width"] | None = None,
        progress: Progress | None = None,
    ) -> Gaussians | list[Gaussians]:
        """Predict from RGB in [0, 1] and OpenCV cam2world poses (metres); a list when there is a batch axis."""
        ...
