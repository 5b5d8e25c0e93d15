"""`pansplat bench refine`: image error against seconds and Gaussians, for predictors with and without refinement.

A row is a pair, a predictor, a height, a time limit of the refinement and a limit of Gaussians. Its errors are those of
the panoramas between the inputs. The cross-fade of the inputs is the row without geometry.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from pansplat import pipeline
from pansplat.bench.report import Column, Report, Row, format_number, result_column
from pansplat.data.pairs import Pair
from pansplat.data.views import Views
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import cross_fade, ws_psnr
from pansplat.evaluation.report import measure_own_views, warm_up
from pansplat.gaussians.scene import Scene
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig, Refinement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CROSS_FADE = "cross-fade"
MEAN = "mean"  # scene of the rows that average all pairs


@dataclass(frozen=True)
class RefineCase:
    """A way to make a scene.

    Attributes:
        model: name of a predictor, or `CROSS_FADE`.
        height: of the panoramas, pixels.
        limit_s: time limit of the refinement; 0 for none.
        limit_gaussians: None for no limit.
    """

    model: str
    height: int
    limit_s: float = 0.0
    limit_gaussians: int | None = None

    def __str__(self) -> str:
        """The case as it is shown while it is measured."""
        refined = f" + {self.limit_s:g} s" if self.limit_s else ""
        limit = f", {self.limit_gaussians:,} Gaussians" if self.limit_gaussians else ""
        return f"{self.model}{refined}, {self.height}x{2 * self.height}{limit}"


@dataclass
class RefineResult:
    """Errors, times and size of a scene.

    Attributes:
        ws_psnr_db, lpips: of the panoramas between the inputs; LPIPS is None if it was not measured.
        inputs_db: WS-PSNR at the input cameras, over unmasked pixels; None for the cross-fade.
        predict_s, refine_s: seconds.
        steps: of the refinement.
        num_gaussians: of the scene.
    """

    ws_psnr_db: float
    lpips: float | None = None
    inputs_db: float | None = None
    predict_s: float = 0.0
    refine_s: float = 0.0
    steps: float = 0.0
    num_gaussians: float = 0.0


RefineRow = Row[RefineCase, RefineResult]


def list_refine_cases(*, quick: bool) -> list[RefineCase]:
    """The cases; with `quick`, two of the default predictor at height 256."""
    if quick:
        return [RefineCase(CROSS_FADE, 256), *(RefineCase("default", 256, seconds) for seconds in (0.0, 5.0))]
    cases = [RefineCase(CROSS_FADE, 512)]
    cases += [RefineCase("sweep", 512, seconds) for seconds in (0.0, 10.0)]
    cases += [RefineCase("default", 256, seconds) for seconds in (0.0, 5.0, 10.0)]
    cases += [RefineCase("default", 512, seconds) for seconds in (0.0, 5.0, 10.0, 20.0)]
    return cases + [RefineCase("default", 512, 10.0, count) for count in (50_000, 100_000, 200_000)]


class RefineBench:
    """Measures cases on pairs.

    Args:
        report: receives the rows.
        lpips: None for no LPIPS.
    """

    def __init__(self, report: Report[RefineRow], lpips: Lpips | None) -> None:
        self._report, self._lpips = report, lpips
        self._predictors: dict[str, Predictor] = {}

    def run(self, pairs: Sequence[Pair], cases: Sequence[RefineCase]) -> None:
        """Measure every case on every pair with targets, then add the means over the pairs."""
        for pair in pairs:
            predicted: dict[tuple[str, int], tuple[Scene, float]] = {}
            for case in cases:
                self._report.update(f"{pair.name}: {case}")
                context, targets = pair.load_context(case.height), pair.load_targets(case.height)
                self._report.add(Row("refine", pair.name, case, self._measure(case, context, targets, predicted)))
        if len(pairs) > 1:
            for row in list(average_rows(self._report.rows)):
                self._report.add(row)

    def _measure(
        self,
        case: RefineCase,
        context: Views,
        targets: Views,
        predicted: dict[tuple[str, int], tuple[Scene, float]],
    ) -> RefineResult:
        if case.model == CROSS_FADE:
            return RefineResult(*self._compare(partial(cross_fade, context.images, context.cam2world), targets))
        if (case.model, case.height) not in predicted:
            predicted[case.model, case.height] = self._predict(case.model, context)
        scene, predict_s = predicted[case.model, case.height]
        refine_s, steps = 0.0, 0
        if case.limit_s:
            start = time.perf_counter()
            refinement = Refinement(scene, context, RefineConfig(gaussians=case.limit_gaussians))
            steps = refinement.run(seconds=case.limit_s).steps
            scene, refine_s = refinement.scene(), time.perf_counter() - start

        render = partial(pipeline.render, size=(case.height, 2 * case.height))
        inputs_db = measure_own_views(scene, context, render)
        with torch.no_grad():
            error = self._compare(lambda pose: render(scene, pose).color.float(), targets)
        return RefineResult(*error, inputs_db, predict_s, refine_s, steps, len(scene.gaussians))

    def _predict(self, model: str, context: Views) -> tuple[Scene, float]:
        if model not in self._predictors:
            self._predictors[model] = pipeline.load_model(model)
            warm_up(self._predictors[model])
        start = time.perf_counter()
        scene = pipeline.predict(context, self._predictors[model])
        return scene, time.perf_counter() - start

    def _compare(self, draw: Callable[[Tensor], Tensor], targets: Views) -> tuple[float, float | None]:
        """Mean WS-PSNR and LPIPS of the targets."""
        images = [draw(pose) for pose in targets.cam2world]
        errors = [ws_psnr(image, target) for image, target in zip(images, targets.images, strict=True)]
        if self._lpips is None:
            return statistics.fmean(errors), None
        distances = [self._lpips.distance(image, target) for image, target in zip(images, targets.images, strict=True)]
        return statistics.fmean(errors), statistics.fmean(distances)


def average_rows(rows: Sequence[RefineRow]) -> Iterator[RefineRow]:
    """For each case, the mean of its rows."""
    for case in dict.fromkeys(row.case for row in rows):
        results = [row.result for row in rows if row.case == case and row.scene != MEAN]
        columns = {name: [getattr(result, name) for result in results] for name in vars(results[0])}
        means = {name: None if None in values else statistics.fmean(values) for name, values in columns.items()}
        yield Row("refine", MEAN, case, RefineResult(**means))  # type: ignore[arg-type]


REFINE_COLUMNS: tuple[Column[RefineRow], ...] = (
    Column("model", lambda row: row.case.model, "left"),
    Column("height", lambda row: str(row.case.height)),
    Column("refinement", lambda row: f"{row.case.limit_s:g} s" if row.case.limit_s else "none"),
    Column("limit", lambda row: f"{row.case.limit_gaussians:,}" if row.case.limit_gaussians else ""),
    result_column("Gaussians", "{:,.0f}", "num_gaussians"),
    result_column("predict s", "{:.1f}", "predict_s"),
    result_column("refine s", "{:.1f}", "refine_s"),
    result_column("steps", "{:.0f}", "steps"),
    result_column("WS-PSNR dB", "{:.2f}", "ws_psnr_db"),
    result_column("LPIPS", "{:.3f}", "lpips"),
    Column("at inputs dB", lambda row: format_number(row.result.inputs_db, "{:.2f}")),
)


def make_refine_report(
    machine: Mapping[str, Any], lpips: str | None, *, json: Path | None = None, out: Path | None = None
) -> Report[RefineRow]:
    """The report of a run.

    Args:
        machine: from `describe_machine`.
        lpips: name of the LPIPS that is measured.
        json: file of the rows.
        out: folder for refine.md and refine.png.
    """
    return Report(
        REFINE_COLUMNS,
        lambda row: row.scene,
        machine,
        header={"lpips": lpips},
        facts=("cpu", "threads"),
        json_file=json,
        page=None if out is None else out / "refine.md",
        plots={} if out is None else {out / "refine.png": lambda rows: plot_refine(rows, str(machine["cpu"]), lpips)},
        print_steps=True,
    )


def plot_refine(rows: Sequence[RefineRow], title: str, lpips: str | None) -> Figure:
    """Plot the mean WS-PSNR and LPIPS over the seconds, and WS-PSNR over the number of Gaussians."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    means = list(average_rows([row for row in rows if row.scene != MEAN]))
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    axes = figure.subplots(1, 3)
    unlimited = [row for row in means if row.case.limit_gaussians is None]
    for model, height in dict.fromkeys((row.case.model, row.case.height) for row in unlimited):
        line = [row.result for row in unlimited if (row.case.model, row.case.height) == (model, height)]
        seconds = [result.predict_s + result.refine_s for result in line]
        label = model if model == CROSS_FADE else f"{model}, {height}x{2 * height}"
        axes[0].plot(seconds, [result.ws_psnr_db for result in line], "o-", label=label)
        axes[1].plot(seconds, [result.lpips for result in line], "o-", label=label)
    largest = max((row.case.limit_s for row in means if row.case.limit_gaussians), default=0.0)
    budgets = [row for row in means if row.case.limit_s == largest and row.case.model == "default"]
    height = max((row.case.height for row in budgets), default=0)
    budgets = sorted((row for row in budgets if row.case.height == height), key=lambda row: row.result.num_gaussians)
    axes[2].plot([row.result.num_gaussians for row in budgets], [row.result.ws_psnr_db for row in budgets], "o-")
    axes[0].set(xlabel="seconds of prediction and refinement", ylabel="WS-PSNR between the inputs, dB")
    axes[1].set(xlabel="seconds of prediction and refinement", ylabel=f"LPIPS ({lpips})" if lpips else "LPIPS")
    axes[2].set(
        xlabel=f"Gaussians, default + {largest:g} s at height {height}", ylabel="WS-PSNR between the inputs, dB"
    )
    axes[2].set_xlim(left=0)
    axes[2].xaxis.set_major_formatter(EngFormatter())
    axes[0].legend(fontsize=8)
    axes[0].set_title(title, loc="left", fontsize=9)
    for ax in axes:
        ax.grid(alpha=0.25)
    return figure
