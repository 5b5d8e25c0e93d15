"""Deferred blending: weights are a partition of unity, exact at inputs; opacity renormalises pixels."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pansplat.rendering import Rendering, blend, blend_weights

_COORDINATE = st.floats(-1e6, 1e6, allow_subnormal=False)
_POINT = st.tuples(_COORDINATE, _COORDINATE, _COORDINATE)


def _points(*rows) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def _picture(colour, alpha, depth=2.0, size=(2, 3)) -> Rendering:
    return Rendering(
        torch.tensor(colour)[:, None, None].expand(3, *size), torch.full(size, alpha), torch.full(size, depth)
    )


@settings(max_examples=60, deadline=None)
@given(position=_POINT, others=st.lists(_POINT, min_size=1, max_size=5))
def test_weights_are_a_partition_of_unity(position, others):
    weights = blend_weights(_points(position)[0], _points(*others))
    assert (weights >= 0).all() and float(weights.sum()) == pytest.approx(1, abs=1e-12)


def test_two_views_get_the_papers_weights():
    weights = blend_weights(_points((0, 0, 0.2))[0], _points((0, 0, 0), (0, 0, 1)))
    assert torch.allclose(weights, torch.tensor([0.8, 0.2], dtype=torch.float64))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_weight_at_an_input_position_is_exactly_one_hot(count):
    inputs = _points((0, 0, 0), (1, 0, 0), (0, 3, 1))[:count]
    for i in range(count):
        expected = torch.zeros(count, dtype=torch.float64)
        expected[i] = 1
        assert torch.equal(blend_weights(inputs[i], inputs), expected)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_all_in_one_place_weigh_the_same(count):
    here = _points((1, 2, 3)).expand(count, 3)
    weights = blend_weights(here[0], here)
    assert torch.equal(weights, torch.full((count,), 1 / count, dtype=torch.float64))


def test_inputs_that_coincide_at_the_target_share_all_weight():
    weights = blend_weights(_points((1, 0, 0))[0], _points((1, 0, 0), (5, 0, 0), (1, 0, 0)))
    assert torch.equal(weights, torch.tensor([0.5, 0, 0.5], dtype=torch.float64))


def test_far_outside_the_weights_tend_to_equal_and_stay_positive():
    for count in (1, 2, 3):
        inputs = _points((0, 0, 0), (1, 0, 0), (0, 1, 0))[:count]
        weights = blend_weights(_points((1e9, 0, 0))[0], inputs)
        assert torch.allclose(weights, torch.full((count,), 1 / count, dtype=torch.float64), atol=1e-8)


def test_weights_have_finite_gradients_everywhere_and_zero_at_an_input():
    inputs = _points((0, 0, 0), (1, 0, 0), (1, 0, 0)).requires_grad_()
    cases = (((0, 0, 0), True), ((1, 0, 0), True), ((1e-9, 0, 0), False), ((0.5, 0.1, 0), False))
    for target, zero in cases:
        position = _points(target)[0].requires_grad_()
        (gradient,) = torch.autograd.grad(blend_weights(position, inputs)[0], position)
        assert torch.isfinite(gradient).all()
        assert (float(gradient.abs().max()) == 0) == zero
    position = _points((0.3, 0.2, -0.1))[0].requires_grad_()
    assert torch.autograd.gradcheck(blend_weights, (position, _points((0, 0, 0), (1, 0, 0)).requires_grad_()))


def test_blending_at_an_input_view_ignores_the_other():
    a, b = _picture((0.1, 0.2, 0.3), 0.7, 2.0), _picture((0.9, 0.8, 0.7), 0.9, 5.0)
    for weights, expected in (((1.0, 0.0), a), ((0.0, 1.0), b)):
        got = blend([a, b], torch.tensor(weights))
        assert torch.equal(got.color, expected.color)
        assert torch.equal(got.alpha, expected.alpha) and torch.equal(got.depth, expected.depth)


def test_a_hole_in_one_view_is_filled_by_the_other():
    hole, full = _picture((0.0, 0.0, 0.0), 0.0, 0.0), _picture((0.9, 0.5, 0.1), 1.0, 3.0)
    got = blend([hole, full], torch.tensor([0.9, 0.1]))
    assert torch.equal(got.color, full.color) and torch.equal(got.depth, full.depth)
    assert torch.equal(got.alpha, full.alpha)


def test_opaque_views_mix_by_weight():
    a, b = _picture((1.0, 0.0, 0.0), 1.0, 2.0), _picture((0.0, 1.0, 0.0), 1.0, 4.0)
    got = blend([a, b], torch.tensor([0.25, 0.75]))
    assert torch.allclose(got.color[:, 0, 0], torch.tensor([0.25, 0.75, 0.0]))
    assert float(got.depth[0, 0]) == pytest.approx(3.5) and float(got.alpha[0, 0]) == 1


def test_where_all_views_are_empty_there_is_background():
    empty = _picture((0.2, 0.4, 0.6), 0.0, 0.0)
    got = blend([empty, empty, empty], torch.tensor([0.2, 0.3, 0.5]))
    assert torch.allclose(got.color, empty.color)
    assert float(got.alpha.abs().max()) == float(got.depth.abs().max()) == 0


def test_blending_is_differentiable_without_nan_over_holes():
    alphas = torch.tensor([[[0.0, 0.5]], [[0.0, 0.0]]], dtype=torch.float64, requires_grad=True)
    colours = torch.rand(2, 3, 1, 2, dtype=torch.float64, requires_grad=True)
    weights = torch.tensor([0.5, 0.5], dtype=torch.float64, requires_grad=True)
    got = blend([Rendering(c, a, a) for c, a in zip(colours, alphas, strict=True)], weights)
    (got.color.sum() + got.alpha.sum() + got.depth.sum()).backward()
    for leaf in (alphas, colours, weights):
        assert leaf.grad is not None and torch.isfinite(leaf.grad).all()


def test_blending_refuses_a_wrong_number_of_weights():
    with pytest.raises(ValueError, match=r"got shape \(3,\) for 1"):
        blend([_picture((0.0, 0.0, 0.0), 1.0)], torch.ones(3))
    with pytest.raises(ValueError, match="at least one"):
        blend([], torch.ones(0))
    with pytest.raises(ValueError, match="at least one view"):
        blend_weights(torch.zeros(3), torch.zeros(0, 3))


def test_where_the_nearest_view_sees_nothing_the_others_fill():
    one = torch.ones(1, 2)
    near = Rendering(torch.zeros(3, 1, 2), torch.tensor([[1.0, 0.0]]), 2 * one)
    other = Rendering(torch.ones(3, 1, 2), one, 5 * one)
    mixed = blend([near, other], torch.tensor([1.0, 0.0]))
    assert mixed.color[:, 0].tolist() == [[0.0, 1.0]] * 3
    assert mixed.alpha.tolist() == [[1.0, 1.0]]
    assert mixed.depth.tolist() == [[2.0, 5.0]]
