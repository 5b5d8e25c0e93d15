"""`pansplat bench model`: time, memory and error of each way to run the network.

Every case runs in a process of its own, `python -m pansplat.bench.model`.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import safetensors.torch
import torch
from torch import Tensor, nn

from pansplat.bench.fidelity import clamped_psnr, relative_depth_errors
from pansplat.bench.harness import CaseFailedError, read_resident_peak, reset_resident_peak, run_child, serve_job
from pansplat.bench.report import Column, Report, Row, error_column, format_number, format_threads, result_column
from pansplat.data.views import Views
from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import AdapterConfig, HeadsConfig, merge_tiles
from pansplat.model.layers import Compat, Precision
from pansplat.model.network import build_network
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.model.weights import load_weights, pack_weights, save_weights
from pansplat.pipeline import render

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STAGES = ("features", "mono", "cost volume", "heads")
_STAGE_COLORS = ("#1764ab", "#6aaed6", "#e0a030", "#c8501e")
_WARM_UP_CONFIG = PanSplatConfig(
    features=FeaturePyramidConfig(channels=(4, 8, 8, 16), transformer=TransformerConfig(channels=16, blocks=1)),
    cost_volume=CostVolumeConfig(
        mono_channels=0, levels=(SweepLevel(3, 16, 8, 32), SweepLevel(2, 8, 4, 32), SweepLevel(1, 8, 4, 32))
    ),
    heads=HeadsConfig(feature_channels=(16, 8, 8, 4), candidates=4, adapter=AdapterConfig(degree=1)),
)

# Standard deviations of random weights relative to unit gain. Layers before a rectifier need more to keep the size of
# their output. Logits of depth need less, so that a depth is the mean of several candidates, as after training.
_RECTIFIER_GAIN, _LOGIT_GAIN = math.sqrt(2), 0.2


@dataclass(frozen=True)
class ModelCase:
    """A way to run the network.

    Attributes:
        compat, precision, attention: as in `pansplat.model.network.load_predictor`.
        threads: of torch.
        tiles: along each side of the panorama, for the heads.
    """

    compat: Compat
    precision: Precision
    attention: Precision
    threads: int
    tiles: int

    def __str__(self) -> str:
        """The case as it is shown while it is measured."""
        tiles, threads = _tiles(self), format_threads(self.threads)
        return f"{self.compat}, {self.precision}, attention {self.attention}, {tiles} tiles, {threads}"


@dataclass
class ModelResult:
    """Time and memory of a prediction, and its errors against the reference row.

    Attributes:
        height: of the panoramas, pixels.
        num_gaussians: of the prediction.
        stages_s: seconds of each of `STAGES`.
        total_s: their sum.
        processor_s: of all threads together; other load on the machine hardly affects it.
        peak_gib: largest resident memory of the process, 2^30 bytes; None if the system does not report it.
        depth_median_error, depth_max_error: |depth - reference| / reference of the finest sphere sweep.
        psnr_db: between the images at the middle pose, rendered by numba; infinite if they are equal.
    """

    height: int
    num_gaussians: int | None = None
    stages_s: dict[str, float] = field(default_factory=dict)
    total_s: float | None = None
    processor_s: float | None = None
    peak_gib: float | None = None
    depth_median_error: float | None = None
    depth_max_error: float | None = None
    psnr_db: float | None = None


ModelRow = Row[ModelCase, ModelResult]


def list_model_cases(threads: int, *, bfloat16: bool, quick: bool) -> list[ModelCase]:
    """Ways to run the network; the first of each `compat` is the reference of the others."""
    plain = ModelCase("fixed", "float32", "float32", threads, tiles=1)
    cases = [plain]
    if bfloat16:
        cases.append(dataclasses.replace(plain, precision="bfloat16"))
        cases.append(dataclasses.replace(plain, precision="bfloat16", attention="bfloat16"))
    if quick:
        return cases
    cases.insert(1, dataclasses.replace(plain, attention="bfloat16"))
    cases += [dataclasses.replace(plain, tiles=tiles) for tiles in (2, 4)]
    if bfloat16:
        cases.append(dataclasses.replace(plain, precision="bfloat16", tiles=2))
    if threads > 1:
        cases.append(dataclasses.replace(plain, threads=1))
    official = dataclasses.replace(plain, compat="official")
    cases.append(official)
    if bfloat16:
        cases.append(dataclasses.replace(official, precision="bfloat16"))
    return cases


def measure_model(
    cases: Sequence[ModelCase], views: Views, weights: Path, report: Report[ModelRow], *, scene: str
) -> None:
    """Measure the cases one after another and add their rows to the report.

    Args:
        weights: file of the network's weights.
        scene: name of the views' pair.

    Raises:
        InputError: a case failed, for example because of too little memory.
    """
    references: dict[str, dict[str, Tensor]] = {}
    with _write_views(views) as file:
        for index, case in enumerate(cases, start=1):
            report.update(f"{index} of {len(cases)}: {case}")
            result, tensors = measure_case(case, weights, file, near=views.near, far=views.far)
            row = ModelRow("model", scene, case, result, is_reference=case.compat not in references)
            reference = references.setdefault(case.compat, tensors)
            if not row.is_reference:
                errors = relative_depth_errors(tensors["depth"], reference["depth"])
                result.depth_median_error, result.depth_max_error = errors
                result.psnr_db = clamped_psnr(tensors["image"], reference["image"])
            report.add(row)


@contextmanager
def _write_views(views: Views) -> Iterator[Path]:
    """A temporary file of the panoramas for the child processes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "views.safetensors")
        tensors = {"images": views.images.contiguous(), "cam2world": views.cam2world.contiguous()}
        safetensors.torch.save_file(tensors, path)
        yield path


def measure_case(
    case: ModelCase, weights: Path, views: Path, *, near: float, far: float
) -> tuple[ModelResult, dict[str, Tensor]]:
    """Measure a case in a child process.

    Args:
        weights: file of the network's weights.
        views: safetensors file with `images` (view 3 height width) and `cam2world` (view 4 4).

    Returns:
        The result without errors; the `depth` of the finest sphere sweep and the `image` at the middle pose.

    Raises:
        InputError: the child failed; with its last message.
    """
    job = {"case": dataclasses.asdict(case), "near": near, "far": far, "weights": str(weights), "views": str(views)}
    try:
        numbers, tensors = run_child("pansplat.bench.model", job, threads=case.threads)
    except CaseFailedError as error:
        raise InputError(f"a row of the bench failed ({error}); try a smaller --height, or more tiles") from error
    return ModelResult(**numbers), tensors


@torch.no_grad()
def _measure_job(job: Mapping[str, Any]) -> tuple[dict[str, object], dict[str, Tensor]]:
    """Measure the job of a child process."""
    case, near, far = ModelCase(**job["case"]), job["near"], job["far"]
    views = safetensors.torch.load_file(job["views"])
    images, cam2world = views["images"], views["cam2world"]
    network = build_network(
        load_weights(Path(job["weights"])),
        case.compat,
        job["weights"],
        precision=case.precision,
        attention_precision=case.attention,
    )
    assert isinstance(network, PanSplat)
    _warm_up(case)
    bounds = [torch.full((1, len(images)), bound) for bound in (near, far)]
    stages: dict[str, float] = {}
    has_peak, before = reset_resident_peak(), time.process_time()
    with _timed_stages(network, stages):
        matched = network.match_views(images[None], cam2world[None].float(), *bounds)
    began = time.perf_counter()
    (gaussians,) = merge_tiles(list(network.lift_gaussians(matched, tiles=case.tiles)), case.compat)
    stages["heads"] = time.perf_counter() - began
    processor = time.process_time() - before
    peak = read_resident_peak() / 2**30 if has_peak else None
    depth = matched.depths.depth[-1][0]
    del matched
    scene = Scene(gaussians, cam2world.double(), near, far, height=images.shape[-2])
    image = render(scene, scene.pose_between(0.5), backend="numba").color
    result = ModelResult(scene.height, len(gaussians), stages, sum(stages.values()), processor, peak)
    return dataclasses.asdict(result), {"depth": depth, "image": image}


def _warm_up(case: ModelCase) -> None:
    """Predict with a narrow network, so that kernels are compiled and libraries loaded before the measurement."""
    network = PanSplat(
        _WARM_UP_CONFIG, case.compat, precision=case.precision, attention_precision=case.attention
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


def make_model_report(
    machine: Mapping[str, Any], network: str, *, height: int, json: Path | None = None, out: Path | None = None
) -> Report[ModelRow]:
    """The report of a run.

    Args:
        machine: from `describe_machine`.
        network: a description of its weights.
        height: of the panoramas, pixels.
        json: file of the rows.
        out: folder for model.md and model.png.
    """
    size = f"{height}x{2 * height}"

    return Report(
        MODEL_COLUMNS,
        lambda row: f"{network}, {size}, {row.result.num_gaussians or 0:,} Gaussians",
        machine,
        header={"network": network},
        facts=("cpu", "threads"),
        json_file=json,
        page=None if out is None else out / "model.md",
        plots={} if out is None else {out / "model.png": lambda rows: plot_model(rows, f"{size}, {machine['cpu']}")},
        print_steps=True,
        width=190,
    )


def _tiles(case: ModelCase) -> str:
    return f"{case.tiles}x{case.tiles}"


def _stage_column(stage: str) -> Column[ModelRow]:
    return Column(f"{stage} s", lambda row: format_number(row.result.stages_s.get(stage), "{:.1f}"))


MODEL_COLUMNS: tuple[Column[ModelRow], ...] = (
    Column("compat", lambda row: row.case.compat, "left"),
    Column("precision", lambda row: row.case.precision, "left"),
    Column("attention", lambda row: row.case.attention, "left"),
    Column("tiles", lambda row: _tiles(row.case)),
    Column("threads", lambda row: str(row.case.threads)),
    *map(_stage_column, STAGES),
    result_column("total s", "{:.1f}", "total_s"),
    result_column("processor s", "{:.1f}", "processor_s"),
    result_column("peak GiB", "{:.2f}", "peak_gib"),
    error_column("depth median", "{:.1e}", "depth_median_error"),
    result_column("depth max", "{:.1e}", "depth_max_error"),
    result_column("PSNR dB", "{:.1f}", "psnr_db"),
)


def plot_model(rows: Sequence[ModelRow], title: str) -> Figure:
    """Plot each row's seconds by stage and its memory as bars."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 1.5 + 0.4 * len(rows)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
    names = [_describe_case(row.case) for row in rows]
    starts = [0.0] * len(rows)
    for stage, color in zip(STAGES, _STAGE_COLORS, strict=True):
        widths = [row.result.stages_s.get(stage, 0.0) for row in rows]
        left.barh(names, widths, left=starts, color=color, label=stage)
        starts = [start + width for start, width in zip(starts, widths, strict=True)]
    left.invert_yaxis()
    left.set(xlabel="seconds")
    left.set_title(title, loc="left")
    left.legend(fontsize=8)
    right.barh(names, [row.result.peak_gib or 0.0 for row in rows], color="#888888")
    right.set(xlabel="largest resident memory, GiB")
    for axes in (left, right):
        axes.grid(axis="x", alpha=0.25)
    return figure


def _describe_case(case: ModelCase) -> str:
    parts = [case.compat, case.precision]
    parts += ["attention bfloat16"] * (case.attention == "bfloat16")
    parts += [f"{_tiles(case)} tiles"] * (case.tiles > 1)
    return ", ".join([*parts, format_threads(case.threads)])


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
        return torch.full((), 10.0)  # the monocular network's largest depth, metres
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


if __name__ == "__main__":
    serve_job(_measure_job)
