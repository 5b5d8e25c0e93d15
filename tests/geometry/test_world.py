"""The working world, and its frame in the user's world."""

import math

import pytest
import torch
from refusals import expect_error

from pansplat.geometry.world import USER_FRAME, WorldFrame, choose_frame, choose_unit, require_depth_range


@pytest.mark.parametrize("near", [1e-9, 1e-6, 0.01, 0.1, 0.45, 5.0, 64.0, 65.0, 3.2e4, 1e6, 1e9])
def test_the_working_world_has_its_smallest_depth_near_a_metre(near: float) -> None:
    unit = choose_unit(near)
    assert 1 / 64 <= near / unit <= 64
    assert math.log(unit, 1000) == pytest.approx(round(math.log(unit, 1000)), abs=1e-9), "a power of 1000"
    assert (unit == 1) == (1 / 64 <= near <= 64)


@pytest.mark.parametrize("near", [0.0, -1.0, math.nan, 1e-300, 1e-40, 10.0, 9.9999])
def test_depth_ranges_without_extent_are_refused(near: float) -> None:
    expect_error(r"poses\.json: needed", require_depth_range, near, 10.0, "poses.json")


def test_a_world_of_metres_around_its_origin_is_kept() -> None:
    assert choose_frame(_make_poses((0.0, 250.0, -250.0)), 0.45) == USER_FRAME
    assert choose_frame(_make_poses((260.0, 0.0, 0.0)), 0.45) == WorldFrame(1.0, (256.0, 0.0, 0.0))
    assert choose_frame(_make_poses((260e3, 0.0, 0.0)), 450.0) == WorldFrame(1000.0, (256e3, 0.0, 0.0))


def test_an_origin_does_not_change_when_a_camera_is_added_nearby() -> None:
    poses = _make_poses((5e6, 4e5, 40.0))
    farther = torch.cat((poses, _make_poses((5e6 + 30, 4e5 - 30, 40.0))))
    assert choose_frame(poses, 0.45) == choose_frame(farther, 0.45)


@pytest.mark.parametrize("frame", [WorldFrame(1e3), WorldFrame(1.0, (5e6, -4e5, 512.0)), WorldFrame(1e-3, (5e3, 0, 0))])
def test_poses_in_a_frame_and_back_are_the_same(frame: WorldFrame) -> None:
    poses = torch.eye(4, dtype=torch.float64).repeat(50, 1, 1)
    poses[:, :3, 3] = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)).double() + torch.tensor(
        frame.origin
    )
    local = frame.localize(poses)
    assert torch.equal(local[:, :3, :3], poses[:, :3, :3])
    assert float((local[:, :3, 3] * frame.unit).abs().max()) <= 1
    assert torch.allclose(frame.globalize(local), poses, rtol=1e-15, atol=0)


def _make_poses(place: tuple[float, float, float]) -> torch.Tensor:
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, :3, 3] = torch.tensor(place)
    poses[1, 0, 3] += 1
    return poses
