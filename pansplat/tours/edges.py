"""Edges along which no camera flies: through walls, and where the pictures of two panoramas disagree; there it zooms.

A flight looks ahead. At three places of the way, both panoramas' surfaces are drawn as points around the direction of
the flight. Its pictures are poor where a large share shows a thing twice: at other depths and in other colours.
docs/web.md has the calibration, an edge a row, on real and generated homes.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping

import numpy as np
from jaxtyping import Float

from pansplat.geometry.equirect import pixel_directions, row_weights
from pansplat.tours.surfaces import Surfaces

POOR = 0.16  # largest share of a good flight's pictures that shows things twice; by the eye (docs/web.md)
_ROWS = 64  # rows of the panoramas in which places are drawn as points
_PLACES = (0.25, 0.5, 0.75)  # places of a flight whose pictures are judged, fractions of the way
_AHEAD = math.cos(math.radians(40))  # least cosine of directions from the way that the pictures of a flight show
# Least differences of what is seen twice: of the logarithms of depths, and of colours in [0, 1], mean over channels.
_OTHER_DEPTH, _OTHER_COLOR = 0.1, 0.1
_SURFACE = 1.05  # largest depth of a pixel's points that are of its nearest surface, relative to the nearest point
_COSINE = math.cos(math.radians(3))  # least cosine of Gaussians around the direction of the other camera
_SHARE = 0.98  # share of those Gaussians that a wall has in front of the other camera; others stray
_DEPTH = 0.95  # largest depth of a wall, relative to the distance of the other camera


def find_walls(surfaces: Mapping[int, Surfaces], edges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """The edges that lead through a wall or a closed door: each camera sees a surface in front of the other camera.

    Args:
        surfaces: that some panoramas show.
        edges: pairs of panoramas; those with another panorama are left out.
    """

    def is_blocked(node: int, other: int) -> bool:
        way, distances = surfaces[other].center - surfaces[node].center, surfaces[node].distances
        length = float(np.linalg.norm(way))
        ahead = distances[surfaces[node].opaque @ way > _COSINE * distances * length]
        return len(ahead) > 0 and bool(np.quantile(ahead, _SHARE) < _DEPTH * length)

    return [(a, b) for a, b in _list_inside(surfaces, edges) if is_blocked(a, b) and is_blocked(b, a)]


def find_poor_edges(surfaces: Mapping[int, Surfaces], edges: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """The edges whose flights would show too much twice (`measure_doubled`).

    Args:
        surfaces, edges: see `find_walls`.
    """
    return tuple((a, b) for a, b in _list_inside(surfaces, edges) if measure_doubled(surfaces[a], surfaces[b]) > POOR)


def _list_inside(nodes: Container[int], edges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """The edges between two of some panoramas."""
    return [(a, b) for a, b in edges if a != b and a in nodes and b in nodes]


def measure_doubled(first: Surfaces, second: Surfaces) -> float:
    """The share of the pictures of a flight between two panoramas that shows things twice, in the worse direction.

    It is 1 where they show nothing in common.
    """
    way = second.center - first.center
    rays, area = pixel_directions(_ROWS, 2 * _ROWS).numpy(), row_weights(_ROWS).numpy()[:, None]
    cosines = rays @ (way / np.linalg.norm(way))
    shares = np.ones((2, len(_PLACES)))
    for number, place in enumerate(_PLACES):
        (depth, color), (other_depth, other_color) = _draw(first, place * way), _draw(second, (place - 1) * way)
        is_seen = np.isfinite(depth) & np.isfinite(other_depth)
        ratio = np.divide(depth, other_depth, out=np.ones_like(depth), where=is_seen)
        is_double = np.abs(np.log(ratio)) > _OTHER_DEPTH
        is_double &= np.abs(color - other_color).mean(axis=-1) > _OTHER_COLOR
        for side, cosine in enumerate((cosines, -cosines)):
            weights = area * (is_seen & (cosine > _AHEAD))
            if weights.any():
                shares[side, number] = (is_double * weights).sum() / weights.sum()
    return float(shares.mean(axis=1).max())


def _draw(
    surfaces: Surfaces, camera: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width 3"]]:
    """Radial depth around a place (relative to the camera) of the nearest point in each pixel, infinite without one,
    and its colour."""
    places, colors = surfaces.opaque - camera, surfaces.colors
    distances = np.maximum(np.linalg.norm(places, axis=1), 1e-9)
    rows = np.arccos(np.clip(-places[:, 1] / distances, -1, 1)) / np.pi * _ROWS
    columns = (np.arctan2(places[:, 0], places[:, 2]) / (2 * np.pi) + 0.5) * 2 * _ROWS
    pixels = np.minimum(rows.astype(int), _ROWS - 1) * 2 * _ROWS + columns.astype(int) % (2 * _ROWS)
    depth = np.full(2 * _ROWS * _ROWS, np.inf)
    np.minimum.at(depth, pixels, distances)
    shown = distances < _SURFACE * depth[pixels]
    pixels, colors = pixels[shown], colors[shown]
    sums = [np.bincount(pixels, channel, len(depth)) for channel in (*colors.T, np.ones(len(pixels)))]
    color = np.stack(sums[:3], axis=-1) / np.maximum(sums[3], 1)[:, None]
    return depth.reshape(_ROWS, -1), color.reshape(_ROWS, -1, 3)
