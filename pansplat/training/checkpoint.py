"""A run on disk: numbered checkpoints that appear whole or not at all, the newest one that can be read, old ones gone.

A checkpoint holds tensors and plain values only. It is read without running what it holds; a file that asks for that
is refused.
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
from pansplat.model.weights import COMPATS, WeightsFile, read_checkpoint

_KIND, _FORMAT = "pansplat-training", 1
_NAME = re.compile(r"step_(\d{8})\.pt")


def checkpoint_path(folder: Path, step: int) -> Path:
    """Where the checkpoint after so many steps is."""
    return folder / f"step_{step:08d}.pt"


def save_checkpoint(folder: Path, step: int, state: Mapping[str, Any], *, keep: int) -> Path:
    """Write the checkpoint after so many steps, then delete all but the newest `keep`.

    The file is on the disk before it takes its name, so that a kill or a power cut leaves the ones before it.

    Raises:
        InputError: no room, or no right to write; what was there stays.
    """
    path = checkpoint_path(folder, step)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        try:
            with open(partial, "wb") as file:
                torch.save({"kind": _KIND, "format": _FORMAT, "step": step, **state}, file)
                file.flush()
                os.fsync(file.fileno())
        except RuntimeError as error:  # torch's word for a disk that is full
            raise OSError(0, str(error).splitlines()[0]) from error
    for old in checkpoints(folder)[:-keep]:
        old.unlink(missing_ok=True)
    return path


def checkpoints(folder: Path) -> list[Path]:
    """Those of a run, oldest first."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))


def load_latest(folder: Path) -> tuple[Path, dict[str, Any]] | None:
    """The newest checkpoint that can be read, with what it holds; None where there is none at all.

    Remains of writes that were cut off are deleted. A damaged checkpoint is passed over, and a warning says so.

    Raises:
        InputError: there are checkpoints and none can be read, or one asks for code to be run.
    """
    _sweep(folder)
    found = checkpoints(folder)
    failures = []
    for path in reversed(found):
        try:
            return path, load_checkpoint(path)
        except InputError as error:
            if "asks to run" in str(error):
                raise
            failures.append(str(error))
            warnings.warn(f"passed over a checkpoint: {error}", stacklevel=2)
    if failures:
        raise InputError(f"{folder}: needed a checkpoint that can be read, got none:\n  " + "\n  ".join(failures))
    return None


def load_checkpoint(path: Path) -> dict[str, Any]:
    """What a checkpoint of training holds.

    Raises:
        InputError: damaged, no checkpoint of training, of another format, or one that asks for code to be run.
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
    """Whether a file's contents are those of a checkpoint of training."""
    return content.get("kind") == _KIND


def weights_of(content: Mapping[str, Any], path: Path) -> WeightsFile:
    """The weights in a checkpoint of training: their running mean, if there is one."""
    try:
        described = json.loads(content["weights"])
        tensors = content["mean"] if content.get("mean") else content["network"]
        return WeightsFile(described["model"], described["config"], COMPATS[described["compat"]], dict(tensors))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: needed weights in the checkpoint, got {error!r}; take another.") from error


def _sweep(folder: Path) -> None:
    """Delete what writes that were cut off left behind."""
    if folder.is_dir():
        for path in folder.glob(".step_*.pt"):
            path.unlink(missing_ok=True)
