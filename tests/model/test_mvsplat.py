"""The MVSplat baseline: agreement with the official code, symmetries of the fixed network."""

from collections.abc import Callable

import pytest
import torch

from pansplat.errors import InputError
from pansplat.model.feature_pyramid import TransformerConfig
from pansplat.model.heads import AdapterConfig
from pansplat.model.mvsplat import MVSplat, MVSplatConfig

SMALL = MVSplatConfig(
    channels=16,
    candidates=8,
    width=32,
    refine_width=32,
    transformer=TransformerConfig(channels=16, blocks=2),
    adapter=AdapterConfig(degree=1),
)


@pytest.fixture(scope="module")
def small(randomize: Callable[[torch.nn.Module], torch.nn.Module]) -> MVSplat:
    return randomize(MVSplat(SMALL, "fixed"))


def test_rolling_by_half_a_turn_rolls_the_prediction(small: MVSplat, make_inputs) -> None:
    images, poses, near, far = make_inputs(32)
    half_turn = torch.diag(torch.tensor((-1.0, 1.0, -1.0, 1.0), dtype=torch.float64))
    with torch.no_grad():
        before = small(images, poses, near, far)
        after = small(images.roll(32, dims=-1), poses @ half_turn, near, far)
    rolled = before.depths.inverse_depth[0].roll(8, dims=-1)
    assert torch.allclose(after.depths.inverse_depth[0], rolled, rtol=1e-8)
    means = before.gaussians[0].means.reshape(2, 32, 64, 3).roll(32, dims=2)
    assert torch.allclose(after.gaussians[0].means.reshape(2, 32, 64, 3), means, atol=1e-8)


def test_batch_items_are_independent(small: MVSplat, make_inputs) -> None:
    inputs = make_inputs(height=32, batch=2, views=3)
    with torch.no_grad():
        together = small(*inputs).gaussians
        apart = [small(*(tensor[n : n + 1] for tensor in inputs)).gaussians[0] for n in range(2)]
    for ours, alone in zip(together, apart, strict=True):
        assert torch.equal(ours.views, torch.arange(3, dtype=torch.uint8).repeat_interleave(32 * 64))
        assert torch.allclose(ours.means, alone.means, atol=1e-9)
        assert torch.allclose(ours.opacities, alone.opacities, atol=1e-9)


def test_gradients_reach_every_weight(small: MVSplat, make_inputs) -> None:
    gaussians = small(*make_inputs(32)).gaussians[0]
    loss = gaussians.means.square().mean() + gaussians.opacities.mean() + gaussians.harmonics.square().mean()
    loss = loss + gaussians.scales.mean() + gaussians.quats.sum(dim=0).square().mean()
    gradients = torch.autograd.grad(loss, list(small.parameters()))
    names = [name for name, _ in small.named_parameters()]
    without = [name for name, gradient in zip(names, gradients, strict=True) if not gradient.abs().max() > 0]
    assert not without


def test_unusable_views_and_sizes_are_refused(make_inputs) -> None:
    network = MVSplat(SMALL, "official").double()
    with pytest.raises(InputError, match="exactly two views"):
        network(*make_inputs(views=3))
    with pytest.raises(InputError, match="a height and a width that 16 divides, got 40x80"):
        network(*make_inputs(height=40))
