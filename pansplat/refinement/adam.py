"""Adam for a refinement: torch's fused kernel without torch.optim, whose first use imports the compiler for a second.

Source: Kingma and Ba, "Adam: a method for stochastic optimization", 2015.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.optim.adam import adam

_MIN_EPSILON = 1e-15


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
        """Forget the gradients."""
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
            factor: of the step size.
            rows: mask of the rows of each parameter that move, with their averages. Else rows that have a gradient in
                few steps would go on along each for many. By default all.
        """
        moved = [parameter for parameter in self.parameters if parameter.grad is not None]
        for parameter in moved:
            if parameter not in self._states:
                count = torch.zeros((), dtype=torch.float32, device=parameter.device)
                self._states[parameter] = torch.zeros_like(parameter), torch.zeros_like(parameter), count
        tensors = [(parameter.detach(), parameter.grad, *self._states[parameter][:2]) for parameter in moved]
        if rows:
            indices = {parameter: mask.nonzero()[:, 0] for parameter, mask in zip(self.parameters, rows, strict=True)}
            tensors = [
                [tensor[indices[parameter]] for tensor in values if tensor is not None]
                for parameter, values in zip(moved, tensors, strict=True)
            ]
        values, gradients, means, squares = ([row[k] for row in tensors] for k in range(4))
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
        for parameter, value, mean, square in zip(moved, values, means, squares, strict=True) if rows else ():
            for whole, part in zip(
                (parameter.detach(), *self._states[parameter][:2]), (value, mean, square), strict=True
            ):
                whole[indices[parameter]] = part
