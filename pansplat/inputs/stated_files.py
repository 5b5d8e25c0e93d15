"""The rule for files that a list names: only those in its folder are read, whoever made the folder."""

from __future__ import annotations

import os
from pathlib import Path

from pansplat.errors import InputError
from pansplat.images.cube_images import CUBE_SUFFIX
from pansplat.images.rig_images import RIG_SUFFIX


def locate_inside(folder: Path, name: str, where: object = "") -> Path:
    """The normalised path of a file that a list names, relative to the folder or whole; it need not exist."""
    top = Path(os.path.abspath(folder))
    path = Path(os.path.normpath(top / name))
    if "\0" not in name and path.is_relative_to(top) and not name.endswith((CUBE_SUFFIX, RIG_SUFFIX)):
        return folder / path.relative_to(top)
    prefix = f"{where}: " if where else ""
    raise InputError(
        f"{prefix}needed a file inside {folder}, got the path {name[:80]!r}; copy the picture into the folder"
    )


def find_inside(folder: Path, name: str) -> Path | None:
    """The file of `locate_inside`; None if there is none."""
    try:
        path = locate_inside(folder, name)
    except InputError:
        return None
    return path if path.is_file() else None
