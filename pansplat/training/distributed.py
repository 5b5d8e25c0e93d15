"""Several processes that train one network: each takes its share of a step, and all take the mean of the gradients.

DistributedDataParallel averages the gradients. Batch normalisation takes its statistics from all processes, so that N
processes learn what one would from the joint batch.
"""

from __future__ import annotations

import os
import warnings
from contextlib import AbstractContextManager, nullcontext
from datetime import timedelta
from typing import Any

import torch
import torch.distributed
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from pansplat.errors import InputError

_PATIENCE = timedelta(hours=2)  # the first process may validate for long while the others wait


def _number(name: str, otherwise: int | None) -> int:
    """A number that torchrun puts into the environment.

    Raises:
        InputError: it is none, or missing without anything in its place.
    """
    text = os.environ.get(name, "" if otherwise is None else str(otherwise))
    try:
        return int(text)
    except ValueError:
        raise InputError(
            f"needed a number in the environment's {name}, got {text!r}; start the processes with torchrun."
        ) from None


class ProcessGroup:
    """This process among those that train together; one alone where torchrun did not start us.

    Attributes:
        rank, count: number of this process, and of all.
        place: its number on its own machine.

    Raises:
        InputError: the environment contradicts itself.
    """

    def __init__(self) -> None:
        self.count = _number("WORLD_SIZE", 1)
        self.rank = _number("RANK", 0 if self.count == 1 else None)
        self.place = _number("LOCAL_RANK", 0 if self.count == 1 else None)
        if self.count < 1 or not 0 <= self.rank < self.count:
            raise InputError(
                f"RANK must be below WORLD_SIZE, got {self.rank} of {self.count}; start the processes with torchrun."
            )
        self._joined = False
        self._device = torch.device("cpu")

    def device(self, name: str) -> torch.device:
        """This process's own: with CUDA the device of its number on this machine.

        Args:
            name: "auto", "cpu" or "cuda".

        Raises:
            InputError: CUDA is asked for and is not there, or there are more processes than devices.
        """
        if name == "cpu" or not torch.cuda.is_available():
            if name == "cuda":
                raise InputError("--device cuda needs a CUDA device that torch can use, got none; use --device cpu.")
            return torch.device("cpu")
        there = torch.cuda.device_count()
        if self.place >= there:
            raise InputError(
                f"needed a CUDA device for each process on this machine, got {there} for process {self.place + 1}; "
                f"start {there} with --nproc-per-node, or use --device cpu."
            )
        return torch.device("cuda", self.place)

    def join(self, device: torch.device) -> None:
        """Meet the others: by NCCL where they compute with CUDA, else by gloo.

        Raises:
            InputError: they could not meet.
        """
        self._device = device
        if device.type == "cuda":
            torch.cuda.set_device(device)
        if self.count == 1 or torch.distributed.is_initialized():
            return
        kind = "nccl" if device.type == "cuda" else "gloo"
        try:
            torch.distributed.init_process_group(kind, timeout=_PATIENCE)
        except (ValueError, RuntimeError) as error:
            raise InputError(
                f"process {self.rank} of {self.count} could not meet the others by {kind} "
                f"({str(error).splitlines()[0]}); start all with torchrun, or give MASTER_ADDR and MASTER_PORT."
            ) from error
        self._joined = True

    def leave(self) -> None:
        """Part from the others."""
        if self._joined and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
            self._joined = False

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files."""
        return self.rank == 0

    def mean(self, numbers: dict[str, float]) -> dict[str, float]:
        """The means of all processes' numbers."""
        if self.count == 1:
            return numbers
        values = torch.tensor(list(numbers.values()), dtype=torch.float64, device=self._device)
        torch.distributed.all_reduce(values)
        return dict(zip(numbers, (values / self.count).tolist(), strict=True))

    def any(self, flag: bool) -> bool:
        """Whether it is so in any process."""
        if self.count == 1:
            return flag
        value = torch.tensor(float(flag), device=self._device)
        torch.distributed.all_reduce(value, torch.distributed.ReduceOp.MAX)
        return bool(value)

    def wait(self) -> None:
        """Go on when all have come here."""
        if self.count > 1:
            torch.distributed.barrier()


class _SumOfAll(torch.autograd.Function):
    """The sum of all processes' tensors, differentiable in each."""

    @staticmethod
    def forward(ctx: Any, own: Tensor) -> Tensor:
        total = own.clone(memory_format=torch.contiguous_format)
        torch.distributed.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return _SumOfAll.apply(gradients[0])


class SyncBatchNorm2d(nn.BatchNorm2d):
    """Batch normalisation by the statistics of all processes' batches; on CPUs too, unlike torch's own."""

    def forward(self, input: Tensor) -> Tensor:
        if not self.training:
            return super().forward(input)
        maps = input.float() if input.dtype != torch.float64 else input
        count = maps.numel() // maps.shape[1] * torch.distributed.get_world_size()
        mean = _SumOfAll.apply(maps.sum(dim=(0, 2, 3))) / count
        apart = maps - mean[:, None, None]
        variance = _SumOfAll.apply(apart.square().sum(dim=(0, 2, 3))) / count
        self._remember(mean.detach(), variance.detach() * count / max(1, count - 1))
        scaled = apart * (variance + self.eps).rsqrt()[:, None, None]
        return (scaled * self.weight[:, None, None] + self.bias[:, None, None]).to(input.dtype)

    @torch.no_grad()
    def _remember(self, mean: Tensor, variance: Tensor) -> None:
        if self.running_mean is None or self.running_var is None or self.num_batches_tracked is None:
            return
        self.num_batches_tracked += 1
        share = self.momentum if self.momentum is not None else 1 / float(self.num_batches_tracked)
        self.running_mean.lerp_(mean.to(self.running_mean), share)
        self.running_var.lerp_(variance.to(self.running_var), share)


def convert_sync_batch_norm(network: nn.Module, processes: ProcessGroup) -> None:
    """Let batch normalisation see all processes' batches, where there are several."""
    if processes.count > 1:
        for module in network.modules():
            if type(module) is nn.BatchNorm2d:
                module.__class__ = SyncBatchNorm2d


def data_parallel(lessons: nn.Module, processes: ProcessGroup) -> nn.Module:
    """The module, with the mean of all processes' gradients at its parameters after `backward()` of its loss.

    Args:
        lessons: called, gives (loss, anything else); its gradients may come while it is called, or by `backward()`.
        processes: itself comes back where there is only one.
    """
    if processes.count == 1:
        return lessons
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch 2.4 knows `broadcast_buffers` by no other name
        wrapped = DistributedDataParallel(_ReachingAll(lessons), broadcast_buffers=False)
    # It orders its buckets anew after its first step, and a sum of three or more depends on its place in a bucket. So
    # that a run goes on to the bit from any step, that first step is this one.
    loss, _ = wrapped()
    loss.backward()
    wrapped.zero_grad()
    return wrapped


def no_sync(lessons: nn.Module) -> AbstractContextManager[None]:
    """While in it, gradients gather in each process by itself; the next ones outside take these along."""
    return lessons.no_sync() if isinstance(lessons, DistributedDataParallel) else nullcontext()


class _ReachingAll(nn.Module):
    """Lessons with a loss that depends on every parameter that learns, as DistributedDataParallel needs it.

    It averages a parameter's gradient when `backward()` reaches the parameter, and waits for all of them. Gradients
    that came before, while the lessons were called, it takes as they are: it does not look until the call is over.
    """

    def __init__(self, lessons: nn.Module) -> None:
        super().__init__()
        self.lessons = lessons

    def forward(self, *given: Any) -> tuple[Tensor, Any]:
        learning = [p for p in self.parameters() if p.requires_grad]
        loss, told = self.lessons(*given) if given else (learning[0].new_zeros(()), None)
        for parameter in learning:  # reached from the last to the first, as in backpropagation
            loss = _Reach.apply(loss, parameter)
        return loss, told


class _Reach(torch.autograd.Function):
    """A number that depends on a parameter too; nothing is added to the parameter's gradient."""

    @staticmethod
    def forward(ctx: Any, number: Tensor, parameter: Tensor) -> Tensor:
        return number.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None
