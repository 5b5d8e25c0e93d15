"""What pruning keeps is as it was."""

import torch

from pansplat.gaussians.gaussians import Gaussians
from pansplat.gaussians.prune import prune


def _gaussians() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    count = 50
    return Gaussians(
        means=torch.randn(count, 3, generator=generator),
        scales=torch.rand(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        opacities=torch.linspace(0, 1, count),
        harmonics=torch.randn(count, 25, 3, generator=generator),
        levels=torch.zeros(count, dtype=torch.uint8),
        views=torch.zeros(count, dtype=torch.uint8),
    )


def test_nothing_asked_changes_nothing():
    gaussians = _gaussians()
    assert prune(gaussians) is gaussians
    assert prune(gaussians, degree=4) is gaussians


def test_the_opaque_are_kept_with_all_that_they_have():
    gaussians = _gaussians()
    kept = prune(gaussians, min_opacity=float(gaussians.opacities[20]))
    assert torch.equal(kept.opacities, gaussians.opacities[20:])
    assert torch.equal(kept.harmonics, gaussians.harmonics[20:])


def test_lower_degrees_stay_as_they_are():
    gaussians = _gaussians()
    for degree in range(4):
        kept = prune(gaussians, degree=degree)
        assert kept.degree == degree and len(kept) == len(gaussians)
        assert torch.equal(kept.harmonics, gaussians.harmonics[:, : (degree + 1) ** 2])
        assert torch.equal(kept.means, gaussians.means)
    assert prune(prune(gaussians, degree=1), degree=3).degree == 1
