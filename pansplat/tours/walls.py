"""Walls and closed doors between the panoramas of a tour, through which no camera flies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from pansplat.gaussians.scene import Scene

_COSINE = math.cos(math.radians(3))  # of the Gaussians around the direction of the other camera
_SHARE = 0.98  # of them on a wall; others are seen beyond a door, or stray
_DEPTH = 0.95  # of the distance of the other camera, the largest depth of a wall
_OPAQUE = 0.5  # least opacity of a surface
_BACKGROUND_LEVEL = 2  # behind all surfaces


def find_walls(scene: Scene, panoramas: Sequence[int], edges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """The edges that lead through a surface: each camera sees one in front of the other camera.

    Args:
        scene: of some panoramas, with all Gaussians of each.
        panoramas: the number in the tour of each of the scene's views.
        edges: pairs of panoramas; those with another panorama are left out.
    """
    view = {panorama: number for number, panorama in enumerate(panoramas)}
    gaussians, centers = scene.gaussians, scene.cam2world[:, :3, 3].to(scene.gaussians.means)
    is_surface = (gaussians.opacities >= _OPAQUE) & (gaussians.levels < _BACKGROUND_LEVEL)

    def is_blocked(node: int, other: int) -> bool:
        start, way = centers[view[node]], centers[view[other]] - centers[view[node]]
        offsets = gaussians.means[is_surface & (gaussians.views == view[node])] - start
        distances, length = offsets.norm(dim=1), way.norm()
        ahead = distances[offsets @ way > _COSINE * distances * length]
        return len(ahead) > 0 and bool(ahead.quantile(_SHARE) < _DEPTH * length)

    inside = [(a, b) for a, b in edges if a != b and a in view and b in view]
    return [(a, b) for a, b in inside if is_blocked(a, b) and is_blocked(b, a)]
