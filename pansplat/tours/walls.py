"""The straight walls around a panorama: what it shows of them, their lines, and its outline.

A wall is sought above the doors, just below the ceiling, where a room is closed and little furniture stands. Each
direction around a camera ends at one of few lines, which are parallel to the main directions of the place: the
sequence of lines with the least error is found by dynamic programming.

Lengths below are fractions of the height of the cameras over the floor, about 1.5 m, so that the unit has no influence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import Polygon

from pansplat.tours.floor import FloorOutline
from pansplat.tours.surfaces import RAY_DIRECTIONS, RAYS, Outline, Surfaces, split_by_azimuth

LEAST_WALL = 0.2  # least length of a wall
# What a panorama shows of walls.
_WALL_BAND = 0.6, 0.85  # walls are sought between these fractions of the ceiling's height over the camera
_LEAST_CEILING = 0.25  # least height of a ceiling over the camera; doors may reach into the band of a lower one
_SURFACE = 0.12  # largest difference of the places of one surface, as a fraction of their distance
_BESIDE = 1  # number of rays on either side of one whose places count for it, too
_LEAST_DISTANCE = 0.25  # least distance of a wall from the camera; nearer places may be a lamp above it
_LOW = 0.5, 0.9  # openings reach to the floor if they are seen between these fractions of the height below the camera
# Directions and lines of walls. Chords connect places of walls; their lengths are the weights.
_SPAN = 2  # number of rays on either side of the one whose chord states a wall's direction
_LARGEST_STEP = 0.3  # largest length of a chord, as a fraction of its distance
_PARALLEL = math.radians(15)  # largest angle between a chord and its wall
_SKEW = math.radians(3)  # largest angle between a side of an outline and its wall
_OBLIQUE, _OBLIQUE_SHARE = math.radians(12), 0.15  # oblique walls: least angle to others, and share of all chords
_CLUSTER, _MOST_LINES = 0.07, 24  # half the width of a line; lines of a direction
# The outline around a camera. Costs are in errors of one ray.
_DISTANCE_NOISE, _LARGEST_ERROR = 0.07, 0.35  # usual and largest error of the distance of a wall
_CORNER, _JUMP, _LARGEST_JUMP = 5.0, 0.15, 5.0  # cost of another wall; a jump in depth that costs 1, and its most
_NEVER = 1e4  # cost of a wall in a direction in which it is not

_BORDERS = np.stack([f(np.arange(RAYS) * 2 * math.pi / RAYS) for f in (np.sin, np.cos)], axis=1)  # between the rays


@dataclass(frozen=True, eq=False)
class Sight:
    """What one panorama shows of its room.

    Attributes:
        center: of the camera, in the plan.
        walls: where each ray meets a wall, relative to the camera; NaN where it is unknown.
        shown: all places of walls, in the plan.
        low: places below the camera and above the floor, relative to the camera.
    """

    center: Float[np.ndarray, "2"]
    walls: Float[np.ndarray, "ray 2"]
    shown: Float[np.ndarray, "n 2"]
    low: Float[np.ndarray, "m 2"]


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of walls: places with normal @ place = offset."""

    normals: Float[np.ndarray, "line 2"]
    offsets: Float[np.ndarray, "line"]


def find_sight(surfaces: Surfaces, height: float, ceiling: float | None, floor: FloorOutline | None) -> Sight | None:
    """What a panorama shows; None if it shows no walls."""
    center, places = surfaces.center[[0, 2]], surfaces.samples
    down, flat = places[:, 1], places[:, (0, 2)]
    low = flat[(down > _LOW[0] * height) & (down < _LOW[1] * height)]
    if ceiling is None or ceiling < _LEAST_CEILING * height:
        if floor is None:
            return None
        reach = np.repeat(np.linalg.norm(floor.corners - center, axis=1), RAYS // len(floor.corners))
        walls = reach[:, None] * RAY_DIRECTIONS
        return Sight(center, walls, center + walls, low[:0])  # no wall is above the openings
    band = flat[(-down > _WALL_BAND[0] * ceiling) & (-down < _WALL_BAND[1] * ceiling)]
    band = band[np.linalg.norm(band, axis=1) > _LEAST_DISTANCE * height]
    reach = measure_reach(band)
    if np.isfinite(reach).sum() < RAYS // 2:
        return None
    return Sight(center, reach[:, None] * RAY_DIRECTIONS, center + band, low)


def measure_reach(places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "ray"]:
    """Distance around each ray of the surface that most places show; NaN where there are fewer than three.

    It is the median of those near the median of all, so that a beam in front or an opening does not move it.
    """
    distances = split_by_azimuth(places, np.linalg.norm(places, axis=1), RAYS)
    reach = np.full(RAYS, np.nan)
    for ray in range(RAYS):
        found = np.sort(np.concatenate([distances[(ray + shift) % RAYS] for shift in range(-_BESIDE, _BESIDE + 1)]))
        if len(found) > 2:
            middle = found[(len(found) - 1) // 2]
            near = found[np.abs(found - middle) <= _SURFACE * middle]
            reach[ray] = (near[(len(near) - 1) // 2] + near[len(near) // 2]) / 2  # np.median takes ten times as long
    return reach


def find_directions(sights: Sequence[Sight], unit: float) -> Float[np.ndarray, "direction 2"]:
    """Normals of the main walls, two of them at right angles, and those of frequent oblique ones."""
    chords = np.concatenate([_find_chords(sight, unit)[1] for sight in sights])
    angles, weights = np.arctan2(chords[:, 1], chords[:, 0]), np.linalg.norm(chords, axis=1)
    main = _find_peak(angles, weights, 90)
    found = [main, main + math.pi / 2]
    total = weights.sum()
    for _ in range(2):
        free = np.min([np.abs(_wrap(angles - angle, math.pi)) for angle in found], axis=0) > _OBLIQUE
        if not free.any():
            break
        angle = _find_peak(angles[free], weights[free], 180)
        near = np.abs(_wrap(angles - angle, math.pi)) < math.radians(5)
        if weights[near & free].sum() < _OBLIQUE_SHARE * total:
            break
        found.append(angle)
    turned = np.array(found) + math.pi / 2
    return np.stack((np.cos(turned), np.sin(turned)), axis=1)


def _find_peak(angles: np.ndarray, weights: np.ndarray, period: int) -> float:
    """The most frequent angle, radians, of angles that are equal after a period (degrees)."""
    degrees = np.degrees(angles) % period
    counts = np.bincount(degrees.astype(int) % period, weights, period)
    smooth = sum(np.roll(counts, shift) for shift in range(-2, 3))
    peak = math.radians(int(np.argmax(smooth)) + 0.5)
    for tolerance in (6, 3, 3):
        offset = _wrap(angles - peak, math.radians(period))
        near = np.abs(offset) < math.radians(tolerance)
        if not near.any():
            break
        peak += float(np.average(offset[near], weights=weights[near]))
    return peak


def _wrap(angles: np.ndarray, period: float) -> np.ndarray:
    """Angles in half a period around 0."""
    return (angles + period / 2) % period - period / 2


def _find_chords(sight: Sight, unit: float) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Middles in the plan, and vectors, of chords along the walls."""
    chords = np.roll(sight.walls, -_SPAN, axis=0) - np.roll(sight.walls, _SPAN, axis=0)
    length, distance = (np.linalg.norm(values, axis=1) for values in (chords, sight.walls))
    with np.errstate(invalid="ignore"):
        usable = (length > 0) & (length < np.maximum(_LARGEST_STEP * distance, LEAST_WALL * unit))
    return sight.center + sight.walls[usable], chords[usable] / (2 * _SPAN)


def find_lines(sights: Sequence[Sight], normals: Float[np.ndarray, "direction 2"], unit: float) -> Lines:
    """The lines on which the walls of some panoramas are."""
    middles, chords = (np.concatenate(values) for values in zip(*(_find_chords(s, unit) for s in sights), strict=True))
    length = np.linalg.norm(chords, axis=1)
    found = []
    for normal in normals:
        chosen = np.abs(chords @ normal) < math.sin(_PARALLEL) * length
        offsets, weights = middles[chosen] @ normal, length[chosen]
        for _ in range(_MOST_LINES):
            if not len(offsets):
                break
            order = np.argsort(offsets, kind="stable")
            offsets, weights = offsets[order], weights[order]
            sums = np.concatenate(([0.0], np.cumsum(weights)))
            first, last = (np.searchsorted(offsets, offsets + sign * _CLUSTER * unit) for sign in (-1, 1))
            near = sums[last] - sums[first]
            best = int(near.argmax())
            if near[best] < LEAST_WALL * unit * len(sights) ** 0.5:
                break
            a, b = first[best], last[best]
            middle = np.searchsorted(sums[a : b + 1], (sums[a] + sums[b]) / 2)
            found.append((normal, offsets[a + max(int(middle) - 1, 0)]))
            offsets, weights = (np.delete(values, np.s_[a:b]) for values in (offsets, weights))
    return Lines(np.array([n for n, _ in found]).reshape(-1, 2), np.array([offset for _, offset in found]))


def trace_outline(sight: Sight, lines: Lines, unit: float) -> Polygon | None:
    """The outline of the walls around a camera; None if no lines enclose it."""
    sequence = _choose_lines(sight, lines, unit)
    if sequence is None:
        return None
    changes = np.flatnonzero(sequence != np.roll(sequence, 1))
    if len(changes) < 3:
        return None
    corners: list[np.ndarray] = []
    offsets = lines.offsets - lines.normals @ sight.center  # relative to the camera
    for ray in changes.tolist():
        before, after = int(sequence[ray - 1]), int(sequence[ray])
        corners += _join(_BORDERS[ray], lines.normals[[before, after]], offsets[[before, after]], unit)
    outline = np.array(corners).reshape(-1, 2)
    if len(outline) < 3 or not _is_along(outline, lines, unit):
        return None
    # Behind an opening no end of a wall may be seen: it ends where the farthest surfaces are.
    axes = np.stack((lines.normals[0], (-lines.normals[0, 1], lines.normals[0, 0])))
    low, high = (find(sight.walls @ axes.T, axis=0) for find in (np.nanmin, np.nanmax))
    margin = _LARGEST_ERROR * unit
    outline = np.clip(outline @ axes.T, low - margin, high + margin) @ axes
    pieces = shapely.get_parts(shapely.make_valid(Polygon(sight.center + outline)).buffer(0))
    return next((piece for piece in pieces if piece.contains(shapely.Point(sight.center))), None)


def _is_along(outline: Outline, lines: Lines, unit: float) -> bool:
    """Whether all longer sides of an outline are parallel to a wall, so that the walls enclose the camera."""
    sides = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(sides, axis=1)
    away = np.abs(sides @ lines.normals.T).min(axis=1)
    return not ((length > LEAST_WALL * unit) & (away > math.sin(_SKEW) * length)).any()


def _choose_lines(sight: Sight, lines: Lines, unit: float) -> np.ndarray | None:
    """The line that each ray ends at, by dynamic programming around the circle; None without lines."""
    if len(lines.offsets) < 3:
        return None
    measured = np.linalg.norm(sight.walls, axis=1)
    offsets = lines.offsets - lines.normals @ sight.center

    def meet(rays: np.ndarray) -> np.ndarray:
        """Distances (ray, line) at which rays meet the lines; infinite if they do not."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = offsets / (rays @ lines.normals.T)
        return np.where(distance > 0, distance, np.inf)

    reached = meet(RAY_DIRECTIONS)
    error = np.abs(reached - measured[:, None]) / unit
    costs = np.minimum(np.where(np.isnan(error), 0, error), _LARGEST_ERROR) / _DISTANCE_NOISE
    costs[np.isinf(reached)] = _NEVER
    between = meet(_BORDERS)
    beyond = np.where(np.isinf(between), _NEVER, 0.0)  # a wall ends where a ray meets it
    between = np.minimum(between, 1e3 * unit)
    total, origins = costs[0], []
    for step in range(1, 3 * RAYS):
        ray = step % RAYS
        jump = np.abs(between[ray][:, None] - between[ray]) / (_JUMP * unit)
        change = _CORNER + np.minimum(jump, _LARGEST_JUMP) + beyond[ray] + beyond[ray][:, None]
        np.fill_diagonal(change, 0)
        reached = total[:, None] + change  # from each line to each line
        origins.append(reached.argmin(axis=0))
        total = reached.min(axis=0) + costs[ray]
    state, sequence = int(total.argmin()), []
    for origin in reversed(origins):
        sequence.append(state)
        state = int(origin[state])
    sequence.append(state)
    return np.array(sequence[::-1])[RAYS : 2 * RAYS]


def _join(
    direction: Float[np.ndarray, "2"], normals: Float[np.ndarray, "2 2"], offsets: Float[np.ndarray, "2"], unit: float
) -> list[np.ndarray]:
    """Corners relative to a camera between two walls that meet, or of which the nearer one hides the other's end.

    Args:
        direction: in which the first wall ends.
        normals, offsets: of the two walls, relative to the camera.
    """
    along = normals @ direction
    distance = offsets / np.where(np.abs(along) < 1e-9, 1e-9, along)
    ends = distance[:, None] * direction
    if abs(np.linalg.det(normals)) > 0.17:  # 10 degrees
        corner = np.linalg.solve(normals, offsets)
        if min(np.linalg.norm(ends - corner, axis=1)) < 2 * _LARGEST_ERROR * unit and corner @ direction > 0:
            return [corner]
    if (distance <= 0).any() or not np.isfinite(distance).all():
        return []
    near = int(distance.argmin())
    far = 1 - near
    if abs(np.linalg.det(normals)) < 0.17:
        step = (offsets[far] - normals[far] @ ends[near]) / (normals[far] @ normals[near])
        hidden = [ends[near] + step * normals[near]]
    else:
        # The hidden wall starts at right angles to the nearer one, and another one ends at the farther one.
        across = np.stack((normals[near], -normals[far]), axis=1)
        lengths = np.linalg.solve(across, ends[far] - ends[near])
        hidden = [ends[near] + lengths[0] * normals[near], ends[far]]
    path = [ends[near], *hidden]
    return path if near == 0 else path[::-1]
