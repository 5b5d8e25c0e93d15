"""What a path holds that can be shown, and loading it in the background.

Pairs go through the prediction pipeline (cached), .ply files are read. The window stays alive meanwhile: a
worker thread does the work and `poll` hands over the result.
"""

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pansplat.errors import InputError

if TYPE_CHECKING:
    from pansplat.data.pairs import Pair
    from pansplat.data.views import Views
    from pansplat.gaussians.scene import Scene

PHOTO_HEIGHT = 1024  # of the photographs to compare with, pixels

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Entry:
    """One thing to show: a pair of panoramas to predict from, or a scene file.

    Attributes:
        name: for the chooser and for output folders.
        pair: the pair, or None for a scene file.
        file: the scene file, or None for a pair.
    """

    name: str
    pair: "Pair | None" = None
    file: Path | None = None

    @property
    def folder_name(self) -> str:
        """The name as one folder's name: no separators, nothing hidden."""
        return re.sub(r"[^\w.-]+", "_", self.name).strip("._") or "scene"


@dataclass(frozen=True, eq=False)
class Loaded:
    """A scene ready to draw, and the photographs it was made from (None when they are not at hand)."""

    entry: Entry
    scene: "Scene"
    photos: "Views | None" = None


@dataclass(frozen=True)
class LoadOptions:
    """How to read and predict; as `load_pairs` and `predict` take them."""

    model: str = "sweep"
    compat: Literal["trained", "official", "fixed"] = "trained"
    precision: Literal["float32", "bfloat16"] = "float32"
    height: int = 512
    cache: bool = True
    convention: str | None = None
    near: float | None = None
    far: float | None = None


def find_entries(path: Path, options: LoadOptions) -> list[Entry]:
    """Everything at `path` that can be shown.

    Raises:
        InputError: no such path, or nothing in it that can be shown.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give a pair folder, a folder of pairs or a scene .ply")
    if path.is_file() and path.suffix.lower() == ".ply":
        return [Entry(path.stem, file=path)]
    scenes = sorted(p for p in path.iterdir() if p.suffix.lower() == ".ply") if path.is_dir() else []
    try:
        from pansplat.pipeline import load_pairs

        pairs = load_pairs(path, convention=options.convention, near=options.near, far=options.far)
    except InputError:
        if not scenes:
            raise
        pairs = []
    return [Entry(pair.name, pair=pair) for pair in pairs] + [Entry(p.stem, file=p) for p in scenes]


def load_entry(entry: Entry, options: LoadOptions, progress: Progress, *, photos: bool = True) -> Loaded:
    """Read or predict an entry's scene, blocking; reports what is being done and the fraction done.

    Args:
        entry: what to load.
        options: how.
        progress: told what is being done and the fraction done.
        photos: whether to read the input photographs too.
    """
    from pansplat import pipeline

    if entry.pair is None:
        progress("reading", 0.0)
        assert entry.file is not None
        return Loaded(entry, pipeline.load(entry.file))
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
        return Loaded(entry, scene)
    progress("reading photographs", 1.0)
    return Loaded(entry, scene, entry.pair.load_context(max(PHOTO_HEIGHT, options.height)))


class _Cancelled(Exception):
    """Thrown through the predictor's progress calls when nobody waits for the result any more."""


@dataclass
class _Job:
    entry: Entry
    what: str = "starting"
    fraction: float = 0.0
    cancelled: threading.Event = field(default_factory=threading.Event)
    outcome: Any = None
    thread: threading.Thread | None = None


class Loader:
    """Loads entries one at a time in a worker thread; a new request takes the place of the one under way."""

    def __init__(self, load: Callable[[Entry, Progress], Loaded]) -> None:
        """`load` does the work: `load_entry` with its options, or a test's own."""
        self._load = load
        self._job: _Job | None = None
        self._retired: list[threading.Thread] = []

    def request(self, entry: Entry) -> None:
        """Start loading an entry."""
        self.cancel()
        job = _Job(entry)
        job.thread = threading.Thread(target=self._run, args=(job,), name=f"load {entry.name}")
        self._job = job
        job.thread.start()

    @property
    def progress(self) -> tuple[str, str, float] | None:
        """Name of what is loading, what is being done and the fraction done; None when idle."""
        job = self._job
        return (job.entry.name, job.what, job.fraction) if job else None

    def poll(self) -> Loaded | Exception | None:
        """The result or failure of the request, once; None while it is under way or when there is none."""
        job = self._job
        if job is None or job.outcome is None:
            return None
        self._job = None
        if job.thread:
            job.thread.join()
        return job.outcome

    def cancel(self) -> None:
        """Forget the request under way; its thread stops at its next report of progress."""
        if self._job is not None:
            self._job.cancelled.set()
            if self._job.thread:
                self._retired.append(self._job.thread)
            self._job = None

    def close(self) -> None:
        """Cancel and wait for every thread."""
        self.cancel()
        for thread in self._retired:
            thread.join()
        self._retired.clear()

    def _run(self, job: _Job) -> None:
        def progress(what: str, fraction: float) -> None:
            if job.cancelled.is_set():
                raise _Cancelled
            job.what, job.fraction = what, min(max(fraction, 0.0), 1.0)

        try:
            job.outcome = self._load(job.entry, progress)
        except _Cancelled:
            job.outcome = None
        except Exception as error:  # shown in the window; a thread must not print a traceback over it
            job.outcome = error
