"""Rotations and rigid poses."""

import math

import pytest
import torch
from synthetic_scenes import draw_noise, turn_camera

from pansplat.geometry.pose import (
    interpolate_poses,
    invert_pose,
    multiply_quats,
    nearest_views,
    orthonormal_error,
    quats_from_rotations,
    rotations_from_quats,
)


def test_rotations_are_orthonormal_and_do_not_depend_on_the_quaternions_length_and_sign():
    q = draw_noise(50, 4)
    rotations = rotations_from_quats(q)
    identity = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    assert torch.allclose(rotations @ rotations.transpose(1, 2), identity, atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotations), torch.ones(50, dtype=torch.float64))
    assert torch.allclose(rotations_from_quats(-2 * q), rotations, atol=1e-12)


def test_rotations_are_converted_back_to_their_quaternions():
    q = torch.nn.functional.normalize(draw_noise(200, 4), dim=1)
    half_turns = torch.eye(4, dtype=torch.float64)[1:]
    for quats in (q, half_turns):
        again = quats_from_rotations(rotations_from_quats(quats))
        assert torch.allclose((again * quats).sum(1).abs(), torch.ones(len(quats), dtype=torch.float64), atol=1e-12)
        assert (again[:, 0] >= 0).all()


def test_the_product_of_quaternions_is_the_product_of_rotations():
    a, b = draw_noise(20, 4), draw_noise(20, 4, seed=1)
    product = rotations_from_quats(multiply_quats(a, b))
    assert torch.allclose(product, rotations_from_quats(a) @ rotations_from_quats(b), atol=1e-12)


def test_a_pose_times_its_inverse_is_the_identity():
    pose = turn_camera(draw_noise(4), (1.0, -2.0, 3.0))
    assert torch.allclose(pose @ invert_pose(pose), torch.eye(4, dtype=torch.float64), atol=1e-12)


def test_the_orthonormal_error_of_rigid_scaled_mirrored_and_invalid_poses():
    pose = turn_camera(draw_noise(4), (1.0, 2.0, 3.0))
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
    a = turn_camera((1.0, 0, 0, 0), (0.0, 0, 0))
    angle = math.radians(100)
    b = turn_camera((-math.cos(angle / 2), 0, -math.sin(angle / 2), 0), (2.0, 0, 0))
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
