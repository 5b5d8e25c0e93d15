"""Work in a thread that reports its progress and can be cancelled."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, TypeVar

Result = TypeVar("Result")
Report = Callable[..., None]  # description of the work, fraction done


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
        self.future: Future[Result] = executor.submit(work, self.report)

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
        keeps the progress.
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


class Jobs:
    """Named work in threads, one piece of each name at a time; its results and errors arrive in the window's thread."""

    def __init__(self, show_error: Callable[[str], None]) -> None:
        """`show_error` shows a message to the user."""
        self._show_error = show_error
        self._workers: dict[str, BackgroundWorker[Any]] = {}
        self._ends: dict[str, tuple[Callable[[Any], None], str]] = {}

    def start(
        self,
        name: str,
        work: Callable[[Report], Result],
        then: Callable[[Result], None],
        *,
        description: str = "starting",
        failure: str = "",
    ) -> None:
        """Start work in place of that of the same name.

        Args:
            name: of the job and its thread.
            work: called in the thread, as by `BackgroundWorker.start`.
            then: called with the result by `poll`.
            description: of the work before its first report.
            failure: of the message of an error, before the reason.
        """
        self._workers.setdefault(name, BackgroundWorker(name)).start(work, description)
        self._ends[name] = then, failure

    @property
    def is_busy(self) -> bool:
        """Whether there is work, or a result that `poll` has not taken."""
        return any(worker.future is not None for worker in self._workers.values())

    def progress(self, name: str) -> tuple[str, float] | None:
        """Description of the work of this name and the fraction done; None without work."""
        return self._workers[name].progress if name in self._workers else None

    def poll(self) -> None:
        """Hand over the results of finished work, or show its errors."""
        for name, worker in list(self._workers.items()):
            future = worker.future
            if future is not None and future.done():
                worker.poll()
                then, failure = self._ends[name]
                error = future.exception()
                if error is None:
                    then(future.result())
                else:
                    self._show_error(f"{failure}{error}")

    def cancel(self, name: str, *, join: bool = False) -> bool:
        """Make the work of this name end; with `join`, wait for its end. Returns whether there was work."""
        return name in self._workers and self._workers[name].cancel(join=join)

    def close(self) -> None:
        """Cancel all work and wait for the threads."""
        for worker in self._workers.values():
            worker.close()
