"""Lists the scenes at a path and loads them in a worker thread.

Pairs go through the prediction pipeline with its cache, .ply files are read. Imports no torch before it loads.
"""

import re
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pansplat.errors import InputError

if TYPE_CHECKING:
    from pansplat.data.pairs import Pair
    from pansplat.data.views import Views
    from pansplat.gaussians.scene import Scene

PHOTO_HEIGHT = 1024  # smallest height of the photographs for comparison, pixels

Progress = Callable[[str, float], None]  # task, fraction done


@dataclass(frozen=True, eq=False)
class SceneEntry:
    """A scene that can be shown: a pair of panoramas to predict from, or a scene file.

    Attributes:
        name: shown in the list of scenes and used for output folders.
        pair: the pair, or None for a scene file.
        file: the scene file, or None for a pair.
    """

    name: str
    pair: "Pair | None" = None
    file: Path | None = None

    @property
    def folder_name(self) -> str:
        """The name as a valid folder name, without separators and leading dots."""
        return re.sub(r"[^\w.-]+", "_", self.name).strip("._") or "scene"


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene, and the photographs it was predicted from (None for a scene file)."""

    entry: SceneEntry
    scene: "Scene"
    photos: "Views | None" = None


@dataclass(frozen=True)
class LoadOptions:
    """Arguments of `load_pairs` and `predict`."""

    model: str = "default"
    compat: Literal["trained", "official", "fixed"] = "trained"
    precision: Literal["float32", "bfloat16"] = "float32"
    height: int = 512
    cache: bool = True
    convention: str | None = None
    near: float | None = None
    far: float | None = None


def find_entries(path: Path, options: LoadOptions) -> list[SceneEntry]:
    """Return all scenes at `path`: pairs first, then scene files.

    Raises:
        InputError: the path does not exist, or holds neither pairs nor scene files.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give a pair folder, a folder of pairs or a scene .ply")
    if path.is_file() and path.suffix.lower() == ".ply":
        return [SceneEntry(path.stem, file=path)]
    scenes = sorted(p for p in path.iterdir() if p.suffix.lower() == ".ply") if path.is_dir() else []
    try:
        from pansplat.pipeline import load_pairs

        pairs = load_pairs(path, convention=options.convention, near=options.near, far=options.far)
    except InputError:
        if not scenes:
            raise
        pairs = []
    return [SceneEntry(pair.name, pair=pair) for pair in pairs] + [SceneEntry(p.stem, file=p) for p in scenes]


def load_entry(entry: SceneEntry, options: LoadOptions, progress: Progress, *, photos: bool = True) -> LoadedScene:
    """Read or predict an entry's scene.

    Args:
        entry: the entry.
        options: arguments of reading and prediction.
        progress: called with the task and the fraction done.
        photos: whether to read the input photographs.
    """
    from pansplat import pipeline

    if entry.pair is None:
        progress("reading", 0.0)
        assert entry.file is not None
        return LoadedScene(entry, pipeline.load(entry.file))
    scene = pipeline.predict(
        entry.pair,
        model=options.model,
        compat=options.compat,
        precision=options.precision,
        height=options.height,
        cache=options.cache,
        progress=progress,
    )
    if not photos:
        return LoadedScene(entry, scene)
    progress("reading photographs", 1.0)
    return LoadedScene(entry, scene, entry.pair.load_context(max(PHOTO_HEIGHT, options.height)))


class _CancelledError(Exception):
    """Raised from the progress call to end a load that was cancelled."""


@dataclass
class _Job:
    entry: SceneEntry
    task: str = "starting"
    fraction: float = 0.0
    cancelled: bool = False
    future: Future[LoadedScene] | None = None

    def report(self, task: str, fraction: float) -> None:
        if self.cancelled:
            raise _CancelledError
        self.task, self.fraction = task, min(max(fraction, 0.0), 1.0)


class SceneLoader:
    """Loads entries in worker threads; a new request cancels the previous one."""

    def __init__(self, load: Callable[[SceneEntry, Progress], LoadedScene]) -> None:
        """`load` loads one entry, such as `load_entry` with its options."""
        self._load = load
        self._executor = ThreadPoolExecutor(thread_name_prefix="scene-loader")
        self._job: _Job | None = None

    def request(self, entry: SceneEntry) -> None:
        """Start loading an entry."""
        self.cancel()
        self._job = _Job(entry)
        self._job.future = self._executor.submit(self._load, entry, self._job.report)

    @property
    def progress(self) -> tuple[str, str, float] | None:
        """Name of the entry, task and fraction done; None if nothing is loading."""
        job = self._job
        return (job.entry.name, job.task, job.fraction) if job else None

    def poll(self) -> LoadedScene | BaseException | None:
        """Return the result or exception of the request once; None while it is loading or if there is no request."""
        if self._job is None or self._job.future is None or not self._job.future.done():
            return None
        future, self._job = self._job.future, None
        return future.exception() or future.result()

    def cancel(self) -> None:
        """Cancel the request; its thread stops at its next progress call."""
        if self._job is not None:
            self._job.cancelled = True
            self._job = None

    def close(self) -> None:
        """Cancel the request and wait for all threads."""
        self.cancel()
        self._executor.shutdown()
