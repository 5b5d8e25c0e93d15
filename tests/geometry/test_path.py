"""Flights pass through the cameras, smoothly, level and along the path."""

import math

import pytest
import torch

from pansplat.geometry.path import ease_in_out, fly_pose, level_pose, look_pose, path_poses, turn_pose, up_direction
from pansplat.geometry.pose import orthonormal_error


def _pose(position=(0.0, 0.0, 0.0), rotation=None) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    if rotation is not None:
        pose[:3, :3] = torch.as_tensor(rotation, dtype=torch.float64)
    pose[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return pose


def fly_path(cam2world: torch.Tensor, fractions: list[float]) -> torch.Tensor:
    """The poses of a flight at each of the fractions."""
    return torch.stack([fly_pose(cam2world, fraction) for fraction in fractions])


def _rotation_z(degrees: float) -> list[list[float]]:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return [[c, -s, 0], [s, c, 0], [0, 0, 1]]


TWO = torch.stack((_pose((1, 2, 3)), _pose((4, 2, 3))))


def test_easing_starts_and_stops_without_velocity_or_acceleration():
    assert ease_in_out(0) == 0 and ease_in_out(1) == 1 and ease_in_out(0.5) == pytest.approx(0.5)
    values = [ease_in_out(i / 100) for i in range(101)]
    assert values == sorted(values)
    assert ease_in_out(1e-3) < 1e-7 and 1 - ease_in_out(1 - 1e-3) < 1e-7
    assert ease_in_out(-1) == 0 and ease_in_out(2) == 1


def test_up_is_minus_y_of_upright_cameras_and_follows_tilted_ones():
    assert torch.allclose(up_direction(TWO), torch.tensor((0.0, -1.0, 0.0), dtype=torch.float64))
    z_up = _pose(rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]])[None]
    assert torch.allclose(up_direction(z_up), torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64))
    assert torch.allclose(up_direction(torch.zeros(0, 4, 4)), torch.tensor((0.0, -1.0, 0.0), dtype=torch.float64))


def test_look_pose_refuses_a_direction_along_up():
    with pytest.raises(ValueError, match="parallel"):
        look_pose(torch.zeros(3), torch.tensor((0.0, 1, 0)), torch.tensor((0.0, -1, 0)))


def test_positive_turn_looks_right():
    pose = turn_pose(torch.eye(4, dtype=torch.float64), math.pi / 2, torch.tensor((0.0, -1, 0)))
    assert torch.allclose(pose[:3, 2], torch.tensor((1.0, 0, 0), dtype=torch.float64), atol=1e-12)
    assert orthonormal_error(pose) < 1e-12


def test_level_pose_has_no_roll_and_keeps_the_heading():
    up = torch.tensor((0.0, -1, 0))
    rolled = _pose((1, 1, 1), _rotation_z(20))
    assert torch.allclose(level_pose(rolled, up), _pose((1, 1, 1)), atol=1e-12)


@pytest.mark.parametrize("looks", [1, -1], ids=["down", "up"])
def test_level_pose_is_continuous_through_the_vertical(looks: int):
    up = torch.tensor((0.0, -1, 0))
    # Rotated about x from +z; at 85 degrees the heading is still defined.
    headings = []
    for degrees in (85, 90):
        c, s = math.cos(math.radians(degrees)), -looks * math.sin(math.radians(degrees))
        pose = level_pose(_pose(rotation=[[1, 0, 0], [0, c, -s], [0, s, c]]), up)
        assert orthonormal_error(pose) < 1e-12
        headings.append(pose[:3, 2])
    forward = torch.tensor((0.0, 0, 1), dtype=torch.float64)
    assert torch.allclose(headings[0], forward) and torch.allclose(headings[1], forward)


def test_flight_starts_and_ends_at_the_cameras_along_the_path():
    start, end = fly_path(TWO, [0.0, 1.0])
    assert torch.allclose(start[:3, 3], TWO[0, :3, 3]) and torch.allclose(end[:3, 3], TWO[1, :3, 3])
    for pose in (start, end, fly_pose(TWO, 0.5)):
        assert torch.allclose(pose[:3, 2], torch.tensor((1.0, 0, 0), dtype=torch.float64), atol=1e-9)


def test_flight_turns_left_and_then_right_by_40_degrees():
    forward = fly_path(TWO, [i / 200 for i in range(201)])[:, :3, 2]
    assert torch.allclose(forward[:, 1], torch.zeros(201, dtype=torch.float64), atol=1e-9)
    yaw = torch.rad2deg(torch.atan2(forward[:, 0], forward[:, 2])) - 90  # heading is +x, right of it is -z
    assert float(yaw[:100].min()) == pytest.approx(-40, abs=0.1) and float(yaw[:100].max()) < 1e-6
    assert float(yaw[101:].max()) == pytest.approx(40, abs=0.1) and float(yaw[101:].min()) > -1e-6


def test_flight_is_rigid_and_continuous():
    cameras = torch.stack((_pose((0, 0, 0)), _pose((1, 0, 0), _rotation_z(3)), _pose((1, 0.1, 2)), _pose((0, 0, 4))))
    path = fly_path(cameras, [i / 300 for i in range(301)])
    assert max(orthonormal_error(pose) for pose in path) < 1e-9
    length = float((cameras[1:, :3, 3] - cameras[:-1, :3, 3]).norm(dim=-1).sum())
    assert float((path[1:, :3, 3] - path[:-1, :3, 3]).norm(dim=-1).max()) < 2.5 * length / 300
    cosines = (path[1:, :3, 2] * path[:-1, :3, 2]).sum(-1).clamp(-1, 1)
    assert float(torch.rad2deg(torch.acos(cosines)).max()) < 4


def test_a_flight_between_coincident_cameras_keeps_position_and_heading():
    cameras = torch.stack((_pose((1, 2, 3)), _pose((1, 2, 3))))
    path = fly_path(cameras, [0, 0.3, 1])
    assert torch.isfinite(path).all()
    assert torch.allclose(path[:, :3, 3], cameras[0, :3, 3].expand(3, 3))
    assert torch.allclose(path[0], cameras[0])


def test_a_vertical_path_keeps_the_cameras_heading():
    cameras = torch.stack((_pose((0, 0, 0)), _pose((0, -2, 0))))
    assert torch.allclose(path_poses(cameras)[:, :3, :3], torch.eye(3, dtype=torch.float64).expand(2, 3, 3))


def test_a_flight_with_one_camera_is_a_circle_through_it():
    path = fly_path(TWO[:1], [i / 100 for i in range(101)])[:, :3, 3]
    ahead = path_poses(TWO[:1])[0, :3, 2]
    assert torch.allclose(path[[0, -1]], TWO[:1, :3, 3].expand(2, 3))
    center = TWO[0, :3, 3] + 0.2 * ahead
    assert torch.allclose((path - center).norm(dim=-1), torch.tensor(0.2, dtype=torch.float64))
    assert torch.allclose(path[50], center + 0.2 * ahead)
