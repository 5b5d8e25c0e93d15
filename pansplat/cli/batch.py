"""`pansplat batch`: many pairs and tours, on worker processes of one or many machines."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from pansplat.cli.inputs import Compat, Out, Precision, Writer
from pansplat.console import print_message, progress_bar
from pansplat.errors import InputError
from pansplat.files import expand_home, require_output_folder, require_replaceable
from pansplat.options import Count, Height, Positive, Seconds, Threads

if TYPE_CHECKING:
    from pansplat.batch import BatchOptions, Item, ItemReport


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
    model: str = "default"
    """Predictor: `default`, `sweep` (without weights), or a file of weights."""
    compat: Compat = "trained"
    """For a network: official, fixed, or as its weights were trained; see `pansplat predict --help`."""
    precision: Precision = "float32"
    """Number type of a network's convolutions."""
    height: Height | None = None
    """Panoramas are resized to this height, pixels; by default that of the photographs, at most 1024 (for networks
    512)."""
    camera_height: Positive = 1.5
    """Height of the cameras over the floor, metres: the scale of a single photograph, and of a folder without poses."""
    refine: Seconds = 10.0
    """Time limit of the refinement of a pair, seconds."""
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
        batch.require_cluster()
        memory = self._parse_memory()
        items = batch.list_items(self.path)
        batch.read_fingerprint(options)  # an unknown model is an error of the command, not of each item
        out = expand_home(self.out).absolute()
        with batch.lock_folder(out):
            try:
                reports, seconds, problem = self._run_items(items, options, out, memory)
            finally:
                if self.scheduler is None:
                    batch.remove_unfinished(items, out)
        count = {status: sum(r.status == status for r in reports) for status in ("done", "skipped", "failed")}
        print(
            f"{self.out}: {len(items):,} items: {count['done']:,} done, {count['skipped']:,} already there, "
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
        is_file = Path(self.model).suffix != ""
        return batch.BatchOptions(
            steps=tuple(step for step in batch.STEPS if step in steps),
            model=str(expand_home(self.model).absolute()) if is_file else self.model,
            compat=self.compat,
            precision=self.precision,
            height=self.height,
            camera_height=self.camera_height,
            refine_seconds=self.refine,
            suffix=suffix,
            gaussians=self.gaussians,
        )

    def _parse_memory(self) -> int | None:
        """Bytes of --memory."""
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

    def _run_items(
        self, items: list[Item], options: BatchOptions, out: Path, memory: int | None
    ) -> tuple[list[ItemReport], float, str | None]:
        """Run the items, and write a line of the report at the end of each.

        Returns:
            The reports, the seconds since the workers of this machine have started, and a message if the report could
            not be written.
        """
        from pansplat import batch

        reports = []
        cluster = batch.start_workers(self.workers, memory) if self.scheduler is None else nullcontext()
        with cluster as local, progress_bar() as progress, open(out / batch.REPORT_NAME, "wb", 0) as file:
            lines = ReportFile(file)
            address = self.scheduler or ""
            if local is not None:
                workers = list(local.workers.values())
                limit = workers[0].memory_manager.memory_limit / 2**30
                address = local.scheduler_address
                print(f"workers: {len(workers)}, of at most {limit:.1f} GiB each", file=sys.stderr)
            began = time.perf_counter()
            for report in batch.run_items(address, items, options, out):
                reports.append(report)
                lines.add(json.dumps({"software": "pansplat", **dataclasses.asdict(report)}) + "\n")
                progress(f"{len(reports)} of {len(items)}: {report.item[-30:]}", len(reports) / len(items))
                if report.error is not None:
                    print_message("note", f"{report.item}: {report.error}")
            return reports, time.perf_counter() - began, lines.problem


class ReportFile:
    """The report. While the disk is full, lines wait, and the items go on.

    Args:
        file: without a buffer.
    """

    def __init__(self, file: FileIO) -> None:
        self._file, self._waiting, self._reason = file, b"", "No space left on device"

    def add(self, line: str) -> None:
        """Write the lines that wait, and another one."""
        self._waiting += line.encode()
        try:
            self._waiting = self._waiting[self._file.write(self._waiting) :]
        except OSError as error:
            self._reason = error.strerror or str(error)

    @property
    def problem(self) -> str | None:
        """What prevents that lines are written; None if none waits."""
        if not self._waiting:
            return None
        return (
            f"{self._file.name}: needed free disk space for the report, got {self._reason!r}; the items are finished: "
            "free some space and run the same command again"
        )
