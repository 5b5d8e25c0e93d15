"""What one picture says by itself: what looks like the floor, and how far away the things are that stand on it.

Where only one view sees a wall nothing can be matched, but the wall's foot shows where it stands. What the floor looks
like the scene tells itself: what lies steeply below the cameras and matches as floor does, what is above the
horizon does not. (`walls` makes straight walls of the feet.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.cost import Family, MatchingConfig, View, matching_cost
from pansplat.sweep.planes import PlaneSupport
from pansplat.sweep.sphere import nearest_pixel, pad_sphere, ray_grid, resize_sphere

_BINS = (5, 8, 32, 32)  # texture, lightness and the two colour axes of CIELAB
_BLUR = (0.7, 0.5, 1.0, 1.0)  # of the histogram, bins
_UNKNOWN = 2e-5  # density of a bin below which nothing is known of it
# Rounds of learning. Sine of the angle below the horizon of what may teach the floor, and the cost up to which it must
# match as floor: first what lies under the cameras, where little else stands, then all that looks like that, too.
_ROUNDS = ((0.8, 0.8), (0.4, 0.5))
_UNLIKE = -0.01  # likeness up to which a pixel teaches nothing about the floor
_SMOOTHING, _EDGE = 50.0, 6.0  # of the likeness, between the picture's edges: lambda, sigma of 8 bit values
_FLOOR_LIKE = 0.2  # likeness before an end, at least
_MIN_DROP, _SURE_DROP = 0.25, 0.8  # of the likeness where the floor ends
_BAD_FLOOR, _SLACK = 1.0, 0.2  # cost at which what lies before a foot is no floor after all
_FOOT_TOLERANCE = 0.12  # of the logarithm of a foot's distance
_NOISE, _CHANGE = 2.0, 30.0  # of CIELAB from row to row: what counts for nothing, and what makes a foot count less by e
_STANDS = 3.0  # how many times sooner an edge ends what stands from the horizon down
_FAINT_DROP, _LEFT = 0.15, 0.65  # of the likeness: the least that may be an end, and how much more makes it sure
_ANY_DEPTH = (1e-6, 1e6)  # inverse, 1/m
# Between the scene's axes, down first, and those of a panorama that stands along them: x the third, z the second.
_DOWN_FIRST, _LEVELLED = [1, 2, 0], [2, 0, 1]


@dataclass(frozen=True)
class FloorConfig:
    """How much is made of the floor's look, in the matching cost's unit."""

    unlike_penalty: float = 0.5
    """For the floor where the picture surely does not look like it."""
    like_penalty: float = 0.3
    """For anything but the floor where the picture surely looks like it."""
    foot_bonus: float = 0.8
    """For standing on the floor where the floor ends ..."""
    foot_reach: float = 1.5
    """... falling by e this many radians above the foot, and faster where the picture changes on the way up."""
    wall_bonus: float = 2.0
    """For lying on the wall that stands there, if no other view contradicts it."""


@dataclass(frozen=True, eq=False)
class FloorClues:
    """What one view's picture says.

    Attributes:
        likeness: (h, w) from -1, surely no floor, to 1.
        foot_angle: (azimuths) angle below the horizon where the floor ends, radians; below it there is floor. Azimuths
            are columns of a panorama that stands along the scene's axes.
        foot_distance: (azimuths) from the camera to there along the floor, metres.
        foot_strength: (azimuths) in [0, 1]; 0 where no end was found.
        ends: (rows, azimuths) of that panorama, up to 1, how surely the floor ends at a pixel's lower edge.
        change: (rows, azimuths) how much the picture changes from the bottom up to a row, in units that make
            a foot count less by e each.
    """

    likeness: np.ndarray
    foot_angle: np.ndarray
    foot_distance: np.ndarray
    foot_strength: np.ndarray
    ends: np.ndarray
    change: np.ndarray

    def locate(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and azimuth (h, w) of rays (3, h, w) given along the scene's axes."""
        return nearest_pixel(np.moveaxis(rays, 0, -1)[..., _LEVELLED], len(self.change))

    def fading(self, foot_angle: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """What is left (h, w), in [0, 1], of a foot (azimuths) at a ray above it; 0 for rays below.

        It fades where the picture changes between the two, for there something else may begin.
        """
        height, (row, azimuth) = len(self.change), self.locate(rays)
        start = np.rint((foot_angle / math.pi + 0.5) * height - 2.5).astype(np.int64)  # clear of the foot's own edge
        at_foot = self.change[np.clip(start, 0, height - 1), np.arange(len(foot_angle))]
        left = np.exp(-np.maximum(self.change[row, azimuth] - at_foot[azimuth], 0))
        return np.where(_above(foot_angle[azimuth], rays) > 0, left, 0)


def find_floor(
    views: Sequence[View],
    rays: Sequence[np.ndarray],
    cam2world: np.ndarray,
    support: PlaneSupport,
    config: MatchingConfig,
) -> list[FloorClues] | None:
    """What each view's picture says of the floor; None where pixels voted for none.

    Args:
        rays: (3, h, w) for each view, components of its rays along the scene's axes.
    """
    below = [support.floor_below(pose) for pose in cam2world]
    if not all(support.bin < depth < math.inf for depth in below):
        return None
    costs = [
        np.mean(
            [
                _cost_of_floor(view, other, ray[0], depth, np.linalg.inv(pose_of_other) @ pose, config)
                for other, pose_of_other in zip(views, cam2world, strict=True)
                if other is not view
            ],
            axis=0,
        )
        for view, ray, depth, pose in zip(views, rays, below, cam2world, strict=True)
    ]
    likeness = _likeness(views, rays, costs)
    return [
        _clues(like, cost, view, depth, support.axes @ pose[:3, :3])
        for like, cost, view, depth, pose in zip(likeness, costs, views, below, cam2world, strict=True)
    ]


def _cost_of_floor(
    view: View, other: View, down: np.ndarray, below: float, pose: np.ndarray, config: MatchingConfig
) -> np.ndarray:
    """Matching cost (h, w) of the floor, `below` metres under the camera."""
    base = np.maximum(down, 1e-3).astype(np.float32) / np.float32(below)
    family = Family(base, np.zeros_like(base), np.zeros((2, 1), np.float32), np.zeros(base.shape, np.uint8))
    return matching_cost(view, other, pose, [family], _ANY_DEPTH, (math.inf, -math.inf), config)[..., 0]


def _above(foot_angle: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """How far above a foot rays (3, h, w) are, radians."""
    return foot_angle - np.arcsin(np.clip(rays[0], -1, 1))


def _likeness(views: Sequence[View], rays: Sequence[np.ndarray], costs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """From -1 to 1: how much more often a pixel's colour and texture are found on the floor than above the horizon."""
    looks = [_look(view.image) for view in views]
    areas = [row_weights(len(view.image)).numpy()[:, None] * view.usable for view in views]
    above = _density(looks, [area * (ray[0] < 0) for area, ray in zip(areas, rays, strict=True)])
    likeness = [np.zeros(cost.shape, np.float32) for cost in costs]
    for steep, match in _ROUNDS:
        taught = [
            area * ((ray[0] > steep) & (cost < match) & (like > _UNLIKE))
            for area, ray, cost, like in zip(areas, rays, costs, likeness, strict=True)
        ]
        if not any(weight.any() for weight in taught):
            break
        floor = _density(looks, taught)
        ratio = ((floor - above) / (floor + above)).astype(np.float32)
        likeness = [_smooth(ratio[look], view.image) for look, view in zip(looks, views, strict=True)]
    return likeness


def _density(looks: Sequence[tuple[np.ndarray, ...]], weights: Sequence[np.ndarray]) -> np.ndarray:
    """How often each colour and texture is met, by weights (h, w) for each view."""
    histogram = np.zeros(_BINS)
    for look, weight in zip(looks, weights, strict=True):
        np.add.at(histogram, look, weight)
    return ndimage.gaussian_filter(histogram / max(histogram.sum(), 1e-9), _BLUR) + _UNKNOWN


def _smooth(values: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Values (h, w) smoothed between the picture's edges."""
    margin = 8
    guide = (pad_sphere(image, margin) * 255).astype(np.uint8)
    padded = cv2.ximgproc.fastGlobalSmootherFilter(guide, pad_sphere(values, margin), _SMOOTHING, _EDGE)
    return padded[margin:-margin, margin:-margin]


def _look(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Bins of texture and colour, four maps (h, w)."""
    padded = pad_sphere(image, 2)
    inside = (slice(2, -2), slice(2, -2))
    gray = padded.mean(axis=2)
    variance = cv2.blur(gray * gray, (3, 3)) - cv2.blur(gray, (3, 3)) ** 2
    texture = np.log2(np.sqrt(np.maximum(variance[inside], 1e-9)) / 0.006) + 1
    lab = cv2.cvtColor(cv2.blur(padded, (3, 3)), cv2.COLOR_RGB2LAB)[inside]
    values = (texture, lab[..., 0] / 12.5, lab[..., 1] / 4 + 16, lab[..., 2] / 4 + 16)
    return tuple(np.clip(v, 0, bins - 1).astype(np.int64) for v, bins in zip(values, _BINS, strict=True))


def _clues(likeness: np.ndarray, cost: np.ndarray, view: View, below: float, down_first: np.ndarray) -> FloorClues:
    """Where the floor ends, by azimuth; see `FloorClues`.

    Args:
        cost: (h, w) of the floor.
        down_first: (3, 3) the scene's axes, down first, in the camera's frame, as rows.
    """
    height, width = likeness.shape
    angle = ((np.arange(height) + 0.5) / height - 0.5) * math.pi
    row, column = nearest_pixel(ray_grid(height)[..., _DOWN_FIRST] @ down_first, height)
    like, cost, usable = likeness[row, column], cost[row, column], view.usable[row, column]
    usable &= np.roll(usable, -3, axis=0)
    change = _change(cv2.blur(view.image, (3, 3))[row, column])
    # What goes on below the horizon as it is above, without an edge, is no floor whatever its colour.
    stands = np.exp(-_STANDS * np.maximum(change[height // 2] - change, 0)) * (angle > 0)[:, None]
    like = like * (1 - stands) - stands
    before = _mean_of_rows(like, 1, 4)
    drop = before - _mean_of_rows(like, -2, 1)
    ends = (drop > _MIN_DROP) & (before > _FLOOR_LIKE) & usable
    ends &= drop >= ndimage.maximum_filter1d(drop, 5, axis=0)
    ends &= (angle > 0)[:, None]
    ends[-4:] = False
    lowest = height - 1 - ends[::-1].argmax(axis=0)
    azimuth = np.arange(width)
    is_floor = np.clip((_BAD_FLOOR - _mean_of_rows(cost, 2, 7)) / _SLACK, 0, 1)
    sure = np.clip((drop - _MIN_DROP) / (_SURE_DROP - _MIN_DROP), 0, 1) * is_floor
    strength = np.where(ends.any(axis=0), sure[lowest, azimuth], 0)
    foot = angle[lowest] + 0.5 * math.pi / height
    return FloorClues(
        likeness, foot, below / np.tan(foot), strength,
        ends=_soft_ends(like, drop, before, usable),
        change=change,
    )  # fmt: skip


def _soft_ends(like: np.ndarray, drop: np.ndarray, before: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """How surely the floor ends at a row, (h, azimuths): a drop after floor, with nothing but floor below."""
    unlike = np.cumsum((np.maximum(-like, 0) * usable)[::-1], axis=0)[::-1]
    unlike /= np.maximum(np.cumsum(usable[::-1], axis=0)[::-1], 1)
    sure = np.clip((drop - _FAINT_DROP) / _LEFT, 0, 1) * np.clip((before + _FLOOR_LIKE) / (2 * _FLOOR_LIKE), 0, 1)
    return sure * usable - np.roll(unlike, -2, axis=0)


def _change(image: np.ndarray) -> np.ndarray:
    """How much a picture (h, w, 3) changes from its bottom up to each row; see `FloorClues`."""
    lab = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB)
    step = np.abs(np.diff(lab, axis=0, append=lab[-1:])).sum(axis=2)
    return np.cumsum((np.maximum(step - _NOISE, 0) / _CHANGE)[::-1], axis=0)[::-1]


def _mean_of_rows(values: np.ndarray, first: int, end: int) -> np.ndarray:
    """For each row the mean of the rows from `first` up to `end` below it; the last ones stand for those beyond."""
    margin = max(-first, end)
    padded = np.pad(values, ((margin, margin), (0, 0)), mode="edge").astype(np.float64)
    return sum(padded[margin + n : margin + n + len(values)] for n in range(first, end)) / (end - first)


def add_clues(
    cost: np.ndarray,
    clues: FloorClues,
    families: Sequence[Family],
    is_floor: np.ndarray,
    rays: np.ndarray,
    config: FloorConfig,
) -> None:
    """Make hypotheses dearer or cheaper, in place, by what the picture says.

    Args:
        cost: (h, w, families * count).
        families: spheres, then planes across the down axis, then upright planes.
        is_floor: (count) the down axis' planes below the camera that are the floor.
        rays: (3, h, w) components of the rays along the scene's axes.
    """
    count = families[0].penalty.shape[1]
    below = rays[0] > 0
    likeness = resize_sphere(clues.likeness, len(cost))
    unlike = config.unlike_penalty * np.maximum(-likeness, 0) * below
    like = (config.like_penalty * np.maximum(likeness, 0) * below).astype(np.float32)
    cost += like[..., None]
    for floor in np.flatnonzero(is_floor):
        cost[..., count + floor] += unlike - like
    _, column = clues.locate(rays)
    weight = config.foot_bonus * clues.foot_strength[column] * clues.fading(clues.foot_angle, rays)
    weight *= np.exp(-np.maximum(_above(clues.foot_angle[column], rays), 0) / config.foot_reach)
    upright = clues.foot_distance[column] / np.sqrt(np.maximum(1 - rays[0] ** 2, 1e-6))  # depth of what stands there
    rows, columns = np.nonzero(weight > 1e-3)
    k = np.arange(count, dtype=np.float32)
    for n, family in enumerate(families):
        if n == 1:  # what is level does not stand
            continue
        inverse = family.base[rows, columns, None] + k * family.step[rows, columns, None]
        away = np.abs(np.log(np.maximum(inverse * upright[rows, columns, None], 1e-6))) / _FOOT_TOLERANCE
        bonus = weight[rows, columns, None] * np.maximum(1 - away, 0)
        cost[rows, columns, n * count : (n + 1) * count] -= bonus.astype(np.float32)
