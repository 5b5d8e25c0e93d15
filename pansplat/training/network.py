"""The trained network: its configuration, initial weights, and trainable parts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import nn

from pansplat.errors import InputError
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import AdapterConfig, AuxiliaryHeads, HeadsConfig
from pansplat.model.network import read_weights, require_precision
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.networks.weights import pack_weights, require_shapes, save_weights
from pansplat.training.config import NetworkConfig, NetworkShape


def network_config(shape: NetworkShape) -> PanSplatConfig:
    """Configuration of the paper's network, or of a smaller one with the same stages but no monocular network."""
    if shape == "paper":
        return PanSplatConfig()
    if shape == "small":
        return _small_config(channels=(16, 32, 48, 64), candidates=(64, 32, 16), width=32, blocks=4, degree=1)
    return _small_config(channels=(8, 16, 24, 32), candidates=(32, 16, 16), width=32, blocks=2, degree=0)


def _small_config(
    *, channels: tuple[int, int, int, int], candidates: tuple[int, int, int], width: int, blocks: int, degree: int
) -> PanSplatConfig:
    levels = tuple(SweepLevel(3 - i, channels[3 - i], count, width) for i, count in enumerate(candidates))
    return PanSplatConfig(
        features=FeaturePyramidConfig(channels, TransformerConfig(channels[-1], blocks)),
        cost_volume=CostVolumeConfig(mono_channels=0, levels=levels),
        heads=HeadsConfig(
            feature_channels=channels[::-1], candidates=candidates[-1], layers=3, adapter=AdapterConfig(degree=degree)
        ),
    )


def build_network(config: NetworkConfig, seed: int) -> PanSplat:
    """The network with the weights of `config.init`, or with random weights from the seed; frozen parts are frozen."""
    require_precision(config.precision)
    initial = None if config.init is None else read_weights(config.init)
    torch.manual_seed(seed)
    network = PanSplat(
        network_config(config.shape),
        config.compat,
        precision=config.precision,
        attention_precision=config.attention_precision,
    )
    if initial is not None:
        require_shapes(initial.tensors, network.state_dict(), config.init)
        network.load_state_dict(initial.tensors, strict=True)
    elif network.mono_depth is not None:
        raise InputError(
            "--network.init: needed weights of the monocular network, which is not trained, got none; give an official "
            "checkpoint or a file of `pansplat convert`, or train --network.shape small, which has none."
        )
    freeze(network, config.frozen)
    return network


def write_weights(path: Path, network: PanSplat, state: dict[str, torch.Tensor] | None = None) -> None:
    """Write the network's weights, or another state of it, as a .safetensors for `--model`."""
    tensors = dict(network.state_dict() if state is None else state)
    save_weights(path, pack_weights(network.model, network.config, tensors, compat=network.compat))


def freeze(network: nn.Module, parts: tuple[str, ...]) -> None:
    """Make parts of the network not trainable."""
    for part in parts:
        getattr(network, part).requires_grad_(False)


def set_training_mode(network: nn.Module, parts: tuple[str, ...]) -> None:
    """Put the network in training mode, but `parts` in eval mode, so that their normalisation statistics do not change.

    The official code updates the statistics of frozen parts (docs/official.md, section 11).
    """
    network.train()
    for part in parts:
        getattr(network, part).eval()


def matching_is_trainable(network: nn.Module) -> bool:
    """Whether any parameter before the heads is trainable."""
    return any(p.requires_grad for name, p in network.named_parameters() if not name.startswith("heads."))


def trainable_parameters(*modules: nn.Module | None) -> Iterator[nn.Parameter]:
    """The trainable parameters of modules."""
    for module in modules:
        if module is not None:
            yield from (p for p in module.parameters() if p.requires_grad)


def build_auxiliary_heads(network: PanSplat) -> AuxiliaryHeads:
    """Randomly initialised heads that predict Gaussians from each level of the cost volume alone; for training only."""
    heads = network.config.heads
    swept = network.config.cost_volume.levels
    config = HeadsConfig(
        depth="swept",
        layers=2,
        feature_channels=tuple(level.channels for level in swept),
        candidates=heads.candidates,
        adapter=heads.adapter,
    )
    return AuxiliaryHeads(config, network.compat)
