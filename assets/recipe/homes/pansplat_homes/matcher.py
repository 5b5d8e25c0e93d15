"""The published weights of ALIKED and LightGlue as `matcher.safetensors` (assets/matcher/MODEL.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tyro.conf import Positional

from pansplat.networks.weights import WeightsFile, save_weights
from pansplat.poses.learned import default_weights


def convert_aliked(old: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights of `Aliked`: batch normalisation becomes part of the convolutions."""
    new = {}
    for level in range(4):
        for number, name in ((1, "first"), (2, "second")):
            source, target = f"block{level + 1}", f"blocks.{level}.{name}"
            norm = {key: old[f"{source}.bn{number}.{key}"] for key in ("weight", "bias", "running_mean", "running_var")}
            scale = norm["weight"] / (norm["running_var"] + 1e-5).sqrt()
            deformed = level >= 2
            kernel = old[f"{source}.conv{number}{'.regular_conv' if deformed else ''}.weight"]
            inner = target + (".conv" if deformed else "")
            new[f"{inner}.weight"] = kernel * scale[:, None, None, None]
            new[f"{inner}.bias"] = norm["bias"] - norm["running_mean"] * scale
            for part in ("weight", "bias") if deformed else ():
                new[f"{target}.offset.{part}"] = old[f"{source}.conv{number}.offset_conv.{part}"]
        for part in ("weight", "bias") if level else ():
            new[f"blocks.{level}.shortcut.{part}"] = old[f"block{level + 1}.downsample.{part}"]
        new[f"reduce.{level}.weight"] = old[f"conv{level + 1}.weight"]
        new[f"score.{level}.weight"] = old[f"score_head.{2 * level}.weight"]
    for part in ("weight", "bias"):
        new[f"offset.0.{part}"] = old[f"desc_head.offset_conv.0.{part}"]
        new[f"offset.1.{part}"] = old[f"desc_head.offset_conv.2.{part}"].flatten(1 if part == "weight" else 0)
    new["mix.weight"] = old["desc_head.sf_conv.weight"].flatten(1)
    new["aggregate"] = old["desc_head.agg_weights"]
    return new


def convert_lightglue(old: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights of `LightGlue`: queries, keys and values in blocks; real parts of queries and keys before imaginary."""
    new = {"position.weight": old["posenc.Wr.weight"]}
    halves = torch.cat((torch.arange(0, 64, 2), torch.arange(1, 64, 2)))
    for part in ("weight", "bias"):
        new[f"entry.{part}"] = old[f"input_proj.{part}"]
        for layer in range(9):
            source, target = f"transformers.{layer}", f"layers.{layer}"
            mixed = old[f"{source}.self_attn.Wqkv.{part}"].unflatten(0, (4, 64, 3))
            query, key, value = mixed[:, halves, 0], mixed[:, halves, 1], mixed[:, :, 2]
            new[f"{target}.self_in.{part}"] = torch.stack((query, key, value)).flatten(0, 2)
            cross = [old[f"{source}.cross_attn.{name}.{part}"] for name in ("to_qk", "to_v")]
            new[f"{target}.cross_in.{part}"] = torch.cat(cross)
            for kind, output in (("self", "out_proj"), ("cross", "to_out")):
                names = {output: "message", "ffn.0": "inner", "ffn.1": "norm", "ffn.3": "outer"}
                for name, ours in names.items():
                    new[f"{target}.{kind}_update.{ours}.{part}"] = old[f"{source}.{kind}_attn.{name}.{part}"]
            new[f"matchable.{layer}.{part}"] = old[f"log_assignment.{layer}.matchability.{part}"]
            new[f"similar.{layer}.{part}"] = old[f"log_assignment.{layer}.final_proj.{part}"]
            if layer < 8:
                new[f"confidence.{layer}.{part}"] = old[f"token_confidence.{layer}.token.0.{part}"]
    return new


@dataclass(frozen=True)
class ConvertMatcher:
    """Convert the published weights of ALIKED and LightGlue to the `matcher.safetensors` of the installed pansplat."""

    aliked: Positional[Path]
    """aliked-n16.pth"""
    lightglue: Positional[Path]
    """aliked_lightglue.pth"""

    def run(self) -> int:
        """Write the weights file: kernels in float16, the rest in float32."""
        tensors = {}
        files = (("aliked", self.aliked, convert_aliked), ("lightglue", self.lightglue, convert_lightglue))
        for name, file, convert in files:
            converted = convert(torch.load(file, "cpu", weights_only=True))
            tensors |= {f"{name}.{key}": tensor for key, tensor in converted.items()}
        half = {name: tensor.half() if tensor.ndim > 1 else tensor for name, tensor in tensors.items()}
        save_weights(default_weights(), WeightsFile("matcher", {}, "fixed", half))
        return 0
