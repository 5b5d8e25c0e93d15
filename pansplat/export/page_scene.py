"""The scene of a page: its visible Gaussians, merged until they are few enough."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch

from pansplat import constants, pipeline
from pansplat.errors import InputError
from pansplat.export.page_data import MAX_DEGREE, count_bytes
from pansplat.gaussians.scene import Gaussians, Scene, prune
from pansplat.inputs.views import Views
from pansplat.refinement import DISPLAY_HEIGHT, RefineConfig, Refinement
from pansplat.rendering.color_fit import fit_colors
from pansplat.tours.merge import select_views

FIT_STEPS = 8  # steps that fit merged Gaussians to the images of all Gaussians


def prepare(scene: Scene) -> Scene:
    """The visible Gaussians on the CPU; with a camera in the middle if there is none."""
    gaussians = prune(scene.gaussians.to(device="cpu"), min_opacity=constants.ALPHA_CUT)
    numbers = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities[:, None])
    finite = torch.stack([(value.abs() <= constants.MAX_MAGNITUDE).all(1) for value in numbers]).all(0)
    gaussians = gaussians.select(finite & (gaussians.harmonics.abs() <= constants.MAX_MAGNITUDE).flatten(1).all(1))
    if not len(gaussians):
        raise InputError(
            "the scene has no visible Gaussians, and a page needs at least one; check it with `pansplat info`"
        )
    poses, names = scene.cam2world.double().cpu(), scene.names
    if not len(poses):
        poses, names = torch.eye(4, dtype=torch.float64)[None], ("start",)
        poses[0, :3, 3] = gaussians.means.double().median(0).values
    if scene.joint or len(poses) < 2 or int(gaussians.views.max()) >= len(poses):
        # The Gaussians of all views are drawn together.
        gaussians = dataclasses.replace(gaussians, views=torch.zeros_like(gaussians.views))
    names = tuple(names[k] if k < len(names) else f"panorama {k + 1}" for k in range(len(poses)))
    return dataclasses.replace(scene, gaussians=gaussians, cam2world=poses, names=names)


def merge(scene: Scene, parts: Sequence[int], count: int, steps: int = FIT_STEPS) -> Scene:
    """At most `count` Gaussians, an equal number for each panorama of different parts that have any.

    Args:
        scene: of `prepare`.
        parts: of each view; they are merged one after the other.
        steps: of the fit of shapes; 0 fits colours only.
    """
    merged, seen = [], {parts[view] for view in scene.gaussians.views.unique().tolist()}
    total = sum(part in seen for part in parts)
    for part in dict.fromkeys(part for part in parts if part in seen):
        views = tuple(view for view, other in enumerate(parts) if other == part)
        chosen = select_views(scene, views)
        kept = max(count * len(views) // total, 1)
        if len(chosen.gaussians) > kept:
            chosen = _merge_part(chosen, kept, steps)
        labels = torch.tensor(views)[chosen.gaussians.views.long()]
        merged.append(dataclasses.replace(chosen.gaussians, views=labels))
    return dataclasses.replace(scene, gaussians=Gaussians.cat(merged))


@torch.no_grad()
def _draw_inputs(scene: Scene) -> Views:
    """Images of the scene at its input cameras, at twice its rows: those of the scene do not show the gaps between
    merged Gaussians."""
    height = min(2 * scene.height, DISPLAY_HEIGHT)
    owners = scene.gaussians.views.unique().tolist()
    images = [
        pipeline.render(scene, pose, blend=view if view in owners else "joint", size=(height, 2 * height)).color
        for view, pose in enumerate(scene.cam2world)
    ]
    masks = torch.ones(len(images), height, 2 * height, dtype=torch.bool)
    return Views(torch.stack(images), scene.cam2world, masks, scene.near, scene.far, scene.names)


def _merge_part(scene: Scene, count: int, steps: int) -> Scene:
    """At most `count` Gaussians, fitted to the images of all at the input cameras."""
    views = _draw_inputs(scene)
    refinement = Refinement(scene, views, RefineConfig(gaussians=count, splits=()))
    for step in range(steps):
        refinement.step(step / steps)
    merged = refinement.scene()
    fitted = fit_colors(merged.gaussians, views.images, views.cam2world, views.masks)
    return dataclasses.replace(merged, gaussians=fitted)


def choose_degree(scene: Scene, num_bytes: float) -> int:
    """The highest degree of harmonics with which the data of a page is small enough even if nothing is compressed."""
    count = len(scene.gaussians)
    degrees = range(min(scene.gaussians.degree, MAX_DEGREE), 0, -1)
    return next((degree for degree in degrees if count_bytes(count, degree) * 4 / 3 <= num_bytes), 0)
