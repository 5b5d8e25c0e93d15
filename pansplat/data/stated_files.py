"""The rule for files that a list names (poses, reconstructions, web tours): only those in the folder are read.

A folder may come from anybody, and what its list names gets into an export.
"""

from __future__ import annotations

import os
from pathlib import Path

from pansplat.data.cube_images import CUBE_SUFFIX
from pansplat.data.rig_images import RIG_SUFFIX
from pansplat.errors import InputError


def locate_inside(folder: Path, name: str) -> Path:
    """The normalised path of a file that a list names; it need not exist. Links of the file system are followed.

    Args:
        folder: the only one from which files are read, with those below it.
        name: relative to the folder, or a whole path in it.

    Raises:
        InputError: the path leads out of the folder, or is a description that names other pictures.
    """
    top = Path(os.path.abspath(folder))
    path = Path(os.path.normpath(top / name))
    if "\0" in name or not path.is_relative_to(top):
        raise InputError(f"needed a file inside {folder}, got the path {name[:80]!r}; copy the file into the folder")
    if name.endswith((CUBE_SUFFIX, RIG_SUFFIX)):
        raise InputError(f"needed a picture inside {folder}, got the path {name[:80]!r}; name the pictures themselves")
    return folder / path.relative_to(top)


def leads_out(folder: Path, name: str) -> bool:
    """Whether `locate_inside` refuses a name."""
    try:
        locate_inside(folder, name)
    except InputError:
        return True
    return False


def find_inside(folder: Path, name: str) -> Path | None:
    """The file of `locate_inside`; None if there is none."""
    return None if leads_out(folder, name) or not (path := locate_inside(folder, name)).is_file() else path
