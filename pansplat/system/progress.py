"""Progress of long work: its steps report the fraction done, and a function of the caller shows it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar

POSED = 0.5  # fraction of the work that is done when poses had to be estimated first
CONNECTED = 0.05  # fraction of the work that is done when only the overlaps of a tour had to be measured first

Show = Callable[[str, float], None]  # current step, fraction done in [0, 1]


class _Stage:
    """Work whose progress is shown; the fraction does not fall."""

    def __init__(self, show: Show) -> None:
        self.show, self.done = show, 0.0

    def report(self, what: str, done: float) -> None:
        self.done = min(max(done, self.done), 1.0)
        self.show(what, self.done)


_stage: ContextVar[_Stage | None] = ContextVar("stage", default=None)


@contextlib.contextmanager
def show_progress(show: Show) -> Iterator[_Stage]:
    """Call a function with the current step and the fraction done of the block; an exception of it ends the work."""
    shown = _Stage(show)
    token = _stage.set(shown)
    try:
        yield shown
    finally:
        _stage.reset(token)


@contextlib.contextmanager
def stage(end: float = 1.0, name: str = "") -> Iterator[None]:
    """The block is a part of the work around it: from the fraction that is done now to `end`, if it reports any step.

    `name` is put before the steps.
    """
    whole = _stage.get()
    if whole is None:
        yield
        return
    start = whole.done
    with show_progress(lambda what, done: whole.report(name + what, start + (end - start) * done)) as part:
        yield
    if part.done > 0:
        whole.done = max(whole.done, end)


def report_progress(what: str, done: float) -> None:
    """Report a step, and the fraction that is done of the present stage; without `show_progress` nothing happens."""
    current = _stage.get()
    if current is not None:
        current.report(what, done)


def is_progress_shown() -> bool:
    """Whether a caller shows the progress."""
    return _stage.get() is not None
