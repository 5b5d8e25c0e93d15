"""The second process brings kernels that the first one then finds, and nothing depends on it."""

import contextlib
import dataclasses
import importlib
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from numba import float32, float64, int64

from pansplat.rendering import rasterize
from pansplat.rendering.cpu import beside, compiling
from pansplat.rendering.cpu.beside import Beside, Task, ours, possible, theirs

_DEPTHS = Task("sort", "_measure", (int64, float32[:, ::1], float64[::1], float64[::1], float64[::1]))
_FIND = """
import numpy as np
from numba import float32, float64, int64
from pansplat.rendering.cpu import compiling, sort
from pansplat.rendering.cpu.beside import Beside, Task
wrong, kinds = Task("sort", "_sort_tiles", (int64,)), (int64, float32[:, ::1], *(float64[::1],) * 3)
compiling._second = Beside([wrong, Task("sort", "_measure", kinds)])
sort._measure(0, np.zeros((1, 16), np.float32), *np.zeros((3, 3)))
print(sum(sort._measure.stats.cache_hits.values()), sum(sort._measure.stats.cache_misses.values()))
"""
_ABANDON = """
import os, signal
from pansplat.rendering.cpu import beside
beside._SERVE = "import time; from pansplat.rendering.cpu import beside; beside._end_with_parent()"
print(beside.Beside([])._process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def _signatures(module, name):
    return list(getattr(importlib.import_module(f"pansplat.rendering.cpu.{module}"), name).overloads)


def _brings(monkeypatch, code, **options):
    monkeypatch.setattr(beside, "_SERVE", code)
    return Beside([_DEPTHS], **options)


def test_a_kernel_that_the_second_process_compiled_is_not_compiled_again(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    child = subprocess.run(
        [sys.executable, "-W", "error", "-c", _FIND], env=environment, check=True, capture_output=True, text=True
    )
    assert child.stdout.split() == ["1", "0"] and child.stderr == ""


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("covariances", [False, True])
def test_what_is_compiled_ahead_is_what_drawing_asks_for(degree, covariances, make_scene, pose):
    scene = make_scene(20, scale=0.15, degree=degree, seed=1).to(dtype=torch.float32)
    means = scene.means.clone().requires_grad_()
    drawn = rasterize(
        dataclasses.replace(scene, means=means),
        pose,
        size=(16, 32),
        backend="numba",
        covariances=scene.covariances if covariances else None,
    )
    drawn.color.sum().backward()
    for task in theirs(gradients=True):
        assert task.arguments in _signatures(task.module, task.name), task.name
    observed = [
        signature
        for signature in _signatures("observe", "_observe")
        if (str(signature[4]) != "none") == covariances and (str(signature[12]) != "none") == (degree > 0)
    ]
    (chain,) = ours(observed[0], gradients=True)
    assert len(observed) == 1 and chain.arguments in _signatures("observe_backward", "_chain")


def test_a_second_process_that_fails_is_not_waited_for(monkeypatch):
    failing = _brings(monkeypatch, "raise SystemExit(3)")
    assert failing.wait(lambda: None) is None
    assert not failing.running
    failing.stop()


def test_a_second_process_that_hangs_is_ended(monkeypatch):
    monkeypatch.setattr(beside, "_LONGEST", 0.1)
    hanging = _brings(monkeypatch, "import time; time.sleep(600)")
    assert hanging.wait(lambda: None) is None
    assert not hanging.running


def test_waiting_ends_when_the_kernel_is_there_though_the_process_goes_on(monkeypatch):
    busy, looks = _brings(monkeypatch, "import time; time.sleep(600)"), iter([None, None, "code"])
    assert busy.wait(lambda: next(looks)) == "code"
    assert busy.running
    busy.stop()


def test_what_is_left_to_the_first_process_is_compiled_once_before_it_waits(monkeypatch):
    done = []
    monkeypatch.setattr(beside, "compile_all", lambda work: done.extend(work))
    failing = _brings(monkeypatch, "raise SystemExit(3)", meanwhile=[_DEPTHS])
    assert done == []
    failing.wait(lambda: done.append("look"))
    assert done[0] == _DEPTHS and set(done[1:]) == {"look"}
    failing.wait(lambda: None)
    assert done.count(_DEPTHS) == 1
    failing.stop()


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="this system has no /proc")
def test_the_second_process_ends_with_the_first():
    parent = subprocess.run([sys.executable, "-c", _ABANDON], stdout=subprocess.PIPE, text=True)
    state, deadline = Path("/proc", parent.stdout.strip(), "status"), time.monotonic() + 60
    assert parent.returncode == -signal.SIGKILL and parent.stdout.strip()
    with contextlib.suppress(OSError):  # it has gone
        while "State:\tZ" not in state.read_text():  # or waits for somebody to clear it away
            assert time.monotonic() < deadline
            time.sleep(0.05)


@pytest.mark.parametrize(
    ("threads", "executable", "frozen", "expected"),
    [
        (2, "/usr/bin/python3", False, True),
        (1, "/usr/bin/python3", False, False),
        (2, "/usr/bin/python3", True, False),
        (2, "/opt/editor/bin/editor", False, False),
        (2, None, False, False),
    ],
)
def test_a_second_process_needs_a_second_thread_and_an_interpreter(threads, executable, frozen, expected, monkeypatch):
    monkeypatch.setattr(beside, "thread_count", lambda: threads)
    monkeypatch.setattr(sys, "executable", executable)
    monkeypatch.setattr(sys, "frozen", frozen, raising=False)
    assert possible() is expected


@pytest.fixture
def started(monkeypatch):
    """The lists of tasks that second processes were started for."""
    lists = []

    def start(work, meanwhile):
        lists.append([[task.name for task in part] for part in (work, meanwhile)])
        return SimpleNamespace(kernels=frozenset((task.module, task.name) for task in work), wait=lambda look: "waited")

    monkeypatch.setattr(beside, "Beside", start)
    monkeypatch.setattr(beside, "thread_count", lambda: 2)
    monkeypatch.setattr(compiling, "_second", None)
    return lists


_OBSERVED = tuple(range(18))  # in place of the types


@pytest.mark.parametrize("gradients", [False, True])
def test_the_first_kernel_that_is_missing_starts_the_second_process_once(gradients, started):
    with compiling.announced(gradients=gradients):
        assert compiling._load(("observe", "_observe"), lambda *_: None, _OBSERVED, None) is None
        assert compiling._load(("observe", "_observe"), lambda *_: None, _OBSERVED, None) is None
        assert compiling._load(("raster", "_draw_tiles"), lambda *_: None, (), None) == "waited"
        assert compiling._load(("boxes", "_panorama"), lambda *_: None, (), None) is None
    ((work, meanwhile),) = started
    assert {"_list", "_sort_tiles", "_draw_tiles"} < set(work)
    assert ("_walk_tiles" in work) == gradients
    assert meanwhile == (["_chain"] if gradients else [])


def test_no_second_process_is_started_for_kernels_on_disk_nor_outside_a_picture(started):
    with compiling.announced():
        assert compiling._load(("observe", "_observe"), lambda *_: "code", _OBSERVED, None) == "code"
        assert compiling._load(("boxes", "_panorama"), lambda *_: None, (), None) is None
    assert compiling._load(("observe", "_observe"), lambda *_: None, _OBSERVED, None) is None
    assert started == []


def test_where_no_process_can_be_had_everything_is_compiled_here(started, monkeypatch):
    def refuse(work, meanwhile):
        raise BlockingIOError("no more processes")

    monkeypatch.setattr(beside, "Beside", refuse)
    with compiling.announced():
        assert compiling._load(("observe", "_observe"), lambda *_: None, _OBSERVED, None) is None
    assert compiling._second is None


def test_tasks_can_be_told_to_another_process():
    work = theirs(gradients=True)
    assert pickle.loads(pickle.dumps(work)) == work
