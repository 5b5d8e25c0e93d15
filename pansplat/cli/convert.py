"""`pansplat convert`: an official checkpoint to a file of weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from pansplat.cli.inputs import Out, Writer
from pansplat.system.console import make_table_console
from pansplat.system.files import require_output_file

if TYPE_CHECKING:
    from rich.table import Table

    from pansplat.model.weights import ConversionReport

_MAX_NAMES = 2  # in a row of the report


@dataclass(frozen=True)
class Convert(Writer):
    """Convert a checkpoint of the official PanSplat to a file of weights.

    No code in the checkpoint is executed. Use the weights with --model.
    """

    path: Positional[Path]
    """The official Lightning checkpoint (.ckpt)."""
    out: Out
    """The .safetensors file to write."""

    def run(self) -> int:
        """Print the report of all tensors, then convert and save; the report also explains a refusal."""
        from pansplat.model.network import convert_checkpoint
        from pansplat.model.weights import match_tensors, read_checkpoint, save_weights

        require_output_file("--out", self.out, (".safetensors",), overwrite=self.overwrite)
        content = read_checkpoint(self.path)
        make_table_console().print(_make_report_table(match_tensors(content, self.path)))
        weights = convert_checkpoint(content, self.path)
        save_weights(self.out, weights)
        numbers = sum(tensor.numel() for tensor in weights.tensors.values())
        print(
            f"{self.out}: {len(weights.tensors)} tensors, {numbers:,} numbers; --model {self.out} computes what the "
            "official code does (--compat official); --compat fixed corrects its defects"
        )
        return 0


def _make_report_table(report: ConversionReport) -> Table:
    """Rows of used, unused (by reason), unknown and missing tensors."""
    from rich.table import Table

    table = Table(title="Tensors of the checkpoint")
    table.add_column("")
    table.add_column("count", justify="right")
    table.add_column("such as", overflow="fold")
    table.add_row("used", str(len(report.used)), _join_first_names(list(report.used)))
    for reason, names in report.unused.items():
        table.add_row(f"left out: {reason}", str(len(names)), _join_first_names(names))
    for word, names in (("unknown", report.unexpected), ("missing", report.missing)):
        table.add_row(word, str(len(names)), _join_first_names(names), style="bold red" if names else "")
    return table


def _join_first_names(names: list[str]) -> str:
    return ", ".join(names[:_MAX_NAMES]) + (", ..." if len(names) > _MAX_NAMES else "")
