"""Predictors by their names and files of weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from pansplat.errors import InputError
from pansplat.networks.weights import WEIGHTS_SUFFIXES, read_model_name
from pansplat.prediction_options import CompatChoice, Precision, PredictOptions
from pansplat.predictor import Predictor
from pansplat.sweep import Sweep
from pansplat.sweep.guided_sweep import default_weights, load_default_sweep, load_guided_sweep
from pansplat.system.devices import with_device
from pansplat.system.files import expand_home

_MODELS: dict[str, Callable[..., Predictor]] = {"default": load_default_sweep, "sweep": Sweep}


@with_device
def load_model(
    name: str | Path = "default",
    *,
    compat: CompatChoice = "trained",
    precision: Precision = "float32",
    depth_network: str | Path | None = None,
    **options: Any,
) -> Predictor:
    """Load a predictor.

    Args:
        name: "default", the trained model of the package; "sweep", without weights; or a file of weights: a
            .safetensors file from `pansplat convert` or from training, or an official checkpoint (.ckpt).
        compat: for networks: "official" reproduces the official code with its defects; "fixed" corrects them;
            "trained" is the mode of the training, which is "official" for official weights.
        precision: for networks: number type of the convolutions; docs/bench_model.md shows time against error.
        depth_network: for "default" and files of depth networks: an ONNX file of relative depth, whose edges the
            surfaces have (docs/depth_network.md).
        **options: of "sweep", the arguments of `pansplat.sweep.Sweep`; of the weights of a network, those of
            `pansplat.model.network.load_network_predictor`; others have none.
        device: see `predict`.
    """
    if compat not in get_args(CompatChoice):
        raise InputError(f"`compat` must be one of {', '.join(get_args(CompatChoice))}, got {compat!r}")
    path = None if str(name) in _MODELS else expand_home(name)
    if path is not None and path.suffix.lower() not in WEIGHTS_SUFFIXES:
        raise InputError(
            f"`model` must be one of {', '.join(sorted(_MODELS))}, or a file of weights "
            f"({', '.join(WEIGHTS_SUFFIXES)}), got {str(name)!r}"
        )
    is_guided = str(name) == "default" if path is None else read_model_name(path) == "depth"
    if depth_network is not None and not is_guided:
        raise InputError(f"`depth_network` is for the model default, got the model {name}; leave one of them out")
    if path is not None and not is_guided:
        from pansplat.model.network import load_network_predictor

        return load_network_predictor(path, compat, precision=precision, **options)
    refused = {"compat": compat != "trained", "precision": precision != "float32"}
    refused |= dict.fromkeys(options, str(name) != "sweep")
    for option, is_refused in refused.items():
        if is_refused:
            raise InputError(f"`{option}` is for networks, and {name} is not one; leave it out")
    if path is None and depth_network is None:
        return _MODELS[str(name)](**options)
    return load_guided_sweep(path or default_weights(), path.stem if path else "default", depth_network)


def load_predictor(options: PredictOptions) -> Predictor:
    """The predictor of options; an InputError if there is none of that name or file, or it lacks the options."""
    return load_model(
        options.model, compat=options.compat, precision=options.precision, depth_network=options.depth_network
    )


def find_min_views(predictor: Predictor) -> int:
    """The number of views, at least, that a predictor needs."""
    return getattr(predictor, "min_views", 1)


def can_stream(predictor: Predictor) -> bool:
    """Whether the predictor computes a scene tile by tile."""
    return hasattr(predictor, "stream")
