"""A running mean of the weights, which makes smoother pictures than the weights of any one step."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class RunningMean:
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
