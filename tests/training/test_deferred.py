"""Deferred gradients are the plain path's."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from pansplat.data.views import Batch
from pansplat.model.feature_pyramid import TransformerConfig
from pansplat.model.heads import AdapterConfig, AuxiliaryHeads
from pansplat.model.mvsplat import MVSplat, MVSplatConfig
from pansplat.model.pansplat import PanSplat
from pansplat.training.config import MemoryConfig
from pansplat.training.losses import LossWeights, Structure
from pansplat.training.network import build_auxiliary_heads, freeze, set_training_mode
from pansplat.training.step import TrainingStep, accumulate_gradients


def gradients(
    network: PanSplat | MVSplat, memory: MemoryConfig, *batches: Batch, auxiliary: AuxiliaryHeads | None = None
) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
    """Of every parameter that gets one, and the parts of the loss."""
    network.zero_grad()
    told = accumulate_gradients(TrainingStep(network, auxiliary, Structure(), LossWeights(), memory), batches)
    return {name: p.grad.clone() for name, p in network.named_parameters() if p.grad is not None}, told


def assert_equal_gradients(found: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor]) -> None:
    assert found.keys() == wanted.keys()
    for name, gradient in wanted.items():
        scale = float(gradient.abs().max())
        torch.testing.assert_close(found[name], gradient, rtol=1e-6, atol=1e-6 * scale + 1e-14, msg=name)


@pytest.mark.parametrize("style", ["panorama", "cubemap", "original"])
@pytest.mark.parametrize("method", ["one-step", "two-step"])
def test_deferred_gradients_equal_plain_ones(
    style: str, method: str, micro: Callable[..., PanSplat], make_batch: Callable[..., Batch]
) -> None:
    network, batch = micro(), make_batch()
    set_training_mode(network, ())
    wanted, loss = gradients(network, MemoryConfig("plain", 1, style), batch)
    found, deferred_loss = gradients(network, MemoryConfig(method, 2, style), batch)
    assert loss["depth"] > 0 and loss["square"] > 0
    assert deferred_loss == pytest.approx(loss, rel=1e-9)
    assert any(name.startswith("features.") for name in wanted)
    assert_equal_gradients(found, wanted)


def test_deferred_gradients_equal_plain_ones_when_views_are_mixed(
    micro: Callable[..., PanSplat], make_batch: Callable[..., Batch]
) -> None:
    network, batch = micro(), make_batch()
    set_training_mode(network, ())
    wanted, _ = gradients(network, MemoryConfig("plain", 1, "cubemap", "by_view"), batch)
    found, _ = gradients(network, MemoryConfig("two-step", 2, "cubemap", "by_view"), batch)
    assert_equal_gradients(found, wanted)


def test_deferred_gradients_equal_plain_ones_with_auxiliary_heads(
    micro: Callable[..., PanSplat], make_batch: Callable[..., Batch]
) -> None:
    network, batch = micro(), make_batch()
    set_training_mode(network, ())
    extra = build_auxiliary_heads(network).double()
    wanted, plain = gradients(network, MemoryConfig("plain"), batch, auxiliary=extra)
    own = [p.grad.clone() for p in extra.parameters() if p.grad is not None]
    extra.zero_grad()
    found, _ = gradients(network, MemoryConfig("two-step", 2), batch, auxiliary=extra)
    assert plain["auxiliary"] > 0
    assert_equal_gradients(found, wanted)
    for parameter, gradient in zip(extra.parameters(), own, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_a_frozen_part_gets_no_gradient_and_keeps_its_statistics(
    micro: Callable[..., PanSplat], make_batch: Callable[..., Batch]
) -> None:
    network, batch, frozen = micro(), make_batch(), ("features", "cost_volume")
    freeze(network, frozen)
    set_training_mode(network, frozen)
    before = {name: tensor.clone() for name, tensor in network.features.state_dict().items()}
    wanted, _ = gradients(network, MemoryConfig("plain", 1, "cubemap"), batch)
    found, _ = gradients(network, MemoryConfig("two-step", 2, "cubemap"), batch)
    assert wanted and all(name.startswith("heads.") for name in wanted)
    assert_equal_gradients(found, wanted)
    for name, tensor in network.features.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_gradients_of_two_items_are_those_of_two_batches_of_one(
    micro: Callable[..., PanSplat], make_batch: Callable[..., Batch]
) -> None:
    network, memory = micro().eval(), MemoryConfig("two-step", 1, "cubemap")
    both, joint = gradients(network, memory, make_batch(0, 1))
    found, apart = gradients(network, memory, make_batch(0), make_batch(1))
    assert_equal_gradients(found, both)
    assert apart == pytest.approx(joint, rel=1e-9)


def test_deferred_gradients_of_the_baseline_equal_plain_ones(make_batch: Callable[..., Batch]) -> None:
    network, batch = micro_mvsplat(), make_batch(0, 1)
    wanted, loss = gradients(network, MemoryConfig("plain", 1, "cubemap"), batch)
    assert wanted.keys() == {name for name, _ in network.named_parameters()}
    for method in ("one-step", "two-step"):
        found, deferred_loss = gradients(network, MemoryConfig(method, 2, "cubemap"), batch)  # it has one tile only
        assert deferred_loss == pytest.approx(loss, rel=1e-9)
        assert_equal_gradients(found, wanted)


def micro_mvsplat() -> MVSplat:
    torch.manual_seed(3)
    transformer = TransformerConfig(8, 1)
    config = MVSplatConfig(8, candidates=4, width=32, transformer=transformer, adapter=AdapterConfig(degree=0))
    return MVSplat(config).double()
