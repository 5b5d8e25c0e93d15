"""`pansplat bench`: time, memory and error of the rasterisers, the network, the viewer and others on this machine."""

from __future__ import annotations

import itertools
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta
from tyro.conf import Positional, subcommand

import pansplat
from pansplat.cli.evaluate import LpipsChoice, choose_lpips
from pansplat.cli.inputs import OptionalOut, PairChoice, Writer, choose_set, predict_scene
from pansplat.errors import InputError
from pansplat.prediction_options import PredictOptions
from pansplat.system.files import require_output_folder, require_replaceable
from pansplat.system.options import CAMERA_HEIGHT, MIN_HEIGHT, Positive, Threads

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pansplat.bench.harness import Suite
    from pansplat.evaluation.results import Row

_SAMPLE = Path(pansplat.__file__).parents[1] / "assets" / "living_room"
_LatticeHeight = Annotated[int, Meta(ge=16, le=4096, multiple_of=8)]
_WindowSide = Annotated[int, Meta(ge=64, le=8192)]


@dataclass(frozen=True)
class _Options(Writer):
    """Options of every benchmark."""

    out: OptionalOut = None
    """Folder for NAME.json, NAME.md and NAME.png, with the name of the benchmark; rows are written as they come."""
    threads: Threads | None = None
    """The largest number of threads to use; by default torch's."""

    def _check(self, name: str) -> int:
        """Refuse files and folders that cannot be written; set the number of threads, and return it."""
        import torch

        if self.out is not None:
            require_output_folder("--out", self.out)
            files = [self.out / f"{name}{suffix}" for suffix in (".json", ".md", ".png")]
            require_replaceable("--out", files, self.overwrite)
            self.out.mkdir(parents=True, exist_ok=True)
        if self.threads is not None:
            torch.set_num_threads(self.threads)
        return torch.get_num_threads()

    def _run(self, suite: Suite, rows: Iterable[Row], **header: object) -> list[Row]:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.harness import run

        return run(suite, rows, header, self.out)


@dataclass(frozen=True)
class BenchRaster(_Options):
    """Measure the rasterisers: time and memory against error, for panoramas, cube faces and the official drawing."""

    quick: bool = False
    """Fewer repeats, and 128 rows by default: about 20 seconds on two idle cores."""
    height: Annotated[int, Meta(ge=16, le=8192, multiple_of=8)] | None = None
    """Height of the panoramas, pixels, 512 by default; a multiple of 8."""

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        import torch

        from pansplat.bench import raster

        height = self.height or (128 if self.quick else 512)
        threads, small = self._check("raster"), raster.choice_height(height)
        backends = ["numba", "triton"] if torch.cuda.is_available() else ["numba"]
        if len(backends) == 1:
            print("without triton: there is no CUDA device")
        groups = raster.list_raster_groups(height, backends, threads)
        if _SAMPLE.is_dir():
            options = PredictOptions("sweep", height=max(small, MIN_HEIGHT), refine_steps=0)
            scene = predict_scene(choose_set(_SAMPLE, PairChoice()), options)
            sample = raster.BenchScene(_SAMPLE.stem, lambda: scene.gaussians, scene.pose_between(0.5))
            groups.append(raster.make_sample_group(sample, small, backends, threads))
        budget = 0.2 if self.quick else 2.0
        self._run(raster.RASTER, raster.measure_raster(groups, budget=budget))
        return 0


@dataclass(frozen=True)
class BenchModel(_Options):
    """Measure the network: seconds of each part and memory against error, for each precision and way to run it."""

    model: Path | None = None
    """Weights of PanSplat (.safetensors); by default random ones, which take the same time."""
    pair: Path | None = None
    """Folder of a pair; by default the sample, if it is there."""
    height: Annotated[int, Meta(ge=64, le=8192, multiple_of=64)] = 512
    """Panoramas are resized to this height, pixels; a multiple of 64, so that 4x4 tiles fit."""
    quick: bool = False
    """Precisions only, without tiles and the official code's defects."""

    def run(self) -> int:
        """Measure, print the table and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.model import MODEL, list_model_cases, measure_model, save_random_weights
        from pansplat.model.network import has_bfloat16
        from pansplat.networks.weights import load_weights

        weights = "random (seed 0): images are meaningless" if self.model is None else self.model.name
        threads = self._check("model")
        folder = self.pair or _SAMPLE
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder; give one with --pair (the sample is in the repository only)")
        views = choose_set(folder, PairChoice()).load_context(self.height)
        bfloat16 = has_bfloat16()
        cases = list_model_cases(threads, bfloat16=bfloat16, quick=self.quick)
        with tempfile.TemporaryDirectory() as temporary:
            file = self.model or Path(temporary, "random.safetensors")
            if self.model is None:
                save_random_weights(file)
            elif (found := load_weights(file).model) != "pansplat":
                raise InputError(f"{self.model}: the benchmark needs weights of PanSplat, got those of {found}")
            if not bfloat16:
                print("without bfloat16: this processor has no instructions for it")
            self._run(MODEL, measure_model(cases, views, file, folder.name), weights=weights)
        return 0


@dataclass(frozen=True)
class BenchRefine(_Options):
    """Measure image error against steps and Gaussians: cross-fade, predictors, and their refinement."""

    paths: Positional[tuple[Path, ...]] = ()
    """Folders of pairs with targets; by default the sample, if it is there."""
    quick: bool = False
    """Height 256 and one number of steps only."""
    lpips: LpipsChoice = field(default_factory=LpipsChoice)

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        from pansplat import pipeline
        from pansplat.bench.refine import REFINE, list_refine_cases, measure_refine

        self._check("refine")
        found = [pair for path in _paths_or_sample(self.paths) for pair in pipeline.load_sets(path)]
        pairs = [pair for pair in found if pair.targets]
        if not pairs:
            raise InputError(f"none of the {len(found)} pairs has a target view to compare with")
        cases = list_refine_cases(quick=self.quick)
        lpips = choose_lpips(self.lpips, min(case.height for case in cases))
        self._run(REFINE, measure_refine(pairs, cases, lpips), lpips=None if lpips is None else lpips.name)
        return 0


@dataclass(frozen=True)
class BenchViewer(_Options):
    """Measure the viewer's frames: each renderer, moving and turning, joint and deferred, over counts of Gaussians."""

    heights: tuple[_LatticeHeight, ...] = (256, 512, 1024)
    """Heights of the panoramas whose lattices hold the Gaussians: 221,642, 886,580 and 3,546,326; multiples of 8."""
    size: tuple[_WindowSide, _WindowSide] = (1280, 720)
    """Width and height of the window, pixels."""
    renderers: tuple[Literal["cpu", "gl"], ...] = ("cpu", "gl")
    """Renderers to measure, for a run in pieces."""
    quick: bool = False
    """The smallest height only, few frames."""

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.viewer import VIEWER, list_viewer_cases, measure_viewer

        threads, repeats = self._check("viewer"), 3 if self.quick else 9
        cases = list_viewer_cases(self.size, self.renderers)
        heights = sorted(self.heights)[: 1 if self.quick else None]
        rows = (measure_viewer(height, cases, repeats=repeats, threads=threads) for height in heights)
        self._run(VIEWER, itertools.chain.from_iterable(rows))
        return 0


@dataclass(frozen=True)
class BenchPose(_Options):
    """Measure estimated camera poses against known ones: every pair, and all panoramas of each folder together."""

    paths: Positional[tuple[Path, ...]] = ()
    """Folders of panoramas with poses; by default the sample, if it is there."""
    camera_height: Positive = CAMERA_HEIGHT
    """Mean height of the cameras over the floor, metres."""
    tours: Literal["no", "also", "only"] = "no"
    """Whether to estimate all panoramas of each folder together: not, beside its pairs, or instead of them."""

    def run(self) -> int:
        """Measure, print the tables and write the files; exit status 1 if a wrong pose passed the check."""
        from pansplat.bench.pose import POSE, measure_folder

        self._check("pose")
        options = {"camera_height": self.camera_height, "pairs": self.tours != "only", "tours": self.tours != "no"}
        found = itertools.chain.from_iterable(measure_folder(path, **options) for path in _paths_or_sample(self.paths))
        return int(any(row.get("outcome") == "wrong" for row in self._run(POSE, found)))


@dataclass(frozen=True)
class Bench:
    """Measure speed, memory and error on this machine."""

    what: (
        Annotated[BenchRaster, subcommand("raster")]
        | Annotated[BenchModel, subcommand("model")]
        | Annotated[BenchRefine, subcommand("refine")]
        | Annotated[BenchViewer, subcommand("viewer")]
        | Annotated[BenchPose, subcommand("pose")]
    )

    def run(self) -> int:
        """Run the chosen benchmark."""
        return self.what.run()


def _paths_or_sample(paths: tuple[Path, ...]) -> tuple[Path, ...]:
    """The folders, by default the sample."""
    if not paths and not _SAMPLE.is_dir():
        raise InputError("give a folder (the sample is in the repository only)")
    return paths or (_SAMPLE,)
