"""Edges along which no camera flies: through walls, and where the surfaces of two panoramas disagree; there it fades.

Half-way between the panoramas, places of their surfaces are drawn as points. Two numbers predict LPIPS-squeeze of the
picture there: the share of the sphere where the surfaces disagree, and how near the nearest ones are.
docs/web.md has the calibration on flights through generated homes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat.tours.surfaces import locate_ends

POOR = 0.27  # predicted LPIPS-squeeze half-way, above which an edge fades
_ROWS = 64  # of the depth half-way
_DISAGREE = 0.1  # of the logarithms of depths
_NEAR = 0.05  # quantile of the depth around the horizon
_COSINE = math.cos(math.radians(3))  # of the Gaussians around the direction of the other camera
_SHARE = 0.98  # of them on a wall; others are seen beyond a door, or stray
_DEPTH = 0.95  # of the distance of the other camera, the largest depth of a wall
_CONSTANT, _DISAGREEMENT, _NEARNESS = 0.256, 0.345, -0.198  # fitted to flights of generated homes


def find_walls(scene: Scene, panoramas: Sequence[int], edges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """The edges that lead through a wall or a closed door: each camera sees a surface in front of the other camera.

    Args:
        scene, panoramas, edges: see `judge_edges`.
    """
    inside, surfaces, centers = locate_ends(scene, panoramas, edges)

    def is_blocked(node: int, other: int) -> bool:
        way = centers[other] - centers[node]
        distances, length = np.linalg.norm(surfaces[node], axis=1), float(np.linalg.norm(way))
        ahead = distances[surfaces[node] @ way > _COSINE * distances * length]
        return len(ahead) > 0 and bool(np.quantile(ahead, _SHARE) < _DEPTH * length)

    return [(a, b) for a, b in inside if is_blocked(a, b) and is_blocked(b, a)]


def find_poor_edges(
    scene: Scene, panoramas: Sequence[int], edges: Iterable[tuple[int, int]]
) -> tuple[tuple[int, int], ...]:
    """The edges of `judge_edges` whose flights would be poor."""
    return tuple(edge for edge, error in judge_edges(scene, panoramas, edges).items() if error > POOR)


def judge_edges(
    scene: Scene, panoramas: Sequence[int], edges: Iterable[tuple[int, int]]
) -> dict[tuple[int, int], float]:
    """LPIPS-squeeze that is expected half-way along each edge between two of a scene's panoramas.

    Args:
        scene: of some panoramas, with all Gaussians of each.
        panoramas: the number in the tour of each of the scene's views.
        edges: pairs of panoramas; those with another panorama are left out.
    """
    inside, surfaces, centers = locate_ends(scene, panoramas, edges)
    errors = {}
    for a, b in inside:
        disagreement, nearest = measure_way(surfaces[a], surfaces[b], centers[b] - centers[a])
        errors[a, b] = _CONSTANT + _DISAGREEMENT * disagreement + _NEARNESS * nearest
    return errors


def measure_way(
    first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "m 3"], way: Float[np.ndarray, "3"]
) -> tuple[float, float]:
    """The share of directions half-way in which two panoramas show different depths, and the depth of the nearest
    surfaces as a fraction of the way, at most 1.

    Args:
        first, second: surfaces relative to their cameras.
        way: from the first camera to the second one.
    """
    depths = np.stack([_draw(first - 0.5 * way), _draw(second + 0.5 * way)])
    weights = np.sin((np.arange(_ROWS) + 0.5) * np.pi / _ROWS)[:, None] * np.isfinite(depths).all(axis=0)
    with np.errstate(invalid="ignore"):
        differs = np.abs(np.log(depths[0]) - np.log(depths[1])) > _DISAGREE
    middle = depths.min(axis=0)[_ROWS // 4 : -_ROWS // 4]
    known = middle[np.isfinite(middle)]
    if not len(known) or not weights.any():
        return 1.0, 0.0
    nearest = float(np.quantile(known, _NEAR) / np.linalg.norm(way))
    return float((differs * weights).sum() / weights.sum()), min(nearest, 1.0)


def _draw(places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "height width"]:
    """Radial depth around the origin, of the nearest place in each pixel; infinite without one."""
    distances = np.maximum(np.linalg.norm(places, axis=1), 1e-9)
    rows = np.arccos(np.clip(-places[:, 1] / distances, -1, 1)) / np.pi * _ROWS
    columns = (np.arctan2(places[:, 0], places[:, 2]) / (2 * np.pi) + 0.5) * 2 * _ROWS
    pixels = np.minimum(rows.astype(int), _ROWS - 1) * 2 * _ROWS + columns.astype(int) % (2 * _ROWS)
    depth = np.full(2 * _ROWS * _ROWS, np.inf)
    np.minimum.at(depth, pixels, distances)
    return depth.reshape(_ROWS, 2 * _ROWS)
