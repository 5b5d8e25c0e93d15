"""Arguments that several commands share, and the pair or scene that they choose.

Modules of this package import torch and everything that needs it inside functions, so that `--help` is fast.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from pansplat.errors import InputError
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat.system.descriptions import describe_count
from pansplat.system.devices import Device, measure_free_memory
from pansplat.system.files import is_scene_file
from pansplat.system.options import Height
from pansplat.system.progress import CONNECTED, POSED, stage

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.panorama_sets import PanoramaSet
    from pansplat.tours.graph import TourGraph

Out = Annotated[Path, arg(aliases=["-o"])]
_PREDICTION_MEMORY, _SCENE_MEMORY = 2.6e9, 1e9  # bytes of the default prediction and refinement; of its scene
# Bytes for a pixel of a photograph that is read, and of one in a page (docs/web.md).
_READ_MEMORY, _PAGE_MEMORY = 14, 42
_PAGE_ROWS = 4096  # most rows of a photograph in a page
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
    """Name of a tour, or name or number (from 1) of a pair, if the folder holds several; by default the first tour,
    else the first pair."""
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

    def open(
        self, path: Path, choose_count: Callable[[Sequence[int]], int] | None = None, *, joint: bool = False
    ) -> tuple[Scene, PanoramaSet | TourGraph | None]:
        """The scene of a scene file, or that of the chosen pair or tour, and its panoramas in the scene's order.

        Args:
            path: the scene file or folder.
            choose_count: the number of Gaussians that is needed beside photographs of some heights.
            joint: see `pansplat.predict`.
        """
        from pansplat import pipeline
        from pansplat.images.image_files import read_height

        if is_scene_file(path):
            return pipeline.load(path), None
        source, count = choose_source(path, self.choice), None
        if choose_count is not None:
            count = choose_count([read_height(view.image) for view in source.panoramas])
        return pipeline.predict(source, options=replace(self.options, gaussians=count, joint=joint)), source


def choose_source(path: Path, choice: PairChoice) -> PanoramaSet | TourGraph:
    """The chosen pair or tour of a path; without a choice the first tour, else the first pair, with a note if there are
    more."""
    from pansplat.tours.graph import find_tours
    from pansplat.tours.overlap import connect

    pairs = _load_sets(path, choice)
    _note_memory(path, pairs)
    tours = [tour for tour in find_tours(pairs) if choice.pair in (None, tour.name)]
    if not tours:
        return _pick_set(path, pairs, choice)
    alone = sum(a == b for a, b in tours[0].overlaps)
    kinds = f"{len(tours[0]) - alone} placed, {alone} not placed; " if alone else ""
    more = f"; left out: {describe_count(len(tours) - 1, 'other tour')}" if len(tours) > 1 else ""
    count = describe_count(len(tours[0]), "panorama")
    print(f"note: {path}: a tour of {count} ({kinds}--pair chooses one pair){more}", file=sys.stderr)
    with stage(CONNECTED):
        return connect(tours[0])


def choose_set(path: Path, choice: PairChoice) -> PanoramaSet:
    """The chosen pair of a folder; without a choice the first one, with a note if there are more."""
    return _pick_set(path, _load_sets(path, choice), choice)


def _load_sets(path: Path, choice: PairChoice) -> list[PanoramaSet]:
    from pansplat import pipeline

    with stage(POSED):
        return pipeline.load_sets(path, **vars(choice.reading))


def _note_memory(path: Path, pairs: Sequence[PanoramaSet]) -> None:
    """Print the memory that is needed if less is free. Photographs are read, and put into a page, one at a time."""
    from pansplat.images.image_files import read_height

    rows = max(map(read_height, {view.image for pair in pairs for view in pair.context}), default=0)
    tall = _READ_MEMORY * 2 * rows**2 + _PAGE_MEMORY * 2 * min(rows, _PAGE_ROWS) ** 2
    needed, free = max(_PREDICTION_MEMORY, _SCENE_MEMORY + tall), measure_free_memory()
    if needed > free:
        have = f"takes about {needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are free"
        print(f"note: {path}: {have}; photographs have up to {rows} rows, smaller copies take less", file=sys.stderr)


def _pick_set(path: Path, pairs: list[PanoramaSet], choice: PairChoice) -> PanoramaSet:
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


def parse_blend(text: str) -> str | int:
    """The `blend` of `pansplat.render` for an argument: "deferred", "joint", or the number of "view0", "view1", ..."""
    if text in ("deferred", "joint"):
        return text
    number = text.removeprefix("view")
    if number.isascii() and number.isdecimal() and len(number) < 10:
        return int(number)
    raise InputError(f"--blend must be deferred, joint or view0, view1, ..., got {text!r}")
