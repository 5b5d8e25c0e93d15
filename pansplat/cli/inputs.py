"""Arguments that several commands share, the pair or scene that they choose, and a progress bar.

Modules of this package import torch and everything that needs it inside functions, so that `--help` is fast.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from pansplat.errors import InputError

if TYPE_CHECKING:
    from pansplat.data.pairs import Pair
    from pansplat.gaussians.scene import Scene
    from pansplat.predictor import Predictor, Progress

Out = Annotated[Path, arg(aliases=["-o"])]
OptionalOut = Annotated[Path | None, arg(aliases=["-o"])]
Compat = Literal["trained", "official", "fixed"]
Precision = Literal["float32", "bfloat16"]


@dataclass(frozen=True)
class PairChoice:
    """How to read a folder of panoramas, and which of its pairs to use."""

    pair: str | None = None
    """Name or number (from 1) of the pair, if the folder holds several; the first by default."""
    convention: str | None = None
    """Pose convention, if the folder does not state it: "cam2world opencv", "cam2world opengl",
    "world2cam opencv" or "world2cam opengl" (Habitat and Blender use opengl)."""
    near: float | None = None
    """Nearest depth to search, metres; by default the folder's."""
    far: float | None = None
    """Farthest depth to search, metres; by default the folder's."""


def choose_pair(path: Path, choice: PairChoice) -> Pair:
    """The chosen pair of a folder; without a choice the first one, with a note if there are more."""
    from pansplat import pipeline

    pairs = pipeline.load_pairs(path, convention=choice.convention, near=choice.near, far=choice.far)
    names = [pair.name for pair in pairs]
    listed = ", ".join(f"{number}: {name}" for number, name in enumerate(names, 1))
    if choice.pair is None:
        if len(pairs) > 1:
            print(f"note: {path} holds {len(pairs)} pairs, using the first (--pair takes: {listed})", file=sys.stderr)
        return pairs[0]
    if choice.pair in names:
        return pairs[names.index(choice.pair)]
    if choice.pair.isdecimal() and 1 <= int(choice.pair) <= len(pairs):
        return pairs[int(choice.pair) - 1]
    raise InputError(f"--pair {choice.pair}: {path} holds {listed}")


def predict_scene(pair: Pair, model: Predictor, height: int, *, cache: bool, refine_seconds: float = 0.0) -> Scene:
    """Predict and refine a scene, and show a progress bar."""
    from pansplat import pipeline

    with progress_bar() as progress:
        return pipeline.predict(
            pair, model, height=height, refine_seconds=refine_seconds, cache=cache, progress=progress
        )


def require_output(option: str, path: Path, suffix: str) -> None:
    """Refuse an output file with another suffix, or in a folder that does not exist."""
    if path.suffix.lower() != suffix or not path.resolve().parent.is_dir():
        raise InputError(f"{option} must be a {suffix} file in an existing folder, got {path}")


def require_refine(seconds: float) -> None:
    """Refuse a time limit of the refinement that is negative or not finite."""
    if not 0 <= seconds < math.inf:
        raise InputError(f"--refine must be a number of seconds, 0 for none, got {seconds}")


def require_height(height: int) -> None:
    """Refuse panorama heights that the predictors do not support."""
    if not 16 <= height <= 8192 or height % 2:
        raise InputError(f"--height must be an even number of 16 to 8192 pixels, got {height}")


def parse_blend(text: str) -> str | int:
    """The `blend` of `pansplat.render` for an argument: "deferred", "joint", or the number of "view0", "view1", ..."""
    if text in ("deferred", "joint"):
        return text
    number = text.removeprefix("view")
    if number.isdecimal():
        return int(number)
    raise InputError(f"--blend must be deferred, joint or view0, view1, ..., got {text!r}")


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A temporary bar on standard error; nothing if that is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %")
    with Progress(
        *columns, TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("", total=1.0)

        def report(stage: str, fraction: float) -> None:
            bar.update(task, description=stage, completed=fraction)

        yield report
