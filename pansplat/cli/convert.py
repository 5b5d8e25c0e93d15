"""`pansplat convert`: an original checkpoint to a file of weights."""

from __future__ import annotations

from rich.table import Table

from pansplat.cli.commands import Convert
from pansplat.cli.printing import table_console
from pansplat.errors import InputError
from pansplat.model.network import convert_checkpoint
from pansplat.model.weights import ConversionReport, match_tensors, read_checkpoint, save_weights

_SHOWN = 2  # names a line of the report


def run_convert(command: Convert) -> int:
    """Tell what becomes of every tensor, then convert and save; the table also shows why a checkpoint is refused."""
    if command.out.suffix.lower() != ".safetensors" or not command.out.resolve().parent.is_dir():
        raise InputError(f"--out must be a .safetensors file in an existing folder, got {command.out}")
    content = read_checkpoint(command.path)
    report = match_tensors(content, command.path)
    table_console().print(_table(report))
    weights = convert_checkpoint(content, command.path)
    save_weights(command.out, weights)
    numbers = sum(tensor.numel() for tensor in weights.tensors.values())
    print(
        f"{command.out}: {len(weights.tensors)} tensors, {numbers:,} numbers; --model {command.out} computes what the "
        "original does (--compat official), unless told --compat fixed"
    )
    return 0


def _table(report: ConversionReport) -> Table:
    """A line each for what is used, left out (by reason), unknown and missing."""
    table = Table(title=f"{report.model}: what the checkpoint holds")
    table.add_column("")
    table.add_column("count", justify="right")
    table.add_column("such as", overflow="fold")
    table.add_row("used", str(len(report.used)), _first(list(report.used)))
    for reason, names in report.unused.items():
        table.add_row(f"left out: {reason}", str(len(names)), _first(names))
    for word, names in (("unknown", report.surplus), ("missing", report.missing)):
        table.add_row(word, str(len(names)), _first(names), style="bold red" if names else "")
    return table


def _first(names: list[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
