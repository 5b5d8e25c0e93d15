"""One of three processes: a few lessons of its own, and what gradients it has after each."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor, nn

from pansplat.training.distributed import ProcessGroup, data_parallel, no_sync


class Lessons(nn.Module):
    """A chain of layers, and one that nothing uses."""

    def __init__(self) -> None:
        super().__init__()
        self.chain = nn.Sequential(*(nn.Linear(50, 50) for _ in range(4)))
        self.idle = nn.Linear(3, 3)

    def forward(self, given: Tensor, early: bool) -> tuple[Tensor, str]:
        """The loss; or the loss without a graph, its gradients made already, in two parts."""
        loss = self.chain(given).square().mean()
        if not early:
            return loss, "by backward()"
        for part in self.chain(given).square().mean(1):
            (part / len(given)).backward(retain_graph=True)
        return loss.detach(), "while called"


def main(folder: Path) -> None:
    processes = ProcessGroup()
    processes.initialize(torch.device("cpu"))
    torch.manual_seed(0)
    lessons = Lessons()
    shared = data_parallel(lessons, processes)
    given = torch.randn(3, 2, 50, generator=torch.Generator().manual_seed(1))
    own = given[processes.rank]
    for step, early in enumerate((False, False, True)):
        shared.zero_grad()
        loss, _ = shared(own, early)
        loss.backward()
        _write(lessons, folder / f"{step}_{processes.rank}.pt")
    shared.zero_grad()
    with no_sync(shared):
        shared(own, False)[0].backward()
    _write(lessons, folder / f"apart_{processes.rank}.pt")
    if processes.rank == 0:
        lessons.zero_grad()
        lessons(given.flatten(0, 1), False)[0].backward()
        torch.save({name: p.grad for name, p in lessons.chain.named_parameters()}, folder / "joint.pt")
    processes.destroy()


def _write(lessons: Lessons, path: Path) -> None:
    idle = {f"idle.{name}": p.grad for name, p in lessons.idle.named_parameters()}
    torch.save({name: p.grad for name, p in lessons.chain.named_parameters()} | idle, path)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
