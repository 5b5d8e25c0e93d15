"""Unavailable renderers give a reason."""

import pytest
import torch

from pansplat.bench.renderers import unavailable_reason


def test_torch_is_always_available():
    assert unavailable_reason("torch") is None


@pytest.mark.skipif(torch.cuda.is_available(), reason="tests a machine without CUDA")
def test_triton_is_unavailable_without_cuda():
    assert unavailable_reason("triton") == "there is no CUDA device"
