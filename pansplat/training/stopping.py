"""The end of a training run before its last step, after which the same command resumes it."""

from __future__ import annotations

import signal
import threading
from contextlib import AbstractContextManager

from pansplat.system.console import call_at_first_signal
from pansplat.training.logs import ProgressDisplay


class StopRequest:
    """Whether a run ends after the current step, and the exit status of its command then.

    Attributes:
        requested: set by a signal, or by the run itself.
        status: 128 + the number of the signal.
    """

    def __init__(self) -> None:
        self.requested, self.status = False, 128 + signal.SIGINT

    def on_signal(self, progress: ProgressDisplay) -> AbstractContextManager[None]:
        """The first Ctrl-C or SIGTERM stops the run after the current step; the second one raises KeyboardInterrupt."""

        def stop(number: int) -> None:
            self.requested, self.status = True, 128 + number
            # A handler may interrupt a write to the same stream, which cannot be entered twice; a thread waits for it.
            message = "stopping after this step; press Ctrl-C again to stop at once"
            threading.Thread(target=progress.print, args=(message,), daemon=True).start()

        return call_at_first_signal((signal.SIGINT, signal.SIGTERM), stop)
