"""Fewer and plainer Gaussians, where a file must be small."""

from __future__ import annotations

import dataclasses

from pansplat.gaussians.gaussians import Gaussians


def prune(gaussians: Gaussians, *, degree: int | None = None, min_opacity: float = 0.0) -> Gaussians:
    """The Gaussians of at least some opacity, with harmonics up to a degree.

    Args:
        degree: highest degree kept; None keeps all, as does one that is higher than what is there.
        min_opacity: in [0, 1]; below 1/255 nothing can be seen.
    """
    if min_opacity > 0:
        gaussians = gaussians.select(gaussians.opacities >= min_opacity)
    if degree is None or degree >= gaussians.degree:
        return gaussians
    return dataclasses.replace(gaussians, harmonics=gaussians.harmonics[:, : (degree + 1) ** 2])
