"""Small scenes whose photographs are known: Gaussians on a wavy shell, seen from two cameras."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from synthetic_scenes import make_balls, place_cameras

from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.inputs.views import Views
from pansplat.rendering import rasterize


@dataclasses.dataclass(frozen=True)
class Room:
    """The true scene, its photographs, and a wrong prediction of it."""

    truth: Scene
    views: Views
    predicted: Scene

    def error(self, scene: Scene, pose: torch.Tensor) -> float:
        """Mean absolute error of the first view's image at a pose."""
        size = (self.truth.height, 2 * self.truth.height)
        images = [
            rasterize(s.gaussians.select(s.gaussians.views == 0), pose, size=size).color for s in (scene, self.truth)
        ]
        return float((images[0] - images[1]).abs().mean())


@pytest.fixture(autouse=True)
def few_rows_of_gains(monkeypatch) -> None:
    """The gains are sought in 32 rows, as many as the photographs have, in place of 64."""
    monkeypatch.setattr("pansplat.rendering.gains._HEIGHT", 32)


@pytest.fixture(scope="session")
def room() -> Room:
    return _make_room(600, 32)


@pytest.fixture(scope="session")
def small_room() -> Room:
    """For the slow torch renderer of a pretended card."""
    return _make_room(75, 16)


def _make_room(count: int, height: int) -> Room:
    """Each view holds all Gaussians; in the prediction their distances, scales and colours are wrong."""
    random = torch.Generator().manual_seed(0)
    rays = fibonacci_directions(count).float()
    means = rays * (2.5 + 0.6 * torch.sin(3 * rays[:, :1]) * torch.cos(2 * rays[:, 1:2]))
    size, colors = 0.13 * (600 / count) ** 0.5, 1.5 * torch.rand(count, 1, 3, generator=random) - 0.75
    one = make_balls(means, size, 0.95, harmonics=colors)
    both = Gaussians.cat([one, dataclasses.replace(one, views=torch.ones_like(one.views))])
    poses = place_cameras((-0.3, 0, 0), (0.3, 0, 0))
    truth = Scene(both, poses, near=0.5, far=10.0, names=("left", "right"), model="truth", height=height)
    images = torch.stack([rasterize(one, pose, size=(height, 2 * height)).color for pose in poses]).clamp(0, 1)
    views = Views(images, poses, torch.ones(2, height, 2 * height, dtype=torch.bool), 0.5, 10.0, ("left", "right"))
    offsets = both.means - poses[both.views, :3, 3].float()
    factor = (0.05 * torch.randn(2 * count, 1, generator=random)).exp()
    wrong = dataclasses.replace(
        both,
        means=both.means - offsets + offsets * factor,
        scales=1.3 * both.scales,
        harmonics=both.harmonics + 0.2 * torch.randn(2 * count, 1, 3, generator=random),
    )
    return Room(truth, views, dataclasses.replace(truth, gaussians=wrong, model="wrong"))
