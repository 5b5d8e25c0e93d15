"""The interface of all predictors: the sweep and the networks."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.system.options import MIN_HEIGHT


def require_matching_inputs(images: Tensor, cam2world: Tensor, **masks: Tensor | None) -> None:
    """Check images (view, 3, height, 2 height), their poses and masks of all kinds."""
    shape = tuple(images.shape)
    if shape[2] < MIN_HEIGHT:
        raise InputError(f"`images` must be at least {MIN_HEIGHT} pixels high, got {shape[2]}; resize them")
    if tuple(cam2world.shape) != (shape[0], 4, 4):
        raise InputError(f"`cam2world` must be ({shape[0]}, 4, 4) to fit the images, got {tuple(cam2world.shape)}")
    for name, mask in masks.items():
        if mask is not None and tuple(mask.shape) != (shape[0], *shape[2:]):
            raise InputError(f"`{name}` must be {(shape[0], *shape[2:])} to fit the images, got {tuple(mask.shape)}")
    if not (torch.isfinite(images).all() and torch.isfinite(cam2world).all()):
        raise InputError("`images` and `cam2world` must be finite, got NaN or infinity; clean the input first")


def select_item(value: float | Tensor, n: int) -> float | Tensor:
    """The depth bound of a batch item, from one number or one of each item."""
    return value[n] if isinstance(value, Tensor) and value.ndim else value


@runtime_checkable
class Predictor(Protocol):
    """A callable from posed panoramas to Gaussians.

    Optional attributes, which `pipeline` reads: `min_views` (1), `max_views` of a tour at once (3), `default_height`
    (512), `stream`, with the arguments of a call, which yields the Gaussians tile by tile, and `takes_holes` (False),
    whether a call may have the argument `holes`, as `Views.holes`.
    """

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
    ) -> Gaussians | list[Gaussians]:
        """Predict from RGB in [0, 1] and OpenCV cam2world poses (metres); a list when there is a batch axis."""
        ...
