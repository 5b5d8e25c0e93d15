"""Checkpoints of a training run, written atomically and numbered by step.

A checkpoint holds tensors and plain values only. It is loaded without executing code; a file with code is refused.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from msgspec import Meta, Struct

from pansplat.errors import InputError
from pansplat.networks.weights import read_checkpoint
from pansplat.system.atomic import replacing
from pansplat.system.strict_json import convert

_KIND, _FORMAT = "pansplat-training", 1
_NAME = re.compile(r"step_(\d{8})\.pt")
_Tensors = dict[str, torch.Tensor]


class _Content(Struct):
    """The types of a checkpoint's values; `restore` names a key that is missing."""

    step: Annotated[int, Meta(ge=0, lt=10**9)] = 0
    config: str = ""
    network: _Tensors = {}
    auxiliary: _Tensors | None = None
    mean: _Tensors | None = None
    optimizer: dict[str, Any] = {}
    random: torch.Tensor | None = None


def save_checkpoint(folder: Path, step: int, state: Mapping[str, Any], *, keep: int) -> Path:
    """Write the checkpoint after `step` steps, then delete all but the newest `keep` checkpoints.

    The file is synced to disk before it is renamed, so that older checkpoints survive a kill or a power failure.
    """
    path = folder / f"step_{step:08d}.pt"
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path, failures=(RuntimeError,)) as partial, open(partial, "wb") as file:  # torch's if a disk is full
        torch.save({"kind": _KIND, "format": _FORMAT, "step": step, **state}, file)
        file.flush()
        os.fsync(file.fileno())
    for old in list_checkpoints(folder)[:-keep]:
        old.unlink(missing_ok=True)
    return path


def list_checkpoints(folder: Path) -> list[Path]:
    """Paths of the checkpoints in a folder, oldest first."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))


class DamagedCheckpointError(InputError):
    """A checkpoint lacks a key, or has a value that does not fit the run."""


def restore(state: Mapping[str, Any], key: str, apply: Callable[[Any], object]) -> None:
    """Apply the value of a key to the run; a DamagedCheckpointError if it is missing or does not fit."""
    try:
        apply(state[key])
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, IndexError, OverflowError) as error:
        cause = "it is missing" if isinstance(error, KeyError) and error.args == (key,) else str(error).splitlines()[0]
        raise DamagedCheckpointError(f"this checkpoint is damaged: key `{key}`: {cause}") from error


def load_latest(
    folder: Path, restore: Callable[[Path, dict[str, Any]], None] | None = None
) -> tuple[Path, dict[str, Any]] | None:
    """Path and content of the newest checkpoint; None if there are none. Deletes incomplete files.

    Args:
        restore: restores a run from a path and its content.

    Raises:
        InputError: the checkpoint is damaged, or `restore` raises it.
    """
    if folder.is_dir():
        for partial in folder.glob(".step_*.pt"):
            partial.unlink(missing_ok=True)
    found = list_checkpoints(folder)
    if not found:
        return None
    path, remedy = found[-1], f"delete it to {f'resume from {found[-2]}' if found[1:] else 'start again'}."
    try:
        content = load_checkpoint(path)
    except InputError as error:
        raise InputError(f"{str(error).rstrip('.')}; or {remedy}") from error
    try:
        if restore is not None:
            restore(path, content)
    except DamagedCheckpointError as error:
        raise InputError(f"{path}: {error}; {remedy}") from error
    return path, content


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Content of a training checkpoint; an InputError if it is damaged, of another kind or format, or has code."""
    content = read_checkpoint(path)
    if content.get("kind") != _KIND:
        raise InputError(f"{path}: needed a checkpoint of pansplat-train, got another file.")
    if not isinstance(content.get("format"), int) or content["format"] != _FORMAT:
        raise InputError(
            f"{path}: needed format {_FORMAT} of training checkpoints, got {content.get('format')!s:.20}; use the "
            "pansplat version that wrote it."
        )
    convert(content, _Content, f"{path}: this checkpoint is damaged")
    return content


def restore_optimizer(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore an optimiser; a ValueError if the state is not that of its parameters."""
    optimizer.load_state_dict(state)
    for parameter, values in optimizer.state.items():
        for name in ("exp_avg", "exp_avg_sq"):
            if values[name].shape != parameter.shape:
                raise ValueError(f"{name} has the shape {tuple(values[name].shape)}")
