"""Many pairs and tours: one task each, on the worker processes of a Dask cluster (docs/batch.md).

The name of each output contains a hash of all its inputs, and outputs appear complete or not at all. A task whose
outputs exist does nothing, so that Dask may repeat a task, and a stopped run goes on where it was.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
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
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta, Struct

from pansplat import __version__, pipeline
from pansplat.errors import InputError, InputWarning, collect_notes
from pansplat.export.plan_files import write_picture
from pansplat.gaussians.scene import Scene
from pansplat.images.image_files import list_masks
from pansplat.inputs.folders import find_panorama_folders
from pansplat.inputs.pairs import Pair
from pansplat.inputs.views import CAMERA_HEIGHT
from pansplat.prediction_options import PredictOptions
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig, refinement_fingerprint
from pansplat.system.atomic import replacing
from pansplat.system.console import is_out_of_memory
from pansplat.system.files import SCENE_SUFFIXES, expand_home, is_portable_name, read_file
from pansplat.system.strict_json import read_json
from pansplat.tours.graph import TourGraph, find_tours, merge_scenes
from pansplat.tours.overlap import connect

if TYPE_CHECKING:
    from distributed import LocalCluster

STEPS = ("predict", "refine", "export")
EXPORT_SUFFIXES = (".html", ".png", *SCENE_SUFFIXES)
REPORT_NAME = "report.jsonl"
MIN_MEMORY = 1 << 29  # bytes of a worker; torch and the kernels take half of it

_LAYOUT = "2"  # of the outputs; part of their hashes
_BYTES_PER_PIXEL = 40  # of panoramas, in the .ply of their prediction; most predictors write more
_MAX_NAME = 80  # characters of a pair's name in the name of an output
# Temporary names (pansplat.system.atomic) of outputs.
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
        prediction: the time limit is that of a pair, or of three panoramas of a tour; the number of Gaussians is that
            of a web page.
        camera_height: see `pansplat.load_pairs`.
        suffix: of the exported files; one of `EXPORT_SUFFIXES`.
    """

    steps: tuple[str, ...] = ("predict",)
    prediction: PredictOptions = field(default_factory=PredictOptions)
    camera_height: float = CAMERA_HEIGHT
    suffix: str = ".html"


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
    """The items of a manifest, or the folders with panoramas at or below a folder."""
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
    entries = read_json(path, _Manifest).items
    if not entries:
        raise InputError(f'{path}: needed a list of folders as "items", got none; see docs/batch.md.')
    items = [_read_entry(entry, path, f"{path}, items[{index}]") for index, entry in enumerate(entries)]
    seen: set[str] = set()
    for item in items:
        if item.name in seen:
            raise InputError(f'{path}: needed items of different names, got {item.name!r} twice; add a "name" to one.')
        seen.add(item.name)
    return items


class _Entry(Struct, forbid_unknown_fields=True):
    """An item as a manifest states it."""

    path: Annotated[str, Meta(min_length=1)]
    name: str | None = None
    pair: str | None = None
    convention: str | None = None
    near: float | None = None
    far: float | None = None


class _Manifest(Struct):
    """A manifest: items, or paths of folders."""

    items: list[str | _Entry] = []


def _read_entry(entry: str | _Entry, manifest: Path, source: str) -> Item:
    """An item of a manifest: the path of a folder, or an object."""
    entry = _Entry(entry) if isinstance(entry, str) else entry
    folder = Path(os.path.normpath(manifest.parent / expand_home(entry.path)))
    name = entry.name or (f"{folder.name}-{entry.pair}" if entry.pair else folder.name)
    parts = PurePosixPath(name).parts
    allowed = all(not part.startswith(".") and len(os.fsencode(part)) <= 200 for part in parts)
    if sys.platform == "win32":
        allowed = allowed and all(map(is_portable_name, parts))
    if not parts or name.startswith("/") or not allowed:
        raise InputError(f'{source}: needed a name that can be a folder, got {name[:60]!r}; add another "name".')
    return Item(name, folder, entry.pair, entry.convention, entry.near, entry.far)


# The work of a task


def process_item(item: Item, options: BatchOptions, fingerprint: str, out: Path) -> ItemReport:
    """Do the steps of an item whose outputs are missing; an error is part of the report.

    Args:
        fingerprint: of the predictor that the batch was started with.
        out: folder of the batch.
    """
    began, outputs, error = time.perf_counter(), _Outputs(out / item.name), None
    with collect_notes() as caught:
        try:
            outputs.folder.mkdir(parents=True, exist_ok=True)
            _remove_unfinished(outputs.folder)
            predictor = load_predictor(options.prediction)
            if predictor.fingerprint != fingerprint:
                raise InputError(
                    f"worker: needed the predictor {options.prediction.model} of the machine that started the batch, "
                    "got another one; install the same version of pansplat and the same weights on all machines"
                )
            for pairs, tour in _list_units(item, options.camera_height, pipeline.find_max_views(predictor), outputs):
                _process_unit(pairs, tour, predictor, options, outputs)
        except Exception as problem:  # whatever it is, other items go on
            error = _describe(problem)
    status = "failed" if error else "done" if outputs.num_written else "skipped"
    files = tuple(path.relative_to(out).as_posix() for path in outputs.files)
    notes = tuple(" ".join(note.splitlines()) for note in caught)
    return ItemReport(item.name, status, round(time.perf_counter() - began, 3), files, notes, error)


class _Outputs:
    """The files of an item.

    Attributes:
        files: those that were made or exist.
        num_written: number of those that were made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.files, self.num_written = folder, list[Path](), 0

    def make(self, step: str, key: str, name: str, suffix: str, write: Callable[[Path], object]) -> Path:
        """The file of a step, written if it does not exist."""
        path = self.folder / f"{step}-{key}-{_shorten(name)}{suffix}"
        if not path.exists():
            write(path)
            self.num_written += 1
        self.files.append(path)
        return path


def _describe(error: BaseException) -> str:
    """One line about an error."""
    text = " ".join(str(error).split())
    if isinstance(error, InputError):
        return text
    if is_out_of_memory(error):
        return f"out of memory ({text[:120]}); choose a smaller --height or fewer --workers"
    return f"{type(error).__name__}: {text[:400]}"


def _list_units(
    item: Item, camera_height: float, max_views: int, outputs: _Outputs
) -> list[tuple[Sequence[Pair], TourGraph | None]]:
    """What one file is exported of: a tour with its scenes as pairs, or a pair that belongs to none."""
    pairs = pipeline.load_pairs(
        item.folder, convention=item.convention, near=item.near, far=item.far, camera_height=camera_height
    )
    if item.pair is not None:
        chosen = [pair for pair in pairs if pair.name == item.pair]
        if not chosen:
            names = ", ".join(pair.name for pair in pairs[:8])
            raise InputError(f"{item.folder}: needed a pair {item.pair!r}, got {names}; correct the manifest.")
        return [([pair], None) for pair in chosen]
    units: list[tuple[Sequence[Pair], TourGraph | None]] = []
    images = set()
    for tour in find_tours(pairs):
        images |= {panorama.image for panorama in tour.panoramas}
        graph = _connect(tour, outputs)
        units.append(([graph.make_pair(views) for views in graph.choose_sources(max_views)], graph))
    return units + [([pair], None) for pair in pairs if pair.context[0].image not in images]


def _connect(tour: TourGraph, outputs: _Outputs) -> TourGraph:
    """The connected graph of a tour, from its file."""
    panoramas = [[view.name, view.cam2world.tolist(), *_hash_image(view.image)] for view in tour.panoramas]
    key = _join_hash(_LAYOUT, "graph", [panoramas, tour.near, tour.far, list(tour.overlaps)])

    def write(path: Path) -> None:
        overlaps = connect(tour).list_overlaps()
        with replacing(path) as temporary:
            temporary.write_text(json.dumps({"overlaps": overlaps}), "utf-8")

    path = outputs.make("graph", key, tour.name, ".json", write)
    return tour.with_overlaps(tuple(read_json(path, dict[str, list[tuple[int, int, float]]])["overlaps"]))


@lru_cache(maxsize=1)
def load_predictor(options: PredictOptions) -> Predictor:
    """The predictor of a batch."""
    return pipeline.load_predictor(options)


def _process_unit(
    pairs: Sequence[Pair], tour: TourGraph | None, predictor: Predictor, options: BatchOptions, outputs: _Outputs
) -> None:
    """Predict, refine and export a pair, or a tour with its scenes as pairs."""
    name, part = (pairs[0].name, None) if tour is None else (tour.name, _count_of_page(options) / len(tour))
    alone = sum(len(pair.context) == 1 for pair in pairs)
    if alone and "refine" in options.steps:
        count = f"{alone} single views are" if alone > 1 else "a single view is"
        warnings.warn(f"{name}: {count} not refined.", InputWarning, stacklevel=2)
    if tour is not None:
        pipeline.warn_of_single_views(tour, predictor)
    predictors = [predictor if tour is None else pipeline.choose_predictor(pair, predictor) for pair in pairs]
    made = [_process_pair(pair, part, each, options, outputs) for pair, each in zip(pairs, predictors, strict=True)]
    if "export" not in options.steps:
        return

    def export(path: Path) -> None:
        if tour is None:
            scene = made[0][1]()
        else:
            max_views = pipeline.find_max_views(predictor)
            readers = dict(zip(tour.choose_sources(max_views), (read for _, read in made), strict=True))
            scene = merge_scenes(tour, lambda views: readers[views](), max_views)
        if options.suffix == ".html":
            from pansplat.export.page import write_page
            from pansplat.export.photographs import list_photographs

            count, title = int(_count_of_page(options)), name.replace("_", " ")
            photographs = list_photographs(tour or pairs[0], range(len(scene.cam2world)))
            write_page(scene, path, gaussians=count, title=title, photographs=photographs)
        elif options.suffix == ".png":
            write_picture(scene, path)
        elif pipeline.can_stream(predictor):
            pipeline.save(scene, path)  # networks are trained for joint drawing
        elif tour is not None:
            pipeline.save(pipeline.fuse_tour(tour, scene), path)
        else:
            pipeline.save(pipeline.fuse(scene, pairs[0].load_context(scene.height)), path)

    settings = [__version__, options.suffix, options.prediction.gaussians, [] if tour is None else _list_graph(tour)]
    key = _join_hash(",".join(key for key, _ in made), "export", settings)
    outputs.make("export", key, name, options.suffix, export)


def _process_pair(
    pair: Pair, part: float | None, predictor: Predictor, options: BatchOptions, outputs: _Outputs
) -> tuple[str, Callable[[], Scene]]:
    """Predict and refine a pair, or a scene of a tour. A single view is predicted only.

    Args:
        part: number of Gaussians that the export of a tour needs of each panorama; None for a pair.

    Returns:
        Hash of all that the scene depends on, and a function that reads it, or computes it if no step writes a file.
    """
    fitted = pipeline.fit_to_scene(options.prediction, pair, part or math.inf)
    height, count = options.prediction.height if part is None else fitted.height, fitted.gaussians
    key = _join_hash(_hash_pair(pair), "predict", [predictor.name, predictor.fingerprint, height])
    read = partial(pipeline.predict, pair, predictor, height=height, cache=False)
    is_refined = "refine" in options.steps and len(pair.context) > 1
    if "predict" in options.steps or ("refine" in options.steps and not is_refined):

        def predict(path: Path) -> None:
            rows = height or pipeline.choose_height(pair, predictor)
            needed, free = _BYTES_PER_PIXEL * len(pair.context) * 2 * rows**2, shutil.disk_usage(outputs.folder).free
            if free < needed:  # a full disk must not cost the time of the prediction
                raise InputError(
                    f"{outputs.folder}: needed at least {needed / 1e6:,.1f} MB of free disk space for {pair.name}, "
                    f"got {free / 1e6:,.1f} MB; free some and run the command again"
                )
            pipeline.predict_to_file(pair, path, predictor, height=rows)

        read = partial(pipeline.load, outputs.make("predict", key, pair.name, ".ply", predict))
    if is_refined:
        read_prediction, seconds = read, fitted.refine_seconds

        def refine(path: Path) -> None:
            scene = read_prediction()
            views = pipeline.load_photographs(pair, scene.height, count)
            pipeline.refine_to_file(scene, views, path, seconds=seconds, config=RefineConfig(gaussians=count))

        key = _join_hash(key, "refine", [refinement_fingerprint(), seconds, count])
        read = partial(pipeline.load, outputs.make("refine", key, pair.name, ".ply", refine))
    return key, read


def _list_graph(tour: TourGraph) -> list[Any]:
    """What the scene of a tour states of its graph: edges, and titles, links and start views if there are any."""
    edges = [[*edge, round(overlap, 6)] for *edge, overlap in tour.list_overlaps()]
    stated = [
        [node, view.title, view.start, [dataclasses.astuple(link) for link in view.links]]
        for node, view in enumerate(tour.panoramas)
        if view.title or view.start or view.links
    ]
    return edges + stated


def _count_of_page(options: BatchOptions) -> float:
    """The largest number of Gaussians of a page; infinite for other files."""
    if "export" not in options.steps or options.suffix != ".html":
        return math.inf
    from pansplat.export.page import PHOTO_GAUSSIANS

    return options.prediction.gaussians or PHOTO_GAUSSIANS


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
    if not os.path.exists(path):
        return _hash_content(path, 0, 0)  # raises the error that names the file
    state = os.stat(path)
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


def remove_unfinished(items: Sequence[Item], out: Path) -> None:
    """Remove the temporary files of workers that have ended."""
    for item in items:
        _remove_unfinished(out / item.name)


# The workers


@contextlib.contextmanager
def start_workers(workers: int | None = None, memory: int | None = None) -> Iterator[LocalCluster]:
    """Worker processes on this machine, which end with the block.

    Args:
        workers: number of processes; by default one per two cores with at least 4 GiB each. They share the cores.
        memory: limit of each, bytes; a worker above 95 % of it is killed and replaced. By default an equal part.
    """
    import logging

    from dask import config as dask_config
    from dask.system import CPU_COUNT
    from distributed import LocalCluster
    from distributed.system import MEMORY_LIMIT

    workers = workers or max(1, min(CPU_COUNT // 2, MEMORY_LIMIT // (memory or _DEFAULT_MEMORY)))
    memory = min(memory or MEMORY_LIMIT // workers, MEMORY_LIMIT)
    print(f"workers: {workers}, of at most {memory / 2**30:.1f} GiB each", file=sys.stderr)
    variables = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    settings = {
        # A worker's memory is the work of one task, which Dask cannot spill.
        **{f"distributed.worker.memory.{name}": False for name in ("target", "spill", "pause")},
        "distributed.scheduler.worker-ttl": None,  # a compiled kernel may hold Python's lock for minutes
        # Dask sets these variables in this process, too: numba fails if its number of threads changes. With Dask's
        # MALLOC_TRIM_THRESHOLD_ each large array is returned to the system, and page faults take a quarter of the time.
        "distributed.nanny.pre-spawn-environ": {},
    }
    with dask_config.set(settings):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            dashboard_address=None,  # pyright: ignore[reportArgumentType]
            memory_limit=memory,
            silence_logs=logging.CRITICAL,
            preload=["pansplat.batch"],
            env=dict.fromkeys(variables, str(max(1, CPU_COUNT // workers))),
        )
        with cluster:
            yield cluster


def dask_setup(worker: Any) -> None:
    """Called by Dask in each local worker. Ctrl+C in a terminal reaches workers, too, and the command ends them."""
    import torch

    del worker
    warnings.simplefilter("ignore")  # reports have the notes
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))  # it may have been imported before the variable was set
    with contextlib.suppress(ValueError):  # only the main thread can set handlers
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def lock_folder(out: Path) -> Iterator[None]:
    """Make the folder of a batch and lock it against a second batch on this machine."""
    import locket  # Dask needs it, too

    out.mkdir(parents=True, exist_ok=True)
    lock = locket.lock_file(str(out / ".lock"), timeout=0)
    try:
        lock.acquire()
    except locket.LockError as error:
        message = f"--out {out}: needed a folder of its own, got one that another batch writes to"
        raise InputError(message) from error
    try:
        yield
    finally:
        lock.release()


def run_items(address: str, items: Sequence[Item], options: BatchOptions, out: Path) -> Iterator[ItemReport]:
    """Yield the report of each item when its task ends.

    Args:
        address: of the scheduler. The workers must see the items' folders and `out` under the same paths.
        out: absolute.
    """
    import logging

    from distributed import Client, as_completed

    for name in ("distributed", "distributed.client"):  # it logs the traceback of a lost connection
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, set_as_default=False)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"--scheduler {address}: needed a running Dask scheduler, got '{_describe(error)[:200]}'; "
            "check the address, such as tcp://host:8786"
        ) from error
    run = secrets.token_hex(4)  # the scheduler would answer a repeated key with an old report
    names = {f"pansplat-{run}-{item.name}": item.name for item in items}
    arguments = {"options": options, "fingerprint": load_predictor(options.prediction).fingerprint, "out": out}
    with client:
        futures = client.map(process_item, items, key=list(names), pure=False, **arguments)
        for future in as_completed(futures, loop=client.loop):
            if future.status == "finished":
                yield future.result()
            elif future.status == "error":
                error = future.exception()
                text = f"worker: {_describe(error)}"
                if type(error).__name__ == "KilledWorker":
                    text = (
                        "several worker processes ended during this item, probably for lack of memory; "
                        "choose a smaller --height, fewer --workers or more --memory"
                    )
                yield ItemReport(names[future.key], "failed", 0.0, error=text)
            else:
                raise InputError(
                    f"--scheduler {address}: needed a scheduler that keeps running, got a lost connection; run the "
                    "command again, finished items are kept"
                )
            future.release()
