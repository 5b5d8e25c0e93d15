"""Numbers of threads: numba's loops have torch's, and leave it."""

import os
import subprocess
import sys

import numba
import pytest
import torch

from pansplat.threads import limit_numba_threads, one_thread

_FIRST_LOOP = """
import numpy as np
import torch
from pansplat.sweep.matching import select_labels
torch.set_num_threads(1)
select_labels(np.zeros((2, 4, 3), np.float32), 3)
assert torch.get_num_threads() == 1
"""


def test_the_first_loop_of_numba_leaves_torchs_number_of_threads() -> None:
    environment = os.environ | {"NUMBA_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", _FIRST_LOOP], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two processors")
def test_numbas_loops_have_as_many_threads_as_torch() -> None:
    before, found = torch.get_num_threads(), []
    try:
        torch.set_num_threads(2)
        limit_numba_threads()
        found.append(numba.get_num_threads())
        with one_thread():
            limit_numba_threads()
            found.append(numba.get_num_threads())
        torch.set_num_threads(numba.config.NUMBA_NUM_THREADS + 3)
        limit_numba_threads()
        found.append(numba.get_num_threads())
    finally:
        torch.set_num_threads(before)
        limit_numba_threads()
    assert found == [2, 1, numba.config.NUMBA_NUM_THREADS]
