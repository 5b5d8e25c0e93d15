"""Checkpoints are written atomically, and code in them is never executed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import expect_error

from pansplat.networks.weights import WeightsFile, save_weights
from pansplat.training.checkpoint import list_checkpoints, load_checkpoint, load_latest, save_checkpoint
from pansplat.training.trainer import Trainer

_WRITER = """
import sys, torch
from pathlib import Path
from pansplat.training.checkpoint import save_checkpoint
state = {"network": {"weight": torch.zeros(500_000)}}
step = 0
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
    command = [sys.executable, "-c", _WRITER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        written = int(child.stdout.readline())
        time.sleep(0.023)
        child.send_signal(signal.SIGKILL)
        written = max([written, *map(int, child.stdout.read().split())])
    found = load_latest(tmp_path)
    assert found is not None and found[1]["step"] >= written
    assert found[1]["network"]["weight"].eq(found[1]["step"]).all()
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


def test_a_checkpoint_with_code_is_an_error(tmp_path: Path) -> None:
    torch.save({"kind": "pansplat-training", "network": os.mkdir}, tmp_path / "step_00000001.pt")
    expect_error(r"calls .*mkdir", load_latest, tmp_path)


_DAMAGE: dict[str, tuple[str, Callable[[dict[str, Any]], Any]]] = {
    "no step": ("step", lambda c: c.pop("step")),
    "a step of 400 digits": ("step", lambda c: c.update(step=10**400)),
    "settings nested 100,000 deep": ("config", lambda c: c.update(config="[" * 100_000)),
    "a network without a tensor": ("network", lambda c: c["network"].popitem()),
    "an average of other shapes": ("mean", lambda c: c["mean"].update({next(iter(c["mean"])): torch.zeros(7)})),
    "an optimiser of another network": ("optimizer", lambda c: c["optimizer"]["param_groups"][0].update(params=[0])),
    "moments of another shape": ("optimizer", lambda c: c["optimizer"]["state"][0].update(exp_avg=torch.zeros(7, 7))),
    "a random state of another size": ("random", lambda c: c.update(random=torch.zeros(3, dtype=torch.uint8))),
}


@pytest.mark.parametrize("name", _DAMAGE)
def test_a_damaged_checkpoint_names_its_key_and_the_previous_one(name: str, micro_run: Callable) -> None:
    (key, damage), config = _DAMAGE[name], micro_run()
    trainer = Trainer(config, silent=True)
    for parameter in trainer.network.parameters():
        parameter.grad = torch.ones_like(parameter)
    trainer.optimizer.step()
    trainer.save()
    first, second = (config.out / "checkpoints" / f"step_0000000{step}.pt" for step in (0, 2))
    content = torch.load(first, weights_only=True)
    damage(content)
    torch.save(content, second)
    message = rf"{second.name}: this checkpoint is damaged.*{key}.*delete it to resume from .*{first.name}"
    expect_error(message, Trainer, config, silent=True)
    second.unlink()
    assert Trainer(config, silent=True).resumed_from == first


def test_only_the_newest_checkpoints_are_kept(tmp_path: Path) -> None:
    for step in range(5):
        save_checkpoint(tmp_path, step, state(), keep=2)
    assert [path.name for path in list_checkpoints(tmp_path)] == ["step_00000003.pt", "step_00000004.pt"]


def test_other_files_are_refused(tmp_path: Path) -> None:
    torch.save({"state_dict": {}}, tmp_path / "other.pt")
    expect_error("needed a checkpoint of pansplat-train", load_checkpoint, tmp_path / "other.pt")
