"""The paper's evaluations: test sets, the metrics of one case, and one table per evaluation.

A test set has its name in the paper's tables. Metrics are computed for each target image; the value of a set is their
unweighted mean.

Source: PanSplat, section 4; docs/official.md, sections 2.1 to 2.4 and 13.
"""

from __future__ import annotations

import functools
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat import pipeline
from pansplat.errors import InputError
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import depth_errors
from pansplat.evaluation.report import error_image, measure_image, warm_up
from pansplat.evaluation.results import Row, average_rows, make_folder, write_json
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.images.image_files import write_image
from pansplat.inputs.views import Sample, Views
from pansplat.model.network import NetworkPredictor
from pansplat.pipeline import Drawing
from pansplat.predictor import Predictor
from pansplat.system.progress import stage
from pansplat.training.sequences import BoundedSampler, ImageSequence, read_frame_pair, read_loc360
from pansplat.training.sources import TripletSet, panogrf_folder, read_panogrf

LOC360 = "360Loc"

_SUBFOLDERS = {  # possible locations of a data set in the given folder
    "panogrf": (".", "pano_grf", "datasets/pano_grf"),
    LOC360: (".", "360Loc", "datasets/360Loc"),
}


@dataclass(frozen=True)
class EvaluationCase:
    """One scene of a set; `read(height)` loads its inputs and targets."""

    name: str
    read: Callable[[int], Sample]


@dataclass(frozen=True)
class EvaluationSet:
    """A test set of the paper, or what is missing of it.

    Attributes:
        name: as in the paper's tables, such as "M3D 1.0 m".
        cases: empty if the data is missing.
        missing: message that names the missing folder; empty if the data is there.
    """

    name: str
    cases: tuple[EvaluationCase, ...] = ()
    missing: str = ""


def find_panogrf_set(root: Path, title: str, name: str, distance: float, height: int) -> EvaluationSet:
    """PanoGRF triplets of one kind, with one distance (metres) from an input to the middle view."""
    for subfolder in _SUBFOLDERS["panogrf"]:
        try:
            (triplets,) = read_panogrf(root / subfolder, "test", height, [(name, distance)])
        except InputError:
            continue
        cases = [
            EvaluationCase(source.name, functools.partial(_read_triplet, triplets, index))
            for index, source in enumerate(triplets.sources)
        ]
        return EvaluationSet(title, tuple(cases))
    expected = panogrf_folder(root / "pano_grf", "test", name, distance, height)
    return EvaluationSet(
        title, missing=f"{title}: needed PanoGRF's scenes in {expected} (or in {root / expected.name})"
    )


def _read_triplet(triplets: TripletSet, index: int, height: int) -> Sample:
    pair = triplets.pair(index)
    return Sample(pair.name, pair.load_context(height), pair.load_targets(height))


def find_loc360_set(root: Path, pairs_per_sequence: int = 100) -> EvaluationSet:
    """Pairs spread evenly over the sequences of the test location; all frames from one to the other are targets."""
    for subfolder in _SUBFOLDERS[LOC360]:
        if (root / subfolder / "atrium").is_dir():
            sequences = read_loc360(root / subfolder, "test")
            return EvaluationSet(LOC360, tuple(_make_cases(sequences, pairs_per_sequence)))
    expected = root / "360Loc" / "atrium"
    return EvaluationSet(
        LOC360, missing=f"{LOC360}: needed {expected} (with camera_pose.json and image/ in mapping/*360*)"
    )


def _make_cases(sequences: Sequence[ImageSequence], pairs_per_sequence: int) -> Iterator[EvaluationCase]:
    for sequence in sequences:
        for pair in BoundedSampler().evaluation(len(sequence.poses), pairs_per_sequence):
            name = f"{sequence.name}-{pair.left:06d}-{pair.right:06d}"
            yield EvaluationCase(name, functools.partial(read_frame_pair, sequence, pair))


Blend = Literal["joint", "deferred"]


@dataclass(frozen=True)
class Method:
    """A predictor with its rendering options: a row of a table.

    Attributes:
        blend, drawing: see `pipeline.render`.
    """

    name: str
    predictor: Predictor
    blend: Blend
    drawing: Drawing = "exact"


def predict_case(context: Views, predictor: Predictor) -> tuple[Scene, Float[Tensor, "view _ _"] | None]:
    """The scene of a case's inputs, and their radial depth at the finest level in metres if a network predicts it."""
    masks = None if bool(context.masks.all()) else context.masks
    inputs = (context.images, context.cam2world, context.near, context.far)
    depth = None
    if isinstance(predictor, NetworkPredictor):
        gaussians, depths = predictor.predict_with_depths(*inputs, masks=masks)
        depth = depths[-1]
    else:
        gaussians = predictor(*inputs, masks=masks)
    assert isinstance(gaussians, Gaussians)  # a list is returned for a batch only
    scene = Scene(
        gaussians,
        context.cam2world,
        near=context.near,
        far=context.far,
        names=context.names,
        model=predictor.name,
        height=context.images.shape[-2],
    )
    return scene, depth


def measure_depth(context: Views, scene: Scene, depth: Float[Tensor, "view _ _"] | None) -> dict[str, float]:
    """Errors of the inputs' depth by name; empty without true depth.

    For a predictor without depth maps, the depth at each input is rendered from the Gaussians of that input.
    """
    if context.depths is None:
        return {}
    if depth is None:
        size = (context.images.shape[-2], context.images.shape[-1])
        with torch.no_grad():
            depths = [
                pipeline.render(scene, pose, blend=view, size=size).depth for view, pose in enumerate(context.cam2world)
            ]
        depth = torch.stack(depths)
    unit = context.frame.unit
    return depth_errors(depth * unit, context.depths * unit, context.near * unit, context.far * unit)


ProtocolName = Literal["m3d", "narrow", "replica", "residential", "360loc"]

# By protocol: name of the set in the table, its PanoGRF kind, and metres from an input to the middle view.
_PANOGRF: dict[str, tuple[tuple[str, str, float], ...]] = {
    "m3d": (("M3D 1.0 m", "m3d", 0.5), ("M3D 1.5 m", "m3d", 0.75), ("M3D 2.0 m", "m3d", 1.0)),
    "narrow": (("M3D 0.2 m", "m3d", 0.1), ("M3D 0.5 m", "m3d", 0.25)),
    "replica": (("Replica 1.0 m", "replica", 0.5),),
    "residential": (("Residential 0.3 m", "residential", 0.15),),
}
_DEPTH_SET = "M3D 1.0 m"  # the official code measures depth on this set only


@dataclass(frozen=True)
class ProtocolOptions:
    """Settings of an evaluation.

    Attributes:
        height: of the resized panoramas, pixels; the paper's is 512.
        limit: largest number of cases of a set, spread evenly; None for all, as in the paper.
        image_cases: number of cases whose images are written, for each set.
        pairs_per_sequence: number of pairs of a sequence, for 360Loc.
    """

    height: int = 512
    limit: int | None = None
    image_cases: int = 8
    pairs_per_sequence: int = 100


_METRICS = ("psnr", "ws_psnr", "ssim", "lpips", "abs_rel", "sq_rel", "rmse", "gaussians")


@dataclass
class ProtocolResult:
    """A whole evaluation.

    Attributes:
        lpips: name of the LPIPS metric, such as "lpips-vgg"; None without.
        rows: one for each set, method, case and target. Times in seconds, the number of Gaussians and errors of depth
            are those of the case.
        missing: a message for each set without data.
        skipped: a message for each case that could not be read.
    """

    protocol: str
    height: int
    lpips: str | None
    rows: list[Row] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def means(self) -> list[Row]:
        """The mean over the images of each set and method, with the number of `images`."""
        means = average_rows(self.rows, ("set", "method"))
        for mean in means:
            mean.case["images"] = len(self._list_rows(mean))
        return means

    def _list_rows(self, mean: Row) -> list[Row]:
        return [row for row in self.rows if all(row.get(name) == mean.get(name) for name in ("set", "method"))]

    def as_json(self) -> dict[str, object]:
        """The content of results.json."""
        results = [
            {
                **mean.case,
                **{metric: mean.get(metric) for metric in (*_METRICS, "predict_seconds", "render_seconds")},
                "scores": [row.as_json() for row in self._list_rows(mean)],
            }
            for mean in self.means()
        ]
        head = {"protocol": self.protocol, "height": self.height, "lpips": self.lpips}
        return {**head, "results": results, "missing": self.missing, "skipped": self.skipped}


def list_methods(
    predictor: Predictor, protocol: str, blend: Blend | None = None, name: str | None = None, drawing: Drawing = "exact"
) -> list[Method]:
    """The rows of a predictor in a protocol's table.

    On synthetic scenes the paper renders all Gaussians jointly; on real ones it compares that with deferred blending.
    The Gaussians of other predictors are made for deferred blending and rendered with it.

    Args:
        blend: the only blending; by default as above.
        name: of the predictor in the table; its own name by default.
        drawing: see `pipeline.render`.
    """
    blends: tuple[Blend, ...] = ("joint", "deferred") if protocol not in _PANOGRF else ("joint",)
    if blend is not None:
        blends = (blend,)
    elif not isinstance(predictor, NetworkPredictor):
        blends = ("deferred",)
    suffixes = {"joint": "", "deferred": " + deferred blending"}
    title = f"ours, {name or predictor.name}" + (", official rendering" if drawing == "original" else "")
    return [Method(f"{title}{suffixes[b]}", predictor, b, drawing) for b in blends]


def find_sets(protocol: ProtocolName, root: Path, options: ProtocolOptions) -> list[EvaluationSet]:
    """The protocol's sets, including those without data; an InputError if `root` or the data is invalid."""
    if not root.is_dir():
        raise InputError(f"{root}: needed the folder that holds the test data, got no such folder; check --data.")
    if protocol in _PANOGRF:
        return [find_panogrf_set(root, *kind, options.height) for kind in _PANOGRF[protocol]]
    return [find_loc360_set(root, options.pairs_per_sequence)]


def run_protocol(
    protocol: ProtocolName,
    root: Path,
    methods: Sequence[Method],
    out: Path,
    *,
    options: ProtocolOptions | None = None,
    lpips: Lpips | None = None,
) -> ProtocolResult:
    """Evaluate the methods on the available sets; results.json is written after every case."""
    options = options or ProtocolOptions()
    sets = find_sets(protocol, root, options)
    result = ProtocolResult(protocol, options.height, lpips.name if lpips else None)
    result.missing = [found.missing for found in sets if not found.cases]
    if len(result.missing) == len(sets):
        raise InputError(
            f"{root}: got none of the data of --protocol {protocol}. " + ". ".join(result.missing) + ". "
            "Download it, or give the folder that holds it as --data."
        )
    chosen = [(found, _take_evenly(found.cases, options.limit)) for found in sets if found.cases]
    total = sum(len(cases) for _, cases in chosen)
    for predictor in {id(method.predictor): method.predictor for method in methods}.values():
        with stage(0.0):
            warm_up(predictor)
    done = 0
    for test_set, cases in chosen:
        for number, case in enumerate(cases):
            folder = out / _slugify(test_set.name) / _slugify(case.name) if number < options.image_cases else None
            done += 1
            try:
                with stage(done / total, f"{test_set.name}: {case.name}: "):
                    result.rows += _run_case(case, test_set.name, methods, options.height, lpips, folder)
            except InputError as error:
                result.skipped.append(f"{test_set.name}, {case.name}: {error}")
            make_folder(out)
            write_json(result.as_json(), out / "results.json")
    if not result.rows:
        raise InputError(f"{root}: none of the {total} cases can be used. The first: {result.skipped[0]}")
    return result


def _run_case(
    case: EvaluationCase,
    set_name: str,
    methods: Sequence[Method],
    height: int,
    lpips: Lpips | None,
    folder: Path | None,
) -> list[Row]:
    """The rows of a case; methods with the same predictor share its prediction."""
    sample = case.read(height)
    predictions: dict[int, tuple[Scene, dict[str, float]]] = {}
    rows = []
    for method in methods:
        key = id(method.predictor)
        if key not in predictions:
            start = time.perf_counter()
            scene, depth = predict_case(sample.context, method.predictor)
            values = {"predict_seconds": time.perf_counter() - start, "gaussians": len(scene.gaussians)}
            if set_name == _DEPTH_SET:
                values |= measure_depth(sample.context, scene, depth)
            predictions[key] = scene, values
        scene, values = predictions[key]
        for index, target in enumerate(sample.targets.images):
            pose, size = sample.targets.cam2world[index], (target.shape[-2], target.shape[-1])
            start = time.perf_counter()
            with torch.no_grad():
                image = pipeline.render(
                    scene, pose, blend=method.blend, size=size, drawing=method.drawing
                ).color.float()
            seconds, name = time.perf_counter() - start, sample.targets.names[index]
            rows.append(
                Row(
                    {"set": set_name, "method": method.name, "case": sample.name, "target": name},
                    {**measure_image(image, target, lpips), **values, "render_seconds": seconds},
                )
            )
            if folder is not None:
                _write_images(folder, _slugify(name), _slugify(method.name), image, target)
    return rows


def _write_images(folder: Path, target_name: str, method: str, image: Tensor, target: Tensor) -> None:
    make_folder(folder)
    write_image(folder / f"{target_name}_target.png", target)
    write_image(folder / f"{target_name}_{method}.png", image)
    write_image(folder / f"{target_name}_{method}_error.png", error_image(image, target))


def _take_evenly(cases: Sequence[EvaluationCase], limit: int | None) -> Sequence[EvaluationCase]:
    """At most `limit` cases, spread evenly from the first to the last."""
    if limit is None or limit >= len(cases):
        return cases
    return [cases[i * (len(cases) - 1) // max(limit - 1, 1)] for i in range(limit)]


def _slugify(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "_", name).strip("._").lower() or "case"
