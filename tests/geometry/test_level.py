"""Level cameras keep their heading, and look along the path."""

import math

import pytest
import torch

from pansplat.geometry.level import level_axes, level_pose, look_pose, up_direction
from pansplat.geometry.pose import orthonormal_error


def _pose(position=(0.0, 0.0, 0.0), rotation=None) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    if rotation is not None:
        pose[:3, :3] = torch.as_tensor(rotation, dtype=torch.float64)
    pose[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return pose


TWO = torch.stack((_pose((1, 2, 3)), _pose((4, 2, 3))))


def test_up_is_minus_y_of_upright_cameras_and_follows_tilted_ones():
    assert torch.allclose(up_direction(TWO), torch.tensor((0.0, -1.0, 0.0), dtype=torch.float64))
    z_up = _pose(rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]])[None]
    assert torch.allclose(up_direction(z_up), torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64))
    assert torch.allclose(up_direction(torch.zeros(0, 4, 4)), torch.tensor((0.0, -1.0, 0.0), dtype=torch.float64))


def test_look_pose_refuses_a_direction_along_up():
    with pytest.raises(ValueError, match="parallel"):
        look_pose(torch.zeros(3), torch.tensor((0.0, 1, 0)), torch.tensor((0.0, -1, 0)))


def test_level_pose_has_no_roll_and_keeps_the_heading():
    up = torch.tensor((0.0, -1, 0))
    c, s = math.cos(math.radians(20)), math.sin(math.radians(20))
    rolled = _pose((1, 1, 1), [[c, -s, 0], [s, c, 0], [0, 0, 1]])
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


def test_level_axes_look_along_the_path():
    expected = torch.tensor(((0.0, 0, 1), (0, 1, 0), (-1, 0, 0)), dtype=torch.float64)
    assert torch.allclose(torch.from_numpy(level_axes(TWO)), expected, atol=1e-9)


@pytest.mark.parametrize("end", [(0, 0, 0), (0, -2, 0)], ids=["coincident cameras", "vertical path"])
def test_level_axes_without_a_direction_keep_the_cameras_heading(end):
    axes = level_axes(torch.stack((_pose(), _pose(end))))
    assert torch.allclose(torch.from_numpy(axes), torch.eye(3, dtype=torch.float64))
