"""Threads: sections of torch code on one thread, and how threads wait."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info

from pansplat.system.threads import one_thread


def test_a_section_on_one_thread_restores_the_number_of_threads() -> None:
    np.ones((8, 8)) @ np.ones((8, 8))  # loads the library

    def count() -> tuple[int, set[int]]:
        pools = [each for each in threadpool_info() if each["user_api"] == "blas"]
        return torch.get_num_threads(), {each["num_threads"] for each in pools}

    before = count()
    with one_thread():
        with one_thread():
            assert count() == (1, {1})
        assert count()[1] == {1}
    assert count() == before


@pytest.mark.parametrize(("given", "expected"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_threads_that_wait_sleep_unless_the_user_chose_otherwise(given: str | None, expected: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"OMP_WAIT_POLICY": given} if given else {}
    code = "import os, sys, pansplat; assert 'torch' not in sys.modules; print(os.environ['OMP_WAIT_POLICY'])"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == expected
