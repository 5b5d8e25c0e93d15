"""Training reduces the loss, resumes bit-identically, and stops on errors and signals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from refusals import expect_error

from pansplat.inputs.views import Batch, Sample
from pansplat.networks.weights import load_weights
from pansplat.training import trainer
from pansplat.training.config import OptimizerConfig, TrainConfig, ValidationConfig
from pansplat.training.logs import read_table
from pansplat.training.rendering import TargetRenderer
from pansplat.training.trainer import Trainer
from pansplat.training.validation import describe_measures, validate


def curve(folder: Path) -> list[tuple[str, str, str]]:
    """Step, loss and gradient norm of every row, as written."""
    return [(row["step"], row["loss"], row["gradient_norm"]) for row in read_table(folder / "log.csv")]


def trained(config: TrainConfig) -> dict[str, torch.Tensor]:
    Trainer(config, silent=True).train()
    return load_weights(config.out / "model.safetensors").tensors


@pytest.mark.slow
def test_the_loss_decreases(micro_run: Callable) -> None:
    config = micro_run(steps=14, optimizer=OptimizerConfig(steps=14, batch_size=1, rate=5e-3))
    trained(config)
    losses = [float(loss) for _, loss, _ in curve(config.out)]
    assert sum(losses[-4:]) < 0.9 * sum(losses[:4])


class Killed(BaseException):
    """Simulates a kill."""


@pytest.mark.slow
def test_a_killed_run_resumes_bit_identically(micro_run: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    optimizer = OptimizerConfig(steps=6, batch_size=1, rate=1e-3, ema=0.9)
    whole, broken = micro_run("whole", optimizer=optimizer), micro_run("broken", optimizer=optimizer)
    expected = trained(whole)
    optimize = Trainer._optimize

    def killed(self: Trainer, batch: Batch) -> dict[str, float]:
        if self.step == 5:  # the last checkpoint is of step 4, and a row of step 4 has been written since
            raise Killed
        return optimize(self, batch)

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "_optimize", killed)
        with pytest.raises(Killed):
            Trainer(broken, silent=True).train()
    assert [row[0] for row in curve(broken.out)] == list("01234")
    found = trained(broken)
    assert curve(broken.out) == curve(whole.out)
    assert len(curve(whole.out)) == 6
    for name, tensor in expected.items():
        assert torch.equal(found[name], tensor), name


def test_a_loss_that_is_not_finite_stops_the_run_and_saves_the_batch(micro_run, sphere, monkeypatch) -> None:
    source = sphere(8, broken=frozenset(range(8)))
    monkeypatch.setattr(trainer, "load_sources", lambda *_: (source, source))
    config = micro_run()
    expect_error(r"step 0: needed finite numbers.*sphere_", lambda: Trainer(config, silent=True).train())
    (kept,) = config.out.glob("not_finite_*.pt")
    content = torch.load(kept, weights_only=True)
    assert content["batch"]["names"][0].startswith("sphere_")
    assert not torch.isfinite(content["batch"]["images"]).all()
    assert not list(config.out.glob("model.safetensors"))


@pytest.mark.slow
def test_a_sample_without_known_depth_is_left_out_of_the_depth_error(micro_run: Callable, sphere: type) -> None:
    class Source(sphere):
        def sample(self, index: int, height: int, seed: int) -> Sample:
            sample = super().sample(index, height, seed)
            depths = sample.context.depths * (1 if index in known else 1e6)
            return replace(sample, context=replace(sample.context, depths=depths))

    network = Trainer(micro_run(steps=1), silent=True).network

    def measure(samples: int) -> dict[str, float]:
        options = {"samples": samples, "pictures": 0, "tiles": 1, "folder": None, "name": ""}
        return validate(network, Source(), TargetRenderer("panorama", "joint", 32), **options)

    known = {0}
    first, both = measure(1), measure(2)
    assert both["depth_error"] == first["depth_error"] and both["psnr"] != first["psnr"]
    known = set()
    unknown = measure(2)
    assert math.isnan(unknown["depth_error"])
    assert "depth error" in describe_measures(first) and "depth error" not in describe_measures(unknown)


def test_validation_writes_measures_and_images(micro_run: Callable) -> None:
    config = micro_run(steps=2, validation=ValidationConfig(every=1, samples=2, pictures=1))
    trained(config)
    rows = read_table(config.out / "validation.csv")
    assert [row["step"] for row in rows] == ["0", "1", "2"]
    for measure in ("psnr", "depth_error"):  # each of another network
        assert len({row[measure] for row in rows} - {"nan"}) == 3
    assert len(list((config.out / "pictures").glob("*.png"))) == 3
    with Image.open(config.out / "curves.png") as curves:
        assert min(curves.size) > 300


@pytest.mark.slow
def test_the_height_grows_during_training(micro_run: Callable) -> None:
    config = micro_run(steps=2, heights=(32, 64), validation=ValidationConfig(every=1, samples=1, pictures=0))
    trained(config)
    assert [row["height"] for row in read_table(config.out / "validation.csv")] == ["32", "32", "64"]


def test_initial_weights_are_those_of_a_file(micro_run: Callable) -> None:
    config = micro_run(steps=2)
    final = trained(config)
    other = micro_run("other", network=replace(config.network, init=config.out / "model.safetensors"))
    initial = Trainer(other, silent=True).network.state_dict()
    assert all(torch.equal(initial[name], tensor) for name, tensor in final.items())
