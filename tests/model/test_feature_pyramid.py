"""Feature pyramid and transformer: agreement with the official code, windowed attention, symmetries of the sphere."""

import math

import pytest
import torch
from refusals import expect_error
from synthetic_scenes import draw_noise

from pansplat.model.feature_pyramid import (
    FeaturePyramid,
    FeaturePyramidConfig,
    Transformer,
    TransformerConfig,
    make_shift_mask,
)

_SMALL = FeaturePyramidConfig(channels=(8, 8, 8, 16), transformer=TransformerConfig(16, blocks=2, expansion=1))


@pytest.mark.parametrize(
    ("compat", "shape", "message"),
    [
        ("fixed", (1, 1, 3, 32, 64), "two or more views, got 1"),
        ("official", (1, 3, 3, 32, 64), "exactly two views, as the official code does, got 3"),
        ("fixed", (1, 2, 3, 48, 96), "that 32 divides, got 48x96"),
        ("official", (1, 2, 3, 40, 80), "that 16 divides, got 40x80"),
    ],
)
def test_unusable_views_and_sizes_are_refused(compat, shape, message):
    expect_error(message, lambda: FeaturePyramid(_SMALL, compat)(torch.zeros(shape)))


def test_fixed_shift_mask_wraps_at_the_seam_but_not_at_the_poles():
    mask = make_shift_mask(8, 16, 2, "fixed")
    assert not mask[:2].any()  # all tokens of the upper windows are neighbours
    rows = torch.arange(4).repeat_interleave(8)  # of a lower window's tokens; half of them wrapped around
    apart = (rows[:, None] < 2) != (rows[None] < 2)
    assert torch.equal(mask[2:] == -math.inf, apart.expand(2, -1, -1))


def test_a_repeated_view_changes_nothing(randomize):
    network = randomize(Transformer(TransformerConfig(channels=16, blocks=1, expansion=2), "fixed"))
    maps = draw_noise(1, 2, 16, 4, 8)
    twice = network(torch.cat((maps, maps[:, 1:]), dim=1))
    assert torch.allclose(twice[:, 0], network(maps)[:, 0], atol=1e-12)
