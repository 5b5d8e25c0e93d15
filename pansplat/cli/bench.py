"""`pansplat bench`: time, memory and error of the rasterisers, the network and the viewer on this machine."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, subcommand

import pansplat
from pansplat.cli.evaluate import LpipsChoice, choose_lpips
from pansplat.cli.inputs import OptionalOut, PairChoice, choose_pair, predict_scene
from pansplat.console import make_table_console
from pansplat.errors import InputError
from pansplat.files import is_scene_file, require_output_folder
from pansplat.options import WHOLE, Positive, Range, Threads

if TYPE_CHECKING:
    from pansplat.bench.memory import MemorySetting
    from pansplat.bench.raster_cases import BenchScene, Settings
    from pansplat.gaussians.scene import Scene

_SAMPLE = Path(pansplat.__file__).parents[1] / "assets" / "living_room"
_MIN_SWEEP_HEIGHT = 64  # pixels
_RASTER_BACKENDS = ("numba", "triton")
_DEFAULT_MEMORY = 16e9  # bytes, if the system does not report its memory
_LatticeHeight = Annotated[int, Range(16, 4096, "pixels", multiple=8), WHOLE]
_WindowSide = Annotated[int, Range(64, 8192, "pixels"), WHOLE]
_TiledHeight = Annotated[int, Range(64, 8192, "pixels", multiple=32), WHOLE]  # 4x4 tiles must fit the four levels
_RANDOM_WEIGHTS = "PanSplat with random weights (seed 0): times and memory are valid, images are meaningless"


@dataclass(frozen=True)
class BenchRaster:
    """Measure the rasterisers: time and memory against error, for every choice of kernel, order, filter and faces."""

    scene: Positional[Path | None] = None
    """A scene file, or the folder of a pair for `sweep`; by default a synthetic room, and the sample if it is there."""
    quick: bool = False
    """Some minutes on two cores instead of an hour: all choices at reduced height only."""
    json: Path | None = None
    """File for the rows; written after every image."""
    plot: Path | None = None
    """Plot of time against error (.png, .svg, .pdf); the costs over counts and resolutions go to NAME_sweeps."""
    out: OptionalOut = None
    """Folder for raster.json, raster.md, raster.png and raster_sweeps.png."""
    height: Annotated[int, Range(16, 8192, "pixels", multiple=8), WHOLE] = 512
    """Height of the panoramas, pixels; a multiple of 8."""
    threads: Threads | None = None
    """The largest number of threads to use; by default torch's."""

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.harness import describe_machine
        from pansplat.bench.raster import RasterBench, make_raster_report
        from pansplat.bench.raster_cases import (
            list_raster_groups,
            make_room_scene,
            make_sample_group,
        )

        json, plot, page = self._files()
        settings = self._settings()
        scene_of = make_room_scene if self.scene is None else self._scene_of(self.scene, self.height)
        budget, slow = (1.0, 3.0) if self.quick else (8.0, 5.0)
        machine = describe_machine(settings.threads)
        with make_raster_report(machine, json=json, plot=plot, page=page) as report:
            bench = RasterBench(report, budget=budget, slow=slow)
            bench.run(list_raster_groups(settings, scene_of, synthetic=self.scene is None))
            if self.scene is None and _SAMPLE.is_dir():
                small = settings.choice_height
                bench.run([make_sample_group(settings, self._scene_of(_SAMPLE, small)(small))])
        return 0

    def _files(self) -> tuple[Path | None, Path | None, Path | None]:
        """The files of rows, plot and tables; refuses missing folders before the work."""
        json, plot, page = self.json, self.plot, None
        if self.out is not None:
            _make_output_folder(self.out)
            json, plot = json or self.out / "raster.json", plot or self.out / "raster.png"
            page = self.out / "raster.md"
        for file in (json, plot):
            _require_folder(file)
        if plot is not None and plot.suffix.lower() not in (".png", ".svg", ".pdf"):
            raise InputError(f"--plot must end in .png, .svg or .pdf, got {plot}")
        return json, plot, page

    def _settings(self) -> Settings:
        """The settings of the run; prints the backends that are left out, with the reason."""
        from pansplat.bench.raster_cases import Settings
        from pansplat.bench.renderers import unavailable_reason

        threads = _choose_threads(self.threads)
        available = []
        for name in _RASTER_BACKENDS:
            reason = unavailable_reason(name)
            if reason is None:
                available.append(name)
            else:
                print(f"without {name}: {reason}")
        return Settings(self.height, self.quick, threads, tuple(available), _find_usable_memory())

    def _scene_of(self, path: Path, height: int) -> Callable[[int], BenchScene]:
        """The scene of a file or a pair, seen from between its cameras, or from the origin if it has none."""
        import torch

        from pansplat.bench.raster_cases import BenchScene

        scene = self._read_scene(path, height)
        pose = scene.pose_between(0.5) if len(scene.cam2world) else torch.eye(4, dtype=torch.float64)
        return lambda _: BenchScene(path.stem, lambda: scene.gaussians, pose)

    def _read_scene(self, path: Path, height: int) -> Scene:
        """The scene of a file, or the prediction of a pair's folder by `sweep`."""
        from pansplat import pipeline

        if is_scene_file(path):
            return pipeline.load(path)
        pair = choose_pair(path, PairChoice())
        model = pipeline.load_model("sweep")
        return predict_scene(pair, model, max(height, _MIN_SWEEP_HEIGHT), cache=True)


@dataclass(frozen=True)
class BenchModel:
    """Measure the network: seconds of each part and memory against error, for each precision and way to run it."""

    model: Path | None = None
    """Weights of PanSplat (.safetensors); by default random ones, which take the same time."""
    pair: Path | None = None
    """Folder of a pair; by default the sample, if it is there."""
    height: Annotated[int, Range(64, 8192, "pixels", multiple=64), WHOLE] = 512
    """Panoramas are resized to this height, pixels; a multiple of 64, so that 4x4 tiles fit."""
    quick: bool = False
    """Precisions only, without tiles, a single thread and the official code's defects."""
    json: Path | None = None
    """File for the rows; written after every row."""
    out: OptionalOut = None
    """Folder for model.json, model.md and model.png."""
    threads: Threads | None = None
    """The largest number of threads to use; by default torch's."""

    def run(self) -> int:
        """Measure, print the table and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.harness import describe_machine
        from pansplat.bench.model import list_model_cases, make_model_report, measure_model
        from pansplat.model.network import has_bfloat16

        json = _choose_rows_file(self.json, self.out, "model.json")
        threads = _choose_threads(self.threads)
        folder = self.pair or _SAMPLE
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder; give one with --pair (the sample is in the repository only)")
        views = choose_pair(folder, PairChoice()).load_context(self.height)
        machine = describe_machine(threads)
        bfloat16 = has_bfloat16()
        cases = list_model_cases(threads, bfloat16=bfloat16, quick=self.quick)
        with (
            self._weights() as (weights, network),
            make_model_report(machine, network, height=self.height, json=json, out=self.out) as report,
        ):
            if not bfloat16:
                print("without bfloat16: this processor has no instructions for it")
            measure_model(cases, views, weights, report, scene=folder.name)
        return 0

    @contextmanager
    def _weights(self) -> Iterator[tuple[Path, str]]:
        """The file of weights, and a description of them."""
        from pansplat.bench.model import save_random_weights
        from pansplat.model.weights import load_weights

        if self.model is not None:
            weights = load_weights(self.model)
            if weights.model != "pansplat":
                raise InputError(f"{self.model}: the benchmark needs weights of PanSplat, got those of {weights.model}")
            yield self.model, f"PanSplat with the weights of {self.model.name}"
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "random.safetensors")
            save_random_weights(path)
            yield path, _RANDOM_WEIGHTS


@dataclass(frozen=True)
class BenchMemory:
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
    """Largest memory of a row, 10^9 bytes. Rows expected to need more are skipped; rows that exceed it are ended."""
    style: Literal["panorama", "cubemap", "original"] = "cubemap"
    """How images are rendered; as training's --memory.style."""
    perceptual: Literal["structure", "lpips-vgg", "lpips-alex", "lpips-squeeze"] = "structure"
    """Part of the loss; LPIPS needs its weights."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a GPU if there is one; its memory is that of torch's allocator."""
    threads: Threads | None = None
    """Threads to use; by default torch's."""
    out: OptionalOut = None
    """Folder for memory.json, memory.md and memory.png."""

    def run(self) -> int:
        """Measure, print the table and write the files; an interruption keeps the measured rows."""
        from pansplat.bench.harness import describe_machine
        from pansplat.bench.memory import MemoryBench, list_memory_cases, make_memory_report, read_rows
        from pansplat.bench.model import save_random_weights
        from pansplat.training.network import network_config

        setting = self._setting()
        cases = list_memory_cases(self.heights, quick=self.quick)
        with tempfile.TemporaryDirectory() as temporary:
            folder = self.out or Path(temporary)
            _make_output_folder(folder)
            rows = read_rows(folder / "memory.json", setting)
            weights = Path(temporary, "random.safetensors")
            save_random_weights(weights, network_config(setting.network))
            references = folder / "references"
            references.mkdir(exist_ok=True)
            with make_memory_report(describe_machine(setting.threads), setting, cases, self.out) as report:
                report.rows += rows
                MemoryBench(setting, weights, references, report).run(cases)
            shutil.rmtree(references, ignore_errors=True)  # only an interrupted run needs them
        return 0

    def _setting(self) -> MemorySetting:
        import torch

        from pansplat.bench.memory import MemorySetting

        threads = _choose_threads(self.threads)
        if self.device == "cuda" and not torch.cuda.is_available():
            raise InputError("--device cuda needs a CUDA device that torch can use, got none; use --device cpu.")
        cuda = self.device == "cuda" or (self.device == "auto" and torch.cuda.is_available())
        device, limit_gib = "cuda" if cuda else "cpu", self.limit_gb * 1e9 / 2**30
        return MemorySetting(self.preset, self.style, self.perceptual, threads, device, limit_gib)


@dataclass(frozen=True)
class BenchRefine:
    """Measure image error against seconds and Gaussians: cross-fade, predictors, and their refinement."""

    paths: Positional[tuple[Path, ...]] = ()
    """Folders of pairs with targets; by default the sample, if it is there."""
    quick: bool = False
    """Height 256 and one time limit only."""
    json: Path | None = None
    """File for the rows; written after every row."""
    out: OptionalOut = None
    """Folder for refine.json, refine.md and refine.png."""
    threads: Threads | None = None
    """Threads to use; by default torch's."""
    lpips: LpipsChoice = field(default_factory=LpipsChoice)

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        import torch

        from pansplat import pipeline
        from pansplat.bench.harness import describe_machine
        from pansplat.bench.refine import RefineBench, list_refine_cases, make_refine_report

        json = _choose_rows_file(self.json, self.out, "refine.json")
        if not self.paths and not _SAMPLE.is_dir():
            raise InputError("give a folder of pairs with targets (the sample is in the repository only)")
        found = [pair for path in self.paths or (_SAMPLE,) for pair in pipeline.load_pairs(path)]
        pairs = [pair for pair in found if pair.targets]
        if not pairs:
            raise InputError(f"none of the {len(found)} pairs has a target view to compare with")
        cases = list_refine_cases(quick=self.quick)
        lpips = choose_lpips(self.lpips, min(case.height for case in cases))
        threads = _choose_threads(self.threads)
        torch.set_num_threads(threads)
        name = None if lpips is None else lpips.name
        with make_refine_report(describe_machine(threads), name, json=json, out=self.out) as report:
            RefineBench(report, lpips).run(pairs, cases)
        return 0


@dataclass(frozen=True)
class BenchViewer:
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
    out: OptionalOut = None
    """Folder for viewer.json, viewer.md and viewer.png."""
    threads: Threads | None = None
    """Threads to use; by default torch's."""

    def run(self) -> int:
        """Measure, print the tables and write the files; an interruption keeps the measured rows."""
        import torch

        from pansplat.bench.harness import describe_machine
        from pansplat.bench.viewer import ViewerBench, list_viewer_cases, make_viewer_report, read_viewer_rows

        json = _choose_rows_file(None, self.out, "viewer.json")
        threads = _choose_threads(self.threads)
        torch.set_num_threads(threads)
        heights = [min(self.heights)] if self.quick else sorted(self.heights)
        with make_viewer_report(describe_machine(threads), json=json, out=self.out) as report:
            report.rows += read_viewer_rows(json)
            bench = ViewerBench(report, repeats=3 if self.quick else 9, threads=threads)
            for height in heights:
                bench.run(height, list_viewer_cases(self.size, self.renderers))
        return 0


@dataclass(frozen=True)
class BenchPose:
    """Measure estimated camera poses against known ones: every pair, and all panoramas of each folder together."""

    paths: Positional[tuple[Path, ...]] = ()
    """Folders of panoramas with poses; by default the sample, if it is there."""
    camera_height: Positive = 1.5
    """Mean height of the cameras over the floor, metres."""
    tours: bool = False
    """Also estimate all panoramas of each folder together."""
    json: Path | None = None
    """File for the rows; written after every row."""
    out: OptionalOut = None
    """Folder for pose.json, pose.md and pose.png."""
    threads: Threads | None = None
    """Threads to use; by default torch's."""

    def run(self) -> int:
        """Measure, print the tables and write the files; exit status 1 if a wrong pose passed the check."""
        import torch

        from pansplat.bench.harness import describe_machine
        from pansplat.bench.pose import make_pose_report, measure_poses, summarise
        from pansplat.data.folders import load_pairs

        json = _choose_rows_file(self.json, self.out, "pose.json")
        if not self.paths and not _SAMPLE.is_dir():
            raise InputError("give a folder of panoramas with poses (the sample is in the repository only)")
        threads = _choose_threads(self.threads)
        torch.set_num_threads(threads)
        with make_pose_report(describe_machine(threads), json=json, out=self.out) as report:
            for path in self.paths or (_SAMPLE,):
                pairs = load_pairs(path)
                contexts = {tuple(sorted(str(view.image) for view in pair.context)): pair for pair in pairs}
                for pair in contexts.values():
                    report.update(pair.name)
                    report.add(measure_poses(pair.name, pair.context, self.camera_height))
                if self.tours:
                    views = {view.image: view for pair in pairs for view in (*pair.context, *pair.targets)}
                    report.update(f"all {len(views)} panoramas")
                    name = path.resolve().name
                    report.add(measure_poses(name, list(views.values()), self.camera_height, "tour"))
        print(summarise([row for row in report.rows if row.suite == "pair"]))
        return int(any(row.result.outcome == "wrong" for row in report.rows))


@dataclass(frozen=True)
class BenchFormats:
    """Compare the file formats of scenes: size, error of each field, error of the image, time."""

    path: Positional[Path]
    """A scene file."""
    degree: Annotated[int, Range(0, 3), WHOLE] | None = None
    """Degree of the harmonics that are written; by default that of the scene. Missing ones are made at random."""
    height: Annotated[int, Range(16, 4096, "pixels"), WHOLE] = 256
    """Of the panoramas that are compared, pixels."""
    json: Path | None = None
    """File for the rows."""

    def run(self) -> int:
        """Measure each format and print the table."""
        from pansplat import pipeline
        from pansplat.bench.formats import make_format_table, measure_formats, set_degree
        from pansplat.evaluation.report import write_json

        _require_folder(self.json)
        scene = pipeline.load(self.path)
        if not len(scene.gaussians):
            raise InputError(f"{self.path}: needed Gaussians, got none; give another scene")
        if self.degree is not None:
            scene = set_degree(scene, self.degree)
        rows = measure_formats(scene, self.height)
        make_table_console().print(make_format_table(rows, f"{self.path.name}: {len(scene.gaussians):,} Gaussians"))
        if self.json is not None:
            write_json([row.as_json() for row in rows], self.json)
        return 0


@dataclass(frozen=True)
class Bench:
    """Measure speed, memory and error on this machine."""

    what: (
        Annotated[BenchRaster, subcommand("raster")]
        | Annotated[BenchModel, subcommand("model")]
        | Annotated[BenchMemory, subcommand("memory")]
        | Annotated[BenchRefine, subcommand("refine")]
        | Annotated[BenchViewer, subcommand("viewer")]
        | Annotated[BenchPose, subcommand("pose")]
        | Annotated[BenchFormats, subcommand("formats")]
    )

    def run(self) -> int:
        """Run the chosen benchmark."""
        return self.what.run()


def _choose_threads(threads: int | None) -> int:
    """The number of threads; by default torch's."""
    import torch

    return threads or torch.get_num_threads()


def _find_usable_memory() -> float:
    """Bytes that a run may use: three quarters of the free memory."""
    try:
        pages = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return _DEFAULT_MEMORY
    return 0.75 * pages


def _choose_rows_file(json: Path | None, out: Path | None, name: str) -> Path | None:
    """The file of the rows, by default in the folder `out`, which is made; refuses a missing folder."""
    if out is not None:
        _make_output_folder(out)
        json = json or out / name
    _require_folder(json)
    return json


def _make_output_folder(folder: Path) -> None:
    require_output_folder("--out", folder)
    folder.mkdir(parents=True, exist_ok=True)


def _require_folder(file: Path | None) -> None:
    if file is not None and not file.resolve().parent.is_dir():
        raise InputError(f"cannot write {file}: its folder does not exist; create it first")
