"""Learning-rate schedule and moving average of the weights."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

_START = 25.0  # how many times smaller than the peak the first rate is
_END = 1e4  # how many times smaller than the first the last rate is


def one_cycle_rate(step: int, total: int, peak: float, *, rise: float = 0.01) -> float:
    """The rate of a step, from peak / 25 up to the peak and down to peak / 250,000; the last beyond the end.

    Args:
        step: counted from 0.
        total: steps of the cycle; the original takes ten more than it trains.
        rise: part of the steps in which the rate rises.
    """
    start, last = peak / _START, total - 1
    top = rise * total - 1
    if step < top:
        return _cosine(start, peak, step / top)
    return _cosine(peak, start / _END, min(1.0, (step - max(top, 0.0)) / max(1e-9, last - max(top, 0.0))))


def _cosine(first: float, last: float, part: float) -> float:
    return last + (first - last) * (1 + math.cos(math.pi * part)) / 2


class ExponentialMovingAverage:
    """Exponential moving average of a network's state.

    Args:
        network: whose state is followed; its state now is the first mean.
        decay: part of the mean that a step keeps, once many steps were taken. Early steps keep less:
            (1 + step) / (10 + step).
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.decay = decay
        self.state = {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}

    @torch.no_grad()
    def update(self, network: nn.Module, step: int) -> None:
        """Take in the state after a step, counted from 0; what is no floating number is copied."""
        share = 1 - min(self.decay, (1 + step) / (10 + step))
        for name, tensor in network.state_dict().items():
            mean = self.state[name]
            if mean.is_floating_point():
                mean.lerp_(tensor.to(mean), share)
            else:
                mean.copy_(tensor)

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from a state that was saved."""
        for name, mean in self.state.items():
            mean.copy_(state[name])
