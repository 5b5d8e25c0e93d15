"""Arguments that several commands share, and the pair or scene that they choose.

Modules of this package import torch and everything that needs it inside functions, so that `--help` is fast.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from pansplat.errors import InputError
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat.system.descriptions import describe_count
from pansplat.system.devices import Device
from pansplat.system.files import is_scene_file
from pansplat.system.options import Height
from pansplat.system.progress import CONNECTED, POSED, stage

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.panorama_sets import PanoramaSet
    from pansplat.tours.graph import TourGraph

Out = Annotated[Path, arg(aliases=["-o"])]
OptionalOut = Annotated[Path | None, arg(aliases=["-o"])]


@dataclass(frozen=True)
class Writer:
    """A command that writes files."""

    overwrite: bool = field(default=False, kw_only=True)
    """Replace files that pansplat did not write, too."""


@dataclass(frozen=True)
class Computation(Writer):
    """A command that computes what it writes."""

    device: Device = field(default="auto", kw_only=True)
    """auto: the graphics card for long work if there is one that torch can use, else the processor; cpu, cuda: for all
    work (docs/platforms.md)."""
    verbose: bool = field(default=False, kw_only=True)
    """Print what runs where, and the figures of reasons."""


@dataclass(frozen=True)
class PairChoice:
    """How to read a panorama, a folder of panoramas or a web tour, and which of its pairs to use."""

    pair: str | None = None
    """Name or number (from 1) of the pair, if the folder holds several; the first by default. For an export also the
    name of a tour."""
    reading: Annotated[ReadOptions, arg(name="")] = field(default_factory=ReadOptions)


@dataclass(frozen=True)
class SceneOptions(PredictOptions):
    """How the scene of panoramas is predicted and refined; unused for a scene file."""

    height: Annotated[Height | None, arg(name="predict-height")] = None


@dataclass(frozen=True)
class ScenePrediction:
    """How the scene of a path is predicted."""

    options: Annotated[PredictOptions, arg(name="prediction", prefix_name=False, constructor=SceneOptions)] = field(
        default_factory=SceneOptions
    )
    choice: Annotated[PairChoice, arg(prefix_name=False)] = field(default_factory=PairChoice)

    def open(self, path: Path) -> tuple[Scene, PanoramaSet | None]:
        """The scene of a scene file, or the prediction of a pair's folder, and the pair."""
        from pansplat import pipeline

        if is_scene_file(path):
            return pipeline.load(path), None
        pair = choose_set(path, self.choice)
        return predict_scene(pair, self.options), pair

    def open_panoramas(
        self, path: Path, gaussians: int | None = None, *, joint: bool = False
    ) -> tuple[Scene, PanoramaSet | TourGraph]:
        """The scene of the chosen pair, or of the first tour of a folder, and its panoramas in the scene's order.

        Args:
            path: the folder.
            gaussians: of a page; see `pansplat.predict_tour`.
            joint: see `pansplat.predict`; predictions of networks are returned as they are.
        """
        from pansplat.tours.graph import find_tours
        from pansplat.tours.overlap import connect

        pairs = load_choice(path, self.choice)
        tours = [tour for tour in find_tours(pairs) if self.choice.pair in (None, tour.name)]
        options = replace(self.options, gaussians=gaussians, joint=joint)
        if not tours:
            pair = pick_set(path, pairs, self.choice)
            return predict_scene(pair, options), pair
        alone = sum(a == b for a, b in tours[0].overlaps)
        kinds = f"{len(tours[0]) - alone} placed, {alone} not placed; " if alone else ""
        more = f"; left out: {describe_count(len(tours) - 1, 'other tour')}" if len(tours) > 1 else ""
        count = describe_count(len(tours[0]), "panorama")
        print(f"note: {path}: a tour of {count} ({kinds}--pair chooses one pair){more}", file=sys.stderr)
        with stage(CONNECTED):
            tour = connect(tours[0])
        return predict_scene(tour, options), tour


def choose_set(path: Path, choice: PairChoice) -> PanoramaSet:
    """The chosen pair of a folder; without a choice the first one, with a note if there are more."""
    return pick_set(path, load_choice(path, choice), choice)


def load_choice(path: Path, choice: PairChoice) -> list[PanoramaSet]:
    """The pairs of a folder."""
    from pansplat import pipeline

    with stage(POSED):
        return pipeline.load_sets(path, **vars(choice.reading))


def pick_set(path: Path, pairs: list[PanoramaSet], choice: PairChoice) -> PanoramaSet:
    """The chosen one of the pairs of a folder; without a choice the first one, with a note if there are more."""
    names = [pair.name for pair in pairs]
    listed = ", ".join(f"{number}: {name}" for number, name in enumerate(names, 1))
    if choice.pair is None:
        if len(pairs) > 1:
            print(f"note: {path} holds {len(pairs)} pairs, using the first (--pair takes: {listed})", file=sys.stderr)
        return pairs[0]
    if choice.pair in names:
        return pairs[names.index(choice.pair)]
    numbered = {str(number): pair for number, pair in enumerate(pairs, 1)}
    if choice.pair in numbered:
        return numbered[choice.pair]
    raise InputError(f"--pair {choice.pair}: {path} holds {listed}")


def predict_scene(source: PanoramaSet | TourGraph, options: PredictOptions) -> Scene:
    """Predict and refine the scene of a pair or tour; networks draw layers jointly."""
    from pansplat import pipeline
    from pansplat.inputs.panorama_sets import PanoramaSet

    model = pipeline.load_predictor(options)
    options = replace(options, joint=options.joint and not pipeline.can_stream(model))
    if isinstance(source, PanoramaSet):
        return pipeline.predict(source, model, options=options)
    return pipeline.predict_tour(source, model, options=options)


def parse_blend(text: str) -> str | int:
    """The `blend` of `pansplat.render` for an argument: "deferred", "joint", or the number of "view0", "view1", ..."""
    if text in ("deferred", "joint"):
        return text
    number = text.removeprefix("view")
    if number.isascii() and number.isdecimal() and len(number) < 10:
        return int(number)
    raise InputError(f"--blend must be deferred, joint or view0, view1, ..., got {text!r}")
