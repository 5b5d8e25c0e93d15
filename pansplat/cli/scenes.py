"""From a command's arguments to pairs and scenes; `pansplat predict`."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pansplat import pipeline
from pansplat.cli.commands import PairChoice, Predict, Render
from pansplat.errors import InputError
from pansplat.gaussians.scene import prune

if TYPE_CHECKING:
    from pansplat import predictor
    from pansplat.data.pairs import Pair
    from pansplat.gaussians.scene import Scene

_HELD_HEIGHT = 512  # networks write taller predictions tile by tile, and keep none


def run_predict(command: Predict) -> int:
    """Predict, save, and tell how long it took."""
    if command.out.suffix.lower() != ".ply" or not command.out.resolve().parent.is_dir():
        raise InputError(f"--out must be a .ply file in an existing folder, got {command.out}")
    require_height(command.height)
    pair = choose_pair(command.path, command.choice)
    if command.degree is not None and not 0 <= command.degree <= 4:
        raise InputError(f"--degree must be 0 to 4, got {command.degree}")
    if not 0 <= command.min_opacity < 1:
        raise InputError(f"--min-opacity must be at least 0 and less than 1, got {command.min_opacity}")
    model = pipeline.load_model(command.model, compat=command.compat, precision=command.precision)
    began = time.perf_counter()
    count = _predict_to_file(command, pair, model)
    took = time.perf_counter() - began
    names = ", ".join(panorama.name for panorama in pair.context)
    print(f"{command.out}: {count:,} Gaussians from {names} in {took:.1f} s")
    return 0


def _predict_to_file(command: Predict, pair: Pair, model: predictor.Predictor) -> int:
    """Write the prediction, tile by tile where it is large; how many Gaussians it has."""
    if command.height > _HELD_HEIGHT and pipeline.can_stream(model):
        with progress_bar() as progress:
            return pipeline.predict_to_file(
                pair,
                command.out,
                model,
                height=command.height,
                degree=command.degree,
                min_opacity=command.min_opacity,
                progress=progress,
            )
    scene = predict(pair, model, command.height, cache=not command.no_cache)
    gaussians = prune(scene.gaussians, degree=command.degree, min_opacity=command.min_opacity)
    pipeline.save(dataclasses.replace(scene, gaussians=gaussians), command.out)
    return len(gaussians)


def choose_pair(path: Path, choice: PairChoice) -> Pair:
    """The pair of a folder that was asked for by name or number; the first, with a note, when none was."""
    pairs = pipeline.load_pairs(path, convention=choice.convention, near=choice.near, far=choice.far)
    names = [pair.name for pair in pairs]
    if choice.pair is None:
        if len(pairs) > 1:
            listed = ", ".join(f"{i}: {name}" for i, name in enumerate(names, 1))
            print(
                f"note: {path} holds {len(pairs)} pairs, this is the first (--pair takes: {listed})",
                file=sys.stderr,
            )
        return pairs[0]
    if choice.pair in names:
        return pairs[names.index(choice.pair)]
    if choice.pair.isdecimal() and 1 <= int(choice.pair) <= len(pairs):
        return pairs[int(choice.pair) - 1]
    raise InputError(f"--pair {choice.pair}: {path} holds {', '.join(f'{i}: {n}' for i, n in enumerate(names, 1))}")


def open_scene(command: Render) -> Scene:
    """The scene of a .ply file, or the prediction of a pair's folder."""
    if command.path.suffix.lower() == ".ply":
        return pipeline.load(command.path)
    require_height(command.predict_height)
    pair = choose_pair(command.path, command.choice)
    model = pipeline.load_model(command.model, compat=command.compat, precision=command.precision)
    return predict(pair, model, command.predict_height, cache=True)


def predict(pair: Pair, model: predictor.Predictor, height: int, *, cache: bool) -> Scene:
    """Predict behind a progress bar."""
    with progress_bar() as progress:
        return pipeline.predict(pair, model, height=height, cache=cache, progress=progress)


def require_height(height: int) -> None:
    """Refuse heights that no panorama pyramid fits."""
    if not 16 <= height <= 8192 or height % 2:
        raise InputError(f"--height must be an even number of 16 to 8192 pixels, got {height}")


def blend_mode(text: str) -> str | int:
    """What `pipeline.render` calls the mode that a user names: deferred, joint, view0, view1, ..."""
    if text in ("deferred", "joint"):
        return text
    number = text.removeprefix("view")
    if number.isdecimal():
        return int(number)
    raise InputError(f"--blend must be deferred, joint or view0, view1, ..., got {text!r}")


@contextmanager
def progress_bar() -> Iterator[predictor.Progress]:
    """A bar on standard error that goes when the work is done; nothing where that is no terminal."""
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %")
    with Progress(
        *columns, TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("", total=1.0)

        def report(what: str, fraction: float) -> None:
            bar.update(task, description=what, completed=fraction)

        yield report
