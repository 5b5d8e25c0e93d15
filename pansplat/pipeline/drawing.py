"""Images of scenes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.pose import blend_weights
from pansplat.rendering import Rendering, rasterize
from pansplat.rendering import blend as blend_renderings
from pansplat.rendering.official import rasterize_official
from pansplat.system.devices import choose_device, note_full_card
from pansplat.tours.scene_graph import make_graph
from pansplat.tours.scene_views import choose_scene_views

Drawing = Literal["exact", "original"]

_OPAQUE = 0.99  # least alpha of an image without holes; those of the default model have 0.999
_PIXEL_SECONDS = 2e-7  # seconds of a pixel of an image of a pair's scene, on two cores (docs/bench_raster.md)


def render(
    scene: Scene,
    cam2world: Float[Tensor, "4 4"] | np.ndarray,
    *,
    blend: str | int | None = None,
    size: tuple[int, int] | None = None,
    layout: str = "equirect",
    eye_distance: float | None = None,
    drawing: Drawing = "exact",
    **raster: Any,
) -> Rendering:
    """Render a scene from a pose: colour, alpha and radial depth.

    Args:
        scene: the Gaussians and their input cameras.
        cam2world: pose of the camera, OpenCV axes, in the world of `scene.cam2world`; `scene.frame.localize` brings a
            pose of the user's world there.
        blend: "deferred" renders the Gaussians of each context view and blends the images by nearness; in a scene of
            a tour, those of the views at the nearest edge. The other views (of a tour: of the same part) are rendered
            only if these leave holes. "joint" renders all Gaussians together, of a tour those of the part; a number
            renders those of one view only. By default as the scene is made for (`Scene.joint`).
        size: (height, width), pixels; by default the scene's height, 2:1 (16:9 for `pinhole`).
        layout: "equirect", "cubemap" or "pinhole".
        eye_distance: if given, omni-directional stereo (docs/rendering.md, section 9): the left eye's panorama above
            the right eye's; `size` is that of one. Metres.
        drawing: "exact", or "original": a panorama as the official code renders it, with its defects, to reproduce
            published figures (docs/paper.md).
        **raster: further arguments of `pansplat.rasterize`, with "exact".
    """
    pose = torch.as_tensor(cam2world, dtype=torch.float64, device=scene.gaussians.means.device)
    if pose.shape != (4, 4):
        raise InputError(f"`cam2world` must be a pose (4, 4), such as scene.pose_between(0.5), got {tuple(pose.shape)}")
    if eye_distance is not None:
        if raster.get("eye_offset") or not 0 < eye_distance < math.inf:
            raise InputError(f"`eye_distance` must be above 0, without `eye_offset`, got {eye_distance}")
        both = [
            render(scene, pose, blend=blend, size=size, layout=layout, drawing=drawing, eye_offset=offset, **raster)
            for offset in (-0.5 * eye_distance, 0.5 * eye_distance)
        ]
        color, alpha, depth = (
            torch.cat([getattr(eye, name) for eye in both], dim=-2) for name in ("color", "alpha", "depth")
        )
        return Rendering(color, alpha, depth)
    if blend is None:
        blend = "joint" if scene.joint else "deferred"
    if size is None:
        size = (scene.height, round(scene.height * 16 / 9) if layout == "pinhole" else 2 * scene.height)
    rasterize_gaussians = _choose_rasterizer(drawing, scene, size, layout, raster)
    num_views = len(scene.cam2world)
    if isinstance(blend, int):
        if not 0 <= blend < max(num_views, 1):
            raise InputError(f"`blend` must be a view from 0 to {max(num_views, 1) - 1}, got {blend}")
        return rasterize_gaussians(scene.gaussians.select(scene.gaussians.views == blend), pose)
    if blend not in ("deferred", "joint"):
        raise InputError(f"`blend` must be deferred, joint or the number of a view, got {blend!r}")
    shown = group = list(range(num_views))
    if scene.tour:
        tour = make_graph(scene)
        edge, _ = tour.find_nearest_edge(pose[:3, 3].detach().cpu().numpy())
        shown = [view for view in shown if tour.parts[view] == tour.parts[edge[0]]]
        group = list(choose_scene_views(tour)[edge])
    if blend == "joint" or num_views < 2:
        gaussians = scene.gaussians
        if len(shown) < num_views:
            gaussians = gaussians.select(torch.isin(gaussians.views, torch.tensor(shown).to(gaussians.views)))
        return rasterize_gaussians(gaussians, pose)
    weights = torch.zeros(num_views, dtype=torch.float64, device=pose.device)
    near = torch.tensor(group, device=pose.device)
    forward = pose[:3, 2] if layout == "pinhole" else None
    weights[near] = blend_weights(pose[:3, 3], scene.cam2world[group, :3, 3].to(pose), forward)
    order, renderings = sorted(shown, key=lambda view: -float(weights[view])), []
    for view in order:
        if weights[view] == 0 and float(torch.stack([each.alpha for each in renderings]).amax(dim=0).min()) > _OPAQUE:
            break
        renderings.append(rasterize_gaussians(scene.gaussians.select(scene.gaussians.views == view), pose))
    return blend_renderings(renderings, weights[torch.tensor(order[: len(renderings)], device=pose.device)])


def make_renderer(scene: Scene, work: str, count: int, **options: Any) -> Callable[..., Rendering]:
    """A function from a pose to its image, on the device for their number; on the processor once a card is full.

    Keywords of the function replace those of all images.

    Args:
        scene: in main memory, as the images are.
        work: name of the images.
        count: of images.
        options: keywords of `render`, with the size.
    """
    device = choose_device(work, count * math.prod(options["size"]) * _PIXEL_SECONDS, kernels=True)
    placed = replace(scene, gaussians=scene.gaussians.to(device=device))

    def draw(cam2world: Tensor | np.ndarray, **changed: Any) -> Rendering:
        nonlocal placed
        try:
            image = render(placed, cam2world, **options | changed)
        except torch.cuda.OutOfMemoryError:
            note_full_card(work)
            placed = scene
            return draw(cam2world, **changed)
        return replace(image, color=image.color.cpu(), alpha=image.alpha.cpu(), depth=image.depth.cpu())

    return draw


def _choose_rasterizer(
    drawing: Drawing, scene: Scene, size: tuple[int, int], layout: str, raster: dict[str, Any]
) -> Callable[[Gaussians, Tensor], Rendering]:
    """Return a function from Gaussians and a pose to their rendering."""
    if drawing == "exact":
        return partial(rasterize, size=size, layout=layout, **raster)
    if drawing != "original":
        raise InputError(f"`drawing` must be exact or original, got {drawing!r}")
    if layout != "equirect" or set(raster) - {"backend"}:
        given = ", ".join([*sorted(raster), *(["layout"] if layout != "equirect" else [])])
        raise InputError(f"drawing='original' sets all options but size and backend, got {given}; omit them")
    return partial(rasterize_official, size=size, near=scene.near, **raster)
