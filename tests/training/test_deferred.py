"""Gradients of deferred backpropagation equal those of plain backpropagation."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from pansplat.inputs.views import Batch
from pansplat.model.heads import AuxiliaryHeads
from pansplat.model.pansplat import PanSplat
from pansplat.training.config import MemoryConfig
from pansplat.training.losses import LossWeights, Structure
from pansplat.training.network import build_auxiliary_heads, freeze, set_training_mode
from pansplat.training.step import TrainingStep


def gradients(
    network: PanSplat, memory: MemoryConfig, batch: Batch, auxiliary: AuxiliaryHeads | None = None
) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
    """Gradients by parameter, and the loss terms."""
    network.zero_grad()
    terms = TrainingStep(network, auxiliary, Structure(), LossWeights(), memory)(batch)
    return {name: p.grad.clone() for name, p in network.named_parameters() if p.grad is not None}, terms


def assert_equal_gradients(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        scale = float(gradient.abs().max())
        torch.testing.assert_close(found[name], gradient, rtol=1e-6, atol=1e-6 * scale + 1e-14, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("style", "mixing"), [("cubemap", "by_view"), pytest.param("panorama", "joint", marks=pytest.mark.exhaustive)]
)
def test_deferred_gradients_equal_plain_ones(style: str, mixing: str, micro: Callable, make_batch: Callable) -> None:
    network, batch = micro(), make_batch()
    set_training_mode(network, ())
    expected, loss = gradients(network, MemoryConfig("plain", 1, style, mixing), batch)
    assert loss["depth"] > 0 and loss["square"] > 0
    assert any(name.startswith("features.") for name in expected)
    found, deferred_loss = gradients(network, MemoryConfig("two-step", 2, style, mixing), batch)
    assert deferred_loss == pytest.approx(loss, rel=1e-9)
    assert_equal_gradients(found, expected)


@pytest.mark.exhaustive
@pytest.mark.slow
def test_deferred_gradients_equal_plain_ones_with_auxiliary_heads(micro: Callable, make_batch: Callable) -> None:
    network, batch = micro(), make_batch()
    set_training_mode(network, ())
    heads = build_auxiliary_heads(network).double()
    expected, plain = gradients(network, MemoryConfig("plain"), batch, auxiliary=heads)
    own = [p.grad.clone() for p in heads.parameters() if p.grad is not None]
    heads.zero_grad()
    found, _ = gradients(network, MemoryConfig("two-step", 2), batch, auxiliary=heads)
    assert plain["auxiliary"] > 0
    assert_equal_gradients(found, expected)
    for parameter, gradient in zip(heads.parameters(), own, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


@pytest.mark.slow
def test_frozen_parts_have_no_gradient_and_keep_their_statistics(micro: Callable, make_batch: Callable) -> None:
    network, batch, frozen = micro(), make_batch(), ("features", "cost_volume")
    freeze(network, frozen)
    set_training_mode(network, frozen)
    before = {name: tensor.clone() for name, tensor in network.features.state_dict().items()}
    expected, _ = gradients(network, MemoryConfig("plain", 1, "cubemap"), batch)
    found, _ = gradients(network, MemoryConfig("two-step", 2, "cubemap"), batch)
    assert expected and all(name.startswith("heads.") for name in expected)
    assert_equal_gradients(found, expected)
    for name, tensor in network.features.state_dict().items():
        assert torch.equal(tensor, before[name]), name


@pytest.mark.exhaustive
@pytest.mark.slow
def test_gradients_of_a_batch_are_the_mean_of_those_of_its_items(micro: Callable, make_batch: Callable) -> None:
    network, memory = micro().eval(), MemoryConfig("two-step", 1, "cubemap")
    expected, joint = gradients(network, memory, make_batch(0, 1))
    (first, one), (second, other) = (gradients(network, memory, make_batch(item)) for item in (0, 1))
    assert_equal_gradients({name: (first[name] + second[name]) / 2 for name in first}, expected)
    assert {name: (one[name] + other[name]) / 2 for name in one} == pytest.approx(joint, rel=1e-9)
