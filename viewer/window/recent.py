"""The paths that were opened in the window, in one JSON file of the user."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import platformdirs
from msgspec import Struct

from pansplat.errors import InputError
from pansplat.system.atomic import replacing
from pansplat.system.strict_json import read_json

_MAX_RECENT = 10  # paths that are kept


class _File(Struct):
    """The content of the file."""

    recent: list[str] = []


def find_file() -> Path:
    """The user's file, such as ~/.config/pansplat/viewer.json; it may not exist."""
    return platformdirs.user_config_path("pansplat", appauthor=False) / "viewer.json"


def read_recent(file: Path | None) -> tuple[str, ...]:
    """The paths of a file, the last one first; none if there is no file, or if it is damaged."""
    with suppress(InputError, OSError):
        if file is not None and file.is_file():
            return tuple(read_json(file, _File).recent[:_MAX_RECENT])
    return ()


def add_recent(recent: tuple[str, ...], path: Path, file: Path | None) -> tuple[str, ...]:
    """The paths with one that is opened now, which are written to the file, complete or not at all, if it can be."""
    name = str(path.absolute())
    recent = read_recent(file) or recent  # another window may have opened others since
    recent = (name, *(other for other in recent if other != name))[:_MAX_RECENT]
    with suppress(InputError, OSError):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            with replacing(file) as temporary:
                temporary.write_text(json.dumps({"recent": recent}, indent=1), "utf-8")
    return recent
