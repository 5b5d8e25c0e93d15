"""Programs of test_distributed.py: each of several processes writes its gradients to files, and trains.

Usage: distributed_programs.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

from pansplat.inputs.views import collate
from pansplat.model.pansplat import PanSplat
from pansplat.training import network as network_module
from pansplat.training import trainer as trainer_module
from pansplat.training.__main__ import run
from pansplat.training.config import MemoryConfig, TrainConfig
from pansplat.training.distributed import ProcessGroup, convert_sync_batch_norm, data_parallel
from pansplat.training.losses import LossWeights
from pansplat.training.network import set_training_mode
from pansplat.training.step import TrainingStep, accumulate_gradients

sys.path.insert(0, str(Path(__file__).parent))
from conftest import PaintedSphere, micro_config

METHODS = ("plain", "two-step")
"""Of backpropagation."""
ROUNDS = 2
"""Batches per step: the processes exchange the gradients of the last one only."""
PROCESSES = 3


def split_batches(processes: ProcessGroup) -> dict[str, Tensor]:
    """Gradients and statistics of a network for batches of three samples, which the processes share."""
    torch.manual_seed(3)
    network = PanSplat(micro_config(), "fixed").double()
    convert_sync_batch_norm(network, processes)
    set_training_mode(network, ())
    step = TrainingStep(network, None, None, LossWeights(), MemoryConfig())
    wrapped = data_parallel(step, processes)
    found = {}
    for method in METHODS:
        step.memory = MemoryConfig(method, 1 if method == "plain" else 2, "original")
        step.zero_grad()
        indices = [range(PROCESSES * n, PROCESSES * (n + 1)) for n in range(ROUNDS)]
        own = indices if processes.count == 1 else [part[processes.rank : processes.rank + 1] for part in indices]
        batches = [collate([PaintedSphere().sample(n, 32, 0) for n in part]) for part in own]
        accumulate_gradients(wrapped, batches)
        found |= {f"{method} {name}": p.grad for name, p in network.named_parameters() if p.grad is not None}
    return found | {name: tensor for name, tensor in network.named_buffers() if tensor.is_floating_point()}


def train(folder: Path) -> int:
    """Run `pansplat-train` for one step of a micro network; the exit status."""
    network_module.network_config = lambda shape: micro_config()
    trainer_module.load_sources = lambda data, height, seed: (PaintedSphere(), PaintedSphere(2))
    TrainConfig.check = lambda self: None  # it refuses the height
    settings = {"heights": 32, "perceptual": "structure", "device": "cpu", "data.workers": 0, "optimizer.steps": 1}
    settings |= {"optimizer.batch-size": 1, "validation.every": 0}
    options = [text for name, value in settings.items() for text in (f"--{name}", str(value))]
    return run(["tiny", "--out", str(folder / "run"), *options])


if __name__ == "__main__":
    folder, group = Path(sys.argv[1]), ProcessGroup()
    group.initialize(torch.device("cpu"))
    torch.save(split_batches(group), folder / f"split_{group.rank}.pt")
    status = train(folder)  # it joins the group that exists
    group.destroy()
    sys.exit(status)
