"""Gravity and the axes of the walls in one panorama, from its straight line segments.

A segment and the camera span a plane. The normals of vertical segments are perpendicular to gravity, and those of a
room's horizontal edges to one of two further axes (a Manhattan world). The axes of two panoramas of one building give
their relative rotation up to a quarter turn, independently of matches.

Source: J. Coughlan, A. Yuille, Manhattan World, ICCV 1999; segments: R. Grompone von Gioi et al., LSD, PAMI 2010.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from pansplat.poses.features import FACE_ROTATIONS, render_face
from pansplat.poses.solvers import rotation_angle, rotation_exp, skew

_MIN_LENGTH = math.radians(2.5)  # shorter segments are not used
_NORMAL_NOISE = 4e-3  # standard deviation of a normal, radians
_ROUNDS = 25  # steps of the fit, in which its tolerance shrinks
_FIRST_TOLERANCE = math.radians(3)
_SEARCH_TOLERANCE = math.radians(1.5)
_LARGEST_TILT = math.radians(20)  # a camera is less tilted
_MIN_SUPPORT, _MIN_CONTRAST = 12, 2.5  # segments that an axis needs; also their ratio to the number by chance
_LONG = math.radians(10)  # longer segments measure the noise of the axes, because pixels hardly matter
_LEAST_NOISE, _LARGEST_NOISE = math.radians(0.03), math.radians(0.26)  # limits of the noise of long normals
_TILT_NOISE, _YAW_NOISE = 0.8, 1.35  # noise of a relative rotation, about horizontal axes and gravity, over theirs
_LARGEST_RESIDUAL = 7.0  # a rotation that differs more from the axes does not follow them; in the noise's unit
_LARGEST_DIFFERENCE = math.radians(1.8)  # walls that differ by less are parallel
_AGREEMENT = 0.9, 0.06  # prior probability that axes are of one building, or only upright in different ones


@dataclass(frozen=True, eq=False)
class SceneAxes:
    """Axes in the camera's frame, as rows: down, and two walls' normals.

    Attributes:
        axes: orthonormal, right-handed.
        has_down: whether enough vertical edges determine the first axis.
        has_walls: whether enough horizontal edges determine the other two.
        noise: standard deviation of the normals of long edges, radians: stitching, and edges that are not parallel.
    """

    axes: Float[Array, "3 3"]
    has_down: bool
    has_walls: bool
    noise: float = _LARGEST_NOISE

    @property
    def frame(self) -> Float[Array, "3 3"]:
        """The axes x, y (down) and z of the scene in the camera's frame, as columns."""
        down, wall = self.axes[:2]
        return np.stack((np.cross(down, wall), down, wall), axis=1)


def find_axes(image: UInt8[Array, "height width"]) -> SceneAxes:
    """The axes of a grey panorama of a camera that is upright within 20 degrees."""
    normals, lengths = _segment_normals(image)
    if len(normals) < _MIN_SUPPORT:
        return SceneAxes(np.array(((0.0, 1, 0), (0, 0, 1), (1, 0, 0))), False, False)
    axes = _search_axes(normals, lengths)
    tolerance = _FIRST_TOLERANCE
    rows = np.arange(len(normals))
    for _ in range(_ROUNDS):
        cosine = normals @ axes.T
        nearest = np.abs(cosine).argmin(axis=1)
        residual = cosine[rows, nearest]
        weight = lengths**2 * np.exp(-0.5 * (residual / tolerance) ** 2)
        jacobian = np.cross(axes[nearest], normals)
        hessian = (jacobian * weight[:, None]).T @ jacobian
        step = np.linalg.solve(
            hessian + (1e-9 * np.trace(hessian) + 1e-12) * np.eye(3), -jacobian.T @ (weight * residual)
        )
        axes = axes @ rotation_exp(step).T
        tolerance = max(0.75 * tolerance, _NORMAL_NOISE)
    inlier = np.abs(residual) < 2.5 * _NORMAL_NOISE
    support = np.bincount(nearest[inlier], minlength=3)
    by_chance = 2.5 * _NORMAL_NOISE * len(normals)
    is_clear = support > max(_MIN_SUPPORT, _MIN_CONTRAST * by_chance)
    weak = support[1:].sum() > max(1.5 * _MIN_SUPPORT, 2 * _MIN_CONTRAST * by_chance)
    scatter, noise = np.abs(residual[(lengths > _LONG) & (np.abs(residual) < 3 * _NORMAL_NOISE)]), _LARGEST_NOISE
    if len(scatter) >= _MIN_SUPPORT:
        # Edges that are parallel to no wall are among them: a large scatter states little about stitching.
        noise = float(np.clip(1.48 * np.median(scatter), _LEAST_NOISE, _LARGEST_NOISE))
    return SceneAxes(axes, bool(is_clear[0]), bool(is_clear[0] and weak), noise)


def _segment_normals(image: UInt8[Array, "height width"]) -> tuple[Float[Array, "n 3"], Float[Array, "n"]]:
    """Normals of the planes through the camera and the line segments, and the segments' lengths, radians."""
    focal = image.shape[1] / (2 * math.pi)
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
    normals, lengths = [np.empty((0, 3))], [np.empty(0)]
    for rotation in FACE_ROTATIONS:
        face = render_face(image, rotation, focal)
        found = detector.detect(face)[0]
        if found is None:
            continue
        ends = (found.reshape(-1, 2, 2).astype(np.float64) + 0.5 - len(face) / 2) / focal
        rays = np.concatenate((ends, np.ones((*ends.shape[:2], 1))), axis=2) @ rotation.T
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        normal = np.cross(rays[:, 0], rays[:, 1])
        sine = np.linalg.norm(normal, axis=1)
        long = sine > math.sin(_MIN_LENGTH)
        normals.append(normal[long] / sine[long][:, None])
        lengths.append(np.arcsin(np.clip(sine[long], 0, 1)))
    return np.concatenate(normals), np.minimum(np.concatenate(lengths), math.radians(20))


def _search_axes(normals: Float[Array, "n 3"], lengths: Float[Array, "n"]) -> Float[Array, "3 3"]:
    """Start of the fit: the direction near the camera's y axis with most edges, then the best yaw."""
    first, second = np.triu_indices(min(len(normals), 120), 1)
    order = np.argsort(-lengths, kind="stable")
    crossing = np.cross(normals[order[first]], normals[order[second]])
    norm = np.linalg.norm(crossing, axis=1)
    crossing = crossing[norm > 0.2] / norm[norm > 0.2][:, None]
    crossing *= np.where(crossing[:, 1:2] < 0, -1, 1)
    candidates = np.concatenate((crossing[crossing[:, 1] > math.cos(_LARGEST_TILT)], [[0.0, 1.0, 0.0]]))[:4000]
    votes = np.exp(-0.5 * ((candidates @ normals.T) / _SEARCH_TOLERANCE) ** 2) @ lengths
    down = candidates[votes.argmax()]
    a = np.cross(down, (0.0, 0.0, 1.0))
    a /= np.linalg.norm(a)
    b = np.cross(down, a)
    flat = np.abs(normals @ down) > 0.15  # not of vertical edges
    angles = np.radians(np.arange(0, 90, 0.5))
    walls = np.cos(angles)[:, None] * a + np.sin(angles)[:, None] * b
    both = [np.exp(-0.5 * ((w @ normals[flat].T) / _SEARCH_TOLERANCE) ** 2) for w in (walls, np.cross(down, walls))]
    wall = walls[((both[0] + both[1]) @ lengths[flat]).argmax()]
    return np.stack((down, wall, np.cross(down, wall)))


@dataclass(frozen=True, eq=False)
class RotationPrior:
    """What the axes of two panoramas state about their relative rotation, before any match.

    Both cameras see the same gravity, and usually parallel walls; with a small probability neither holds.
    """

    first: SceneAxes
    second: SceneAxes

    @property
    def has_down(self) -> bool:
        """Whether both panoramas determine gravity."""
        return self.first.has_down and self.second.has_down

    @property
    def has_walls(self) -> bool:
        """Whether both panoramas determine the walls."""
        return self.first.has_walls and self.second.has_walls

    @property
    def noise(self) -> tuple[float, float]:
        """Standard deviations of the relative rotation about horizontal axes and about gravity, radians."""
        both = math.hypot(self.first.noise, self.second.noise)
        return _TILT_NOISE * both, _YAW_NOISE * both

    @functools.cached_property
    def wall_rotations(self) -> Float[Array, "n 3 3"]:
        """The four rotations from the first camera to the second one that make the walls parallel; none without."""
        rotations = np.empty((4 if self.has_walls else 0, 3, 3))
        for n, (cosine, sine) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))[: len(rotations)]):
            quarter = np.array(((1.0, 0, 0), (0, cosine, -sine), (0, sine, cosine)))
            rotations[n] = self.second.axes.T @ quarter @ self.first.axes
        return rotations

    def _turn_from_walls(self, rotation: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """The smallest rotation from one with parallel walls to this one, for known walls."""
        # The trace of a relative rotation grows with the cosine of its angle.
        nearest = (self.wall_rotations.reshape(4, 9) @ rotation.reshape(9)).argmax()
        return self.wall_rotations[nearest].T @ rotation

    def residual(self, rotation: Float[Array, "3 3"]) -> tuple[Float[Array, "n"], Float[Array, "n 3"]] | None:
        """Tilt (3) and, with walls, yaw (1) against the axes in units of their noise, and the derivative by rotation.

        The derivative is by a left rotation of `rotation`. None if the axes do not agree or are unknown.
        """
        if not self.has_down:
            return None
        turned = rotation @ self.first.axes[0]
        across = skew(self.second.axes[0]) / self.noise[0]
        tilt = across @ turned
        if tilt @ tilt > _LARGEST_RESIDUAL**2 or self.second.axes[0] @ turned < 0:
            return None
        derivative = -across @ skew(turned)
        if self.has_walls:
            turn = self._turn_from_walls(rotation)  # less than half a turn, because gravity agrees
            axis = np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])) / 2
            sine = max(math.sqrt(axis @ axis), 1e-12)
            angle = math.atan2(sine, (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1) / 2)
            yaw = angle / sine * float(self.first.axes[0] @ axis) / self.noise[1]
            if abs(yaw) < _LARGEST_RESIDUAL:
                return np.append(tilt, yaw), np.concatenate((derivative, turned[None] / self.noise[1]))
        return tilt, derivative

    def confirms(self, rotation: Float[Array, "3 3"]) -> bool:
        """Whether both panoramas determine the walls, and the rotation makes them parallel."""
        return self.has_walls and bool(rotation_angle(self._turn_from_walls(rotation)) < _LARGEST_DIFFERENCE)

    def score(self, rotation: Float[Array, "3 3"]) -> float:
        """Logarithm of the rotation's probability density under the prior, over that of a random rotation."""
        if not self.has_down:
            return 0.0
        tilt = math.acos(float(np.clip(self.second.axes[0] @ rotation @ self.first.axes[0], -1, 1)))
        sigma = math.sqrt(2) * self.noise[0]
        upright = 2 / sigma**2 * math.exp(-0.5 * (tilt / sigma) ** 2)
        walls, share, others = 0.0, *_AGREEMENT
        if self.has_walls:
            nearest = rotation_angle(self._turn_from_walls(rotation))
            sigma = 1.5 * self.noise[1]
            walls = 2 * math.pi**2 / ((2 * math.pi) ** 1.5 * sigma**3) * math.exp(-0.5 * (nearest / sigma) ** 2)
        else:
            share, others = 0.0, sum(_AGREEMENT)
        return math.log(share * walls + others * upright + 1 - share - others)


NO_PRIOR = RotationPrior(*(SceneAxes(np.eye(3), False, False),) * 2)
