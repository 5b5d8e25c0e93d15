"""`pansplat convert`: an official checkpoint to a file of weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from pansplat.cli.inputs import Out, Writer
from pansplat.system.files import require_output_file


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
        """Convert and save, and print what is left out."""
        from pansplat.model.network import convert_checkpoint
        from pansplat.model.official_weights import match_tensors
        from pansplat.networks.weights import read_checkpoint, save_weights

        require_output_file("--out", self.out, (".safetensors",), overwrite=self.overwrite)
        content = read_checkpoint(self.path)
        unused, weights = match_tensors(content, self.path), convert_checkpoint(content, self.path)
        save_weights(self.out, weights)
        for reason, names in unused.items():
            print(f"left out: {len(names)} {reason} ({names[0]}{', ...' if len(names) > 1 else ''})")
        numbers = sum(tensor.numel() for tensor in weights.tensors.values())
        print(
            f"{self.out}: {len(weights.tensors)} tensors, {numbers:,} numbers; --model {self.out} computes what the "
            "official code does (--compat official); --compat fixed corrects its defects"
        )
        return 0
