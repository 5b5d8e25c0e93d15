"""One step of training, or one prediction, in a process of its own: `python -m pansplat.bench.memory_case JOB.json`.

Only a fresh process tells the truth about its memory. The parent watches it and ends it where it takes too much.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import safetensors.torch
import torch
from torch import Tensor

from pansplat.bench.measure import peak_memory, reset_resident_peak, resident, seconds
from pansplat.data.views import Batch, Sample, Views, collate
from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions
from pansplat.model.heads import merge_tiles
from pansplat.model.pansplat import PanSplat
from pansplat.rendering.cpu.runtime import release_idle_memory
from pansplat.training.config import MemoryConfig, NetworkShape, Style
from pansplat.training.losses import LossWeights, Perceptual, PerceptualName, choose_perceptual
from pansplat.training.network import freeze, network_config, read_weights, set_training_mode, trainable_parameters
from pansplat.training.rendering import TargetRenderer
from pansplat.training.step import TrainingStep, accumulate_gradients

Work = Literal["inference", "plain", "one-step", "two-step"]
MATCHED_HEIGHT = 512  # above it only the heads learn, as in the paper's stages

_WARM_HEIGHT = 64
_WATCHED_EVERY = 0.05  # seconds
_RADIUS = 3.0  # metres, of the painted sphere


@dataclass(frozen=True)
class MemoryCase:
    """What is done.

    Attributes:
        work: predict and draw a panorama; or a step of training by that way of backpropagation.
        tiles: along each side of the panorama, for the heads.
        height: of the panoramas, pixels.
    """

    work: Work
    tiles: int
    height: int

    @property
    def kind(self) -> Literal["inference", "training"]:
        """What its result is: a prediction, or gradients."""
        return "inference" if self.work == "inference" else "training"


@dataclass(frozen=True)
class MemorySetting:
    """What all rows have in common.

    Attributes:
        network: its size; weights are random, the same in each row.
        style: how pictures are drawn.
        perceptual: part of the loss.
        threads: of the processor.
        device: "cpu" or "cuda".
        limit_gib: a process that takes more is ended, 2^30 bytes; on a GPU its allocator refuses more.
    """

    network: NetworkShape
    style: Style
    perceptual: PerceptualName
    threads: int
    device: str
    limit_gib: float


@dataclass(frozen=True)
class Taken:
    """What a case took.

    Attributes:
        base_gib: held before it began: Python, libraries, weights, input; on a GPU weights and input. 2^30 bytes.
        peak_gib: the most that was held at once.
        wall_s, processor_s: seconds on the clock, and of all threads together.
        num_gaussians: that were predicted.
        result: gradients of a step, or means, opacities and picture of a prediction.
    """

    base_gib: float
    peak_gib: float
    wall_s: float
    processor_s: float
    num_gaussians: int
    result: dict[str, Tensor]


class RowFailed(Exception):
    """A case that came to no end; its text says what happened."""


class OverLimit(RowFailed):
    """A case that took more memory than it may."""


def take(case: MemoryCase, setting: MemorySetting, weights: Path) -> Taken:
    """Run a case in a child process.

    Raises:
        OverLimit: it took more than the limit, or than there is.
        RowFailed: it ended in another way.
    """
    with tempfile.TemporaryDirectory() as folder:
        job, out, log = Path(folder, "job.json"), Path(folder, "out.safetensors"), Path(folder, "log")
        told = {"case": dataclasses.asdict(case), "setting": dataclasses.asdict(setting)}
        job.write_text(json.dumps({**told, "weights": str(weights), "out": str(out)}))
        with open(log, "wb") as said:
            child = subprocess.Popen(
                [sys.executable, "-m", "pansplat.bench.memory_case", str(job)],
                env=os.environ | {"OMP_NUM_THREADS": str(setting.threads)},
                stdout=said,
                stderr=said,
            )
        try:
            over = _watch(child, setting)
        finally:
            child.kill()
            child.wait()
        words = log.read_text(errors="replace").strip().splitlines()
        if over:
            raise OverLimit(f"ended at {setting.limit_gib:g} GiB")
        if child.returncode:
            raise _failure(child.returncode, words)
        return Taken(**json.loads(words[-1]), result=safetensors.torch.load_file(out))


def _watch(child: subprocess.Popen[bytes], setting: MemorySetting) -> bool:
    """Wait for a child; True, and it is ended, where it holds more than it may."""
    status = Path(f"/proc/{child.pid}/status")
    while child.poll() is None:
        time.sleep(_WATCHED_EVERY)
        if setting.device != "cpu":
            continue
        try:
            found = re.search(r"VmRSS:\s+(\d+) kB", status.read_text())
        except OSError:  # it has just ended, or the system has no such file
            continue
        if found is not None and int(found[1]) > setting.limit_gib * 2**20:
            child.kill()
            return True
    return False


def _failure(status: int, words: list[str]) -> RowFailed:
    """What became of a child, by its exit status and the last that it said."""
    last = words[-1] if words else "it said nothing"
    if "allocate" in last or "out of memory" in last.lower() or last.startswith("MemoryError"):
        return OverLimit(f"no memory left: {last[:120]}")
    if status < 0:
        return RowFailed(f"ended by {signal.Signals(-status).name}")
    return RowFailed(last[:160])


def painted_sphere(height: int) -> Batch:
    """Two views, and one to compare with, from within a painted sphere: a scene of any size without files."""
    generator = torch.Generator().manual_seed(0)
    waves, phases = 2 * torch.randn(3, 3, generator=generator), torch.randn(3, generator=generator)
    rays = pixel_directions(height, 2 * height, dtype=torch.float32)

    def views(places: tuple[float, ...]) -> Views:
        cam2world = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
        cam2world[:, 0, 3] = torch.tensor(places, dtype=torch.float64)
        images, depths = [], []
        for x in places:
            along = x * rays[..., 0]
            depth = (along.square() + _RADIUS**2 - x * x).sqrt() - along
            points = depth[..., None] * rays
            points[..., 0] += x
            images.append(0.5 + 0.4 * torch.sin((points @ waves.T + phases).permute(2, 0, 1)))
            depths.append(depth)
        masks = torch.ones(len(places), height, 2 * height, dtype=torch.bool)
        return Views(torch.stack(images), cam2world, masks, 0.45, 10.0, tuple(map(str, places)), torch.stack(depths))

    return collate([Sample("sphere", views((-0.5, 0.5)), views((0.1,)))])


@dataclass(frozen=True)
class _Worker:
    """A network ready for a kind of work.

    Attributes:
        optimizer: None for inference.
        perceptual: part of the loss.
    """

    case: MemoryCase
    setting: MemorySetting
    network: PanSplat
    optimizer: torch.optim.Optimizer | None
    perceptual: Perceptual

    def work(self, batch: Batch) -> tuple[int, dict[str, Tensor]]:
        """The number of Gaussians, and the result by name."""
        return self._predict(batch) if self.optimizer is None else self._learn(batch, self.optimizer)

    @torch.no_grad()
    def _predict(self, batch: Batch) -> tuple[int, dict[str, Tensor]]:
        network = self.network
        matched = network.match_views(batch.images, batch.cam2world.float(), batch.near, batch.far)
        (scene,) = merge_tiles(list(network.lift_gaussians(matched, tiles=self.case.tiles)), network.compat)
        renderer = TargetRenderer(self.setting.style, "joint", batch.images.shape[-2])
        picture = renderer.render(scene, batch.target_cam2world[0, 0], batch.cam2world[0])
        return len(scene), {"means": scene.means, "opacities": scene.opacities, "picture": picture}

    def _learn(self, batch: Batch, optimizer: torch.optim.Optimizer) -> tuple[int, dict[str, Tensor]]:
        network, case = self.network, self.case
        assert case.work != "inference"
        set_training_mode(network, _frozen(batch.images.shape[-2]))
        optimizer.zero_grad()
        memory = MemoryConfig(case.work, case.tiles, self.setting.style)
        weights = LossWeights(depth=0.0) if batch.images.shape[-2] > MATCHED_HEIGHT else LossWeights()
        accumulate_gradients(TrainingStep(network, None, self.perceptual, weights, memory), [batch])
        found = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
        optimizer.step()
        views, heights = batch.images.shape[1], batch.images.shape[-2]
        return views * sum(len(points) for points in network.heads.points(heights)), found


def _frozen(height: int) -> tuple[str, ...]:
    return ("features", "cost_volume") if height > MATCHED_HEIGHT else ()


def _run(job: Path) -> None:
    """The child: measure, and write what came."""
    told = json.loads(job.read_text())
    case, setting = MemoryCase(**told["case"]), MemorySetting(**told["setting"])
    torch.set_num_threads(setting.threads)
    device = torch.device(setting.device)
    if device.type == "cuda":
        whole_memory = torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(1.0, setting.limit_gib * 2**30 / whole_memory))
    perceptual = choose_perceptual(setting.perceptual, device=device)
    worker = _Worker(case, setting, *_network(case, setting, Path(told["weights"]), device), perceptual)
    worker.work(painted_sphere(_WARM_HEIGHT).to(device))  # compiles and loads what will be needed
    batch = painted_sphere(case.height).to(device)
    gc.collect()
    release_idle_memory()
    reset_resident_peak()
    base = torch.cuda.memory_allocated(device) if device.type == "cuda" else resident()
    more, (took, (count, result)) = peak_memory(lambda: seconds(lambda: worker.work(batch), device), device)
    if more is None:
        raise InputError("this system does not tell a process's largest memory; run the bench on Linux")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in result.items()}
    safetensors.torch.save_file(tensors, told["out"])
    peak = base + 1e6 * more
    print(json.dumps({
        "base_gib": base / 2**30, "peak_gib": peak / 2**30, "wall_s": took.wall, "processor_s": took.cpu,
        "num_gaussians": count,
    }))  # fmt: skip


def _network(
    case: MemoryCase, setting: MemorySetting, weights: Path, device: torch.device
) -> tuple[PanSplat, torch.optim.Optimizer | None]:
    """The network with its weights, and for training an optimizer that already has its state."""
    network = PanSplat(network_config(setting.network), "fixed")
    network.load_state_dict(read_weights(weights).tensors)
    network = network.to(device)
    if case.work == "inference":
        return network.eval(), None
    freeze(network, _frozen(case.height))
    optimizer = torch.optim.Adam(list(trainable_parameters(network)), lr=0.0)
    return network, optimizer


if __name__ == "__main__":
    _run(Path(sys.argv[1]))
