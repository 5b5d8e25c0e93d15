"""A small scene whose photographs are known: 600 Gaussians on a wavy shell, seen from two cameras."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from synthetic_scenes import make_balls, place_cameras

from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.inputs.views import Views
from pansplat.rendering import rasterize

HEIGHT = 32
COUNT = 600


@dataclasses.dataclass(frozen=True)
class Room:
    """The true scene, its photographs, and a wrong prediction of it."""

    truth: Scene
    views: Views
    predicted: Scene

    def error(self, scene: Scene, pose: torch.Tensor) -> float:
        """Mean absolute error of the first view's image at a pose."""
        images = [
            rasterize(s.gaussians.select(s.gaussians.views == 0), pose, size=(HEIGHT, 2 * HEIGHT)).color
            for s in (scene, self.truth)
        ]
        return float((images[0] - images[1]).abs().mean())


@pytest.fixture(scope="session")
def room() -> Room:
    """Each view holds all Gaussians; in the prediction their distances, scales and colours are wrong."""
    random = torch.Generator().manual_seed(0)
    rays = fibonacci_directions(COUNT).float()
    means = rays * (2.5 + 0.6 * torch.sin(3 * rays[:, :1]) * torch.cos(2 * rays[:, 1:2]))
    one = make_balls(means, 0.13, 0.95, harmonics=1.5 * torch.rand(COUNT, 1, 3, generator=random) - 0.75)
    both = Gaussians.cat([one, dataclasses.replace(one, views=torch.ones_like(one.views))])
    poses = place_cameras((-0.3, 0, 0), (0.3, 0, 0))
    truth = Scene(both, poses, near=0.5, far=10.0, names=("left", "right"), model="truth", height=HEIGHT)
    images = torch.stack([rasterize(one, pose, size=(HEIGHT, 2 * HEIGHT)).color for pose in poses]).clamp(0, 1)
    views = Views(images, poses, torch.ones(2, HEIGHT, 2 * HEIGHT, dtype=torch.bool), 0.5, 10.0, ("left", "right"))
    offsets = both.means - poses[both.views, :3, 3].float()
    factor = (0.05 * torch.randn(2 * COUNT, 1, generator=random)).exp()
    wrong = dataclasses.replace(
        both,
        means=both.means - offsets + offsets * factor,
        scales=1.3 * both.scales,
        harmonics=both.harmonics + 0.2 * torch.randn(2 * COUNT, 1, 3, generator=random),
    )
    return Room(truth, views, dataclasses.replace(truth, gaussians=wrong, model="wrong"))
