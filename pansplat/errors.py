"""The error for unusable input, and the warning for input of which a part is ignored."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar

_notes: ContextVar[list[str] | None] = ContextVar("notes", default=None)


class InputError(ValueError):
    """Input that pansplat cannot use.

    The message names the file or argument, what was needed, what was given, and what to do. Commands print it
    without a traceback and exit with status 2.
    """


class NothingFoundError(InputError):
    """There is nothing at a path that could be panoramas."""


class InputWarning(UserWarning):
    """Input that pansplat can use in part. Commands print it as one line `note: ...`; `collect_notes` lists it."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)
        notes = _notes.get()
        if notes is not None:
            notes.append(str(self))


@contextlib.contextmanager
def collect_notes() -> Iterator[list[str]]:
    """List the text of each `InputWarning` that this thread, or a pool of `worker_threads` for it, makes in the block.

    No filters of `warnings` change: they belong to all threads, and one may restore what another has just changed.
    """
    notes: list[str] = []
    token = _notes.set(notes)
    try:
        yield notes
    finally:
        _notes.reset(token)
