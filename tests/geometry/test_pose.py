"""Rotations and rigid poses."""

import math

import pytest
import torch

from pansplat.geometry.pose import (
    interpolate_poses,
    invert_pose,
    multiply_quats,
    nearest_views,
    orthonormal_error,
    quats_from_rotations,
    rotations_from_quats,
)


def _quats(count: int) -> torch.Tensor:
    return torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))


def _pose(quat: torch.Tensor, centre: tuple[float, float, float]) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(quat)
    pose[:3, 3] = torch.tensor(centre)
    return pose


def test_rotations_are_orthonormal_and_do_not_depend_on_the_quaternions_length_and_sign():
    q = _quats(50)
    rotations = rotations_from_quats(q)
    identity = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    assert torch.allclose(rotations @ rotations.transpose(1, 2), identity, atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotations), torch.ones(50, dtype=torch.float64))
    assert torch.allclose(rotations_from_quats(-2 * q), rotations, atol=1e-12)


def test_rotations_are_converted_back_to_their_quaternions():
    q = torch.nn.functional.normalize(_quats(200), dim=1)
    half_turns = torch.eye(4, dtype=torch.float64)[1:]
    for quats in (q, half_turns):
        again = quats_from_rotations(rotations_from_quats(quats))
        assert torch.allclose((again * quats).sum(1).abs(), torch.ones(len(quats), dtype=torch.float64), atol=1e-12)
        assert (again[:, 0] >= 0).all()


def test_the_product_of_quaternions_is_the_product_of_rotations():
    a, b = _quats(20), _quats(40)[20:]
    product = rotations_from_quats(multiply_quats(a, b))
    assert torch.allclose(product, rotations_from_quats(a) @ rotations_from_quats(b), atol=1e-12)


def test_a_pose_times_its_inverse_is_the_identity():
    pose = _pose(_quats(1)[0], (1.0, -2.0, 3.0))
    assert torch.allclose(pose @ invert_pose(pose), torch.eye(4, dtype=torch.float64), atol=1e-12)


def test_the_orthonormal_error_of_rigid_scaled_mirrored_and_invalid_poses():
    pose = _pose(_quats(1)[0], (1.0, 2.0, 3.0))
    assert orthonormal_error(pose) < 1e-12
    scaled = pose.clone()
    scaled[:3, :3] *= 1.1
    assert orthonormal_error(scaled) == pytest.approx(0.21, abs=1e-6)
    mirrored = pose @ torch.diag(torch.tensor((-1.0, 1, 1, 1), dtype=torch.float64))
    assert orthonormal_error(mirrored) == math.inf
    assert orthonormal_error(pose * float("nan")) == math.inf
    bottom = pose.clone()
    bottom[3, 0] = 0.5
    assert orthonormal_error(bottom) == pytest.approx(0.5)


def test_interpolation_starts_and_ends_at_the_poses_on_the_shortest_arc():
    a = _pose(torch.tensor((1.0, 0, 0, 0), dtype=torch.float64), (0.0, 0, 0))
    angle = math.radians(100)
    b = _pose(-torch.tensor((math.cos(angle / 2), 0, math.sin(angle / 2), 0), dtype=torch.float64), (2.0, 0, 0))
    assert torch.allclose(interpolate_poses(a, b, 0.0), a) and torch.allclose(interpolate_poses(a, b, 1.0), b)
    middle = interpolate_poses(a, b, 0.5)
    assert middle[:3, 3].tolist() == [1, 0, 0]
    assert float(torch.atan2(middle[0, 2], middle[2, 2])) == pytest.approx(angle / 2)
    assert orthonormal_error(middle) < 1e-12


def test_nearest_views_are_ordered_by_distance_without_the_view_itself() -> None:
    poses = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 5.0, 1.0, 1.5], dtype=torch.float64)
    assert nearest_views(poses, 0, 2) == [2, 3] and nearest_views(poses, 2, 9) == [3, 0, 1]
    assert nearest_views(poses[:1], 0, 3) == []
