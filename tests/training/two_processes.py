"""One of two processes: gradients of its half of a batch, averaged with the other's, written to a file."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from pansplat.data.sample import collate
from pansplat.training.config import MemoryConfig
from pansplat.training.distributed import Processes, share_statistics
from pansplat.training.losses import LossWeights
from pansplat.training.network import learn
from pansplat.training.step import Teacher

sys.path.insert(0, str(Path(__file__).parent))
from conftest import PaintedSphere, micro_config

from pansplat.model.pansplat import PanSplat


def main(folder: Path, dtype: torch.dtype = torch.float64) -> None:
    processes = Processes()
    processes.join(torch.device("cpu"))
    torch.manual_seed(3)
    network = PanSplat(micro_config(), "fixed").to(dtype)
    share_statistics(network, processes)
    learn(network, ())
    own = [0, 1] if processes.count == 1 else [processes.rank]
    batch = collate([PaintedSphere().sample(n, 32, 0) for n in own])
    Teacher(network, None, None, LossWeights(), MemoryConfig()).backpropagate(batch)
    parameters = list(network.parameters())
    processes.average_gradients(parameters)
    found = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
    buffers = {name: tensor for name, tensor in network.named_buffers() if tensor.is_floating_point()}
    torch.save({**found, **buffers}, folder / f"{processes.count}_{processes.rank}.pt")
    processes.leave()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
