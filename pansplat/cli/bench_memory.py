"""`pansplat bench memory`: how much memory a step of training and a prediction take, at each height."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from pansplat.atomic import replacing
from pansplat.bench.machine import describe_machine
from pansplat.bench.memory import Measuring, MemoryRow, kept_rows, memory_cases, write_memory_rows
from pansplat.bench.memory_case import MemoryCase, MemorySetting
from pansplat.bench.memory_report import memory_markdown, memory_table, plot_memory
from pansplat.bench.model_weights import save_random_weights
from pansplat.cli.commands import BenchMemory
from pansplat.cli.printing import table_console
from pansplat.errors import InputError
from pansplat.training.network import network_config

_WIDTH = 150  # characters, where there is no terminal
_LEAST_HEIGHT, _MULTIPLE = 64, 32  # so that 4x4 tiles fit the four levels
_SHOWN = 14  # rows of the running table


def run_memory(command: BenchMemory) -> int:
    """Measure, print the table and write the files; an interruption keeps and reports what was measured."""
    setting = _setting(command)
    cases = memory_cases(_heights(command), quick=command.quick)
    with _folder(command.out) as folder:
        file = folder / "memory.json"
        rows = kept_rows(file, setting)
        machine = describe_machine(setting.threads)
        console = Console(stderr=True)
        bar = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), console=console
        )
        task = bar.add_task("", total=len(cases))
        try:
            with _weights(setting) as weights, Live(bar, console=console, transient=True) as live:

                def watch(doing: str, rows: list[MemoryRow]) -> None:
                    bar.update(task, completed=len(cases) - _missing(cases, rows), description=doing)
                    _show(live, bar, doing, rows)
                    if rows:
                        write_memory_rows(file, machine, setting, rows)

                references = folder / "references"
                references.mkdir(exist_ok=True)
                Measuring(setting, weights, references, watch).run(cases, rows)
            shutil.rmtree(references, ignore_errors=True)  # only a run that was stopped has a use for them
        finally:
            _report(rows, cases, folder, machine, setting, written=command.out is not None)
    return 0


def _setting(command: BenchMemory) -> MemorySetting:
    if command.threads is not None and command.threads < 1:
        raise InputError(f"--threads must be at least 1, got {command.threads}")
    if not 0 < command.limit_gb < math.inf:
        raise InputError(f"--limit-gb must be positive, got {command.limit_gb}")
    if command.device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda needs a CUDA device that torch can use, got none; use --device cpu.")
    cuda = command.device == "cuda" or (command.device == "auto" and torch.cuda.is_available())
    return MemorySetting(
        command.preset,
        command.style,
        command.perceptual,
        command.threads or torch.get_num_threads(),
        "cuda" if cuda else "cpu",
        command.limit_gb * 1e9 / 2**30,
    )


def _heights(command: BenchMemory) -> tuple[int, ...]:
    for height in command.heights:
        if height < _LEAST_HEIGHT or height % _MULTIPLE:
            raise InputError(
                f"--heights must be {_LEAST_HEIGHT} pixels or more and multiples of {_MULTIPLE}, got {height}"
            )
    return command.heights


@contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    """Where rows and what they are compared with go; nowhere that stays if none was asked for."""
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        yield out
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


@contextmanager
def _weights(setting: MemorySetting) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "random.safetensors")
        save_random_weights(path, network_config(setting.network))
        yield path


def _missing(cases: list[MemoryCase], rows: list[MemoryRow]) -> int:
    """How many of the cases have no row."""
    return len(set(cases) - {row.case for row in rows})


def _show(live: Live, bar: Progress, doing: str, rows: list[MemoryRow]) -> None:
    """The rows so far, and what is being done; one line a row where there is no terminal."""
    if live.console.is_terminal:
        live.update(Group(memory_table(rows[-_SHOWN:], "memory"), bar))
    elif doing:
        live.console.print(doing, highlight=False, soft_wrap=True)


def _report(
    rows: list[MemoryRow],
    cases: list[MemoryCase],
    folder: Path,
    machine: dict[str, object],
    setting: MemorySetting,
    *,
    written: bool,
) -> None:
    """Print the table, and write the picture and the page, of whatever was measured."""
    if not rows:
        return
    console = table_console(_WIDTH)
    where = machine["gpu"] if setting.device == "cuda" else machine["cpu"]
    title = f"{setting.network} network, batch 1, {setting.style} pictures, {setting.perceptual} loss; {where}"
    console.print(memory_table(rows, title))
    missing = _missing(cases, rows)
    if missing:
        print(f"{missing} of {len(cases)} rows are still to be measured")
    if written:
        plot_memory(rows, folder / "memory.png", title)
        with replacing(folder / "memory.md") as partial_file:
            partial_file.write_text(memory_markdown(rows))
        for file in (folder / name for name in ("memory.json", "memory.md", "memory.png")):
            if file.is_file():
                print(file)
