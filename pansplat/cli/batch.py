"""`pansplat batch`: many pairs and tours, on worker processes of one or many machines."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import time
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from pansplat.cli.inputs import Out, Writer
from pansplat.errors import InputError
from pansplat.prediction_options import PredictOptions
from pansplat.system.console import print_message, progress_bar
from pansplat.system.descriptions import describe_count
from pansplat.system.files import expand_home, require_output_folder, require_replaceable
from pansplat.system.options import Count, Positive, Threads

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pansplat.batch import BatchOptions, ItemReport


@dataclass(frozen=True)
class Batch(Writer):
    """Predict, refine and export many pairs and tours; finished items are not done again (docs/batch.md).

    An item that fails is reported and stops no other; the exit status is 1 then.
    """

    path: Positional[Path]
    """A folder whose subfolders hold panoramas, or a manifest (.json)."""
    out: Out
    """Folder for the results and the report, report.jsonl."""
    do: str = "predict"
    """Steps, separated by commas: predict, refine, export."""
    workers: Threads | None = None
    """Number of worker processes on this machine; by default one per two cores with at least 4 GiB each."""
    memory: str | None = None
    """Memory of each worker, such as 4GiB; a worker that takes more is replaced. By default an equal part."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Address of a running Dask scheduler, such as tcp://host:8786, whose workers are used instead."""
    prediction: PredictOptions = field(default_factory=PredictOptions)
    camera_height: Positive = 1.5
    """Height of the cameras over the floor, metres: the scale of a single photograph, and of a folder without poses."""
    format: str = "html"
    """Format of the export: html, png (a floor plan), ply, compressed.ply, spz, splat, sog or glb."""
    gaussians: Count | None = None
    """For html: largest number of Gaussians, 450,000 by default."""

    def run(self) -> int:
        """Run all items, write the report and print a summary."""
        from pansplat import batch

        require_output_folder("--out", self.out)
        require_replaceable("--out", [expand_home(self.out) / batch.REPORT_NAME], self.overwrite)
        options = self._make_options()
        if importlib.util.find_spec("distributed") is None:
            raise InputError(
                "pansplat batch: needed the package distributed, got none; run pip install 'pansplat[cluster]'"
            )
        memory = self._parse_memory()
        items = batch.list_items(self.path)
        batch.load_predictor(options.prediction)  # an unknown model is an error of the command, not of each item
        out = expand_home(self.out).absolute()
        with batch.lock_folder(out):
            try:
                with batch.start_workers(self.workers, memory) if self.scheduler is None else nullcontext() as local:
                    began = time.perf_counter()  # the workers have started
                    address = self.scheduler if local is None else local.scheduler_address
                    found = batch.run_items(str(address), items, options, out)
                    count, problem = _write_report(found, len(items), out / batch.REPORT_NAME)
                    seconds = time.perf_counter() - began
            finally:
                if self.scheduler is None:
                    batch.remove_unfinished(items, out)
        counted = describe_count(len(items), "item")
        print(
            f"{self.out}: {counted}: {count['done']:,} done, {count['skipped']:,} already there, "
            f"{count['failed']:,} failed, in {seconds:.1f} s; {self.out / batch.REPORT_NAME}"
        )
        if problem is not None:
            print_message("error", problem)
        return 1 if count["failed"] or problem is not None else 0

    def _make_options(self) -> BatchOptions:
        """The checked options of the steps."""
        from pansplat import batch

        steps = {word.strip() for word in self.do.split(",")}
        unknown = sorted(steps - set(batch.STEPS))
        if unknown:
            raise InputError(f"--do must be some of {','.join(batch.STEPS)}, got {unknown[0]!r}")
        suffix = f".{self.format.lower().lstrip('.')}"
        if suffix not in batch.EXPORT_SUFFIXES:
            known = ", ".join(name.lstrip(".") for name in batch.EXPORT_SUFFIXES)
            raise InputError(f"--format must be one of {known}, got {self.format!r}")
        if self.gaussians is not None and suffix != ".html":
            raise InputError(f"--gaussians is for --format html, got {self.format}; leave it out")
        if self.scheduler is not None and (self.workers is not None or self.memory is not None):
            raise InputError("--workers and --memory are for workers of this machine; leave them out with --scheduler")
        model = self.prediction.model
        if Path(model).suffix != "":
            model = str(expand_home(model).absolute())  # of workers in other folders
        prediction = dataclasses.replace(self.prediction, model=model, gaussians=self.gaussians)
        chosen = tuple(step for step in batch.STEPS if step in steps)
        return batch.BatchOptions(chosen, prediction, self.camera_height, suffix)

    def _parse_memory(self) -> int | None:
        """The number of bytes that `--memory` states."""
        if self.memory is None:
            return None
        from dask.utils import parse_bytes

        from pansplat.batch import MIN_MEMORY

        try:
            memory = parse_bytes(self.memory)
        except ValueError:
            memory = 0
        if not MIN_MEMORY <= memory < 1 << 50:
            raise InputError(f"--memory must be at least {MIN_MEMORY >> 20}MiB, such as 4GiB, got {self.memory!r:.40}")
        return memory


def _write_report(reports: Iterator[ItemReport], total: int, path: Path) -> tuple[Counter[str], str | None]:
    """Write a line of the report at the end of each item. While the disk is full, lines wait, and the items go on.

    Returns:
        The number of items of each status, and a message if lines could not be written.
    """
    count, waiting, reason = Counter[str](), b"", ""
    with progress_bar() as progress, open(path, "wb", 0) as file:
        for report in reports:
            count[report.status] += 1
            waiting += json.dumps({"software": "pansplat", **dataclasses.asdict(report)}).encode() + b"\n"
            try:
                waiting = waiting[file.write(waiting) :]
            except OSError as error:
                reason = error.strerror
            progress(f"{count.total()} of {total}: {report.item[-30:]}", count.total() / total)
            if report.error is not None:
                print_message("note", f"{report.item}: {report.error}")
    if not waiting:
        return count, None
    return count, (
        f"{path}: needed free disk space for the report, got {reason!r}; the items are finished: "
        "free some space and run the same command again"
    )
