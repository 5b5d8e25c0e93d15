"""What a step's batches teach."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor, nn

from pansplat.training import step
from pansplat.training.step import LOSS_TERMS, accumulate_gradients


class OneWeight(nn.Module):
    """A loss of weight times batch."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))

    def forward(self, batch: float, share: float) -> tuple[Tensor, dict[str, float]]:
        loss = self.weight * batch
        return share * loss, {**dict.fromkeys(LOSS_TERMS, 0.0), "loss": loss.item()}


def test_all_batches_but_the_last_are_kept_apart(unchecked: None, monkeypatch: pytest.MonkeyPatch) -> None:
    inside: list[bool] = []
    teacher = OneWeight()

    @contextmanager
    def apart(lessons: nn.Module) -> Iterator[None]:
        assert lessons is teacher
        hook = teacher.weight.register_hook(lambda _: inside.append(True))
        yield
        hook.remove()

    monkeypatch.setattr(step, "no_sync", apart)
    told = accumulate_gradients(teacher, [1.0, 2.0, 6.0])
    assert len(inside) == 2
    assert told["loss"] == pytest.approx(3.0)
    assert teacher.weight.grad is not None and float(teacher.weight.grad) == pytest.approx(3.0)
