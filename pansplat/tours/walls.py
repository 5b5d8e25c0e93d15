"""Walls and closed doors between the panoramas of a tour, through which no camera flies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from pansplat.gaussians.scene import Scene
from pansplat.tours.surfaces import locate_ends

_COSINE = math.cos(math.radians(3))  # of the Gaussians around the direction of the other camera
_SHARE = 0.98  # of them on a wall; others are seen beyond a door, or stray
_DEPTH = 0.95  # of the distance of the other camera, the largest depth of a wall


def find_walls(scene: Scene, panoramas: Sequence[int], edges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """The edges that lead through a surface: each camera sees one in front of the other camera.

    Args:
        scene: of some panoramas, with all Gaussians of each.
        panoramas: the number in the tour of each of the scene's views.
        edges: pairs of panoramas; those with another panorama are left out.
    """
    inside, surfaces, centers = locate_ends(scene, panoramas, edges)

    def is_blocked(node: int, other: int) -> bool:
        way = centers[other] - centers[node]
        distances, length = np.linalg.norm(surfaces[node], axis=1), float(np.linalg.norm(way))
        ahead = distances[surfaces[node] @ way > _COSINE * distances * length]
        return len(ahead) > 0 and bool(np.quantile(ahead, _SHARE) < _DEPTH * length)

    return [(a, b) for a, b in inside if is_blocked(a, b) and is_blocked(b, a)]
