"""Weights on disk: safetensors files of pansplat, and PyTorch checkpoints.

A weights file is a .safetensors file with four metadata entries: `pansplat_format` (a number), `model` (the network's
name), `config` (its architecture, JSON) and `compat` (the mode of its training). Checkpoints are read without executing
code in them.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.networks.layers import Compat
from pansplat.system.atomic import replacing
from pansplat.system.files import require_file
from pansplat.system.strict_json import convert, parse_json

FORMAT = 1  # increased when tensor names or the meaning of the metadata change

CHECKPOINT_SUFFIXES = (".ckpt", ".pt", ".pth")
WEIGHTS_SUFFIXES = (".safetensors", *CHECKPOINT_SUFFIXES)
COMPATS: dict[str, Compat] = {"official": "official", "fixed": "fixed"}

ModelName = Literal["pansplat", "depth", "depth_sharpening"]

_T = TypeVar("_T")
_MAX_NAMES = 4  # names that an error message lists


@dataclass(frozen=True)
class WeightsFile:
    """Content of a weights file.

    Attributes:
        model: name of the network, such as "pansplat".
        config: settings of its architecture.
        compat: mode of its training.
        tensors: weights by name.
    """

    model: str
    config: dict[str, Any]
    compat: Compat
    tensors: dict[str, Tensor]


def pack_weights(model: ModelName, config: object, tensors: dict[str, Tensor], *, compat: Compat) -> WeightsFile:
    """Pack a network's tensors with its settings; `config` is a dataclass."""
    assert dataclasses.is_dataclass(config) and not isinstance(config, type)
    settings = json.loads(json.dumps(dataclasses.asdict(config)))  # lists instead of tuples, as read from a file
    return WeightsFile(model, settings, compat, tensors)


def save_weights(path: str | Path, weights: WeightsFile) -> None:
    """Write a .safetensors file atomically; an InputError for another suffix, or if it cannot be written."""
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        raise InputError(f"{path}: a weights file must end in .safetensors, got {path.suffix or 'no suffix'!r}")
    metadata = {
        "pansplat_format": str(FORMAT),
        "model": weights.model,
        "config": json.dumps(weights.config),
        "compat": weights.compat,
    }
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.tensors.items()}
    with replacing(path) as partial:  # `save_file` makes files that nobody else may read
        partial.write_bytes(safetensors.torch.save(tensors, metadata))


def load_weights(path: str | Path) -> WeightsFile:
    """Read a weights file; an InputError if it is missing, damaged, or was not written by pansplat."""
    path = Path(path)
    _require_file(path)
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            # Copies: the tensors are maps of the file, which Windows could not replace and a writer would change.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118  # not a dict
    except (safetensors.SafetensorError, OSError, ValueError, AttributeError) as error:  # torch lacks some types
        raise InputError(f"{path}: needed a whole .safetensors file, got '{error}'; {_suggest_remedy(path)}") from error
    if not {"pansplat_format", "model", "config", "compat"} <= metadata.keys():
        raise InputError(
            f"{path}: needed weights that `pansplat convert` or `pansplat-train` wrote, got a .safetensors file "
            "without their metadata; convert the official checkpoint"
        )
    if metadata["pansplat_format"] != str(FORMAT):
        raise InputError(
            f"{path}: needed format {FORMAT} of weights files, got {metadata['pansplat_format']}; "
            "use the pansplat version that wrote it, or convert the official checkpoint again"
        )
    if metadata["compat"] not in COMPATS:
        needed = " or ".join(COMPATS)
        raise InputError(f"{path}: needed compat {needed} in its metadata, got {metadata['compat']!r:.60}")
    config = convert(parse_json(metadata["config"], f"{path}: config"), dict[str, Any], f"{path}: config")
    return WeightsFile(metadata["model"], config, COMPATS[metadata["compat"]], as_float32(tensors, path))


def as_float32(tensors: Mapping[str, Tensor], source: object) -> dict[str, Tensor]:
    """The tensors with floating-point numbers in float32; an InputError if a number is not finite."""
    converted = {}
    for name, tensor in tensors.items():
        converted[name] = tensor.float() if tensor.is_floating_point() else tensor
        if tensor.is_floating_point() and not torch.isfinite(converted[name]).all():
            raise InputError(f"{source}: needed finite numbers, got NaN or infinity in {name}; use another file")
    return converted


def read_model_name(path: Path) -> str | None:
    """Name of the network in the metadata of a weights file; None if it has none."""
    if not path.is_file():
        return None
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get("model")
    except (safetensors.SafetensorError, OSError, ValueError):
        return None


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read the tensors and plain values of a PyTorch (Lightning) checkpoint, without executing code in it.

    Raises:
        InputError: the file contains code, or is damaged.
    """
    path = Path(path)
    _require_file(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        code = re.search(r"(?:GLOBAL|global|class|function) ([\w.]+\.[\w.]+)", str(error))
        if code is None:
            raise InputError(
                f"{path}: needed a PyTorch checkpoint, got other contents; {_suggest_remedy(path)}"
            ) from error
        raise InputError(
            f"{path}: needed a checkpoint of tensors and plain values, got one that calls {code[1]}; the call was not "
            "executed. If you trust the source of the file, keep only its `state_dict`: "
            "torch.save({'state_dict': torch.load(PATH, weights_only=False)['state_dict']}, NEW_PATH)"
        ) from error
    except MemoryError:
        raise
    except Exception as error:  # damaged bytes raise many kinds of error in the zip and pickle readers
        raise InputError(
            f"{path}: needed a whole PyTorch checkpoint, got a damaged one; {_suggest_remedy(path)}"
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: needed a checkpoint with a `state_dict`, got a {type(content).__name__}")
    return content


def get_state_dict(content: Mapping[str, Any], path: str | Path) -> dict[str, Tensor]:
    """The tensors of a Lightning checkpoint; an InputError without a `state_dict` of tensors only."""
    state = content.get("state_dict")
    if not isinstance(state, Mapping):
        keys = ", ".join(str(key) for key in list(content)[:5])
        raise InputError(f"{path}: needed a checkpoint with a `state_dict`, got one with {keys or 'nothing'}")
    odd = [str(name) for name, value in state.items() if not isinstance(value, Tensor)]
    if odd:
        raise InputError(f"{path}: needed a `state_dict` of tensors, got other values at {', '.join(odd[:3])}")
    return {str(name): value for name, value in state.items()}


def config_from_dict(kind: type[_T], values: Mapping[str, Any], where: str = "config") -> _T:
    """A nested dataclass from the JSON of its `asdict`; an InputError for any other field, type or range."""
    config = convert(values, kind, where)
    known, given = _list_leaves(msgspec.to_builtins(config), where), _list_leaves(values, where)
    if known != given:
        unknown, missing = sorted(given - known), sorted(known - given)
        raise InputError(
            f"{where}: needed the settings of this version, got unknown {unknown} and lacked {missing}; use the "
            "pansplat version that wrote the file, or convert the official checkpoint again"
        )
    return config


def _list_leaves(value: Any, name: str) -> set[str]:
    """The names of the numbers and texts in nested settings."""
    if not isinstance(value, (dict, list, tuple)):
        return {name}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return {leaf for key, item in items for leaf in _list_leaves(item, f"{name}.{key}")}


def build_on_meta(build: Callable[[], _T], model: str, source: object) -> _T:
    """Build a network without memory and random numbers; an InputError if its settings fit no network."""
    try:
        with torch.device("meta"):
            return build()
    except InputError:
        raise
    except Exception as error:
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{source}: needed settings of a {model} network, got '{cause}'; use another file") from error


def _require_file(path: Path) -> None:
    if not os.path.lexists(path):
        raise InputError(f"{path}: needed a file of weights, got no file")
    require_file(path, "a file of weights")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: needed a file of weights, got an empty file; download or copy it again")


def _suggest_remedy(path: Path) -> str:
    """Suggest what to do about an unreadable file, from its first bytes."""
    with open(path, "rb") as file:
        start = file.read(64).lstrip().lower()
    if start.startswith((b"<!doctype", b"<html", b"<?xml", b"<head")):
        return "it is a web page: download the file itself, not the page about it"
    if start.startswith(b"version https://git-lfs"):
        return "it is a Git LFS pointer: run `git lfs pull`"
    return "download or copy it again"


def require_shapes(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], source: object) -> None:
    """Raise an InputError that counts and names the tensors without the names and shapes of a network's tensors."""
    missing = [name for name in expected if name not in tensors]
    unexpected = [name for name in tensors if name not in expected]
    wrong = [
        f"{name} {tuple(tensors[name].shape)} instead of {tuple(tensor.shape)}"
        for name, tensor in expected.items()
        if name in tensors and tensors[name].shape != tensor.shape
    ]
    wrong += [
        f"{name} of {str(tensors[name].dtype).removeprefix('torch.')}"
        for name, tensor in expected.items()
        if name in tensors and tensors[name].is_floating_point() != tensor.is_floating_point()
    ]
    problems = [
        f"{problem} {join_names(names)}"
        for problem, names in (("lacked", missing), ("found unknown", unexpected), ("got", wrong))
        if names
    ]
    if problems:
        raise InputError(f"{source}: its tensors do not fit the network: {'; '.join(problems)}; use another file")


def join_names(names: Sequence[str]) -> str:
    """The number of the names, and the first of them."""
    return f"{len(names)} ({', '.join(names[:_MAX_NAMES])}{', ...' if len(names) > _MAX_NAMES else ''})"
