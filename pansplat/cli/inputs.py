"""Arguments that several commands share, and the pair or scene that they choose.

Modules of this package import torch and everything that needs it inside functions, so that `--help` is fast.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from pansplat.errors import InputError
from pansplat.system.console import progress_bar
from pansplat.system.files import is_scene_file
from pansplat.system.options import Depth, Height, Positive, Seconds

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.pairs import Pair
    from pansplat.predictor import Predictor
    from pansplat.tours import TourGraph

Out = Annotated[Path, arg(aliases=["-o"])]
OptionalOut = Annotated[Path | None, arg(aliases=["-o"])]
Compat = Literal["trained", "official", "fixed"]
Precision = Literal["float32", "bfloat16"]


@dataclass(frozen=True)
class Writer:
    """A command that writes files."""

    overwrite: bool = field(default=False, kw_only=True)
    """Replace files that pansplat did not write, too."""


@dataclass(frozen=True)
class PairChoice:
    """How to read a panorama, a folder of panoramas or a web tour, and which of its pairs to use."""

    pair: str | None = None
    """Name or number (from 1) of the pair, if the folder holds several; the first by default."""
    convention: str | None = None
    """Pose convention, if the folder does not state it: "cam2world opencv", "cam2world opengl",
    "world2cam opencv" or "world2cam opengl" (Habitat and Blender use opengl)."""
    near: Depth | None = None
    """Nearest depth to search, metres; by default the folder's."""
    far: Depth | None = None
    """Farthest depth to search, metres; by default the folder's."""
    camera_height: Positive = 1.5
    """Height of the cameras over the floor, metres: the scale of a single photograph, and of a folder without poses."""


@dataclass(frozen=True)
class ModelChoice:
    """The predictor of a pair."""

    model: str = "default"
    """Predictor, for a pair: `default`, `sweep` (without weights), or a file of weights (.safetensors, or an official
    .ckpt)."""
    compat: Compat = "trained"
    """For a network: official computes what the official code does, fixed corrects its defects; by default the one
    that the weights were trained with, which is official for official weights."""
    precision: Precision = "float32"
    """Number type of a network's convolutions; bfloat16 is less exact, and faster if the processor supports it."""

    def load(self) -> Predictor:
        """The predictor; an InputError if there is none of that name or file, or it lacks the options."""
        from pansplat import pipeline

        return pipeline.load_model(self.model, compat=self.compat, precision=self.precision)


@dataclass(frozen=True)
class ScenePrediction:
    """How to predict the scene of a pair; unused for a scene file."""

    model: ModelChoice = field(default_factory=ModelChoice)
    refine: Seconds | None = None
    """Time limit of the refinement after the prediction, for a pair, seconds; 0 for none. 10 by default, for the page
    of a pair 30, for a file of other programs 20."""
    predict_height: Height | None = None
    """Height that the panoramas are resized to before the prediction, for a pair; by default that of the photographs,
    at most 1024 (for networks 512)."""
    choice: PairChoice = field(default_factory=PairChoice)

    def open(self, path: Path) -> Scene:
        """The scene of a scene file, or the prediction of a pair's folder."""
        from pansplat import pipeline

        if is_scene_file(path):
            return pipeline.load(path)
        return self._predict_pair(choose_pair(path, self.choice), None, joint=False)

    def open_panoramas(
        self, path: Path, gaussians: int | None = None, *, joint: bool = False
    ) -> tuple[Scene, Pair | TourGraph]:
        """The scene of the chosen pair, or of the first tour of a folder, and its panoramas in the scene's order.

        Args:
            path: the folder.
            gaussians: of a page; see `pansplat.predict_tour`.
            joint: see `pansplat.predict`; predictions of networks are returned as they are.
        """
        from pansplat import pipeline
        from pansplat.tours import connect, find_tours

        pairs = load_choice(path, self.choice)
        tours = find_tours(pairs) if self.choice.pair is None else []
        if not tours:
            pair = pick_pair(path, pairs, self.choice)
            return self._predict_pair(pair, gaussians, joint), pair
        alone = sum(a == b for a, b in tours[0].overlaps)
        kinds = f"{len(tours[0]) - alone} placed, {alone} not placed; " if alone else ""
        more = f"; {len(tours) - 1} other tours are left out" if len(tours) > 1 else ""
        print(
            f"note: {path}: a tour of {len(tours[0])} panoramas ({kinds}--pair chooses one pair){more}", file=sys.stderr
        )
        model = self.model.load()
        joint = joint and not pipeline.can_stream(model)
        with progress_bar() as progress:
            tour = connect(tours[0], progress)
            scene = pipeline.predict_tour(
                tour,
                model,
                height=self.predict_height,
                refine_seconds=self._choose_seconds(None, joint),
                gaussians=gaussians,
                joint=joint,
                progress=progress,
            )
        return scene, tour

    def predict_layers(self, source: Pair | TourGraph) -> Scene:
        """The unrefined scene of the panoramas of `open_panoramas` with all that each of them shows, from the cache."""
        from pansplat import pipeline
        from pansplat.inputs.pairs import Pair

        model = self.model.load()
        with progress_bar() as progress:
            if isinstance(source, Pair):
                return pipeline.predict(source, model, height=self.predict_height, progress=progress)
            return pipeline.predict_tour(source, model, height=self.predict_height, progress=progress)

    def _predict_pair(self, pair: Pair, gaussians: int | None, joint: bool) -> Scene:
        from pansplat import pipeline

        model = self.model.load()
        joint = joint and len(pair.context) > 1 and not pipeline.can_stream(model)
        seconds, height = self._choose_seconds(gaussians, joint), self.predict_height
        return predict_scene(pair, model, height, cache=True, refine_seconds=seconds, gaussians=gaussians, joint=joint)

    def _choose_seconds(self, gaussians: int | None, joint: bool) -> float:
        """The time limit of a refinement."""
        from pansplat import pipeline

        return pipeline.choose_refine_seconds(gaussians, joint=joint) if self.refine is None else self.refine


def choose_pair(path: Path, choice: PairChoice) -> Pair:
    """The chosen pair of a folder; without a choice the first one, with a note if there are more."""
    return pick_pair(path, load_choice(path, choice), choice)


def load_choice(path: Path, choice: PairChoice) -> list[Pair]:
    """The pairs of a folder."""
    from pansplat import pipeline

    return pipeline.load_pairs(
        path, convention=choice.convention, near=choice.near, far=choice.far, camera_height=choice.camera_height
    )


def pick_pair(path: Path, pairs: list[Pair], choice: PairChoice) -> Pair:
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


def predict_scene(
    pair: Pair,
    model: Predictor,
    height: int | None,
    *,
    cache: bool,
    refine_seconds: float = 0.0,
    gaussians: int | None = None,
    joint: bool = False,
) -> Scene:
    """Predict and refine a scene, and show a progress bar."""
    from pansplat import pipeline

    with progress_bar() as progress:
        return pipeline.predict(
            pair,
            model,
            height=height,
            refine_seconds=refine_seconds,
            gaussians=gaussians,
            joint=joint,
            cache=cache,
            progress=progress,
        )


def parse_blend(text: str) -> str | int:
    """The `blend` of `pansplat.render` for an argument: "deferred", "joint", or the number of "view0", "view1", ..."""
    if text in ("deferred", "joint"):
        return text
    number = text.removeprefix("view")
    if number.isascii() and number.isdecimal() and len(number) < 10:
        return int(number)
    raise InputError(f"--blend must be deferred, joint or view0, view1, ..., got {text!r}")
