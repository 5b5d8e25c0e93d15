"""An image composed of parts, each rendered from its visible Gaussians, equals the whole image."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
import torch

from pansplat.gaussians.scene import Gaussians
from pansplat.training.config import Mixing, Style
from pansplat.training.rendering import TargetRenderer

HEIGHT = 32
STYLES: tuple[Style, ...] = ("panorama", "cubemap")
POSE = torch.eye(4, dtype=torch.float64)
POSE[:3, 3] = torch.tensor([0.2, -0.1, 0.3])
CONTEXT = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
CONTEXT[1, 0, 3] = 0.5


def cloud(count: int = 400, dtype: torch.dtype = torch.float64) -> Gaussians:
    """Random Gaussians around the camera; some are thin, contain the camera, are faint, or are not finite."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    directions = torch.nn.functional.normalize(normal(count, 3), dim=1)
    radii = 0.5 + 3 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    means = directions * radii
    means[:3] = POSE[:3, 3] + 0.01
    scales = 0.1 * torch.exp(1.2 * normal(count, 3) - 1)
    scales[3:6] = 2.0
    opacities = torch.rand(count, generator=generator, dtype=torch.float64)
    opacities[6:9] = 1e-4
    means[9] = torch.nan
    views = torch.arange(count) % 2
    return Gaussians(means, scales, normal(count, 4), opacities, 0.3 * normal(count, 4, 3), views * 0, views).to(
        dtype=dtype
    )


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


@pytest.mark.parametrize("height", [32, 64, 512, 2048])
def test_strips_cover_every_row_once_and_have_equal_areas(height: int) -> None:
    renderer = TargetRenderer("panorama", "joint", height)
    rows = [renderer._strip_rows(part.index) for part in renderer.list_parts(2)]
    assert rows[0][0] == 0 and rows[-1][1] == height
    assert all(before[1] == after[0] for before, after in itertools.pairwise(rows))
    areas = [math.cos(math.pi * first / height) - math.cos(math.pi * end / height) for first, end in rows]
    assert max(areas) - min(areas) < 4 * math.pi / height
