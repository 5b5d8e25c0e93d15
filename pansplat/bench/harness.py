"""The harness of all benchmarks: a suite is a function that yields rows; `run` prints and writes them.

Time, memory and errors of single calls are measured here, too.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import math
import platform
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from pansplat.evaluation.results import Column, Row, markdown_table, rich_table, write_json
from pansplat.system.atomic import replacing
from pansplat.system.console import make_table_console
from pansplat.system.files import SOFTWARE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

T = TypeVar("T")
Header = Mapping[str, Any]

_WIDTH = 210  # characters of a printed line without a terminal
MEAN = "mean"  # name of the scene in rows that average all others
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_PACKAGES = ("pansplat", "torch", "numpy", "numba")


@dataclass(frozen=True)
class Suite:
    """What the rows of one benchmark have in common.

    Attributes:
        name: the start of the names of its files: NAME.json, NAME.md and NAME.png.
        columns: the columns of its tables.
        section: title of the table that a row belongs to.
        plot: a function that plots the rows, given also the header of the JSON file; None if there is nothing to plot.
        findings: sentences about all rows, for the terminal and the page.
    """

    name: str
    columns: Sequence[Column]
    section: Callable[[Row], str]
    plot: Callable[[Sequence[Row], Header], Figure | None]
    findings: Callable[[Sequence[Row]], list[str]] = lambda rows: []

    def sections(self, rows: Sequence[Row]) -> dict[str, list[Row]]:
        """The rows of each table by its title."""
        sections: dict[str, list[Row]] = {}
        for row in rows:
            sections.setdefault(self.section(row), []).append(row)
        return sections


def run(suite: Suite, measured: Iterable[Row], header: Header, out: Path | None = None) -> list[Row]:
    """Measure the rows, print their tables and findings, and write the files; return the rows.

    The rows so far are written as NAME.json after each one, and printed if the run is interrupted.

    Args:
        measured: rows as they are measured; a changed row may be yielded again.
        header: values of the JSON file beside the rows and the machine.
        out: folder for the files; None for none.
    """
    header = {"machine": describe_machine(), **header}
    rows: list[Row] = []
    try:
        for row in measured:
            rows += [] if any(row is known for known in rows) else [row]
            if out is not None:
                write_json({**header, "rows": [known.as_json() for known in rows]}, out / f"{suite.name}.json")
    finally:
        machine, sections, findings = header["machine"], suite.sections(rows), suite.findings(rows)
        print(f"{machine['cpu']}, GPU: {machine['gpu'] or 'none'}, {format_threads(machine['threads'])}")
        console = make_table_console(_WIDTH)
        for title, part in sections.items():
            console.print(rich_table(title, suite.columns, part))
        for line in findings:
            print(line)
        if out is not None and rows:
            print(out / f"{suite.name}.json")
            tables = [markdown_table(title, suite.columns, part) for title, part in sections.items()]
            text = "\n".join([*(f"* {sentence}" for sentence in findings), *([""] if findings else []), *tables])
            with replacing(out / f"{suite.name}.md") as partial:
                partial.write_text(f"<!-- {SOFTWARE} -->\n{text}", "utf-8")
            print(out / f"{suite.name}.md")
            if figure := suite.plot(rows, header):
                with replacing(out / f"{suite.name}.png") as partial:
                    figure.savefig(partial, dpi=110, metadata={"Software": "pansplat"})
                print(out / f"{suite.name}.png")
    return rows


def announce(text: object) -> None:
    """Show what is measured next."""
    print(text, file=sys.stderr, flush=True)


def format_threads(count: int) -> str:
    """A number of threads in words."""
    return "one thread" if count == 1 else f"{count} threads"


def make_axes(count: int, size: tuple[float, float], **options: Any) -> tuple[Figure, list[Axes]]:
    """A figure of this size in inches with plots side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = list(figure.subplots(1, count, squeeze=False, **options)[0])
    for each in axes:
        each.grid(alpha=0.25)
    return figure, axes


class Timing(NamedTuple):
    """Seconds of a call: elapsed, and of all threads of the process, which other processes affect far less."""

    wall: float
    cpu: float


def time_call(call: Callable[[], T], device: torch.device) -> tuple[Timing, T]:
    """Time a call, its work on the device included, and return its result."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    began, began_cpu = time.perf_counter(), time.process_time()
    result = call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return Timing(time.perf_counter() - began, time.process_time() - began_cpu), result


@torch.inference_mode()
def time_workload() -> float:
    """Seconds of a fixed workload on torch's threads, so that times of different machines compare: median of 51.

    It is a convolution (1.2 GFLOP) and the exponentials of 4 million numbers, on the CPU, after half a second of the
    same: the first calls wait for memory and sleeping threads.
    """
    maps = torch.linspace(-1, 1, 32 * 256 * 512).reshape(1, 32, 256, 512)
    weights = torch.linspace(-0.1, 0.1, 16 * 32 * 9).reshape(16, 32, 3, 3)
    values = torch.empty_like(maps)

    def work() -> None:
        torch.nn.functional.conv2d(maps, weights, padding=1)
        torch.exp(maps, out=values)

    cpu = torch.device("cpu")
    end = time.perf_counter() + 0.5
    while time.perf_counter() < end:
        work()
    return statistics.median(time_call(work, cpu)[0].wall for _ in range(51))


def measure_peak_memory(call: Callable[[], T], device: torch.device) -> tuple[dict[str, float], T]:
    """Largest additional memory during a call, `peak_mb` in 10^6 bytes, and the result of the call.

    On the CPU it is the kernel's high-water mark of the resident memory, reset before the call; on CUDA that of
    the allocator. It is missing if the system has no such mark (not Linux).
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        result = call()
        return {"peak_mb": (torch.cuda.max_memory_allocated(device) - before) / 1e6}, result
    if not _reset_resident_peak():
        return {}, call()
    before = _read_status_bytes("VmRSS")
    result = call()
    return {"peak_mb": max(0, _read_status_bytes("VmHWM") - before) / 1e6}, result


def _reset_resident_peak() -> bool:
    """Return freed memory to the system and restart the high-water mark; False if there is none (not Linux)."""
    if sys.platform == "win32":  # there, the libraries of the process have no common handle
        return False
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only
    if trim is not None:
        trim(0)
    try:
        _RESET.write_text("5", encoding="utf-8")
    except OSError:
        return False
    return True


def _read_status_bytes(field: str) -> int:
    found = re.search(rf"{field}:\s+(\d+) kB", _STATUS.read_text(encoding="utf-8"))
    return 1024 * int(found[1]) if found else 0


def quartile_range(times: Sequence[float]) -> float:
    """The range between the quartiles; the whole range of fewer than four times."""
    if len(times) < 4:
        return max(times) - min(times)
    low, _, high = statistics.quantiles(times, n=4, method="inclusive")
    return high - low


@contextlib.contextmanager
def restore_threads() -> Iterator[None]:
    """Restore torch's number of threads afterwards."""
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def compare_images(image: Tensor, reference: Tensor) -> dict[str, float]:
    """`max_error`, the largest absolute difference of the colours, and `psnr_db`, unclamped and for a peak of 1.

    Raises:
        ValueError: the shapes differ.
    """
    if image.shape != reference.shape:
        raise ValueError(f"`image` must have the reference's shape {tuple(reference.shape)}, got {tuple(image.shape)}")
    error = image.detach().double().cpu() - reference.double().cpu()
    mean_square = float(error.square().mean())
    psnr_db = -10 * math.log10(mean_square) if mean_square > 0 else math.inf
    return {"psnr_db": psnr_db, "max_error": float(error.abs().max())}


def describe_machine() -> dict[str, object]:
    """The processor with its widest vector extension, the GPU (or None), torch's number of threads, and versions."""
    facts: dict[str, str] = {}
    with contextlib.suppress(OSError):  # Linux only
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            facts.setdefault(name.strip(), value.strip())
    flags = facts.get("flags", facts.get("Features", "")).split()
    widest = next((f" ({flag})" for flag in ("avx512f", "avx2", "avx", "asimd") if flag in flags), "")
    return {
        "cpu": (facts.get("model name") or platform.processor() or platform.machine()) + widest,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
    }
