"""Checkpoints are written atomically, and code in them is never executed."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from refusals import expect_error

from pansplat.errors import InputError
from pansplat.networks.weights import UnsafeCheckpointError, WeightsFile, save_weights
from pansplat.training.checkpoint import list_checkpoints, load_checkpoint, load_latest, save_checkpoint

_WRITER = """
import sys, torch
from pathlib import Path
from pansplat.training.checkpoint import save_checkpoint
state = {"network": {"weight": torch.zeros(500_000)}}
step = int(sys.argv[2])
while True:
    step += 1
    state["network"]["weight"].fill_(step)
    save_checkpoint(Path(sys.argv[1]), step, state, keep=2)
    print(step, flush=True)
"""


def state(value: float = 1.0, count: int = 4) -> dict[str, object]:
    return {"network": {"weight": torch.full((count,), value)}}


@pytest.mark.slow
def test_a_kill_at_any_time_leaves_a_readable_checkpoint(tmp_path: Path) -> None:
    first = 0
    for number in range(2):
        command = [sys.executable, "-c", _WRITER, str(tmp_path), str(first)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            written = int(child.stdout.readline())
            time.sleep(0.01 + 0.023 * number)
            child.send_signal(signal.SIGKILL)
            written = max([written, *map(int, child.stdout.read().split())])
        found = load_latest(tmp_path)
        assert found is not None
        first = found[1]["step"]
        assert first >= written
        assert found[1]["network"]["weight"].eq(first).all()
        assert {path.suffix for path in tmp_path.iterdir()} == {".pt"}
        assert not list(tmp_path.glob(".step_*"))


def test_a_full_disk_is_an_error_and_keeps_the_older_file(tmp_path: Path, full_disk: Callable) -> None:
    weights = WeightsFile("pansplat", {}, "fixed", {"a": torch.zeros(100_000)})
    save_checkpoint(tmp_path, 1, state(), keep=1)
    with full_disk(100_000):
        expect_error("step_00000002.pt", lambda: save_checkpoint(tmp_path, 2, state(count=1_000_000), keep=1))
        expect_error("free disk space", save_weights, tmp_path / "m.safetensors", weights)
    found = load_latest(tmp_path)
    assert found is not None and found[1]["step"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["step_00000001.pt"]


def test_no_readable_checkpoint_is_an_error(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, 1, state(), keep=1).write_bytes(b"nothing")
    with pytest.warns(UserWarning, match="skipped"), pytest.raises(InputError, match="got none"):
        load_latest(tmp_path)
    assert load_latest(tmp_path / "nowhere") is None


class Malicious:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("kind", ["zip", "pickle"])
def test_a_checkpoint_with_code_is_refused_and_not_executed(kind: str, tmp_path: Path) -> None:
    marker, path = tmp_path / "ran", tmp_path / "step_00000001.pt"
    content = {"kind": "pansplat-training", "network": Malicious(marker)}
    if kind == "zip":
        torch.save(content, path)
    else:
        path.write_bytes(pickle.dumps(content, protocol=2))
    with pytest.raises(UnsafeCheckpointError):
        load_checkpoint(path)
    with pytest.raises(UnsafeCheckpointError):
        load_latest(tmp_path)
    assert not marker.exists()


def test_only_the_newest_checkpoints_are_kept(tmp_path: Path) -> None:
    for step in range(5):
        save_checkpoint(tmp_path, step, state(), keep=2)
    assert [path.name for path in list_checkpoints(tmp_path)] == ["step_00000003.pt", "step_00000004.pt"]


def test_other_files_are_refused(tmp_path: Path) -> None:
    torch.save({"state_dict": {}}, tmp_path / "other.pt")
    expect_error("needed a checkpoint of pansplat-train", load_checkpoint, tmp_path / "other.pt")
