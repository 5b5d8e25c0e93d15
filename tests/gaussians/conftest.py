"""A scene of random Gaussians for the tests of scene files."""

from collections.abc import Callable

import pytest
import torch

from pansplat.gaussians.scene import Gaussians, Scene, SceneTour
from pansplat.geometry.pose import rotations_from_quats


def _make_scene(count: int = 40, degree: int = 1, *, seed: int = 0, spread: float = 1.0) -> Scene:
    random = torch.Generator().manual_seed(seed)
    half = count // 2
    gaussians = Gaussians(
        means=torch.randn(count, 3, generator=random) * spread,
        scales=torch.rand(count, 3, generator=random) * 0.1 + 1e-3,
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=1),
        opacities=torch.rand(count, generator=random) * 0.98 + 0.01,
        harmonics=torch.randn(count, (degree + 1) ** 2, 3, generator=random) * 0.3,
        levels=torch.arange(count) // 7 % 4,
        views=torch.cat((torch.zeros(half), torch.ones(count - half))).long(),
    )
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[0, :3, :3] = rotations_from_quats(torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=torch.float64))
    poses[1, :3, 3] = torch.tensor([1 / 3, -2e-7, 12345.678901234567], dtype=torch.float64)
    names, gains, starts = ("à\n.jpg", "b c.png"), ((1.25, 1.0, 0.9), (0.8, 1.0, 1 / 0.9)), (None, (1.0, -0.5))
    tour = SceneTour(((0, 0, 1), (1, 1, 0.5)), ((1, 0, -3.0, 0.25, "à <b>"),), ((1, 0, 1.5, -2.0, 0.3),))
    return Scene(gaussians, poses, 0.45, 10.0, names, "sweep", height=256, gains=gains, starts=starts, tour=tour)


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Scene]:
    """Make a scene of `count` random Gaussians of a degree, with two cameras and all fields of the pansplat entry."""
    return _make_scene
