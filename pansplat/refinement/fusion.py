"""One scene for joint drawing: each surface is kept once.

The Gaussians of a view show all that it sees, so that those of two views cover a surface twice, and errors of depth put
either in front of the other. Deferred blending draws views one by one. Other programs draw all Gaussians together.

Each place belongs to the nearest camera that sees it, whose photograph has most pixels there: a Gaussian is dropped if
a nearer camera sees its place. The camera does if the surface of its own Gaussians is not in front. A Gaussian in front
of that surface is dropped too: the nearer camera's depth is the more accurate one. The background levels, which a view
has behind its surfaces, are kept only where no other camera sees.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import pad_equirect, uv_from_directions
from pansplat.rendering import rasterize

_HEIGHT = 512  # most rows of the image of the surface that a view sees
_MAX_OFFSET = 0.1  # largest distance of a Gaussian behind the surface that it belongs to, over the depth of the surface
BACKGROUND_LEVEL = 2  # the finest of the levels that a view has behind its surfaces
OPAQUE = 0.5  # least alpha of a pixel that shows a surface


@torch.no_grad()
def fuse_views(scene: Scene) -> Scene:
    """The scene with each surface once, for joint drawing.

    Gaussians are only left out: colours of different views may differ, and a refinement of the result fits them. A
    scene of fewer than two cameras is returned as it is.
    """
    if scene.joint or len(scene.cam2world) < 2:
        return scene
    gaussians, poses = scene.gaussians, scene.cam2world
    own = gaussians.views.long()
    centers = poses[:, :3, 3].to(gaussians.means)
    own_distances = (gaussians.means - centers[own]).norm(dim=1)
    is_dropped = torch.zeros_like(own, dtype=torch.bool)
    for view in own.unique().tolist():
        surface = gaussians.select(own == view)
        distances = (gaussians.means - centers[view]).norm(dim=1)
        is_nearer = (distances < own_distances) | ((distances == own_distances) & (own > view))
        is_tested = (own != view) & ~is_dropped & (is_nearer | (gaussians.levels >= BACKGROUND_LEVEL))
        chosen = is_tested.nonzero()[:, 0]
        reach = measure_reach(surface, poses[view], min(scene.height, _HEIGHT))
        is_dropped[chosen] = are_seen(gaussians.means[chosen], poses[view], reach)
    return dataclasses.replace(scene, gaussians=scene.gaussians.select(~is_dropped), joint=True)


def measure_reach(surface: Gaussians, pose: Float[Tensor, "4 4"], height: int) -> Float[Tensor, "height width"]:
    """How far a camera sees in each direction; 0 where there is no surface.

    It is the largest depth around each pixel, as depth is uncertain at edges.

    Args:
        surface: the Gaussians that the camera shows.
        pose: of the camera.
        height: rows.
    """
    drawn = rasterize(surface, pose, size=(height, 2 * height))
    depth = torch.where(drawn.alpha > OPAQUE, drawn.depth, 0)[None]
    return functional.max_pool2d(pad_equirect(depth, 1), 3, stride=1)[0]


def are_seen(
    points: Float[Tensor, "n 3"], pose: Float[Tensor, "4 4"], reach: Float[Tensor, "height width"]
) -> Bool[Tensor, "n"]:
    """Whether a camera sees the points, before or at its surfaces (`measure_reach`)."""
    distances, found = look_up(reach, points, pose)
    return distances <= (1 + _MAX_OFFSET) * found


def look_up(
    depths: Float[Tensor, "height width"], points: Float[Tensor, "n 3"], pose: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Distances of points from a camera, and its depths in their directions."""
    height, width = depths.shape
    offsets = (points.double() - pose[:3, 3].to(points.device)) @ pose[:3, :3].to(points.device)
    uv = uv_from_directions(offsets)
    row = (uv[:, 1] * height).long().clamp(0, height - 1)
    return offsets.norm(dim=1), depths[row, (uv[:, 0] * width).long() % width]
