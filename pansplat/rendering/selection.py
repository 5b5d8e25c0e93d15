"""Which Gaussians a picture is drawn from: all that are finite, neither too near nor too faint.

Source: docs/rendering.md, sections 1 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.constants import OPACITY_CUT
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.backend import Options
from pansplat.rendering.splats import near_enough, sound


@dataclass(frozen=True, eq=False)
class Selection:
    """The Gaussians worth observing, and what became of the others.

    Attributes:
        covariances: theirs, where they were given in place of scales and quats.
        total: number of Gaussians given.
        dropped: not finite.
        near: nearer than `near`.
    """

    gaussians: Gaussians
    covariances: Float[Tensor, "n 3 3"] | None
    total: int
    dropped: int
    near: int


def select_drawable(
    gaussians: Gaussians, covariances: Float[Tensor, "n 3 3"] | None, pose: Float[Tensor, "4 4"], options: Options
) -> Selection:
    """Select before any arithmetic, which is what keeps the others' gradients exactly zero.

    Args:
        pose: cam2world.

    Raises:
        InputError: `options.strict` and a Gaussian is not finite.
    """
    radius = _radius(gaussians, pose)
    close = radius < options.near
    usable = _usable(gaussians, covariances, radius, close)
    dropped = len(gaussians) - int(usable.sum())
    if options.strict and dropped:
        raise InputError(not_finite(gaussians, covariances, pose, options))
    close &= usable
    keep = usable & ~close & (gaussians.opacities.detach() >= OPACITY_CUT)
    total, near = len(gaussians), int(close.sum())
    if not bool(keep.all()):
        gaussians = gaussians.select(keep)
        covariances = None if covariances is None else covariances[keep]
    return Selection(gaussians, covariances, total, dropped, near)


def not_finite(
    gaussians: Gaussians, covariances: Float[Tensor, "n 3 3"] | None, pose: Float[Tensor, "4 4"], options: Options
) -> str:
    """What to tell about Gaussians that cannot be drawn, at least one."""
    radius = _radius(gaussians, pose)
    wrong = torch.nonzero(~_usable(gaussians, covariances, radius, radius < options.near))[:, 0]
    return (
        f"`gaussians` must hold only finite numbers, got {len(wrong)} of {len(gaussians)} that do not (the first is "
        f"number {int(wrong[0])}); remove them, or render with strict=False to leave them out"
    )


@torch.no_grad()
def _radius(gaussians: Gaussians, pose: Tensor) -> Float[Tensor, "n"]:
    return torch.linalg.vector_norm(gaussians.means.double() - pose[:3, 3], dim=1)


@torch.no_grad()
def _usable(gaussians: Gaussians, covariances: Tensor | None, radius: Tensor, close: Tensor) -> Bool[Tensor, "n"]:
    return sound(gaussians, covariances) & (close | near_enough(gaussians, covariances, radius))
