"""Adam for a refinement: torch's fused kernel without torch.optim, whose first use imports the compiler for a second.

Source: Kingma and Ba, "Adam: a method for stochastic optimization", 2015.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.optim.adam import adam

_MIN_EPSILON = 1e-15  # smallest epsilon of Adam, against a division by 0


@dataclass(eq=False)
class ParameterGroup:
    """Parameters of one step size.

    Attributes:
        rate: step size at the start of a run.
        betas: decay of the averages of the gradients and of their squares.
        epsilon: added to the root of the mean square of the gradients.
    """

    parameters: Sequence[Tensor]
    rate: float
    betas: tuple[float, float]
    epsilon: float = _MIN_EPSILON
    _states: dict[Tensor, tuple[Tensor, Tensor, Tensor]] = field(default_factory=dict, init=False)

    def clear_gradients(self) -> None:
        """Set the gradients of all parameters to none, before the next step."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def clean_gradients(self) -> None:
        """Replace gradients that are not finite by 0."""
        for parameter in self.parameters:
            if parameter.grad is not None:
                torch.nan_to_num_(parameter.grad, nan=0.0, posinf=0.0, neginf=0.0)

    def replace(self, parameters: Sequence[Tensor]) -> None:
        """Continue with other parameters, whose averages begin at 0."""
        self.parameters = parameters
        self._states.clear()

    def set_damping(self, damping: float) -> None:
        """Set epsilon to `damping` times the root mean square of the gradients."""
        gradients = [parameter.grad.flatten() for parameter in self.parameters if parameter.grad is not None]
        if gradients:
            self.epsilon = max(damping * float(torch.cat(gradients).square().mean().sqrt()), _MIN_EPSILON)

    @torch.no_grad()
    def step(self, factor: float, rows: Sequence[Tensor] = ()) -> None:
        """Move the parameters that have a gradient.

        Args:
            factor: factor of the step size.
            rows: mask of the rows of each parameter that move; all by default. Other rows keep their averages, whose
                momentum would move a Gaussian for many steps after the last one that saw it.
        """
        moved = [parameter for parameter in self.parameters if parameter.grad is not None]
        for parameter in moved:
            if parameter not in self._states:
                count = torch.zeros((), dtype=torch.float32, device=parameter.device)
                self._states[parameter] = torch.zeros_like(parameter), torch.zeros_like(parameter), count
        gradients = [parameter.grad for parameter in moved if parameter.grad is not None]
        whole = [[parameter.detach(), *self._states[parameter][:2]] for parameter in moved]
        parts, indices = whole, []
        if rows:
            masks = dict(zip(self.parameters, rows, strict=True))
            indices = [masks[parameter].nonzero()[:, 0] for parameter in moved]
            gradients = [gradient[index] for gradient, index in zip(gradients, indices, strict=True)]
            parts = [[tensor[index] for tensor in each] for each, index in zip(whole, indices, strict=True)]
        values, means, squares = ([each[k] for each in parts] for k in range(3))
        adam(
            values,
            gradients,
            means,
            squares,
            [],
            [self._states[parameter][2] for parameter in moved],
            fused=True,
            amsgrad=False,
            beta1=self.betas[0],
            beta2=self.betas[1],
            lr=factor * self.rate,
            weight_decay=0.0,
            eps=self.epsilon,
            maximize=False,
        )
        for index, tensors, moved_rows in zip(indices, whole, parts, strict=False):  # without rows there are no indices
            for tensor, part in zip(tensors, moved_rows, strict=True):
                tensor[index] = part
