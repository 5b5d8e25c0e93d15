"""LPIPS of a picture band by band is LPIPS of the picture."""

from __future__ import annotations

import pytest
import torch

from pansplat.evaluation import lpips
from pansplat.evaluation.lpips import Lpips


@pytest.fixture(scope="module")
def vgg() -> Lpips:
    """VGG with random weights, float64."""
    torch.manual_seed(0)
    made = Lpips("vgg").double()
    for head in made.heads:
        head.uniform_()
    return made


def measured(metric: Lpips, size: tuple[int, int], weighed: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """The distances of two pictures each, and their gradient."""
    generator = torch.Generator().manual_seed(1)
    shape = (2, 3, *size)
    a, b = (torch.rand(shape, generator=generator, dtype=torch.float64) for _ in range(2))
    weights = torch.rand(2, *size, generator=generator, dtype=torch.float64) if weighed else None
    a.requires_grad_()
    found = metric(a, b, weights)
    found.sum().backward()
    assert a.grad is not None
    return found.detach(), a.grad


@pytest.mark.parametrize(
    ("size", "pixels", "weighed"),
    [((64, 48), 1000, False), ((67, 33), 300, True), ((70, 40), 600, False), ((35, 32), 1, True)],
)
def test_bands_change_neither_distances_nor_gradients(
    size: tuple[int, int], pixels: int, weighed: bool, vgg: Lpips, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted, wanted_gradient = measured(vgg, size, weighed)
    monkeypatch.setattr(lpips, "_WHOLE", 0)
    monkeypatch.setattr(lpips, "_BAND", pixels)
    found, gradient = measured(vgg, size, weighed)
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(gradient, wanted_gradient, rtol=1e-9, atol=1e-9 * float(wanted_gradient.abs().max()))
    assert float(wanted.min()) > 0.01


def test_bands_keep_a_band_of_activations_at_a_time(vgg: Lpips, monkeypatch: pytest.MonkeyPatch) -> None:
    def largest() -> int:
        """Numbers that are kept for the backward pass before it begins."""
        kept: dict[int, int] = {}

        def keep(tensor: torch.Tensor) -> torch.Tensor:
            kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes() // 8
            return tensor

        a = torch.rand(1, 3, 128, 64, dtype=torch.float64, requires_grad=True)
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            vgg(a, a.detach().flip(2))
        return sum(kept.values())

    whole = largest()
    monkeypatch.setattr(lpips, "_WHOLE", 0)
    monkeypatch.setattr(lpips, "_BAND", 16 * 64)
    assert largest() < whole / 3
