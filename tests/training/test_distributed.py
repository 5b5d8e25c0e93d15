"""Several processes have the gradients of one process with the joint batch; each has a device, and one writes files."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from pansplat.errors import InputError
from pansplat.training import step as step_module
from pansplat.training.distributed import ProcessGroup, data_parallel, no_sync
from pansplat.training.step import LOSS_TERMS, accumulate_gradients

_PROGRAMS = Path(__file__).with_name("distributed_programs.py")
COUNT = 3


@dataclass(frozen=True)
class Launched:
    """The folder that the processes wrote into, and what each printed."""

    folder: Path
    messages: list[str]


@pytest.fixture(scope="module")
def launched(tmp_path_factory: pytest.TempPathFactory) -> Launched:
    """The programs after their run in three processes, with the environment that torchrun gives them."""
    folder = tmp_path_factory.mktemp("distributed")
    with socket.create_server(("localhost", 0)) as server:
        port = server.getsockname()[1]
    shared = {"OMP_NUM_THREADS": "1", "MASTER_ADDR": "localhost", "MASTER_PORT": str(port), "WORLD_SIZE": str(COUNT)}
    children = [
        subprocess.Popen(
            [sys.executable, _PROGRAMS, folder],
            env=os.environ | shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(COUNT)
    ]
    messages = [child.communicate(timeout=600)[1] for child in children]
    assert not any(child.returncode for child in children), messages
    return Launched(folder, messages)


@pytest.mark.exhaustive
@pytest.mark.slow
def test_processes_have_the_gradients_of_one_process_with_the_joint_batch(launched: Launched) -> None:
    spec = importlib.util.spec_from_file_location("distributed_programs", _PROGRAMS)
    programs = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(programs)
    joint = programs.split_batches(ProcessGroup())
    first, *others = (torch.load(launched.folder / f"split_{rank}.pt") for rank in range(COUNT))
    assert any("norm" in name and "running" in name for name in joint)
    for method in ("plain", "two-step"):
        assert {f"{method} features.", f"{method} heads."} <= {name[: name.find(".") + 1] for name in joint}
    assert joint.keys() == first.keys()
    for name, expected in joint.items():
        scale = float(expected.abs().max())
        torch.testing.assert_close(first[name], expected, rtol=1e-7, atol=1e-9 * scale + 1e-15, msg=name)
        assert all(torch.equal(other[name], first[name]) for other in others)


@pytest.mark.exhaustive
@pytest.mark.slow
def test_only_the_first_process_of_a_run_writes_files_and_messages(launched: Launched) -> None:
    out = launched.folder / "run"
    assert launched.messages[0].count("3 process(es), from step 0 of 1") == 1
    assert not any("process(es)" in message for message in launched.messages[1:])
    rows = (out / "log.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["step", "0"]
    written = {
        str(path.relative_to(out)) for path in out.rglob("*") if path.is_file() and "tensorboard" not in str(path)
    }
    assert written == {
        *("config.json", "log.csv", "validation.csv", "model.safetensors"), "checkpoints/step_00000001.pt"
    }  # fmt: skip


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
