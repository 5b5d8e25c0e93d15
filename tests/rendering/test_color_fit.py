"""Colours fitted to photographs."""

import dataclasses
import itertools

import pytest
import torch
from synthetic_scenes import make_balls

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.rendering import color_fit, rasterize
from pansplat.rendering.color_fit import fit_colors

SIZE = (24, 48)
POSES = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    """Two views with Gaussians of random colours on a sphere."""
    count, random = 300, torch.Generator().manual_seed(0)
    colors, label = 1.5 * torch.rand(count, 1, 3, generator=random) - 0.75, torch.tensor(0, dtype=torch.uint8)
    one = make_balls(2 * fibonacci_directions(count), 0.12, harmonics=colors, levels=label, views=label)
    return Gaussians.cat([one, dataclasses.replace(one, views=torch.ones_like(one.views))])


@pytest.fixture(scope="module")
def photographs(truth) -> torch.Tensor:
    return torch.stack([_draw(truth, view) for view in (0, 1)])


def _draw(gaussians: Gaussians, view: int) -> torch.Tensor:
    return rasterize(gaussians.select(gaussians.views == view), POSES[view], size=SIZE).color


def _fit(gaussians: Gaussians, images: torch.Tensor, masks: torch.Tensor | None = None, steps: int = 3) -> Gaussians:
    masks = torch.ones(2, *SIZE, dtype=torch.bool) if masks is None else masks
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(color_fit, "_STEPS", steps)
        return fit_colors(gaussians, images, POSES, masks)


def _grey(gaussians: Gaussians) -> Gaussians:
    return dataclasses.replace(gaussians, harmonics=torch.zeros_like(gaussians.harmonics))


def test_more_steps_bring_every_view_nearer_to_its_photograph(truth, photographs):
    errors = [
        [
            float((_draw(_fit(_grey(truth), photographs, steps=steps), view) - photographs[view]).abs().mean())
            for view in (0, 1)
        ]
        for steps in (0, 1, 4, 16)
    ]
    for before, after in itertools.pairwise(errors):
        assert all(b < 0.75 * a for a, b in zip(before, after, strict=True))


def test_true_colours_stay(truth, photographs):
    assert torch.allclose(_fit(truth, photographs).harmonics, truth.harmonics, atol=1e-4)


def test_harmonics_of_higher_degree_stay_and_count(truth, photographs):
    further = 0.3 * torch.rand(len(truth), 3, 3, generator=torch.Generator().manual_seed(1)) - 0.15
    start = dataclasses.replace(truth, harmonics=torch.cat((truth.harmonics, further), dim=1))
    fitted = _fit(start, photographs, steps=16)
    assert torch.equal(fitted.harmonics[:, 1:], further)
    for view in (0, 1):
        before, after = (float((_draw(g, view) - photographs[view]).abs().mean()) for g in (start, fitted))
        assert after < 0.1 * before


def test_masked_pixels_do_not_change_colours(truth, photographs):
    masks = torch.ones(2, *SIZE, dtype=torch.bool)
    masks[:, :, : SIZE[1] // 2] = False  # the west
    spoiled = torch.where(masks[:, None], photographs, 1.0)
    fitted = _fit(_grey(truth), spoiled, masks)
    assert torch.equal(fitted.harmonics, _fit(_grey(truth), photographs, masks).harmonics)
    west = truth.means[:, 0] < -0.5
    assert not fitted.harmonics[west].any()
    assert fitted.harmonics[truth.means[:, 0] > 0.5].abs().mean() > 0.2
