"""One way to run the network, in a process of its own: `python -m pansplat.bench.model_case JOB.json`.

A fresh process tells the truth about memory, and takes the number of threads that it is told.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor, nn

from pansplat.bench.measure import reset_resident_peak, resident_peak
from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import AdapterConfig, HeadsConfig, merge_tiles
from pansplat.model.layers import AttentionPrecision, Compat, Precision
from pansplat.model.network import build_network
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.model.weights import load_weights
from pansplat.pipeline import render

STAGES = ("features", "mono", "cost volume", "heads")
_NARROW = PanSplatConfig(
    features=FeaturePyramidConfig(channels=(4, 8, 8, 16), transformer=TransformerConfig(channels=16, blocks=1)),
    cost_volume=CostVolumeConfig(
        mono_channels=0, levels=(SweepLevel(3, 16, 8, 32), SweepLevel(2, 8, 4, 32), SweepLevel(1, 8, 4, 32))
    ),
    heads=HeadsConfig(feature_channels=(16, 8, 8, 4), candidates=4, adapter=AdapterConfig(degree=1)),
)


@dataclass(frozen=True)
class ModelCase:
    """One way to run the network.

    Attributes:
        tiles: along each side of the panorama, for the heads.
    """

    compat: Compat
    precision: Precision
    attention: AttentionPrecision
    threads: int
    tiles: int


@dataclass(frozen=True)
class Measured:
    """What a case took and gave.

    Attributes:
        stages_s: seconds of each of `STAGES`.
        processor_s: of all threads together; over the number of threads, what an idle machine would take at least.
        peak_gib: the process's largest resident memory, 2^30 bytes; None where the system does not tell.
        depth: of the finest sweep, metres.
        picture: at the middle pose, drawn by numba.
    """

    stages_s: dict[str, float]
    processor_s: float
    peak_gib: float | None
    num_gaussians: int
    depth: Tensor
    picture: Tensor


def measure_case(case: ModelCase, weights: Path, views: Path, *, near: float, far: float) -> Measured:
    """Run a case in a child process.

    Args:
        weights: a file of weights.
        views: safetensors with `images` (view 3 height width) and `cam2world` (view 4 4).

    Raises:
        InputError: the child failed; with what it said last.
    """
    with tempfile.TemporaryDirectory() as folder:
        job, out = Path(folder, "job.json"), Path(folder, "out.safetensors")
        paths = {"weights": str(weights), "views": str(views), "out": str(out)}
        job.write_text(json.dumps({"case": dataclasses.asdict(case), "near": near, "far": far, **paths}))
        child = subprocess.run(
            [sys.executable, "-m", "pansplat.bench.model_case", str(job)],
            env=os.environ | {"OMP_NUM_THREADS": str(case.threads)},
            capture_output=True,
            text=True,
        )
        if child.returncode:
            said = (child.stderr.strip() or f"status {child.returncode}").splitlines()[-1]
            raise InputError(f"a row of the bench failed ({said}); try a smaller --height, or more tiles")
        told, tensors = json.loads(child.stdout.splitlines()[-1]), safetensors.torch.load_file(out)
    return Measured(**told, depth=tensors["depth"], picture=tensors["picture"])


def _run(job: Path) -> None:
    """The child: measure, and write what came."""
    told = json.loads(job.read_text())
    case = ModelCase(**told["case"])
    torch.set_num_threads(case.threads)
    views = safetensors.torch.load_file(told["views"])
    network = build_network(
        load_weights(Path(told["weights"])),
        case.compat,
        told["weights"],
        precision=case.precision,
        attention_precision=case.attention,
    )
    assert isinstance(network, PanSplat)
    with torch.no_grad():
        _wake(case)
        measured = _measure(network, case, views["images"], views["cam2world"], told["near"], told["far"])
    tensors = {"depth": measured.depth.contiguous(), "picture": measured.picture.contiguous()}
    safetensors.torch.save_file(tensors, told["out"])
    numbers = {name: getattr(measured, name) for name in ("stages_s", "processor_s", "peak_gib", "num_gaussians")}
    print(json.dumps(numbers))


def _wake(case: ModelCase) -> None:
    """Compile and load what the measured run will need, with a network as narrow as can be."""
    network = PanSplat(_NARROW, case.compat, precision=case.precision, attention_precision=case.attention).eval()
    poses = torch.eye(4).repeat(1, 2, 1, 1)
    poses[0, 1, 0, 3] = 0.1
    network(torch.zeros(1, 2, 3, 64, 128), poses, torch.full((1, 2), 0.5), torch.full((1, 2), 10.0))


def _measure(
    network: PanSplat, case: ModelCase, images: Tensor, cam2world: Tensor, near: float, far: float
) -> Measured:
    views = len(images)
    bounds = [torch.full((1, views), bound) for bound in (near, far)]
    stages: dict[str, float] = {}
    can_tell, before = reset_resident_peak(), time.process_time()
    with _watched(network, stages):
        matched = network.match_views(images[None], cam2world[None].float(), *bounds)
    began = time.perf_counter()
    (gaussians,) = merge_tiles(list(network.lift_gaussians(matched, tiles=case.tiles)), case.compat)
    stages["heads"] = time.perf_counter() - began
    processor = time.process_time() - before
    peak = resident_peak() / 2**30 if can_tell else None
    depth = matched.depths.depth[-1][0]
    del matched
    scene = Scene(gaussians, cam2world.double(), near, far, height=images.shape[-2])
    picture = render(scene, scene.pose_between(0.5), backend="numba").color
    return Measured(stages, processor, peak, len(gaussians), depth, picture)


@contextmanager
def _watched(network: PanSplat, stages: dict[str, float]) -> Iterator[None]:
    """Take the time of the network's parts while they are called."""
    parts: dict[str, nn.Module | None] = {
        "features": network.features,
        "mono": network.mono_depth,
        "cost volume": network.cost_volume,
    }
    handles = []
    for name, part in parts.items():
        stages[name] = 0.0
        if part is None:
            continue

        def begin(*_: object, name: str = name) -> None:
            stages[name] -= time.perf_counter()

        def end(*_: object, name: str = name) -> None:
            stages[name] += time.perf_counter()

        handles += [part.register_forward_pre_hook(begin), part.register_forward_hook(end)]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


if __name__ == "__main__":
    _run(Path(sys.argv[1]))
