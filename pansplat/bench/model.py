"""`pansplat bench model`: time, memory and error of each way to run the network.

Values of a row: `height` of the panoramas, pixels; `stages_s`, the seconds of each of `STAGES`; `total_s`, their sum;
`total_ratio`, it over the seconds of `harness.time_workload` just before, so that figures of different machines
compare; `processor_s` of all threads together, which other load on the machine hardly affects; `taken_gib`, the largest
additional memory, beyond Python, libraries, weights and input, 2^30 bytes; `depth_median_error` and `depth_max_error`,
|depth - reference| / reference of the finest sphere sweep; `psnr_db` between the images at the middle pose, rendered by
numba, infinite if they are equal.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from pansplat.bench.harness import (
    Header,
    Suite,
    announce,
    format_threads,
    make_axes,
    measure_peak_memory,
    time_call,
    time_workload,
)
from pansplat.evaluation.metrics import psnr
from pansplat.evaluation.results import Column, Row
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.inputs.views import Views
from pansplat.model.heads import merge_tiles
from pansplat.model.network import build_network
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.networks.layers import Compat, Precision
from pansplat.networks.weights import load_weights, pack_weights, save_weights
from pansplat.pipeline import render
from pansplat.system.kernels import release_idle_memory
from pansplat.training.network import network_config

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STAGES = ("features", "mono", "cost volume", "heads")
_STAGE_COLORS = ("#1764ab", "#6aaed6", "#e0a030", "#c8501e")
# Standard deviations of random weights relative to unit gain. Layers before a rectifier need more to keep the size of
# their output. Logits of depth need less, so that a depth is the mean of several candidates, as after training.
_RECTIFIER_GAIN, _LOGIT_GAIN = math.sqrt(2), 0.2


@dataclass(frozen=True)
class ModelCase:
    """A way to run the network.

    Attributes:
        compat, precision, attention: as in `pansplat.model.network.load_predictor`.
        threads: number of torch's threads.
        tiles: along each side of the panorama, for the heads.
    """

    compat: Compat
    precision: Precision
    attention: Precision
    threads: int
    tiles: int

    def __str__(self) -> str:
        """The case as it is shown while it is measured."""
        tiles, threads = f"{self.tiles}x{self.tiles} tiles", format_threads(self.threads)
        return f"{self.compat}, {self.precision}, attention {self.attention}, {tiles}, {threads}"


def list_model_cases(threads: int, *, bfloat16: bool, quick: bool) -> list[ModelCase]:
    """Ways to run the network; the first of each `compat` is the reference of the others."""
    plain = ModelCase("fixed", "float32", "float32", threads, tiles=1)
    rounded = dataclasses.replace(plain, precision="bfloat16")
    cases = [plain, rounded, dataclasses.replace(rounded, attention="bfloat16")]
    if not quick:
        official = dataclasses.replace(plain, compat="official")
        cases += [dataclasses.replace(case, tiles=tiles) for case in (plain, rounded) for tiles in (2, 4)]
        cases += [official, dataclasses.replace(official, precision="bfloat16")]
    return [case for case in cases if bfloat16 or case.precision == "float32"]


def measure_model(cases: Sequence[ModelCase], views: Views, weights: Path, scene: str) -> Iterator[Row]:
    """Yield the row of each case; its errors are against the first case of its `compat`.

    Args:
        weights: file of the network's weights.
        scene: name of the views' pair.
    """
    references: dict[str, dict[str, Tensor]] = {}
    for index, case in enumerate(cases, start=1):
        announce(f"{index} of {len(cases)}: {case}")
        values, prediction = measure_case(case, weights, views)
        is_reference = case.compat not in references
        errors = compare_predictions(prediction, references.setdefault(case.compat, prediction))
        entries = {"suite": "model", "scene": scene, "is_reference": is_reference, "name": str(case)}
        yield Row(entries | dataclasses.asdict(case), values if is_reference else values | errors)


def compare_predictions(prediction: Mapping[str, Tensor], reference: Mapping[str, Tensor]) -> dict[str, float]:
    """Errors of a prediction's `depth` and `image`."""
    error = (prediction["depth"].double() - reference["depth"].double()).abs() / reference["depth"].double()
    return {
        "depth_median_error": float(error.median()),
        "depth_max_error": float(error.max()),
        "psnr_db": psnr(prediction["image"], reference["image"]),
    }


@torch.no_grad()
def measure_case(
    case: ModelCase, weights: Path, views: Views
) -> tuple[dict[str, float | dict[str, float]], dict[str, Tensor]]:
    """The values of a case, and its prediction: `depth` of the finest sphere sweep, `image` at the middle pose."""
    network = build_network(
        load_weights(weights), case.compat, weights, precision=case.precision, attention_precision=case.attention
    )
    assert isinstance(network, PanSplat)
    _warm_up(case)
    bounds = [torch.full((1, len(views.images)), bound) for bound in (views.near, views.far)]
    stages: dict[str, float] = {}

    def predict() -> tuple[Tensor, Gaussians]:
        with _timed_stages(network, stages):
            matched = network.match_views(views.images[None], views.cam2world[None].float(), *bounds)
        began = time.perf_counter()
        (gaussians,) = merge_tiles(list(network.lift_gaussians(matched, tiles=case.tiles)), case.compat)
        stages["heads"] = time.perf_counter() - began
        return matched.depths.depth[-1][0].clone(), gaussians

    workload_s, cpu = time_workload(), torch.device("cpu")
    release_idle_memory()  # numba keeps buffers
    taken, (timing, (depth, gaussians)) = measure_peak_memory(lambda: time_call(predict, cpu), cpu)
    scene = Scene(gaussians, views.cam2world.double(), views.near, views.far, height=views.images.shape[-2])
    image = render(scene, scene.pose_between(0.5), backend="numba").color
    total_s = sum(stages.values())
    times = {"stages_s": stages, "total_s": total_s, "total_ratio": total_s / workload_s, "processor_s": timing.cpu}
    memory = {"taken_gib": taken["peak_mb"] * 1e6 / 2**30} if taken else {}
    size = {"height": scene.height, "num_gaussians": len(gaussians)}
    return {**size, **times, **memory}, {"depth": depth, "image": image}


def _warm_up(case: ModelCase) -> None:
    """Predict with a narrow network, so that kernels are compiled and libraries loaded before the measurement."""
    network = PanSplat(
        network_config("tiny"), case.compat, precision=case.precision, attention_precision=case.attention
    ).eval()
    poses = torch.eye(4).repeat(1, 2, 1, 1)
    poses[0, 1, 0, 3] = 0.1
    network(torch.zeros(1, 2, 3, 64, 128), poses, torch.full((1, 2), 0.5), torch.full((1, 2), 10.0))


@contextmanager
def _timed_stages(network: PanSplat, stages: dict[str, float]) -> Iterator[None]:
    """Add the seconds of the network's parts to `stages` while they are called."""
    parts: dict[str, nn.Module | None] = {
        "features": network.features,
        "mono": network.mono_depth,
        "cost volume": network.cost_volume,
    }

    def add(name: str, sign: int) -> Callable[..., None]:
        def hook(*_: object) -> None:
            stages[name] += sign * time.perf_counter()

        return hook

    stages |= dict.fromkeys(parts, 0.0)
    handles = []
    for name, part in parts.items():
        if part is not None:
            handles += [part.register_forward_pre_hook(add(name, -1)), part.register_forward_hook(add(name, 1))]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def plot_model(rows: Sequence[Row], header: Header) -> Figure:
    """Plot each row's seconds by stage and its memory as bars."""
    figure, (left, right) = make_axes(2, (11, 1.5 + 0.4 * len(rows)), sharey=True, width_ratios=(2, 1))
    names = [row.get("name") for row in rows]
    starts = [0.0] * len(rows)
    for stage, color in zip(STAGES, _STAGE_COLORS, strict=True):
        widths = [row.get("stages_s").get(stage, 0.0) for row in rows]
        left.barh(names, widths, left=starts, color=color, label=stage)
        starts = [start + width for start, width in zip(starts, widths, strict=True)]
    left.invert_yaxis()
    left.set(xlabel="seconds")
    left.set_title(f"{rows[0].get('height')}x{2 * rows[0].get('height')}, {header['machine']['cpu']}", loc="left")
    left.legend(fontsize=8)
    right.barh(names, [row.get("taken_gib") or 0.0 for row in rows], color="#888888")
    right.set(xlabel="GiB beyond Python, weights and input")
    return figure


def _stage_column(stage: str) -> Column:
    return Column(f"{stage} s", lambda row: row.get("stages_s").get(stage), ".1f")


MODEL = Suite(
    "model",
    (
        Column("compat", "compat"),
        Column("precision", "precision"),
        Column("attention", "attention"),
        Column("tiles", lambda row: "{0}x{0}".format(row.get("tiles")), ">"),
        Column("threads", "threads", "d"),
        *map(_stage_column, STAGES),
        Column("total s", "total_s", ".1f"),
        Column("ratio", "total_ratio", ".0f"),
        Column("processor s", "processor_s", ".1f"),
        Column("taken GiB", "taken_gib", ".2f"),
        Column(
            "depth median", lambda row: "reference" if row.get("is_reference") else row.get("depth_median_error"), ".1e"
        ),
        Column("depth max", "depth_max_error", ".1e"),
        Column("PSNR dB", "psnr_db", ".1f"),
    ),
    lambda row: (
        f"{row.get('scene')}, {row.get('height')}x{2 * row.get('height')}, {row.get('num_gaussians'):,} Gaussians"
    ),
    plot_model,
)


def save_random_weights(path: Path, config: PanSplatConfig | None = None, seed: int = 0) -> None:
    """Write random weights for `load_model`; deterministic. They keep the variance of every layer's output."""
    config = config or PanSplatConfig()
    with torch.device("meta"):
        shapes = PanSplat(config).state_dict()
    generator = torch.Generator().manual_seed(seed)
    tensors = {name: _random_weight(name, shape, generator) for name, shape in shapes.items()}
    save_weights(path, pack_weights("pansplat", config, tensors, compat="fixed"))


def _random_weight(name: str, like: Tensor, generator: torch.Generator) -> Tensor:
    if not like.is_floating_point():
        return torch.full(like.shape, 100, dtype=like.dtype)
    if like.dim() == 0:
        return torch.full((), 10.0)  # the largest depth of the monocular network, metres
    if name.endswith("running_var") or (name.endswith("weight") and like.dim() == 1):
        return 0.5 + torch.rand(like.shape, generator=generator)
    numbers = torch.randn(like.shape, generator=generator)
    if like.dim() == 1:
        return 0.1 * numbers
    return _gain(name) * numbers / math.sqrt(like[0].numel())


def _gain(name: str) -> float:
    if name.startswith(("features.encoder", "features.decoder", "mono_depth.")):
        return _RECTIFIER_GAIN
    is_logits = name.startswith("cost_volume.levels") and name.endswith(".head.2.weight")
    return _LOGIT_GAIN if is_logits else 1.0
