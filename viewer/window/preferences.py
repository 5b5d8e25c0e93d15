"""What the window remembers: layout, theme and recent paths, in one JSON file of the user."""

from __future__ import annotations

import json
import zlib
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import platformdirs
from msgspec import Struct

from pansplat.errors import InputError
from pansplat.system.atomic import replacing
from pansplat.system.strict_json import read_json

Theme = Literal["dark", "light"]

_MAX_RECENT = 10


@dataclass(frozen=True)
class Preferences:
    """The values that the viewer remembers between runs."""

    theme: Theme = "dark"  # colours of the panels
    recent: tuple[str, ...] = ()  # paths that were opened, the last one first
    layout: str = ""  # sizes, places and docking of the panels, as imgui's text; empty is the default layout

    def add_recent(self, path: Path) -> Preferences:
        """The preferences with a path as the last one that was opened."""
        name = str(path.absolute())
        return replace(self, recent=(name, *(other for other in self.recent if other != name))[:_MAX_RECENT])


class _File(Struct):
    """The content of the file."""

    theme: Theme = "dark"
    recent: list[str] = []
    layout: str = ""
    checksum: int | None = None


def find_file() -> Path:
    """The user's file, such as ~/.config/pansplat/viewer.json; it may not exist."""
    return platformdirs.user_config_path("pansplat", appauthor=False) / "viewer.json"


def read_preferences(file: Path | None) -> Preferences:
    """The preferences of a file; the default ones if there is none, or if it is damaged."""
    if file is None or not file.is_file():
        return Preferences()
    try:
        values = read_json(file, _File)
    except (InputError, OSError):
        return Preferences()
    layout = values.layout if values.checksum == _checksum(values.layout) else ""
    return Preferences(values.theme, tuple(values.recent[:_MAX_RECENT]), layout)


def write_preferences(preferences: Preferences, file: Path | None) -> None:
    """Write the file, complete or not at all. Without a writable folder nothing is remembered."""
    if file is None:
        return
    with suppress(InputError, OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            values = {**asdict(preferences), "checksum": _checksum(preferences.layout)}
            temporary.write_text(json.dumps(values, indent=1), "utf-8")


def _checksum(layout: str) -> int:
    """imgui ends the process at some damaged layouts, so only one that is complete is read."""
    return zlib.crc32(layout.encode())
