"""Compilation, worker threads and working memory."""

import gc
import threading
import time
from collections import deque

import numba as nb
import numpy as np
import pytest
import torch

from pansplat.system import kernels, source_hash
from pansplat.system.kernels import (
    Workspace,
    cached_njit,
    kernel,
    parallel_for,
    pooled_empty,
    release_idle_memory,
)


def _add_indices(x):
    for i in range(3):
        x += i
    return x


@pytest.mark.parametrize(("module", "messages"), [("pansplat.rendering.cpu.projection", [1, 0]), ("else", [0, 0])])
def test_only_the_first_compilation_of_pansplat_kernels_is_announced(module, messages, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(kernels, "find_cache_folder", lambda compiled: tmp_path)
    for count in messages:  # in as many processes
        monkeypatch.setattr(kernels, "_message_shown", False)
        for _ in range(2):
            function = type(_add_indices)(_add_indices.__code__, {"range": range})
            function.__module__ = module
            nb.njit(function)(1.0)
        (tmp_path / "kernel.nbi").touch()
        assert capsys.readouterr().err.count("compiling kernels for this processor") == count


@pytest.mark.parametrize("decorate", [kernel, cached_njit(nogil=True)])
def test_a_change_of_an_imported_module_invalidates_a_kernel(decorate, monkeypatch, tmp_path):
    """`lift` inlines functions of `surface`; numba itself checks the file of the kernel only."""
    stamps = []
    monkeypatch.setattr(source_hash, "_FOLDER", tmp_path)
    monkeypatch.setattr(kernels, "set_source_stamp", lambda compiled, stamp: stamps.append(stamp))
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep/lift.py").write_text("from pansplat.sweep.surface import locate\n")
    function = type(_add_indices)(_add_indices.__code__, {"range": range})
    function.__module__ = "pansplat.sweep.lift"
    for content in ("1", "2"):
        (tmp_path / "sweep/surface.py").write_text(content)
        source_hash.hash_sources.cache_clear()
        decorate(function)
    source_hash.hash_sources.cache_clear()
    assert len(set(stamps)) == 2


def test_a_kernel_is_compiled_without_a_cache_directory(monkeypatch):
    def refuse(*, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return nb.njit(**options)

    monkeypatch.setattr(kernels, "nb", type("Numba", (), {"njit": staticmethod(refuse)}))
    assert kernel(_add_indices)(1.0) == 4.0


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 3, 100])
def test_parallel_for_runs_each_item_once(count, threads):
    done: list[int] = []
    parallel_for(done.append, count, threads)
    assert sorted(done) == list(range(count))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_parallel_for_raises_after_all_threads_have_stopped(threads):
    busy = []

    def work(item):
        busy.append(item)
        try:
            if item == 3:
                raise KeyboardInterrupt
            time.sleep(0.001)
        finally:
            busy.remove(item)

    with pytest.raises(KeyboardInterrupt):
        parallel_for(work, 50, threads)
    assert busy == []
    parallel_for(work, 3, threads)  # the pool is still usable


def test_two_threads_may_use_parallel_for_at_once():
    done: list[tuple[int, int]] = []

    def run(caller):
        parallel_for(lambda item: done.append((caller, item)), 200, 3)

    callers = [threading.Thread(target=run, args=(caller,)) for caller in range(2)]
    for thread in callers:
        thread.start()
    for thread in callers:
        thread.join()
    assert sorted(done) == [(caller, item) for caller in range(2) for item in range(200)]


@pytest.fixture
def no_idle_memory(monkeypatch):
    monkeypatch.setattr(kernels, "_idle", [])
    monkeypatch.setattr(kernels, "_returned", deque())


@pytest.mark.parametrize("shape", [(3, 16), (7,), 5, (0, 4), ()])
def test_arrays_are_contiguous_and_aligned_to_a_cache_line(shape):
    workspace = Workspace()
    for array in (workspace.array(shape, np.float32), pooled_empty(shape, np.float32)):
        assert array.size == 0 or array.ctypes.data % 64 == 0
        assert array.shape == (shape if isinstance(shape, tuple) else (shape,))
        assert array.flags.c_contiguous and array.dtype == np.float32


@pytest.mark.usefixtures("no_idle_memory")
def test_idle_memory_is_limited(monkeypatch):
    monkeypatch.setattr(kernels, "_MAX_IDLE", 5000)
    workspace = Workspace()
    for _ in range(10):
        workspace.array(1000, np.uint8)
    del workspace
    assert 0 < sum(buffer.nbytes for buffer in kernels._idle) <= 5000


@pytest.mark.usefixtures("no_idle_memory")
def test_pooled_memory_is_reused_after_the_last_view_of_it():
    tensor = torch.from_numpy(pooled_empty((1000, 3), np.float32))
    part = tensor[10:20, 1]
    del tensor
    assert not np.shares_memory(Workspace().array((1000, 3), np.float32), part.numpy())
    del part
    release_idle_memory()
    tensor = torch.from_numpy(pooled_empty((1000, 3), np.float32))
    address = tensor.data_ptr()
    del tensor
    assert pooled_empty((1000, 3), np.float32).ctypes.data == address


@pytest.mark.usefixtures("no_idle_memory")
def test_an_array_that_grows_from_image_to_image_seldom_needs_new_memory():
    sizes = [100_000 + 1000 * number for number in range(12)]
    assert len({Workspace().array(size, np.uint8).ctypes.data for size in sizes}) == 1


@pytest.mark.usefixtures("no_idle_memory")
def test_a_workspace_that_ends_while_the_lock_is_held_does_not_wait():
    workspace = Workspace()
    address = workspace.array(5000, np.uint8).ctypes.data
    with kernels._lock:
        del workspace
        gc.collect()
        assert kernels._idle == []
    assert Workspace().array(5000, np.uint8).ctypes.data == address
