"""Lists the scenes at a path and loads them in a worker thread.

Pairs go through the prediction pipeline with its cache, scene files are read. Of a tour, the graph and one scene are
loaded; `tour` requests its other scenes. A file that has the graph of a tour is shown as a tour: its scenes are parts
of the scene in the file. Imports no torch before it loads.
"""

import re
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pansplat.errors import InputError
from pansplat.files import is_scene_file

if TYPE_CHECKING:
    from pansplat.data.pairs import Pair, Panorama
    from pansplat.gaussians.scene import Scene
    from pansplat.tours import FloorOutline, TourGraph


Progress = Callable[[str, float], None]  # task, fraction done


@dataclass(frozen=True, eq=False)
class SceneEntry:
    """A scene that can be shown: a tour, a pair of panoramas to predict from, or a scene file.

    Attributes:
        name: shown in the list of scenes and used for output folders.
        pair: the pair, or the panoramas of one scene of a tour; None for a scene file and for a whole tour.
        file: the scene file, or None.
        tour: the tour, or None.
        views: of one scene of a tour: numbers of its panoramas in the tour.
        merged: of a tour from a file: the scene in it, of all panoramas.
    """

    name: str
    pair: "Pair | None" = None
    file: Path | None = None
    tour: "TourGraph | None" = None
    views: tuple[int, ...] = ()
    merged: "Scene | None" = None

    @property
    def panoramas(self) -> "tuple[Panorama, ...]":
        """The photographs of the scene, those that are held out last; a file has none."""
        if self.merged is not None:
            return ()
        if self.tour is not None:
            return self.tour.panoramas
        return () if self.pair is None else self.pair.context + self.pair.targets

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the scene is made from, and the folders of the panoramas."""
        source = self.tour or self.pair
        if self.file is not None or source is None:
            return () if self.file is None else (self.file,)
        images = [panorama.image for panorama in self.panoramas]
        stated = [source.folder / name for name in ("poses.json", "pairs.json")]
        return (*images, *stated, *{image.parent: None for image in images})

    @property
    def folder_name(self) -> str:
        """The name as a valid folder name, without separators and leading dots."""
        return re.sub(r"[^\w.-]+", "_", self.name).strip("._") or "scene"


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene that is loaded.

    Attributes:
        is_final: False for a prediction whose refinement will follow.
        outlines: of a scene of a tour: floor outlines by panorama.
    """

    entry: SceneEntry
    scene: "Scene"
    is_final: bool = True
    outlines: "dict[int, FloorOutline]" = field(default_factory=dict)


@dataclass(frozen=True)
class LoadOptions:
    """Arguments of `load_pairs` and `predict`."""

    model: str = "default"
    compat: Literal["trained", "official", "fixed"] = "trained"
    precision: Literal["float32", "bfloat16"] = "float32"
    height: int | None = None
    refine_seconds: float = 10.0
    cache: bool = True
    convention: str | None = None
    near: float | None = None
    far: float | None = None


def find_entries(path: Path, options: LoadOptions, progress: Progress | None = None) -> list[SceneEntry]:
    """Return all scenes at `path`: tours of three or more panoramas first, then pairs, then scene files.

    Args:
        path: a file or folder.
        options: arguments of reading.
        progress: called while the poses of panoramas without poses are estimated.

    Raises:
        InputError: the path does not exist, or holds neither pairs nor scene files.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give a pair folder, a folder of pairs or a scene file")
    if path.is_file() and is_scene_file(path):
        return [SceneEntry(path.stem, file=path)]
    scenes = sorted(p for p in path.iterdir() if is_scene_file(p)) if path.is_dir() else []
    try:
        from pansplat.pipeline import load_pairs

        pairs = load_pairs(path, convention=options.convention, near=options.near, far=options.far, progress=progress)
    except InputError:
        if not scenes:
            raise
        pairs = []
    from pansplat.tours import find_tours

    tours = [SceneEntry(tour.name, tour=tour) for tour in find_tours(pairs)]
    return tours + [SceneEntry(pair.name, pair=pair) for pair in pairs] + [SceneEntry(p.stem, file=p) for p in scenes]


def load_entry(
    entry: SceneEntry,
    options: LoadOptions,
    progress: Progress,
    show: Callable[[LoadedScene], None] | None = None,
) -> LoadedScene:
    """Read an entry's scene, or predict and refine it. Of a tour, the scene in which `plan_walk` starts.

    The entry of the result for a tour has its connected graph and the panoramas of the scene.

    Args:
        entry: the entry.
        options: arguments of reading and prediction.
        progress: called with the task and the fraction done.
        show: called with the prediction before it is refined.
    """
    from pansplat import pipeline

    if entry.tour is not None:
        return _load_tour_scene(entry, options, progress, show)
    if entry.pair is None:
        progress("reading", 0.0)
        assert entry.file is not None
        scene = pipeline.load(entry.file)
        if not scene.overlaps:
            return LoadedScene(entry, scene)
        from pansplat.tours import make_graph

        tour = replace(make_graph(scene), name=entry.name)
        return _load_tour_scene(replace(entry, tour=tour, merged=scene), options, progress, show)
    scene = pipeline.predict(
        entry.pair,
        model=options.model,
        compat=options.compat,
        precision=options.precision,
        height=options.height,
        refine_seconds=options.refine_seconds,
        cache=options.cache,
        progress=progress,
        on_predicted=None if show is None else lambda scene: show(LoadedScene(entry, scene, is_final=False)),
    )
    return LoadedScene(entry, scene)


def _load_tour_scene(
    entry: SceneEntry, options: LoadOptions, progress: Progress, show: Callable[[LoadedScene], None] | None
) -> LoadedScene:
    """Predict and refine one scene of a tour, with its floor outlines; the first one after its graph is connected."""
    from pansplat import pipeline
    from pansplat.tours import connect, find_floor_outlines, select_views

    tour, views = entry.tour, entry.views
    assert tour is not None
    if not views:
        tour = tour if entry.merged is not None else connect(tour, progress)
        first, second = tour.plan_walk()[:2]
        views = tour.choose_scene_views()[min(first, second), max(first, second)]
        entry = replace(entry, tour=tour, views=views)
    pair = entry.pair or tour.make_pair(views)

    def finish(scene: "Scene", is_final: bool) -> LoadedScene:
        return LoadedScene(entry, scene, is_final=is_final, outlines=find_floor_outlines(tour, scene, views))

    if entry.merged is not None:
        return finish(select_views(entry.merged, views), is_final=True)
    scene = pipeline.predict(
        pair,
        model=options.model,
        compat=options.compat,
        precision=options.precision,
        height=options.height or pipeline.choose_tour_height(pair),
        refine_seconds=options.refine_seconds,
        cache=options.cache,
        progress=progress,
        on_predicted=None if show is None else lambda scene: show(finish(scene, is_final=False)),
    )
    return finish(scene, is_final=True)


class _CancelledError(Exception):
    """Raised from the progress call to end a load that was cancelled."""


@dataclass
class _Job:
    entry: SceneEntry
    future: "Future[LoadedScene] | Future[list[SceneEntry]] | None" = None
    task: str = "starting"
    fraction: float = 0.0
    cancelled: bool = False
    preview: LoadedScene | None = None
    is_shown: bool = False

    def show(self, preview: LoadedScene) -> None:
        self.preview = preview

    def report(self, task: str, fraction: float) -> None:
        if self.cancelled:
            raise _CancelledError
        self.task, self.fraction = task, min(max(fraction, 0.0), 1.0)


class SceneLoader:
    """Finds, loads and refines entries in worker threads; a new request cancels the previous one of its kind."""

    def __init__(self, load: Callable[[SceneEntry, Progress, Callable[[LoadedScene], None]], LoadedScene]) -> None:
        """`load` loads one entry, such as `load_entry` with its options."""
        self._load = load
        self._executor = ThreadPoolExecutor(thread_name_prefix="scene-loader")
        self._job: _Job | None = None
        self._search: _Job | None = None

    def search(self, path: Path, find: Callable[[Path, Progress], list[SceneEntry]]) -> None:
        """Start to find the entries at a path. The request of an entry goes on."""
        self.cancel_search()
        self._search = _Job(SceneEntry(path.name or str(path)), task="looking for panoramas and scenes")
        self._search.future = self._executor.submit(find, path, self._search.report)

    def request(self, entry: SceneEntry) -> None:
        """Start loading an entry."""
        self.cancel()
        self._job = _Job(entry)
        self._job.future = self._executor.submit(self._load, entry, self._job.report, self._job.show)

    def load(self, entry: SceneEntry, progress: Progress) -> LoadedScene:
        """Load an entry in the calling thread, without regard to requests; `progress` may raise to end it."""
        return self._load(entry, progress, lambda loaded: None)

    @property
    def is_searching(self) -> bool:
        """Whether entries are being looked for."""
        return self._search is not None

    @property
    def entry(self) -> SceneEntry | None:
        """The entry that is being loaded or refined; None if the loader is idle."""
        return self._job.entry if self._job else None

    @property
    def progress(self) -> tuple[str, str, float] | None:
        """Name of the entry or path, task and fraction done; None if nothing is loading."""
        job = self._search or self._job
        return (job.entry.name, job.task, job.fraction) if job and not job.is_shown else None

    @property
    def refinement(self) -> float | None:
        """Fraction of the refinement that is done; None if no scene is being refined."""
        job = self._job
        return max(2 * job.fraction - 1, 0.0) if job and job.is_shown else None

    def poll(self) -> LoadedScene | list[SceneEntry] | BaseException | None:
        """Return a prediction that is being refined, then the result or exception of the request, each once.

        Entries that are found come first. None while there is nothing new, or if there is no request.
        """
        if self._search is not None and self._search.future is not None and self._search.future.done():
            search, self._search = self._search.future, None
            return search.exception() or search.result()
        if self._job is None or self._job.future is None:
            return None
        if self._job.preview is not None and not self._job.is_shown:
            self._job.is_shown = True
            return self._job.preview
        if not self._job.future.done():
            return None
        future, self._job = self._job.future, None
        return future.exception() or future.result()

    def cancel(self) -> None:
        """Cancel the request; its thread stops at its next progress call."""
        if self._job is not None:
            self._job.cancelled = True
            self._job = None

    def cancel_search(self) -> bool:
        """Stop to look for entries; returns whether there was a search."""
        search, self._search = self._search, None
        if search is not None:
            search.cancelled = True
        return search is not None

    def close(self) -> None:
        """Cancel the request and wait for all threads."""
        self.cancel_search()
        self.cancel()
        self._executor.shutdown()
