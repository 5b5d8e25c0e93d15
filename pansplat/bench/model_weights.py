"""Weights for measuring a network where no trained ones are at hand: random, but nothing in it stands still."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.model.weights import pack_weights, save_weights

# Of weights of unit gain: what follows a rectifier needs more to keep its size, logits of depth need less, so that
# a depth is the mean of several candidates, as it is after training.
_RECTIFIED, _LOGITS = math.sqrt(2), 0.2


def save_random_weights(path: Path, config: PanSplatConfig | None = None, seed: int = 0) -> None:
    """Write a file of weights for `load_model`; the same numbers for the same seed."""
    config = config or PanSplatConfig()
    with torch.device("meta"):
        shapes = PanSplat(config).state_dict()
    generator = torch.Generator().manual_seed(seed)
    tensors = {name: _random(name, shape, generator) for name, shape in shapes.items()}
    save_weights(path, pack_weights("pansplat", config, tensors, compat="fixed"))


def _random(name: str, like: Tensor, generator: torch.Generator) -> Tensor:
    if not like.is_floating_point():
        return torch.full(like.shape, 100, dtype=like.dtype)
    if like.dim() == 0:
        return torch.full((), 10.0)  # the monocular network's largest depth, metres
    if name.endswith("running_var") or (name.endswith("weight") and like.dim() == 1):
        return 0.5 + torch.rand(like.shape, generator=generator)
    numbers = torch.randn(like.shape, generator=generator)
    if like.dim() == 1:
        return 0.1 * numbers
    return _gain(name) * numbers / math.sqrt(like[0].numel())


def _gain(name: str) -> float:
    if name.startswith(("features.encoder", "features.decoder", "mono_depth.")):
        return _RECTIFIED
    is_logits = name.startswith("cost_volume.levels") and name.endswith(".head.2.weight")
    return _LOGITS if is_logits else 1.0
