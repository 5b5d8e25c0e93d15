"""`pansplat-train` as it is typed: what it lists, refuses, says and leaves behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pansplat.training import __main__ as command
from pansplat.training.__main__ import parse, run
from pansplat.training.config import PRESETS, TrainConfig
from pansplat.training.trainer import Trainer

_SHORT = ("--optimizer.steps", "40", "--optimizer.batch-size", "1", "--data.workers", "1", "--validation.every", "0")


def test_help_lists_every_preset(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        parse(["--help"])
    told = capsys.readouterr().out
    assert done.value.code == 0
    assert all(name in told for name in PRESETS)


def test_help_of_a_preset_lists_its_settings(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        parse(["pansplat-2048", "--help"])
    told = capsys.readouterr().out
    assert done.value.code == 0
    assert "--memory.tiles" in told and "(default: 4)" in told


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "tiny"),
        (["gigantic"], "gigantic"),
        (["tiny", "--optimizer.stepps", "3"], "--optimizer.steps"),
        (["tiny", "--optimizer.steps", "many"], "--optimizer.steps"),
        (["tiny", "--memory.backpropagation", "three-step"], "two-step"),
    ],
)
def test_what_cannot_be_read_is_refused_with_what_could(
    arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as done:
        run(arguments)
    assert done.value.code == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["tiny", "--optimizer.steps", "0"], "--optimizer.steps must be at least 1, got 0"),
        (["tiny", "--heights", "32"], "--heights must be 64 pixels or more"),
        (["tiny", "--data.kind", "triplets"], "--data.kind triplets needs --data.root"),
        (["tiny", "--data.kind", "triplets", "--data.root", "nowhere"], "nowhere"),
        (["pansplat-256", "--data.root", "nowhere"], "--network.init"),
        (["tiny", "--network.init", "none.safetensors"], "none.safetensors"),
    ],
)
def test_settings_that_cannot_be_trained_are_errors_without_a_traceback(
    arguments: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run([*arguments, "--data.workers", "0", "--device", "cpu", "--perceptual", "structure"]) == 2
    said = capsys.readouterr().err
    assert "error: " in said and told in said
    assert not list(tmp_path.rglob("*.pt"))


def test_a_device_that_is_not_there_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert run(["tiny", "--device", "cuda"]) == 2
    assert "error: --device cuda needs a CUDA device" in capsys.readouterr().err


def test_too_little_memory_is_told_with_what_to_do(
    micro_run: Callable[..., TrainConfig], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: Trainer, batches: list) -> dict[str, float]:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 10 bytes")

    monkeypatch.setattr(Trainer, "_optimize", full)
    monkeypatch.setattr(command, "parse", lambda argv: micro_run())
    assert run([]) == 2
    assert "--memory.backpropagation two-step" in capsys.readouterr().err


def test_the_same_command_goes_on_and_says_from_where(
    micro_run: Callable[..., TrainConfig], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "parse", lambda argv: micro_run(steps=2))
    learn = Trainer._optimize

    def interrupted(self: Trainer, batches: list) -> dict[str, float]:
        os.kill(os.getpid(), signal.SIGINT)
        return learn(self, batches)

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "_optimize", interrupted)
        assert run([]) == 130
    said = capsys.readouterr().err
    assert "stopped after step 1; run the same command to resume" in said
    assert "resuming from" not in said
    assert run([]) == 0
    said = capsys.readouterr().err
    assert "resuming from" in said and "step_00000001.pt" in said and "from step 1 of 2" in said
    assert "done: " in said and "model.safetensors" in said
    with monkeypatch.context() as patched:
        patched.setattr(command, "parse", lambda argv: micro_run(steps=3))
        assert run([]) == 2
    assert "optimizer.steps was 2, now 3" in capsys.readouterr().err


def test_ctrl_c_in_a_terminal_saves_and_shows_no_traceback(tmp_path: Path) -> None:
    """The signal reaches the whole group of processes there, those that read the data too."""
    arguments = ["tiny", "--out", str(tmp_path / "run"), *_SHORT]
    with subprocess.Popen(
        [sys.executable, "-m", "pansplat.training", *arguments],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as child:
        assert child.stderr is not None
        said = ""
        while "step 1 of 40" not in said:
            line = child.stderr.readline()
            assert line, said
            said += line
        os.killpg(child.pid, signal.SIGINT)
        said += child.stderr.read()
    assert child.returncode == 130, said
    assert "Traceback" not in said, said
    assert "run the same command to resume" in said
    assert list((tmp_path / "run" / "checkpoints").glob("step_*.pt"))
