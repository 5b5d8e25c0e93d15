"""`pansplat bench model`: what the network takes on this machine, and what each choice costs in error."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import rich.console
import torch
from rich.console import Console
from rich.live import Live
from rich.text import Text

import pansplat
from pansplat.atomic import replacing
from pansplat.bench.machine import describe_machine
from pansplat.bench.model import ModelRow, measure_model, model_cases, write_model_rows
from pansplat.bench.model_report import model_markdown, model_table, plot_model
from pansplat.bench.model_weights import save_random_weights
from pansplat.cli.commands import BenchModel, PairChoice
from pansplat.cli.printing import table_console
from pansplat.cli.scenes import choose_pair, require_height
from pansplat.errors import InputError
from pansplat.model.network import has_bfloat16
from pansplat.model.weights import load_weights

if TYPE_CHECKING:
    from pansplat.data.views import Views

_SAMPLE = Path(pansplat.__file__).parents[1] / "assets" / "living_room"
_RANDOM = "PanSplat with random weights (seed 0): times and memory are true, pictures mean nothing"
_WIDTH = 190  # characters, where there is no terminal


def run_model(command: BenchModel) -> int:
    """Measure, print the table and write the files; an interruption keeps and reports what was measured."""
    files = _files(command)
    views = _views(command)
    threads = command.threads or torch.get_num_threads()
    bfloat16 = has_bfloat16()
    if not bfloat16:
        print("without bfloat16: this processor has no instructions for it")
    machine = describe_machine(threads)
    rows: list[ModelRow] = []
    console = Console(stderr=True)
    with _weights(command) as (weights, network), Live(console=console, transient=True) as live:
        try:
            watch = partial(_watch, live, files["json"], machine, network)
            cases = model_cases(threads, bfloat16=bfloat16, quick=command.quick)
            measure_model(cases, views, weights, watch=watch, rows=rows)
        finally:
            live.stop()
            _report(rows, files, machine, network)
    return 0


def _views(command: BenchModel) -> Views:
    """The pair's panoramas; by default the sample's."""
    if command.threads is not None and command.threads < 1:
        raise InputError(f"--threads must be at least 1, got {command.threads}")
    require_height(command.height)
    if command.height % 64:
        raise InputError(f"--height must be a multiple of 64 pixels, so that 4x4 tiles fit, got {command.height}")
    folder = command.pair or _SAMPLE
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give one with --pair (the sample is in the repository only)")
    return choose_pair(folder, PairChoice()).load_context(command.height)


@contextmanager
def _weights(command: BenchModel) -> Iterator[tuple[Path, str]]:
    """A file of weights, and what to call them."""
    if command.model is not None:
        found = load_weights(command.model)
        if found.model != "pansplat":
            raise InputError(f"{command.model}: the bench measures PanSplat, these are weights of {found.model}")
        yield command.model, f"PanSplat with the weights of {command.model.name}"
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "random.safetensors")
        save_random_weights(path)
        yield path, _RANDOM


def _files(command: BenchModel) -> dict[str, Path | None]:
    """Where rows, table and picture go; refused before the work when a folder is missing."""
    files: dict[str, Path | None] = {"json": command.json, "plot": None, "page": None}
    if command.out is not None:
        command.out.mkdir(parents=True, exist_ok=True)
        files = {
            "json": command.json or command.out / "model.json",
            "plot": command.out / "model.png",
            "page": command.out / "model.md",
        }
    if files["json"] is not None and not files["json"].resolve().parent.is_dir():
        raise InputError(f"cannot write {files['json']}: its folder does not exist; create it first")
    return files


def _watch(
    live: Live, file: Path | None, machine: dict[str, object], network: str, doing: str, rows: list[ModelRow]
) -> None:
    """Show the rows so far and keep them."""
    if live.console.is_terminal:
        live.update(rich.console.Group(model_table(rows, network), Text(doing, style="cyan")))
    if file is not None and rows:
        write_model_rows(file, machine, network, rows)


def _report(rows: list[ModelRow], files: dict[str, Path | None], machine: dict[str, object], network: str) -> None:
    """Print the table, and write the picture and the page, of whatever was measured."""
    if not rows:
        return
    console = table_console(_WIDTH)
    for name in ("cpu", "threads", "fma_gflops"):
        print(f"{name:<12} {machine[name]}")
    height = rows[0].height
    title = f"{network}, {height}x{2 * height}, {rows[0].num_gaussians or 0:,} Gaussians"
    console.print(model_table(rows, title))
    if files["plot"] is not None:
        plot_model(rows, files["plot"], f"{height}x{2 * height}, {machine['cpu']}")
    if files["page"] is not None:
        with replacing(files["page"]) as partial_file:
            partial_file.write_text(model_markdown(rows))
    for file in files.values():
        if file is not None:
            print(file)
