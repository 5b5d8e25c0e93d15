"""The end of a training run before its last step, after which the same command resumes it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from pansplat.training.logs import ProgressDisplay


class StopRequest:
    """Whether a run ends after the current step, and the exit status of its command then.

    Attributes:
        requested: set by a signal, or by the run itself.
        status: 128 + the number of the signal: SIGINT if another process received it. 0 if the run set it.
    """

    def __init__(self) -> None:
        self.requested, self.status = False, 128 + signal.SIGINT

    @contextmanager
    def on_signal(self, progress: ProgressDisplay) -> Iterator[None]:
        """The first Ctrl-C or SIGTERM stops the run after the current step; the second one raises KeyboardInterrupt."""

        def handle(number: int, _: object) -> None:
            if self.requested:
                raise KeyboardInterrupt
            self.requested, self.status = True, 128 + number
            # A handler may interrupt a write to the same stream, which cannot be entered twice; a thread waits for it.
            message = "stopping after this step; press Ctrl-C again to stop at once"
            threading.Thread(target=progress.print, args=(message,), daemon=True).start()

        signals = (signal.SIGINT, signal.SIGTERM)
        try:
            previous = [signal.signal(kind, handle) for kind in signals]
        except ValueError:  # signal handlers can only be set in the main thread
            previous = []
        try:
            yield
        finally:
            for kind, handler in zip(signals, previous, strict=False):
                signal.signal(kind, handler)
