"""A damaged training checkpoint is named by its key, and the run resumes from the previous one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import expect_error

from pansplat.errors import InputError
from pansplat.training import trainer as trainer_module
from pansplat.training.config import OptimizerConfig, TrainConfig, ValidationConfig, as_json
from pansplat.training.trainer import Trainer

_DAMAGE: dict[str, tuple[str, Callable[[dict[str, Any]], Any]]] = {
    "no step": ("step", lambda c: c.pop("step")),
    "a step of 400 digits": ("step", lambda c: c.update(step=10**400)),
    "no settings": ("config", lambda c: c.pop("config")),
    "settings that are not JSON": ("config", lambda c: c.update(config="{")),
    "settings of a list": ("config", lambda c: c.update(config="[]")),
    "settings nested 100,000 deep": ("config", lambda c: c.update(config="[" * 100_000)),
    "no network": ("network", lambda c: c.pop("network")),
    "a network without a tensor": ("network", lambda c: c["network"].pop(next(iter(c["network"])))),
    "a network of other shapes": ("network", lambda c: c["network"].update({next(iter(c["network"])): torch.zeros(7)})),
    "no average": ("mean", lambda c: c.pop("mean")),
    "an average without a tensor": ("mean", lambda c: c["mean"].pop(next(iter(c["mean"])))),
    "an average of other shapes": ("mean", lambda c: c["mean"].update({next(iter(c["mean"])): torch.zeros(7)})),
    "no optimiser": ("optimizer", lambda c: c.pop("optimizer")),
    "an optimiser without groups": ("optimizer", lambda c: c["optimizer"].pop("param_groups")),
    "an optimiser of another network": ("optimizer", lambda c: c["optimizer"]["param_groups"][0].update(params=[0])),
    "moments of another shape": ("optimizer", lambda c: c["optimizer"]["state"][0].update(exp_avg=torch.zeros(7, 7))),
    "no random state": ("random", lambda c: c.pop("random")),
    "a random state of another size": ("random", lambda c: c.update(random=torch.zeros(3, dtype=torch.uint8))),
}


@pytest.fixture(scope="module")
def few_tensors(small_config: Any) -> Any:
    """The small config without the U-Nets of the cost volume: thousands of tensors would be read in each test."""
    cost_volume = dataclasses.replace(small_config.cost_volume, refinement="none")
    return dataclasses.replace(small_config, cost_volume=cost_volume)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory, few_tensors: Any) -> tuple[Path, TrainConfig]:
    """The first checkpoint of a run of a small network."""
    patch = pytest.MonkeyPatch()
    patch.setattr("pansplat.training.network.network_config", lambda shape: few_tensors)
    config = TrainConfig(
        out=tmp_path_factory.mktemp("run"),
        heights=(64,),
        perceptual="structure",
        device="cpu",
        network=TrainConfig().network.__class__(shape="tiny"),
        optimizer=OptimizerConfig(steps=2, batch_size=1, ema=0.9),
        validation=ValidationConfig(every=0),
    )
    trainer = Trainer(config, silent=True)
    for parameter in trainer.network.parameters():
        parameter.grad = torch.ones_like(parameter)
    trainer.optimizer.step()
    trainer.save()
    patch.undo()
    return config.out / "checkpoints" / "step_00000000.pt", config


@pytest.fixture
def resume(
    checkpoint: tuple[Path, TrainConfig], tmp_path: Path, few_tensors: Any, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Trainer]:
    """A function that resumes a run from copies of the checkpoint, the last of which is damaged."""
    monkeypatch.setattr("pansplat.training.network.network_config", lambda shape: few_tensors)
    good, config = checkpoint
    folder = tmp_path / "checkpoints"
    folder.mkdir()

    def start(damage: Callable[[dict[str, Any]], Any], *, previous: bool) -> Trainer:
        content = torch.load(good, weights_only=True)
        if previous:
            torch.save(content | {"step": 1}, folder / "step_00000001.pt")
        damage(content)
        torch.save(content, folder / "step_00000002.pt")
        return Trainer(trainer_module.TrainConfig(**{**vars(config), "out": tmp_path}), silent=True)

    return start


@pytest.mark.parametrize("name", _DAMAGE)
def test_a_damaged_checkpoint_names_its_key_and_the_previous_one_is_used(
    name: str, resume: Callable[..., Trainer]
) -> None:
    key, damage = _DAMAGE[name]
    message = rf"step_00000002\.pt: this checkpoint is damaged.*{key}.*the previous one is .*step_00000001\.pt"
    with pytest.warns(UserWarning, match=message):
        trainer = resume(damage, previous=True)
    assert trainer.step == 1 and trainer.resumed_from is not None and trainer.resumed_from.name == "step_00000001.pt"


def test_a_run_with_one_damaged_checkpoint_only_is_refused(resume: Callable[..., Trainer]) -> None:
    with (
        pytest.warns(UserWarning, match="there is no previous one"),
        pytest.raises(InputError, match=r"needed a readable checkpoint.*key `step`"),
    ):
        resume(_DAMAGE["no step"][1], previous=False)


def test_other_settings_are_not_a_damage(resume: Callable[..., Trainer], checkpoint: tuple[Path, TrainConfig]) -> None:
    other = as_json(checkpoint[1]).replace('"seed": 111123', '"seed": 7')
    expect_error(r"seed was 7", lambda: resume(lambda content: content.update(config=other), previous=True))
