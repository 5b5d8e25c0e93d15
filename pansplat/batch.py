"""Many pairs and tours: one task each, on the worker processes of a Dask cluster (docs/batch.md).

The name of each output contains a hash of all its inputs, and outputs appear complete or not at all. A task whose
outputs exist does nothing, so that Dask may repeat a task, and a stopped run goes on where it was.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import json
import math
import os
import re
import secrets
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from pansplat import __version__, pipeline, tours
from pansplat.atomic import replacing
from pansplat.console import is_out_of_memory
from pansplat.data.folders import find_panorama_folders
from pansplat.data.images import list_masks
from pansplat.data.pairs import Pair
from pansplat.data.views import CAMERA_HEIGHT
from pansplat.errors import InputError, InputWarning, collect_notes
from pansplat.files import SCENE_SUFFIXES, expand_home, is_portable_name, read_file
from pansplat.gaussians.scene import Scene
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig, refinement_fingerprint
from pansplat.strict_json import list_field, number_field, read_json, require_object, text_field
from pansplat.tours import TourGraph, find_tours, merge_scenes, write_floor_plan

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

STEPS = ("predict", "refine", "export")
EXPORT_SUFFIXES = (".html", ".png", *SCENE_SUFFIXES)
REPORT_NAME = "report.jsonl"
MIN_MEMORY = 1 << 29  # bytes of a worker; torch and the kernels take half of it

_LAYOUT = "2"  # of the outputs; part of their hashes
_MAX_DEATHS = 2  # worker processes that may end during one task before the item counts as failed
_MAX_LOSSES = 3  # of the connection to a scheduler without a finished item in between
_CONNECT_SECONDS = 60.0
_BYTES_PER_PIXEL = 40  # of panoramas, in the .ply of their prediction; most predictors write more
_MAX_NAME = 80  # characters of a pair's name in the name of an output
# Temporary names (pansplat.atomic) of outputs.
_UNFINISHED = re.compile(rf"\.(graph|{'|'.join(STEPS)})-[0-9a-f]{{16}}.*\.[0-9a-f]{{8}}\.\w+")
_DEFAULT_MEMORY = 4 << 30  # bytes; decides the default number of workers


@dataclass(frozen=True)
class Item:
    """A folder with a pair or a tour, and how to read it.

    Attributes:
        name: relative path of its outputs, unique in a batch.
        folder: absolute.
        pair: name of the only pair to use; None for all pairs of the folder.
        convention, near, far: see `pansplat.load_pairs`.
    """

    name: str
    folder: Path
    pair: str | None = None
    convention: str | None = None
    near: float | None = None
    far: float | None = None


@dataclass(frozen=True)
class BatchOptions:
    """What is made of each pair.

    Attributes:
        steps: a part of `STEPS`, in this order.
        model, compat, precision: see `pansplat.load_model`.
        height: see `pansplat.predict`.
        camera_height: see `pansplat.load_pairs`.
        refine_seconds: time limit of the refinement of a pair, or of three panoramas of a tour.
        suffix: of the exported files; one of `EXPORT_SUFFIXES`.
        gaussians: largest number in a web page; None for the default.
    """

    steps: tuple[str, ...] = ("predict",)
    model: str = "default"
    compat: pipeline.CompatChoice = "trained"
    precision: pipeline.Precision = "float32"
    height: int | None = None
    camera_height: float = CAMERA_HEIGHT
    refine_seconds: float = 10.0
    suffix: str = ".html"
    gaussians: int | None = None


@dataclass(frozen=True)
class ItemReport:
    """The end of a task: a line of the report.

    Attributes:
        item: its name.
        status: "done", "skipped" if all outputs existed, or "failed".
        seconds: time of the task.
        outputs: files, relative to the folder of the batch.
        notes: parts of the input that are ignored.
        error: one line; None unless the item failed.
    """

    item: str
    status: str
    seconds: float
    outputs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    error: str | None = None


def list_items(path: Path) -> list[Item]:
    """The items of a manifest, or the folders with panoramas at or below a folder.

    Raises:
        InputError: a manifest that cannot be read, two items of one name, or no items.
    """
    path = expand_home(path).absolute()
    if path.is_dir():
        try:
            folders = find_panorama_folders(path)
        except OSError as error:
            raise InputError(
                f"{error.filename or path}: needed a readable folder, got '{error.strerror}'; check its permissions."
            ) from error
        if not folders:
            raise InputError(f"{path}: needed folders with panoramas, got none there or in its subfolders; check it.")
        return [Item(path.name if f == path else f.relative_to(path).as_posix(), f) for f in folders]
    entries = list_field(require_object(read_json(path), path), "items", path)
    if not entries:
        raise InputError(f'{path}: needed a list of folders as "items", got none; see docs/batch.md.')
    items = [_read_entry(entry, path, f"{path}, items[{index}]") for index, entry in enumerate(entries)]
    seen: set[str] = set()
    for item in items:
        if item.name in seen:
            raise InputError(f'{path}: needed items of different names, got {item.name!r} twice; add a "name" to one.')
        seen.add(item.name)
    return items


def _read_entry(entry: Any, manifest: Path, source: str) -> Item:
    """An item of a manifest: the path of a folder, or an object."""
    content = {"path": entry} if isinstance(entry, str) else require_object(entry, source)
    unknown = sorted(set(content) - {"path", "name", "pair", "convention", "near", "far"})
    if unknown:
        raise InputError(f"{source}: needed path, name, pair, convention, near or far, got {unknown[0]!r}; correct it.")
    given = text_field(content, "path", source)
    if not given:
        raise InputError(f'{source}: needed the path of a folder as "path", got none; add it.')
    folder = Path(os.path.normpath(manifest.parent / expand_home(given)))
    pair = text_field(content, "pair", source)
    name = text_field(content, "name", source) or (f"{folder.name}-{pair}" if pair else folder.name)
    parts = PurePosixPath(name).parts
    allowed = all(not part.startswith(".") and len(os.fsencode(part)) <= 200 for part in parts)
    if sys.platform == "win32":
        allowed = allowed and all(map(is_portable_name, parts))
    if not parts or name.startswith("/") or not allowed:
        raise InputError(f'{source}: needed a name that can be a folder, got {name[:60]!r}; add another "name".')
    return Item(
        name,
        folder,
        pair,
        text_field(content, "convention", source),
        number_field(content, "near", source),
        number_field(content, "far", source),
    )


def require_cluster() -> None:
    """Check that Dask is installed.

    Raises:
        InputError: it is not.
    """
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(
            "pansplat batch: needed the package distributed, got none; run pip install 'pansplat[cluster]'"
        ) from error


# The work of a task


def process_item(item: Item, options: BatchOptions, fingerprint: str, out: Path) -> ItemReport:
    """Do the steps of an item whose outputs are missing; an error is part of the report.

    Args:
        fingerprint: of the predictor that the batch was started with.
        out: folder of the batch.
    """
    began = time.perf_counter()
    outputs: list[str] = []
    num_written, error = 0, None
    with collect_notes() as caught:
        try:
            folder = out / item.name
            folder.mkdir(parents=True, exist_ok=True)
            _remove_unfinished(folder)
            for unit in _list_units(item, options, folder):
                for path, is_new in itertools.chain(unit.files, _process_unit(unit, options, fingerprint, folder)):
                    outputs.append(path.relative_to(out).as_posix())
                    num_written += is_new
        except Exception as problem:  # whatever it is, other items go on
            error = _describe(problem)
    status = "failed" if error else "done" if num_written else "skipped"
    notes = tuple(" ".join(note.splitlines()) for note in caught)
    return ItemReport(item.name, status, round(time.perf_counter() - began, 3), tuple(outputs), notes, error)


def _describe(error: BaseException) -> str:
    """One line about an error."""
    text = " ".join(str(error).split())
    if isinstance(error, InputError):
        return text
    if is_out_of_memory(error):
        return f"out of memory ({text[:120]}); choose a smaller --height or fewer --workers"
    return f"{type(error).__name__}: {text[:400]}"


@dataclass(frozen=True, eq=False)
class _Unit:
    """What one file is exported of: a pair, or a tour with its scenes as pairs.

    Attributes:
        name: for the name of the file.
        pairs: that are predicted.
        tour: the graph of a tour, or None.
        files: that hold the graph, and whether they were written.
    """

    name: str
    pairs: tuple[Pair, ...]
    tour: TourGraph | None = None
    files: tuple[tuple[Path, bool], ...] = ()


def _list_units(item: Item, options: BatchOptions, folder: Path) -> list[_Unit]:
    """The tours of an item, and the pairs that belong to none. The graphs of the tours are written to the folder."""
    pairs = pipeline.load_pairs(
        item.folder, convention=item.convention, near=item.near, far=item.far, camera_height=options.camera_height
    )
    if item.pair is not None:
        chosen = [pair for pair in pairs if pair.name == item.pair]
        if not chosen:
            names = ", ".join(pair.name for pair in pairs[:8])
            raise InputError(f"{item.folder}: needed a pair {item.pair!r}, got {names}; correct the manifest.")
        return [_Unit(pair.name, (pair,)) for pair in chosen]
    units, images = [], set()
    for tour in find_tours(pairs):
        images |= {panorama.image for panorama in tour.panoramas}
        graph, *file = _connect(tour, folder)
        sources = graph.choose_sources(_find_max_views(options))
        pairs_of_scenes = tuple(graph.make_pair(views) for views in sources)
        units.append(_Unit(graph.name, pairs_of_scenes, graph, (tuple(file),)))
    return units + [_Unit(pair.name, (pair,)) for pair in pairs if pair.context[0].image not in images]


def _connect(tour: TourGraph, folder: Path) -> tuple[TourGraph, Path, bool]:
    """The connected graph of a tour, its file in the folder, and whether the file was written."""
    panoramas = [[view.name, view.cam2world.tolist(), *_hash_image(view.image)] for view in tour.panoramas]
    key = _join_hash(_LAYOUT, "graph", [panoramas, tour.near, tour.far, list(tour.overlaps)])
    path = folder / f"graph-{key}-{_shorten(tour.name)}.json"
    is_new = not path.exists()
    if is_new:
        overlaps = tours.connect(tour).list_overlaps()
        with replacing(path) as temporary:
            temporary.write_text(json.dumps({"overlaps": overlaps}), "utf-8")
    rows = list_field(require_object(read_json(path), path), "overlaps", path)
    return tour.with_overlaps(tuple(map(tuple, rows))), path, is_new


@lru_cache(maxsize=2)  # that of the batch, and that of single views
def _load_model(model: str, compat: pipeline.CompatChoice, precision: pipeline.Precision) -> Predictor:
    return pipeline.load_model(model, compat=compat, precision=precision)


def _find_max_views(options: BatchOptions) -> int:
    return pipeline.find_max_views(_load_model(options.model, options.compat, options.precision))


def read_fingerprint(options: BatchOptions) -> str:
    """The fingerprint of the batch's predictor.

    Raises:
        InputError: the predictor cannot be loaded.
    """
    return _load_model(options.model, options.compat, options.precision).fingerprint


def _process_unit(unit: _Unit, options: BatchOptions, fingerprint: str, folder: Path) -> Iterator[tuple[Path, bool]]:
    """Yield each output of a pair or tour, and whether it was written."""
    part = None if unit.tour is None else _count_of_page(options) / len(unit.tour)
    alone = sum(len(pair.context) == 1 for pair in unit.pairs)
    if alone and "refine" in options.steps:
        count = f"{alone} single views are" if alone > 1 else "a single view is"
        warnings.warn(f"{unit.name}: {count} not refined.", InputWarning, stacklevel=2)
    of_single_views = _choose_for_single_views(unit, options, fingerprint)
    made = [
        _PairSteps(pair, part, *(of_single_views if len(pair.context) == 1 else (options, fingerprint)), folder)
        for pair in unit.pairs
    ]
    for steps in made:
        yield from steps.run()
    if "export" not in options.steps:
        return
    settings = [__version__, options.suffix, options.gaussians, [] if unit.tour is None else _list_graph(unit.tour)]
    key = _join_hash(",".join(steps.key for steps in made), "export", settings)
    path = folder / f"export-{key}-{_shorten(unit.name)}{options.suffix}"
    is_new = not path.exists()
    if is_new:
        if unit.tour is None:
            scene = made[0].read()
        else:
            max_views = _find_max_views(options)
            of_views = dict(zip(unit.tour.choose_sources(max_views), made, strict=True))
            scene = merge_scenes(unit.tour, lambda views: of_views[views].read(), max_views)
        _export(scene, path, unit, options)
    yield path, is_new


def _choose_for_single_views(unit: _Unit, options: BatchOptions, fingerprint: str) -> tuple[BatchOptions, str]:
    """Options and fingerprint for the single views of a tour; a warning states another predictor than the batch's."""
    alone = [pair for pair in unit.pairs if len(pair.context) == 1]
    if unit.tour is None or not alone:
        return options, fingerprint
    predictor = _load_model(options.model, options.compat, options.precision)
    if pipeline.choose_predictor(alone[0], predictor) is predictor:
        return options, fingerprint
    pipeline.warn_of_single_views(unit.tour, predictor)
    options = dataclasses.replace(options, model="default", compat="trained", precision="float32")
    return options, read_fingerprint(options)


def _list_graph(tour: TourGraph) -> list[Any]:
    """What the scene of a tour states of its graph: edges, and titles, links and start views if there are any."""
    edges = [[*edge, round(overlap, 6)] for *edge, overlap in tour.list_overlaps()]
    stated = [
        [node, view.title, view.start, [dataclasses.astuple(link) for link in view.links]]
        for node, view in enumerate(tour.panoramas)
        if view.title or view.start or view.links
    ]
    return edges + stated


class _PairSteps:
    """The prediction and refinement of a pair, or of a scene of a tour. A single view is predicted only.

    Attributes:
        key: hash of all that the result depends on.
    """

    def __init__(self, pair: Pair, part: float | None, options: BatchOptions, fingerprint: str, folder: Path) -> None:
        """`part` is the number of Gaussians that the export of a tour needs of each panorama."""
        self._pair, self._options, self._fingerprint, self._folder = pair, options, fingerprint, folder
        self._height, self._gaussians = options.height, None
        if part is not None:
            self._height, self._gaussians = pipeline.choose_tour_size(pair, part, options.height)
        self._file: Path | None = None
        self._refine_seconds = pipeline.scale_seconds(options.refine_seconds, pair)
        self.key = _hash_pair(pair)

    def run(self) -> Iterator[tuple[Path, bool]]:
        """Do the steps whose files are missing; yield each file, and whether it was written."""
        options = self._options
        name = options.model.rsplit("/", 1)[-1]
        self.key = _join_hash(self.key, "predict", [name, self._fingerprint, self._height])
        is_refined = "refine" in options.steps and len(self._pair.context) > 1
        if "predict" in options.steps or ("refine" in options.steps and not is_refined):
            yield self._write("predict", self._predict_to)
        if is_refined:
            self.key = _join_hash(self.key, "refine", [refinement_fingerprint(), self._refine_seconds, self._gaussians])
            yield self._write("refine", self._refine_to)

    def read(self) -> Scene:
        """The scene of the last step. It is computed in memory if no step writes a file."""
        if self._file is not None:
            return pipeline.load(self._file)
        return pipeline.predict(self._pair, self._load_predictor(), height=self._height, cache=False)

    def _write(self, step: str, write: Callable[[Path], object]) -> tuple[Path, bool]:
        path = self._folder / f"{step}-{self.key}-{_shorten(self._pair.name)}.ply"
        is_new = not path.exists()
        if is_new:
            write(path)
        self._file = path
        return path, is_new

    def _predict_to(self, path: Path) -> None:
        predictor = self._load_predictor()
        height = self._height or pipeline.choose_height(self._pair, predictor)
        needed, free = _BYTES_PER_PIXEL * len(self._pair.context) * 2 * height**2, shutil.disk_usage(self._folder).free
        if free < needed:  # a full disk must not cost the time of the prediction
            raise InputError(
                f"{self._folder}: needed at least {needed / 1e6:,.1f} MB of free disk space for {self._pair.name}, "
                f"got {free / 1e6:,.1f} MB; free some and run the command again"
            )
        pipeline.predict_to_file(self._pair, path, predictor, height=height)

    def _refine_to(self, path: Path) -> None:
        scene = self.read()
        views = pipeline.load_photographs(self._pair, scene.height, self._gaussians)
        config = RefineConfig(gaussians=self._gaussians)
        pipeline.refine_to_file(scene, views, path, seconds=self._refine_seconds, config=config)

    def _load_predictor(self) -> Predictor:
        predictor = _load_model(self._options.model, self._options.compat, self._options.precision)
        if predictor.fingerprint != self._fingerprint:
            raise InputError(
                f"worker: needed the predictor {self._options.model} of the machine that started the batch, got "
                "another one; install the same version of pansplat and the same weights on all machines"
            )
        return predictor


def _count_of_page(options: BatchOptions) -> float:
    """The largest number of Gaussians of a page; infinite for other files."""
    if "export" not in options.steps or options.suffix != ".html":
        return math.inf
    from pansplat.web import PHOTO_GAUSSIANS

    return options.gaussians or PHOTO_GAUSSIANS


def _export(scene: Scene, path: Path, unit: _Unit, options: BatchOptions) -> None:
    if options.suffix == ".html":
        from pansplat.web import list_photographs, write_page

        count, title = int(_count_of_page(options)), unit.name.replace("_", " ")
        photographs = list_photographs(unit.tour or unit.pairs[0], range(len(scene.cam2world)))
        write_page(scene, path, gaussians=count, title=title, photographs=photographs)
    elif options.suffix == ".png":
        write_floor_plan(scene, path)
    elif pipeline.can_stream(_load_model(options.model, options.compat, options.precision)):
        pipeline.save(scene, path)  # networks are trained for joint drawing
    elif unit.tour is not None:
        pipeline.save(pipeline.fuse_tour(unit.tour, scene), path)
    else:
        pipeline.save(pipeline.fuse(scene, unit.pairs[0].load_context(scene.height)), path)


def _hash_pair(pair: Pair) -> str:
    """Hash of all that the file of a prediction depends on, besides the predictor."""
    context = [
        [
            *(view.name, view.title, view.start, view.cam2world.tolist()),
            *(*_hash_image(view.image), view.mask and _hash_file(view.mask)),
        ]
        for view in pair.context
    ]
    heights = [view.camera_height for view in pair.context] if len(pair.context) == 1 else []
    # Static content is detected in the siblings of a panorama without a mask.
    needs_siblings = any(view.mask is None for view in pair.context)
    siblings = [key for image in pair.siblings for key in _hash_image(image)] if needs_siblings else []
    return _join_hash(_LAYOUT, pair.name, [pair.near, pair.far, context, heights, siblings])


def _hash_image(image: Path) -> list[str]:
    """Hashes of a panorama and of its masks."""
    return [_hash_file(file) for file in (image, *list_masks(image))]


@lru_cache(maxsize=4096)
def _hash_content(path: Path, size: int, changed: int) -> str:
    """Hash of a file's bytes. The panoramas of a tour belong to several pairs, and are read once."""
    del size, changed  # parts of the key of the cache
    return hashlib.blake2b(read_file(path), digest_size=16).hexdigest()


def _hash_file(path: Path) -> str:
    try:
        state = os.stat(path)
    except OSError:
        return hashlib.blake2b(read_file(path), digest_size=16).hexdigest()  # raises the error that names the file
    return _hash_content(path, state.st_size, state.st_mtime_ns)


def _join_hash(key: str, step: str, settings: list[Any]) -> str:
    return hashlib.blake2b(json.dumps([key, step, settings]).encode(), digest_size=8).hexdigest()


def _shorten(name: str) -> str:
    return name if len(os.fsencode(name)) <= _MAX_NAME else name.encode("ascii", "ignore").decode()[:_MAX_NAME]


def _remove_unfinished(folder: Path) -> None:
    """Remove temporary files of a worker that was killed."""
    for path in folder.glob(".*"):
        if _UNFINISHED.fullmatch(path.name):
            with contextlib.suppress(OSError):
                path.unlink()


# The workers


@contextlib.contextmanager
def start_workers(workers: int | None = None, memory: int | None = None) -> Iterator[LocalCluster]:
    """Worker processes on this machine, which end with the block.

    Args:
        workers: number of processes; by default one per two cores with at least 4 GiB each. They share the cores.
        memory: limit of each, bytes; a worker above 95 % of it is killed and replaced. By default an equal part.
    """
    require_cluster()
    import logging

    from dask import config as dask_config
    from dask.system import CPU_COUNT
    from distributed import LocalCluster
    from distributed.system import MEMORY_LIMIT

    workers = workers or max(1, min(CPU_COUNT // 2, MEMORY_LIMIT // (memory or _DEFAULT_MEMORY)))
    threads = max(1, CPU_COUNT // workers)
    variables = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    settings = {
        # A worker's memory is the work of one task, which Dask cannot spill.
        **{f"distributed.worker.memory.{name}": False for name in ("target", "spill", "pause")},
        "distributed.worker.memory.terminate": 0.95,
        "distributed.scheduler.allowed-failures": _MAX_DEATHS,
        "distributed.scheduler.worker-ttl": None,  # a compiled kernel may hold Python's lock for minutes
        # Dask sets these variables in this process, too: numba fails if its number of threads changes. With Dask's
        # MALLOC_TRIM_THRESHOLD_ each large array is returned to the system, and page faults take a quarter of the time.
        "distributed.nanny.pre-spawn-environ": {},
    }
    with dask_config.set(settings):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,  # pyright: ignore[reportArgumentType]
            memory_limit=memory or MEMORY_LIMIT // workers,
            silence_logs=logging.CRITICAL,
            preload=["pansplat.batch"],
            env=dict.fromkeys(variables, str(threads)),
        )
        try:
            yield cluster
        except BaseException:
            _kill_workers(cluster)
            raise
        finally:
            cluster.close()


def dask_setup(worker: Any) -> None:
    """Called by Dask in each local worker. Ctrl+C in a terminal reaches workers, too, and the command ends them."""
    import torch

    del worker
    warnings.simplefilter("ignore")  # reports have the notes
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))  # it may have been imported before the variable was set
    with contextlib.suppress(ValueError):  # only the main thread can set handlers
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _kill_workers(cluster: LocalCluster) -> None:
    """End the workers at once; Dask waits for the ends of their tasks."""
    for nanny in list(cluster.workers.values()):
        nanny.auto_restart = False
        with contextlib.suppress(OSError, TypeError):
            os.kill(nanny.pid, getattr(signal, "SIGKILL", signal.SIGTERM))  # Windows has no SIGKILL


def connect(address: str) -> Client:
    """A client of a scheduler.

    Raises:
        InputError: nothing answers at the address.
    """
    require_cluster()
    import logging

    from distributed import Client

    for name in ("distributed", "distributed.client"):  # it logs the traceback of a lost connection
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        return Client(address, timeout=_CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"--scheduler {address}: needed a running Dask scheduler, got '{_describe(error)[:200]}'; "
            "check the address, such as tcp://host:8786"
        ) from error


@contextlib.contextmanager
def lock_folder(out: Path) -> Iterator[None]:
    """Make the folder of a batch and lock it against a second batch on this machine.

    Raises:
        InputError: another batch writes to it, or it cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    with open(out / ".lock", "ab") as file:
        try:
            _lock(file.fileno())
        except (BlockingIOError, PermissionError) as error:
            message = f"--out {out}: needed a folder of its own, got one that another batch writes to"
            raise InputError(message) from error
        yield


def _lock(descriptor: int) -> None:
    """Lock a file until it is closed; a BlockingIOError or, on Windows, a PermissionError if another process has."""
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def remove_unfinished(items: Sequence[Item], out: Path) -> None:
    """Remove the temporary files of workers that have ended."""
    for item in items:
        _remove_unfinished(out / item.name)


def run_items(address: str, items: Sequence[Item], options: BatchOptions, out: Path) -> Iterator[ItemReport]:
    """Yield the report of each item when its task ends. If the scheduler is restarted, unfinished tasks are sent again.

    Args:
        address: of the scheduler. The workers must see the items' folders and `out` under the same paths.
        out: absolute.

    Raises:
        InputError: the predictor cannot be loaded, or the scheduler is lost.
    """
    fingerprint = read_fingerprint(options)
    remaining = {item.name: item for item in items}
    losses = 0
    while remaining:
        before = len(remaining)
        with connect(address) as client:
            for report in _run_once(client, list(remaining.values()), options, fingerprint, out):
                del remaining[report.item]
                yield report
        losses = 0 if len(remaining) < before else losses + 1
        if losses == _MAX_LOSSES:
            raise InputError(
                f"--scheduler {address}: needed a scheduler that keeps running, got {losses} lost connections in a "
                "row; run the command again, finished items are kept"
            )


def _run_once(
    client: Client, items: Sequence[Item], options: BatchOptions, fingerprint: str, out: Path
) -> Iterator[ItemReport]:
    """Send one task per item; items of tasks that a lost scheduler forgot have no report."""
    from distributed import as_completed

    run = secrets.token_hex(4)  # the scheduler would answer a repeated key with an old report
    names: dict[str, str] = {}
    futures: list[Future] = []
    for item in items:
        key = f"pansplat-{run}-{item.name}"
        names[key] = item.name
        futures.append(client.submit(process_item, item, options, fingerprint, out, key=key, pure=False))
    for future in as_completed(futures, loop=client.loop):
        if future.status == "finished":
            yield future.result()
        elif future.status == "error":
            error = future.exception()
            text = f"worker: {_describe(error)}"
            if type(error).__name__ == "KilledWorker":
                text = (
                    f"{_MAX_DEATHS + 1} worker processes ended during this item, probably for lack of memory; "
                    "choose a smaller --height, fewer --workers or more --memory"
                )
            yield ItemReport(names[future.key], "failed", 0.0, error=text)
        future.release()
