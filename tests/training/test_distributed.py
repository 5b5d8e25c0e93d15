"""Several processes have the gradients of one process with the joint batch; each has a device, and one writes files."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from pansplat.errors import InputError
from pansplat.training import step as step_module
from pansplat.training.distributed import ProcessGroup, data_parallel, no_sync
from pansplat.training.step import LOSS_TERMS, accumulate_gradients
from pansplat.training.trainer import Trainer

_PROGRAMS = str(Path(__file__).with_name("distributed_programs.py"))


def _launch(program: str, folder: Path, count: int) -> None:
    """Run a program of distributed_programs.py in `count` processes."""
    with socket.create_server(("localhost", 0)) as server:
        port = server.getsockname()[1]
    shared = {"OMP_NUM_THREADS": "1", "MASTER_ADDR": "localhost", "MASTER_PORT": str(port), "WORLD_SIZE": str(count)}
    children = [
        subprocess.Popen(
            [sys.executable, _PROGRAMS, program, str(folder)],
            env=os.environ | shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(count)
    ]
    errors = [child.communicate(timeout=300)[1] for child in children]
    assert not any(child.returncode for child in children), errors


@pytest.mark.slow
def test_two_processes_have_the_gradients_of_one_process_with_the_joint_batch(tmp_path: Path) -> None:
    for count in (1, 2):
        _launch("split_batches", tmp_path, count)
    joint, first, second = (torch.load(tmp_path / f"{name}.pt") for name in ("1_0", "2_0", "2_1"))
    assert any("norm" in name and "running" in name for name in joint)
    for method in ("plain 1", "plain 2", "two-step 1", "two-step 2"):
        assert {f"{method} features.", f"{method} heads."} <= {name[: name.find(".") + 1] for name in joint}
    assert joint.keys() == first.keys() == second.keys()
    for name, expected in joint.items():
        scale = float(expected.abs().max())
        torch.testing.assert_close(first[name], expected, rtol=1e-7, atol=1e-9 * scale + 1e-15, msg=name)
        torch.testing.assert_close(second[name], first[name], rtol=0, atol=0)


@pytest.mark.slow
def test_every_step_sums_gradients_in_the_same_order(tmp_path: Path) -> None:
    _launch("repeated_steps", tmp_path, 3)
    read = {path.stem: torch.load(path) for path in tmp_path.iterdir()}
    for name, expected in read["joint"].items():
        scale = float(expected.abs().max())
        for step in ("0_0", "2_0"):
            torch.testing.assert_close(read[step][name], expected, rtol=1e-5, atol=1e-6 * scale)
        local = torch.stack([read[f"local_{rank}"][name] for rank in range(3)])
        assert not torch.equal(local[0], local[1])
        torch.testing.assert_close(local.mean(0), expected, rtol=1e-5, atol=1e-6 * scale)
        # The first step of a resumed run is a later step of the uninterrupted run: they must be bit-identical.
        assert torch.equal(read["0_0"][name], read["1_0"][name])
        for rank in (1, 2):
            for step in range(3):
                assert torch.equal(read[f"{step}_{rank}"][name], read[f"{step}_0"][name])
    assert not read["0_0"]["unused.weight"].any()


def test_a_single_process_needs_no_process_group() -> None:
    step, alone = torch.nn.Linear(2, 2), ProcessGroup()
    assert data_parallel(step, alone) is step
    with no_sync(step):
        step(torch.ones(2)).sum().backward()
    assert step.weight.grad is not None and not torch.distributed.is_initialized()


class OneWeight(torch.nn.Module):
    """A loss of weight times batch."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(()))

    def forward(self, batch: float, weight: float) -> tuple[torch.Tensor, dict[str, float]]:
        loss = self.weight * batch
        return weight * loss, {**dict.fromkeys(LOSS_TERMS, 0.0), "loss": loss.item()}


def test_only_the_last_batch_of_a_step_is_synchronised(monkeypatch: pytest.MonkeyPatch) -> None:
    local: list[bool] = []
    module = OneWeight()

    @contextmanager
    def record(wrapped: torch.nn.Module) -> Iterator[None]:
        assert wrapped is module
        hook = module.weight.register_hook(lambda _: local.append(True))
        yield
        hook.remove()

    monkeypatch.setattr(step_module, "no_sync", record)
    terms = accumulate_gradients(module, [1.0, 2.0, 6.0])
    assert len(local) == 2
    assert terms["loss"] == pytest.approx(3.0)
    assert module.weight.grad is not None and float(module.weight.grad) == pytest.approx(3.0)


@pytest.mark.slow
def test_torchrun_trains_and_only_the_first_process_writes(tmp_path: Path) -> None:
    out = tmp_path / "run"
    settings = ("--optimizer.steps", "1", "--optimizer.batch-size", "1", "--data.workers", "0", "--device", "cpu")
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", "pansplat.training", "tiny")
    done = subprocess.run(
        [sys.executable, *torchrun, "--out", str(out), "--validation.every", "0", *settings],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr.count("2 process(es), from step 0 of 1") == 1
    rows = (out / "log.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["step", "0"]
    written = {
        str(path.relative_to(out)) for path in out.rglob("*") if path.is_file() and "tensorboard" not in str(path)
    }
    assert written == {
        *("config.json", "log.csv", "validation.csv", "model.safetensors"), "checkpoints/step_00000001.pt"
    }  # fmt: skip


def test_only_the_first_process_writes_checkpoints(micro_run: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
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
        _set_environment(monkeypatch, WORLD_SIZE="4", RANK=str(rank), LOCAL_RANK=str(place))
        assert ProcessGroup().device("auto") == torch.device("cuda", place)
        assert ProcessGroup().device("cpu") == torch.device("cpu")
    _set_environment(monkeypatch, WORLD_SIZE="4", RANK="2", LOCAL_RANK="2")
    with pytest.raises(InputError, match=r"got 2 for process 3; start 2 with --nproc-per-node"):
        ProcessGroup().device("auto")


def test_cuda_processes_use_nccl(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[object] = []
    monkeypatch.setattr(torch.cuda, "set_device", calls.append)
    monkeypatch.setattr(torch.distributed, "init_process_group", lambda kind, timeout: calls.append(kind))
    _set_environment(monkeypatch, WORLD_SIZE="2", RANK="1", LOCAL_RANK="1")
    ProcessGroup().initialize(torch.device("cuda", 1))
    ProcessGroup().initialize(torch.device("cpu"))
    assert calls == [torch.device("cuda", 1), "nccl", "gloo"]


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"WORLD_SIZE": "two"}, "needed a number in the environment variable WORLD_SIZE, got 'two'"),
        ({"WORLD_SIZE": "2"}, "needed a number in the environment variable RANK, got ''"),
        ({"WORLD_SIZE": "2", "RANK": "2", "LOCAL_RANK": "0"}, "RANK must be below WORLD_SIZE, got 2 of 2"),
    ],
)
def test_an_inconsistent_environment_is_refused(
    environment: dict[str, str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _set_environment(monkeypatch, **environment)
    with pytest.raises(InputError, match=message):
        ProcessGroup()


def test_failed_initialisation_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    _set_environment(monkeypatch, WORLD_SIZE="2", RANK="0", LOCAL_RANK="0")
    for name in ("MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match=r"process 0 of 2 could not connect to the others by gloo .*MASTER_ADDR"):
        ProcessGroup().initialize(torch.device("cpu"))


def _set_environment(monkeypatch: pytest.MonkeyPatch, **environment: str) -> None:
    for name in ("WORLD_SIZE", "RANK", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
