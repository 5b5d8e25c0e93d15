"""Kernels are compiled bare and kept; the user is told only when it takes long."""

import gc
import inspect
import threading
import time
from collections import deque

import numba as nb
import numpy as np
import pytest
import torch

from pansplat.rendering.cpu import runtime
from pansplat.rendering.cpu.runtime import (
    Workspace,
    _hash_sources,
    announce_compilation,
    inline_kernel,
    kernel,
    parallel_for,
    pooled_empty,
)

# Shared-out work is done once each, and exceptions come out when all have stopped.

# Leased memory is used again, but never by two at a time.


def _work(x):
    for i in range(3):
        x += i
    return x


def _compile(module):
    function = type(_work)(_work.__code__, {"range": range})
    function.__module__ = module
    nb.njit(function)(1.0)


@pytest.mark.parametrize(
    ("patience", "module", "lines"),
    [(0.0, "pansplat.rendering.cpu.observe", 1), (100.0, "pansplat.rendering.cpu.observe", 0), (0.0, "elsewhere", 0)],
)
def test_compiling_our_kernels_is_announced_when_it_takes_long(patience, module, lines, monkeypatch, capsys):
    monkeypatch.setattr(runtime, "_MESSAGE_DELAY", patience)
    monkeypatch.setattr(runtime, "_message_shown", False)
    with announce_compilation():
        _compile(module)
        _compile(module)  # one after another is still one wait
    assert capsys.readouterr().err.count("compiling the rasteriser for this processor") == lines


@pytest.mark.parametrize("decorate", [kernel, inline_kernel])
def test_a_wrapped_function_is_compiled_bare(decorate):
    def wrapper(*args):
        raise AssertionError

    wrapper.__wrapped__ = _work
    compiled = decorate(wrapper)
    assert compiled.py_func is _work and inspect.isfunction(compiled.py_func)


def test_what_is_compiled_into_a_kernel_counts_for_its_freshness(tmp_path, monkeypatch):
    monkeypatch.setattr(runtime, "__file__", str(tmp_path / "runtime.py"))
    package = runtime.__package__
    (tmp_path / "upper.py").write_text(f"from {package} import middle as m, other\n")
    (tmp_path / "middle.py").write_text(f"from {package}.lower import (\n    a,\n    b,\n)\n")
    for name in ("lower", "other", "stranger"):
        (tmp_path / f"{name}.py").write_text("a = 1\n")
    stamps = [_hash_sources(tmp_path / "upper.py")]
    for name in ("lower", "other", "stranger"):
        (tmp_path / f"{name}.py").write_text("a = 2\n")
        stamps.append(_hash_sources(tmp_path / "upper.py"))
    assert len(set(stamps[:3])) == 3 and stamps[2] == stamps[3]


def test_a_kernel_is_compiled_where_nothing_can_be_kept(monkeypatch):
    def refuse(*, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return nb.njit(**options)

    monkeypatch.setattr(runtime, "nb", type("Numba", (), {"njit": staticmethod(refuse)}))
    assert kernel(_work)(1.0) == 4.0


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 3, 100])
def test_each_piece_is_done_once(count, threads):
    done: list[int] = []
    parallel_for(done.append, count, threads)
    assert sorted(done) == list(range(count))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_an_exception_is_raised_when_all_have_stopped(threads):
    busy = []

    def work(piece):
        busy.append(piece)
        try:
            if piece == 3:
                raise KeyboardInterrupt
            time.sleep(0.001)
        finally:
            busy.remove(piece)

    with pytest.raises(KeyboardInterrupt):
        parallel_for(work, 50, threads)
    assert busy == []
    parallel_for(work, 3, threads)  # and it can be used again


def test_two_threads_may_share_out_work_at_once():
    done: list[tuple[int, int]] = []

    def run(who):
        parallel_for(lambda piece: done.append((who, piece)), 200, 3)

    both = [threading.Thread(target=run, args=(who,)) for who in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert sorted(done) == [(who, piece) for who in range(2) for piece in range(200)]


@pytest.fixture(autouse=True)
def _nothing_idle(monkeypatch):
    monkeypatch.setattr(runtime, "_idle", [])
    monkeypatch.setattr(runtime, "_returned", deque())


def test_memory_given_back_is_used_again():
    workspace = Workspace()
    address = workspace.array((100, 16), np.float32).ctypes.data
    del workspace
    assert Workspace().array((50, 32), np.float32).ctypes.data == address


def test_two_leases_share_nothing():
    first, second = Workspace(), Workspace()
    one, two = first.array(1000, np.float64), second.array(1000, np.float64)
    again = first.array(1000, np.float64)
    assert not np.shares_memory(one, two) and not np.shares_memory(one, again)


def test_arrays_start_on_a_cache_line_and_have_the_shape_asked_for():
    workspace = Workspace()
    for shape in ((3, 16), (7,), 5, (0, 4), ()):
        array = workspace.array(shape, np.float32)
        assert array.size == 0 or array.ctypes.data % 64 == 0
        assert array.shape == (shape if isinstance(shape, tuple) else (shape,))
        assert array.flags.c_contiguous and array.dtype == np.float32


def test_no_more_than_a_limit_is_kept(monkeypatch):
    monkeypatch.setattr(runtime, "_MAX_IDLE", 5000)
    workspace = Workspace()
    for _ in range(10):
        workspace.array(1000, np.uint8)
    del workspace
    assert 0 < sum(block.nbytes for block in runtime._idle) <= 5000


def test_a_small_array_does_not_take_a_large_block():
    workspace = Workspace()
    workspace.array(1 << 20, np.uint8)
    del workspace
    Workspace().array(10, np.uint8)
    assert max(block.nbytes for block in runtime._idle) > 1 << 20


def test_what_is_given_comes_back_when_torch_lets_go_of_it():
    tensor = torch.from_numpy(pooled_empty((1000, 3), np.float32))
    part = tensor[10:20, 1]
    del tensor
    assert not np.shares_memory(Workspace().array((1000, 3), np.float32), part.numpy())
    del part
    runtime.release_idle_memory()
    tensor = torch.from_numpy(pooled_empty((1000, 3), np.float32))
    address = tensor.data_ptr()
    del tensor
    assert pooled_empty((1000, 3), np.float32).ctypes.data == address


def test_an_empty_array_can_be_given():
    assert pooled_empty((0, 4), np.float32).shape == (0, 4) and pooled_empty((), np.float32).shape == ()


def test_a_lease_that_ends_while_the_lock_is_held_does_not_wait_for_it():
    workspace = Workspace()
    address = workspace.array(5000, np.uint8).ctypes.data
    with runtime._lock:
        del workspace
        gc.collect()
        assert runtime._idle == []
    assert Workspace().array(5000, np.uint8).ctypes.data == address
