"""One of two processes: gradients of its half of each batch, averaged with the other's, written to a file."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from pansplat.data.views import Batch, collate
from pansplat.model.pansplat import PanSplat
from pansplat.training.config import MemoryConfig
from pansplat.training.distributed import ProcessGroup, convert_sync_batch_norm, data_parallel
from pansplat.training.losses import LossWeights
from pansplat.training.network import set_training_mode
from pansplat.training.step import TrainingStep, accumulate_gradients

sys.path.insert(0, str(Path(__file__).parent))
from conftest import PaintedSphere, micro_config

WAYS = (("plain", 1), ("plain", 2), ("two-step", 1), ("two-step", 2))
"""How gradients are made, and the number of batches they are gathered of."""


def main(folder: Path) -> None:
    processes = ProcessGroup()
    processes.initialize(torch.device("cpu"))
    torch.manual_seed(3)
    network = PanSplat(micro_config(), "fixed").double()
    convert_sync_batch_norm(network, processes)
    set_training_mode(network, ())
    teacher = TrainingStep(network, None, None, LossWeights(), MemoryConfig())
    lessons = data_parallel(teacher, processes)
    found = {}
    for method, rounds in WAYS:
        teacher.memory = MemoryConfig(method, 1 if method == "plain" else 2, "original")
        teacher.zero_grad()
        accumulate_gradients(lessons, [batch_of(processes, n) for n in range(rounds)])
        found |= {f"{method} {rounds} {name}": p.grad for name, p in network.named_parameters() if p.grad is not None}
    buffers = {name: tensor for name, tensor in network.named_buffers() if tensor.is_floating_point()}
    torch.save({**found, **buffers}, folder / f"{processes.count}_{processes.rank}.pt")
    processes.destroy()


def batch_of(processes: ProcessGroup, number: int) -> Batch:
    """Two paintings, or the one of them that is this process's."""
    both = [2 * number, 2 * number + 1]
    own = both if processes.count == 1 else both[processes.rank : processes.rank + 1]
    return collate([PaintedSphere().sample(n, 32, 0) for n in own])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
