"""Leased memory is used again, but never by two at a time."""

import gc
from collections import deque

import numpy as np
import pytest
import torch

from pansplat.rendering.cpu import memory
from pansplat.rendering.cpu.memory import Lease, array_to_give


@pytest.fixture(autouse=True)
def _nothing_idle(monkeypatch):
    monkeypatch.setattr(memory, "_idle", [])
    monkeypatch.setattr(memory, "_returned", deque())


def test_memory_given_back_is_used_again():
    lease = Lease()
    address = lease.array((100, 16), np.float32).ctypes.data
    del lease
    assert Lease().array((50, 32), np.float32).ctypes.data == address


def test_two_leases_share_nothing():
    first, second = Lease(), Lease()
    one, two = first.array(1000, np.float64), second.array(1000, np.float64)
    again = first.array(1000, np.float64)
    assert not np.shares_memory(one, two) and not np.shares_memory(one, again)


def test_arrays_start_on_a_cache_line_and_have_the_shape_asked_for():
    lease = Lease()
    for shape in ((3, 16), (7,), 5, (0, 4), ()):
        array = lease.array(shape, np.float32)
        assert array.size == 0 or array.ctypes.data % 64 == 0
        assert array.shape == (shape if isinstance(shape, tuple) else (shape,))
        assert array.flags.c_contiguous and array.dtype == np.float32


def test_no_more_than_a_limit_is_kept(monkeypatch):
    monkeypatch.setattr(memory, "_KEPT", 5000)
    lease = Lease()
    for _ in range(10):
        lease.array(1000, np.uint8)
    del lease
    assert 0 < sum(block.nbytes for block in memory._idle) <= 5000


def test_a_small_array_does_not_take_a_large_block():
    lease = Lease()
    lease.array(1 << 20, np.uint8)
    del lease
    Lease().array(10, np.uint8)
    assert max(block.nbytes for block in memory._idle) > 1 << 20


def test_what_is_given_comes_back_when_torch_lets_go_of_it():
    tensor = torch.from_numpy(array_to_give((1000, 3), np.float32))
    part = tensor[10:20, 1]
    del tensor
    assert not np.shares_memory(Lease().array((1000, 3), np.float32), part.numpy())
    del part
    memory.forget_idle()
    tensor = torch.from_numpy(array_to_give((1000, 3), np.float32))
    address = tensor.data_ptr()
    del tensor
    assert array_to_give((1000, 3), np.float32).ctypes.data == address


def test_an_empty_array_can_be_given():
    assert array_to_give((0, 4), np.float32).shape == (0, 4) and array_to_give((), np.float32).shape == ()


def test_a_lease_that_ends_while_the_lock_is_held_does_not_wait_for_it():
    lease = Lease()
    address = lease.array(5000, np.uint8).ctypes.data
    with memory._lock:
        del lease
        gc.collect()
        assert memory._idle == []
    assert Lease().array(5000, np.uint8).ctypes.data == address
