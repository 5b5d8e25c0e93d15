"""Lists the scenes at a path and loads them in a worker thread.

Pairs go through the prediction pipeline with its cache, scene files are read. Of a tour, the graph and one scene are
loaded; `tour_scenes` requests the predictions of its parts. A file that has the graph of a tour is shown as a tour: its
scenes are parts of the scene in the file. Imports no torch before it loads.
"""

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pansplat.errors import InputError, InputWarning, NothingFoundError, collect_notes
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat.system.files import is_scene_file, make_portable_name
from pansplat.system.progress import CONNECTED, report_progress, stage
from pansplat_viewer.core.background import BackgroundWorker

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
    from pansplat.tours.facts import TourFacts
    from pansplat.tours.graph import TourGraph


ShowEntries = Callable[[list["SceneEntry"]], None]
Find = Callable[[Path, ShowEntries], list["SceneEntry"]]


_WAIT = 0.01  # time between two looks at a search, seconds


def make_file_name(name: str) -> str:
    """A name of a scene or panorama as a valid name of a file or folder, without separators and leading dots."""
    return make_portable_name(name) or "scene"


@dataclass(frozen=True, eq=False)
class SceneEntry:
    """A scene that can be shown: a tour, a pair of panoramas to predict from, or a scene file.

    Attributes:
        pair: the pair, or the panoramas of one prediction of a tour; None for a scene file and for a whole tour.
        start: of a tour that is loaded: the panorama that it is entered at.
        max_views: of a tour that is loaded: the number of views, at most, that the predictor takes.
    """

    name: str  # shown in the list of scenes and used for output folders
    pair: "PanoramaSet | None" = None
    file: Path | None = None  # the scene file, or None
    tour: "TourGraph | None" = None  # the tour, or None
    views: tuple[int, ...] = ()  # numbers in the tour of the panoramas of one of its scenes
    start: int | None = None
    max_views: int = 1
    merged: "Scene | None" = None  # the scene of all panoramas, if the tour is from a file
    notes: tuple[str, ...] = ()  # what was not used or not placed at its path, and why

    @property
    def panoramas(self) -> "tuple[Panorama, ...]":
        """The photographs of the scene, those that are held out last; a file has none."""
        if self.merged is not None:
            return ()
        if self.tour is not None:
            return self.tour.panoramas
        return () if self.pair is None else self.pair.context + self.pair.targets

    @property
    def folder_name(self) -> str:
        """The name as a valid folder name, without separators and leading dots."""
        return make_file_name(self.name)


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene that is loaded.

    Attributes:
        is_final: False for a prediction whose refinement will follow.
        facts: of a scene with cameras.
    """

    entry: SceneEntry
    scene: "Scene"
    is_final: bool = True
    facts: "TourFacts | None" = None


def find_entries(
    path: Path, reading: ReadOptions, prediction: PredictOptions, show: ShowEntries | None = None
) -> list[SceneEntry]:
    """Return all scenes at `path`: tours first, then pairs and single views, then scene files.

    Args:
        path: a file or folder.
        reading: options of reading.
        prediction: options of the predictor, which may need two views.
        show: called before poses are estimated, with the panoramas as a tour of which none is placed.
    """
    if not path.exists():
        raise InputError(
            f"{path}: no such file or folder; give a panorama, a folder of panoramas, a folder of such folders or a "
            "scene file"
        )
    if path.is_file() and is_scene_file(path):
        return [SceneEntry(path.stem, file=path)]
    scenes = sorted(p for p in path.iterdir() if is_scene_file(p)) if path.is_dir() else []
    from pansplat.pipeline import load_predictor, load_sets, warn_of_single_views
    from pansplat.tours.graph import find_tours

    def on_unposed(pairs: "list[PanoramaSet]") -> None:
        if show is not None:
            show([SceneEntry(tour.name, tour=tour) for tour in find_tours(pairs)])
        report_progress("finding where they were taken", 0.0)

    pairs = []
    with collect_notes() as notes:
        try:
            pairs = load_sets(path, on_unposed=on_unposed, **vars(reading))
        except InputError as error:
            if not scenes:
                raise
            if not isinstance(error, NothingFoundError):
                warnings.warn(f"the photographs are left out: {error}", InputWarning, stacklevel=2)
    tours = find_tours(pairs)
    if any(a == b for tour in tours for a, b in tour.overlaps):
        predictor = load_predictor(prediction)
        with collect_notes() as replaced:
            for tour in tours:
                warn_of_single_views(tour, predictor)
        notes += replaced
    entries = [SceneEntry(tour.name, tour=tour, notes=tuple(notes)) for tour in tours]
    entries += [SceneEntry(pair.name, pair=pair, notes=tuple(notes)) for pair in pairs]
    return entries + [SceneEntry(p.stem, file=p, notes=tuple(notes)) for p in scenes]


def choose_entry(entries: Sequence[SceneEntry], name: str | None) -> int:
    """Return the index of the entry with this name or number (from 1); None is the first."""
    if name is None:
        return 0
    for index, entry in enumerate(entries):
        if name in (entry.name, str(index + 1)):
            return index
    names = ", ".join(entry.name for entry in entries[:12]) + (", ..." if len(entries) > 12 else "")
    raise InputError(f"`--pair` must be a number from 1 to {len(entries)} or one of {names}, got {name!r}")


def list_panoramas_of_folder(entries: Sequence["SceneEntry"], folder: Path) -> "list[Panorama]":
    """The photographs of a folder among all entries, in the worlds and the unit of its files, by name."""
    from pansplat.geometry.world import USER_FRAME

    found: dict[Path, Panorama] = {}
    for entry in entries:
        tour, pair = entry.tour, entry.pair
        if tour is not None and tour.folder == folder:
            found |= {view.image: view for view in tour.originals or tour.panoramas}
        elif pair is not None and pair.folder == folder:
            found |= {view.image: view for view in pair.context + pair.targets}
    views = [replace(view, camera_height=view.frame.unit * view.camera_height) for view in found.values()]
    return sorted((view.in_frame(USER_FRAME) for view in views), key=lambda view: view.name)


def load_whole(entry: SceneEntry, prediction: PredictOptions) -> "tuple[Scene, PanoramaSet | TourGraph | None]":
    """The scene of all panoramas of an entry, and these; None of a scene file."""
    from pansplat import pipeline
    from pansplat.tours.overlap import connect

    if entry.file is not None:
        return pipeline.load(entry.file), None
    source = entry.pair
    if entry.tour is not None:
        with stage(CONNECTED):
            source = connect(entry.tour)
    assert source is not None
    return pipeline.predict(source, options=prediction), source


def load_entry(
    entry: SceneEntry, prediction: PredictOptions, show: Callable[[LoadedScene], None] | None = None
) -> LoadedScene:
    """Read an entry's scene, or predict and refine it. Of a tour, a scene of the panorama in which `plan_walk` starts.

    The entry of the result for a tour has its connected graph and the panoramas of the scene: of an edge, which is
    there soon.

    Args:
        entry: the entry.
        prediction: its options.
        show: called with the prediction before it is refined.
    """
    from pansplat import pipeline

    if entry.tour is not None:
        return _load_tour_scene(entry, prediction, show)
    if entry.pair is None:
        report_progress("reading", 0.0)
        assert entry.file is not None
        scene = pipeline.load(entry.file)
        if scene.tour is None or scene.joint:  # the views of an edge alone lack surfaces of others
            return _with_facts(entry, scene)
        from pansplat.tours.scene_graph import make_graph

        tour = replace(make_graph(scene), name=entry.name)
        return _load_tour_scene(replace(entry, tour=tour, merged=scene), prediction, show)
    scene = pipeline.predict(
        entry.pair,
        options=prediction,
        on_predicted=None if show is None else lambda scene: show(_with_facts(entry, scene, is_final=False)),
    )
    return _with_facts(entry, scene)


def _with_facts(entry: SceneEntry, scene: "Scene", is_final: bool = True) -> LoadedScene:
    """A scene without a graph, and where surfaces stop its camera."""
    from pansplat.tours.facts import TourFacts

    if not len(scene.cam2world):
        return LoadedScene(entry, scene, is_final)
    facts = TourFacts(scene)
    _ = facts.graph, facts.usual_heights, facts.hidden, facts.outlooks  # computed in this thread
    return LoadedScene(entry, scene, is_final, facts.forget_surfaces())


def _load_tour_scene(
    entry: SceneEntry, prediction: PredictOptions, show: Callable[[LoadedScene], None] | None
) -> LoadedScene:
    """The scene of `entry.views` of a tour, predicted and refined, with its floor outlines.

    Without views, the graph is connected first, and the scene is that of the panorama in which the walk starts.
    The first scene of a window is not refined if it is predicted again with the rest of its part.
    """
    from pansplat import pipeline
    from pansplat.tours.facts import TourFacts
    from pansplat.tours.links import link_parts
    from pansplat.tours.merge import select_views
    from pansplat.tours.overlap import connect
    from pansplat.tours.scene_views import choose_predictions

    tour, views, merged = entry.tour, entry.views, entry.merged
    assert tour is not None
    if merged is not None:
        first, views = _choose_first_scene(tour, tour)
        entry = replace(entry, tour=link_parts(tour), views=views, start=first)
        return LoadedScene(entry, select_views(merged, views), facts=TourFacts(merged, tour).prepare())
    predictor = pipeline.load_predictor(prediction)
    if not views:
        with stage(CONNECTED):
            connected, max_views = connect(tour), pipeline.find_max_views(predictor)
        # A window shows photographs before: they begin where the graph that is not connected yet does.
        first, views = _choose_first_scene(connected, tour)
        tour = link_parts(connected)
        if views != choose_predictions(connected, max_views).get(first, views):
            prediction = replace(prediction, refine_steps=0)
        entry = replace(entry, tour=tour, views=views, start=first, max_views=max_views)
    pair = entry.pair or tour.make_set(views)
    fitted = pipeline.fit_to_scene(prediction, pair)

    def finish(scene: "Scene", is_final: bool) -> LoadedScene:
        scene = tour.place(scene, views)
        return LoadedScene(entry, scene, is_final, TourFacts(scene, tour, views, folder=tour.folder).prepare())

    scene = pipeline.predict(
        pair,
        pipeline.choose_predictor(pair, predictor),
        options=fitted,
        on_predicted=None if show is None or fitted.refine_steps == 0 else lambda s: show(finish(s, is_final=False)),
    )
    return finish(scene, is_final=True)


def _choose_first_scene(tour: "TourGraph", walked: "TourGraph") -> tuple[int, tuple[int, ...]]:
    """The panorama in which the walk of one graph starts, and the scene of its first edge in another one."""
    from pansplat.tours.scene_views import choose_scene_views
    from pansplat.tours.walks import plan_walk

    first, *others = plan_walk(walked)
    is_flown = others and not walked.is_zoom(first, others[0])
    edge = (min(first, others[0]), max(first, others[0])) if is_flown else tour.find_edge(first)
    scenes = choose_scene_views(tour)
    return first, scenes.get(edge) or scenes[tour.find_edge(first)]


class SceneLoader:
    """Finds, loads and refines entries in worker threads; a new request cancels the previous one of its kind."""

    def __init__(self, load: Callable[[SceneEntry, Callable[[LoadedScene], None]], LoadedScene]) -> None:
        """`load` loads one entry, such as `load_entry` with its options."""
        self._load = load
        self._loading: BackgroundWorker[LoadedScene] = BackgroundWorker("scene-loader")
        self._searching: BackgroundWorker[list[SceneEntry]] = BackgroundWorker("scene-loader-search")
        self._entry: SceneEntry | None = None  # what is loaded
        self._previews: list[LoadedScene] = []  # at most its prediction, which is being refined
        self._is_shown = False  # whether `poll` has returned the prediction
        self._searched = ""
        self._early: list[list[SceneEntry]] = []  # at most one list, of the search that goes on

    def search(self, path: Path, find: Find) -> None:
        """Start to find the entries at a path. The request of an entry goes on.

        Args:
            path: a file or folder.
            find: called in a thread, as `find_entries` with its options.
        """
        self._searched = path.name or str(path)
        early = self._early = []
        self._searching.start(lambda _: find(path, early.append), "looking for panoramas and scenes")

    def wait_for_entries(self) -> None:
        """Wait until `poll` has the entries or the error of a search, or its panoramas without poses."""
        future = self._searching.future
        while future is not None and not self._early and not future.done():
            time.sleep(_WAIT)

    def request(self, entry: SceneEntry) -> None:
        """Start loading an entry."""
        previews = self._previews = []
        self._entry, self._is_shown = entry, False
        self._loading.start(lambda _: self._load(entry, previews.append))

    @property
    def is_searching(self) -> bool:
        """Whether entries are being looked for."""
        return self._searching.future is not None

    @property
    def entry(self) -> SceneEntry | None:
        """The entry that is being loaded or refined; None if the loader is idle."""
        return self._entry

    @property
    def progress(self) -> tuple[str, str, float] | None:
        """Name of the entry or path, task and fraction done; None if nothing is loading."""
        if self._searching.progress is not None:
            return self._searched, *self._searching.progress
        if self._entry is None or self._is_shown or self._loading.progress is None:
            return None
        return self._entry.name, *self._loading.progress

    def describe_time(self) -> str:
        """The remaining time of what `progress` is of, or the time that it has taken."""
        return (self._searching if self.is_searching else self._loading).describe_time()

    @property
    def refinement(self) -> float | None:
        """Fraction of the refinement that is done; None if no scene is being refined."""
        progress = self._loading.progress
        # A refinement is the second half of `pipeline.predict`.
        return max(2 * progress[1] - 1, 0.0) if progress and self._is_shown else None

    def poll(self) -> LoadedScene | list[SceneEntry] | BaseException | None:
        """Return a prediction that is being refined, then the result or exception of the request, each once.

        Entries that are found come first; while `is_searching`, they are panoramas whose poses are being estimated.
        None while there is nothing new, or if there is no request.
        """
        if self._early and self._searching.future is not None and not self._searching.future.done():
            return self._early.pop()
        found = self._searching.poll()
        if found is not None or self._entry is None:
            return found
        if self._previews:
            self._is_shown = True
            return self._previews.pop()
        loaded = self._loading.poll()
        if loaded is not None:
            self._entry, self._is_shown = None, False
        return loaded

    def cancel(self) -> None:
        """Cancel the request; its thread stops at its next progress call."""
        self._loading.cancel()
        self._entry, self._is_shown = None, False

    def cancel_search(self) -> bool:
        """Stop to look for entries; returns whether there was a search."""
        return self._searching.cancel()

    def close(self) -> None:
        """Cancel the request and wait for all threads."""
        self._searching.close()
        self._loading.close()
