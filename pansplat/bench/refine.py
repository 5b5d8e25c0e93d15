"""`pansplat bench refine`: image error against seconds and Gaussians, for predictors with and without refinement.

A row is a pair, a predictor, a height, a time limit of the refinement and a limit of Gaussians. Its errors are those of
the panoramas between the inputs. The cross-fade of the inputs is the row without geometry.

Values of a row: `ws_psnr_db` and `lpips` of the panoramas between the inputs; `inputs_db`, WS-PSNR at the input cameras
over unmasked pixels; `predict_s` and `refine_s`; `steps` of the refinement; `num_gaussians` of the scene.
`predict_ratio` and `step_ratio` are the seconds of the prediction and of a step of the refinement over those of
`harness.time_workload`, measured just before, so that figures of different machines compare.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pansplat import pipeline
from pansplat.bench.harness import time_workload
from pansplat.bench.report import MEAN, Benchmark, Column, Header, Report, Row, average_rows, make_axes
from pansplat.data.pairs import Pair
from pansplat.data.views import Views, select_views
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import cross_fade, ws_psnr
from pansplat.evaluation.report import measure_own_views, warm_up
from pansplat.gaussians.scene import Scene
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig, Refinement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CROSS_FADE = "cross-fade"


@dataclass(frozen=True)
class RefineCase:
    """A way to make a scene.

    Attributes:
        model: name of a predictor, or `CROSS_FADE`.
        height: of the panoramas, pixels.
        limit_s: time limit of the refinement; 0 for none.
        limit_gaussians: None for no limit.
        views: number of the pair's panoramas that the scene is made of; None for all.
    """

    model: str
    height: int
    limit_s: float = 0.0
    limit_gaussians: int | None = None
    views: int | None = None

    def __str__(self) -> str:
        """The case as it is shown while it is measured."""
        refined = f" + {self.limit_s:g} s" if self.limit_s else ""
        limit = f", {self.limit_gaussians:,} Gaussians" if self.limit_gaussians else ""
        views = f", {self.views} view" if self.views else ""
        return f"{self.model}{refined}, {self.height}x{2 * self.height}{limit}{views}"


def list_refine_cases(*, quick: bool) -> list[RefineCase]:
    """The cases; with `quick`, two of the default predictor at height 256."""
    if quick:
        cases = [RefineCase(CROSS_FADE, 256), RefineCase("default", 256, views=1)]
        return cases + [RefineCase("default", 256, seconds) for seconds in (0.0, 5.0)]
    cases = [RefineCase(CROSS_FADE, 512), *(RefineCase("default", height, views=1) for height in (256, 512))]
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

    def __init__(self, report: Report, lpips: Lpips | None) -> None:
        self._report, self._lpips = report, lpips
        self._predictors: dict[str, Predictor] = {}

    def run(self, pairs: Sequence[Pair], cases: Sequence[RefineCase]) -> None:
        """Measure every case on every pair with targets, then add the means over the pairs."""
        for pair in pairs:
            predicted: dict[tuple[str, int, int], tuple[Scene, dict[str, float]]] = {}
            for case in cases:
                self._report.step(f"{pair.name}: {case}")
                context, targets = pair.load_context(case.height), pair.load_targets(case.height)
                context = select_views(context, range(case.views or len(context.images)))
                self._report.add(Row("refine", pair.name, case, self._measure(case, context, targets, predicted)))
        if len(pairs) > 1:
            for row in average_rows(list(self._report.rows)):
                self._report.add(row)

    def _measure(
        self,
        case: RefineCase,
        context: Views,
        targets: Views,
        predicted: dict[tuple[str, int, int], tuple[Scene, dict[str, float]]],
    ) -> dict[str, float]:
        if case.model == CROSS_FADE:
            errors = self._compare(partial(cross_fade, context.images, context.cam2world), targets)
            return {**errors, "predict_s": 0.0, "refine_s": 0.0, "steps": 0, "num_gaussians": 0}
        key = case.model, case.height, len(context.images)
        if key not in predicted:
            predicted[key] = self._predict(case.model, context)
        scene, times = predicted[key]
        refined = {"refine_s": 0.0, "steps": 0}
        if case.limit_s:
            workload_s = time_workload()
            start = time.perf_counter()
            refinement = Refinement(scene, context, RefineConfig(gaussians=case.limit_gaussians))
            steps = refinement.run(seconds=case.limit_s).steps
            scene, refine_s = refinement.scene(), time.perf_counter() - start
            refined = {"refine_s": refine_s, "steps": steps, "step_ratio": refine_s / max(steps, 1) / workload_s}

        render = partial(pipeline.render, size=(case.height, 2 * case.height))
        with torch.no_grad():
            errors = self._compare(lambda pose: render(scene, pose).color.float(), targets)
        inputs_db, count = measure_own_views(scene, context, render), len(scene.gaussians)
        return {**errors, "inputs_db": inputs_db, **times, **refined, "num_gaussians": count}

    def _predict(self, model: str, context: Views) -> tuple[Scene, dict[str, float]]:
        if model not in self._predictors:
            self._predictors[model] = pipeline.load_model(model)
            warm_up(self._predictors[model])
        workload_s, start = time_workload(), time.perf_counter()
        scene = pipeline.predict(context, self._predictors[model])
        seconds = time.perf_counter() - start
        return scene, {"predict_s": seconds, "predict_ratio": seconds / workload_s}

    def _compare(self, draw: Callable[[Tensor], Tensor], targets: Views) -> dict[str, float]:
        """Mean WS-PSNR and LPIPS of the targets."""
        images = [(draw(pose), target) for pose, target in zip(targets.cam2world, targets.images, strict=True)]
        errors = {"ws_psnr_db": statistics.fmean(ws_psnr(*pair) for pair in images)}
        if self._lpips is not None:
            errors["lpips"] = statistics.fmean(self._lpips.distance(*pair) for pair in images)
        return errors


def _get_line(row: Row) -> tuple[str, int, int | None]:
    """What the points of a line have in common."""
    return row.case.model, row.case.height, row.case.views


def plot_refine(rows: Sequence[Row], header: Header) -> Figure:
    """Plot the mean WS-PSNR and LPIPS over the seconds, and WS-PSNR over the number of Gaussians."""
    means = list(average_rows([row for row in rows if row.scene != MEAN]))
    figure, axes = make_axes(3, (13, 4.2))
    unlimited = [row for row in means if row.case.limit_gaussians is None]
    for model, height, views in dict.fromkeys(map(_get_line, unlimited)):
        line = [row for row in unlimited if _get_line(row) == (model, height, views)]
        seconds = [row.get("predict_s") + row.get("refine_s") for row in line]
        label = model if model == CROSS_FADE else f"{model}, {height}x{2 * height}{', one view' if views else ''}"
        axes[0].plot(seconds, [row.get("ws_psnr_db") for row in line], "o-", label=label)
        axes[1].plot(seconds, [row.get("lpips") for row in line], "o-", label=label)
    largest = max((row.case.limit_s for row in means if row.case.limit_gaussians), default=0.0)
    budgets = [row for row in means if row.case.limit_s == largest and row.case.model == "default"]
    height = max((row.case.height for row in budgets), default=0)
    points = sorted((row.get("num_gaussians"), row.get("ws_psnr_db")) for row in budgets if row.case.height == height)
    axes[2].plot([count for count, _ in points], [psnr for _, psnr in points], "o-")
    between, seconds_label = "WS-PSNR between the inputs, dB", "seconds of prediction and refinement"
    axes[0].set(xlabel=seconds_label, ylabel=between)
    axes[1].set(xlabel=seconds_label, ylabel=f"LPIPS ({header['lpips']})" if header["lpips"] else "LPIPS")
    axes[2].set(xlabel=f"Gaussians, default + {largest:g} s at height {height}", ylabel=between)
    axes[2].set_xlim(left=0)
    axes[2].xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g} k")
    axes[0].legend(fontsize=8)
    axes[0].set_title(header["machine"]["cpu"], loc="left", fontsize=9)
    return figure


REFINE = Benchmark(
    "refine",
    (
        Column("model", "model"),
        Column("height", "height", "{:d}"),
        Column("views", lambda row: row.case.views or "all"),
        Column("refinement", lambda row: f"{row.case.limit_s:g} s" if row.case.limit_s else "none"),
        Column("limit", "limit_gaussians", "{:,}"),
        Column("Gaussians", "num_gaussians", "{:,.0f}"),
        Column("predict s", "predict_s", "{:.1f}"),
        Column("refine s", "refine_s", "{:.1f}"),
        Column("steps", "steps", "{:.0f}"),
        Column("predict ratio", "predict_ratio", "{:.0f}"),
        Column("step ratio", "step_ratio", "{:.1f}"),
        Column("WS-PSNR dB", "ws_psnr_db", "{:.2f}"),
        Column("LPIPS", "lpips", "{:.3f}"),
        Column("at inputs dB", "inputs_db", "{:.2f}"),
    ),
    lambda row: row.scene,
    plot_refine,
    width=175,
)
