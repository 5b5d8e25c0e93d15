"""Settings of all tests."""

import os

import torch

# One thread per pytest-xdist worker and its child processes: workers must not compete for cores.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
