"""Weights on disk: our safetensors files in and out, and PyTorch checkpoints in, without running what they hold.

A weights file is a .safetensors with four entries of metadata: `pansplat_format` (a number), `model` (which
network), `config` (the settings of its architecture, JSON) and `compat` (what it was trained with).
"""

from __future__ import annotations

import dataclasses
import json
import pickle
import re
import typing
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from pansplat.atomic import replacing
from pansplat.errors import InputError
from pansplat.model.layers import Compat

FORMAT = 1  # changes when names of tensors or the meaning of the metadata do

CompatChoice = Literal["trained", "official", "fixed"]
CHECKPOINTS = (".ckpt", ".pt", ".pth")
SUFFIXES = (".safetensors", *CHECKPOINTS)
COMPATS: dict[str, Compat] = {"official": "official", "fixed": "fixed"}

_T = TypeVar("_T")


@dataclass(frozen=True)
class WeightsFile:
    """What a weights file holds.

    Attributes:
        model: the network's name, such as "pansplat".
        config: settings of its architecture.
        compat: "official" where trained with the original's defects, "fixed" where without.
        tensors: weights under our names.
    """

    model: str
    config: dict[str, Any]
    compat: Compat
    tensors: dict[str, Tensor]


def save_weights(path: str | Path, weights: WeightsFile) -> None:
    """Write a weights file; it appears whole or not at all.

    Raises:
        InputError: when the path does not end in .safetensors, or cannot be written.
    """
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
    with replacing(path) as partial:
        safetensors.torch.save_file(tensors, partial, metadata)


def load_weights(path: str | Path) -> WeightsFile:
    """Read a weights file.

    Raises:
        InputError: when there is none, it is damaged, or it was not written by pansplat.
    """
    path = Path(path)
    _require_file(path)
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # not a dict
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: needed a whole .safetensors file, got '{error}'; {_guess(path)}") from error
    if not {"pansplat_format", "model", "config", "compat"} <= metadata.keys():
        raise InputError(
            f"{path}: needed weights that `pansplat convert` or `pansplat-train` wrote, got a .safetensors file "
            "without their metadata; convert the original checkpoint"
        )
    if metadata["pansplat_format"] != str(FORMAT):
        raise InputError(
            f"{path}: needed format {FORMAT} of weights files, got {metadata['pansplat_format']}; "
            "use the pansplat version that wrote it, or convert the original checkpoint again"
        )
    try:
        config, compat = json.loads(metadata["config"]), COMPATS[metadata["compat"]]
    except (ValueError, KeyError) as error:
        raise InputError(
            f"{path}: needed settings in its metadata, got {error}; convert the checkpoint again"
        ) from error
    return WeightsFile(metadata["model"], config, compat, tensors)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The contents of a PyTorch (Lightning) checkpoint: tensors and plain values; nothing in it is run.

    Raises:
        InputError: when the file is missing, damaged, no checkpoint, or asks for code to be run.
    """
    path = Path(path)
    _require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of old pickle protocols
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        wanted = re.search(r"(?:GLOBAL|global|class|function) ([\w.]+\.[\w.]+)", str(error))
        if wanted is None:
            raise InputError(f"{path}: needed a PyTorch checkpoint, got other contents; {_guess(path)}") from error
        raise InputError(
            f"{path}: needed a checkpoint of tensors and plain values, got one that asks to run {wanted[1]}; nothing "
            "was run. If you trust where it comes from, keep only its `state_dict`: "
            "torch.save({'state_dict': torch.load(PATH, weights_only=False)['state_dict']}, NEW_PATH)"
        ) from error
    except MemoryError:
        raise
    except Exception as error:  # whatever the readers of zip and pickle stumble over in damaged bytes
        raise InputError(f"{path}: needed a whole PyTorch checkpoint, got a damaged one; {_guess(path)}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: needed a checkpoint with a `state_dict`, got a {type(content).__name__}")
    return content


def state_dict_of(content: Mapping[str, Any], path: str | Path) -> dict[str, Tensor]:
    """The tensors by name of a Lightning checkpoint's contents.

    Raises:
        InputError: when there is no `state_dict`, or it holds anything but tensors.
    """
    state = content.get("state_dict")
    if not isinstance(state, Mapping):
        keys = ", ".join(str(key) for key in list(content)[:5])
        raise InputError(f"{path}: needed a checkpoint with a `state_dict`, got one with {keys or 'nothing'}")
    odd = [str(name) for name, value in state.items() if not isinstance(value, Tensor)]
    if odd:
        raise InputError(f"{path}: needed a `state_dict` of tensors, got others at {', '.join(odd[:3])}")
    return {str(name): value for name, value in state.items()}


def config_from_dict(kind: type[_T], values: Mapping[str, Any], where: str = "config") -> _T:
    """A (nested) frozen dataclass of what `dataclasses.asdict` and JSON made of it.

    Raises:
        InputError: when a field is unknown or missing.
    """
    if not (dataclasses.is_dataclass(kind) and isinstance(values, Mapping)):
        raise InputError(f"{where}: needed settings by name, got {values!r}")
    fields = {field.name for field in dataclasses.fields(kind)}
    if fields != values.keys():
        unknown, missing = sorted(values.keys() - fields), sorted(fields - values.keys())
        raise InputError(
            f"{where}: needed the settings of this version, got unknown {unknown} and lacked {missing}; use the "
            "pansplat version that wrote the file, or convert the original checkpoint again"
        )
    hints = typing.get_type_hints(kind)
    return kind(**{name: _restore(hints[name], value, f"{where}.{name}") for name, value in values.items()})


def _restore(hint: Any, value: Any, where: str) -> Any:
    """A value as its field's type has it: JSON knows no dataclasses and no tuples."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return config_from_dict(hint, value, where)
    if typing.get_origin(hint) is tuple and isinstance(value, list):
        inner = typing.get_args(hint)
        return tuple(_restore(inner[0], item, where) for item in value)
    if typing.get_origin(hint) is typing.Literal and value not in typing.get_args(hint):
        raise InputError(f"{where}: needed one of {typing.get_args(hint)}, got {value!r}")
    return value


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path}: needed a file of weights, got {'a folder' if path.exists() else 'nothing there'}")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: needed a file of weights, got an empty file; download or copy it again")


def _guess(path: Path) -> str:
    """What the first bytes tell of a file that is not what it should be."""
    with open(path, "rb") as file:
        start = file.read(64).lstrip().lower()
    if start.startswith((b"<!doctype", b"<html", b"<?xml", b"<head")):
        return "it is a web page: download the file itself, not the page about it"
    if start.startswith(b"version https://git-lfs"):
        return "it is a Git LFS pointer: run `git lfs pull`"
    return "download or copy it again"
