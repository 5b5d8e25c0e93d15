"""Reading and writing scene files by suffix."""

from __future__ import annotations

from pathlib import Path

from pansplat.errors import InputError
from pansplat.gaussians.ply import load_ply, save_ply
from pansplat.gaussians.scene import Scene

SCENE_SUFFIXES = (".ply",)


def is_scene_file(path: str | Path) -> bool:
    """Whether the name of a file ends in the suffix of a scene format, in any case."""
    return str(path).lower().endswith(SCENE_SUFFIXES)


def save_scene(scene: Scene, path: str | Path) -> None:
    """Write a scene in the format of the file's suffix, atomically.

    Raises:
        InputError: unknown suffix, or the folder does not exist or cannot be written.
    """
    _require_suffix(path)
    save_ply(scene, path)


def load_scene(path: str | Path) -> Scene:
    """Read a scene file of `save_scene` or of another tool.

    Raises:
        InputError: unknown suffix, or the file is missing or damaged.
    """
    _require_suffix(path)
    return load_ply(path)


def _require_suffix(path: str | Path) -> None:
    if not is_scene_file(path):
        known = ", ".join(SCENE_SUFFIXES)
        raise InputError(f"{path}: a scene file must end in {known}, got {Path(path).suffix or 'no suffix'!r}")
