"""Sums of blending weights."""

from __future__ import annotations

import pytest
import torch
from dense_renderer import POSE, make_scene

from pansplat.rendering import rasterize
from pansplat.rendering.weights import draw_colors, sum_weights

SIZE = (40, 80)


@pytest.fixture
def scene():
    return make_scene(600, scale=0.15, degree=1, seed=1).to(dtype=torch.float32)


@pytest.fixture
def pose():
    return POSE.clone()


def test_sums_of_weights_equal_the_reference(scene, pose):
    image = torch.randn(SIZE, generator=torch.Generator().manual_seed(2))
    expected = sum_weights(scene.to(dtype=torch.float64), pose, image.double())
    error = (sum_weights(scene, pose, image).double() - expected).norm() / expected.norm()
    assert error < 1e-5 and expected.abs().max() > 1


def test_weights_of_all_gaussians_sum_to_the_alpha(scene, pose):
    total = sum_weights(scene, pose, torch.ones(SIZE)).sum()
    torch.testing.assert_close(total, rasterize(scene, pose, size=SIZE).alpha.sum(), rtol=1e-5, atol=0)


def test_both_products_are_transposes_of_each_other(scene, pose):
    random = torch.Generator().manual_seed(3)
    colors, image = 0.1 + torch.rand(600, generator=random), torch.randn(SIZE, generator=random)
    drawn = draw_colors(scene, pose, colors[:, None].expand(-1, 3), SIZE)[2]
    torch.testing.assert_close(
        (drawn * image).sum(), (colors * sum_weights(scene, pose, image)).sum(), rtol=1e-4, atol=0
    )


def test_no_gaussians_have_no_sums(scene, pose):
    assert sum_weights(scene.select(torch.zeros(600, dtype=torch.bool)), pose, torch.ones(SIZE)).shape == (0,)
