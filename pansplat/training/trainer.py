"""The training loop: batches, optimiser steps, validation, checkpoints, and exact resumption.

Step n is determined by the settings, the seed, n, and the state in the checkpoint: weights, optimiser, moving average
and random numbers. A run that was killed therefore continues exactly as an uninterrupted one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from pansplat.errors import InputError
from pansplat.inputs.views import Batch
from pansplat.system.atomic import replacing
from pansplat.system.strict_json import convert, parse_json
from pansplat.training.checkpoint import load_latest, restore, restore_optimizer, save_checkpoint
from pansplat.training.config import TrainConfig, as_json, require_same
from pansplat.training.loader import Loader
from pansplat.training.logs import CsvTable, ProgressDisplay, plot_run
from pansplat.training.losses import choose_perceptual
from pansplat.training.network import (
    build_auxiliary_heads,
    build_network,
    set_training_mode,
    trainable_parameters,
    write_weights,
)
from pansplat.training.optimization import ExponentialMovingAverage, one_cycle_rate
from pansplat.training.rendering import TargetRenderer
from pansplat.training.sources import load_sources
from pansplat.training.step import LOSS_TERMS, TrainingStep
from pansplat.training.stopping import StopRequest
from pansplat.training.validation import MEASURES, describe_measures, validate

_EXTRA_STEPS = 10  # steps of the learning rate's schedule beyond the last step, as in the official code
_COLUMNS = (*LOSS_TERMS, "rate", "gradient_norm", "seconds")


@dataclass(frozen=True)
class _Logs:
    """The log files of a run."""

    steps: CsvTable
    scores: CsvTable

    @staticmethod
    def open(folder: Path, config: TrainConfig, step: int, validation_step: int) -> _Logs:
        """Write config.json, and open the logs. Rows from `step` or `validation_step` on are removed."""
        with replacing(folder / "config.json") as partial:
            partial.write_text(as_json(config) + "\n", "utf-8")
        return _Logs(
            CsvTable(folder / "log.csv", _COLUMNS, step),
            CsvTable(folder / "validation.csv", ("height", *MEASURES), validation_step),
        )

    def close(self) -> None:
        for log in (self.steps, self.scores):
            log.close()


def _choose_device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda needs a CUDA device that torch can use, got none; use --device cpu.")
    return torch.device("cpu" if name == "cpu" or not torch.cuda.is_available() else "cuda")


class Trainer:
    """A training run, resumed from its latest checkpoint if there is one.

    Args:
        config: the settings.
        silent: print nothing.
    """

    def __init__(self, config: TrainConfig, *, silent: bool = False) -> None:
        config.check()
        self.config, self.silent = config, silent
        self.device = _choose_device(config.device)
        self.folder = config.out / "checkpoints"
        self.network = build_network(config.network, config.seed).to(self.device)
        self.auxiliary = build_auxiliary_heads(self.network).to(self.device) if config.network.auxiliary else None
        parameters = list(trainable_parameters(self.network, self.auxiliary))
        self.optimizer = torch.optim.Adam(parameters, lr=config.optimizer.rate)
        self.average = ExponentialMovingAverage(self.network, config.optimizer.ema) if config.optimizer.ema else None
        perceptual = choose_perceptual(config.perceptual, device=self.device)
        self._training_step = TrainingStep(self.network, self.auxiliary, perceptual, config.loss, config.memory)
        self.perceptual_name = perceptual.name
        self.step = 0
        latest = load_latest(self.folder, self._restore)
        self.resumed_from = None if latest is None else latest[0]
        self.stop = StopRequest()

    def train(self) -> bool:
        """Train the remaining steps. Returns whether all were done; a signal ends the run earlier."""
        out, total = self.config.out, self.config.optimizer.steps
        out.mkdir(parents=True, exist_ok=True)
        validation_step = 0 if self.resumed_from is None else self.step + 1
        logs = _Logs.open(out, self.config, self.step, validation_step)
        saved_at = time.monotonic()
        try:
            with ProgressDisplay(self.step, total, silent=self.silent) as progress, self.stop.on_signal(progress):
                progress.print(self._describe())
                if self.resumed_from is not None:
                    progress.print(f"resuming from {self.resumed_from}")
                elif self.config.validation.every:
                    self._validate(logs, progress)  # the untrained network is compared with later ones
                for batch in self._batches():
                    began = time.perf_counter()
                    values = self._optimize(batch)
                    values["seconds"] = time.perf_counter() - began
                    logs.steps.add(self.step, values)
                    self.step += 1
                    progress.update(self.step, values["loss"], values["seconds"])
                    stopped = self.stop.requested
                    if self._is_due(self.config.validation.every) and not stopped:
                        self._validate(logs, progress)
                    is_overdue = time.monotonic() - saved_at > 60 * self.config.checkpoint.minutes
                    if self._is_due(self.config.checkpoint.every) or is_overdue or stopped or self.step == total:
                        self.save()
                        saved_at = time.monotonic()
                    if stopped and self.step < total:
                        progress.print(f"stopped after step {self.step}; run the same command to resume")
                        return False
                self._finish(progress)
        finally:
            logs.close()
        return True

    def save(self) -> None:
        """Write a checkpoint and delete old ones."""
        save_checkpoint(self.folder, self.step, self._state(), keep=self.config.checkpoint.keep)

    def _batches(self) -> Iterator[Batch]:
        """The batch of each remaining step."""
        height, stream = 0, None
        for step in range(self.step, self.config.optimizer.steps):
            if stream is None or self.config.height_at(step) != height:
                height = self.config.height_at(step)
                stream = self._loader(height).batches(step)
            yield next(stream)

    def _loader(self, height: int) -> Loader:
        source, _ = load_sources(self.config.data, height, self.config.seed)
        return Loader(
            source,
            height=height,
            batch_size=self.config.optimizer.batch_size,
            seed=self.config.seed,
            workers=self.config.data.workers,
            augmentation=self.config.data.augmentation,
        )

    def _optimize(self, batch: Batch) -> dict[str, float]:
        """One optimiser step; returns its loss terms, learning rate and gradient norm."""
        settings = self.config.optimizer
        rate = one_cycle_rate(self.step, settings.steps + _EXTRA_STEPS, settings.rate)
        set_training_mode(self.network, self.config.network.frozen)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad()
        terms = self._training_step(batch)
        parameters = list(trainable_parameters(self.network, self.auxiliary))
        norm = float(torch.nn.utils.clip_grad_norm_(parameters, settings.clip))
        if not (math.isfinite(terms["loss"]) and math.isfinite(norm)):
            self._raise_not_finite(batch, terms["loss"], norm)
        self.optimizer.step()
        if self.average is not None:
            self.average.update(self.network, self.step)
        return {**terms, "rate": rate, "gradient_norm": norm}

    def _raise_not_finite(self, batch: Batch, loss: float, norm: float) -> None:
        """Save the batch and weights of a step whose loss or gradient is not finite, and raise an InputError."""
        path = self.config.out / f"not_finite_{self.step:08d}.pt"
        self.config.out.mkdir(parents=True, exist_ok=True)
        fields = {**vars(batch), "names": list(batch.names)}
        with replacing(path, failures=(RuntimeError,)) as partial:
            torch.save({"step": self.step, "batch": fields, "network": self.network.state_dict()}, partial)
        raise InputError(
            f"step {self.step}: needed finite numbers, got a loss of {loss} and a gradient of norm {norm} from "
            f"{', '.join(batch.names)}; the batch and the weights before the step are in {path}. Check the data, lower "
            "--optimizer.rate, and resume from the last checkpoint."
        )

    def _validate(self, logs: _Logs, progress: ProgressDisplay) -> None:
        settings, height = self.config.validation, self.config.height_at(max(self.step - 1, 0))
        _, source = load_sources(self.config.data, height, self.config.seed)
        with self._averaged_weights():
            measures = validate(
                self.network,
                source,
                TargetRenderer(self.config.memory.style, self.config.memory.mixing, height),
                samples=settings.samples,
                pictures=settings.pictures,
                tiles=self.config.memory.tiles,
                folder=self.config.out / "pictures",
                name=f"step_{self.step:08d}",
            )
        logs.scores.add(self.step, {"height": height, **measures})
        plot_run(self.config.out)
        progress.print(f"step {self.step}: {describe_measures(measures)}, mean of {settings.samples} samples")

    @contextmanager
    def _averaged_weights(self) -> Iterator[None]:
        """The network with the moving average of its weights, if there is one."""
        if self.average is None:
            yield
            return
        weights = {name: tensor.clone() for name, tensor in self.network.state_dict().items()}
        self.network.load_state_dict(self.average.state)
        try:
            yield
        finally:
            self.network.load_state_dict(weights)

    def _finish(self, progress: ProgressDisplay) -> None:
        path = self.config.out / "model.safetensors"
        write_weights(path, self.network, None if self.average is None else self.average.state)
        progress.print(f"done: {path}; use it with `pansplat predict PAIR -o scene.ply --model {path}`")

    def _is_due(self, every: int) -> bool:
        return bool(every) and (self.step % every == 0 or self.step == self.config.optimizer.steps)

    def _state(self) -> dict[str, Any]:
        return {
            "config": as_json(self.config),
            "network": self.network.state_dict(),
            "auxiliary": None if self.auxiliary is None else self.auxiliary.state_dict(),
            "mean": None if self.average is None else self.average.state,
            "optimizer": self.optimizer.state_dict(),
            "random": torch.get_rng_state(),
        }

    def _restore(self, path: Path, state: dict[str, Any]) -> None:
        """Restore the run from a checkpoint.

        Raises:
            DamagedCheckpointError: a key is missing or does not fit.
        """
        restore(state, "config", lambda text: convert(parse_json(text, "config"), dict, "config"))
        require_same(state["config"], self.config, path)
        restore(state, "step", int)  # checked before anything is restored
        restore(state, "network", self.network.load_state_dict)
        if self.auxiliary is not None:
            restore(state, "auxiliary", self.auxiliary.load_state_dict)
        if self.average is not None:
            restore(state, "mean", self.average.load)
        restore(state, "optimizer", partial(restore_optimizer, self.optimizer))
        restore(state, "random", torch.set_rng_state)
        self.step = state["step"]

    def _describe(self) -> str:
        count = sum(p.numel() for p in trainable_parameters(self.network, self.auxiliary))
        return (
            f"{self.config.network.shape}: {count:,} trainable parameters, "
            f"{self.config.data.kind} at {', '.join(f'{h}x{2 * h}' for h in self.config.heights)}, "
            f"perceptual loss {self.perceptual_name}, "
            f"from step {self.step} of {self.config.optimizer.steps}"
        )
