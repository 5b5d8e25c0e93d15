"""The evaluations of the paper, a table each, on whatever of their data is here.

Source: PanSplat, section 4; OFFICIAL.md, section 13: figures of each target image, then their plain mean over a set.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pansplat.atomic import replacing
from pansplat.data.images import write_image
from pansplat.errors import InputError
from pansplat.evaluation.data_sets import (
    INSTA360,
    LOC360,
    EvaluationCase,
    EvaluationSet,
    frame_distance_set,
    panogrf_set,
    sequence_set,
    sequences_of,
)
from pansplat.evaluation.depth_metrics import DepthErrors
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.report import error_picture, warm_up
from pansplat.evaluation.score import (
    Blend,
    Drawn,
    Method,
    Score,
    draw_targets,
    mean_depth_errors,
    measure_depth,
    predict_case,
)
from pansplat.model.network import NetworkPredictor
from pansplat.pipeline import Drawing
from pansplat.predictor import Predictor, Progress

ProtocolName = Literal["m3d", "narrow", "replica", "residential", "360loc", "insta360", "ablation", "frame-distance"]

# By protocol: the table's name of a set, PanoGRF's, and metres from an input to the middle view.
_PANOGRF: dict[str, tuple[tuple[str, str, float], ...]] = {
    "m3d": (("M3D 1.0 m", "m3d", 0.5), ("M3D 1.5 m", "m3d", 0.75), ("M3D 2.0 m", "m3d", 1.0)),
    "narrow": (("M3D 0.2 m", "m3d", 0.1), ("M3D 0.5 m", "m3d", 0.25)),
    "replica": (("Replica 1.0 m", "replica", 0.5),),
    "residential": (("Residential 0.3 m", "residential", 0.15),),
    "ablation": (("M3D 1.0 m", "m3d", 0.5),),
}
_DEPTH_SET = "M3D 1.0 m"  # the only one whose depth the paper's code measures


@dataclass(frozen=True)
class ProtocolOptions:
    """How an evaluation is run.

    Attributes:
        height: panoramas are resized to it, pixels; the paper's is 512.
        limit: at most so many cases a set, spread evenly over it; None for all, as in the paper.
        pictures: of so many cases a set pictures are written.
        draws: pairs a sequence, for 360Loc and Insta360.
        gaps: frames between the inputs, for the figure over the frame distance.
    """

    height: int = 512
    limit: int | None = None
    pictures: int = 8
    draws: int = 100
    gaps: tuple[int, ...] = (4, 8, 12, 16, 20, 24, 28, 32)


@dataclass
class SetResult:
    """What one method reached on one set.

    Attributes:
        depth: errors of each case whose inputs have a true depth.
        gaussians: of each case.
        predict_seconds, render_seconds: of each prediction, and of each picture.
    """

    set: str
    method: str
    scores: list[Score] = field(default_factory=list)
    depth: list[DepthErrors] = field(default_factory=list)
    gaussians: list[int] = field(default_factory=list)
    predict_seconds: list[float] = field(default_factory=list)
    render_seconds: list[float] = field(default_factory=list)

    def mean(self, metric: str) -> float | None:
        """Mean of a metric over the set's images (of depth over its scenes); None where it was not measured."""
        if metric == "gaussians":
            return _mean(self.gaussians)
        if metric in ("abs_rel", "sq_rel", "rmse"):
            errors = mean_depth_errors(self.depth)
            return None if errors is None else getattr(errors, metric)
        values = [getattr(score, metric) for score in self.scores]
        return None if None in values else _mean(values)

    def as_json(self) -> dict[str, object]:
        """What results.json says."""
        metrics = ("psnr", "ws_psnr", "ssim", "lpips", "abs_rel", "sq_rel", "rmse", "gaussians")
        return {
            "set": self.set,
            "method": self.method,
            "images": len(self.scores),
            **{metric: self.mean(metric) for metric in metrics},
            "predict_seconds": _mean(self.predict_seconds),
            "render_seconds": _mean(self.render_seconds),
            "scores": [dataclasses.asdict(score) for score in self.scores],
        }


@dataclass
class ProtocolResult:
    """A whole evaluation.

    Attributes:
        lpips: which classifier LPIPS asked, such as "lpips-vgg"; None without.
        missing: a line for each set whose data is not here.
        skipped: a line for each case that could not be read.
    """

    protocol: str
    height: int
    lpips: str | None
    sets: list[SetResult] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """What results.json holds; numbers that are not finite become null."""
        return {
            "protocol": self.protocol,
            "height": self.height,
            "lpips": self.lpips,
            "results": _finite([result.as_json() for result in self.sets]),
            "missing": self.missing,
            "skipped": self.skipped,
        }


def methods_of(
    predictor: Predictor,
    protocol: str,
    blend: Blend | None = None,
    name: str | None = None,
    drawing: Drawing = "exact",
) -> list[Method]:
    """The rows a predictor gets in a protocol's table.

    On rendered scenes the paper draws all Gaussians together, on real ones it compares that with deferred blending. A
    predictor that is no network is drawn with deferred blending only: its Gaussians are made for that.

    Args:
        blend: this one only.
        name: what to call the predictor; its own name by default.
        drawing: see `pipeline.render`.
    """
    blends: tuple[Blend, ...] = ("joint", "deferred") if protocol not in _PANOGRF else ("joint",)
    if blend is not None:
        blends = (blend,)
    elif not isinstance(predictor, NetworkPredictor):
        blends = ("deferred",)
    words = {"joint": "", "deferred": " + deferred blending"}
    called = f"ours, {name or predictor.name}" + (", drawn as the original" if drawing == "original" else "")
    return [Method(f"{called}{words[b]}", predictor, b, drawing) for b in blends]


def sets_of(protocol: ProtocolName, root: Path, options: ProtocolOptions) -> list[EvaluationSet]:
    """The protocol's sets, those whose data is missing included.

    Raises:
        InputError: when `root` is no folder, or data is there and wrong.
    """
    if not root.is_dir():
        raise InputError(f"{root}: needed the folder that holds the test data, got no such folder; check --data.")
    if protocol in _PANOGRF:
        return [panogrf_set(root, *kind, options.height) for kind in _PANOGRF[protocol]]
    if protocol in ("360loc", "insta360"):
        return [sequence_set(root, LOC360 if protocol == "360loc" else INSTA360, options.draws)]
    sequences, missing = sequences_of(root, INSTA360)
    if not sequences:
        sequences, also = sequences_of(root, LOC360)
        missing = f"{missing}; or {also}"
    if not sequences:
        return [EvaluationSet("frame distance", missing=missing)]
    return [frame_distance_set(sequences, gap, options.draws) for gap in options.gaps]


def run_protocol(
    protocol: ProtocolName,
    root: Path,
    methods: Sequence[Method],
    out: Path,
    *,
    options: ProtocolOptions | None = None,
    lpips: Lpips | None = None,
    progress: Progress | None = None,
) -> ProtocolResult:
    """Evaluate the methods on what is here; results.json is written after every case, pictures beside it.

    Raises:
        InputError: when none of the data is here (it names the folders), or none of it can be read, or `out` cannot be
            written.
    """
    options = options or ProtocolOptions()
    sets = sets_of(protocol, root, options)
    result = ProtocolResult(protocol, options.height, lpips.name if lpips else None)
    result.missing = [found.missing for found in sets if not found.cases]
    if len(result.missing) == len(sets):
        raise InputError(
            f"{root}: got none of the data of --protocol {protocol}. " + ". ".join(result.missing) + ". "
            "Fetch it, or give the folder that holds it as --data."
        )
    chosen = [(found, _spread(found.cases, options.limit)) for found in sets if found.cases]
    total = sum(len(cases) for _, cases in chosen)
    for predictor in {id(method.predictor): method.predictor for method in methods}.values():
        warm_up(predictor)
    done = 0
    for found, cases in chosen:
        rows = [SetResult(found.name, method.name) for method in methods]
        result.sets += rows
        for number, case in enumerate(cases):
            if progress is not None:
                progress(f"{found.name}: {case.name}", done / total)
            folder = out / _slug(found.name) / _slug(case.name) if number < options.pictures else None
            try:
                _run_case(case, methods, rows, options.height, lpips, folder)
            except InputError as error:
                result.skipped.append(f"{found.name}, {case.name}: {error}")
            done += 1
            write_json(result, out / "results.json")
    if not any(row.scores for row in result.sets):
        raise InputError(f"{root}: none of the {total} cases can be used. The first: {result.skipped[0]}")
    return result


def write_json(result: ProtocolResult, path: Path) -> None:
    """Write what was measured so far, atomically; the folder is made.

    Raises:
        InputError: it cannot be written.
    """
    _make_folder(path.parent)
    with replacing(path) as partial:
        partial.write_text(json.dumps(result.as_json(), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _run_case(
    case: EvaluationCase,
    methods: Sequence[Method],
    rows: Sequence[SetResult],
    height: int,
    lpips: Lpips | None,
    folder: Path | None,
) -> None:
    """Add a case to the rows of the methods; a predictor that several of them share predicts once."""
    sample = case.read(height)
    predictions = {}
    for method, row in zip(methods, rows, strict=True):
        key = id(method.predictor)
        if key not in predictions:
            predictions[key] = predict_case(sample.context, method.predictor)
        prediction = predictions[key]
        row.predict_seconds.append(prediction.seconds)
        row.gaussians.append(len(prediction.scene.gaussians))
        if row.set == _DEPTH_SET:
            errors = measure_depth(sample.context, prediction)
            row.depth += [errors] if errors is not None and math.isfinite(errors.rmse) else []
        for drawn in draw_targets(sample, prediction, method.blend, lpips, method.drawing):
            row.scores.append(drawn.score)
            row.render_seconds.append(drawn.seconds)
            if folder is not None:
                _write_pictures(folder, method.name, drawn)


def _write_pictures(folder: Path, method: str, drawn: Drawn) -> None:
    _make_folder(folder)
    stem = _slug(drawn.score.target)
    write_image(folder / f"{stem}_target.png", drawn.target)
    write_image(folder / f"{stem}_{_slug(method)}.png", drawn.picture)
    write_image(folder / f"{stem}_{_slug(method)}_error.png", error_picture(drawn.picture, drawn.target))


def _spread(cases: Sequence[EvaluationCase], limit: int | None) -> Sequence[EvaluationCase]:
    """At most `limit` cases, evenly spread from the first to the last."""
    if limit is None or limit >= len(cases):
        return cases
    return [cases[i * (len(cases) - 1) // max(limit - 1, 1)] for i in range(limit)]


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {folder} ({error.strerror}); choose another --out") from error


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "_", name).strip("._").lower() or "case"


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _finite(value: object) -> object:
    """The same with null for numbers that JSON has no word for."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
