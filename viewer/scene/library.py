"""The scenes that a user can choose from: where they were found, and which one is listed as current."""

from __future__ import annotations

from pathlib import Path

from pansplat.errors import InputError
from pansplat_viewer.scene.loader import Find, SceneEntry, SceneLoader, choose_entry


class Library:
    """The listed entries and their loader.

    Attributes:
        loader: loads one entry at a time; closed with the viewer.
        entries: to choose from.
        current: number of the one that is shown or loaded; -1 if there is none.
        path: where they were found; None if they are only loaded again.
    """

    def __init__(self, loader: SceneLoader, find: Find) -> None:
        """`find` returns the entries of a path; it is called in a worker thread."""
        self.loader, self._find = loader, find
        self.entries: list[SceneEntry] = []
        self.current = -1
        self.path: Path | None = None
        self._wanted: tuple[Path, str | None] = Path(), None  # path, and the entry to show of those found there
        self._shown: tuple[list[SceneEntry], int, Path | None] | None = None  # arguments of `offer`

    @property
    def names(self) -> list[str]:
        """The names of the entries."""
        return [entry.name for entry in self.entries]

    @property
    def notes(self) -> tuple[str, ...]:
        """What was not used or not placed at the path, and why."""
        return self.entries[self.current].notes if 0 <= self.current < len(self.entries) else ()

    def search(self, path: Path, name: str | None = None) -> None:
        """Look for the entries at a path, to show that of a name or number, else the first one."""
        self.expect(path, name)
        self.loader.search(path, self._find)

    def expect(self, path: Path, name: str | None = None) -> None:
        """Remember what to show of a search that has begun: the entry of a name or number, else the first one."""
        self._wanted = path, name

    def choose_found(self, found: list[SceneEntry]) -> tuple[int, Path]:
        """The number of the entry to show of those that a search has found, and its path."""
        path, name = self._wanted
        try:
            return choose_entry(found, name), path
        except InputError:
            return 0, path

    def offer(self, entries: list[SceneEntry], index: int, path: Path | None) -> None:
        """Offer these entries, of which one is loaded."""
        self.entries, self.current, self.path = entries, index, path

    def keep(self) -> None:
        """Remember the list and its current entry, which is shown, for `restore`."""
        self._shown = self.entries, self.current, self.path

    def restore(self) -> None:
        """List the entry that is shown again, after another one was not loaded."""
        if self._shown is not None:
            self.offer(*self._shown)
