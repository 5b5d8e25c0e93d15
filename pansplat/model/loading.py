"""From a file of weights to a predictor: our .safetensors, or an original checkpoint converted on the way."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.model.checkpoint import (
    CHECKPOINTS,
    CompatChoice,
    WeightsFile,
    config_from_dict,
    load_weights,
    read_checkpoint,
)
from pansplat.model.layers import AttentionPrecision, Compat, Precision
from pansplat.model.mvsplat import MVSplat, MVSplatConfig
from pansplat.model.network import NetworkPredictor
from pansplat.model.official_names import Model
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.model.weights import convert, match, require_shapes

_NETWORKS: dict[str, tuple[type[PanSplat] | type[MVSplat], type]] = {
    "pansplat": (PanSplat, PanSplatConfig),
    "mvsplat": (MVSplat, MVSplatConfig),
}


def load_predictor(
    path: str | Path,
    compat: CompatChoice = "trained",
    *,
    precision: Precision = "float32",
    attention_precision: AttentionPrecision = "float32",
) -> NetworkPredictor:
    """The predictor whose weights a file holds.

    Args:
        path: a .safetensors of `pansplat convert` or of training, or an original Lightning checkpoint.
        compat: "official" computes what the original does, "fixed" corrects its defects, "trained" is the one that
            the weights were trained with: for original checkpoints "official".
        precision: number type of PanSplat's convolutions; see docs/bench_model.md for what bfloat16 costs and gains.
        attention_precision: what attention rounds its inputs to; the original's was bfloat16.

    Raises:
        InputError: when the file cannot be used, or the processor has no instructions for bfloat16.
    """
    path = Path(path)
    require_precision(precision)
    weights = from_original(read_checkpoint(path), path) if path.suffix.lower() in CHECKPOINTS else load_weights(path)
    network = build_network(
        weights,
        weights.compat if compat == "trained" else compat,
        path,
        precision=precision,
        attention_precision=attention_precision,
    )
    return NetworkPredictor(weights.model, network)


def from_original(content: Mapping[str, object], source: object) -> WeightsFile:
    """An original checkpoint's contents as a weights file.

    Raises:
        InputError: when it is not of an original, unmodified model.
    """
    tensors = convert(content, source)
    model = match(content, source).model
    weights = describe(model, _NETWORKS[model][1](), tensors, compat="official")
    require_shapes(tensors, build_empty(weights, "official", source).state_dict(), source)
    return weights


def describe(model: Model, config: object, tensors: dict[str, Tensor], *, compat: Compat) -> WeightsFile:
    """Weights with what is needed to use them; `config` is the network's dataclass."""
    assert dataclasses.is_dataclass(config) and not isinstance(config, type)
    settings = json.loads(json.dumps(dataclasses.asdict(config)))  # lists for tuples, as a file gives them back
    return WeightsFile(model, settings, compat, tensors)


def require_precision(precision: str) -> None:
    """Refuse number types that this processor can only imitate, slowly.

    Raises:
        InputError: no such precision, or no instructions for it.
    """
    if precision not in get_args(Precision):
        raise InputError(f"`precision` must be {' or '.join(get_args(Precision))}, got {precision!r}")
    if precision == "bfloat16" and not has_bfloat16():
        raise InputError(
            "`precision` bfloat16 needs a processor with bfloat16 instructions (AVX512_BF16, AMX), this one has none "
            "and would be slower than with float32; use float32"
        )


def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 numbers by itself."""
    tell = getattr(torch.cpu, "get_capabilities", None)
    if tell is None:  # an older torch does not tell
        return True
    facts = tell()
    return any(facts.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def build_network(weights: WeightsFile, compat: Compat, source: object, **choices: Any) -> PanSplat | MVSplat:
    """The network with its weights, in eval mode.

    Args:
        choices: the precisions, as `load_predictor` takes them.

    Raises:
        InputError: when the file's settings or tensors fit no network.
    """
    network = build_empty(weights, compat, source, **choices)
    require_shapes(weights.tensors, network.state_dict(), source)
    network.load_state_dict(weights.tensors, strict=True, assign=True)
    return network.eval()


def build_empty(
    weights: WeightsFile,
    compat: Compat,
    source: object,
    *,
    precision: Precision = "float32",
    attention_precision: AttentionPrecision = "float32",
) -> PanSplat | MVSplat:
    """The network without memory for its weights; random numbers are not drawn.

    Raises:
        InputError: when the file's settings fit no network.
    """
    if weights.model not in _NETWORKS:
        raise InputError(f"{source}: needed weights of {' or '.join(_NETWORKS)}, got of {weights.model!r}")
    kind, config_kind = _NETWORKS[weights.model]
    try:
        config = config_from_dict(config_kind, weights.config, f"{source}: config")
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(f"{source}: needed settings of a {weights.model} network, got '{error}'") from error
    with torch.device("meta"):
        if kind is PanSplat:
            return PanSplat(config, compat, precision=precision, attention_precision=attention_precision)
        if precision != "float32":
            raise InputError(f"{source}: a {weights.model} network runs in float32 only, got precision {precision!r}")
        return MVSplat(config, compat, attention_precision=attention_precision)
