"""Whether the files of a scene have changed on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pansplat.errors import InputError
from pansplat.inputs.pairs import list_panorama_files

_SECONDS = 2.0  # between looks at the files
_FILES = 500  # that are looked at together, in about a millisecond; a tour of tiles has thousands


class FileWatch:
    """Compares the times and sizes of files, and the names of the panoramas in folders, with those at the start.

    Attributes:
        changed: whether a file was changed, removed or made at the last look at all files.
    """

    def __init__(self) -> None:
        """No file is watched."""
        self.changed = False
        self._files: tuple[Path, ...] = ()
        self._stamps: list[tuple[object, ...] | None] = []
        self._last = -1e9
        self._next, self._found = 0, False  # of the look at all files that is in progress

    def start(self, files: Sequence[Path]) -> None:
        """Watch these files and folders from now on."""
        self._files, self.changed = tuple(files), False
        self._next, self._found = 0, False
        self._stamps = [_read_stamp(file) for file in self._files]

    def skip(self, file: Path) -> None:
        """Take a file that the window itself has written as it is now; changes of other files stay to be noticed."""
        if file in self._files:
            self._stamps[self._files.index(file)] = _read_stamp(file)

    def look(self, now: float) -> None:
        """Look at some files at time `now` (seconds), and update `changed` after the last one; then pause."""
        if self._next == 0 and now - self._last < _SECONDS:
            return
        self._last, part = now, slice(self._next, self._next + _FILES)
        self._found |= [_read_stamp(file) for file in self._files[part]] != self._stamps[part]
        self._next = part.stop
        if self._next >= len(self._files):
            self.changed, self._next, self._found = self._found, 0, False


def _read_stamp(file: Path) -> tuple[object, ...] | None:
    """Time of the last change and size of a file, or the panoramas in a folder; None if it is missing."""
    try:
        if file.is_dir():
            return tuple(path.name for path in list_panorama_files(file))
        status = file.stat()
    except (OSError, InputError):
        return None
    return status.st_mtime_ns, status.st_size
