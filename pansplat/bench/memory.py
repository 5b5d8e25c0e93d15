"""`pansplat bench memory`: peak memory of training and prediction over resolutions, as in the paper's figure.

Every case is one training step or one prediction in a process of its own, `python -m pansplat.bench.memory`.

Source: PanSplat, section 3.4 and its figure of GPU memory.
"""

from __future__ import annotations

import dataclasses
import gc
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import safetensors.torch
import torch
from torch import Tensor

from pansplat.atomic import replacing
from pansplat.bench.fidelity import relative_deviation
from pansplat.bench.harness import (
    CaseFailedError,
    OverLimitError,
    measure_peak_memory,
    read_resident_memory,
    reset_resident_peak,
    run_child,
    serve_job,
    time_call,
)
from pansplat.bench.report import Column, Report, Row, error_column, read_row, result_column
from pansplat.data.views import Batch, Sample, Views, collate
from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions
from pansplat.model.heads import merge_tiles
from pansplat.model.pansplat import PanSplat
from pansplat.rendering.cpu.runtime import release_idle_memory
from pansplat.strict_json import read_json
from pansplat.training.config import MemoryConfig, NetworkShape, Style
from pansplat.training.losses import LossWeights, PerceptualName, choose_perceptual
from pansplat.training.network import freeze, network_config, read_weights, set_training_mode, trainable_parameters
from pansplat.training.rendering import TargetRenderer
from pansplat.training.step import TrainingStep, accumulate_gradients

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Work = Literal["inference", "plain", "one-step", "two-step"]

_TILES = (1, 2, 4)
_MAX_GROWTH = 4.0  # of memory when the height doubles
_MAX_MATCHING_HEIGHT = 512  # above it only the heads are trained, as in the paper's stages
_WARM_UP_HEIGHT = 64
_SPHERE_RADIUS = 3.0  # metres
_SCENE = "painted sphere"

PAPER_POINTS: tuple[tuple[str, str, int, float], ...] = (
    ("training", "untiled", 512, 36.0),
    ("training", "16 tiles", 2048, 42.0),
    ("inference", "untiled", 512, 7.5),
    ("inference", "tiled", 512, 5.0),
    ("inference", "4 tiles", 2048, 40.0),
    ("inference", "16 tiles", 2048, 23.0),
)
"""Kind, tiles, height, GB of a GPU. Source: the paper's figure of memory, estimated from the plot. The batch of
training is 2 at 512 and 1 at 2048; with 4 tiles 2048 ran out of memory."""

_WORK_COLORS: dict[Work, str] = {
    "inference": "#1764ab", "plain": "#444444", "one-step": "#e0a030", "two-step": "#c8501e"
}  # fmt: skip
_PAPER_STYLE: dict[str, Any] = {"color": "#2a8c4a", "markersize": 13, "markerfacecolor": "none"}
_TILE_LINES = {1: "-", 2: "--", 4: ":"}
_TILE_MARKERS = {1: "o", 2: "s", 4: "D"}


@dataclass(frozen=True)
class MemoryCase:
    """A prediction or a training step.

    Attributes:
        work: predict and render a panorama, or a training step with this kind of backpropagation.
        tiles: along each side of the panorama, for the heads.
        height: of the panoramas, pixels.
    """

    work: Work
    tiles: int
    height: int

    @property
    def kind(self) -> Literal["inference", "training"]:
        """Cases of one kind have comparable tensors: those of a prediction, or gradients."""
        return "inference" if self.work == "inference" else "training"

    def __str__(self) -> str:
        """The case as it is shown while it is measured."""
        work = self.work if self.work == "inference" else f"training, {self.work}"
        return f"{self.height}x{2 * self.height}, {work}, {_tile_count(self.tiles)}"


@dataclass(frozen=True)
class MemorySetting:
    """The options that are the same in all cases.

    Attributes:
        network: its size; weights are random, the same in each case.
        style: how images are rendered.
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


@dataclass
class MemoryResult:
    """Memory and time of a case.

    Attributes:
        base_gib: held before the case: Python, libraries, weights, input; on a GPU weights and input. 2^30 bytes.
        peak_gib: largest memory, the base included.
        taken_gib: their difference.
        wall_s, processor_s: elapsed seconds, and those of all threads together.
        num_gaussians: of the prediction.
        deviation: |result - reference| / |reference|, Euclidean norms: of all gradients together, or the largest among
            the prediction's means, opacities and image.
    """

    base_gib: float | None = None
    peak_gib: float | None = None
    taken_gib: float | None = None
    wall_s: float | None = None
    processor_s: float | None = None
    num_gaussians: int | None = None
    deviation: float | None = None


MemoryRow = Row[MemoryCase, MemoryResult]


def list_memory_cases(heights: Sequence[int], *, quick: bool) -> list[MemoryCase]:
    """The cases by height, inference before training; the first of each kind is the reference: it has no tiles.

    Args:
        quick: leave out one-step backpropagation and the middle number of tiles.
    """
    tiles = (1, 4) if quick else _TILES
    works: tuple[Work, ...] = ("inference", "plain", "two-step") if quick else get_args(Work)
    kinds: list[tuple[Work, int]] = [(work, count) for work in works for count in (tiles if work != "plain" else (1,))]
    return [MemoryCase(work, count, height) for height in sorted(heights) for work, count in kinds]


@dataclass(frozen=True)
class MemoryBench:
    """Measures cases and adds their rows to a report.

    Attributes:
        weights: file of the network's weights.
        references: folder for the results of reference rows, so that an interrupted run can continue.
        report: its rows may hold those of earlier runs.
    """

    setting: MemorySetting
    weights: Path
    references: Path
    report: Report[MemoryRow]

    def run(self, cases: Sequence[MemoryCase]) -> None:
        """Measure the cases that have no measured row. The report's rows have the order of `list_memory_cases`."""
        rows = self.report.rows
        rows[:] = [row for row in rows if row.status == "measured" or row.case not in cases]
        self._drop_lost_references(cases)
        for index, case in enumerate(cases, start=1):
            if case not in [row.case for row in rows]:
                self.report.update(f"{index} of {len(cases)}: {case}")
                rows.append(self._measure(case, cases))
                rows.sort(key=lambda row: (row.case.height, get_args(Work).index(row.case.work), row.case.tiles))
            self.report.update()

    def _drop_lost_references(self, cases: Sequence[MemoryCase]) -> None:
        """Drop reference rows whose result is needed and not stored, so that they are measured again."""
        done = {row.case for row in self.report.rows}
        needed = {(case.kind, case.height) for case in cases if case not in done}

        def is_lost(row: MemoryRow) -> bool:
            is_needed = row.is_reference and (row.case.kind, row.case.height) in needed
            return is_needed and not self._reference_file(row.case).is_file()

        self.report.rows[:] = [row for row in self.report.rows if not is_lost(row)]

    def _reference_file(self, case: MemoryCase) -> Path:
        return self.references / f"{case.kind}_{case.height}.safetensors"

    def _measure(self, case: MemoryCase, cases: Sequence[MemoryCase]) -> MemoryRow:
        row = MemoryRow("memory", _SCENE, case, MemoryResult())
        # Failures of earlier runs do not count: their limit may have been lower.
        known = [row for row in self.report.rows if row.status == "measured" or row.case in cases]
        expected = estimate_gib(case, known)
        if expected > self.setting.limit_gib:
            row.status = "not tried"
            row.note = f"{expected:.1f} GiB expected" if math.isfinite(expected) else "a smaller height failed"
            return row
        try:
            row.result, tensors = measure_case(case, self.setting, self.weights)
        except CaseFailedError as error:
            row.status = "over the limit" if isinstance(error, OverLimitError) else "died"
            row.note = str(error)
            return row
        file = self._reference_file(case)
        row.is_reference = not file.is_file()  # the first of its kind that succeeded
        if row.is_reference:
            with replacing(file) as partial:
                safetensors.torch.save_file(tensors, partial)
        else:
            reference = safetensors.torch.load_file(file)
            row.result.deviation = relative_deviation(tensors, reference, together=case.kind == "training")
        return row


def estimate_gib(case: MemoryCase, rows: Sequence[MemoryRow]) -> float:
    """Upper bound of a case's memory from the same work at the next smaller height; 0 if that is unknown.

    Above some height only a part of the network is trained, so rows at or below it do not bound training above it.
    """
    smaller = [
        row
        for row in rows
        if dataclasses.replace(row.case, height=case.height) == case and row.case.height < case.height
    ]
    if case.kind == "training" and case.height > _MAX_MATCHING_HEIGHT:
        smaller = [row for row in smaller if row.case.height > _MAX_MATCHING_HEIGHT]
    if not smaller:
        return 0.0
    row = max(smaller, key=lambda row: row.case.height)
    if row.result.taken_gib is None or row.result.base_gib is None:
        return math.inf
    return row.result.base_gib + row.result.taken_gib * _MAX_GROWTH ** math.log2(case.height / row.case.height)


def read_rows(path: Path, setting: MemorySetting) -> list[MemoryRow]:
    """The rows of an earlier run with the same setting, failed ones included; none if there is no file.

    Raises:
        InputError: the file has another setting, or is not a file of rows.
    """
    if not path.is_file():
        return []
    try:
        content = read_json(path)
        before = content["setting"]
        rows = [read_row(values, MemoryCase, MemoryResult) for values in content["rows"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: needed rows of `pansplat bench memory`, got {error!r}; delete it.") from error
    now = dataclasses.asdict(setting)
    changed = [
        f"{name} was {before.get(name)}, now {now[name]}"
        for name in now
        if name != "limit_gib" and before.get(name) != now[name]
    ]
    if changed:
        raise InputError(f"{path}: has another setting ({'; '.join(changed)}); give another --out, or delete the file.")
    return rows


def measure_case(case: MemoryCase, setting: MemorySetting, weights: Path) -> tuple[MemoryResult, dict[str, Tensor]]:
    """Measure a case in a child process.

    Returns:
        The result; gradients by name, or means, opacities and image of a prediction.

    Raises:
        OverLimitError: it exceeded the limit or the available memory.
        CaseFailedError: it failed otherwise.
    """
    job = {"case": dataclasses.asdict(case), "setting": dataclasses.asdict(setting), "weights": str(weights)}
    limit = setting.limit_gib if setting.device == "cpu" else None
    numbers, tensors = run_child("pansplat.bench.memory", job, threads=setting.threads, limit_gib=limit)
    return MemoryResult(**numbers), tensors


def _measure_job(job: Mapping[str, Any]) -> tuple[dict[str, object], dict[str, Tensor]]:
    """Measure the job of a child process."""
    case, setting = MemoryCase(**job["case"]), MemorySetting(**job["setting"])
    device = torch.device(setting.device)
    if device.type == "cuda":
        total = torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(1.0, setting.limit_gib * 2**30 / total))
    network = PanSplat(network_config(setting.network), "fixed")
    network.load_state_dict(read_weights(Path(job["weights"])).tensors)
    work = _prepare_work(case, setting, network.to(device))
    work(make_painted_sphere(_WARM_UP_HEIGHT).to(device))  # compiles kernels and loads libraries
    batch = make_painted_sphere(case.height).to(device)
    gc.collect()
    release_idle_memory()
    reset_resident_peak()
    base = torch.cuda.memory_allocated(device) if device.type == "cuda" else read_resident_memory()
    taken_mb, (timing, (count, tensors)) = measure_peak_memory(lambda: time_call(lambda: work(batch), device), device)
    if taken_mb is None:
        raise InputError("this system does not report a process's peak memory; run the benchmark on Linux")
    base_gib, taken_gib = base / 2**30, 1e6 * taken_mb / 2**30
    result = MemoryResult(base_gib, base_gib + taken_gib, taken_gib, timing.wall, timing.cpu, count)
    return dataclasses.asdict(result), tensors


def _prepare_work(
    case: MemoryCase, setting: MemorySetting, network: PanSplat
) -> Callable[[Batch], tuple[int, dict[str, Tensor]]]:
    """A function that predicts or trains on a batch; it returns the number of Gaussians and the resulting tensors."""
    perceptual = choose_perceptual(setting.perceptual, device=torch.device(setting.device))
    if case.work == "inference":
        network.eval()
        return lambda batch: _predict(network, batch, case.tiles, setting.style)
    freeze(network, _frozen_parts(case.height))
    optimizer = torch.optim.Adam(list(trainable_parameters(network)), lr=0.0)
    memory = MemoryConfig(case.work, case.tiles, setting.style)

    def train(batch: Batch) -> tuple[int, dict[str, Tensor]]:
        height = batch.images.shape[-2]
        set_training_mode(network, _frozen_parts(height))
        optimizer.zero_grad()
        weights = LossWeights(depth=0.0) if height > _MAX_MATCHING_HEIGHT else LossWeights()
        accumulate_gradients(TrainingStep(network, None, perceptual, weights, memory), [batch])
        gradients = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
        optimizer.step()
        return batch.images.shape[1] * sum(len(points) for points in network.heads.make_points(height)), gradients

    return train


@torch.no_grad()
def _predict(network: PanSplat, batch: Batch, tiles: int, style: Style) -> tuple[int, dict[str, Tensor]]:
    """Predict Gaussians and render one panorama."""
    matched = network.match_views(batch.images, batch.cam2world.float(), batch.near, batch.far)
    (scene,) = merge_tiles(list(network.lift_gaussians(matched, tiles=tiles)), network.compat)
    renderer = TargetRenderer(style, "joint", batch.images.shape[-2])
    image = renderer.render(scene, batch.target_cam2world[0, 0], batch.cam2world[0])
    return len(scene), {"means": scene.means, "opacities": scene.opacities, "image": image}


def _frozen_parts(height: int) -> tuple[str, ...]:
    return ("features", "cost_volume") if height > _MAX_MATCHING_HEIGHT else ()


def make_painted_sphere(height: int) -> Batch:
    """Two views and one target inside a painted sphere, at any height and without files."""
    generator = torch.Generator().manual_seed(0)
    waves, phases = 2 * torch.randn(3, 3, generator=generator), torch.randn(3, generator=generator)
    rays = pixel_directions(height, 2 * height, dtype=torch.float32)

    def views(positions: tuple[float, ...]) -> Views:
        cam2world = torch.eye(4, dtype=torch.float64).repeat(len(positions), 1, 1)
        cam2world[:, 0, 3] = torch.tensor(positions, dtype=torch.float64)
        images, depths = [], []
        for x in positions:
            along = x * rays[..., 0]
            depth = (along.square() + _SPHERE_RADIUS**2 - x * x).sqrt() - along
            points = depth[..., None] * rays
            points[..., 0] += x
            images.append(0.5 + 0.4 * torch.sin((points @ waves.T + phases).permute(2, 0, 1)))
            depths.append(depth)
        masks = torch.ones(len(positions), height, 2 * height, dtype=torch.bool)
        names = tuple(map(str, positions))
        return Views(torch.stack(images), cam2world, masks, 0.45, 10.0, names, torch.stack(depths))

    return collate([Sample("sphere", views((-0.5, 0.5)), views((0.1,)))])


def make_memory_report(
    machine: Mapping[str, Any], setting: MemorySetting, cases: Sequence[MemoryCase], out: Path | None
) -> Report[MemoryRow]:
    """The report of a run.

    Args:
        machine: from `describe_machine`.
        cases: of the run.
        out: folder for memory.json, memory.md and memory.png.
    """
    device = machine["gpu"] if setting.device == "cuda" else machine["cpu"]
    title = f"{setting.network} network, batch 1, {setting.style} images, {setting.perceptual} loss; {device}"

    def missing_rows(rows: Sequence[MemoryRow]) -> list[str]:
        missing = len(set(cases) - {row.case for row in rows})
        return [f"{missing} of {len(cases)} rows are still to be measured"] if missing else []

    return Report(
        MEMORY_COLUMNS,
        lambda row: title,
        machine,
        header={"setting": dataclasses.asdict(setting)},
        findings=missing_rows,
        json_file=None if out is None else out / "memory.json",
        page=None if out is None else out / "memory.md",
        plots={} if out is None else {out / "memory.png": lambda rows: plot_memory(rows, title)},
        print_steps=True,
    )


def _tile_count(tiles: int) -> str:
    return "untiled" if tiles == 1 else f"{tiles**2} tiles"


MEMORY_COLUMNS: tuple[Column[MemoryRow], ...] = (
    Column("height", lambda row: str(row.case.height)),
    Column("work", lambda row: row.case.work, "left"),
    Column("tiles", lambda row: str(row.case.tiles**2)),
    result_column("base GiB", "{:.2f}", "base_gib"),
    result_column("peak GiB", "{:.2f}", "peak_gib"),
    result_column("taken GiB", "{:.2f}", "taken_gib"),
    result_column("seconds", "{:.1f}", "wall_s"),
    result_column("processor s", "{:.1f}", "processor_s"),
    error_column("deviation", "{:.1e}", "deviation"),
    Column("", lambda row: "" if row.status == "measured" else f"{row.status}: {row.note}", "left"),
)


def plot_memory(rows: Sequence[MemoryRow], title: str) -> Figure | None:
    """Plot the taken memory over the height for training and for inference; None if there is nothing to plot."""
    shown = [row for row in rows if row.result.taken_gib]
    if not shown:
        return None
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _plot_kind(left, [row for row in shown if row.case.kind == "training"], "training")
    _plot_kind(right, [row for row in shown if row.case.kind == "inference"], "inference")
    left.set_ylabel("GiB beyond Python, weights and input")
    heights = sorted({row.case.height for row in shown} | {point[2] for point in PAPER_POINTS})
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_yscale("log", base=2)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xticks(heights, [f"{height}\nx{2 * height}" for height in heights])
        axes.minorticks_off()
        axes.grid(alpha=0.25)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return figure


def _plot_kind(axes: Axes, rows: Sequence[MemoryRow], kind: str) -> None:
    """A curve for each kind of backpropagation and number of tiles, and the paper's points."""
    curves: dict[tuple[Work, int], list[MemoryRow]] = {}
    for row in sorted(rows, key=lambda row: row.case.height):
        curves.setdefault((row.case.work, row.case.tiles), []).append(row)
    for (work, tiles), curve in curves.items():
        name = kind if work == "inference" else work
        axes.plot(
            [row.case.height for row in curve],
            [row.result.taken_gib or 0.0 for row in curve],
            _TILE_LINES[tiles],
            color=_WORK_COLORS[work],
            marker=_TILE_MARKERS[tiles],
            markersize=4,
            label=f"{name}, {_tile_count(tiles)}",
        )
    for _, text, height, gigabytes in (point for point in PAPER_POINTS if point[0] == kind):
        point = (height, gigabytes * 1e9 / 2**30)
        axes.plot(*point, "*", **_PAPER_STYLE)
        axes.annotate(
            text,
            point,
            xytext=(-8, 0),
            textcoords="offset points",
            ha="right",
            va="center",
            fontsize=8,
            color=_PAPER_STYLE["color"],
        )
    axes.plot([], [], "*", **_PAPER_STYLE, label="the paper: its network, a GPU")
    axes.set_title(kind, loc="left")
    axes.set_xlabel("panorama, pixels")
    axes.legend(fontsize=8, loc="lower right")


if __name__ == "__main__":
    serve_job(_measure_job)
