"""Settings of all tests."""

import os
import signal
from collections.abc import Iterator

import pytest
import torch

# One thread per pytest-xdist worker and its child processes: workers must not compete for cores.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _restored_signal_handlers() -> Iterator[None]:
    """Restore the handlers after a test: the end of a command ignores signals, and child processes inherit that."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)
