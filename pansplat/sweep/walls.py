"""Straight walls from the floor's ends: in each direction the upright plane along the scene's axes that stands there.

A foot that one direction shows badly its neighbours show, if a wall is straight. So for each view one path around the
horizon is sought that follows the floor's ends (`floor.FloorClues`) on few planes. What the picture says this way holds
where matching has nothing to say; where the views agree on another surface there is no such wall.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from pansplat.sweep.cost import Family
from pansplat.sweep.floor import FloorClues

# Of the camera's height over the floor: the nearest and the farthest foot of a wall, and between planes that are tried.
_NEAREST, _FARTHEST, _STEP = 1 / 7, 20.0, 1 / 85
_NEIGHBOUR = 0.8  # what an end says of the rows next to it
_NO_WALL = 0.3  # what a direction without a wall counts for, where 1 is a sure end of the floor
_BEGIN = 0.75  # what beginning or leaving a wall costs, likewise
_IMPOSSIBLE = 0.5
_SURE, _WIDE = 0.6, 0.15  # mean end, and width in radians, from which a wall is fully believed
_TOP = 0.5  # radians above the horizon up to which a wall is compared with other surfaces
_SAME = 0.12  # of the logarithm of the depth
_CONTRADICTED, _DOUBT = 0.15, 0.2  # share of a wall from where on it is doubted, and how much more ends it
_TOLERANCE = 0.1  # of the logarithm of a wall's depth


@dataclass(frozen=True, eq=False)
class Walls:
    """The walls that one picture shows, by azimuth (columns of a panorama that stands along the scene's axes).

    Attributes:
        axis: (azimuths) 1 or 2, the axis across the wall; 0 where there is none.
        offset: (azimuths) from the camera along that axis, signed, metres; 1 where there is none.
        number: (azimuths) which wall it is; -1 where there is none.
        strength: (azimuths) in [0, 1].
        foot_angle: (azimuths) of the wall's foot below the horizon, radians.
    """

    axis: np.ndarray
    offset: np.ndarray
    number: np.ndarray
    strength: np.ndarray
    foot_angle: np.ndarray


def find_walls(clues: FloorClues, below: float, far: float) -> Walls:
    """The walls that follow a picture's ends of the floor.

    Args:
        below: how far under the camera the floor is, metres.
        far: how far the scene reaches, metres.
    """
    height, width = clues.ends.shape
    azimuth = ((np.arange(width) + 0.5) / width * 2 - 1) * math.pi
    far, step = min(far, _FARTHEST * below), _STEP * below
    planes = int(far / step)
    along = np.repeat(np.stack((np.cos(azimuth), np.sin(azimuth))), 2 * planes, axis=0).T
    offsets = np.tile((np.arange(-planes, planes) + 0.5) * step, 2)
    with np.errstate(divide="ignore"):
        distance = offsets / along
    there = (distance > _NEAREST * below) & (distance < far)
    angle = np.arctan(below / np.where(there, distance, 1))
    row = np.clip((angle / math.pi + 0.5) * height - 1, 0, height - 1.001)  # of the pixel whose lower edge is there
    ends = np.maximum(clues.ends, _NEIGHBOUR * ndimage.maximum_filter1d(clues.ends, 3, axis=0))
    upper, part, column = row.astype(np.int64), row % 1, np.arange(width)[:, None]
    found = (1 - part) * ends[upper, column] + part * ends[upper + 1, column]
    found = np.where(there, found, -_IMPOSSIBLE)
    chosen = _best_path(found)
    is_wall = chosen >= 0
    number = np.where(is_wall, np.cumsum(chosen != np.roll(chosen, 1)), -1)
    number[number == number[-1]] = number[0] if chosen[0] == chosen[-1] else number[-1]
    kept = np.maximum(chosen, 0)
    strength = np.zeros(width)
    for wall in np.unique(number[is_wall]):
        at = np.flatnonzero(number == wall)
        strength[at] = np.clip(found[at, chosen[at]].mean() / _SURE, 0, 1)
        strength[at] *= min(len(at) * 2 * math.pi / width / _WIDE, 1)
    return Walls(
        axis=np.where(is_wall, 1 + kept // (len(offsets) // 2), 0),
        offset=np.where(is_wall, offsets[kept], 1),
        number=number,
        strength=strength,
        foot_angle=np.where(is_wall, angle[np.arange(width), kept], 0),
    )


def _best_path(found: np.ndarray) -> np.ndarray:
    """The plane (azimuths) around the horizon that collects most, -1 for none; `found` is (azimuths, planes)."""
    width, planes = found.shape
    walls, none = np.zeros(planes), 0.0
    came_from = np.empty((2 * width, planes + 1), np.int64)  # the last column: from where "none" came
    for n in range(2 * width):  # twice around, of which the middle does not know where it began
        best = int(walls.argmax())
        between, source = max((none, -1), (walls[best] - _BEGIN, best))
        begins = between - _BEGIN > walls
        came_from[n, :-1] = np.where(begins, source, np.arange(planes))
        came_from[n, -1] = source
        walls, none = np.where(begins, between - _BEGIN, walls) + found[n % width], between + _NO_WALL
    last = int(walls.argmax()) if walls.max() > none else -1
    path = np.empty(2 * width, np.int64)
    for n in range(2 * width - 1, -1, -1):
        path[n] = last
        last = int(came_from[n, last])
    return np.concatenate((path[width : width + width // 2], path[width // 2 : width]))


def believe(walls: Walls, clues: FloorClues, rays: np.ndarray, inverse: np.ndarray, agreed: np.ndarray) -> Walls:
    """The walls made weaker where the views agree on another surface.

    Args:
        rays: (3, h, w) components of the rays along the scene's axes.
        inverse: (h, w) inverse depth of the surface so far, 1/m.
        agreed: (h, w) where another view's surface is the same.
    """
    _, column = clues.locate(rays)
    wall = _inverse_depth(walls, rays, column)
    angle = np.arcsin(np.clip(rays[0], -1, 1))
    compared = (walls.number[column] >= 0) & (wall > 0) & (angle < walls.foot_angle[column]) & (angle > -_TOP)
    number, area = walls.number[column][compared], np.cos(angle)[compared]
    same = np.abs(np.log(np.maximum(inverse[compared], 1e-6) / np.maximum(wall[compared], 1e-6))) < _SAME
    against = np.where(agreed[compared], np.where(same, -area, area), 0)
    count = max(int(walls.number.max()) + 1, 1)
    whole = np.maximum(np.bincount(number, area, count), 1e-9)
    left = np.clip(1 - (np.bincount(number, against, count) / whole - _CONTRADICTED) / _DOUBT, 0, 1)
    return dataclasses.replace(walls, strength=walls.strength * left[np.maximum(walls.number, 0)])


def add_walls(
    cost: np.ndarray,
    walls: Walls,
    clues: FloorClues,
    families: Sequence[Family],
    rays: np.ndarray,
    ceiling: float,
    bonus: float,
) -> None:
    """Make the hypotheses on the walls cheaper, in place.

    Args:
        cost: (h, w, families * count).
        families: spheres, then planes across the down axis, then upright planes.
        rays: (3, h, w) components of the rays along the scene's axes.
        ceiling: how far the scene reaches up from the camera (negative), metres.
    """
    count = families[0].penalty.shape[1]
    _, column = clues.locate(rays)
    wall = _inverse_depth(walls, rays, column)
    weight = bonus * walls.strength[column] * clues.fading(walls.foot_angle, rays)
    weight *= (wall > 0) & (rays[0] > ceiling * wall)
    k = np.arange(count, dtype=np.float32)
    for axis in (1, 2):
        rows, columns = np.nonzero((weight > 1e-3) & (walls.axis[column] == axis))
        family, first = families[1 + axis], (1 + axis) * count
        inverse = family.base[rows, columns, None] + k * family.step[rows, columns, None]
        away = np.abs(np.log(np.maximum(inverse / wall[rows, columns, None], 1e-6))) / _TOLERANCE
        cost[rows, columns, first : first + count] -= (
            weight[rows, columns, None] * np.maximum(1 - away, 0)
        ).astype(np.float32)  # fmt: skip


def _inverse_depth(walls: Walls, rays: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Inverse depth (h, w) of the walls at rays, at most 0 where there is none."""
    across = np.where(walls.axis[column] == 1, rays[1], rays[2])
    return np.where(walls.axis[column] > 0, across / walls.offset[column], 0)
