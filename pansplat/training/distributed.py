"""Distributed training: averaged gradients (DistributedDataParallel) and synchronised batch normalisation.

N processes compute the gradients that one process computes for the joint batch.
"""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from datetime import timedelta
from typing import Any

import torch
import torch.distributed
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from pansplat.errors import InputError

_TIMEOUT = timedelta(hours=2)  # the other processes wait while the first one validates


def _read_environment(name: str, default: int | None) -> int:
    """A number that torchrun puts into the environment; without a default it must exist."""
    text = os.environ.get(name, "" if default is None else str(default))
    try:
        return int(text)
    except ValueError:
        raise InputError(
            f"needed a number in the environment variable {name}, got {text!r}; start the processes with torchrun."
        ) from None


class ProcessGroup:
    """The processes of a training run, as torchrun describes them; a single process without torchrun.

    Attributes:
        rank, count: index of this process, and number of processes.
        local_rank: index of this process on its machine.
    """

    def __init__(self) -> None:
        self.count = _read_environment("WORLD_SIZE", 1)
        self.rank = _read_environment("RANK", 0 if self.count == 1 else None)
        self.local_rank = _read_environment("LOCAL_RANK", 0 if self.count == 1 else None)
        if self.count < 1 or not 0 <= self.rank < self.count:
            raise InputError(
                f"RANK must be below WORLD_SIZE, got {self.rank} of {self.count}; start the processes with torchrun."
            )
        self._initialized = False
        self._device = torch.device("cpu")

    def device(self, name: str) -> torch.device:
        """The device of this process; with CUDA the device with the number `local_rank`.

        Args:
            name: "auto", "cpu" or "cuda".
        """
        if name == "cpu" or not torch.cuda.is_available():
            if name == "cuda":
                raise InputError("--device cuda needs a CUDA device that torch can use, got none; use --device cpu.")
            return torch.device("cpu")
        devices = torch.cuda.device_count()
        if self.local_rank >= devices:
            raise InputError(
                f"needed a CUDA device for each process on this machine, got {devices} for process "
                f"{self.local_rank + 1}; start {devices} with --nproc-per-node, or use --device cpu."
            )
        return torch.device("cuda", self.local_rank)

    def initialize(self, device: torch.device) -> None:
        """Initialise torch.distributed, by NCCL for CUDA devices, else gloo; an InputError if it fails."""
        self._device = device
        if device.type == "cuda":
            torch.cuda.set_device(device)
        if self.count == 1 or torch.distributed.is_initialized():
            return
        backend = "nccl" if device.type == "cuda" else "gloo"
        try:
            torch.distributed.init_process_group(backend, timeout=_TIMEOUT)
        except (ValueError, RuntimeError) as error:
            raise InputError(
                f"process {self.rank} of {self.count} could not connect to the others by {backend} "
                f"({str(error).splitlines()[0]}); start all with torchrun, or set MASTER_ADDR and MASTER_PORT."
            ) from error
        self._initialized = True

    def destroy(self) -> None:
        """Leave the group of processes that `initialize` has joined."""
        if self._initialized and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
            self._initialized = False

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files."""
        return self.rank == 0

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Means of the values over all processes."""
        if self.count == 1:
            return values
        sums = torch.tensor(list(values.values()), dtype=torch.float64, device=self._device)
        torch.distributed.all_reduce(sums)
        return dict(zip(values, (sums / self.count).tolist(), strict=True))

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in any process."""
        if self.count == 1:
            return flag
        value = torch.tensor(float(flag), device=self._device)
        torch.distributed.all_reduce(value, torch.distributed.ReduceOp.MAX)
        return bool(value)

    def barrier(self) -> None:
        """Wait for all processes."""
        if self.count > 1:
            torch.distributed.barrier()


class _AllReduceSum(torch.autograd.Function):
    """The sum of the tensors of all processes, differentiable in each."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor) -> Tensor:
        total = tensor.clone(memory_format=torch.contiguous_format)
        torch.distributed.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return _AllReduceSum.apply(gradients[0])


class SyncBatchNorm2d(nn.BatchNorm2d):
    """Batch normalisation with the statistics of all processes. Unlike torch.nn.SyncBatchNorm it runs on CPUs too."""

    def forward(self, input: Tensor) -> Tensor:
        if not self.training:
            return super().forward(input)
        maps = input.float() if input.dtype != torch.float64 else input
        count = maps.numel() // maps.shape[1] * torch.distributed.get_world_size()
        mean = _AllReduceSum.apply(maps.sum(dim=(0, 2, 3))) / count
        centred = maps - mean[:, None, None]
        variance = _AllReduceSum.apply(centred.square().sum(dim=(0, 2, 3))) / count
        self._update_statistics(mean.detach(), variance.detach() * count / max(1, count - 1))
        scaled = centred * (variance + self.eps).rsqrt()[:, None, None]
        return (scaled * self.weight[:, None, None] + self.bias[:, None, None]).to(input.dtype)

    @torch.no_grad()
    def _update_statistics(self, mean: Tensor, variance: Tensor) -> None:
        if self.running_mean is None or self.running_var is None or self.num_batches_tracked is None:
            return
        self.num_batches_tracked += 1
        momentum = self.momentum if self.momentum is not None else 1 / float(self.num_batches_tracked)
        self.running_mean.lerp_(mean.to(self.running_mean), momentum)
        self.running_var.lerp_(variance.to(self.running_var), momentum)


def convert_sync_batch_norm(network: nn.Module, processes: ProcessGroup) -> None:
    """Replace batch normalisation by `SyncBatchNorm2d` if there are several processes."""
    if processes.count > 1:
        for module in network.modules():
            if type(module) is nn.BatchNorm2d:
                module.__class__ = SyncBatchNorm2d


def data_parallel(step: nn.Module, processes: ProcessGroup) -> nn.Module:
    """Wrap a module so that `backward()` of its loss averages the parameters' gradients over all processes.

    Args:
        step: returns (loss, anything else); its gradients may be computed in its forward pass or by `backward()`.
        processes: the module itself is returned if there is only one process.
    """
    if processes.count == 1:
        return step
    wrapped = DistributedDataParallel(_ReachAllParameters(step), broadcast_buffers=False)
    # The first step reorders the buckets, and a sum over three or more processes depends on the order. An empty first
    # step makes a resumed run equal to one that was not interrupted.
    loss, _ = wrapped()
    loss.backward()
    wrapped.zero_grad()
    return wrapped


def no_sync(step: nn.Module) -> AbstractContextManager[None]:
    """A context in which gradients accumulate locally; the next backward pass outside of it averages them too."""
    return step.no_sync() if isinstance(step, DistributedDataParallel) else nullcontext()


class _ReachAllParameters(nn.Module):
    """Makes the loss of a module depend on every trainable parameter, as DistributedDataParallel requires.

    DistributedDataParallel averages the gradient of a parameter when `backward()` reaches it, and waits for all
    parameters. It reads gradients only then, so it averages gradients that the forward pass has computed too.
    """

    def __init__(self, step: nn.Module) -> None:
        super().__init__()
        self.step = step

    def forward(self, *arguments: Any) -> tuple[Tensor, Any]:
        trainable = [p for p in self.parameters() if p.requires_grad]
        loss, terms = self.step(*arguments) if arguments else (trainable[0].new_zeros(()), None)
        for parameter in trainable:  # reached from the last to the first, as in backpropagation
            loss = _AddDependency.apply(loss, parameter)
        return loss, terms


class _AddDependency(torch.autograd.Function):
    """Make a number depend on a parameter without a contribution to the parameter's gradient."""

    @staticmethod
    def forward(ctx: Any, number: Tensor, parameter: Tensor) -> Tensor:
        return number.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None
