"""`pansplat bench`: what the renderers take and how wrong they are, and what the machine could do at most."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import rich.console
import torch
from rich.console import Console
from rich.live import Live
from rich.text import Text

import pansplat
from pansplat import pipeline
from pansplat.atomic import replacing
from pansplat.bench.cases import Case, Group, Subject, choices, default_face_size
from pansplat.bench.drawing import why_not
from pansplat.bench.gl_viewer import measure_viewer
from pansplat.bench.lifted import lift_depth
from pansplat.bench.machine import describe_machine
from pansplat.bench.plan import Settings, groups, of_scene, room, sample_groups
from pansplat.bench.plots import plot_choices, plot_sweeps
from pansplat.bench.raster import Bench
from pansplat.bench.report import findings, markdown, tables
from pansplat.bench.rows import Row
from pansplat.cli.commands import BenchMachine, BenchRaster, PairChoice, SceneSource
from pansplat.cli.printing import table_console
from pansplat.cli.scenes import choose_pair, progress_bar, require_height
from pansplat.errors import InputError

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene

_BACKENDS = ("numba", "triton", "gsplat")
_SAMPLE = Path(pansplat.__file__).parents[1] / "assets" / "living_room"
_SHOWN = 12  # rows of the running table
_WIDTH = 210  # characters, where there is no terminal
_MEMORY = 16e9  # bytes, where the system does not tell


def run_machine(command: BenchMachine) -> int:
    """Print what the machine is and can do."""
    for name, value in describe_machine(_threads(command.threads)).items():
        print(f"{name:<15} {_facts(value)}")
    return 0


def run_raster(command: BenchRaster) -> int:
    """Measure, print the tables and write the files; an interruption keeps and reports what was measured."""
    files = _files(command)
    require_height(command.height)
    if command.height % 8:
        raise InputError(f"--height must be a multiple of 8 pixels, got {command.height}")
    settings = _settings(command)
    subject = room if command.scene is None else _scene(command.scene, command.height, command.scene_from)
    machine = describe_machine(settings.threads)
    with _live() as live:
        watch = partial(_show, live)
        budget, slow = (1.0, 3.0) if command.quick else (8.0, 5.0)
        bench = Bench(machine, file=files["json"], budget=budget, slow=slow, watch=watch)
        try:
            bench.run(groups(settings, subject, synthetic=command.scene is None))
            if command.scene is None and _SAMPLE.is_dir():
                small = settings.choice_height
                bench.run(sample_groups(settings, _scene(_SAMPLE, small)(small)))
            _add_viewer(bench, settings, subject)
        finally:
            live.stop()
            _report(bench, files)
    return 0


def _settings(command: BenchRaster) -> Settings:
    """What to measure, and with what; tells which backends are left out and why."""
    usable = []
    for name in _BACKENDS:
        reason = why_not(name)
        if reason is None:
            usable.append(name)
        else:
            print(f"without {name}: {reason}")
    return Settings(command.height, command.quick, _threads(command.threads), tuple(usable), _free_memory())


def _threads(wanted: int | None) -> int:
    """The number of threads asked for; by default as many as torch uses."""
    if wanted is not None and wanted < 1:
        raise InputError(f"--threads must be at least 1, got {wanted}")
    return wanted or torch.get_num_threads()


def _free_memory() -> float:
    """Bytes that a run may take: three quarters of what is free."""
    try:
        pages = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return _MEMORY
    return 0.75 * pages


def _files(command: BenchRaster) -> dict[str, Path | None]:
    """Where the rows, the two pictures and the page of tables go; refused before the work when a folder is missing."""
    files: dict[str, Path | None] = {"json": command.json, "plot": command.plot, "sweeps": None, "page": None}
    if command.out is not None:
        command.out.mkdir(parents=True, exist_ok=True)
        files["json"] = command.json or command.out / "raster.json"
        files["plot"] = command.plot or command.out / "raster.png"
        files["page"] = command.out / "raster.md"
    if files["plot"] is not None:
        files["sweeps"] = files["plot"].with_name(f"{files['plot'].stem}_sweeps{files['plot'].suffix}")
    for file in files.values():
        if file is not None and not file.resolve().parent.is_dir():
            raise InputError(f"cannot write {file}: its folder does not exist; create it first")
    if files["plot"] is not None and files["plot"].suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(f"--plot must end in .png, .svg or .pdf, got {files['plot']}")
    return files


def _scene(path: Path, height: int, source: SceneSource = "prediction") -> Callable[[int], Subject]:
    """A .ply file's scene or a pair's, seen from between its cameras (from the origin if it has none)."""
    scene = _read(path, height, source)
    pose = scene.pose_between(0.5) if len(scene.cam2world) else torch.eye(4, dtype=torch.float64)
    return of_scene(path.stem, lambda: scene.gaussians, pose)


def _read(path: Path, height: int, source: SceneSource) -> Scene:
    """The scene of a .ply file; of a pair's folder what `sweep` predicts, or what its depth maps show."""
    if path.suffix.lower() == ".ply":
        if source == "depth":
            raise InputError(f"--scene-from depth needs a pair's folder with depth maps, got {path}; leave it out")
        return pipeline.load(path)
    pair = choose_pair(path, PairChoice())
    if source == "depth":
        return lift_depth(pair.load_context(height))
    with progress_bar() as progress:
        return pipeline.predict(pair, "sweep", height=height, progress=progress)


def _add_viewer(bench: Bench, settings: Settings, subject: Callable[[int], Subject]) -> None:
    """The viewer's rows among the choices; without OpenGL a note says why there are none."""
    height = settings.choice_height
    sizes = (default_face_size(height),) if settings.quick else settings.face_sizes
    cases = [case for case in choices("gl", height, sizes, settings.threads) if case.layout == "cubemap"]
    if settings.quick:
        cases = [case for case in cases if _is_plain(case)]
    try:
        group = Group("choices", subject(height), tuple(cases), "own")
        measure_viewer(bench, group, repeats=2 if settings.quick else 5)
    except InputError as error:
        print(f"without the viewer: {error}")


def _is_plain(case: Case) -> bool:
    """The exact choices, the classic kernel in their place, and all of the classic renderer's."""
    return (case.order, case.filter) == ("radial", "angular") or (case.kernel, case.order, case.filter) == (
        "ewa",
        "z",
        "3dgs",
    )


def _live() -> Live:
    console = Console(stderr=True)
    return Live(console=console, refresh_per_second=4, transient=True)


def _show(live: Live, doing: str, rows: list[Row]) -> None:
    """The last rows, and what is being measured; one line a step where there is no terminal."""
    if live.console.is_terminal:
        live.update(rich.console.Group(*tables(rows[-_SHOWN:]), Text(doing, style="cyan")))


def _report(bench: Bench, files: dict[str, Path | None]) -> None:
    """Print the tables and the headlines, and write the pictures, of whatever was measured."""
    console = table_console(_WIDTH)
    machine = bench.machine
    for name in ("cpu", "threads", "gpu", "fma_gflops", "bandwidth_gb_s"):
        print(f"{name:<15} {_facts(machine[name])}")
    for table in tables(bench.rows):
        console.print(table)
    for sentence in findings(bench.rows):
        print(sentence)
    written = [files["json"]] if bench.rows else []
    if files["plot"] is not None and plot_choices(bench.rows, files["plot"]):
        written.append(files["plot"])
    if files["sweeps"] is not None and plot_sweeps(bench.rows, files["sweeps"]):
        written.append(files["sweeps"])
    if files["page"] is not None and bench.rows:
        with replacing(files["page"]) as partial:
            partial.write_text(markdown(bench.rows))
        written.append(files["page"])
    for file in written:
        if file is not None:
            print(file)


def _facts(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name}: {one}" for name, one in value.items())
    return "none" if value is None else str(value)
