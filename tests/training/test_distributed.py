"""Two processes learn what one does from the joint batch; each has its device, and one writes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pansplat.errors import InputError
from pansplat.training.config import TrainConfig
from pansplat.training.distributed import ProcessGroup, data_parallel, no_sync
from pansplat.training.trainer import Trainer

_FOLDER = Path(__file__).parent


def _launch(count: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program in that many processes, which torchrun starts if there is more than one."""
    torchrun = ("-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}")
    done = subprocess.run(
        [sys.executable, *(torchrun if count > 1 else ()), *arguments],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def test_two_processes_have_the_gradients_of_one_with_the_joint_batch(tmp_path: Path) -> None:
    for count in (1, 2):
        _launch(count, str(_FOLDER / "two_processes.py"), str(tmp_path))
    whole, first, second = (torch.load(tmp_path / f"{name}.pt") for name in ("1_0", "2_0", "2_1"))
    assert any("norm" in name and "running" in name for name in whole)
    for way in ("plain 1", "plain 2", "two-step 1", "two-step 2"):
        assert {f"{way} features.", f"{way} heads."} <= {name[: name.find(".") + 1] for name in whole}
    assert whole.keys() == first.keys() == second.keys()
    for name, wanted in whole.items():
        scale = float(wanted.abs().max())
        torch.testing.assert_close(first[name], wanted, rtol=1e-7, atol=1e-9 * scale + 1e-15, msg=name)
        torch.testing.assert_close(second[name], first[name], rtol=0, atol=0)


def test_each_step_sums_alike_however_its_gradients_come(tmp_path: Path) -> None:
    _launch(3, str(_FOLDER / "three_processes.py"), str(tmp_path))
    read = {path.stem: torch.load(path) for path in tmp_path.iterdir()}
    for name, wanted in read["joint"].items():
        scale = float(wanted.abs().max())
        for step in ("0_0", "2_0"):
            torch.testing.assert_close(read[step][name], wanted, rtol=1e-5, atol=1e-6 * scale)
        apart = torch.stack([read[f"apart_{rank}"][name] for rank in range(3)])
        assert not torch.equal(apart[0], apart[1])
        torch.testing.assert_close(apart.mean(0), wanted, rtol=1e-5, atol=1e-6 * scale)
        # The first step after a start is a later one of the run that goes on: they must agree to the bit.
        assert torch.equal(read["0_0"][name], read["1_0"][name])
        for rank in (1, 2):
            for step in range(3):
                assert torch.equal(read[f"{step}_{rank}"][name], read[f"{step}_0"][name])
    assert not read["0_0"]["idle.weight"].any()


def test_one_process_learns_without_the_others() -> None:
    lessons, alone = torch.nn.Linear(2, 2), ProcessGroup()
    assert data_parallel(lessons, alone) is lessons
    with no_sync(lessons):
        lessons(torch.ones(2)).sum().backward()
    assert lessons.weight.grad is not None and not torch.distributed.is_initialized()


def test_torchrun_trains_and_only_the_first_process_writes(tmp_path: Path) -> None:
    out = tmp_path / "run"
    settings = ("--optimizer.steps", "2", "--optimizer.batch-size", "1", "--data.workers", "0", "--device", "cpu")
    done = _launch(2, "-m", "pansplat.training", "tiny", "--out", str(out), "--validation.every", "0", *settings)
    assert done.stderr.count("2 process(es), from step 0 of 2") == 1
    rows = (out / "log.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["step", "0", "1"]
    written = {
        str(path.relative_to(out)) for path in out.rglob("*") if path.is_file() and "tensorboard" not in str(path)
    }
    assert written == {
        *("config.json", "log.csv", "validation.csv", "model.safetensors"), "checkpoints/step_00000002.pt"
    }  # fmt: skip


def test_the_first_process_alone_writes_a_checkpoint(
    micro_run: Callable[..., TrainConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    config, second = micro_run(), ProcessGroup()
    second.rank = 1
    Trainer(config, second, silent=True).save()
    assert not list(config.out.rglob("*"))
    Trainer(config, silent=True).save()
    assert [path.name for path in config.out.rglob("*.pt")] == ["step_00000000.pt"]


def test_each_process_of_a_machine_has_its_own_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for rank, place in ((0, 0), (3, 1)):
        _started(monkeypatch, WORLD_SIZE="4", RANK=str(rank), LOCAL_RANK=str(place))
        assert ProcessGroup().device("auto") == torch.device("cuda", place)
        assert ProcessGroup().device("cpu") == torch.device("cpu")
    _started(monkeypatch, WORLD_SIZE="4", RANK="2", LOCAL_RANK="2")
    with pytest.raises(InputError, match=r"got 2 for process 3; start 2 with --nproc-per-node"):
        ProcessGroup().device("auto")


def test_processes_with_cuda_meet_by_nccl_on_their_device(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(torch.cuda, "set_device", asked.append)
    monkeypatch.setattr(torch.distributed, "init_process_group", lambda kind, timeout: asked.append(kind))
    _started(monkeypatch, WORLD_SIZE="2", RANK="1", LOCAL_RANK="1")
    ProcessGroup().initialize(torch.device("cuda", 1))
    ProcessGroup().initialize(torch.device("cpu"))
    assert asked == [torch.device("cuda", 1), "nccl", "gloo"]


@pytest.mark.parametrize(
    ("environment", "told"),
    [
        ({"WORLD_SIZE": "two"}, "needed a number in the environment variable WORLD_SIZE, got 'two'"),
        ({"WORLD_SIZE": "2"}, "needed a number in the environment variable RANK, got ''"),
        ({"WORLD_SIZE": "2", "RANK": "2", "LOCAL_RANK": "0"}, "RANK must be below WORLD_SIZE, got 2 of 2"),
    ],
)
def test_an_environment_that_contradicts_itself_is_refused(
    environment: dict[str, str], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _started(monkeypatch, **environment)
    with pytest.raises(InputError, match=told):
        ProcessGroup()


def test_processes_that_cannot_meet_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    _started(monkeypatch, WORLD_SIZE="2", RANK="0", LOCAL_RANK="0")
    for name in ("MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match=r"process 0 of 2 could not connect to the others by gloo .*MASTER_ADDR"):
        ProcessGroup().initialize(torch.device("cpu"))


def _started(monkeypatch: pytest.MonkeyPatch, **environment: str) -> None:
    """The environment as a launcher left it."""
    for name in ("WORLD_SIZE", "RANK", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
