"""Bundle adjustment recovers cameras and points from disturbed ones."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pansplat.poses.bundle import Bundle, adjust, point_depths, residual_angles, triangulate
from pansplat.poses.solvers import angle_between, rotation_angle, rotation_exp


def _bundle(noise: float, cameras: int = 4, count: int = 80) -> Bundle:
    rng = np.random.default_rng(0)
    points = rng.uniform(-4, 4, (count, 3))
    rotations = rotation_exp(rng.normal(size=(cameras, 3)) * 0.5)
    centres = rng.uniform(-1, 1, (cameras, 3))
    camera, point = (x.reshape(-1) for x in np.meshgrid(np.arange(cameras), np.arange(count), indexing="ij"))
    rays = np.einsum("nji,nj->ni", rotations[camera], points[point] - centres[camera])
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) + noise * rng.normal(size=rays.shape)
    bearings = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    homogeneous = np.concatenate((points, np.ones((count, 1))), axis=1)
    homogeneous /= np.linalg.norm(homogeneous, axis=1, keepdims=True)
    axes = np.einsum("nji,j->ni", rotations, np.array((0.0, 1, 0)))
    return Bundle(rotations, centres, homogeneous, camera, point, bearings, axes, np.array((0.0, 1, 0)))


def _disturb(bundle: Bundle) -> Bundle:
    rng = np.random.default_rng(1)
    rotations = rotation_exp(0.02 * rng.normal(size=(len(bundle.centres), 3))) @ bundle.rotations
    centres = bundle.centres + 0.05 * rng.normal(size=bundle.centres.shape)
    points = triangulate(rotations, centres, bundle.camera, bundle.point, bundle.bearings, len(bundle.points))
    return replace(bundle, rotations=rotations, centres=centres, points=points)


def _relative_errors(found: Bundle, truth: Bundle) -> tuple[float, float]:
    turn = found.rotations[1].T @ found.rotations[0] @ (truth.rotations[1].T @ truth.rotations[0]).T
    directions = [p.rotations[0].T @ (p.centres[1] - p.centres[0]) for p in (found, truth)]
    return float(rotation_angle(turn)), float(angle_between(*directions))


def test_triangulated_points_of_exact_bearings_are_exact() -> None:
    truth = _bundle(0.0)
    points = triangulate(truth.rotations, truth.centres, truth.camera, truth.point, truth.bearings, len(truth.points))
    assert np.allclose(points[:, :3] / points[:, 3:], truth.points[:, :3] / truth.points[:, 3:], atol=1e-8)
    assert residual_angles(truth).max() < 1e-9 and (point_depths(truth) > 0).all()


def test_adjustment_recovers_disturbed_cameras() -> None:
    truth = _bundle(0.0)
    found = adjust(_disturb(truth), noise=1e-3)
    assert max(_relative_errors(found, truth)) < 1e-5
    assert residual_angles(found).max() < 1e-5


def test_adjustment_tolerates_wrong_observations() -> None:
    truth = _bundle(3e-4)
    bearings = truth.bearings.copy()
    bearings[::9] = np.roll(bearings[::9], 1, axis=1)
    found = adjust(_disturb(replace(truth, bearings=bearings)), noise=1e-3)
    assert max(_relative_errors(found, truth)) < math.radians(0.3)


def test_a_known_distance_sets_the_scale() -> None:
    truth = _bundle(0.0)
    distance = np.linalg.norm(truth.centres[0] - truth.centres[1])
    wanted = 1.2 * distance
    known = replace(_disturb(truth), pairs=np.array(((0, 1),)), distances=np.array((wanted,)))
    found = adjust(known, noise=1e-3)
    assert np.linalg.norm(found.centres[0] - found.centres[1]) == pytest.approx(wanted, rel=1e-4)
    assert np.linalg.norm(found.centres[2] - found.centres[3]) == pytest.approx(
        1.2 * np.linalg.norm(truth.centres[2] - truth.centres[3]), rel=1e-3
    )
