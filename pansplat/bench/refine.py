"""`pansplat bench refine`: image error against steps and Gaussians, for predictors with and without refinement.

A row is a pair, a predictor, a height, steps of the refinement and a limit of Gaussians. Its errors are those of
the panoramas between the inputs. The cross-fade of the inputs is the row without geometry.

Values of a row: `ws_psnr_db` and `lpips` of the panoramas between the inputs; `inputs_db`, WS-PSNR at the input cameras
over unmasked pixels; `predict_s` and `refine_s`; `steps` of the refinement; `num_gaussians` of the scene.
`predict_ratio` and `step_ratio` are the seconds of the prediction and of a step of the refinement over those of
`harness.time_workload`, measured just before, so that figures of different machines compare.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pansplat import pipeline
from pansplat.bench.harness import MEAN, Header, Suite, announce, make_axes, time_workload
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import cross_fade, ws_psnr
from pansplat.evaluation.report import measure_own_views, warm_up
from pansplat.evaluation.results import Column, Row, average_rows
from pansplat.gaussians.scene import Scene
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import Views, select_views
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
        height: rows of the panoramas.
        limit_steps: largest number of steps of the refinement; 0 for none.
        limit_gaussians: None for no limit.
        views: number of the pair's panoramas that the scene is made of; None for all.
    """

    model: str
    height: int
    limit_steps: int = 0
    limit_gaussians: int | None = None
    views: int | None = None

    def __str__(self) -> str:
        """The case as it is shown while it is measured."""
        refined = f" + {self.limit_steps} steps" if self.limit_steps else ""
        limit = f", {self.limit_gaussians:,} Gaussians" if self.limit_gaussians else ""
        views = f", {self.views} view" if self.views else ""
        return f"{self.model}{refined}, {self.height}x{2 * self.height}{limit}{views}"


def list_refine_cases(*, quick: bool) -> list[RefineCase]:
    """The cases; with `quick`, two of the default predictor at height 256."""
    if quick:
        cases = [RefineCase(CROSS_FADE, 256), RefineCase("default", 256, views=1)]
        return cases + [RefineCase("default", 256, steps) for steps in (0, 40)]
    cases = [RefineCase(CROSS_FADE, 512), *(RefineCase("default", height, views=1) for height in (256, 512))]
    cases += [RefineCase("sweep", 512, steps) for steps in (0, 40)]
    cases += [RefineCase("default", 256, steps) for steps in (0, 40, 80)]
    cases += [RefineCase("default", 512, steps) for steps in (0, 20, 40, 80)]
    return cases + [RefineCase("default", 512, 40, count) for count in (50_000, 100_000, 200_000)]


_MEAN_ENTRIES = ("suite", *RefineCase.__dataclass_fields__)  # entries of the rows of means over the pairs


def measure_refine(pairs: Sequence[PanoramaSet], cases: Sequence[RefineCase], lpips: Lpips | None) -> Iterator[Row]:
    """Yield the row of every case on every pair with targets, then the means over the pairs.

    Args:
        lpips: None for no LPIPS.
    """
    predictors: dict[str, Predictor] = {}
    rows = []
    for pair in pairs:
        predicted: dict[tuple[str, int, int], tuple[Scene, dict[str, float]]] = {}
        for case in cases:
            announce(f"{pair.name}: {case}")
            context, targets = pair.load_context(case.height), pair.load_targets(case.height)
            context = select_views(context, range(case.views or len(context.images)))
            key = case.model, case.height, len(context.images)
            if case.model == CROSS_FADE:
                values = compare(partial(cross_fade, context.images, context.cam2world), targets, lpips)
                values |= {"predict_s": 0.0, "refine_s": 0.0, "steps": 0, "num_gaussians": 0}
            else:
                if case.model not in predictors:
                    predictors[case.model] = pipeline.load_model(case.model)
                    warm_up(predictors[case.model])
                if key not in predicted:
                    predicted[key] = time_prediction(context, predictors[case.model])
                values = _measure(case, context, targets, *predicted[key], lpips)
            rows.append(Row({"suite": "refine", "scene": pair.name, **asdict(case)}, values))
            yield rows[-1]
    if len(pairs) > 1:
        yield from _average(rows)


def _average(rows: Sequence[Row]) -> list[Row]:
    means = average_rows(rows, _MEAN_ENTRIES)
    return [Row({"suite": "refine", "scene": MEAN, **row.case}, row.values) for row in means]


def time_prediction(context: Views, predictor: Predictor) -> tuple[Scene, dict[str, float]]:
    """A prediction; its seconds, and their ratio to those of the fixed workload."""
    workload_s, start = time_workload(), time.perf_counter()
    scene = pipeline.predict(context, predictor)
    seconds = time.perf_counter() - start
    return scene, {"predict_s": seconds, "predict_ratio": seconds / workload_s}


def _measure(
    case: RefineCase, context: Views, targets: Views, scene: Scene, times: dict[str, float], lpips: Lpips | None
) -> dict[str, float]:
    """Refine a predicted scene, and compare it with the targets and the inputs."""
    refined = {"refine_s": 0.0, "steps": 0}
    if case.limit_steps:
        workload_s, start = time_workload(), time.perf_counter()
        refinement = Refinement(scene, context, RefineConfig(gaussians=case.limit_gaussians))
        steps = refinement.run(steps=case.limit_steps).steps
        scene, refine_s = refinement.scene(), time.perf_counter() - start
        refined = {"refine_s": refine_s, "steps": steps, "step_ratio": refine_s / max(steps, 1) / workload_s}
    render = partial(pipeline.render, size=(case.height, 2 * case.height))
    errors = compare(lambda pose: render(scene, pose).color.float(), targets, lpips)
    inputs_db, count = measure_own_views(scene, context, render), len(scene.gaussians)
    return {**errors, "inputs_db": inputs_db, **times, **refined, "num_gaussians": count}


@torch.no_grad()
def compare(draw: Callable[[Tensor], Tensor], targets: Views, lpips: Lpips | None) -> dict[str, float]:
    """Mean WS-PSNR and LPIPS of the targets."""
    images = [(draw(pose), target) for pose, target in zip(targets.cam2world, targets.images, strict=True)]
    errors = {"ws_psnr_db": statistics.fmean(ws_psnr(*pair) for pair in images)}
    return errors if lpips is None else errors | {"lpips": statistics.fmean(lpips.distance(*pair) for pair in images)}


def _get_line(row: Row) -> tuple[str, int, int | None]:
    """What the points of a line have in common."""
    return row.get("model"), row.get("height"), row.get("views")


def plot_refine(rows: Sequence[Row], header: Header) -> Figure:
    """Plot the mean WS-PSNR and LPIPS over the seconds, and WS-PSNR over the number of Gaussians."""
    means = _average([row for row in rows if row.get("scene") != MEAN])
    figure, axes = make_axes(3, (13, 4.2))
    unlimited = [row for row in means if row.get("limit_gaussians") is None]
    for model, height, views in dict.fromkeys(map(_get_line, unlimited)):
        line = [row for row in unlimited if _get_line(row) == (model, height, views)]
        seconds = [row.get("predict_s") + row.get("refine_s") for row in line]
        label = model if model == CROSS_FADE else f"{model}, {height}x{2 * height}{', one view' if views else ''}"
        axes[0].plot(seconds, [row.get("ws_psnr_db") for row in line], "o-", label=label)
        axes[1].plot(seconds, [row.get("lpips") for row in line], "o-", label=label)
    largest = max((row.get("limit_steps") for row in means if row.get("limit_gaussians")), default=0)
    budgets = [row for row in means if row.get("limit_steps") == largest and row.get("model") == "default"]
    height = max((row.get("height") for row in budgets), default=0)
    points = sorted((row.get("num_gaussians"), row.get("ws_psnr_db")) for row in budgets if row.get("height") == height)
    axes[2].plot([count for count, _ in points], [psnr for _, psnr in points], "o-")
    between, seconds_label = "WS-PSNR between the inputs, dB", "seconds of prediction and refinement"
    axes[0].set(xlabel=seconds_label, ylabel=between)
    axes[1].set(xlabel=seconds_label, ylabel=f"LPIPS ({header['lpips']})" if header["lpips"] else "LPIPS")
    axes[2].set(xlabel=f"Gaussians, default + {largest} steps at height {height}", ylabel=between)
    axes[2].set_xlim(left=0)
    axes[2].xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g} k")
    axes[0].legend(fontsize=8)
    axes[0].set_title(header["machine"]["cpu"], loc="left", fontsize=9)
    return figure


REFINE = Suite(
    "refine",
    (
        Column("model", "model"),
        Column("height", "height", "d"),
        Column("views", lambda row: str(row.get("views") or "all")),
        Column("refinement", lambda row: f"{limit} steps" if (limit := row.get("limit_steps")) else "none"),
        Column("limit", "limit_gaussians", ","),
        Column("Gaussians", "num_gaussians", ",.0f"),
        Column("predict s", "predict_s", ".1f"),
        Column("refine s", "refine_s", ".1f"),
        Column("steps", "steps", ".0f"),
        Column("predict ratio", "predict_ratio", ".0f"),
        Column("step ratio", "step_ratio", ".1f"),
        Column("WS-PSNR dB", "ws_psnr_db", ".2f"),
        Column("LPIPS", "lpips", ".3f"),
        Column("at inputs dB", "inputs_db", ".2f"),
    ),
    lambda row: row.get("scene"),
    plot_refine,
)
