"""The floor under the cameras of a tour, its outlines, and storeys."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import Polygon

from pansplat.tours.graph import TourGraph
from pansplat.tours.surfaces import split_by_azimuth

_UNSEEN_FLOOR = 0.15  # height of a camera over a floor that is not seen, as a fraction of far
_AZIMUTHS = 180  # number of corners of a floor outline
_NECK = 0.3  # half the width of a door, in heights of the camera; floors end where they are narrower
_LEAST_FULL = 0.65  # least part of its convex hull that a floor fills; rays through wide openings fill 0.5 to 0.64
_STOREY_GAP, _STOREY_REACH = 1.2, 0.4  # least distance of storeys, and largest one of a camera from its own, metres


@dataclass(frozen=True, eq=False)
class FloorOutline:
    """Where the floor that one panorama shows ends, seen from above.

    Attributes:
        corners: end of the floor at equal steps of azimuth, metres to the right and forward of the tour's level axes.
        camera_height: of the camera over the floor, metres.
    """

    corners: Float[np.ndarray, "azimuth 2"]
    camera_height: float


def choose_camera_height(heights: Iterable[float | None], far: float) -> float:
    """The median of those heights of cameras that are known; a fraction of `far` if none is.

    Args:
        heights: of `find_floor` or of floor outlines, metres.
        far: of the scene or tour, metres.
    """
    known = [height for height in heights if height is not None]
    return float(np.median(known)) if known else _UNSEEN_FLOOR * far


def find_ceiling(places: Float[np.ndarray, "n 3"]) -> float | None:
    """Height of the ceiling over a camera, in the unit of the places; None if they show none.

    Args:
        places: of surfaces relative to the camera (right, down, forward).
    """
    return find_floor(places * (1, -1, 1))


def find_floor(places: Float[np.ndarray, "n 3"]) -> float | None:
    """Height of a camera over the floor: the most frequent one of the places that are steeply below; None if they are
    fewer than 20.

    Args:
        places: see `find_ceiling`.
    """
    right, down, forward = places.T
    steep = (down > 0.6 * np.hypot(right, forward)) & (down > 0)
    if steep.sum() < 20:
        return None
    logs = np.log(down[steep])
    counts, borders = np.histogram(logs, bins=max(int((logs.max() - logs.min()) / 0.04), 1))
    peak = borders[counts.argmax() : counts.argmax() + 2].mean()
    return float(np.exp(np.median(logs[np.abs(logs - peak) < 0.08])))


def find_floor_outline(places: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "2"]) -> FloorOutline | None:
    """The floor outline of a panorama.

    At each azimuth the floor (`find_floor`) ends at the distance within which 98 % of it is, or at the surfaces that
    stand on it, if these are nearer. It ends at doors. None if places show no floor, or one that still goes on in rays,
    through wide openings.

    Args:
        places: of surfaces relative to the camera (right, down, forward), in any unit.
        center: of the camera, right and forward.
    """
    height = find_floor(places)
    if height is None:
        return None
    down = places[:, 1]
    floor = _measure_reach(places[np.abs(down - height) < 0.08 * height], 0.98)
    standing = _measure_reach(places[(down > 0.15 * height) & (down < 0.8 * height)], 0.5)
    reach = np.fmin(floor, standing)
    known = np.flatnonzero(np.isfinite(floor))
    if len(known) < _AZIMUTHS // 4:
        return None
    reach = np.interp(np.arange(_AZIMUTHS), known, reach[known], period=_AZIMUTHS)
    neighbours = np.stack([np.roll(reach, shift) for shift in range(-2, 3)])
    reach = np.median(neighbours, axis=0)  # without single outliers
    angles = (np.arange(_AZIMUTHS) + 0.5) * 2 * math.pi / _AZIMUTHS
    corners = _close_doors(reach[:, None] * np.stack((np.sin(angles), np.cos(angles)), axis=1), _NECK * height)
    shape = Polygon(corners)
    return FloorOutline(center + corners, height) if shape.area > _LEAST_FULL * shape.convex_hull.area else None


def _close_doors(corners: Float[np.ndarray, "azimuth 2"], neck: float) -> Float[np.ndarray, "azimuth 2"]:
    """An outline around the origin that ends where it is narrower than twice the neck."""
    pieces = shapely.get_parts(Polygon(corners).buffer(-neck))
    piece = min(pieces, key=lambda piece: piece.distance(shapely.Point(0, 0)), default=Polygon())
    shape = piece.buffer(neck, join_style="mitre", mitre_limit=1.5)
    along = np.linspace(0, 1, 65)
    is_inside = shapely.contains_xy(shape, *(corners.T[..., None] * along))
    return corners * (np.logical_and.accumulate(is_inside, axis=1).mean(axis=1))[:, None]


def _measure_reach(places: Float[np.ndarray, "n 3"], quantile: float) -> Float[np.ndarray, "azimuth"]:
    """A quantile of the level distances at each azimuth; NaN where there are fewer than three."""
    flat = places[:, (0, 2)]
    parts = split_by_azimuth(flat, np.hypot(*flat.T), _AZIMUTHS)
    return np.array([np.quantile(part, quantile) if len(part) > 2 else np.nan for part in parts])


def find_storeys(heights: Float[np.ndarray, "n"]) -> list[list[int]]:
    """The cameras of each storey, by number, the storey with most of them first.

    A storey is a level with most of the remaining cameras within 0.4 m, if it is 1.2 m from those before. Cameras near
    no level, and one alone between two levels, stand on stairs and are in none. If no two cameras are at one level, but
    all within 1.2 m, they are in one storey.

    Args:
        heights: of the cameras over any common level, metres.
    """
    near = np.abs(heights[:, None] - heights) < _STOREY_REACH
    counts = near.sum(axis=1)
    if len(heights) and counts.max() == 1 and np.ptp(heights) < _STOREY_GAP:
        return [list(range(len(heights)))]
    ends = heights.min(initial=np.inf), heights.max(initial=-np.inf)
    order = counts + 0.5 * (heights == ends[0])  # the lowest one of cameras that are alone
    free = np.ones(len(heights), bool)
    storeys: list[list[int]] = []
    while free.any():
        members = near[int(np.where(free, order, 0).argmax())]
        storeys.append(np.flatnonzero(members).tolist())
        free &= np.abs(heights - np.median(heights[members])) >= _STOREY_GAP
    return [storey for storey in storeys if len(storey) > 1 or heights[storey[0]] in ends]


def find_other_storeys(tour: TourGraph, position: Float[np.ndarray, "3"]) -> frozenset[int]:
    """The panoramas of the world around a position in other storeys than the one that is nearest in height."""
    nearest = tour.find_nearest(position)
    members = np.flatnonzero(np.array(tour.worlds) == tour.worlds[nearest])
    storeys = np.array(assign_storeys(tour))[members]
    rises = (tour.positions[members] - position) @ tour.level_axes[:, 1]
    return frozenset(members[storeys != storeys[np.abs(rises).argmin()]].tolist())


@lru_cache(maxsize=8)
def assign_storeys(tour: TourGraph) -> list[int]:
    """The storey of each panorama in its world, that of the nearest level; 0 is the lowest.

    Heights of two worlds cannot be compared: a panorama that is not placed is in storey 0 of its own.
    """
    worlds, heights, storeys = np.array(tour.worlds), tour.positions @ -tour.level_axes[:, 1], np.zeros(len(tour), int)
    for world in set(tour.worlds):
        own = heights[worlds == world]
        levels = np.sort([np.median(own[storey]) for storey in find_storeys(own)])
        storeys[worlds == world] = np.abs(own[:, None] - levels).argmin(axis=1)
    return storeys.tolist()


def list_storeys_of_worlds(tour: TourGraph) -> list[tuple[int, int]]:
    """The world of each panorama, and its storey there: those of one storey are drawn together."""
    return list(zip(tour.worlds, assign_storeys(tour), strict=True))
