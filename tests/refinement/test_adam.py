"""Adam of a refinement."""

import math

import torch

from pansplat.refinement.adam import ParameterGroup

BETAS = (0.9, 0.99)


def test_steps_equal_those_of_torch_optim_and_skip_parameters_without_gradient() -> None:
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(5, 3, generator=generator), torch.randn(7, generator=generator), torch.randn(2)]
    ours, theirs = ([value.clone().requires_grad_() for value in start] for _ in range(2))
    group = ParameterGroup(ours, rate=0.1, betas=BETAS, epsilon=1e-8)
    optimizer = torch.optim.Adam(theirs, lr=0.1, betas=BETAS, eps=1e-8)
    for step in range(5):
        factor = 1 / (step + 1)
        group.clear_gradients()
        optimizer.zero_grad()
        for parameters in (ours, theirs):
            (parameters[0].sin().sum() + step * parameters[1].square().sum()).backward()
        optimizer.param_groups[0]["lr"] = 0.1 * factor
        group.step(factor)
        optimizer.step()
    for got, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(got, expected, atol=1e-6, rtol=1e-5)
    assert torch.equal(ours[2], start[2])


def test_gradients_that_are_not_finite_do_not_move_parameters() -> None:
    parameter = torch.zeros(3, requires_grad=True)
    group = ParameterGroup([parameter], rate=0.1, betas=BETAS)
    parameter.grad = torch.tensor([math.nan, math.inf, 1.0])
    group.clean_gradients()
    group.step(1.0)
    moved = parameter.tolist()
    assert moved[:2] == [0, 0] and moved[2] < 0


def test_rows_that_do_not_move_keep_their_values_and_averages() -> None:
    """A row that moves in every second step moves as if the other steps had not been."""
    start = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    whole, half = start.clone().requires_grad_(), start[:2].clone().requires_grad_()
    groups = [ParameterGroup([value], rate=0.1, epsilon=1e-8, betas=BETAS) for value in (whole, half)]
    for step in range(6):
        whole.grad = torch.zeros(4, 3)
        chosen = torch.tensor((step % 2 == 0,) * 2 + (step % 2 == 1,) * 2)
        whole.grad[chosen] = whole.detach()[chosen].sin()
        before = whole.detach().clone()
        groups[0].step(1.0, [chosen])
        assert torch.equal(whole[~chosen], before[~chosen]) and not torch.equal(whole[chosen], before[chosen])
        if step % 2 == 0:
            half.grad = half.detach().sin()
            groups[1].step(1.0)
    mean, square, _ = groups[0]._states[whole]
    torch.testing.assert_close(mean[:2], groups[1]._states[half][0], atol=1e-2, rtol=0.1)
    assert bool((square > 0).all())
