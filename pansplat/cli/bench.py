"""`pansplat bench`: time, memory and error of the rasterisers, the network, the viewer and others on this machine."""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta
from tyro.conf import Positional, subcommand

import pansplat
from pansplat.cli.evaluate import LpipsChoice, choose_lpips
from pansplat.cli.inputs import OptionalOut, PairChoice, Writer, choose_pair, predict_scene
from pansplat.errors import InputError
from pansplat.files import is_scene_file, require_output_folder, require_replaceable
from pansplat.options import Positive, Threads

if TYPE_CHECKING:
    from pansplat.bench.raster import BenchScene
    from pansplat.bench.report import Benchmark, Report
    from pansplat.data.pairs import Pair

_SAMPLE = Path(pansplat.__file__).parents[1] / "assets" / "living_room"
_MIN_SWEEP_HEIGHT = 64  # pixels
_LatticeHeight = Annotated[int, Meta(ge=16, le=4096, multiple_of=8)]
_WindowSide = Annotated[int, Meta(ge=64, le=8192)]
_TiledHeight = Annotated[int, Meta(ge=64, le=8192, multiple_of=32)]  # 4x4 tiles must fit the four levels


@dataclass(frozen=True)
class _Options(Writer):
    """Options of every benchmark."""

    json: Path | None = None
    """File for the rows; written after every row."""
    out: OptionalOut = None
    """Folder for NAME.json, NAME.md and NAME.png, with the name of the benchmark."""
    threads: Threads | None = None
    """The largest number of threads to use; by default torch's."""

    def _open_report(self, benchmark: Benchmark, **header: object) -> Report:
        """Refuse missing folders, set the number of threads, and begin a report."""
        from pansplat.bench.harness import describe_machine
        from pansplat.bench.report import Report

        require_replaceable("--json", filter(None, [self.json]), self.overwrite)
        if self.out is not None:
            require_output_folder("--out", self.out)
            files = [self.out / f"{benchmark.name}{suffix}" for suffix in (".json", ".md", ".png")]
            require_replaceable("--out", files, self.overwrite)
            self.out.mkdir(parents=True, exist_ok=True)
        if self.json is not None and not self.json.resolve().parent.is_dir():
            raise InputError(f"cannot write {self.json}: its folder does not exist; create it first")
        self._set_threads()
        return Report(benchmark, {"machine": describe_machine(), **header}, json_file=self.json, out=self.out)

    def _set_threads(self) -> int:
        """Set torch's number of threads, and return it."""
        import torch

        if self.threads is not None:
            torch.set_num_threads(self.threads)
        return torch.get_num_threads()


@dataclass(frozen=True)
class BenchRaster(_Options):
    """Measure the rasterisers: time and memory against error, for every choice of kernel, order, filter and faces."""

    scene: Positional[Path | None] = None
    """A scene file, or the folder of a pair for `sweep`; by default a synthetic room, and the sample if it is there."""
    quick: bool = False
    """Some minutes on two cores instead of an hour: all choices at reduced height only."""
    height: Annotated[int, Meta(ge=16, le=8192, multiple_of=8)] = 512
    """Height of the panoramas, pixels; a multiple of 8."""

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        import torch

        from pansplat.bench.raster import (
            RASTER,
            RasterBench,
            choice_height,
            list_raster_groups,
            make_room_scene,
            make_sample_group,
        )

        report = self._open_report(RASTER)
        threads, small = self._set_threads(), choice_height(self.height, quick=self.quick)
        backends = ["numba", "triton"] if torch.cuda.is_available() else ["numba"]
        whole = None if self.scene is None else self._open_scene(self.scene, self.height)
        if len(backends) == 1:
            print("without triton: there is no CUDA device")
        with report:
            bench = RasterBench(report, budget=1.0 if self.quick else 8.0, slow=3.0 if self.quick else 5.0)
            scene_of = make_room_scene if whole is None else lambda height: whole
            bench.run(list_raster_groups(scene_of, self.height, backends, threads, quick=self.quick))
            if whole is None and _SAMPLE.is_dir():
                bench.run([make_sample_group(self._open_scene(_SAMPLE, small), small, backends, threads)])
        return 0

    def _open_scene(self, path: Path, height: int) -> BenchScene:
        """The scene of a file or a pair, seen from between its cameras, or from the origin if it has none."""
        import torch

        from pansplat import pipeline
        from pansplat.bench.raster import BenchScene

        if is_scene_file(path):
            scene = pipeline.load(path)
        else:
            pair, model = choose_pair(path, PairChoice()), pipeline.load_model("sweep")
            scene = predict_scene(pair, model, max(height, _MIN_SWEEP_HEIGHT), cache=True)
        pose = scene.pose_between(0.5) if len(scene.cam2world) else torch.eye(4, dtype=torch.float64)
        return BenchScene(path.stem, lambda: scene.gaussians, pose)


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
        from pansplat.model.weights import load_weights

        weights = "random (seed 0): images are meaningless" if self.model is None else self.model.name
        report = self._open_report(MODEL, weights=weights)
        folder = self.pair or _SAMPLE
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder; give one with --pair (the sample is in the repository only)")
        views = choose_pair(folder, PairChoice()).load_context(self.height)
        bfloat16 = has_bfloat16()
        cases = list_model_cases(self._set_threads(), bfloat16=bfloat16, quick=self.quick)
        with tempfile.TemporaryDirectory() as temporary:
            file = self.model or Path(temporary, "random.safetensors")
            if self.model is None:
                save_random_weights(file)
            elif (found := load_weights(file).model) != "pansplat":
                raise InputError(f"{self.model}: the benchmark needs weights of PanSplat, got those of {found}")
            if not bfloat16:
                print("without bfloat16: this processor has no instructions for it")
            with report:
                measure_model(cases, views, file, report, scene=folder.name)
        return 0


@dataclass(frozen=True)
class BenchMemory(_Options):
    """Measure the memory of a training step and of a prediction over resolutions, for each way of backpropagation.

    Every row runs in a process of its own. With --out, the same command continues an interrupted run.
    """

    preset: Literal["tiny", "small", "paper"] = "small"
    """Size of the network; weights are random."""
    heights: tuple[_TiledHeight, ...] = (128, 256, 512, 1024)
    """Heights of the panoramas, pixels; multiples of 32. Above 512 only the heads are trained, as in the paper."""
    quick: bool = False
    """Without one-step and 4 tiles."""
    limit_gb: Positive = 8.0
    """Largest memory of a row, 10^9 bytes. Rows that exceed it are ended, and measured again if another
    limit is given."""
    style: Literal["panorama", "cubemap", "original"] = "cubemap"
    """How images are rendered; as training's --memory.style."""
    perceptual: Literal["structure", "lpips-vgg", "lpips-alex", "lpips-squeeze"] = "structure"
    """Part of the loss; LPIPS needs its weights."""

    def run(self) -> int:
        """Measure, print the table and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.memory import MEMORY, MemoryBench, MemoryCase, MemorySetting, list_memory_cases
        from pansplat.bench.model import save_random_weights
        from pansplat.training.network import network_config

        limit_gib = self.limit_gb * 1e9 / 2**30
        setting = MemorySetting(self.preset, self.style, self.perceptual, self._set_threads(), limit_gib)
        cases = list_memory_cases(self.heights, quick=self.quick)
        report = self._open_report(MEMORY, setting=asdict(setting))
        retry = not report.resume(MemoryCase)
        with tempfile.TemporaryDirectory() as folder, report:
            weights = Path(folder, "random.safetensors")
            save_random_weights(weights, network_config(setting.network))
            MemoryBench(setting, weights, report, retry).run(cases)
        return 0


@dataclass(frozen=True)
class BenchRefine(_Options):
    """Measure image error against seconds and Gaussians: cross-fade, predictors, and their refinement."""

    paths: Positional[tuple[Path, ...]] = ()
    """Folders of pairs with targets; by default the sample, if it is there."""
    quick: bool = False
    """Height 256 and one time limit only."""
    lpips: LpipsChoice = field(default_factory=LpipsChoice)

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.refine import REFINE, RefineBench, list_refine_cases

        pairs = _load_with_targets(self.paths)
        cases = list_refine_cases(quick=self.quick)
        lpips = choose_lpips(self.lpips, min(case.height for case in cases))
        with self._open_report(REFINE, lpips=None if lpips is None else lpips.name) as report:
            RefineBench(report, lpips).run(pairs, cases)
        return 0


@dataclass(frozen=True)
class BenchFlights(_Options):
    """Measure pictures on the way between two panoramas: mixed, drawn jointly, and of each panorama alone."""

    paths: Positional[tuple[Path, ...]] = ()
    """Folders of pairs with targets, such as those of `pansplat-homes flights`; by default the sample."""
    model: str = "default"
    """Name of a predictor, or weights."""
    height: Annotated[int, Meta(ge=64, le=8192, multiple_of=8)] = 512
    """Height of the panoramas, pixels."""
    lpips: LpipsChoice = field(default_factory=LpipsChoice)

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.flights import FLIGHTS, measure_flights

        pairs, lpips = _load_with_targets(self.paths), choose_lpips(self.lpips, self.height)
        with self._open_report(FLIGHTS, lpips=None if lpips is None else lpips.name, height=self.height) as report:
            measure_flights(pairs, self.model, self.height, lpips, report)
        return 0


@dataclass(frozen=True)
class BenchViewer(_Options):
    """Measure the viewer's frames: each renderer, moving and turning, joint and deferred, over counts of Gaussians.

    With --out, the same command continues an interrupted run, and further --heights add rows.
    """

    heights: tuple[_LatticeHeight, ...] = (256, 512, 1024)
    """Heights of the panoramas whose lattices hold the Gaussians: 221,642, 886,580 and 3,546,326; multiples of 8."""
    size: tuple[_WindowSide, _WindowSide] = (1280, 720)
    """Width and height of the window, pixels."""
    renderers: tuple[Literal["cpu", "gl33", "gl43"], ...] = ("cpu", "gl33", "gl43")
    """Renderers to measure, for a run in pieces."""
    quick: bool = False
    """The smallest height only, few frames."""

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.viewer import VIEWER, ViewerBench, ViewerCase, list_viewer_cases

        report = self._open_report(VIEWER)
        report.resume(ViewerCase)
        with report:
            bench = ViewerBench(report, repeats=3 if self.quick else 9, threads=self._set_threads())
            for height in sorted(self.heights)[: 1 if self.quick else None]:
                bench.run(height, list_viewer_cases(self.size, self.renderers))
        return 0


@dataclass(frozen=True)
class BenchPose(_Options):
    """Measure estimated camera poses against known ones: every pair, and all panoramas of each folder together."""

    paths: Positional[tuple[Path, ...]] = ()
    """Folders of panoramas with poses; by default the sample, if it is there."""
    camera_height: Positive = 1.5
    """Mean height of the cameras over the floor, metres."""
    tours: Literal["no", "also", "only"] = "no"
    """Whether to estimate all panoramas of each folder together: not, beside its pairs, or instead of them."""

    def run(self) -> int:
        """Measure, print the tables and write the files; exit status 1 if a wrong pose passed the check."""
        from pansplat.bench.pose import POSE, measure_folder

        paths = _paths_or_sample(self.paths)
        with self._open_report(POSE) as report:
            for path in paths:
                measure_folder(
                    path, report, camera_height=self.camera_height, pairs=self.tours != "only", tours=self.tours != "no"
                )
        return int(any(row.get("outcome") == "wrong" for row in report.rows))


@dataclass(frozen=True)
class BenchFormats(_Options):
    """Compare the file formats of scenes: size, error of each field, error of the image, time."""

    path: Positional[Path] = field(kw_only=True)
    """A scene file."""
    degree: Annotated[int, Meta(ge=0, le=3)] | None = None
    """Degree of the harmonics that are written; by default that of the scene. Missing ones are made at random."""
    height: Annotated[int, Meta(ge=16, le=4096)] = 256
    """Of the panoramas that are compared, pixels."""

    def run(self) -> int:
        """Measure each format, print the table and write the files."""
        from pansplat import pipeline
        from pansplat.bench.formats import FORMATS, measure_formats, set_degree

        report = self._open_report(FORMATS)
        scene = pipeline.load(self.path)
        if not len(scene.gaussians):
            raise InputError(f"{self.path}: needed Gaussians, got none; give another scene")
        if self.degree is not None:
            scene = set_degree(scene, self.degree)
        with report:
            measure_formats(scene, self.height, report, name=f"{self.path.name}: {len(scene.gaussians):,} Gaussians")
        return 0


@dataclass(frozen=True)
class Bench:
    """Measure speed, memory and error on this machine."""

    what: (
        Annotated[BenchRaster, subcommand("raster")]
        | Annotated[BenchModel, subcommand("model")]
        | Annotated[BenchMemory, subcommand("memory")]
        | Annotated[BenchRefine, subcommand("refine")]
        | Annotated[BenchFlights, subcommand("flights")]
        | Annotated[BenchViewer, subcommand("viewer")]
        | Annotated[BenchPose, subcommand("pose")]
        | Annotated[BenchFormats, subcommand("formats")]
    )

    def run(self) -> int:
        """Run the chosen benchmark."""
        return self.what.run()


def _paths_or_sample(paths: tuple[Path, ...]) -> tuple[Path, ...]:
    """The folders, by default the sample."""
    if not paths and not _SAMPLE.is_dir():
        raise InputError("give a folder (the sample is in the repository only)")
    return paths or (_SAMPLE,)


def _load_with_targets(paths: tuple[Path, ...]) -> list[Pair]:
    """The pairs of folders, by default of the sample, that have targets."""
    from pansplat import pipeline

    found = [pair for path in _paths_or_sample(paths) for pair in pipeline.load_pairs(path)]
    pairs = [pair for pair in found if pair.targets]
    if not pairs:
        raise InputError(f"none of the {len(found)} pairs has a target view to compare with")
    return pairs
