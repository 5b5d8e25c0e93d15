"""Hard cases 45 to 49: blending the images of single input views, which is the same for every backend."""

import pytest
import torch

from pansplat.rendering import Rendering, blend, blend_weights, rasterize


def _positions(count: int) -> torch.Tensor:
    return torch.tensor([(0.0, 0, 0), (1.0, 0, 0), (0.2, 2.0, 0.5)], dtype=torch.float64)[:count]


def _image(scene, background=(0.0, 0.0, 0.0)) -> Rendering:
    return rasterize(scene, torch.eye(4, dtype=torch.float64), size=(16, 32), background=background)


def _images(balls, count: int) -> list[Rendering]:
    """Images of single views: each covers a part of the panorama, and none covers all of it."""
    colours = torch.eye(3, dtype=torch.float64)
    means = [(0, 0, 2.0), (0.5, 0, 2.0), (0, 0.5, 2.0)]
    return [_image(balls(means[i], 0.5, colours=colours[i])) for i in range(count)]


@pytest.mark.hard_case(45)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_at_an_input_position_only_its_view_counts_and_the_weights_have_no_gradient(count, balls):
    positions = _positions(count)
    images = _images(balls, count)
    for i in range(count):
        position = positions[i].clone().requires_grad_()
        weights = blend_weights(position, positions)
        assert torch.equal(weights.detach(), torch.eye(count, dtype=torch.float64)[i])
        (gradient,) = torch.autograd.grad(weights[i], position)
        assert not gradient.any()
        mixed = blend(images, weights.detach())
        here = images[i].alpha > 0
        assert here.any()
        # The weight is exactly 1; the other views only make the image opaque.
        assert torch.equal(mixed.depth[here], images[i].depth[here])
        largest = torch.stack([image.alpha for image in images]).amax(dim=0)
        assert torch.equal(mixed.alpha, largest)
        opaque = here & (images[i].alpha == largest)
        assert opaque.any() and torch.equal(mixed.color[:, opaque], images[i].color[:, opaque])
        expected = images[i].color * (largest / images[i].alpha)
        assert torch.allclose(mixed.color[:, here], expected[:, here], rtol=1e-12)


@pytest.mark.hard_case(46)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_inputs_in_one_place_have_equal_weights(count, balls):
    """The official code divides 0 by 0 here."""
    place = torch.tensor((0.3, -0.2, 0.1), dtype=torch.float64)
    positions = place.expand(count, 3).clone().requires_grad_()
    position = place.clone().requires_grad_()
    weights = blend_weights(position, positions)
    assert torch.equal(weights.detach(), torch.full((count,), 1 / count, dtype=torch.float64))
    gradients = torch.autograd.grad(weights[0], (position, positions))
    assert not any(gradient.any() for gradient in gradients)
    assert torch.isfinite(blend(_images(balls, count), weights.detach()).color).all()


@pytest.mark.hard_case(47)
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("distance", [1e2, 1e9, 1e150])
def test_far_outside_weights_are_positive_sum_to_one_and_converge_to_equal(count, distance):
    """The official code's 1 - d / sum d has the sum number of views - 1."""
    position = torch.tensor((distance, 0.3 * distance, 0), dtype=torch.float64, requires_grad=True)
    weights = blend_weights(position, _positions(count))
    assert (weights > 0).all() and float(weights.detach().sum()) == pytest.approx(1, abs=1e-12)
    assert (weights - 1 / count).abs().max() < 3 / distance + 1e-12
    (gradient,) = torch.autograd.grad(weights[0], position)
    assert torch.isfinite(gradient).all()


@pytest.mark.hard_case(48)
def test_a_hole_in_one_view_is_filled_by_the_other_with_finite_gradients(balls):
    near, other = _images(balls, 2)
    hole = (near.alpha == 0) & (other.alpha > 0)
    assert hole.any()
    for weights in ((0.9, 0.1), (1.0, 0.0)):
        mixed = blend([near, other], torch.tensor(weights, dtype=torch.float64))
        for name in ("color", "alpha", "depth"):
            assert torch.allclose(getattr(mixed, name)[..., hole], getattr(other, name)[..., hole], rtol=1e-6)
    fields = [
        [getattr(p, name).clone().requires_grad_() for name in ("color", "alpha", "depth")] for p in (near, other)
    ]
    weights = torch.tensor((0.9, 0.1), dtype=torch.float64, requires_grad=True)
    mixed = blend([Rendering(*field) for field in fields], weights)
    (mixed.color.sum() + mixed.alpha.sum() + mixed.depth.sum()).backward()
    assert all(torch.isfinite(leaf.grad).all() for field in fields for leaf in field)
    assert torch.isfinite(weights.grad).all()


@pytest.mark.hard_case(49)
def test_where_all_views_are_empty_there_is_background_without_gradient(balls):
    scene = balls((0, 0, 2.0), 0.3)
    background = (0.125, 0.25, 0.5)
    images = [_image(scene, background) for _ in range(3)]
    empty = images[0].alpha == 0
    assert empty.any()
    weights = torch.tensor((0.2, 0.3, 0.5), dtype=torch.float64, requires_grad=True)
    mixed = blend(images, weights)
    expected = torch.tensor(background, dtype=torch.float64)[:, None]
    assert torch.allclose(mixed.color.detach()[:, empty], expected, rtol=1e-6)
    assert not mixed.alpha[empty].any() and not mixed.depth[empty].any()
    (mixed.alpha[empty].sum() + mixed.depth[empty].sum()).backward()
    assert not weights.grad.any()
