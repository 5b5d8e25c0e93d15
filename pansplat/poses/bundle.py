"""Bundle adjustment on the sphere: cameras and points with the smallest robust angles between points and bearings.

Points are homogeneous unit 4-vectors, so that points far away are regular. The normal equations are reduced to the
cameras by the Schur complement, and solved by Levenberg and Marquardt's method.

Source: B. Triggs et al., Bundle adjustment - a modern synthesis, 1999.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from pansplat.poses.solvers import rotation_exp, skew

_STEPS = 30
_DISTANCE_NOISE = 0.015  # relative standard deviation of a known distance
_DOWN_NOISE = 0.01  # standard deviation of the cameras' down directions, radians
_CAUCHY = 2.0  # residual at which the loss has half of its weight, in the noise's unit
_BEHIND = 1e6  # squared residual of a point behind its camera
_LARGEST_DAMPING = 1e8
_CONVERGED = 1e-6  # the adjustment ends when the cost falls by a smaller share


@dataclass(frozen=True, eq=False)
class Bundle:
    """Cameras, points and observations.

    Attributes:
        rotations, centres: poses of the cameras, camera to world.
        points: homogeneous unit vectors in the world.
        camera, point: indices for each observation.
        bearings: observed unit directions in the camera's frame.
        downs: for each camera the down direction in its frame; NaN where it is unknown.
        down: the down direction of the world.
        pairs, distances: cameras whose distance is known independently of the points.
    """

    rotations: Float[Array, "camera 3 3"]
    centres: Float[Array, "camera 3"]
    points: Float[Array, "point 4"]
    camera: Int[Array, "observation"]
    point: Int[Array, "observation"]
    bearings: Float[Array, "observation 3"]
    downs: Float[Array, "camera 3"]
    down: Float[Array, "3"]
    pairs: Int[Array, "pair 2"] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    distances: Float[Array, "pair"] = field(default_factory=lambda: np.empty(0))

    def select(self, kept: Bool[Array, "observation"]) -> Bundle:
        """The bundle with some observations only, and without points that fewer than two observe."""
        counts = np.bincount(self.point[kept], minlength=len(self.points))
        kept = kept & (counts[self.point] >= 2)
        used, point = np.unique(self.point[kept], return_inverse=True)
        return replace(
            self,
            points=self.points[used],
            camera=self.camera[kept],
            point=point.reshape(-1),
            bearings=self.bearings[kept],
        )


def triangulate(
    rotations: Float[Array, "camera 3 3"],
    centres: Float[Array, "camera 3"],
    camera: Int[Array, "observation"],
    point: Int[Array, "observation"],
    bearings: Float[Array, "observation 3"],
    count: int,
) -> Float[Array, "count 4"]:
    """Homogeneous points that minimise the sines between points and bearings."""
    rays = np.einsum("nij,nj->ni", rotations[camera], bearings)
    cross = skew(rays)
    rows = np.concatenate((cross, -np.einsum("nij,nj->ni", cross, centres[camera])[..., None]), axis=2)
    matrix = np.zeros((count, 4, 4))
    np.add.at(matrix, point, np.einsum("nki,nkj->nij", rows, rows))
    points = np.linalg.eigh(matrix)[1][:, :, 0]
    # The sign for which most rays point to the point.
    toward = np.einsum("ni,ni->n", rays, points[point, :3] - points[point, 3:] * centres[camera])
    votes = np.bincount(point, np.sign(toward), count)
    return points * np.where(votes < 0, -1.0, 1.0)[:, None]


def residual_angles(bundle: Bundle) -> Float[Array, "observation"]:
    """Angles between points and bearings, radians; pi if a point is behind."""
    q = _camera_points(bundle)
    return np.arctan2(np.linalg.norm(np.cross(q, bundle.bearings), axis=1), (q * bundle.bearings).sum(axis=1))


def point_depths(bundle: Bundle) -> Float[Array, "observation"]:
    """Distance of the point of each observation from its camera; infinite for points at infinity."""
    w = bundle.points[bundle.point, 3]
    with np.errstate(divide="ignore"):
        return np.linalg.norm(_camera_points(bundle), axis=1) / np.abs(w)


def _camera_points(bundle: Bundle) -> Float[Array, "observation 3"]:
    x = bundle.points[bundle.point]
    offset = x[:, :3] - x[:, 3:] * bundle.centres[bundle.camera]
    return np.einsum("nji,nj->ni", bundle.rotations[bundle.camera], offset)


class _State(NamedTuple):
    """The cost by Cauchy's loss. A residual is a point's direction across its bearing, in the noise's unit."""

    cost: float
    residual: Float[Array, "observation 2"]
    weight: Float[Array, "observation"]
    tangents: Float[Array, "observation 2 3"]
    local: Float[Array, "observation 3"]  # the points in the frame of the camera, scaled


def _evaluate(bundle: Bundle, noise: float) -> _State:
    q = _camera_points(bundle)
    length = np.linalg.norm(q, axis=1)
    unit = q / np.maximum(length, 1e-12)[:, None]
    helper = np.eye(3)[np.abs(bundle.bearings).argmin(axis=1)]
    first = np.cross(bundle.bearings, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack((first, np.cross(bundle.bearings, first)), axis=1)
    residual = np.einsum("nki,ni->nk", tangents, unit) / noise
    behind = (unit * bundle.bearings).sum(axis=1) < 0
    squared = np.where(behind, _BEHIND, (residual**2).sum(axis=1)) / _CAUCHY**2
    cost = float(_CAUCHY**2 * np.log1p(squared).sum())
    weight = np.where(behind, 0.0, 1 / (1 + squared))
    tilt = _tilts(bundle) / _DOWN_NOISE
    cost += float((tilt**2).sum()) + float((_stretches(bundle) ** 2).sum())
    return _State(cost, residual, weight, tangents, q)


def _stretches(bundle: Bundle) -> Float[Array, "pair"]:
    """The distances of the cameras over the known ones, minus 1, in the noise's unit."""
    first, second = bundle.centres[bundle.pairs].transpose(1, 0, 2)
    return (np.linalg.norm(first - second, axis=1) / bundle.distances - 1) / _DISTANCE_NOISE


def _tilts(bundle: Bundle) -> Float[Array, "camera 3"]:
    """The cross product of each camera's down direction with the world's; zero where it is unknown."""
    return np.cross(_world_downs(bundle), bundle.down)


def _world_downs(bundle: Bundle) -> Float[Array, "camera 3"]:
    """Each camera's down direction in the world; zero where it is unknown."""
    known = np.isfinite(bundle.downs).all(axis=1)
    return np.einsum("nij,nj->ni", bundle.rotations, np.where(known[:, None], bundle.downs, 0.0))


def adjust(bundle: Bundle, noise: float, steps: int = _STEPS) -> Bundle:
    """Minimise the robust cost over all cameras and points. The gauge is left to the damping.

    Args:
        noise: standard deviation of a bearing, radians.
        steps: largest number of steps.
    """
    damping = 1e-3
    state = _evaluate(bundle, noise)
    for _ in range(steps):
        equations = _normal_equations(bundle, state, noise)
        while damping < _LARGEST_DAMPING:
            moved = _step(bundle, equations, damping)
            if moved is not None and (trial := _evaluate(moved, noise)).cost < state.cost:
                break
            damping *= 6
        else:
            return bundle
        cost, bundle, state = state.cost, moved, trial
        damping = max(damping / 4, 1e-9)
        if cost - state.cost < _CONVERGED * cost:
            break
    return bundle


def _normal_equations(bundle: Bundle, state: _State, noise: float) -> tuple[Array, ...]:
    """Blocks of the normal equations.

    Cameras (c 6 6), points (p 3 3), both (n 6 3), gradients, point bases (p 4 3), known distances (c 3 c 3).
    """
    _, residual, weight, tangents, q = state
    rotation = bundle.rotations[bundle.camera]
    x = bundle.points[bundle.point]
    length = np.linalg.norm(q, axis=1)[:, None, None]
    unit = q[:, :, None] / length
    projected = (tangents - (tangents @ unit) @ unit.transpose(0, 2, 1)) / length / noise  # d residual / d q
    # A left rotation w of the camera: q = R' (offset) -> q + R' (offset x w).
    world = projected @ rotation.transpose(0, 2, 1)
    offset = x[:, :3] - x[:, 3:] * bundle.centres[bundle.camera]
    by_camera = np.concatenate((world @ skew(offset), -world * x[:, 3][:, None, None]), axis=2)
    by_point = np.concatenate((world, -(world @ bundle.centres[bundle.camera][:, :, None])), axis=2)
    bases = np.linalg.svd(bundle.points[:, None, :])[2][:, 1:].transpose(0, 2, 1)  # tangent of the unit 4-sphere
    by_point = by_point @ bases[bundle.point]
    weighted_camera, weighted_point = by_camera * weight[:, None, None], by_point * weight[:, None, None]
    cameras = np.zeros((len(bundle.centres), 6, 6))
    points = np.zeros((len(bundle.points), 3, 3))
    camera_gradient, point_gradient = np.zeros(cameras.shape[:2]), np.zeros(points.shape[:2])
    np.add.at(cameras, bundle.camera, weighted_camera.transpose(0, 2, 1) @ by_camera)
    np.add.at(points, bundle.point, weighted_point.transpose(0, 2, 1) @ by_point)
    np.add.at(camera_gradient, bundle.camera, (weighted_camera * residual[:, :, None]).sum(axis=1))
    np.add.at(point_gradient, bundle.point, (weighted_point * residual[:, :, None]).sum(axis=1))
    both = weighted_camera.transpose(0, 2, 1) @ by_point
    downs = _world_downs(bundle)
    # (w x a) x d = a (w . d) - w (a . d)
    jacobian = downs[:, :, None] * bundle.down - (downs @ bundle.down)[:, None, None] * np.eye(3)
    jacobian /= _DOWN_NOISE
    cameras[:, :3, :3] += jacobian.transpose(0, 2, 1) @ jacobian
    camera_gradient[:, :3] += np.einsum("nki,nk->ni", jacobian, _tilts(bundle) / _DOWN_NOISE)
    stretched = np.zeros((len(cameras), 3, len(cameras), 3))  # of the centres, by known distances
    for (i, j), distance, value in zip(bundle.pairs, bundle.distances, _stretches(bundle), strict=True):
        baseline = bundle.centres[i] - bundle.centres[j]
        slope = baseline / max(float(np.linalg.norm(baseline)), 1e-12) / distance / _DISTANCE_NOISE
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            stretched[a, :, b] += sign * np.outer(slope, slope)
        camera_gradient[i, 3:] += slope * value
        camera_gradient[j, 3:] -= slope * value
    return cameras, points, both, camera_gradient, point_gradient, bases, stretched


def _step(bundle: Bundle, equations: tuple[Array, ...], damping: float) -> Bundle | None:
    cameras, points, both, camera_gradient, point_gradient, bases, stretched = equations
    count = len(cameras)
    cameras = cameras + damping * _diagonal(cameras)
    inverse = np.linalg.inv(points + damping * _diagonal(points))
    reduced = np.zeros((count, 6, count, 6))
    reduced[:, 3:, :, 3:] += stretched
    for camera in range(count):
        reduced[camera, :, camera] += cameras[camera]
    weighted = both @ inverse[bundle.point]
    gradient = camera_gradient.copy()
    np.subtract.at(gradient, bundle.camera, np.einsum("nij,nj->ni", weighted, point_gradient[bundle.point]))
    # Observations of one point by two cameras couple them.
    order = np.argsort(bundle.point, kind="stable")
    sorted_points = bundle.point[order]
    ends = np.searchsorted(sorted_points, sorted_points, side="right")
    starts = np.searchsorted(sorted_points, sorted_points, side="left")
    for shift in range(int((ends - starts).max())):
        other = starts + shift
        valid = other < ends
        i, j = order[valid], order[other[valid]]
        np.subtract.at(
            reduced.transpose(0, 2, 1, 3),
            (bundle.camera[i], bundle.camera[j]),
            weighted[i] @ both[j].transpose(0, 2, 1),
        )
    try:
        camera_step = -np.linalg.solve(reduced.reshape(6 * count, 6 * count), gradient.reshape(-1)).reshape(count, 6)
    except np.linalg.LinAlgError:
        return None
    right = point_gradient.copy()
    np.add.at(right, bundle.point, np.einsum("nij,ni->nj", both, camera_step[bundle.camera]))
    point_step = -np.einsum("nij,nj->ni", inverse, right)
    if not (np.isfinite(camera_step).all() and np.isfinite(point_step).all()):
        return None
    moved = bundle.points + np.einsum("nij,nj->ni", bases, point_step)
    return replace(
        bundle,
        rotations=rotation_exp(camera_step[:, :3]) @ bundle.rotations,
        centres=bundle.centres + camera_step[:, 3:],
        points=moved / np.linalg.norm(moved, axis=1, keepdims=True),
    )


def _diagonal(blocks: Float[Array, "n k k"]) -> Float[Array, "n k k"]:
    """The diagonals of the blocks, with a small minimum."""
    size = blocks.shape[-1]
    diagonal = np.einsum("nii->ni", blocks) + 1e-9
    return diagonal[:, :, None] * np.eye(size)
