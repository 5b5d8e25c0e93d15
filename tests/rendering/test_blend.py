"""Deferred blending: weights are a partition of unity, alpha scales them, and the limits are finite."""

import math

import pytest
import torch
from dense_renderer import ORIGIN, make_spheres
from hypothesis import given, settings
from hypothesis import strategies as st

from pansplat.rendering import Rendering, blend, blend_weights, rasterize

_COORDINATE = st.floats(-1e6, 1e6, allow_subnormal=False)
_POINT = st.tuples(_COORDINATE, _COORDINATE, _COORDINATE)
_COUNTS = pytest.mark.parametrize("count", [1, 2, 3])


def _points(*rows) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


_POSITIONS = _points((0.0, 0, 0), (1.0, 0, 0), (0.2, 2.0, 0.5))


def _image(colour, alpha, depth=2.0, size=(2, 3), background=(0.0, 0.0, 0.0)) -> Rendering:
    """An image of one colour over the background."""
    ground = torch.tensor(background)
    shown = alpha * torch.tensor(colour) + (1 - alpha) * ground
    color = shown[:, None, None].expand(3, *size)
    return Rendering(color, torch.full(size, alpha), torch.full(size, depth), background=ground)


def _draw(count: int, background=(0.0, 0.0, 0.0)) -> list[Rendering]:
    """Images of single views: each covers a part of the panorama, and none covers all of it."""
    means, colours = ((0, 0, 2.0), (0.5, 0, 2.0), (0, 0.5, 2.0)), torch.eye(3, dtype=torch.float64)
    scenes = [make_spheres(means[i], 0.5, colours=colours[i]) for i in range(count)]
    return [rasterize(scene, ORIGIN, size=(16, 32), background=background) for scene in scenes]


@settings(max_examples=60)
@given(position=_POINT, others=st.lists(_POINT, min_size=1, max_size=5))
def test_weights_are_a_partition_of_unity(position, others):
    weights = blend_weights(_points(position)[0], _points(*others))
    assert (weights >= 0).all() and float(weights.sum()) == pytest.approx(1, abs=1e-12)


def test_two_views_have_the_papers_weights():
    weights = blend_weights(_points((0, 0, 0.2))[0], _points((0, 0, 0), (0, 0, 1)))
    assert torch.allclose(weights, torch.tensor([0.8, 0.2], dtype=torch.float64))


def test_a_view_ahead_weighs_more_than_one_behind_and_across_they_weigh_as_without_a_direction():
    position, positions = _points((0, 0, 0.2))[0], _points((0, 0, 0), (0, 0, 1))
    across, ahead, back = _points((1, 0, 0), (0, 0, 1), (0, 0, -1))
    plain = blend_weights(position, positions)
    assert torch.allclose(blend_weights(position, positions, across), plain)
    for forward, sign in ((ahead, 1), (back, -1)):
        first, second = blend_weights(position, positions, forward).tolist()
        assert first + second == pytest.approx(1) and second / first == pytest.approx(0.25 * math.exp(1.1 * sign))
    for number in range(2):
        at_input = blend_weights(positions[number], positions, ahead)
        assert torch.equal(at_input, torch.eye(2, dtype=torch.float64)[number])


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


@_COUNTS
def test_at_an_input_position_only_its_view_counts_and_the_weights_have_no_gradient(count):
    images = _draw(count)
    largest = torch.stack([image.alpha for image in images]).amax(dim=0)
    for i, image in enumerate(images):
        position = _POSITIONS[i].clone().requires_grad_()
        weights = blend_weights(position, _POSITIONS[:count])
        assert torch.equal(weights.detach(), torch.eye(count, dtype=torch.float64)[i])
        assert not torch.autograd.grad(weights[i], position)[0].any()
        mixed, here = blend(images, weights.detach()), image.alpha > 0
        assert here.any() and torch.equal(mixed.depth[here], image.depth[here])
        assert torch.equal(mixed.alpha, largest), "the other views only make the image opaque"
        expected = image.color * (largest / image.alpha)
        assert torch.allclose(mixed.color[:, here], expected[:, here], rtol=1e-12)


@_COUNTS
def test_inputs_in_one_place_have_equal_weights(count):
    """The official code divides 0 by 0 here."""
    position = _points((0.3, -0.2, 0.1))[0].requires_grad_()
    positions = position.detach().expand(count, 3).clone().requires_grad_()
    weights = blend_weights(position, positions)
    assert torch.equal(weights.detach(), torch.full((count,), 1 / count, dtype=torch.float64))
    assert not any(gradient.any() for gradient in torch.autograd.grad(weights[0], (position, positions)))
    assert torch.isfinite(blend(_draw(count), weights.detach()).color).all()


@_COUNTS
@pytest.mark.parametrize("distance", [1e2, 1e9, 1e150])
def test_far_outside_weights_are_positive_sum_to_one_and_converge_to_equal(count, distance):
    """The official code's 1 - d / sum d has the sum number of views - 1."""
    position = _points((distance, 0.3 * distance, 0))[0].requires_grad_()
    weights = blend_weights(position, _POSITIONS[:count])
    assert (weights > 0).all() and float(weights.detach().sum()) == pytest.approx(1, abs=1e-12)
    assert (weights - 1 / count).abs().max() < 3 / distance + 1e-12
    assert torch.isfinite(torch.autograd.grad(weights[0], position)[0]).all()


def test_a_hole_in_one_view_is_filled_by_the_other_with_finite_gradients():
    near, other = _draw(2)
    hole = (near.alpha == 0) & (other.alpha > 0)
    assert hole.any()
    fields = [
        [getattr(p, name).clone().requires_grad_() for name in ("color", "alpha", "depth")] for p in (near, other)
    ]
    for values in ((0.9, 0.1), (1.0, 0.0)):
        weights = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        mixed = blend([Rendering(*field) for field in fields], weights)
        for name in ("color", "alpha", "depth"):
            assert torch.allclose(getattr(mixed, name)[..., hole], getattr(other, name)[..., hole], rtol=1e-6)
        (mixed.color.sum() + mixed.alpha.sum() + mixed.depth.sum()).backward()
        assert all(torch.isfinite(leaf.grad).all() for leaf in (weights, *fields[0], *fields[1]))


def test_where_all_views_are_empty_there_is_background_without_gradient():
    background = (0.125, 0.25, 0.5)
    images = _draw(3, background)
    empty = torch.stack([image.alpha for image in images]).amax(dim=0) == 0
    weights = torch.tensor((0.2, 0.3, 0.5), dtype=torch.float64, requires_grad=True)
    mixed = blend(images, weights)
    expected = torch.tensor(background, dtype=torch.float64)[:, None]
    assert empty.any() and torch.allclose(mixed.color.detach()[:, empty], expected, rtol=1e-6)
    assert not mixed.alpha[empty].any() and not mixed.depth[empty].any()
    (mixed.alpha[empty].sum() + mixed.depth[empty].sum()).backward()
    assert not weights.grad.any()
