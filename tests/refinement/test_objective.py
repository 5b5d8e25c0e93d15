"""The loss of images, and held-out blocks."""

import pytest
import torch

from pansplat.refinement.objective import Photograph, PixelWeights, image_difference


def _error(seed: int = 0) -> torch.Tensor:
    return torch.randn(3, 16, 32, generator=torch.Generator().manual_seed(seed))


def test_a_constant_error_has_no_structure() -> None:
    weights = PixelWeights.from_mask(torch.ones(16, 32, dtype=torch.bool))
    constant = torch.full((3, 16, 32), -0.25)
    assert float(image_difference(constant, weights)) == pytest.approx(0.25, abs=1e-5)
    colors = float((_error().abs().mean(0) * weights.pixels).sum())
    assert float(image_difference(_error(), weights)) > 1.1 * colors


def test_masked_pixels_have_no_gradient() -> None:
    mask = torch.rand(16, 32, generator=torch.Generator().manual_seed(2)) > 0.3
    error = _error().requires_grad_()
    image_difference(error, PixelWeights.from_mask(mask)).backward()
    assert error.grad is not None
    assert not error.grad[:, ~mask].any() and error.grad[:, mask].any()


@pytest.mark.parametrize("size", [(16, 32), (37, 74), (1, 2)])
def test_the_difference_and_its_gradient_are_those_of_mean_absolute_values(size: tuple[int, int]) -> None:
    mask = torch.rand(size, generator=torch.Generator().manual_seed(2)) > 0.3
    weights = PixelWeights.from_mask(mask)
    error = torch.randn(3, *size, generator=torch.Generator().manual_seed(4))
    error[:, : size[0] // 4] = 0.0  # the gradient of an absolute value is 0 at 0
    found, exact = error.clone().requires_grad_(), error.double().requires_grad_()
    loss = image_difference(found, weights)
    expected = (exact.abs().mean(0) * weights.pixels).sum()
    expected = expected + 0.5 * ((exact.roll(-1, 2) - exact).abs().mean(0) * weights.right).sum()
    expected = expected + 0.5 * (exact.diff(dim=1).abs().mean(0) * weights.below[:-1]).sum()
    (2 * loss).backward()
    (2 * expected).backward()
    torch.testing.assert_close(loss.double(), expected, rtol=1e-6, atol=0)
    assert found.grad is not None and exact.grad is not None
    scale = float(exact.grad.abs().max())
    torch.testing.assert_close(found.grad.double(), exact.grad, rtol=1e-5, atol=1e-7 * scale)


def test_held_out_blocks_are_disjoint_from_fitted_pixels_and_repeat_with_the_seed() -> None:
    mask = torch.ones(64, 128, dtype=torch.bool)
    mask[50:] = False
    first, again, other = (
        Photograph.split(torch.zeros(3, 64, 128), mask, 0.1, torch.Generator().manual_seed(seed)) for seed in (3, 3, 4)
    )
    assert torch.equal(first.held_out, again.held_out) and not torch.equal(first.held_out, other.held_out)
    assert not ((first.held_out > 0) & (first.fitted.pixels > 0)).any()
    assert torch.equal((first.held_out > 0) | (first.fitted.pixels > 0), mask)
    assert 0.02 < float((first.held_out > 0).float().mean()) < 0.2
