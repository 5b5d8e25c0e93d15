"""The scene's axes and its planes.

Rooms consist of horizontal planes and of two directions of vertical ones (a Manhattan world). The axes follow from
image gradients: a straight line and the camera span a plane, whose normal is the gradient's direction on the sphere,
and the line's direction is perpendicular to this normal.

The planes across each axis are detected by Hough voting, before any surface is known. Most hypotheses of a single
pixel are wrong. Wrong hypotheses are spread over all offsets, while the pixels of a floor or a wall have one offset.
Each pixel distributes one vote over its hypotheses by their matching cost. A wall without texture matches everywhere
and therefore has no influence. After the first pass the histogram of the consistent surfaces supplements the votes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.matching import DepthRange, HypothesisSet, MatchingConfig, OtherView, View, compute_matching_cost
from pansplat.sweep.surface import Surface, pad_sphere, ray_grid, world_points

_MIN_GRADIENT = 0.02  # per pixel; smaller gradients are noise
_MAX_GRADIENT = 0.2  # larger gradients have the weight of this one

_BIN_WIDTH = 1 / 9  # in units of `near`: 5 cm indoors
_REACH = 1.5  # largest offset of a plane from the cameras' mean, relative to the largest depth
_MIN_SOLID_ANGLE, _MAX_SOLID_ANGLE = 2e-4, 2e-2  # fractions of the sphere at which a plane's support is 0 and 1
_DOWN_AXIS = 0
MIN_FLOOR = 0.9  # smallest distance of the floor or ceiling from the camera, in units of `near`
_FLOOR_SOLID_ANGLE = 0.02  # smallest fraction of the sphere that a floor or ceiling covers

_CANDIDATES = 96  # planes across an axis
_SOFTNESS = np.float32(0.1)  # difference of cost that divides a vote by e
_MAX_COST = np.float32(0.6)  # smallest cost of a match without a vote
_MAX_VARIANCE = 4e-3  # of grey values; more texture has no more weight
_MIN_SLANT = 0.2  # smallest component of a ray along a plane's normal
_MIN_VOTES = 0.1  # scale of a plane's votes, relative to the strongest plane
_DISTINCT = 3  # ratio of a floor's or ceiling's votes to the median

_UNBOUNDED = (math.inf, -math.inf)


def estimate_axes(images: Sequence[np.ndarray], rotations: Sequence[np.ndarray]) -> np.ndarray:
    """Orthonormal world axes of the scene, as rows: down, and the two main wall normals.

    Down starts at the mean of the cameras' y axes and is fitted to the vertical edges. The walls' yaw is the peak of
    the histogram of horizontal edges, modulo a quarter turn. Without edges the axes are still orthonormal.

    Args:
        images: panoramas (h, w, 3) in [0, 1], about 256 pixels high.
        rotations: camera-to-world rotations (3, 3) of the same views.
    """
    normals, weights = [], []
    for image, rotation in zip(images, rotations, strict=True):
        normal, weight = _edge_normals(image)
        normals.append(normal @ rotation.T)
        weights.append(weight)
    normal, weight = np.concatenate(normals), np.concatenate(weights)
    down = _fit_down(normal, weight, np.sum([rotation[:, 1] for rotation in rotations], axis=0))
    helper = np.eye(3)[np.abs(down).argmin()]
    a = np.cross(down, helper)
    a /= np.linalg.norm(a)
    b = np.cross(down, a)
    yaw = _fit_yaw(normal, weight, down, a, b)
    return np.stack((down, math.cos(yaw) * a + math.sin(yaw) * b, -math.sin(yaw) * a + math.cos(yaw) * b))


def match_axes(axes: np.ndarray, reference: np.ndarray) -> list[int]:
    """The order in which the walls' axes of `estimate_axes` are those of a reference."""
    return [0, 1, 2] if abs(axes[1] @ reference[1]) >= abs(axes[2] @ reference[1]) else [0, 2, 1]


def _edge_normals(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (n, 3) of the planes through the camera and an image edge, and their weights (n)."""
    height, width = image.shape[:2]
    margin = 8
    gray = cv2.GaussianBlur(pad_sphere(image.mean(axis=2), margin), (0, 0), 1.0)
    along_v, along_u = np.gradient(gray)
    along_u, along_v = (g[margin:-margin, margin:-margin] for g in (along_u, along_v))
    latitude = ((np.arange(height) + 0.5) / height - 0.5)[:, None] * math.pi
    longitude = ((np.arange(width) + 0.5) / width - 0.5)[None, :] * 2 * math.pi
    ones = np.ones((height, width))
    east = np.stack((np.cos(longitude) * ones, 0 * ones, -np.sin(longitude) * ones), axis=-1)
    south = np.stack(
        (-np.sin(latitude) * np.sin(longitude), np.cos(latitude) * ones, -np.sin(latitude) * np.cos(longitude)), axis=-1
    )
    stretch = np.maximum(np.cos(latitude), 0.05)  # width of a pixel relative to the horizon
    normal = (along_u / stretch)[..., None] * east + along_v[..., None] * south
    length = np.linalg.norm(normal, axis=-1)
    strong = length > _MIN_GRADIENT
    weight = np.minimum(length, _MAX_GRADIENT) * np.cos(latitude)
    return normal[strong] / length[strong][:, None], weight[strong]


def _fit_down(normal: np.ndarray, weight: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The common direction of the vertical edges' planes, near `start`."""
    norm = np.linalg.norm(start)
    down = start / norm if norm > 1e-6 else np.array((0.0, 1.0, 0.0))
    for tolerance_degrees in (10, 6, 4, 3, 2, 2, 2):
        vertical = np.abs(normal @ down) < math.sin(math.radians(tolerance_degrees))
        if vertical.sum() < 100:
            return down
        chosen = normal[vertical]
        eigenvector = np.linalg.eigh((chosen * weight[vertical, None]).T @ chosen)[1][:, 0]
        eigenvector = eigenvector * np.sign(eigenvector @ down)
        if eigenvector @ down < math.cos(math.radians(15)):  # the edges do not constrain the vertical
            return down
        down = eigenvector
    return down


def _fit_yaw(normal: np.ndarray, weight: np.ndarray, down: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Angle in [0, pi/2) from `a` of the most frequent direction of horizontal lines."""
    vertical = np.abs(normal @ down)
    horizontal = (vertical > math.sin(math.radians(8))) & (vertical < math.sin(math.radians(80)))
    angle = np.arctan2(-(normal[horizontal] @ a), normal[horizontal] @ b)
    bins = 180
    votes, _ = np.histogram(angle % (math.pi / 2), bins=bins, range=(0, math.pi / 2), weights=weight[horizontal])
    kernel = np.exp(-0.5 * (np.arange(-4, 5) / 1.5) ** 2)
    smooth = np.convolve(np.concatenate((votes[-4:], votes, votes[:4])), kernel, "valid")
    return (float(smooth.argmax()) + 0.5) / bins * math.pi / 2


def axis_components(axes: np.ndarray, rotation: np.ndarray, height: int) -> np.ndarray:
    """Components (3, height, width) of every pixel's ray along the scene's axes, for a camera's world rotation."""
    return np.moveaxis(ray_grid(height) @ (rotation.T @ axes.T), -1, 0)


@dataclass(frozen=True, eq=False)
class ScenePlanes:
    """Evidence for planes across the scene's axes, by their offset from `origin` along the axis.

    Attributes:
        axes: (3, 3) see `estimate_axes`.
        origin: (3,) in the world.
        histogram: (3, bins) fraction of the sphere whose surface lies on a plane.
        bin: width of a bin, metres.
        votes: (3, bins) support in [0, 1] by Hough voting.
        floor_ceiling: offsets down and up (negative) of the detected floor and ceiling, metres; infinite without one.
    """

    axes: np.ndarray
    origin: np.ndarray
    histogram: np.ndarray
    bin: float
    votes: np.ndarray
    floor_ceiling: tuple[float, float] = _UNBOUNDED

    @property
    def offsets(self) -> np.ndarray:
        """Offsets (bins) of the bins' centres, metres."""
        bins = self.histogram.shape[1]
        return (np.arange(bins) - bins // 2 + 0.5) * self.bin

    def _bin(self, offset: np.ndarray) -> np.ndarray:
        middle = self.histogram.shape[1] // 2
        return np.clip(np.floor(offset / self.bin).astype(np.int64) + middle, 0, self.histogram.shape[1] - 1)

    def support(self, axis: int, cam2world: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Support in [0, 1], (2, n), of planes at distances 1 / `inverse` on the negative and positive side."""
        centre = self.axes[axis] @ (cam2world[:3, 3] - self.origin)
        index = np.stack([self._bin(centre + sign / inverse) for sign in (-1, 1)])
        found = np.log1p(self.histogram[axis, index] / _MIN_SOLID_ANGLE) / np.log1p(_MAX_SOLID_ANGLE / _MIN_SOLID_ANGLE)
        return np.clip(np.maximum(found, self.votes[axis, index]), 0, 1)

    def separating(self, axis: int, cam2world: np.ndarray, other: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Planes at distances 1 / `inverse` on the negative and positive side, (2, n), that separate two cameras.

        The cameras see different sides of such a plane.
        """
        here, there = (self.axes[axis] @ pose[:3, 3] for pose in (cam2world, other))
        return np.stack([sign * (here - there) + 1 / inverse <= 0 for sign in (-1, 1)])

    def vertical_bounds(self, cam2world: np.ndarray) -> tuple[float, float]:
        """Extent of the scene below and above (negative) a camera, metres; infinite where unknown."""
        horizontal = self.histogram[_DOWN_AXIS]
        middle, gap = len(horizontal) // 2, round(MIN_FLOOR / _BIN_WIDTH)
        camera = self.axes[_DOWN_AXIS] @ (cam2world[:3, 3] - self.origin)
        bounds = []
        for voted, start, part, sign in (
            (self.floor_ceiling[0], middle + gap, horizontal[middle + gap :], 1),
            (self.floor_ceiling[1], 0, horizontal[: middle - gap], -1),
        ):
            peak = start + int(part.argmax())
            offset = voted
            if math.isinf(voted) and horizontal[max(peak - 2, 0) : peak + 3].sum() > _FLOOR_SOLID_ANGLE:
                offset = self.offsets[peak]
            bounds.append(1.06 * (offset - camera) + sign * self.bin)
        return bounds[0], bounds[1]


def make_empty_planes(cam2world: np.ndarray, axes: np.ndarray, near: float, far: float) -> ScenePlanes:
    """Planes without evidence, around the mean of the cameras; `near` sets the bins' width and `far` their range."""
    width = near * _BIN_WIDTH
    empty = np.zeros((3, 2 * int(_REACH * far / width)))
    return ScenePlanes(axes, cam2world[:, :3, 3].mean(axis=0), empty, width, empty)


def collect_planes(
    surfaces: Sequence[Surface], consistent: Sequence[np.ndarray], cam2world: np.ndarray, planes: ScenePlanes
) -> ScenePlanes:
    """The planes with a new histogram, of the pixels (h, w) whose surfaces are consistent between views."""
    histogram = np.zeros_like(planes.histogram)
    bins = histogram.shape[1]
    for surface, mask, pose in zip(surfaces, consistent, cam2world, strict=True):
        height, width = surface.inverse_depth.shape
        area = np.repeat(row_weights(height).numpy()[:, None], width, axis=1)
        area /= area.sum() * len(surfaces)
        points = world_points(surface, pose) - planes.origin
        for axis in range(3):
            chosen = mask & (surface.orientation == axis + 1)
            index = planes._bin(points[chosen] @ planes.axes[axis])
            histogram[axis] += np.bincount(index, weights=area[chosen], minlength=bins)
    return dataclasses.replace(planes, histogram=cv2.GaussianBlur(histogram, (9, 1), 1.0))


def detect_planes(
    views: Sequence[View],
    rays: Sequence[np.ndarray],
    cam2world: np.ndarray,
    planes: ScenePlanes,
    depths: DepthRange,
    min_floor: float,
    config: MatchingConfig,
) -> ScenePlanes:
    """The planes with the votes, the floor and the ceiling that Hough voting finds.

    Args:
        rays: (3, h, w) for each view, components of its rays along the scene's axes.
        depths: range of the search.
        min_floor: smallest distance of floor and ceiling from the cameras' mean, metres.
    """
    votes = np.zeros_like(planes.histogram)
    for view in range(len(views)):
        for other in range(len(views)):
            if other != view:
                poses = (cam2world[view], cam2world[other])
                votes += _count_votes(views[view], views[other], rays[view], poses, planes, depths, config)
    support = np.log1p(votes / (_MIN_VOTES * votes.max() + 1e-9)) / math.log1p(1 / _MIN_VOTES)
    offsets = planes.offsets
    floor_ceiling = []
    for sign in (1, -1):
        side = np.where(sign * offsets > min_floor, votes[0], 0)
        usual = (sign * offsets > min_floor) & (sign * offsets < _REACH / depths.low)
        distinct = side.max() > _DISTINCT * np.median(side[usual])
        floor_ceiling.append(float(offsets[side.argmax()]) if distinct else sign * math.inf)
    return dataclasses.replace(planes, votes=support, floor_ceiling=(floor_ceiling[0], floor_ceiling[1]))


def _count_votes(
    view: View,
    other: View,
    rays: np.ndarray,
    poses: tuple[np.ndarray, np.ndarray],
    planes: ScenePlanes,
    depths: DepthRange,
    config: MatchingConfig,
) -> np.ndarray:
    """Votes (3, bins) of one view's pixels, matched against one other view."""
    here, there = poses
    inverse = depths.sample(_CANDIDATES)
    step, count = depths.step(_CANDIDATES), len(inverse)
    no_penalty = np.zeros((2, count), np.float32)
    sets = [
        HypothesisSet(
            (inverse[0] * slope).astype(np.float32), (step * slope).astype(np.float32), no_penalty, side,
            planes.separating(axis, here, there, inverse),
        )
        for axis, (slope, side) in enumerate(zip(np.abs(rays), (rays > 0).astype(np.uint8), strict=True))
    ]  # fmt: skip
    matched = OtherView(other, np.linalg.inv(there) @ here, sets)
    cost = compute_matching_cost(view, [matched], depths.limits, _UNBOUNDED, config)
    vote = np.exp(-cost / _SOFTNESS)
    vote *= (_vote_weights(view) / vote.sum(axis=-1))[..., None] * np.maximum(_MAX_COST - cost, 0)
    votes = np.zeros_like(planes.histogram)
    for axis in range(3):
        centre = planes.axes[axis] @ (here[:3, 3] - planes.origin)
        for sign in (-1, 1):
            facing = sign * rays[axis] > _MIN_SLANT
            found = vote[facing][:, axis * count : (axis + 1) * count].sum(axis=0)
            offset = centre + sign / inverse
            order = np.argsort(offset)
            votes[axis] += np.interp(planes.offsets, offset[order], found[order], left=0, right=0)
    return votes


def texture_weights(view: View) -> np.ndarray:
    """Weights (h, w) of the pixels by texture and solid angle; zero where masked."""
    gray = view.image.mean(axis=2)
    variance = cv2.boxFilter(gray * gray, -1, (5, 5)) - cv2.boxFilter(gray, -1, (5, 5)) ** 2
    area = row_weights(len(view.image)).numpy()[:, None]
    return np.clip(variance, 0, _MAX_VARIANCE) * view.valid * area


def _vote_weights(view: View) -> np.ndarray:
    """The texture weights (h, w), divided by their sum; zero without texture."""
    weight = texture_weights(view)
    return (weight / max(float(weight.sum()), 1e-9)).astype(np.float32)
