"""`pansplat batch`: `pansplat predict` and `export` of many folders, on worker processes of one or many machines.

The name of an output has a hash of all that it depends on. Outputs appear complete or not at all, and one that exists
is not made again: Dask may repeat a task, and a stopped batch goes on where it was.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import secrets
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from pansplat.cli.export import Export, Page
from pansplat.cli.inputs import Computation, Out, PairChoice, ScenePrediction
from pansplat.cli.predict import Predict
from pansplat.errors import InputError, collect_notes
from pansplat.prediction_options import PredictOptions, ReadOptions, choose_caches
from pansplat.system.console import is_out_of_memory, print_message, progress_bar
from pansplat.system.descriptions import describe_count
from pansplat.system.devices import with_device
from pansplat.system.files import (
    SCENE_SUFFIXES,
    expand_home,
    make_portable_name,
    require_output_folder,
    require_replaceable,
)
from pansplat.system.options import Count, Threads
from pansplat.system.progress import report_progress

if TYPE_CHECKING:
    from distributed import LocalCluster

STEPS = ("predict", "refine", "export")
REPORT_NAME = "report.jsonl"
_PROGRAM, _PROGRAM_SUFFIXES = ("pansplat.web", "pansplat.shaders"), (".js", ".html", ".css", ".glsl", ".vert", ".frag")
_MAX_NAME = 40  # letters of a pair's name that the name of an output repeats
_WORKER_MEMORY = 4 << 30  # bytes that a worker needs, for the default number of workers


@dataclass(frozen=True)
class Batch(Computation):
    """Predict, refine and export many pairs and tours; what is up to date is not made again (docs/batch.md).

    An item that fails is reported and stops no other; the exit status is 1 then.
    """

    path: Positional[Path]
    """A folder whose subfolders hold panoramas."""
    out: Out
    """Folder for the results and the report, report.jsonl."""
    do: str = "predict"
    """Steps, separated by commas: predict, refine, export."""
    format: Literal["html", "svg", "png", "ply", "compressed.ply", "spz", "splat", "sog", "glb"] = "html"
    """Format of the export: a web page, a floor plan (svg, png), or a scene."""
    gaussians: Count | None = None
    """For html: largest number of Gaussians, by default 300,000 to 450,000."""
    workers: Threads | None = None
    """Number of worker processes on this machine; by default one per two cores with at least 4 GiB each."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Address of a running Dask scheduler, such as tcp://host:8786, whose workers are used instead."""
    reading: Annotated[ReadOptions, arg(name="")] = field(default_factory=ReadOptions)
    prediction: PredictOptions = field(default_factory=PredictOptions)

    def run(self) -> int:
        """Run all items, write the report and print a summary."""
        require_output_folder("--out", self.out)
        report = expand_home(self.out).absolute() / REPORT_NAME
        require_replaceable("--out", [report], self.overwrite)
        unknown = sorted(set(self.steps) - set(STEPS))
        if unknown:
            raise InputError(f"--do must be some of {','.join(STEPS)}, got {unknown[0]!r}")
        if self.gaussians is not None and self.format != "html":
            raise InputError(f"--gaussians is for --format html, got {self.format}; leave it out")
        if self.scheduler is not None and self.workers is not None:
            raise InputError("--workers is for workers of this machine; leave it out with --scheduler")
        if importlib.util.find_spec("distributed") is None:
            raise InputError(
                "pansplat batch: needed the package distributed, got none; run pip install 'pansplat[cluster]'"
            )
        import locket  # Dask needs locket, too

        items, model, network = list_items(self.path), self.prediction.model, self.prediction.depth_network
        if Path(model).suffix != "":
            model = str(expand_home(model).absolute())  # workers may run in other folders
        chosen = {"model": model, "depth_network": network and expand_home(network).absolute()}
        batch = replace(self, out=report.parent, prediction=replace(self.prediction, **chosen))
        fingerprint_work(batch.prediction)  # an unknown model is an error of the command instead of each item
        batch.out.mkdir(parents=True, exist_ok=True)
        try:
            with locket.lock_file(str(batch.out / ".lock"), timeout=0):
                began = time.perf_counter()
                count = batch._run_items(items)
        except locket.LockError as error:
            message = f"--out {self.out}: needed a folder of its own, got one that another batch writes to"
            raise InputError(message) from error
        print(
            f"{self.out}: {describe_count(len(items), 'item')}: {count['done']:,} done, {count['skipped']:,} already "
            f"there, {count['failed']:,} failed, in {time.perf_counter() - began:.1f} s; {self.out / REPORT_NAME}"
        )
        return 1 if count["failed"] else 0

    @property
    def steps(self) -> list[str]:
        """What is done."""
        return [word.strip() for word in self.do.split(",")]

    def _run_items(self, items: Mapping[str, Path]) -> Counter[str]:
        """Run all items on the workers, and write a line of the report at the end of each; counts by status."""
        count = Counter[str]()
        try:
            with (
                start_workers(self.workers) if self.scheduler is None else contextlib.nullcontext() as local,
                open(self.out / REPORT_NAME, "wb", 0) as file,
                progress_bar(),
            ):
                for line in run_items(str(local.scheduler_address if local else self.scheduler), items, self):
                    file.write(json.dumps({"software": "pansplat", **line}).encode() + b"\n")
                    count[line["status"]] += 1
                    report_progress(
                        f"{count.total()} of {len(items)}: {line['item'][-30:]}", count.total() / len(items)
                    )
                    if line["error"] is not None:
                        print_message("note", f"{line['item']}: {line['error']}")
        finally:
            for name in items if self.scheduler is None else ():
                _remove_unfinished(self.out / name)
        return count

    def list_commands(self, folder: Path) -> dict[str, Export | Predict]:
        """The names of the outputs of a folder, and the commands that write them."""
        from pansplat import pipeline
        from pansplat.inputs.content import hash_panorama, hash_pixels
        from pansplat.inputs.panorama_sets import PanoramaSet
        from pansplat.system.store import hash_parts
        from pansplat.tours.graph import find_tours
        from pansplat.tours.scene_graph import describe_tour

        pairs, found = pipeline.load_sets(folder, **vars(self.reading)), {}
        tours = find_tours(pairs)
        images = {panorama.image for tour in tours for panorama in tour.panoramas}
        for source in (*tours, *(pair for pair in pairs if pair.context[0].image not in images)):
            content = hash_pixels(source.panoramas, source.siblings), *map(hash_panorama, source.panoramas)
            edges = () if isinstance(source, PanoramaSet) else describe_tour(source).overlaps
            for step in (step for step in STEPS if step in self.steps):
                options = self.prediction
                if step == "predict" or "refine" not in self.steps:
                    options = replace(options, refine_steps=0)
                suffix = f".{self.format}" if step == "export" else ".ply"
                choice = PairChoice(source.name, self.reading)
                command = Predict(Path(), Path(suffix), layers=step != "export", prediction=options, choice=choice)
                if suffix not in SCENE_SUFFIXES:
                    prediction = ScenePrediction(options, choice)
                    command = Export(Path(), Path(suffix), page=Page(gaussians=self.gaussians), prediction=prediction)
                stated = fingerprint_work(self.prediction), step, repr(command), f"{source.near} {source.far} {edges}"
                name = make_portable_name(source.name)[:_MAX_NAME].replace(".", "_")
                found[f"{step}-{hash_parts(*stated, *content)[:16]}-{name}{suffix}"] = replace(command, path=folder)
        return found


def list_items(path: Path) -> dict[str, Path]:
    """The folders with panoramas at or below a folder, by the names of their outputs."""
    from pansplat.inputs.folders import find_panorama_folders

    path = expand_home(path).absolute()
    try:
        folders = find_panorama_folders(path)
    except OSError as error:
        raise InputError(f"{error.filename or path}: needed a readable folder, got '{error.strerror}'.") from error
    if not folders:
        raise InputError(f"{path}: needed folders with panoramas, got none; check it (docs/batch.md).")
    return {folder.name if folder == path else folder.relative_to(path).as_posix(): folder for folder in folders}


@with_device
def process_item(item: tuple[str, Path], batch: Batch, fingerprint: str) -> dict[str, Any]:
    """Make the outputs of a folder that are missing, and remove those in whose place they are.

    Args:
        item: of `list_items`.
        batch: with absolute paths.
        fingerprint: of the machine that started the batch (`fingerprint_work`).

    Returns:
        A line of the report; an error is part of it.
    """
    began, files, num_made, error = time.perf_counter(), list[Path](), 0, None
    folder = batch.out / item[0]
    silent = contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO())
    with collect_notes() as notes, silent[0], silent[1], choose_caches(batch):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _remove_unfinished(folder)
            if fingerprint_work(batch.prediction) != fingerprint:
                raise InputError(
                    f"worker: needed the predictor {batch.prediction.model} of the machine that started the batch, "
                    "got another one; install the same version of pansplat and the same weights on all machines"
                )
            for name, command in batch.list_commands(item[1]).items():
                if not (folder / name).exists():
                    replace(command, out=folder / name).run()
                    num_made += 1
                files.append(folder / name)
            for step in batch.steps:
                suffix = batch.format if step == "export" else "ply"
                for path in folder.glob(f"{step}-{'[0-9a-f]' * 16}-*"):
                    if path not in files and path.name.partition(".")[2] == suffix:
                        path.unlink()
        except Exception as problem:  # whatever the problem is, other items go on
            error = _describe(problem)
    return {
        "item": item[0],
        "status": "failed" if error else "done" if num_made else "skipped",
        "seconds": round(time.perf_counter() - began, 3),
        "outputs": [path.relative_to(batch.out).as_posix() for path in files],
        "notes": list(dict.fromkeys(" ".join(note.splitlines()) for note in notes)),  # steps repeat some
        "error": error,
    }


@lru_cache(maxsize=1)
def fingerprint_work(options: PredictOptions) -> str:
    """A hash of the code, the program of pages and the weights of a batch, which all its machines have."""
    from pansplat import __version__, pipeline
    from pansplat.system.source_hash import hash_sources
    from pansplat.system.store import hash_file, hash_parts

    files = (Path(str(file)) for name in _PROGRAM for file in resources.files(name).iterdir())
    program = (f"{file.name} {hash_file(file)}" for file in sorted(files) if file.suffix in _PROGRAM_SUFFIXES)
    return hash_parts(__version__, hash_sources(__name__), *program, pipeline.load_predictor(options).fingerprint)


def _describe(error: BaseException) -> str:
    """One line about an error."""
    text = " ".join(str(error).split())
    if is_out_of_memory(error):
        return f"out of memory ({text[:120]}); choose a smaller --height or fewer --workers"
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text[:400]}"


def _remove_unfinished(folder: Path) -> None:
    """Remove temporary files of workers that have ended."""
    from pansplat.system.atomic import is_unfinished

    for path in folder.glob(".*"):
        if is_unfinished(path) and path.name.startswith(tuple(f".{step}-" for step in STEPS)):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def start_workers(workers: int | None = None) -> Iterator[LocalCluster]:
    """Worker processes on this machine, which end with the block. They share its cores and memory.

    Args:
        workers: number of processes; by default one per two cores with at least 4 GiB each.
    """
    import logging

    from dask import config as dask_config
    from dask.system import CPU_COUNT
    from distributed import LocalCluster
    from distributed.system import MEMORY_LIMIT

    workers = workers or max(1, min(CPU_COUNT // 2, MEMORY_LIMIT // _WORKER_MEMORY))
    print(f"workers: {workers}, of at most {MEMORY_LIMIT / workers / 2**30:.1f} GiB each", file=sys.stderr)
    variables = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    settings = {
        # A worker's memory is the work of one task, which Dask cannot spill.
        **{f"distributed.worker.memory.{name}": False for name in ("target", "spill", "pause")},
        "distributed.scheduler.worker-ttl": None,  # a compiled kernel may hold Python's lock for minutes
        # Dask sets these variables in this process, too: numba fails if its number of threads changes. With Dask's
        # MALLOC_TRIM_THRESHOLD_ each large array is returned to the system, and page faults take a quarter of the time.
        "distributed.nanny.pre-spawn-environ": {},
    }
    with (
        dask_config.set(settings),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            dashboard_address=None,  # pyright: ignore[reportArgumentType]
            memory_limit=MEMORY_LIMIT // workers,
            silence_logs=logging.CRITICAL,
            preload=[__name__],
            env=dict.fromkeys(variables, str(max(1, CPU_COUNT // workers))),
        ) as cluster,
    ):
        yield cluster


def dask_setup(worker: Any) -> None:
    """Called by Dask in each local worker. Ctrl+C in a terminal reaches workers, too, and the command ends them."""
    import torch

    del worker
    warnings.simplefilter("ignore")  # reports have the notes
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))  # torch may have been imported before it was set
    with contextlib.suppress(ValueError):  # only the main thread can set handlers
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def run_items(address: str, items: Mapping[str, Path], batch: Batch) -> Iterator[dict[str, Any]]:
    """Yield the line of the report of each item when its task ends.

    Args:
        address: of the scheduler. The workers must see the items' folders and that of the batch under the same paths.
        items: of `list_items`.
        batch: with absolute paths.
    """
    import logging

    from distributed import Client, KilledWorker, as_completed

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
    names = {f"pansplat-{run}-{name}": name for name in items}
    arguments = {"batch": batch, "fingerprint": fingerprint_work(batch.prediction), "device": batch.device}
    with client:
        futures = client.map(process_item, list(items.items()), key=list(names), pure=False, **arguments)
        for future in as_completed(futures, loop=client.loop):
            if future.status == "finished":
                yield future.result()
            elif future.status == "error":
                text = f"worker: {_describe(future.exception())}"
                if isinstance(future.exception(), KilledWorker):
                    text = (
                        "several worker processes ended during this item, probably for lack of memory; choose a "
                        "smaller --height or fewer --workers"
                    )
                failed = {"item": names[future.key], "status": "failed", "seconds": 0.0, "error": text}
                yield failed | {"outputs": [], "notes": []}
            else:
                raise InputError(
                    f"--scheduler {address}: needed a scheduler that keeps running, got a lost connection; run the "
                    "command again, finished items are kept"
                )
            future.release()
