"""Run these tests on a CUDA device, or without one under Triton's interpreter.

The interpreter's variable must be set before Triton is imported.
"""

import os

import pytest
import torch

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"


@pytest.fixture(autouse=True)
def _device(triton_device: str) -> None:
    pass
