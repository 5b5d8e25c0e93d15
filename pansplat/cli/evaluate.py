"""`pansplat evaluate`: predictions against the panoramas between the inputs."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

from tyro.conf import Fixed, Positional, Suppress, arg

from pansplat.cli.inputs import Computation, Out, parse_blend
from pansplat.errors import InputError
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat.system.console import make_table_console, progress_bar
from pansplat.system.descriptions import describe_count
from pansplat.system.files import require_output_folder, require_replaceable
from pansplat.system.options import CountOrNone, Height

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pansplat.evaluation.lpips import Backbone, Lpips
    from pansplat.inputs.panorama_sets import PanoramaSet

_WRITTEN = "results.json", "*/prediction.png", "*/target.png", "*/error.png"
_HEIGHT = 512  # rows of the paper's panoramas


@dataclass(frozen=True)
class _Prediction(PredictOptions):
    """How scenes are predicted. The cache is not used, so that times are valid."""

    height: Height | None = _HEIGHT
    """Panoramas and targets are resized to this height, pixels."""
    refine_steps: Annotated[CountOrNone | None, arg(name="refine")] = 0
    """Steps of the refinement after the prediction; 0 for none."""
    cache: Annotated[bool, Fixed, Suppress] = False


@dataclass(frozen=True)
class LpipsChoice:
    """Whether to measure LPIPS, and with which weights."""

    lpips: Literal["auto", "vgg", "alex", "squeeze", "none"] = "auto"
    """Backbone of LPIPS; the paper uses vgg. auto: the first whose weights are found, if any."""
    lpips_weights: Path | None = None
    """Folder of its weights; by default the environment variable PANSPLAT_LPIPS, or the torch.hub cache."""


@dataclass(frozen=True)
class Evaluate(Computation):
    """Compare predictions with the real panoramas between the inputs, and with the cross-fade baseline."""

    paths: Positional[tuple[Path, ...]]
    """Folders of pairs; pairs without target views are skipped."""
    out: Out
    """Folder for results.json and, for each case, prediction.png, target.png and error.png."""
    prediction: _Prediction = field(default_factory=_Prediction)
    blend: str = "deferred"
    """deferred, joint, or view0, view1, .... For joint, each surface is kept once, except of networks."""
    drawing: Literal["exact", "original"] = "exact"
    """exact, or original: render as the official code does, to compare with its published figures."""
    leave_one_out: bool = False
    """Instead of targets: each panorama of a tour against the scene that the tour without it shows there."""
    reading: ReadOptions = field(default_factory=ReadOptions)
    lpips: LpipsChoice = field(default_factory=LpipsChoice)

    def run(self) -> int:
        """Evaluate all pairs with targets in the folders and print the table."""
        from pansplat import pipeline
        from pansplat.evaluation.report import evaluate, results_table

        require_output_folder("--out", self.out)
        require_replaceable("--out", [file for name in _WRITTEN for file in self.out.glob(name)], self.overwrite)
        if not self.paths:
            raise InputError("`pansplat evaluate` needs at least one folder of pairs")
        blend, height = parse_blend(self.blend), self.prediction.height or _HEIGHT
        lpips = choose_lpips(self.lpips, height)
        pairs = []
        for path in self.paths:
            found = pipeline.load_sets(path, **vars(self.reading))
            if self.leave_one_out:
                with_targets = _leave_out_each(path, found)
            else:
                with_targets = [pair for pair in found if pair.targets]
                if not with_targets:
                    count = describe_count(len(found), "pair")
                    print(f"note: {path}: no target view in {count}; skipped", file=sys.stderr)
            pairs += with_targets
        predictor = pipeline.load_predictor(self.prediction)
        with progress_bar():
            cases = evaluate(
                pairs,
                predictor,
                self.out,
                height=height,
                refine_steps=self.prediction.refine_steps or 0,
                blend=blend,
                drawing=self.drawing,
                lpips=lpips,
            )
        make_table_console().print(results_table(cases))
        if lpips is not None:
            print(f"LPIPS is {lpips.name}")
        print(f"{self.out / 'results.json'} and the images of each case")
        return 0


def _leave_out_each(path: Path, pairs: Sequence[PanoramaSet]) -> list[PanoramaSet]:
    """A pair for each panorama of the tours of a folder that has others in its part; the rest are named."""
    from pansplat.tours.graph import find_tours
    from pansplat.tours.overlap import connect
    from pansplat.tours.scene_views import leave_out

    tours = find_tours(pairs)
    if not tours:
        raise InputError(
            f"{path}: --leave-one-out needed a tour of three or more panoramas with poses, got "
            f"{len({view.image for pair in pairs for view in pair.context})} panoramas; add some"
        )
    found = []
    for tour in map(connect, tours):
        alone = [n for n in range(len(tour)) if not tour.neighbours(n)]
        if alone:
            names = ", ".join(tour.panoramas[n].name for n in alone)
            print(f"note: {path}: not left out, because no other panorama shows the same: {names}", file=sys.stderr)
        found += [leave_out(tour, n) for n in range(len(tour)) if n not in alone]
    return found


def choose_lpips(choice: LpipsChoice, height: int) -> Lpips | None:
    """The chosen LPIPS; None for "none", or if "auto" finds no weights or the images are too small."""
    from pansplat.evaluation.lpips import MIN_IMAGE_SIZE, find_backbone, load_lpips

    if choice.lpips == "none":
        return None
    if choice.lpips != "auto":
        return load_lpips(cast("Backbone", choice.lpips), choice.lpips_weights)
    backbone = find_backbone(choice.lpips_weights) if height >= MIN_IMAGE_SIZE else None
    return load_lpips(backbone, choice.lpips_weights) if backbone else None
