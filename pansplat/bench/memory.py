"""`pansplat bench memory`: peak memory of training and prediction over resolutions, as in the paper's figure.

Every case is one training step or one prediction in a process of its own, `python -m pansplat.bench.memory`.

Values of a row: `base_gib` is the memory held before: Python, libraries, weights, input.
`peak_gib` is the largest memory, `taken_gib` their difference, all in 2^30 bytes. `wall_s` are elapsed seconds,
`processor_s` those of all threads. `deviation` is |result - reference| / |reference|, Euclidean norms: of all gradients
together, or the largest among the prediction's means, opacities and image.

Source: PanSplat, section 3.4 and its figure of GPU memory.
"""

from __future__ import annotations

import dataclasses
import gc
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch
from torch import Tensor

from pansplat.bench.harness import (
    CaseFailedError,
    OverLimitError,
    measure_peak_memory,
    read_resident_memory,
    relative_deviation,
    reset_resident_peak,
    run_child,
    serve_job,
    time_call,
)
from pansplat.bench.report import Benchmark, Column, Header, Report, Row, error_or_reference, make_axes
from pansplat.data.views import Batch, Sample, Views, collate
from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions
from pansplat.model.heads import merge_tiles
from pansplat.model.pansplat import PanSplat
from pansplat.rendering.cpu.runtime import release_idle_memory
from pansplat.training.config import MemoryConfig, NetworkShape, Style
from pansplat.training.losses import LossWeights, PerceptualName, choose_perceptual
from pansplat.training.network import freeze, network_config, read_weights, set_training_mode, trainable_parameters
from pansplat.training.rendering import TargetRenderer
from pansplat.training.step import TrainingStep, accumulate_gradients

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Work = Literal["inference", "plain", "one-step", "two-step"]

_WORKS: tuple[Work, ...] = get_args(Work)
_TILES = (1, 2, 4)
_MAX_MATCHING_HEIGHT = 512  # above it only the heads are trained, as in the paper's stages
_WARM_UP_HEIGHT = 64
_SPHERE_RADIUS = 3.0  # metres
_SCENE = "painted sphere"
_CPU = torch.device("cpu")

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
_TILE_STYLES = {1: "o-", 2: "s--", 4: "D:"}


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
        limit_gib: a process that takes more is ended, 2^30 bytes.
    """

    network: NetworkShape
    style: Style
    perceptual: PerceptualName
    threads: int
    limit_gib: float


def list_memory_cases(heights: Sequence[int], *, quick: bool) -> list[MemoryCase]:
    """The cases by height, inference before training; the first of each kind is the reference: it has no tiles.

    Args:
        quick: leave out one-step backpropagation and the middle number of tiles.
    """
    return [
        MemoryCase(work, tiles, height)
        for height in sorted(heights)
        for work in _WORKS
        for tiles in (_TILES if work != "plain" else (1,))
        if not quick or (work != "one-step" and tiles != 2)
    ]


@dataclass(frozen=True)
class MemoryBench:
    """Measures cases and adds their rows to a report.

    Attributes:
        weights: file of the network's weights.
        report: its rows may hold those of earlier runs.
        retry: measure failed rows of earlier runs again.
    """

    setting: MemorySetting
    weights: Path
    report: Report
    retry: bool = False

    def run(self, cases: Sequence[MemoryCase]) -> None:
        """Measure the cases. The report's rows have the order of `list_memory_cases`.

        Cases of one height and kind are compared with the first that succeeds, so they are measured in one run: they
        are skipped only if all of them have rows.
        """
        done = {row.case for row in self.report.rows if row.status == "measured" or not self.retry}
        for _, group in itertools.groupby(cases, key=lambda case: (case.height, case.kind)):
            comparable = list(group)
            if done.issuperset(comparable):
                continue
            self.report.rows[:] = [row for row in self.report.rows if row.case not in comparable]
            reference: dict[str, Tensor] = {}
            for case in comparable:
                self.report.step(str(case))
                self.report.rows.append(self._measure(case, reference))
                self.report.rows.sort(key=lambda row: (row.case.height, _WORKS.index(row.case.work), row.case.tiles))
                self.report.save()

    def _measure(self, case: MemoryCase, reference: dict[str, Tensor]) -> Row:
        """The row of a case; its tensors become the reference if that is empty."""
        row = Row("memory", _SCENE, case)
        try:
            row.result, tensors = measure_case(case, self.setting, self.weights)
        except CaseFailedError as error:
            row.status = "over the limit" if isinstance(error, OverLimitError) else "died"
            row.note = str(error)
            return row
        row.is_reference = not reference
        if reference:
            row.result["deviation"] = relative_deviation(tensors, reference, together=case.kind == "training")
        else:
            reference |= tensors
        return row


def measure_case(case: MemoryCase, setting: MemorySetting, weights: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The values of a case from a child process, and gradients by name, or means, opacities and image of a prediction.

    Raises:
        CaseFailedError: it failed; OverLimitError if it exceeded the limit or the available memory.
    """
    job = {"case": dataclasses.asdict(case), "setting": dataclasses.asdict(setting), "weights": str(weights)}
    return run_child("pansplat.bench.memory", job, threads=setting.threads, limit_gib=setting.limit_gib)


def _measure_job(job: Mapping[str, Any]) -> tuple[dict[str, object], dict[str, Tensor]]:
    """Measure the job of a child process."""
    case, setting = MemoryCase(**job["case"]), MemorySetting(**job["setting"])
    network = PanSplat(network_config(setting.network), "fixed")
    network.load_state_dict(read_weights(Path(job["weights"])).tensors)
    work = _prepare_work(case, setting, network)
    work(make_painted_sphere(_WARM_UP_HEIGHT))  # compiles kernels and loads libraries
    batch = make_painted_sphere(case.height)
    gc.collect()
    release_idle_memory()
    reset_resident_peak()
    base_gib = read_resident_memory() / 2**30
    taken_mb, (timing, (count, tensors)) = measure_peak_memory(lambda: time_call(lambda: work(batch), _CPU), _CPU)
    if taken_mb is None:
        raise InputError("this system does not report a process's peak memory; run the benchmark on Linux")
    taken_gib = 1e6 * taken_mb / 2**30
    memory = {"base_gib": base_gib, "peak_gib": base_gib + taken_gib, "taken_gib": taken_gib}
    return {**memory, "wall_s": timing.wall, "processor_s": timing.cpu, "num_gaussians": count}, tensors


def _prepare_work(
    case: MemoryCase, setting: MemorySetting, network: PanSplat
) -> Callable[[Batch], tuple[int, dict[str, Tensor]]]:
    """A function that predicts or trains on a batch; it returns the number of Gaussians and the resulting tensors."""
    perceptual = choose_perceptual(setting.perceptual, device=_CPU)
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


def _tile_count(tiles: int) -> str:
    return "untiled" if tiles == 1 else f"{tiles**2} tiles"


def plot_memory(rows: Sequence[Row], header: Header) -> Figure | None:
    """Plot the taken memory over the height for training and for inference; None if there is nothing to plot."""
    shown = sorted((row for row in rows if row.get("taken_gib")), key=lambda row: row.case.height)
    if not shown:
        return None
    figure, both = make_axes(2, (11, 5.5), sharey=True)
    heights = sorted({row.case.height for row in shown} | {point[2] for point in PAPER_POINTS})
    for axes, kind in zip(both, ("training", "inference"), strict=True):
        of_kind = [row for row in shown if row.case.kind == kind]
        for work, tiles in dict.fromkeys((row.case.work, row.case.tiles) for row in of_kind):
            curve = [row for row in of_kind if (row.case.work, row.case.tiles) == (work, tiles)]
            x, y = [row.case.height for row in curve], [row.get("taken_gib") for row in curve]
            style = {"color": _WORK_COLORS[work], "markersize": 4, "label": f"{work}, {_tile_count(tiles)}"}
            axes.plot(x, y, _TILE_STYLES[tiles], **style)
        for _, text, height, gigabytes in (point for point in PAPER_POINTS if point[0] == kind):
            point = (height, gigabytes * 1e9 / 2**30)
            axes.plot(*point, "*", **_PAPER_STYLE)
            axes.annotate(f"{text}    ", point, ha="right", va="center", fontsize=8, color=_PAPER_STYLE["color"])
        axes.plot([], [], "*", **_PAPER_STYLE, label="the paper: its network, a GPU")
        axes.set_xscale("log", base=2)
        axes.set_yscale("log", base=2)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xticks(heights, [f"{height}\nx{2 * height}" for height in heights])
        axes.minorticks_off()
        axes.set(title=kind, xlabel="panorama, pixels", ylabel="GiB beyond Python, weights and input")
        axes.legend(fontsize=8, loc="lower right")
    setting = header["setting"]
    title = f"{setting['network']} network, batch 1, {setting['style']} images, {setting['perceptual']} loss"
    figure.suptitle(f"{title}; {header['machine']['cpu']}", x=0.01, ha="left", fontsize=10)
    return figure


MEMORY = Benchmark(
    "memory",
    (
        Column("height", "height", "{:d}"),
        Column("work", "work"),
        Column("tiles", lambda row: row.case.tiles**2, "{:d}"),
        Column("base GiB", "base_gib", "{:.2f}"),
        Column("peak GiB", "peak_gib", "{:.2f}"),
        Column("taken GiB", "taken_gib", "{:.2f}"),
        Column("seconds", "wall_s", "{:.1f}"),
        Column("processor s", "processor_s", "{:.1f}"),
        Column("deviation", error_or_reference("deviation"), "{:.1e}"),
        Column("", lambda row: "" if row.status == "measured" else f"{row.status}: {row.note}"),
    ),
    lambda row: "one prediction or training step of each row",
    plot_memory,
    width=150,
)


if __name__ == "__main__":
    serve_job(_measure_job)
