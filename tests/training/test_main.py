"""The `pansplat-train` command: help, refusals, messages and exit status."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pansplat.training import __main__ as command
from pansplat.training.__main__ import run
from pansplat.training.config import CheckpointConfig
from pansplat.training.trainer import Trainer

_SHORT = ("--optimizer.steps", "40", "--optimizer.batch-size", "1", "--data.workers", "1", "--validation.every", "0")


def test_a_missing_device_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert run(["tiny", "--device", "cuda"]) == 2
    assert "error: --device cuda needs a CUDA device" in capsys.readouterr().err


def test_a_folder_of_data_that_is_missing_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = ["--data.kind", "triplets", "--data.root", str(tmp_path / "nowhere"), "--data.workers", "0"]
    assert run(["tiny", "--out", str(tmp_path / "run"), *data, "--perceptual", "structure", "--device", "cpu"]) == 2
    assert f"error: {tmp_path / 'nowhere'}: needed" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.pt"))


def test_out_of_memory_is_an_error_with_advice(micro_run, monkeypatch, capsys) -> None:
    def full(self: Trainer, batches: list) -> dict[str, float]:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 10 bytes")

    monkeypatch.setattr(Trainer, "_optimize", full)
    monkeypatch.setattr(command, "parse", lambda argv: micro_run())
    assert run([]) == 2
    assert "--memory.backpropagation two-step" in capsys.readouterr().err


@pytest.mark.slow
def test_the_same_command_resumes_a_stopped_run(micro_run, monkeypatch, capsys) -> None:
    config = micro_run(steps=2, checkpoint=CheckpointConfig(every=0))
    monkeypatch.setattr(command, "parse", lambda argv: config)
    optimize = Trainer._optimize

    def interrupted(self: Trainer, batches: list) -> dict[str, float]:
        os.kill(os.getpid(), signal.SIGINT)
        return optimize(self, batches)

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "_optimize", interrupted)
        assert run([]) == 130
    output = capsys.readouterr().err
    assert "stopped after step 1; run the same command to resume" in output
    assert "resuming from" not in output
    assert run([]) == 0
    output = capsys.readouterr().err
    assert "resuming from" in output and "step_00000001.pt" in output and "from step 1 of 2" in output
    assert "done: " in output and "model.safetensors" in output
    assert len((config.out / "log.csv").read_text().splitlines()) == 3
    with monkeypatch.context() as patched:
        patched.setattr(command, "parse", lambda argv: replace(config, optimizer=replace(config.optimizer, steps=3)))
        assert run([]) == 2
    assert "optimizer.steps was 2, now 3" in capsys.readouterr().err


@pytest.mark.exhaustive
@pytest.mark.slow
def test_ctrl_c_in_a_terminal_saves_without_a_traceback(tmp_path: Path) -> None:
    """A terminal sends the signal to the whole process group, including the data workers."""
    arguments = ["tiny", "--out", str(tmp_path / "run"), *_SHORT]
    with subprocess.Popen(
        [sys.executable, "-m", "pansplat.training", *arguments],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as child:
        assert child.stderr is not None
        output = ""
        while "step 1 of 40" not in output:
            line = child.stderr.readline()
            assert line, output
            output += line
        os.killpg(child.pid, signal.SIGINT)
        output += child.stderr.read()
    assert child.returncode == 130, output
    assert "Traceback" not in output, output
    assert "run the same command to resume" in output
    assert list((tmp_path / "run" / "checkpoints").glob("step_*.pt"))
