"""Learning-rate schedule, and exponential moving average of the weights."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

_START_DIVISOR = 25.0  # peak rate over first rate
_END_DIVISOR = 1e4  # first rate over last rate
_RISE = 0.01  # fraction of the steps during which the rate rises


def one_cycle_rate(step: int, total: int, peak: float) -> float:
    """Learning rate of a step: from peak / 25 up to the peak and down to peak / 250,000, along two cosines.

    Source: docs/official.md, section 11; Smith and Topin, https://arxiv.org/abs/1708.07120 (one cycle).

    Args:
        step: counted from 0; later steps than the last have the last rate.
        total: number of steps of the cycle; the official code uses ten more than it trains.
    """
    start, last = peak / _START_DIVISOR, total - 1
    top = _RISE * total - 1
    if step < top:
        return _cosine(start, peak, step / top)
    return _cosine(peak, start / _END_DIVISOR, min(1.0, (step - max(top, 0.0)) / max(1e-9, last - max(top, 0.0))))


def _cosine(first: float, last: float, fraction: float) -> float:
    return last + (first - last) * (1 + math.cos(math.pi * fraction)) / 2


class ExponentialMovingAverage:
    """Exponential moving average of a network's state.

    Args:
        network: its current state is the first average.
        decay: fraction of the average that a step keeps; early steps keep less, (1 + step) / (10 + step).
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.decay = decay
        self.state = {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}

    @torch.no_grad()
    def update(self, network: nn.Module, step: int) -> None:
        """Add the state after a step, counted from 0. Integer tensors are copied."""
        weight = 1 - min(self.decay, (1 + step) / (10 + step))
        for name, tensor in network.state_dict().items():
            average = self.state[name]
            if average.is_floating_point():
                average.lerp_(tensor.to(average), weight)
            else:
                average.copy_(tensor)

    def load(self, state: dict[str, Tensor]) -> None:
        """Restore a saved state."""
        for name, average in self.state.items():
            if state[name].shape != average.shape:
                raise ValueError(f"{name} has the shape {tuple(state[name].shape)}, not {tuple(average.shape)}")
            average.copy_(state[name])
