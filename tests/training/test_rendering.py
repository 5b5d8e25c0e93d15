"""An image composed of parts, each rendered from its visible Gaussians, equals the whole image."""

from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch
from dense_renderer import make_scene

from pansplat.gaussians.scene import Gaussians
from pansplat.training.config import Mixing, Style
from pansplat.training.rendering import TargetRenderer

HEIGHT = 32
STYLES: tuple[Style, ...] = ("panorama", "cubemap")
POSE = torch.eye(4, dtype=torch.float64)
POSE[:3, 3] = torch.tensor([0.2, -0.1, 0.3])
CONTEXT = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
CONTEXT[1, 0, 3] = 0.5


def cloud(count: int = 400) -> Gaussians:
    """Random Gaussians around the camera; some are thin, contain the camera, are faint, or are not finite."""
    scene = make_scene(count, scale=0.05, degree=1)
    scene.means[:3], scene.means[9] = POSE[:3, 3] + 0.01, torch.nan
    scene.scales[:, 0] *= 0.2
    scene.scales[3:6] = 2.0
    scene.opacities[6:9] = 1e-4
    return dataclasses.replace(scene, views=torch.arange(count) % 2)


@pytest.mark.parametrize(("style", "mixing"), list(itertools.product(STYLES, ("joint", "by_view"))))
def test_composed_parts_equal_the_whole_image(style: Style, mixing: Mixing) -> None:
    renderer, gaussians = TargetRenderer(style, mixing, HEIGHT), cloud()
    parts = renderer.list_parts(len(CONTEXT))
    masks = renderer.find_visible(gaussians, POSE, parts)
    rendered = [
        renderer.render_part(gaussians.select(mask), POSE, part) for mask, part in zip(masks, parts, strict=True)
    ]
    whole = renderer.render(gaussians, POSE, CONTEXT)
    assert float(whole.std()) > 0.05
    torch.testing.assert_close(renderer.compose(rendered, POSE, CONTEXT), whole, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("style", STYLES)
def test_gaussians_that_are_not_selected_are_invisible(style: Style) -> None:
    renderer, gaussians = TargetRenderer(style, "joint", HEIGHT), cloud()
    parts = renderer.list_parts(2)
    for mask, part in zip(renderer.find_visible(gaussians, POSE, parts), parts, strict=True):
        assert not renderer.render_part(gaussians.select(~mask), POSE, part)[3].any()


@pytest.mark.parametrize("style", STYLES)
def test_a_part_needs_few_of_the_gaussians(style: Style) -> None:
    renderer, small = TargetRenderer(style, "joint", 128), cloud(2000)
    small = dataclasses.replace(small, scales=small.scales.clamp_max(0.02))
    masks = renderer.find_visible(small, POSE, renderer.list_parts(2))
    assert max(float(mask.double().mean()) for mask in masks) < 0.3
    assert sum(float(mask.double().mean()) for mask in masks) < 1.5
