"""The room layout of a single panorama: the edge of the floor, and the straight walls on it.

A wall that only one view sees cannot be matched, but the boundary of the floor gives its distance. The appearance of
the floor is estimated from the scene: pixels far below the cameras that match the floor plane are floor, and pixels
above the horizon are not.

In a single direction the boundary is often unreliable. If walls are straight, neighbouring directions share a plane.
For each view, dynamic programming finds a path around the horizon that follows the floor boundary on few vertical
planes across the scene's axes. The walls are used where matching gives no evidence; they are dropped where the views
agree on another surface.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.matching import HypothesisSet, MatchingConfig, View, compute_matching_cost
from pansplat.sweep.planes import ScenePlanes
from pansplat.sweep.surface import nearest_pixel, pad_sphere, ray_grid, resize_sphere

_BINS = (5, 8, 32, 32)  # texture, lightness and the two colour axes of CIELAB
_BLUR = (0.7, 0.5, 1.0, 1.0)  # of the histogram, bins
_MIN_DENSITY = 2e-5  # added to each bin of the histogram
# Samples of the floor in two rounds: sine of the smallest angle below the horizon, and largest matching cost of the
# floor. The first round samples pixels below the cameras, the second all pixels of similar appearance.
_ROUNDS = ((0.8, 0.8), (0.4, 0.5))
_MIN_SCORE = -0.01  # smallest floor score of a sample
_SMOOTHING, _EDGE = 50.0, 6.0  # of the floor score: lambda, and sigma in 8 bit values, of the edge-aware filter
_FLOOR_SCORE = 0.2  # smallest floor score below the boundary
_MIN_DROP, _FULL_DROP = 0.25, 0.8  # drop of the floor score at which a boundary has confidence 0 and 1
_MAX_FLOOR_COST = 1.0  # matching cost of the floor below a boundary with confidence 0
_COST_RAMP = 0.2  # decrease of that cost at which the confidence is 1
_BOUNDARY_TOLERANCE = 0.12  # of the logarithm of the distance
_EDGE_NOISE, _EDGE_SCALE = 2.0, 30.0  # CIELAB differences between rows: ignored; divides a bonus by e
_ABOVE_HORIZON_SCALE = 3.0  # of edge sums, for surfaces that continue from above the horizon
_FAINT_DROP, _DROP_RANGE = 0.15, 0.65  # drop at which the boundary score is 0; its increase to score 1
_ANY_DEPTH = (1e-6, 1e6)  # inverse, 1/m
# Axis order of a panorama that is aligned with the scene (down first): its x is the third axis, its z the second.
_DOWN_FIRST, _ALIGNED = [1, 2, 0], [2, 0, 1]

# In units of the camera's height: the smallest and largest distance of a wall's base, and the spacing of the planes.
_NEAREST, _FARTHEST, _SPACING = 1 / 7, 20.0, 1 / 85
_NEIGHBOUR = 0.8  # factor on the boundary score of the neighbouring rows
_NO_WALL = 0.3  # score of a direction without a wall; a certain boundary has score 1
_CHANGE_PENALTY = 0.75  # at the start and at the end of a wall
_IMPOSSIBLE = 0.5
_FULL_SCORE, _FULL_WIDTH = 0.6, 0.15  # mean boundary score, and width in radians, of a wall with confidence 1
_TOP = 0.5  # radians above the horizon up to which a wall is compared with other surfaces
_SAME_DEPTH = 0.12  # of the logarithm of the depth
_CONTRADICTED = 0.15  # contradicted fraction of a wall at which its confidence starts to fall
_CONTRADICTION_RANGE = 0.2  # increase of that fraction at which the confidence is 0
_WALL_TOLERANCE = 0.1  # of the logarithm of a wall's depth


@dataclass(frozen=True)
class RoomLayoutConfig:
    """Weights of the room layout, in the unit of the matching cost."""

    not_floor_penalty: float = 0.5
    """Added to the floor where the floor score is -1."""
    floor_like_penalty: float = 0.3
    """Added to all other surfaces where the floor score is 1."""
    boundary_bonus: float = 0.8
    """Subtracted from surfaces that stand on the floor boundary."""
    boundary_decay: float = 1.5
    """Angle above the boundary, radians, that divides the bonus by e; image edges reduce it further."""
    wall_bonus: float = 2.0
    """Subtracted from a wall that no other view contradicts."""


@dataclass(frozen=True, eq=False)
class FloorBoundary:
    """The floor in one view's image. Azimuths are columns of a panorama that is aligned with the scene's axes.

    Attributes:
        floor_score: (h, w) from -1, certainly not floor, to 1.
        angle: (azimuths) of the boundary below the horizon, radians; there is floor below it.
        distance: (azimuths) from the camera to the boundary along the floor, metres.
        confidence: (azimuths) in [0, 1]; 0 where no boundary was found.
        score: (rows, azimuths) up to 1: evidence that the floor ends at the lower edge of a pixel.
        edge_sum: (rows, azimuths) sum of image edges from the bottom up to a row; each unit divides a bonus by e.
    """

    floor_score: np.ndarray
    angle: np.ndarray
    distance: np.ndarray
    confidence: np.ndarray
    score: np.ndarray
    edge_sum: np.ndarray

    def locate(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and azimuth (h, w) of rays (3, h, w) along the scene's axes."""
        return nearest_pixel(np.moveaxis(rays, 0, -1)[..., _ALIGNED], len(self.edge_sum))

    def attenuation(self, angle: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Factor (h, w) in [0, 1] by the image edges between a boundary (azimuths) and the rays above it; 0 below.

        Another object may begin at an edge.
        """
        height, (row, azimuth) = len(self.edge_sum), self.locate(rays)
        start = np.rint((angle / math.pi + 0.5) * height - 2.5).astype(np.int64)  # clear of the boundary's own edge
        at_boundary = self.edge_sum[np.clip(start, 0, height - 1), np.arange(len(angle))]
        factor = np.exp(-np.maximum(self.edge_sum[row, azimuth] - at_boundary[azimuth], 0))
        return np.where(_angle_above(angle[azimuth], rays) > 0, factor, 0)


def detect_floor_boundaries(
    views: Sequence[View],
    rays: Sequence[np.ndarray],
    cam2world: np.ndarray,
    planes: ScenePlanes,
    config: MatchingConfig,
) -> list[FloorBoundary] | None:
    """The floor boundary of each view; None without a detected floor plane.

    Args:
        rays: (3, h, w) for each view, components of its rays along the scene's axes.
    """
    heights = [planes.camera_height(pose) for pose in cam2world]
    if not all(planes.bin < height < math.inf for height in heights):
        return None
    costs = [
        np.mean(
            [
                _floor_cost(view, other, ray[0], height, np.linalg.inv(pose_of_other) @ pose, config)
                for other, pose_of_other in zip(views, cam2world, strict=True)
                if other is not view
            ],
            axis=0,
        )
        for view, ray, height, pose in zip(views, rays, heights, cam2world, strict=True)
    ]
    scores = _score_floor(views, rays, costs)
    return [
        _find_boundary(score, cost, view, height, planes.axes @ pose[:3, :3])
        for score, cost, view, height, pose in zip(scores, costs, views, heights, cam2world, strict=True)
    ]


def _floor_cost(
    view: View, other: View, down: np.ndarray, camera_height: float, pose: np.ndarray, config: MatchingConfig
) -> np.ndarray:
    """Matching cost (h, w) of the floor plane."""
    base = np.maximum(down, 1e-3).astype(np.float32) / np.float32(camera_height)
    floor = HypothesisSet(base, np.zeros_like(base), np.zeros((2, 1), np.float32), np.zeros(base.shape, np.uint8))
    return compute_matching_cost(view, other, pose, [floor], _ANY_DEPTH, (math.inf, -math.inf), config)[..., 0]


def _angle_above(angle: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Angle of rays (3, h, w) above a boundary, radians."""
    return angle - np.arcsin(np.clip(rays[0], -1, 1))


def _score_floor(views: Sequence[View], rays: Sequence[np.ndarray], costs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Score from -1 to 1: frequency of a pixel's colour and texture on the floor against above the horizon."""
    appearances = [_classify_appearance(view.image) for view in views]
    areas = [row_weights(len(view.image)).numpy()[:, None] * view.valid for view in views]
    above = _estimate_density(appearances, [area * (ray[0] < 0) for area, ray in zip(areas, rays, strict=True)])
    scores = [np.zeros(cost.shape, np.float32) for cost in costs]
    for min_down, max_cost in _ROUNDS:
        samples = [
            area * ((ray[0] > min_down) & (cost < max_cost) & (score > _MIN_SCORE))
            for area, ray, cost, score in zip(areas, rays, costs, scores, strict=True)
        ]
        if not any(weight.any() for weight in samples):
            break
        floor = _estimate_density(appearances, samples)
        ratio = ((floor - above) / (floor + above)).astype(np.float32)
        scores = [_smooth_between_edges(ratio[bins], view.image) for bins, view in zip(appearances, views, strict=True)]
    return scores


def _estimate_density(appearances: Sequence[tuple[np.ndarray, ...]], weights: Sequence[np.ndarray]) -> np.ndarray:
    """Density of each colour and texture, by weights (h, w) for each view."""
    histogram = np.zeros(_BINS)
    for bins, weight in zip(appearances, weights, strict=True):
        np.add.at(histogram, bins, weight)
    return ndimage.gaussian_filter(histogram / max(histogram.sum(), 1e-9), _BLUR) + _MIN_DENSITY


def _smooth_between_edges(values: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Values (h, w) smoothed between the image's edges."""
    margin = 8
    guide = (pad_sphere(image, margin) * 255).astype(np.uint8)
    padded = cv2.ximgproc.fastGlobalSmootherFilter(guide, pad_sphere(values, margin), _SMOOTHING, _EDGE)
    return padded[margin:-margin, margin:-margin]


def _classify_appearance(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Bins of texture and colour, four maps (h, w)."""
    padded = pad_sphere(image, 2)
    inside = (slice(2, -2), slice(2, -2))
    gray = padded.mean(axis=2)
    variance = cv2.blur(gray * gray, (3, 3)) - cv2.blur(gray, (3, 3)) ** 2
    texture = np.log2(np.sqrt(np.maximum(variance[inside], 1e-9)) / 0.006) + 1
    lab = cv2.cvtColor(cv2.blur(padded, (3, 3)), cv2.COLOR_RGB2LAB)[inside]
    values = (texture, lab[..., 0] / 12.5, lab[..., 1] / 4 + 16, lab[..., 2] / 4 + 16)
    return tuple(np.clip(v, 0, bins - 1).astype(np.int64) for v, bins in zip(values, _BINS, strict=True))


def _find_boundary(
    floor_score: np.ndarray, cost: np.ndarray, view: View, camera_height: float, down_first: np.ndarray
) -> FloorBoundary:
    """The lowest floor boundary at each azimuth.

    Args:
        cost: (h, w) of the floor plane.
        down_first: (3, 3) the scene's axes, down first, in the camera's frame, as rows.
    """
    height, width = floor_score.shape
    angle = ((np.arange(height) + 0.5) / height - 0.5) * math.pi
    row, column = nearest_pixel(ray_grid(height)[..., _DOWN_FIRST] @ down_first, height)
    score, cost, valid = floor_score[row, column], cost[row, column], view.valid[row, column]
    valid &= np.roll(valid, -3, axis=0)
    edge_sum = _sum_edges(cv2.blur(view.image, (3, 3))[row, column])
    # A surface that continues from above the horizon without an edge is not floor.
    standing = np.exp(-_ABOVE_HORIZON_SCALE * np.maximum(edge_sum[height // 2] - edge_sum, 0)) * (angle > 0)[:, None]
    score = score * (1 - standing) - standing
    before = _average_rows(score, 1, 4)
    drop = before - _average_rows(score, -2, 1)
    ends = (drop > _MIN_DROP) & (before > _FLOOR_SCORE) & valid
    ends &= drop >= ndimage.maximum_filter1d(drop, 5, axis=0)
    ends &= (angle > 0)[:, None]
    ends[-4:] = False
    lowest = height - 1 - ends[::-1].argmax(axis=0)
    azimuth = np.arange(width)
    is_floor = np.clip((_MAX_FLOOR_COST - _average_rows(cost, 2, 7)) / _COST_RAMP, 0, 1)
    confidence = np.clip((drop - _MIN_DROP) / (_FULL_DROP - _MIN_DROP), 0, 1) * is_floor
    boundary = angle[lowest] + 0.5 * math.pi / height
    return FloorBoundary(
        floor_score, boundary, camera_height / np.tan(boundary),
        confidence=np.where(ends.any(axis=0), confidence[lowest, azimuth], 0),
        score=_score_boundary(score, drop, before, valid),
        edge_sum=edge_sum,
    )  # fmt: skip


def _score_boundary(score: np.ndarray, drop: np.ndarray, before: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Boundary score (h, azimuths): a drop of the floor score after floor, with only floor below."""
    not_floor = np.cumsum((np.maximum(-score, 0) * valid)[::-1], axis=0)[::-1]
    not_floor /= np.maximum(np.cumsum(valid[::-1], axis=0)[::-1], 1)
    after_floor = np.clip((before + _FLOOR_SCORE) / (2 * _FLOOR_SCORE), 0, 1)
    evidence = np.clip((drop - _FAINT_DROP) / _DROP_RANGE, 0, 1) * after_floor
    return evidence * valid - np.roll(not_floor, -2, axis=0)


def _sum_edges(image: np.ndarray) -> np.ndarray:
    """Sum of the vertical changes of an image (h, w, 3) from its bottom up to each row."""
    lab = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB)
    step = np.abs(np.diff(lab, axis=0, append=lab[-1:])).sum(axis=2)
    return np.cumsum((np.maximum(step - _EDGE_NOISE, 0) / _EDGE_SCALE)[::-1], axis=0)[::-1]


def _average_rows(values: np.ndarray, first: int, end: int) -> np.ndarray:
    """For each row the mean of the rows from `first` up to `end` below it; the border rows are repeated."""
    margin = max(-first, end)
    padded = np.pad(values, ((margin, margin), (0, 0)), mode="edge").astype(np.float64)
    return sum(padded[margin + n : margin + n + len(values)] for n in range(first, end)) / (end - first)


def apply_floor_costs(
    cost: np.ndarray,
    boundary: FloorBoundary,
    sets: Sequence[HypothesisSet],
    is_floor: np.ndarray,
    rays: np.ndarray,
    config: RoomLayoutConfig,
) -> None:
    """Add the penalties and bonuses of the floor and its boundary to the cost, in place.

    Args:
        cost: (h, w, sets * count).
        sets: spheres, then horizontal planes, then vertical planes.
        is_floor: (count) horizontal planes below the camera that are the floor.
        rays: (3, h, w) components of the rays along the scene's axes.
    """
    count = sets[0].penalty.shape[1]
    below = rays[0] > 0
    score = resize_sphere(boundary.floor_score, len(cost))
    not_floor = config.not_floor_penalty * np.maximum(-score, 0) * below
    floor_like = (config.floor_like_penalty * np.maximum(score, 0) * below).astype(np.float32)
    cost += floor_like[..., None]
    for floor in np.flatnonzero(is_floor):
        cost[..., count + floor] += not_floor - floor_like
    _, column = boundary.locate(rays)
    weight = config.boundary_bonus * boundary.confidence[column] * boundary.attenuation(boundary.angle, rays)
    weight *= np.exp(-np.maximum(_angle_above(boundary.angle[column], rays), 0) / config.boundary_decay)
    depth = boundary.distance[column] / np.sqrt(np.maximum(1 - rays[0] ** 2, 1e-6))  # of surfaces on the boundary
    rows, columns = np.nonzero(weight > 1e-3)
    k = np.arange(count, dtype=np.float32)
    for n, hypotheses in enumerate(sets):
        if n == 1:  # horizontal planes do not stand on the floor
            continue
        inverse = hypotheses.base[rows, columns, None] + k * hypotheses.step[rows, columns, None]
        away = np.abs(np.log(np.maximum(inverse * depth[rows, columns, None], 1e-6))) / _BOUNDARY_TOLERANCE
        bonus = weight[rows, columns, None] * np.maximum(1 - away, 0)
        cost[rows, columns, n * count : (n + 1) * count] -= bonus.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Walls:
    """The walls in one view's image, by azimuth; see `FloorBoundary`.

    Attributes:
        axis: (azimuths) 1 or 2, the axis across the wall; 0 where there is none.
        offset: (azimuths) from the camera along that axis, signed, metres; 1 where there is none.
        index: (azimuths) of the wall; -1 where there is none.
        confidence: (azimuths) in [0, 1].
        base_angle: (azimuths) of the wall's base below the horizon, radians.
    """

    axis: np.ndarray
    offset: np.ndarray
    index: np.ndarray
    confidence: np.ndarray
    base_angle: np.ndarray


def fit_walls(boundary: FloorBoundary, camera_height: float, far: float) -> Walls:
    """The walls that follow a view's floor boundary.

    Args:
        camera_height: over the floor, metres.
        far: largest distance of the scene, metres.
    """
    height, width = boundary.score.shape
    azimuth = ((np.arange(width) + 0.5) / width * 2 - 1) * math.pi
    far, step = min(far, _FARTHEST * camera_height), _SPACING * camera_height
    planes = int(far / step)
    along = np.repeat(np.stack((np.cos(azimuth), np.sin(azimuth))), 2 * planes, axis=0).T
    offsets = np.tile((np.arange(-planes, planes) + 0.5) * step, 2)
    with np.errstate(divide="ignore"):
        distance = offsets / along
    in_range = (distance > _NEAREST * camera_height) & (distance < far)
    angle = np.arctan(camera_height / np.where(in_range, distance, 1))
    row = np.clip((angle / math.pi + 0.5) * height - 1, 0, height - 1.001)  # of the pixel with this lower edge
    scores = np.maximum(boundary.score, _NEIGHBOUR * ndimage.maximum_filter1d(boundary.score, 3, axis=0))
    upper, fraction, column = row.astype(np.int64), row % 1, np.arange(width)[:, None]
    found = (1 - fraction) * scores[upper, column] + fraction * scores[upper + 1, column]
    found = np.where(in_range, found, -_IMPOSSIBLE)
    chosen = _find_best_path(found)
    is_wall = chosen >= 0
    index = np.where(is_wall, np.cumsum(chosen != np.roll(chosen, 1)), -1)
    index[index == index[-1]] = index[0] if chosen[0] == chosen[-1] else index[-1]
    kept = np.maximum(chosen, 0)
    confidence = np.zeros(width)
    for wall in np.unique(index[is_wall]):
        at = np.flatnonzero(index == wall)
        confidence[at] = np.clip(found[at, chosen[at]].mean() / _FULL_SCORE, 0, 1)
        confidence[at] *= min(len(at) * 2 * math.pi / width / _FULL_WIDTH, 1)
    return Walls(
        axis=np.where(is_wall, 1 + kept // (len(offsets) // 2), 0),
        offset=np.where(is_wall, offsets[kept], 1),
        index=index,
        confidence=confidence,
        base_angle=np.where(is_wall, angle[np.arange(width), kept], 0),
    )


def _find_best_path(found: np.ndarray) -> np.ndarray:
    """The plane at each azimuth, -1 for none, of the path with the highest score; `found` is (azimuths, planes).

    Dynamic programming over two turns; the middle turn does not depend on the start and the end.
    """
    width, planes = found.shape
    walls, none = np.zeros(planes), 0.0
    predecessor = np.empty((2 * width, planes + 1), np.int64)  # the last column is the predecessor of "no wall"
    for n in range(2 * width):
        best = int(walls.argmax())
        between, source = max((none, -1), (walls[best] - _CHANGE_PENALTY, best))
        begins = between - _CHANGE_PENALTY > walls
        predecessor[n, :-1] = np.where(begins, source, np.arange(planes))
        predecessor[n, -1] = source
        walls, none = np.where(begins, between - _CHANGE_PENALTY, walls) + found[n % width], between + _NO_WALL
    last = int(walls.argmax()) if walls.max() > none else -1
    path = np.empty(2 * width, np.int64)
    for n in range(2 * width - 1, -1, -1):
        path[n] = last
        last = int(predecessor[n, last])
    return np.concatenate((path[width : width + width // 2], path[width // 2 : width]))


def discount_contradicted(
    walls: Walls, boundary: FloorBoundary, rays: np.ndarray, inverse: np.ndarray, consistent: np.ndarray
) -> Walls:
    """The walls with lower confidence where the views agree on another surface.

    Args:
        rays: (3, h, w) components of the rays along the scene's axes.
        inverse: (h, w) inverse depth of the surface found so far, 1/m.
        consistent: (h, w) where that surface is consistent with another view.
    """
    _, column = boundary.locate(rays)
    wall = _wall_inverse_depth(walls, rays, column)
    angle = np.arcsin(np.clip(rays[0], -1, 1))
    compared = (walls.index[column] >= 0) & (wall > 0) & (angle < walls.base_angle[column]) & (angle > -_TOP)
    index, area = walls.index[column][compared], np.cos(angle)[compared]
    same = np.abs(np.log(np.maximum(inverse[compared], 1e-6) / np.maximum(wall[compared], 1e-6))) < _SAME_DEPTH
    against = np.where(consistent[compared], np.where(same, -area, area), 0)
    count = max(int(walls.index.max()) + 1, 1)
    whole = np.maximum(np.bincount(index, area, count), 1e-9)
    factor = np.clip(1 - (np.bincount(index, against, count) / whole - _CONTRADICTED) / _CONTRADICTION_RANGE, 0, 1)
    return dataclasses.replace(walls, confidence=walls.confidence * factor[np.maximum(walls.index, 0)])


def apply_wall_bonus(
    cost: np.ndarray,
    walls: Walls,
    boundary: FloorBoundary,
    sets: Sequence[HypothesisSet],
    rays: np.ndarray,
    ceiling: float,
    bonus: float,
) -> None:
    """Subtract the bonus from the cost of the hypotheses on the walls, in place.

    Args:
        cost: (h, w, sets * count).
        sets: spheres, then horizontal planes, then vertical planes.
        rays: (3, h, w) components of the rays along the scene's axes.
        ceiling: extent of the scene above the camera (negative), metres.
    """
    count = sets[0].penalty.shape[1]
    _, column = boundary.locate(rays)
    wall = _wall_inverse_depth(walls, rays, column)
    weight = bonus * walls.confidence[column] * boundary.attenuation(walls.base_angle, rays)
    with np.errstate(invalid="ignore"):  # a ceiling at infinity times a wall without a distance
        weight *= (wall > 0) & (rays[0] > ceiling * wall)
    k = np.arange(count, dtype=np.float32)
    for axis in (1, 2):
        rows, columns = np.nonzero((weight > 1e-3) & (walls.axis[column] == axis))
        hypotheses, first = sets[1 + axis], (1 + axis) * count
        inverse = hypotheses.base[rows, columns, None] + k * hypotheses.step[rows, columns, None]
        away = np.abs(np.log(np.maximum(inverse / wall[rows, columns, None], 1e-6))) / _WALL_TOLERANCE
        cost[rows, columns, first : first + count] -= (
            weight[rows, columns, None] * np.maximum(1 - away, 0)
        ).astype(np.float32)  # fmt: skip


def _wall_inverse_depth(walls: Walls, rays: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Inverse depth (h, w) of the walls at rays, at most 0 where there is none."""
    across = np.where(walls.axis[column] == 1, rays[1], rays[2])
    return np.where(walls.axis[column] > 0, across / walls.offset[column], 0)
