"""Units of worlds."""

import math

import pytest
import torch

from pansplat import pipeline
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.world import require_depth_range, scale_poses, working_factor


@pytest.mark.parametrize("near", [1e-9, 1e-6, 0.01, 0.1, 0.45, 5.0, 64.0, 1e6, 1e9])
def test_the_working_world_has_its_smallest_depth_near_a_metre(near: float) -> None:
    factor = working_factor(near)
    assert 1 / 64 <= near * factor <= 64
    assert math.frexp(factor)[0] == 0.5  # a power of two


@pytest.mark.parametrize("near", [0.0, -1.0, math.nan, 1e-300, 1e-40, 10.0, 9.9999])
def test_depth_ranges_without_extent_are_refused(near: float) -> None:
    with pytest.raises(InputError, match=r"poses\.json: needed"):
        require_depth_range(near, 10.0, "poses.json")


def test_scaling_changes_positions_only() -> None:
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    scaled = scale_poses(poses, 4.0)
    assert torch.equal(scaled[:, :3, :3], poses[:, :3, :3])
    assert torch.equal(scaled[1, :3, 3], torch.tensor([4.0, 8.0, 12.0], dtype=torch.float64))


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**20])
def test_a_scene_in_another_unit_has_the_same_image(unit: float) -> None:
    random = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=torch.randn(40, 3, generator=random) * 2,
        scales=torch.full((40, 3), 0.2),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(40, 1),
        opacities=torch.full((40,), 0.8),
        harmonics=torch.rand(40, 1, 3, generator=random),
        levels=torch.zeros(40, dtype=torch.int64),
        views=torch.zeros(40, dtype=torch.int64),
    )
    scene = Scene(gaussians, torch.eye(4, dtype=torch.float64)[None], near=0.45, far=10.0, height=16)
    pose = torch.eye(4, dtype=torch.float64)
    theirs, ours = pipeline.render(scene, pose), pipeline.render(scene.scaled(unit), pose)
    torch.testing.assert_close(ours.color, theirs.color, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.depth / unit, theirs.depth, rtol=1e-4, atol=1e-4)
