"""Deferred blending: weights are a partition of unity, and alpha scales them. Hard cases 45 to 49 test the limits."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pansplat.rendering import Rendering, blend, blend_weights

_COORDINATE = st.floats(-1e6, 1e6, allow_subnormal=False)
_POINT = st.tuples(_COORDINATE, _COORDINATE, _COORDINATE)


def _points(*rows) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def _image(colour, alpha, depth=2.0, size=(2, 3), background=(0.0, 0.0, 0.0)) -> Rendering:
    """An image of one colour over the background."""
    ground = torch.tensor(background)
    shown = alpha * torch.tensor(colour) + (1 - alpha) * ground
    color = shown[:, None, None].expand(3, *size)
    return Rendering(color, torch.full(size, alpha), torch.full(size, depth), background=ground)


@settings(max_examples=60)
@given(position=_POINT, others=st.lists(_POINT, min_size=1, max_size=5))
def test_weights_are_a_partition_of_unity(position, others):
    weights = blend_weights(_points(position)[0], _points(*others))
    assert (weights >= 0).all() and float(weights.sum()) == pytest.approx(1, abs=1e-12)


def test_two_views_have_the_papers_weights():
    weights = blend_weights(_points((0, 0, 0.2))[0], _points((0, 0, 0), (0, 0, 1)))
    assert torch.allclose(weights, torch.tensor([0.8, 0.2], dtype=torch.float64))


def test_opaque_views_mix_by_weight():
    a, b = _image((1.0, 0.0, 0.0), 1.0, 2.0), _image((0.0, 1.0, 0.0), 1.0, 4.0)
    got = blend([a, b], torch.tensor([0.25, 0.75]))
    assert torch.allclose(got.color[:, 0, 0], torch.tensor([0.25, 0.75, 0.0]))
    assert float(got.depth[0, 0]) == pytest.approx(3.5) and float(got.alpha[0, 0]) == 1


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (0.2, 0.9, 0.4)])
@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.9, 0.1), (0.5, 0.5)])
def test_a_translucent_edge_over_an_opaque_view_shows_no_background(background, weights):
    red = (1.0, 0.0, 0.0)
    got = blend([_image(red, alpha, background=background) for alpha in (0.3, 1.0)], torch.tensor(weights))
    assert torch.allclose(got.color, torch.tensor(red)[:, None, None].expand(3, 2, 3), atol=1e-6)
    assert torch.equal(got.alpha, torch.ones(2, 3))


def test_views_of_equal_alpha_keep_it():
    background = (0.2, 0.9, 0.4)
    first, second = (_image(color, 0.3, background=background) for color in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    got = blend([first, second], torch.tensor((0.25, 0.75)))
    assert torch.allclose(got.color, 0.25 * first.color + 0.75 * second.color)
    assert torch.allclose(got.alpha, first.alpha)


def test_a_wrong_number_of_weights_is_refused():
    with pytest.raises(ValueError, match=r"got shape \(3,\) for 1"):
        blend([_image((0.0, 0.0, 0.0), 1.0)], torch.ones(3))
    with pytest.raises(ValueError, match="at least one"):
        blend([], torch.ones(0))
    with pytest.raises(ValueError, match="at least one view"):
        blend_weights(torch.zeros(3), torch.zeros(0, 3))
