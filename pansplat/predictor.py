"""What every predictor offers, so that the sweep and the networks are interchangeable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.gaussians.scene import Gaussians

Progress = Callable[[str, float], None]  # what is being done, fraction of the whole in [0, 1]


@runtime_checkable
class Predictor(Protocol):
    """Posed panoramas in, Gaussians out.

    Attributes:
        name: as users type it.
    """

    name: str

    @property
    def fingerprint(self) -> str:
        """Changes whenever the output for the same input could; keys the prediction cache."""
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
