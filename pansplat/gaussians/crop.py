"""A part of a scene: some Gaussians, and the cameras that go with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene

Box = tuple[float, float, float, float, float, float]
"""Two opposite corners: x, y and z of one, then of the other, metres in world axes."""


def keep_gaussians(scene: Scene, kept: Bool[Tensor, "n"], views: Sequence[int] | None = None) -> Scene:
    """The scene of some Gaussians and views; the views are numbered anew.

    Args:
        scene: a scene.
        kept: True for the Gaussians that stay.
        views: in the order of their new numbers; by default those that have Gaussians. For deferred blending,
            Gaussians of other views are left out. For joint drawing, they belong to the nearest one of these.
    """
    gaussians, count = scene.gaussians, len(scene.cam2world)
    if not count:
        return dataclasses.replace(scene, gaussians=gaussians.select(kept))
    own = gaussians.views.long()
    chosen = own[kept].unique().tolist() if views is None else list(views)
    number = torch.full((count,), -1)
    number[chosen] = torch.arange(len(chosen))
    number = number.to(own.device)
    if scene.joint and chosen:
        centers = scene.cam2world[chosen, :3, 3].to(gaussians.means)
        lost = (kept & (number[own] < 0)).nonzero()[:, 0]
        nearest = torch.cdist(gaussians.means[lost], centers).argmin(dim=1)
        own = own.clone()
        own[lost] = torch.tensor(chosen, device=own.device)[nearest]
    kept = kept & (number[own] >= 0)
    part = gaussians.select(kept)
    return dataclasses.replace(
        scene,
        gaussians=dataclasses.replace(part, views=number[own[kept]].to(gaussians.views)),
        cam2world=scene.cam2world[chosen],
        names=tuple(scene.names[view] for view in chosen if view < len(scene.names)),
        gains=tuple(scene.gains[view] for view in chosen) if scene.gains else (),
        starts=tuple(scene.starts[view] for view in chosen) if scene.starts else (),
        tour=scene.tour.select(chosen) if scene.tour and chosen else None,
    )


def crop(scene: Scene, box: Box) -> Scene:
    """The part of a scene whose Gaussians have their centres in a box.

    Cameras outside are left out with their layers; if all are outside, those stay that have Gaussians in the box.
    """
    is_inside = are_in_box(scene.gaussians.means, box)
    views = are_in_box(scene.cam2world[:, :3, 3], box).nonzero()[:, 0].tolist()
    cropped = keep_gaussians(scene, is_inside, views or None)
    if not len(cropped.gaussians):
        finite = scene.gaussians.means[torch.isfinite(scene.gaussians.means).all(dim=1)]
        found, users = "no Gaussian", scene.frame.globalize_places
        if len(finite):
            found = f"a scene from {_list(users(finite.amin(0)))} to {_list(users(finite.amax(0)))}"
        low, high = map(users, _sort_corners(box))
        raise InputError(
            f"needed a box with Gaussians, got {_list(low)} to {_list(high)} m and {found}; choose another"
        )
    return cropped


def are_in_box(points: Float[Tensor, "n 3"], box: Box) -> Bool[Tensor, "n"]:
    """Whether points are in a box, its faces included; NaN is outside."""
    low, high = _sort_corners(box)
    points = points.double()
    return ((points >= low.to(points.device)) & (points <= high.to(points.device))).all(dim=1)


def _sort_corners(box: Box) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """The least and the greatest corner."""
    corners = torch.tensor(box, dtype=torch.float64).reshape(2, 3)
    return corners.amin(dim=0), corners.amax(dim=0)


def _list(point: Tensor) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in point.tolist()) + ")"
