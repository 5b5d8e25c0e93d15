"""Single-threaded sections of torch code."""

import contextlib
import threading
from collections.abc import Iterator

import torch

_lock = threading.Lock()
_inside = 0
_outside = 1


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run torch operations on the calling thread only, then restore the number of threads.

    Operations on a few thousand numbers do not benefit from a second core. On a busy machine they wait for it: three
    jobs on two cores ran 40 times slower. One thread also fixes the order of summation.
    """
    global _inside, _outside
    with _lock:
        if _inside == 0:
            _outside = torch.get_num_threads()
        _inside += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            torch.set_num_threads(_outside)
