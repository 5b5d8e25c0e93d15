"""Work in a thread that reports its progress and can be cancelled."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from typing import Generic, TypeVar

from pansplat.system.descriptions import describe_time_left
from pansplat.system.progress import show_progress

Result = TypeVar("Result")
Report = Callable[..., None]  # description of the work, fraction done
_LEAST_SECONDS, _LEAST_FRACTION = 2.0, 0.05  # duration and share of work before its remaining time is estimated


class CancelledError(Exception):
    """Raised from a report to end work whose result is not needed."""


class _Task(Generic[Result]):
    """Work that was started.

    Attributes:
        description, fraction: of the last report; the fraction of a description does not fall.
        future: of the result.
    """

    def __init__(self, executor: ThreadPoolExecutor, work: Callable[[Report], Result], description: str) -> None:
        self.description, self.fraction, self.is_cancelled = description, 0.0, False
        self.started = time.monotonic()
        self.future: Future[Result] = executor.submit(copy_context().run, self._run, work)  # with its device

    def _run(self, work: Callable[[Report], Result]) -> Result:
        with show_progress(self.report):
            return work(self.report)

    def report(self, description: str | None = None, fraction: float = 0.0) -> None:
        if self.is_cancelled:
            raise CancelledError
        if description is None:
            return
        before = self.fraction if description == self.description else 0.0
        self.description, self.fraction = description, min(max(fraction, before), 1.0)


class BackgroundWorker(Generic[Result]):
    """Runs one piece of work at a time in a thread; a new one cancels the one before, and begins after its end."""

    def __init__(self, name: str) -> None:
        """A thread with this name starts with the first work."""
        self._executor = ThreadPoolExecutor(1, thread_name_prefix=name)
        self._task: _Task[Result] | None = None

    def start(self, work: Callable[[Report], Result], description: str = "starting") -> None:
        """Call `work` in a thread with a function that takes a description and the fraction done.

        This function raises `CancelledError` after the work is cancelled. Any thread may call it; without arguments it
        keeps the progress. `report_progress` calls it, too.
        """
        self.cancel()
        self._task = _Task(self._executor, work, description)

    @property
    def future(self) -> Future[Result] | None:
        """The result of the work; None if there is none, or if `poll` has returned it."""
        return None if self._task is None else self._task.future

    @property
    def progress(self) -> tuple[str, float] | None:
        """Description and fraction done; None as for `future`."""
        return None if self._task is None else (self._task.description, self._task.fraction)

    def describe_time(self) -> str:
        """The remaining time of the work; the time that it has taken while that is unknown, and none without work."""
        if self._task is None:
            return ""
        seconds, done = time.monotonic() - self._task.started, self._task.fraction
        if seconds < _LEAST_SECONDS or done < _LEAST_FRACTION:
            return f"{seconds:.0f} s"
        return describe_time_left(seconds * (1 - done) / done)

    def poll(self) -> Result | BaseException | None:
        """The result or the exception of work that is finished, once; None before."""
        if self._task is None or not self._task.future.done():
            return None
        future, self._task = self._task.future, None
        return future.exception() or future.result()

    def cancel(self, *, join: bool = False) -> bool:
        """Make the work end at its next report; with `join`, wait for its end. Returns whether there was work."""
        task, self._task = self._task, None
        if task is None:
            return False
        task.is_cancelled = True
        task.future.cancel()
        if join:
            self._executor.submit(int).result()  # begins after all work
        return True

    def close(self) -> None:
        """Cancel the work and wait for the thread."""
        self.cancel()
        self._executor.shutdown()
