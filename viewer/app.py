"""The `pansplat-view` command. Imports torch and OpenGL only when they are needed, so that `--help` is fast."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from msgspec import Meta

from pansplat.errors import InputError
from pansplat.prediction_options import PredictOptions, ReadOptions, choose_caches
from pansplat.system.console import own_warnings, parse_arguments, print_message, progress_bar
from pansplat.system.devices import Device, use_device
from pansplat.system.files import expand_home, require_output_folder, require_replaceable
from pansplat.system.options import check_numbers
from pansplat.system.progress import stage
from pansplat_viewer.core.loader import (
    SceneEntry,
    SceneLoader,
    ShowEntries,
    choose_entry,
    find_entries,
    load_entry,
    load_whole,
)
from pansplat_viewer.core.settings import DrawSettings, RendererChoice

if TYPE_CHECKING:
    import moderngl

    from pansplat.tours.camera_path import CameraPath

_WRITTEN = "[0-9]*_*.png", "film.mp4"  # offscreen
_WINDOW_SIZE, _FILM_SIZE = (1280, 720), (1920, 1080)  # pixels
_SETTINGS = DrawSettings(mode="deferred")
_PREDICTION_PART = 0.6  # share of the prediction in the progress of a film; the rest is drawing
_MAX_CONTEXTS = 3  # windows that are opened one after the other if the graphics card is reset


@dataclass(frozen=True)
class Options:
    """Fly through the scene of one or more 360-degree panoramas.

    Opens a window. Without a display, writes a film and stills.
    """

    path: Annotated[Path, tyro.conf.Positional]
    """A panorama, a folder of panoramas (a tour), a folder of such folders, or a scene file."""
    offscreen: Path | None = None
    """Open no window; write film and stills to this folder."""
    path_file: Annotated[Path | None, tyro.conf.arg(name="path")] = None
    """A camera path (docs/viewer.md), whose key frames the window has; `pansplat render` draws its film."""
    overwrite: bool = False
    """With --offscreen: replace files that pansplat did not write, too."""
    pair: str | None = None
    """Name or number of the tour, pair or scene to show first if the path holds several; offscreen also "all"."""
    prediction: PredictOptions = field(default_factory=PredictOptions)
    reading: ReadOptions = field(default_factory=ReadOptions)
    renderer: RendererChoice = "auto"
    """Draw with OpenGL (gl) or on the processor (cpu); auto is gl on a GPU, and cpu where OpenGL is
    software."""
    device: Device = "auto"
    """As that of `pansplat predict`; OpenGL draws on its own card (--renderer)."""
    verbose: bool = False
    """Print what runs where, and the figures of reasons."""
    size: str | None = None
    """Width x height, pixels (window 1280x720, film 1920x1080)."""
    seconds: Annotated[float, Meta(gt=0, le=3600)] | None = None
    """Length of the film; by default that of the ways through all panoramas, or 4 around a scene without cameras."""
    fps: Annotated[float, Meta(gt=0, le=240)] = 24.0
    """Frames per second of the film."""

    @property
    def pixels(self) -> tuple[int, int]:
        """`size` of films and stills as (width, height)."""
        if self.size is None:
            return _FILM_SIZE
        match = re.fullmatch(r"(\d{2,5})x(\d{2,5})", self.size.lower())
        if not match or not all(16 <= int(side) <= 16384 for side in match.groups()):
            raise InputError(f"`--size` must be WIDTHxHEIGHT in pixels, 16 to 16384, got {self.size!r}")
        return int(match[1]), int(match[2])


def run_arguments(args: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, those of the process by default, and return its exit status."""
    options = parse_arguments(
        lambda args: tyro.cli(
            Options, args=args, prog="pansplat-view", config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
        ),
        "pansplat-view",
        args,
    )
    check_numbers(options)
    say = partial(print_message, "note") if options.verbose else None
    with own_warnings(), use_device(options.device, say), choose_caches(options):
        return _run(options)


def _run(options: Options) -> int:
    pixels = options.pixels
    if options.offscreen is not None:
        require_output_folder("--offscreen", options.offscreen)
    from pansplat.tours.camera_path import read_path

    path = None if options.path_file is None else read_path(expand_home(options.path_file))
    folder = options.offscreen
    if folder is None:
        problem = _run_window(options, pixels if options.size else _WINDOW_SIZE, path)
        if problem is None:
            return 0
        if path is None:
            print(f"{problem}: writing a film instead")
        require_output_folder("the folder", Path("renders"))
    if path is not None:
        raise InputError("--path needs a window; `pansplat render SCENE --path FILE -o film.mp4` draws its film")
    with progress_bar():  # the poses of a tour without them take minutes
        entries = find_entries(expand_home(options.path), options.reading, options.prediction)
    show_all = options.pair == "all"
    first = 0 if show_all else choose_entry(entries, options.pair)
    chosen = entries if show_all else entries[first : first + 1]
    if len(chosen) < len(entries):
        print(f"{options.path} has {len(entries)} scenes: showing {chosen[0].name}; select with --pair NAME or all")
    root = folder or Path("renders")
    targets = [root / entry.folder_name if folder is None or show_all else root for entry in chosen]
    written = [file for target in targets for name in _WRITTEN for file in target.glob(name)]
    require_replaceable(f"{root}", written, options.overwrite)
    for entry, target in zip(chosen, targets, strict=True):
        _write_film(options, entry, target, pixels)
    return 0


def _run_window(options: Options, pixels: tuple[int, int], path: "CameraPath | None") -> str | None:
    """Run the viewer in a window; if no window can be opened, returns the reason.

    The window opens when the panoramas are known. Their poses may arrive later.
    """
    from pansplat.tours.camera_path import CameraPath
    from pansplat_viewer.core.state import ViewerState

    try:
        from pansplat_viewer.viewer import Viewer
        from pansplat_viewer.window.recent import find_file
        from pansplat_viewer.window.window import ContextLostError, NoWindowError, Window, run_viewer
    except ImportError as error:  # imgui_bundle needs the libraries of X11
        return f"the window's libraries cannot be loaded ({error})"

    state = ViewerState(settings=_SETTINGS, path=path or CameraPath())
    source = expand_home(options.path)

    def create_loader() -> SceneLoader:
        return SceneLoader(lambda entry, show: load_entry(entry, options.prediction, show))

    def find(path: Path, show: ShowEntries) -> list[SceneEntry]:
        found = find_entries(path, options.reading, options.prediction, show)
        choose_entry(found, options.pair if path == source else None)
        return found

    loader = create_loader()
    loader.search(source, find)
    loader.wait_for_entries()
    entries = loader.poll()
    if isinstance(entries, BaseException):
        loader.close()
        raise entries
    first = 0 if loader.is_searching else choose_entry(entries, options.pair)
    for attempt in range(_MAX_CONTEXTS):
        try:
            window = Window("pansplat", pixels)
        except NoWindowError as error:
            loader.close()
            return str(error)
        viewer = Viewer(
            window.ctx,
            loader,
            find=find,
            state=state,
            dpi_scale=window.dpi_scale,
            renderer=options.renderer,
            recent=find_file(),
        )
        if loader.is_searching:
            viewer.session.expect(entries, source, options.pair)
        else:
            viewer.session.show(entries, first, source)
        try:
            run_viewer(window, viewer)
            return None
        except ContextLostError:  # start again with the same scene, camera and settings
            if attempt == _MAX_CONTEXTS - 1:
                raise
            session, loader = viewer.session, create_loader()
            if session.path is None:  # poses were being estimated
                loader.search(source, find)
            else:
                entries, first, source = session.entries, max(session.current, 0), session.path
    return None


def _write_film(options: Options, entry: SceneEntry, folder: Path, pixels: tuple[int, int]) -> None:
    """Load one entry and write its film to a folder, with a progress bar.

    Names of scenes and files are printed as soon as they are there.
    """
    from pansplat.tours.facts import TourFacts
    from pansplat_viewer.capture import open_film, write_flight
    from pansplat_viewer.draw.cpu_renderer import create_renderer

    ctx = _create_context(options.renderer)  # before the prediction, so that missing OpenGL is reported early
    with progress_bar():
        with stage(_PREDICTION_PART, f"{entry.name}: "):
            scene, source = load_whole(entry, options.prediction)
        print(f"{entry.name}: {len(scene.gaussians):,} Gaussians", flush=True)
        facts = TourFacts(scene, folder=None if source is None else source.folder)
        create = partial(create_renderer, ctx, options.renderer, color_bits=32)
        try:
            with open_film(create, scene, source, pixels, _SETTINGS) as film:
                write_flight(film, facts, folder, options.fps, options.seconds, partial(print, flush=True))
        finally:
            if ctx is not None:
                ctx.release()


def _create_context(renderer: RendererChoice) -> "moderngl.Context | None":
    """Return an OpenGL context, or None if the renderer does not need one and there is none."""
    if renderer == "cpu":
        return None
    from pansplat_viewer.draw.offscreen import create_context

    try:
        return create_context()
    except InputError:
        if renderer == "gl":
            raise
        return None
