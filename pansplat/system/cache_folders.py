"""Folders for what is computed from a folder's panoramas, and atomic writing of files in them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Sequence
from pathlib import Path

from pansplat.errors import InputError
from pansplat.system.atomic import is_unfinished, replacing
from pansplat.system.files import expand_home

_ABANDONED_SECONDS = 3600.0  # after which an unfinished file is that of a process that was killed


def cache_folders(folder: Path) -> list[Path]:
    """Folders for what is computed from a folder's panoramas, in order of preference."""
    folder_hash = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=8).hexdigest()
    folders = [folder / ".pansplat"]
    with contextlib.suppress(InputError):  # no home folder
        home = os.environ.get("XDG_CACHE_HOME") or expand_home("~/.cache")
        folders.append(Path(home) / "pansplat" / folder_hash)
    return folders


def write_cache_file(folders: Sequence[Path], name: str, *parts: bytes) -> Path | None:
    """Write a file to the first writable folder; returns its path, or None if there is no such folder."""
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(folder / name) as unfinished, open(unfinished, "wb") as file:
                file.writelines(parts)
        except (OSError, InputError):
            continue
        _remove_abandoned(folder)
        return folder / name
    return None


def _remove_abandoned(folder: Path) -> None:
    """Remove unfinished files of processes that were killed."""
    with contextlib.suppress(OSError):
        for file in folder.iterdir():
            if is_unfinished(file) and time.time() - file.stat().st_mtime > _ABANDONED_SECONDS:
                file.unlink()
