"""Checkpoints of a training run, written atomically and numbered by step.

A checkpoint holds tensors and plain values only. It is loaded without executing code; a file with code is refused.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from pansplat.atomic import replacing
from pansplat.errors import InputError
from pansplat.model.weights import COMPATS, UnsafeCheckpointError, WeightsFile, read_checkpoint

_KIND, _FORMAT = "pansplat-training", 1
_NAME = re.compile(r"step_(\d{8})\.pt")


def save_checkpoint(folder: Path, step: int, state: Mapping[str, Any], *, keep: int) -> Path:
    """Write the checkpoint after `step` steps, then delete all but the newest `keep` checkpoints.

    The file is synced to disk before it is renamed, so that older checkpoints survive a kill or a power failure.

    Raises:
        InputError: the disk is full or not writable; older checkpoints are kept.
    """
    path = folder / f"step_{step:08d}.pt"
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        try:
            with open(partial, "wb") as file:
                torch.save({"kind": _KIND, "format": _FORMAT, "step": step, **state}, file)
                file.flush()
                os.fsync(file.fileno())
        except RuntimeError as error:  # raised by torch when the disk is full
            raise OSError(0, str(error).splitlines()[0]) from error
    for old in list_checkpoints(folder)[:-keep]:
        old.unlink(missing_ok=True)
    return path


def list_checkpoints(folder: Path) -> list[Path]:
    """Paths of the checkpoints in a folder, oldest first."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))


def load_latest(folder: Path) -> tuple[Path, dict[str, Any]] | None:
    """Path and content of the newest readable checkpoint; None if there are no checkpoints.

    Deletes incomplete files. Skips damaged checkpoints with a warning.

    Raises:
        UnsafeCheckpointError: a checkpoint contains code.
        InputError: no checkpoint is readable.
    """
    if folder.is_dir():
        for partial in folder.glob(".step_*.pt"):
            partial.unlink(missing_ok=True)
    found = list_checkpoints(folder)
    failures = []
    for path in reversed(found):
        try:
            return path, load_checkpoint(path)
        except UnsafeCheckpointError:
            raise
        except InputError as error:
            failures.append(str(error))
            warnings.warn(f"skipped a checkpoint: {error}", stacklevel=2)
    if failures:
        raise InputError(f"{folder}: needed a readable checkpoint, got none:\n  " + "\n  ".join(failures))
    return None


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Content of a training checkpoint.

    Raises:
        InputError: damaged, not a training checkpoint, of another format, or containing code.
    """
    content = read_checkpoint(path)
    if not is_training_state(content):
        raise InputError(f"{path}: needed a checkpoint of pansplat-train, got another file; give it as --network.init.")
    if content.get("format") != _FORMAT:
        raise InputError(
            f"{path}: needed format {_FORMAT} of training checkpoints, got {content.get('format')}; use the pansplat "
            "version that wrote it."
        )
    return content


def is_training_state(content: Mapping[str, Any]) -> bool:
    """Whether the content of a file is that of a training checkpoint."""
    return content.get("kind") == _KIND


def extract_weights(content: Mapping[str, Any], path: Path) -> WeightsFile:
    """The weights of a training checkpoint: their moving average, if there is one.

    Raises:
        InputError: weights are missing or invalid.
    """
    try:
        header = json.loads(content["weights"])
        tensors = content["mean"] if content.get("mean") else content["network"]
        return WeightsFile(header["model"], header["config"], COMPATS[header["compat"]], dict(tensors))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: needed weights in the checkpoint, got {error!r}; use another file.") from error
