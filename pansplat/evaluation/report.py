"""Evaluation of predictions against real panoramas: images, metrics and a table, with the cross-fade as baseline.

Source: PanSplat, section 4 (metrics of the views between the inputs).
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from rich.table import Table
from torch import Tensor

from pansplat import pipeline
from pansplat.atomic import replacing
from pansplat.data.images import write_image
from pansplat.data.pairs import Pair
from pansplat.data.views import Views
from pansplat.errors import InputError
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import cross_fade, psnr, ssim, ws_psnr
from pansplat.gaussians.scene import Scene
from pansplat.pipeline import Drawing
from pansplat.predictor import Predictor, Progress
from pansplat.rendering import Rendering

ERROR_SCALE = 0.25  # mean absolute colour error that the brightest colour of an error image shows


@dataclass(frozen=True)
class Case:
    """Metrics of one target view (PSNR in dB), and the paths of its images.

    Attributes:
        own_ws_psnr: mean WS-PSNR of the scene's images at the input cameras, over unmasked pixels.
        refine_seconds: 0 without refinement.
        masked_ws_psnr: WS-PSNR of the unmasked pixels; None without a mask.
        lpips: None if it was not measured.
        cross_fade_ws_psnr, masked_cross_fade_ws_psnr, cross_fade_lpips: the same metrics of the cross-fade.
    """

    name: str
    model: str
    height: int
    ws_psnr: float
    psnr: float
    ssim: float
    cross_fade_ws_psnr: float
    predict_seconds: float
    render_seconds: float
    num_gaussians: int
    prediction: Path
    target: Path
    own_ws_psnr: float
    refine_seconds: float
    masked_ws_psnr: float | None = field(default=None, compare=False)
    masked_cross_fade_ws_psnr: float | None = field(default=None, compare=False)
    lpips: float | None = field(default=None, compare=False)
    cross_fade_lpips: float | None = field(default=None, compare=False)

    def as_json(self) -> dict[str, object]:
        """The entry in results.json, without the metrics that were not measured; non-finite numbers become null."""
        values = {key: value for key, value in dataclasses.asdict(self).items() if value is not None}
        return {key: str(value) if isinstance(value, Path) else finite_json(value) for key, value in values.items()}


def evaluate(
    pairs: Sequence[Pair],
    predictor: Predictor,
    out: Path,
    *,
    height: int = 512,
    refine_seconds: float = 0.0,
    blend: str | int = "deferred",
    drawing: Drawing = "exact",
    lpips: Lpips | None = None,
    progress: Progress | None = None,
) -> list[Case]:
    """Evaluate every target of the pairs, and write results.json and images into `out`.

    For correct times, predictions are not read from the cache and the predictor runs once before the first pair.
    results.json is written after each pair, so that an interruption keeps the results so far.

    Args:
        refine_seconds: time limit of the refinement of each scene; 0 for none.
        blend, drawing: see `pipeline.render`. With "joint", scenes are fused (`fuse_views`), but those of networks are
            not: these are trained for joint drawing.

    Raises:
        InputError: no pair has a target, or `out` cannot be written.
    """
    with_targets = [pair for pair in pairs if pair.targets]
    if not with_targets:
        raise InputError("none of the pairs has a target view to compare with; name targets in pairs.json")
    make_folder(out)
    warm_up(predictor)
    render = partial(pipeline.render, blend=blend, size=(height, 2 * height), drawing=drawing)
    cases: list[Case] = []
    for index, pair in enumerate(with_targets):

        def report(what: str, fraction: float, pair: Pair = pair, index: int = index) -> None:
            if progress is not None:
                progress(f"{pair.name}: {what}", (index + fraction) / len(with_targets))

        taken = {case.prediction.parent.name for case in cases}
        joint = blend == "joint" and not pipeline.can_stream(predictor)
        cases += _evaluate_pair(pair, predictor, out, taken, height, refine_seconds, joint, render, lpips, report)
        write_json([case.as_json() for case in cases], out / "results.json")
    return cases


def warm_up(predictor: Predictor) -> None:
    """Predict once from small noise, to compile the kernels that the predictor compiles at its first use."""
    images = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 1.0
    predictor(images, poses, 0.5, 10.0)


def _evaluate_pair(
    pair: Pair,
    predictor: Predictor,
    out: Path,
    taken: set[str],
    height: int,
    refine_seconds: float,
    joint: bool,
    render: Callable[[Scene, Tensor], Rendering],
    lpips: Lpips | None,
    progress: Progress,
) -> Iterator[Case]:
    context, targets = pair.load_context(height), pair.load_targets(height)
    start = time.perf_counter()
    scene = pipeline.predict(context, predictor, joint=joint, progress=progress)
    predict_seconds = time.perf_counter() - start
    if refine_seconds:
        start = time.perf_counter()
        scene = pipeline.refine(scene, context, seconds=refine_seconds, progress=progress)
        refine_seconds = time.perf_counter() - start
    own_ws_psnr = measure_own_views(scene, context, render)
    for view, target in enumerate(targets.images):
        progress("rendering", 1.0)
        pose = targets.cam2world[view]
        start = time.perf_counter()
        with torch.no_grad():
            image = render(scene, pose).color.float()
        render_seconds = time.perf_counter() - start
        name = pair.name if len(targets.images) == 1 else f"{pair.name} {Path(targets.names[view]).stem}"
        folder = out / _choose_folder_name(name, taken)
        make_folder(folder)
        write_image(folder / "prediction.png", image)
        write_image(folder / "target.png", target)
        write_image(folder / "error.png", error_image(image, target))
        faded = cross_fade(context.images, context.cam2world, pose)
        mask = None if bool(targets.masks[view].all()) else targets.masks[view]
        yield Case(
            name=folder.name,
            model=predictor.name,
            height=height,
            ws_psnr=ws_psnr(image, target),
            psnr=psnr(image, target),
            ssim=ssim(image, target),
            cross_fade_ws_psnr=ws_psnr(faded, target),
            own_ws_psnr=own_ws_psnr,
            predict_seconds=predict_seconds,
            refine_seconds=refine_seconds,
            render_seconds=render_seconds,
            num_gaussians=len(scene.gaussians),
            prediction=(folder / "prediction.png").resolve(),
            target=(folder / "target.png").resolve(),
            masked_ws_psnr=None if mask is None else ws_psnr(image, target, mask=mask),
            masked_cross_fade_ws_psnr=None if mask is None else ws_psnr(faded, target, mask=mask),
            lpips=None if lpips is None else lpips.distance(image, target),
            cross_fade_lpips=None if lpips is None else lpips.distance(faded, target),
        )


def measure_own_views(scene: Scene, context: Views, render: Callable[[Scene, Tensor], Rendering]) -> float:
    """Mean WS-PSNR of the unmasked pixels at the input cameras."""
    with torch.no_grad():
        values = [
            ws_psnr(render(scene, pose).color.float(), image, mask=mask)
            for image, pose, mask in zip(context.images, scene.cam2world, context.masks, strict=True)
        ]
    return sum(values) / len(values)


def error_image(
    prediction: Float[Tensor, "3 height width"], target: Float[Tensor, "3 height width"]
) -> Float[Tensor, "3 height width"]:
    """The mean absolute colour error as a heat map: black at 0, pale yellow from ERROR_SCALE up."""
    from matplotlib import colormaps

    error = (prediction - target).abs().mean(0).div(ERROR_SCALE).clamp(0, 1).cpu().numpy()
    heat = np.asarray(colormaps["inferno"](error), np.float32)[..., :3]
    return torch.from_numpy(heat).permute(2, 0, 1)


def write_json(value: Mapping[str, Any] | Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write an object, or a list of objects, without non-finite numbers as JSON, atomically."""
    mark = {"software": "pansplat"}
    marked = {**mark, **value} if isinstance(value, dict) else [{**mark, **row} for row in value]
    text = json.dumps(marked, indent=1, allow_nan=False)
    with replacing(path) as unfinished:
        unfinished.write_text(text + "\n", encoding="utf-8")


@dataclass(frozen=True)
class _Column:
    """A column of the table: the field of a case, the format, and the field of the cross-fade if it has one."""

    field: str
    format_spec: str
    cross_fade: str = ""


_COLUMNS = {
    "WS-PSNR": _Column("ws_psnr", ".2f", "cross_fade_ws_psnr"),
    "masked": _Column("masked_ws_psnr", ".2f", "masked_cross_fade_ws_psnr"),
    "PSNR": _Column("psnr", ".2f"),
    "SSIM": _Column("ssim", ".4f"),
    "LPIPS": _Column("lpips", ".4f", "cross_fade_lpips"),
    "cross-fade": _Column("cross_fade_ws_psnr", ".2f"),
    "at inputs": _Column("own_ws_psnr", ".2f"),
    "predict s": _Column("predict_seconds", ".1f"),
    "refine s": _Column("refine_seconds", ".1f"),
    "render s": _Column("render_seconds", ".1f"),
    "Gaussians": _Column("num_gaussians", ",.0f"),
}
_NOT_MEASURED = {"masked_ws_psnr": None, "lpips": None, "refine_seconds": 0.0}  # columns of these values are left out


def results_table(cases: Sequence[Case]) -> Table:
    """A printable table of the cases, their mean, and the mean of the cross-fade of the same cases."""
    columns = {head: column for head, column in _COLUMNS.items() if _is_measured(cases, column.field)}
    table = Table(title=f"{cases[0].model}, {cases[0].height}x{2 * cases[0].height}" if cases else None)
    table.add_column("case")
    for head in columns:
        table.add_column(head, justify="right")
    for case in cases:
        table.add_row(case.name, *(_format_mean([case], c.field, c.format_spec) for c in columns.values()))
    if cases:
        table.add_section()
        if len(cases) > 1:
            table.add_row("mean", *(_format_mean(cases, c.field, c.format_spec) for c in columns.values()))
        table.add_row("cross-fade", *(_format_mean(cases, c.cross_fade, c.format_spec) for c in columns.values()))
    return table


def _is_measured(cases: Sequence[Case], name: str) -> bool:
    return name not in _NOT_MEASURED or any(getattr(case, name) != _NOT_MEASURED[name] for case in cases)


def _format_mean(cases: Sequence[Case], field: str, format_spec: str) -> str:
    return format(fmean(_read_value(case, field) for case in cases), format_spec) if field else ""


def _read_value(case: Case, field: str) -> float:
    """A metric; without a mask the masked one is that of all pixels."""
    value = getattr(case, field)
    if value is None and field.startswith("masked_"):
        value = getattr(case, field.removeprefix("masked_"))
    return math.nan if value is None else value


def finite_json(value: object) -> object:
    """The value with null for numbers that JSON cannot represent."""
    if isinstance(value, dict):
        return {key: finite_json(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [finite_json(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def make_folder(folder: Path) -> None:
    """Make a folder and its parents; an InputError if it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {folder} ({error.strerror}); choose another --out") from error


def _choose_folder_name(name: str, taken: set[str]) -> str:
    """The name as a valid folder name, numbered if another case has it."""
    base = re.sub(r"[^\w.+-]+", "_", name).strip("._") or "case"
    free, number = base, 2
    while free in taken:
        free, number = f"{base}-{number}", number + 1
    taken.add(free)
    return free
